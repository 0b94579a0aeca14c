"""Does the joint 95 % region contain the truth 95 times in a hundred?

Each seed has a truth, a noise and images of its own, and runs through the whole pipeline with
unknown identities. Seeds for which no answer was offered are listed separately.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from spoilt_scans import careful_scan

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit.priors import exact
from flexdt.twin.calibration.fit.problem import SIX
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.projection.analytic_solids import Scene
from flexdt_extensions.studies.experiments import SHAPE
from flexdt_extensions.studies.rendered_runs import Rendering, exposures, line_integrals

DEMO = Rendering(counts=48_000.0, blur_px=0.0, fine=1)
"""Images as the twin makes them without blur: one ray a pixel, 12 000 counts of 4 photons."""
BLURRED = Rendering(counts=12_000.0, blur_px=0.7, fine=4)
"""Pixels that integrate, blur, fewer photons: closer to a real detector."""
CAMERAS = {"demo": DEMO, "blurred": BLURRED}


@dataclass(frozen=True)
class Draw:
    """One seed: was an answer offered, was the truth inside, how far off in sigmas.

    Attributes:
        seed: which.
        offered: the calibration was identifiable.
        inside: the truth is in the joint 95 % region.
        intervals: share of the six 95 % intervals that hold their truth.
        distance2: squared Mahalanobis distance.
        warnings: codes of the calibration's findings.
    """

    seed: int
    offered: bool
    inside: bool
    intervals: float
    distance2: float
    warnings: tuple[str, ...]


def draw(
    seed: int, model: BeadModel, scene: Scene, camera: Rendering, frames: int = 36
) -> Draw:
    """Simulate one scan's images, calibrate it, and compare its 95 % intervals and
    ellipsoid with the truth.

    Args:
        seed: of truth and noise.
        model, scene: the phantom.
        camera: how images are made.
        frames: over the turn.

    Returns:
        The draw; not offered if the calibration is not identifiable.
    """
    nominal, truth = careful_scan(np.random.default_rng([seed, 7]), frames)
    assert camera.counts is not None
    images = [
        line_integrals(counts, camera.counts)
        for counts in exposures(scene, model, nominal.cone_vec(truth), camera, [seed, 8])
    ]
    result = calibrate(
        [Scan(ArrayFrames(images, SHAPE), nominal)],
        replace(model),
        CalibrationRequest(priors=exact()),
        scene=scene,
    )
    codes = tuple(f.code for f in result.findings)
    if not result.identifiable or result.fit is None:
        return Draw(seed, False, False, 0.0, float("nan"), codes)
    certificate = result.fit.certificate
    edge = truth.to_edge()
    values = {}
    for name in SIX:
        true = edge[name]
        if name == "alpha":
            found = certificate.estimates[name].value
            true = found + (true - found + 180.0) % 360.0 - 180.0
        values[name] = true
    held = [e.low <= values[n] <= e.high for n, e in certificate.estimates.items()]
    return Draw(
        seed,
        True,
        certificate.inside_95(values),
        float(np.mean(held)),
        certificate.mahalanobis2(values),
        codes,
    )
