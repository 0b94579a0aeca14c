"""Touching beads before a body that the phantom does not describe are where they are: the
renderer is foreign, its scans are drawn."""

from __future__ import annotations

import beam_faults
import numpy as np
import numpy.typing as npt
import prior_coverage as own
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.poses import Poses

ANGLES = 22.5 * np.arange(16)
APART_MM = 4.5
"""Distance of the centres of balls of 2 mm that touch in some frames."""
TOUCHING_PX = 15.0
"""Distance of spots of 12 px in the image from which their fits are independent."""
MOST_SIGMAS = 1.3
"""Largest rms error of touching spots, in their sigmas (2.1 if the body's slope stays)."""


def touching(
    monkeypatch: pytest.MonkeyPatch, seed: int, body_mm: float
) -> npt.NDArray[np.float64]:
    """Errors of touching spots, in their sigmas, of two balls side by side; they are in a
    cylinder of plastic (0: in air)."""
    monkeypatch.setattr(own, "PIXEL", 0.3)
    monkeypatch.setattr(own, "SHAPE", (380, 478))
    rng = np.random.default_rng([29, seed])
    body = "pmma" if body_mm else "air"
    lab = beam_faults.Laboratory(body=body, body_mm=body_mm, photons=1e5)
    beads = own.spread(rng, 3.0 * APART_MM)
    way = rng.uniform(0.0, 2.0 * np.pi)
    beads[1] = beads[0] + APART_MM * np.array([np.cos(way), np.sin(way), 0.0])
    truth = own.drawn(rng, 1.0, False)
    images = beam_faults.radiographs(lab, rng, beads, ANGLES, truth)
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(ANGLES)
    )
    scan = Scan(ArrayFrames(images, own.SHAPE), poses)
    model = BeadModel(beads, np.full(len(beads), 1.0))
    (measured,) = calibrate([scan], model, CalibrationRequest()).measured
    centres = own.pixels(beads, ANGLES, own.SOD, truth)
    sigma = np.sqrt(np.diagonal(measured.covariances, axis1=2, axis2=3))
    near = np.linalg.norm(centres[:, 0] - centres[:, 1], axis=1) < TOUCHING_PX
    off = ((measured.tracks - centres) / sigma)[near, :2]
    return np.asarray(off[np.isfinite(off)])


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("body_mm", [0.0, 20.0])
def test_touching_beads_before_a_body_are_where_they_are(
    monkeypatch: pytest.MonkeyPatch, body_mm: float
) -> None:
    """They were off by several sigmas, towards where the body is thinner."""
    off = np.concatenate([touching(monkeypatch, seed, body_mm) for seed in range(3)])
    assert len(off) >= 24
    assert np.sqrt(np.mean(off**2)) < MOST_SIGMAS
