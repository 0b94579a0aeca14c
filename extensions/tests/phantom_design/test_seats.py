"""Seats in a stack of bricks are free space where a bead touches what it is glued to."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.phantoms import PhantomError
from flexdt.phantoms.bricks import Brickwork, lego_phantom
from flexdt.twin.errors import LimitError
from flexdt_extensions.phantom_design.seats import (
    grid_seats,
    seats_of,
    stack_of,
    stack_phantom,
)


def plastic(work: Brickwork, points: np.ndarray) -> np.ndarray:
    """Whether points lie in plastic: bricks written out by hand from their measures."""
    v, (wide, deep, _) = work.measures, work.size_mm
    inside = np.zeros(len(points), dtype=bool)
    for brick in range(work.bricks):
        z = points[:, 2] - work.floor(brick)
        here = (z >= 0) & (z <= v["brick_height_mm"])
        flat = (np.abs(points[:, 0]) <= wide / 2) & (np.abs(points[:, 1]) <= deep / 2)
        hollow = (
            (np.abs(points[:, 0]) < wide / 2 - v["wall_mm"])
            & (np.abs(points[:, 1]) < deep / 2 - v["wall_mm"])
            & (z < v["brick_height_mm"] - v["roof_mm"])
        )
        inside |= here & flat & ~hollow
        for x in (-4.0, 4.0):  # two tubes under a 3 x 2 brick
            r = np.hypot(points[:, 0] - x, points[:, 1])
            inside |= here & (r > v["tube_inner_diameter_mm"] / 2) & (
                r < v["tube_outer_diameter_mm"] / 2
            )  # fmt: skip
        for x in (-8.0, 0.0, 8.0):
            for y in (-4.0, 4.0):
                r = np.hypot(points[:, 0] - x, points[:, 1] - y)
                top = z - v["brick_height_mm"]
                inside |= (
                    (r < v["stud_diameter_mm"] / 2)
                    & (top >= 0)
                    & (top < v["stud_height_mm"])
                )
    return inside


def test_no_seat_lies_in_plastic_and_each_touches_some() -> None:
    work = Brickwork()
    seats = seats_of(work, 1.0)
    directions = np.random.default_rng(3).normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    for place in seats.places:
        assert not plastic(work, place + 0.999 * directions).any(), place
        assert plastic(work, place + 1.02 * axes).any(), place
    assert set(seats.brick.tolist()) == set(range(5))
    floors = np.array([work.floor(brick) for brick in range(5)])
    levels = np.round(seats.places[:, 2] - floors[seats.brick], 6)
    assert (
        len(set(levels.tolist())) == 3
    )  # just above the studs, half way up, against the roof


def test_stack_is_the_thesis_phantom_but_for_its_beads() -> None:
    thesis, work = lego_phantom(), Brickwork()
    made = stack_phantom(work, "mine", seats_of(work, 1.0).places[[0, 100]], 1.0)
    assert made.size_mm == thesis.size_mm
    assert len(made.scene.solids) - 2 == len(thesis.scene.solids) - 5


def test_what_cannot_be_built_is_refused() -> None:
    with pytest.raises(LimitError, match="bricks"):
        stack_of((3, 2), 0)
    with pytest.raises(LimitError, match="does not fit"):
        seats_of(Brickwork(), 4.0)
    with pytest.raises(PhantomError, match="not on a seat"):
        stack_phantom(Brickwork(), "x", [[0.0, 0.0, 0.0]], 1.0)
    with pytest.raises(LimitError):
        grid_seats((1.0, 10.0, 10.0), 1.0, 2.0)
