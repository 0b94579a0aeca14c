"""Right scans in a beam of several energies are right at every binning: the renderer is foreign,
its spectra are drawn."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import prior_coverage as own
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.geometry.poses import Poses

HARDNESS = np.array([0.6, 1.0, 3.0, 10.0])
"""Attenuation of four energies, in units of the middle one's."""
PANELS = {0.15: (760, 956), 0.3: (380, 478), 0.6: (190, 239)}
"""Pixel pitch [mm] and shape of one panel at three binnings."""
SIGMAS = (0.7, 1.3)
"""Bounds of the rms error of measured places, in their sigmas (up to 2.6 without the error of
the rendering, 2.5 to 4.2 without hardening or with nine rays a pixel)."""
CALM = {"causes_open", "held_unchecked"}
"""Findings that state no problem of the scan."""


def scanned(
    monkeypatch: pytest.MonkeyPatch, seed: int, pitch_mm: float, frames: int
) -> tuple[Calibration, npt.NDArray[np.float64]]:
    """A calibration of balls of steel in a drawn spectrum, and the places of their centres."""
    monkeypatch.setattr(own, "PIXEL", pitch_mm)
    monkeypatch.setattr(own, "SHAPE", PANELS[pitch_mm])
    monkeypatch.setattr(own, "RAYS", 10)
    rng = np.random.default_rng([17, seed])
    beads = own.spread(rng, 8.0)
    truth = {n: float(rng.uniform(-r, r)) for n, r in own.REACH.items()}
    angles = 360.0 / frames * np.arange(frames)
    shares = rng.dirichlet(np.full(len(HARDNESS), 2.0))
    photons = 10.0 ** rng.uniform(4.0, 5.0)
    at, panel = own.places(beads, angles, own.SOD, truth)
    centres = own.pixels(beads, angles, own.SOD, truth)
    images = []
    for balls, places in zip(at, centres, strict=True):
        # Energies add behind all balls in the way, not behind each of them.
        light = np.ones((len(HARDNESS), *own.SHAPE))
        for ball, place in zip(balls, places, strict=True):
            where, passed = own.shadow(ball, place, panel, 1.0, own.SOD)
            for part, hardness in zip(light, HARDNESS, strict=True):
                part[where] *= passed(1.2 * float(hardness))
        seen = rng.poisson(photons * np.tensordot(shares, light, 1))
        images.append(-np.log(np.maximum(seen, 0.5) / photons).astype(np.float32))
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], pitch_mm, np.radians(angles)
    )
    scan = Scan(ArrayFrames(images, own.SHAPE), poses)
    model = BeadModel(beads, np.full(len(beads), 1.0))
    return calibrate([scan], model, CalibrationRequest()), centres


@pytest.mark.parametrize(
    ("seed", "pitch_mm", "frames"),
    [
        (1, 0.6, 16),
        pytest.param(2, 0.6, 24, marks=pytest.mark.slow),
        pytest.param(3, 0.3, 24, marks=pytest.mark.slow),
        pytest.param(4, 0.15, 24, marks=pytest.mark.slow),
        pytest.param(105, 0.6, 24, marks=pytest.mark.slow),
        pytest.param(112, 0.6, 24, marks=pytest.mark.slow),
    ],
)
@pytest.mark.campaign(3)
def test_beads_in_a_hard_beam_are_where_they_are(
    monkeypatch: pytest.MonkeyPatch, seed: int, pitch_mm: float, frames: int
) -> None:
    found, centres = scanned(monkeypatch, seed, pitch_mm, frames)
    (measured,) = found.measured
    error = measured.tracks - centres
    sigma = np.sqrt(np.diagonal(measured.covariances, axis1=2, axis2=3))
    assert np.isfinite(error).mean() > 0.8
    assert SIGMAS[0] < np.sqrt(np.nanmean((error / sigma) ** 2)) < SIGMAS[1]
    assert {f.code for f in found.findings} <= CALM
