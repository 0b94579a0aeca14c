"""Voxel projection against the double-precision reference, an analytic box, and its adjoint."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import (
    TriangleMesh,
    Volume,
    back,
    forward,
    project_materials,
    project_mesh,
    project_scene,
)
from flexdt.twin.projection.analytic_solids import Box, Scene, Solid

WORST = 3e-6
MEAN = 3e-7


def rng(seed=0):
    return np.random.default_rng(seed)


GEOMETRIES = {
    "level": {},
    "tilted": {"roll": 0.007, "pitch_tilt": 0.012, "yaw": 0.005},
    "strongly tilted": {"roll": 0.78, "pitch_tilt": 0.6, "yaw": -0.5},
    "source high": {"height": 4.0},
    "quarter turns": {"start": np.pi / 2},
}


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("voxel", [(0.1, 0.1, 0.1), (0.1, 0.17, 0.06)])
def test_forward_equals_the_sorted_siddon(name, voxel, siddon, circle) -> None:
    data = rng().random((31, 23, 18), dtype=np.float32)
    center = (0.12, -0.07, 0.31)
    geometry = circle(4, 20.0, 40.0, 0.23, **GEOMETRIES[name])
    shape = (27, 33)
    exact = siddon(data, voxel, center, geometry, shape)
    got = forward(Volume(data, voxel, center), geometry, shape)
    error = np.abs(got - exact) / exact.max()
    assert exact.max() > 1
    assert error.max() < WORST
    assert error.mean() < MEAN


def test_forward_of_one_voxel_is_its_chord(circle) -> None:
    # The ray through the centre of a cube along an axis: length of the edge, exactly.
    volume = Volume(np.full((1, 1, 1), 2.0, np.float32), (0.5, 3.0, 0.5))
    image = forward(volume, circle(1, 20, 40, 0.1), (3, 3))
    assert image[0, 1, 1] == pytest.approx(2.0 * 3.0, rel=1e-6)


def test_rays_begin_at_the_source_and_run_through_the_pixel() -> None:
    # Source in the middle of the volume: half the box; the panel there: all of it.
    volume = Volume(np.ones((5, 10, 5), np.float32), 1.0)
    inside = ConeVec.from_vectors(
        (0.1, 0, 0.1), (0.1, 30, 0.1), (0.1, 0, 0), (0, 0, -0.1)
    )
    assert forward(volume, inside, (1, 1))[0, 0, 0] == pytest.approx(5.0, rel=1e-6)
    short = ConeVec.from_vectors(
        (0.1, -30, 0.1), (0.1, 2, 0.1), (0.1, 0, 0), (0, 0, -0.1)
    )
    assert forward(volume, short, (1, 1))[0, 0, 0] == pytest.approx(10.0, rel=1e-6)


def test_z_contiguous_data_give_the_same_image_without_a_copy(circle) -> None:
    data = rng(1).random((12, 9, 7), dtype=np.float32)
    turned = np.ascontiguousarray(data.transpose(1, 2, 0)).transpose(2, 0, 1)
    geometry = circle(3, 20.0, 40.0, 0.1, roll=0.01)
    volume = Volume(turned, 0.1)
    assert np.shares_memory(volume.layout.flat, turned)
    assert np.array_equal(
        forward(volume, geometry, (20, 24)),
        forward(Volume(data, 0.1), geometry, (20, 24)),
    )


def test_empty_margins_are_cropped_and_change_nothing(circle, siddon) -> None:
    data = np.zeros((20, 22, 24), np.float32)
    data[5:9, 3:8, 11:20] = rng(2).random((4, 5, 9), dtype=np.float32)
    data[7, 5, 12:15] = 0
    volume = Volume(data, (0.1, 0.2, 0.15), (1.0, -0.5, 0.2))
    assert volume.layout.counts == (9, 5, 4)
    geometry = circle(5, 20.0, 40.0, 0.3, roll=0.02)
    exact = siddon(data, (0.1, 0.2, 0.15), (1.0, -0.5, 0.2), geometry, (15, 25))
    assert np.abs(forward(volume, geometry, (15, 25)) - exact).max() < WORST * exact.max()


def test_an_empty_volume_gives_zeros(circle) -> None:
    out = np.full((1, 4, 5), 7, np.float32)
    assert not forward(
        Volume(np.zeros((3, 3, 3), np.float32), 1.0), circle(1, 9, 18, 1), (4, 5), out
    ).any()


def test_out_is_filled_and_returned(circle) -> None:
    volume = Volume(np.ones((3, 3, 3), np.float32), 1.0)
    out = np.empty((2, 4, 5), np.float32)
    assert forward(volume, circle(2, 9, 18, 1), (4, 5), out) is out
    for bad in (np.empty((2, 4, 5)), np.empty((1, 4, 5), np.float32), out[:, :, ::-1]):
        with pytest.raises(GeometryError, match="out is"):
            forward(volume, circle(2, 9, 18, 1), (4, 5), bad)


@pytest.mark.parametrize("name", GEOMETRIES)
def test_back_is_the_adjoint_of_forward(name, circle) -> None:
    geometry = circle(3, 20.0, 40.0, 0.23, **GEOMETRIES[name])
    volume = Volume(
        rng(3).random((31, 23, 18), dtype=np.float32), (0.1, 0.17, 0.06), (0.1, 0, 0)
    )
    y = rng(4).random((3, 27, 33), dtype=np.float32)
    ax = forward(volume, geometry, (27, 33)).astype(np.float64)
    aty = back(y, geometry, volume)
    left, right = np.vdot(ax, y), np.vdot(volume.data.astype(np.float64), aty.data)
    assert abs(left - right) < 1e-6 * abs(left)


def test_back_of_one_ray_is_its_path_lengths(siddon, circle) -> None:
    # Column of the system matrix, voxel by voxel, from the reference.
    geometry = circle(1, 20.0, 40.0, 0.2, roll=0.3, pitch_tilt=0.2, start=0.4)
    y = np.zeros((1, 9, 9), np.float32)
    y[0, 3, 6] = 1
    grid = Volume(np.zeros((5, 4, 6), np.float32), 0.3)
    got = back(y, geometry, grid).data
    for index in np.ndindex(grid.shape):
        unit = np.zeros(grid.shape)
        unit[index] = 1
        exact = siddon(unit, (0.3,) * 3, (0, 0, 0), geometry, (9, 9), [(3, 6)])[0, 0]
        assert got[index] == pytest.approx(exact, abs=1e-6)


def test_back_and_forward_refuse_what_does_not_fit(circle) -> None:
    grid = Volume(np.zeros((2, 2, 2), np.float32), 1.0)
    with pytest.raises(GeometryError, match="2 x rows x cols"):
        back(np.zeros((3, 4, 4)), circle(2, 9, 18, 1), grid)
    with pytest.raises(GeometryError, match="a detector of 0 x 4 pixels"):
        forward(grid, circle(2, 9, 18, 1), (0, 4))


SOUND = [0, -9, 0, 0, 9, 0, 0.2, 0, 0, 0, 0, -0.2]
DEGENERATE = {
    "u is zero": ([0, -9, 0, 0, 9, 0, 0, 0, 0, 0, 0, -0.2], "do not span"),
    "v is zero": ([0, -9, 0, 0, 9, 0, 0.2, 0, 0, 0, 0, 0], "do not span"),
    "u is parallel to v": (
        [0, -9, 0, 0, 9, 0, 0.2, 0.1, 0, -0.4, -0.2, 0],
        "do not span",
    ),
    "the source in the plane": (
        [5, 9, 1, 0, 9, 0, 0.2, 0, 0, 0, 0, -0.2],
        "detector's plane",
    ),
    "the source in the middle": (
        [0, 9, 0, 0, 9, 0, 0.2, 0, 0, 0, 0, -0.2],
        "detector's plane",
    ),
    "not a number": ([0, -9, 0, 0, 9, 0, 0.2, np.nan, 0, 0, 0, -0.2], "not finite"),
    "no end": ([0, -9, 0, 0, np.inf, 0, 0.2, 0, 0, 0, 0, -0.2], "not finite"),
    "beyond all numbers": ([0, -9, 0, 0, 9, 0, 1e300, 0, 0, 0, 0, -0.2], "do not span"),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_views_without_rays_are_refused_by_their_row(name) -> None:
    row, words = DEGENERATE[name]
    rows = np.array([SOUND, SOUND, row, row])
    grid = Volume(np.ones((2, 2, 2), np.float32), 1.0)
    scene = Scene((Solid(Box((0, 0, 0), (1, 1, 1)), "abs", 1.0),))
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = TriangleMesh(box.vertices, box.faces)
    for call in (
        lambda: forward(grid, rows, (4, 5)),
        lambda: back(np.zeros((4, 4, 5)), rows, grid),
        lambda: project_scene(scene, rows, (4, 5)),
        lambda: project_materials(scene, rows, (4, 5)),
        lambda: project_mesh(mesh, rows, (4, 5)),
    ):
        with pytest.raises(GeometryError, match=f"row 2.*{words}") as caught:
            call()
        assert caught.value.data["row"] == 2
    assert forward(grid, rows[:2], (4, 5)).any()


def test_rays_of_a_geometry_reach_its_pixels(circle) -> None:
    geometry = circle(3, 9.0, 18.0, 0.3, roll=0.3, pitch_tilt=0.2, start=0.4)
    source, first, u, v = np.split(geometry.rays((4, 5)), 4, axis=1)
    assert np.array_equal(source, geometry.source)
    for (r, c), ends in (
        ((0, 0), source + first),
        ((3, 2), source + first + 2 * u + 3 * v),
    ):
        assert np.allclose(ends, geometry.pixel_centers((4, 5))[:, r, c], atol=1e-12)


def test_volume_refuses_what_is_no_volume() -> None:
    with pytest.raises(GeometryError, match="shape"):
        Volume(np.zeros((2, 2), np.float32), 1.0)
    with pytest.raises(GeometryError, match="voxel_mm"):
        Volume(np.zeros((2, 2, 2), np.float32), (1.0, 0.0, 1.0))
    with pytest.raises(GeometryError, match="center_mm"):
        Volume(np.zeros((2, 2, 2), np.float32), 1.0, (0.0, float("nan"), 0.0))


def test_voxel_centres_are_object_frame_positions() -> None:
    x, y, z = Volume(
        np.zeros((2, 3, 4), np.float32), (1.0, 2.0, 4.0), (10.0, 20.0, 30.0)
    ).centers()
    assert x.tolist() == [8.5, 9.5, 10.5, 11.5]
    assert y.tolist() == [18.0, 20.0, 22.0]
    assert z.tolist() == [28.0, 32.0]
