"""Each import of what is exported gives the same geometry, tilts and all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import CHIRAL, SHAPE, some_parameters, some_poses, worst

from flexdt.twin.exchange.flexdata import flexdata_text, read_flexdata
from flexdt.twin.exchange.geometry import ExchangeError, ScanGeometry, circle_of
from flexdt.twin.exchange.number_tables import (
    csv_text,
    geometry_text,
    read_csv,
    read_geometry_text,
    read_tomosipo,
    read_vectors_array,
    read_vectors_text,
    tomosipo_arrays,
    vectors_text,
)
from flexdt.twin.exchange.rtk_xml import read_rtk, rtk_text
from flexdt.twin.geometry.poses import Poses

SEEDS = st.integers(0, 2**32 - 1)
SAME = 1e-9
"""mm, as promised."""


def scan(seed: int, *, even: bool = False, still: bool = False) -> ScanGeometry:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, int(rng.integers(1, 9)), even=even, still=still)
    cone_vec = poses.cone_vec(some_parameters(rng))
    files = tuple(f"scan_{i:06d}.tif" for i in range(len(cone_vec)))
    return ScanGeometry(cone_vec, SHAPE, name="a scan", files=files)


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_tables_keep_every_digit(seed: int) -> None:
    geometry = scan(seed)
    assert read_vectors_text(vectors_text(geometry)).cone_vec == geometry.cone_vec
    assert read_vectors_array(geometry.cone_vec.rows).cone_vec == geometry.cone_vec
    assert read_geometry_text(geometry_text(geometry)) == geometry
    table = read_csv(csv_text(geometry))
    assert (table.cone_vec, table.shape, table.files) == (
        geometry.cone_vec, geometry.shape, geometry.files,
    )  # fmt: skip
    arrays = read_tomosipo(tomosipo_arrays(geometry))
    assert (arrays.cone_vec, arrays.shape) == (geometry.cone_vec, geometry.shape)


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_rtk_keeps_any_view(seed: int) -> None:
    geometry = scan(seed)
    for one in (geometry, geometry.rows_up()):
        back = read_rtk(rtk_text(one), one.pitch_mm, one.shape)
        assert worst(back.cone_vec.rows, one.cone_vec.rows) < SAME


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_flexdata_keeps_any_circle_in_equal_steps(seed: int) -> None:
    geometry = scan(seed, even=True, still=True)
    back = read_flexdata(flexdata_text(geometry))
    assert worst(back.cone_vec.rows, geometry.cone_vec.rows) < SAME
    assert back.shape == geometry.shape


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_from_cone_vec_gives_the_geometry_and_stands_still_where_it_does(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    true = some_poses(rng)
    poses = Poses.from_cone_vec(true.cone_vec())
    assert worst(poses.cone_vec().rows, true.cone_vec().rows) < SAME
    for part in (poses.source, poses.detector, poses.u, poses.v):
        assert np.ptp(part, axis=0).max() < SAME


def test_correction_parameters_keep_their_meaning() -> None:
    """An imported nominal geometry takes a correction as the data set's own does."""
    rng = np.random.default_rng(8)
    true = Poses(
        np.array([[3.0, 0, 12]]), np.array([[1.0, 600, 20]]), np.array([[2.0, 1050, 9]]),
        np.array([[0.15, 0, 0]]), np.array([[0, 0, -0.15]]), np.linspace(0.3, 6, 9),
    )  # fmt: skip
    imported = Poses.from_cone_vec(true.cone_vec())
    for _ in range(5):
        parameters = some_parameters(rng)
        assert (
            worst(imported.cone_vec(parameters).rows, true.cone_vec(parameters).rows)
            < SAME
        )


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_the_circle_is_found_wherever_its_axis_is(seed: int) -> None:
    geometry = scan(seed, even=False, still=True)
    circle = circle_of(geometry.cone_vec, "test")
    assert worst(circle.cone_vec().rows, geometry.cone_vec.rows) < SAME


@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_what_is_no_circle_is_refused(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, 7, still=False)
    with pytest.raises(ExchangeError, match="one circle"):
        flexdata_text(ScanGeometry(poses.cone_vec(), SHAPE))


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS)
def test_upside_down_images_see_the_same_points(seed: int) -> None:
    geometry = scan(seed)
    up = geometry.rows_up()
    a = geometry.cone_vec.project_points(CHIRAL, SHAPE)
    b = up.cone_vec.project_points(CHIRAL, SHAPE)
    assert worst(a[..., 0], b[..., 0]) < 1e-9
    assert worst(a[..., 1], SHAPE[0] - 1 - b[..., 1]) < 1e-9
    assert up.rows_up() == geometry


def test_astra_text_is_read_as_others_write_it() -> None:
    geometry = scan(3)
    rows = geometry.cone_vec.rows
    savetxt = "\n".join(" ".join(f"{x:.18e}" for x in row) for row in rows)
    assert (
        worst(read_vectors_text("# walnut\n" + savetxt + "\n").cone_vec.rows, rows)
        < 1e-12
    )
    commas = "\r\n".join(", ".join(f"{x:.17g}" for x in row) for row in rows)
    assert read_vectors_text(commas).cone_vec == geometry.cone_vec
