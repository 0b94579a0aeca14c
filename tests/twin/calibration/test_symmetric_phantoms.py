"""The field's own phantoms: two rings, ball plates, a helix and a ball bar, told apart or not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import constellations
import numpy as np
import pytest
from constellations import (
    Drawn,
    bar,
    helix,
    odd_ball,
    odd_material,
    plate,
    rings,
    scan_of,
)

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose import CalibrationCode
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

Array = constellations.Array
UPRIGHT = np.outer(9.0 * np.arange(-2, 3), [0, 0, 1.0])
PLATE = plate()
SHAPES: dict[str, Array] = {
    "two rings": rings(), "plate": PLATE, "rings of four": rings(4),
    "ring and foot": np.concatenate([rings(5)[:5], [[0, 0, 12.0]]]), "upright bar": UPRIGHT,
}  # fmt: skip
"""Phantoms that look alike in several ways."""
TOLD: dict[str, Array] = {"helix": helix(), "bar": bar()}
"""Those that do not."""


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


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.campaign(1)) for n in range(1, 12))]
)
def test_axis_and_magnification_of_a_symmetric_phantom_are_offered_without_its_angle(
    shape: str, seed: int
) -> None:
    rng = np.random.default_rng([seed, 5])
    drawn = scan_of(SHAPES[shape], rng)
    result = calibrated(drawn, rng)
    assert result.identifiable, result.findings.texts
    assert result.findings.of(CalibrationCode.AMBIGUOUS).warnings
    off = pulls(result, drawn)
    assert "alpha" not in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("odd", [odd_ball, odd_material])
@pytest.mark.parametrize("shape", ["two rings", "rings of four", "plate"])
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.campaign(1)) for n in range(1, 10))]
)
def test_one_odd_ball_tells_everything(
    shape: str, seed: int, odd: Callable[[Drawn, np.random.Generator], Drawn]
) -> None:
    rng = np.random.default_rng([seed, 6])
    drawn = scan_of(SHAPES[shape], rng)
    while True:  # A ball on the line about which a phantom is turned tells nothing.
        marked = odd(drawn, rng)
        which = (marked.radii != drawn.radii) | (marked.mu != drawn.mu)
        if np.hypot(*drawn.beads[which][0, :2]) > 1.0:
            break
    result = calibrated(marked, rng)
    assert result.identifiable, result.findings.texts
    assert not result.findings.of(CalibrationCode.AMBIGUOUS)
    off = pulls(result, marked)
    assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("shape", TOLD)
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.campaign(1)) for n in range(1, 10))]
)
def test_a_helix_and_a_leaning_bar_have_every_number(shape: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    drawn = scan_of(TOLD[shape], rng)
    result = calibrated(drawn, rng)
    assert result.identifiable, result.findings.texts
    off = pulls(result, drawn)
    if shape == "helix":
        assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("shape", ["two rings", "plate"])
def test_a_stated_angle_tells_all(shape: str) -> None:
    rng = np.random.default_rng([3, 8])
    drawn = scan_of(SHAPES[shape], rng)
    stated = {"alpha": round(drawn.truth["alpha"]) + 2.0}
    result = calibrated(drawn, rng, stated)
    assert result.identifiable, result.findings.texts
    assert not result.findings.of(CalibrationCode.AMBIGUOUS)
    off = pulls(result, drawn)
    assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


def test_every_angle_of_a_symmetric_phantom_is_listed() -> None:
    rng = np.random.default_rng(1)
    drawn = scan_of(rings(), rng)
    (told,) = calibrated(drawn, rng).findings.of(CalibrationCode.AMBIGUOUS)
    angles = [
        float(w.strip(","))
        for w in told.text.split("angles, ")[1].split(" deg")[0].split()
    ]
    assert len(angles) == 12
    true = drawn.truth["alpha"] % 30.0
    apart = np.abs((np.array(angles) - true + 15.0) % 30.0 - 15.0)
    assert apart.max() < 1.0
