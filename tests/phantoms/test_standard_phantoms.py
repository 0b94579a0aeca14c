"""Phantoms of the field: where their balls are, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.phantoms import ball_bar, ball_helix, ball_plate, load_phantom, two_rings
from flexdt.twin.errors import LimitError

NAMES = {"two-rings": 24, "helix": 16, "ball-plate": 25, "ball-bar": 5}


@pytest.mark.parametrize(("name", "balls"), NAMES.items())
def test_they_ship_by_name_with_balls_apart(name: str, balls: int) -> None:
    phantom = load_phantom(name)
    assert phantom.name == name
    assert phantom.beads.shape == (balls, 3)
    gap = np.linalg.norm(phantom.beads[:, None] - phantom.beads, axis=2)
    assert gap[~np.eye(balls, dtype=bool)].min() > 2.0 * float(
        np.max(phantom.bead_radius_mm)
    )
    assert len(phantom.scene.solids) == balls


def test_rings_lie_on_two_circles() -> None:
    beads = two_rings(8, radius_mm=15.0, apart_mm=20.0).beads
    assert np.allclose(np.hypot(beads[:, 0], beads[:, 1]), 15.0)
    assert sorted(set(beads[:, 2])) == [-10.0, 10.0]


def test_one_ball_may_be_odd() -> None:
    assert np.count_nonzero(two_rings(odd_radius_mm=1.7).bead_radius_mm == 1.7) == 1
    assert np.count_nonzero(ball_plate(odd_radius_mm=1.7).bead_radius_mm == 1.7) == 1


def test_a_bar_leans_from_z_towards_x() -> None:
    ends = np.ptp(ball_bar(5, 9.0, lean_deg=30.0).beads, axis=0)
    assert np.allclose(ends, [18.0, 0.0, 18.0 * np.sqrt(3.0)])


@pytest.mark.parametrize(
    "made",
    [
        lambda: two_rings(2),
        lambda: two_rings(80),
        lambda: ball_helix(3),
        lambda: ball_plate(1),
        lambda: ball_bar(2),
        lambda: ball_bar(pitch_mm=1.5),
    ],
)
def test_too_few_balls_or_balls_that_overlap_are_refused(made: object) -> None:
    with pytest.raises(LimitError):
        made()  # type: ignore[operator]
