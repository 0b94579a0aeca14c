"""A wrong pixel pitch beside a panel elsewhere: both in the intervals unless images decide."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from causes_named import calibrated, worst_error
from faults_drawn import World, drawn, phantom, shadows

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.diagnose.table.explained import explained
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.groups.told import pitch_beside
from flexdt.twin.calibration.fit.fit import (
    FitResult,
    estimate_geometry,
    image_quantities,
)
from flexdt.twin.calibration.fit.priors import ASSUMED
from flexdt.twin.calibration.fit.problem import SIX, UNSTRAINED, Centre
from flexdt.twin.geometry.poses import Poses

FREED = ("dD_z",)


@pytest.mark.parametrize("seed", [1, 2])
def test_the_advice_to_free_the_distance_is_not_wrong_of_a_wrong_pitch(seed: int) -> None:
    """It was offered up to 122 sigmas off; the axis in the images stays as sharp."""
    scan = drawn("other_pitch", seed)
    result = calibrated(scan, free=FREED)
    assert result.identifiable, result.findings
    worst, where = worst_error(result, scan)
    assert worst < 4.0, where
    (said,) = (f.text for f in result.findings if f.code == "pixel_pitch")
    told = re.search(r"pixels ([0-9.]+) mm wide instead of 0.1496 mm", said)
    assert told is not None
    assert float(told[1]) == pytest.approx(scan.pixel, rel=3e-3)
    assert result.fit is not None
    (seen,) = image_quantities(result.fit)
    assert seen["axis_column"].sigma < 0.02
    assert seen["magnification"].sigma / seen["magnification"].value > 0.02


@pytest.mark.parametrize("seed", [3, 4])
def test_a_freed_distance_near_its_place_is_as_certain_as_before(seed: int) -> None:
    result = calibrated(drawn("sdd_off", seed), free=FREED)
    assert result.identifiable
    assert not [f for f in result.findings if f.code == "pixel_pitch"]
    assert result.fit is not None
    estimates = result.fit.certificate.estimates
    assert estimates["pixel"].sigma * 700.0 < estimates["dD_z"].sigma < 2.0


def two_distances(elsewhere_mm: float, pitch: float) -> FitResult:
    """A fit with a free distance to scans with two distances of the panel."""
    rng = np.random.default_rng(5)
    beads = phantom(rng, 6)
    radii = np.full(6, 1.0)
    angles = 15.0 * np.arange(24)
    shown = np.ones((24, 6), dtype=bool)
    offsets = {"dO_x": 1.5, "dO_z": -3.0, "alpha": 20.0, "dD_z": elsewhere_mm}
    world = World(
        beads,
        radii,
        offsets,
        angles,
        np.zeros((24, 3)),
        shown,
        500.0,
        700.0,
        0.1496 * pitch,
    )
    distances = 700.0, 1100.0
    tracks = np.concatenate([shadows(replace(world, sdd=d))[0] for d in distances])
    tracks += rng.normal(scale=0.01, size=tracks.shape)
    poses = Poses.concatenate(
        [
            Poses.upright([0, 0, 0], [0, 500, 0], [0, d, 0], 0.1496, np.radians(angles))
            for d in distances
        ]
    )
    priors = {n: w for n, w in ASSUMED.items() if n not in FREED}
    return estimate_geometry(
        tracks, BeadModel(beads, radii), poses, (*SIX, *FREED), shape=(760, 956),
        priors=priors, centre=Centre.OUTLINE,
    )  # fmt: skip


def distance_of(fit: FitResult) -> tuple[float, float]:
    """The panel's distance with its sigma, beside all that residuals show."""
    certificate = explained(fit, Known(UNSTRAINED, 0.0, 1e-3)).fit.certificate
    estimate = certificate.estimates["dD_z"]
    return estimate.value, estimate.sigma


def test_two_distances_of_the_panel_tell_the_pitch() -> None:
    """A panel elsewhere has no rival there. A wrong pitch has one, a panel whose way is wrong,
    too."""
    right = two_distances(25.0, 1.0)
    assert pitch_beside(right, ASSUMED["dD_z"]) is None
    value, sigma = distance_of(right)
    assert abs(value - 25.0) < 4.0 * sigma < 2.0
    value, sigma = distance_of(two_distances(0.0, 1.03))
    assert abs(value) < 4.0 * sigma
