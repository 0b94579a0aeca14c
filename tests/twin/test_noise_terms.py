"""A source of noise stands in images and in forecasts: a term is planted, and seen in both."""

from __future__ import annotations

import math

import numpy as np
import pytest

import flexdt as fx
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings, PixelGrid
from flexdt.twin.physics import Detector, panel_noise
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.panel_noise import Exposed, NoiseTerm
from flexdt.twin.physics.readout import Expected, read_out

SIDE = 240


def planted(sigma_e: float, spreads: bool) -> NoiseTerm:
    """White noise of so many electrons in each read-out."""

    def draw(exposed: Exposed, rng: np.random.Generator) -> Float32Array:
        sigma = sigma_e / math.sqrt(exposed.averages)
        return rng.normal(0.0, sigma, exposed.mean_e.shape).astype(np.float32)

    return NoiseTerm("planted", spreads, draw, lambda panel, camera, xrays_e2: sigma_e**2)


def seen_variance(
    panel: Detector,
    camera: CameraSettings,
    averages: int,
    mean_e: float,
    xrays_e2: float,
    seed: int,
) -> float:
    """Variance of the counts of a flat image [counts^2]; the panel has no fixed pattern."""
    flat = np.full((SIDE, SIDE), 1.0, np.float32)
    expected = Expected(flat * np.float32(mean_e), flat * np.float32(xrays_e2))
    exposure = ExposureSettings(90.0, 50.0, 100.0, averages)
    counts = read_out(panel, expected, camera, exposure, np.random.default_rng(seed))
    return float(counts[20:-20, 20:-20].astype(float).var())


@pytest.mark.parametrize("seed", range(6))
def test_a_planted_term_is_in_images_as_the_forecast_says(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng([53, seed])
    spreads, averages = bool(seed % 2), int(rng.integers(1, 5))
    panel = Detector(
        pixels=PixelGrid(SIDE, SIDE, 0.1), blur_mm=float(rng.uniform(0.05, 0.15)),
        gain_sigma=0.0, offset_sigma_counts=0.0, dead_fraction=0.0,
        electrons_per_count=float(rng.uniform(20.0, 60.0)),
    )  # fmt: skip
    camera = panel.camera((SIDE, SIDE))
    mean_e, xrays_e2 = float(rng.uniform(1e5, 3e5)), float(rng.uniform(1e6, 1e7))
    sigma_e = float(rng.uniform(2.0, 4.0)) * math.sqrt(xrays_e2)
    told, seen = [], []
    for terms in (panel_noise.NOISE, (*panel_noise.NOISE, planted(sigma_e, spreads))):
        monkeypatch.setattr(panel_noise, "NOISE", terms)
        told.append(panel_noise.pixel_variance(panel, camera, averages, xrays_e2))
        seen.append(seen_variance(panel, camera, averages, mean_e, xrays_e2, seed))
    assert seen == pytest.approx(told, rel=0.08)
    if not spreads:
        assert panel.electrons_per_count is not None
        added = sigma_e**2 / averages / panel.electrons_per_count**2
        assert told[1] - told[0] == pytest.approx(added, rel=1e-9)
    assert told[1] > 1.3 * told[0]


def test_a_planted_term_lowers_the_contrast_that_expose_forecasts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ball = {"kind": "sphere", "center": [0, 0, 0], "radius": 8, "material": "aluminium"}
    before = fx.expose(ball).asked.cnr
    monkeypatch.setattr(
        panel_noise, "NOISE", (*panel_noise.NOISE, planted(20_000.0, False))
    )
    assert fx.expose(ball).asked.cnr < 0.5 * before
