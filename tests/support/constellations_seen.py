"""Drawn scans of balls as a calibration takes them, and how far off its numbers are."""

from __future__ import annotations

import math
from dataclasses import replace

import constellations
import numpy as np
from constellations import Drawn

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses


def scan_seen(drawn: Drawn, rng: np.random.Generator) -> Scan:
    """A drawn scan as a calibration takes it: its spots, and what is believed."""
    noise = constellations.NOISE_PX
    looks = []
    for frame in constellations.spots(drawn, rng, noise):
        some = Detections.of_points(frame[:, :2], noise, frame[:, 2], drawn.shape)
        seen = replace(some, bias=np.ones(len(frame)), contrast=frame[:, 3])
        looks.append(FrameSpots(seen, FrameState.USABLE))
    b = drawn.believed
    poses = Poses.upright(
        [0, 0, 0], [0, b["sod"], 0], [0, b["sdd"], 0], b["pixel"],
        np.radians(drawn.believed_angles),
    )  # fmt: skip
    return Scan(SpotFrames(looks), poses)


def calibrated(
    drawn: Drawn, rng: np.random.Generator, start: dict[str, float] | None = None
) -> Calibration:
    """Calibrate a drawn scan; with a start angle it is stated to 5 degrees."""
    contrast = 2.0 * drawn.believed_radii * drawn.believed_mu
    model = BeadModel(drawn.believed_beads, drawn.believed_radii, contrast=contrast)
    request = CalibrationRequest(
        second_look=False, start=Offsets.from_edge(start or {}),
        priors={"alpha": 5.0} if start else {},
    )  # fmt: skip
    return calibrate([scan_seen(drawn, rng)], model, request)


def pulls(result: Calibration, drawn: Drawn) -> dict[str, float]:
    """Errors of what is offered, in sigmas: the axis and the magnification in the image, and
    each parameter that has a value."""
    assert result.fit is not None
    t = drawn.truth
    depth = constellations.SOD + t["dO_z"] + t["tau_z"]
    true = {
        "axis_column": (t["dO_x"] + t["tau_x"]) * constellations.SDD / depth
        / constellations.PIXEL + (constellations.SHAPE[1] - 1) / 2,
        "magnification": constellations.SDD / depth,
        "axis_angle": 0.0,
    }  # fmt: skip
    (seen,) = image_quantities(result.fit)
    out = {n: (e.value - true[n]) / e.sigma for n, e in seen.items()}
    for name, e in result.fit.certificate.estimates.items():
        if e.asked and math.isfinite(e.sigma):
            off = e.value - t[name]
            if name == "alpha":
                off = (off + 180.0) % 360.0 - 180.0
            out[name] = off / e.sigma
    return out
