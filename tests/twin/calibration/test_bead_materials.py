"""Beads of several materials: all are found, of a renderer of its own."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
import prior_coverage as own
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, Scan, calibrate
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.projection import Scene, Solid, Sphere

ANGLES = 20.0 * np.arange(18)
RADIUS = 1.0
BEAM = 1.4
"""Factor by which the faint material attenuates more in the beam than the phantom's file
says."""


def calibrated(
    seed: int,
    attenuations: npt.ArrayLike,
    *,
    stated: bool = True,
    radii: npt.ArrayLike = RADIUS,
) -> tuple[Calibration, dict[str, float]]:
    """A calibration of balls of these attenuations [1/mm], and the truth."""
    rng = np.random.default_rng([31, seed])
    beads = own.spread(rng, 8.0)
    attenuation = np.broadcast_to(np.asarray(attenuations, dtype=float), len(beads))
    radius = np.broadcast_to(np.asarray(radii, dtype=float), len(beads))
    truth = {n: float(rng.uniform(-r, r)) for n, r in own.REACH.items()}
    at, panel = own.places(beads, ANGLES, own.SOD, truth)
    images = []
    for balls, centres in zip(at, own.pixels(beads, ANGLES, own.SOD, truth), strict=True):
        light = np.ones(own.SHAPE)
        for ball, centre, mu, r in zip(balls, centres, attenuation, radius, strict=True):
            where, passed = own.shadow(ball, centre, panel, r, own.SOD)
            light[where] *= passed(mu)
        seen = own.PHOTONS * cv2.GaussianBlur(light, (0, 0), own.BLUR_PX)
        images.append(-np.log(np.maximum(rng.poisson(seen), 0.5) / own.PHOTONS))
    said = np.where(attenuation < attenuation.max(), attenuation / BEAM, attenuation)
    solids = Scene(
        tuple(
            Solid(Sphere((x, y, z), r), f"material {mu:g}", mu)
            for (x, y, z), mu, r in zip(
                beads.tolist(), said.tolist(), radius.tolist(), strict=True
            )
        )
    )
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(ANGLES)
    )
    scan = Scan(ArrayFrames([i.astype(np.float32) for i in images], own.SHAPE), poses)
    model = BeadModel(beads, radius)
    return calibrate([scan], model, scene=solids if stated else Scene(())), truth


STEEL, ALUMINIUM = 0.9, 0.07


@pytest.mark.parametrize(
    ("seed", "faint"),
    [
        (1, (1, 3)),
        pytest.param(2, (0,), marks=pytest.mark.slow),
        pytest.param(3, (0, 1, 2, 4), marks=pytest.mark.slow),
    ],
)
def test_beads_of_two_materials_are_all_found(seed: int, faint: tuple[int, ...]) -> None:
    attenuations = np.full(5, STEEL)
    attenuations[list(faint)] = ALUMINIUM
    found, truth = calibrated(seed, attenuations)
    assert found.identifiable, found.findings
    assert "beads_missing" not in {f.code for f in found.findings}
    seen = np.isfinite(found.measured[0].tracks[..., 0]).mean(axis=0)
    assert seen.min() > 0.9
    assert found.fit is not None
    for name, value in truth.items():
        e = found.fit.certificate.estimates[name]
        assert abs(e.value - value) < 4.0 * e.sigma, name


@pytest.mark.slow
def test_of_a_phantom_without_materials_the_faint_beads_are_missing() -> None:
    found, _ = calibrated(1, [STEEL, ALUMINIUM, STEEL, ALUMINIUM, STEEL], stated=False)
    assert "beads_missing" in {f.code for f in found.findings}
