"""A second measurement that loses the beads is a finding and does not end the calibration."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
import prior_coverage as own
import pytest

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.frame_source import ArrayFrames
from flexdt.twin.calibration.pipeline import Calibration, Scan, calibrate
from flexdt.twin.geometry.poses import Poses

ANGLES = 30.0 * np.arange(12)


@cache
def rendered(count: int) -> tuple[npt.NDArray[np.float64], list[npt.NDArray[np.float32]]]:
    """Some balls, and their line integrals."""
    rng = np.random.default_rng([11, count])
    beads = own.spread(rng, 8.0)[:count]
    return beads, list(
        own.radiographs(rng, beads, ANGLES, own.SOD, {"dO_x": 1.0, "alpha": 12.0})
    )


def calibrated(count: int, saturated_at: float) -> Calibration:
    """A calibration of images whose panel is full from a part of the open beam on."""
    beads, images = rendered(count)
    shown = [np.maximum(i + np.log(saturated_at), 0.0).astype(np.float32) for i in images]
    poses = Poses.upright(
        [0, 0, 0], [0, own.SOD, 0], [0, own.SDD, 0], own.PIXEL, np.radians(ANGLES)
    )
    scan = Scan(ArrayFrames(shown, own.SHAPE), poses)
    return calibrate([scan], BeadModel(beads, np.full(count, own.RADIUS)))


def codes(found: Calibration) -> list[str]:
    return [f.code for f in found.errors]


@pytest.mark.parametrize(
    ("saturated_at", "code"),
    [
        pytest.param(0.75, "bead_size", marks=pytest.mark.slow),
        (0.64, "spots_unconfirmed"),
        pytest.param(0.5, "no_beads", marks=pytest.mark.slow),
    ],
)
def test_saturated_images_are_refused_with_a_reason(
    saturated_at: float, code: str
) -> None:
    found = calibrated(5, saturated_at)
    assert not found.identifiable
    assert code in codes(found)


def test_of_one_ball_it_is_said_that_it_does_not_determine_the_geometry() -> None:
    found = calibrated(1, 1.0)
    assert found.fit is not None
    assert not found.identifiable
    assert codes(found) == []  # its size depends on the distance, which is open
