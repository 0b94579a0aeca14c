"""Bead cuboids against the thesis's table and formula, written out by hand in Unity's axes."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.phantoms import (
    bead_phantom,
    load_phantom,
    material,
    phantom_names,
    spiral_positions,
)
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt.twin.projection.analytic_solids import Box, Sphere

TABLE_6_2 = {
    "normal": (20, 40, 60),
    "small": (20, 22, 40),
    "square": (30, 30, 30),
    "tall": (10, 15, 80),
    "wide": (80, 80, 20),
    "compact": (10, 15, 20),
    "coplanar": (40, 60, 10),
}
ALL = [(name, k) for name in TABLE_6_2 for k in range(1, 8)]


def spiral_by_hand(
    width: float, breadth: float, height: float, k: int
) -> list[list[float]]:
    """Unity's (x, y, z) of each bead, then the world's (x, z, y)."""
    out = []
    for i in range(k):
        y = (i / (k - 1) - 0.5) * (height - 4.0) if k > 1 else 0.0
        x = (width / 2 - 2.0) * math.cos(2 * math.pi * i / k)
        z = (breadth / 2 - 2.0) * math.sin(2 * math.pi * i / k)
        out.append([x, z, y])
    return out


@pytest.mark.parametrize(("name", "k"), ALL)
def test_beads_lie_on_the_spiral_of_table_6_2(name: str, k: int) -> None:
    p = load_phantom(f"{name}-{k}")
    assert p.size_mm == TABLE_6_2[name]
    assert_allclose(p.beads, spiral_by_hand(*TABLE_6_2[name], k), atol=1e-12)
    assert_allclose(p.bead_radius_mm, 2.0)
    inside = np.asarray(p.size_mm) / 2 - np.abs(p.beads) - 2.0
    assert inside.min() >= -1e-12
    gap = min(
        (np.linalg.norm(a - b) - 4 for a, b in itertools.combinations(p.beads, 2)),
        default=9,
    )
    assert (
        (gap < 0)
        == any("overlap" in a for a in p.assumed)
        == ((name, k) == ("compact", 7))
    )


def test_normal_with_three_beads_in_numbers() -> None:
    h = 18 * math.sqrt(3) / 2
    assert_allclose(
        load_phantom("normal-3").beads, [[8, 0, -28], [-4, h, 0], [-4, -h, 28]]
    )


def test_one_bead_is_at_mid_height_angle_0() -> None:
    assert_allclose(spiral_positions((20, 40, 60), 1, 2.0), [[8.0, 0.0, 0.0]])


def test_growing_height_turns_counter_clockwise_from_above() -> None:
    """The spiral's sense is a fact of handedness: Unity's turn from x to z is x to y here."""
    b = load_phantom("normal-7").beads
    turn = b[:-1, 0] * b[1:, 1] - b[:-1, 1] * b[1:, 0]
    assert (np.diff(b[:, 2]) > 0).all()
    assert (turn > 0).all()


def test_the_bead_carries_the_difference_to_its_body() -> None:
    p = bead_phantom("normal", 2, body_material="pmma", bead_material="aluminium")
    body, first, second = p.scene.solids
    assert isinstance(body.shape, Box)
    assert body.shape.size == (20.0, 40.0, 60.0)
    assert isinstance(first.shape, Sphere)
    assert first.shape.center == tuple(p.beads[0])
    assert body.mu_per_mm + second.mu_per_mm == pytest.approx(
        material("aluminium").mu_per_mm
    )


def test_names_and_defaults() -> None:
    assert set(TABLE_6_2) | {"lego", "shepp-logan", "chiral"} <= set(phantom_names())
    assert len(load_phantom("wide").beads) == 5
    assert bead_phantom((11, 12, 13), 2).size_mm == (11.0, 12.0, 13.0)
    for name in phantom_names():
        assert load_phantom(name).description


@pytest.mark.parametrize(
    "name", ["", "Normal", "normal-0", "normal-", "../lego", "lego-3", "x" * 99]
)
def test_unknown_names_list_the_known_ones(name: str) -> None:
    with pytest.raises(UnknownNameError, match="shepp-logan"):
        load_phantom(name)


def test_beads_that_do_not_fit_are_refused_with_numbers() -> None:
    with pytest.raises(
        LimitError, match=r"radius 6 mm does not fit into 10 x 15 x 20.*at most 5"
    ):
        bead_phantom("compact", 3, bead_radius_mm=6.0)
    with pytest.raises(LimitError, match="0 beads"):
        bead_phantom("normal", 0)


def test_no_mirror_image_of_the_chiral_phantom_fits_it() -> None:
    """Labelled by radius, no rotation maps the beads onto their mirror image: the volume they
    span changes its sign, and the radii forbid any relabelling."""
    p = load_phantom("chiral")
    assert len(set(p.bead_radius_mm)) == len(p.beads) == 4
    spanned = np.linalg.det(p.beads[1:] - p.beads[0])
    assert abs(spanned) > 1000.0
    largest = p.beads[np.argmax(p.bead_radius_mm)]
    assert largest[0] > 0
    assert largest[1] == largest[2] == 0.0
