"""Analytic chords against closed forms, a brute-force sampling, and the voxel projector."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import rotation_about
from flexdt.twin.projection import Volume, forward, project_materials, project_scene
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Solid,
    Sphere,
)

SHAPE = (40, 50)


def one(shape, mu=1.0, material="water"):
    return Scene((Solid(shape, material, mu),))


def turned(angle=0.7):
    return tuple(map(tuple, rotation_about((1, 2, -1), angle)))


def norm2(p):
    return np.sum(p**2, axis=-1)


TURN = np.array(turned()).T
OCTAHEDRON = ConvexPolyhedron(
    tuple(
        tuple(np.array([i, j, k]) / np.sqrt(3))
        for i in (-1, 1)
        for j in (-1, 1)
        for k in (-1, 1)
    ),
    (1.0,) * 8,
)

INSIDE = {
    "sphere": (
        Sphere((0.3, 0.2, -0.1), 1.1),
        lambda p: norm2(p - [0.3, 0.2, -0.1]) < 1.21,
    ),
    "box": (
        Box((0.3, 0.2, -0.1), (1.0, 2.0, 1.5), turned()),
        lambda p: (
            np.abs((p - [0.3, 0.2, -0.1]) @ np.array(turned()).T) < [0.5, 1.0, 0.75]
        ).all(-1),
    ),
    "cylinder": (
        Cylinder((0.1, 0.0, 0.2), 0.7, 1.8, turned()[1]),
        lambda p: (
            (np.abs((p - [0.1, 0, 0.2]) @ TURN[:, 1]) < 0.9)
            & (norm2((p - [0.1, 0, 0.2]) @ TURN[:, [0, 2]]) < 0.49)
        ),
    ),
    "ellipsoid": (
        Ellipsoid((0.1, 0.0, 0.2), (0.5, 1.2, 0.9), turned()),
        lambda p: (
            np.sum(
                ((p - [0.1, 0, 0.2]) @ np.array(turned()).T / [0.5, 1.2, 0.9]) ** 2, -1
            )
            < 1
        ),
    ),
    "polyhedron": (
        OCTAHEDRON,
        lambda p: np.abs(p).sum(-1) < np.sqrt(3),
    ),
}


@pytest.mark.parametrize("name", INSIDE)
@pytest.mark.parametrize(
    "tilt", [{}, {"roll": 0.5, "pitch_tilt": 0.3, "yaw": 0.2, "height": 1.0}]
)
def test_chords_agree_with_points_counted_inside(name, tilt, circle) -> None:
    shape, inside = INSIDE[name]
    geometry = circle(3, 8.0, 16.0, 0.2, start=0.3, **tilt)
    got = project_scene(one(shape), geometry, SHAPE)
    steps = 4000
    t = (np.arange(steps) + 0.5) / steps * 0.4 + 0.3
    for view, (source, ends) in enumerate(
        zip(geometry.source, geometry.pixel_centers(SHAPE), strict=True)
    ):
        ray = ends - source
        length = np.linalg.norm(ray, axis=-1)
        for r in range(0, SHAPE[0], 3):
            points = source + t[:, None, None] * ray[r]
            counted = inside(points).sum(0) * 0.4 / steps * length[r]
            # Two ends, each within half a step.
            assert (
                np.abs(counted - got[view, r]).max()
                < 1.01 * 0.4 / steps * length[r].max()
            )
    assert (got > 0).any(axis=(1, 2)).all()


def test_sphere_chord_is_the_closed_form_to_float_accuracy(circle) -> None:
    # A 1 mm ball 600 mm from the source: 2 sqrt(R^2 - d^2) with d from the cross product.
    geometry = circle(2, 600.0, 1059.0, 0.01, start=0.2)
    got = project_scene(one(Sphere((0.2, 0.1, 0.3), 1.0), 0.3), geometry, (300, 310))
    for view, (source, ends) in enumerate(
        zip(geometry.source, geometry.pixel_centers((300, 310)), strict=True)
    ):
        ray = ends - source
        away = np.cross(ray, np.array([0.2, 0.1, 0.3]) - source)
        d2 = np.sum(away**2, -1) / np.sum(ray**2, -1)
        exact = 0.3 * 2 * np.sqrt(np.maximum(1 - d2, 0))
        assert np.abs(got[view] - exact).max() < 1e-6 * exact.max()


@pytest.mark.parametrize("name", INSIDE)
def test_culling_loses_no_pixel(name, circle, monkeypatch) -> None:
    import flexdt.twin.projection.analytic as module

    shape, _ = INSIDE[name]
    geometry = circle(7, 5.0, 16.0, 0.3, start=0.1, roll=0.3, pitch_tilt=-0.4)
    culled = project_scene(one(shape), geometry, SHAPE)
    everything = (
        np.broadcast_to([0, SHAPE[0], 0, SHAPE[1]], (7, 1, 4)).astype(np.int64).copy()
    )
    monkeypatch.setattr(module, "shadows", lambda *_: everything)
    assert np.array_equal(culled, project_scene(one(shape), geometry, SHAPE))


def test_culling_of_many_solids_at_once_loses_no_pixel_of_any(circle) -> None:
    """Shadows are found for all solids of a scene together, those with corners and the
    round ones apart: each must keep the place of its own."""
    shapes = (
        Box((-0.8, -0.6, 0.7), (0.4, 0.3, 0.5)),
        Sphere((0.9, 0.2, -0.8), 0.2),
        Cylinder((0.1, 0.8, 0.1), 0.2, 0.6),
        Ellipsoid((-0.9, 0.5, -0.5), (0.1, 0.3, 0.2)),
        Box((0.7, -0.8, 0.2), (0.2, 0.4, 0.3)),
    )
    solids = [one(shape).solids[0] for shape in shapes]
    geometry = circle(7, 5.0, 16.0, 0.3, start=0.1, roll=0.3, pitch_tilt=-0.4)
    alone = [project_scene(Scene((solid,)), geometry, SHAPE) for solid in solids]
    together = project_scene(Scene(tuple(solids)), geometry, SHAPE)
    assert np.abs(together - np.sum(alone, axis=0)).max() < 1e-6 * together.max()


def test_a_shape_of_lists_and_arrays_is_projected_as_one_of_tuples(circle) -> None:
    geometry = circle(3, 8.0, 16.0, 0.2)
    center = np.array([0.1, 0.0, 0.2])
    listed = project_scene(one(Box(center, [1.0, 0.8, 1.2])), geometry, SHAPE)  # type: ignore[arg-type]
    tupled = one(Box((0.1, 0.0, 0.2), (1.0, 0.8, 1.2)))
    assert np.array_equal(listed, project_scene(tupled, geometry, SHAPE))
    center += 0.5
    moved = project_scene(one(Box(center, [1.0, 0.8, 1.2])), geometry, SHAPE)  # type: ignore[arg-type]
    assert not np.array_equal(listed, moved)


@pytest.mark.parametrize("name", INSIDE)
def test_a_solid_around_or_behind_the_source_is_handled(name) -> None:
    shape, inside = INSIDE[name]
    # Source inside the solid; then the whole solid behind the source.
    within = ConeVec.from_vectors((0.1, 0.1, 0), (0.1, 9, 0), (0.3, 0, 0), (0, 0, -0.3))
    image = project_scene(one(shape), within, (21, 21))
    assert (image > 0).all()
    t = (np.arange(20000) + 0.5) / 20000
    path = np.array([0.1, 0.1, 0.0]) + t[:, None] * np.array([0, 8.9, 0])
    assert image[0, 10, 10] == pytest.approx(inside(path).mean() * 8.9, abs=1e-3)
    behind = ConeVec.from_vectors((0, 5, 0), (0, 9, 0), (0.3, 0, 0), (0, 0, -0.3))
    assert not project_scene(one(shape), behind, (21, 21)).any()


def test_a_box_of_voxels_equals_the_analytic_box(circle) -> None:
    geometry = circle(4, 20.0, 40.0, 0.1, start=0.25, roll=0.01)
    voxels = forward(Volume(np.full((12, 8, 10), 0.7, np.float32), 0.1), geometry, SHAPE)
    exact = project_scene(one(Box((0, 0, 0), (1.0, 0.8, 1.2)), 0.7), geometry, SHAPE)
    assert np.abs(voxels - exact).max() < 3e-6 * exact.max()


def test_materials_add_up_to_the_line_integral(circle) -> None:
    bead = Sphere((0.2, 0.1, 0.0), 0.3)
    scene = Scene(
        (
            Solid(Box((0, 0, 0), (2, 2, 2)), "abs", 0.02),
            Solid(bead, "abs", -0.02),
            Solid(bead, "steel", 0.9),
        )
    )
    geometry = circle(2, 20.0, 40.0, 0.1)
    paths = project_materials(scene, geometry, SHAPE)
    assert list(paths) == ["abs", "steel"]
    total = 0.02 * paths["abs"] + 0.9 * paths["steel"]
    assert np.allclose(total, project_scene(scene, geometry, SHAPE), atol=1e-6)
    assert paths["steel"].max() == pytest.approx(0.6, abs=0.02)


def test_scene_without_solids_is_zero_and_out_is_used(circle) -> None:
    out = np.full((1, *SHAPE), 3, np.float32)
    assert project_scene(Scene(()), circle(1, 9, 18, 1), SHAPE, out) is out
    assert not out.any()


@pytest.mark.parametrize(
    "shape",
    [
        Sphere((0, 0, 0), 0.0),
        Box((0, 0, 0), (1, -1, 1)),
        Box((0, 0, 0), (1, 1, 1), ((1, 0, 0), (1, 0, 0), (0, 0, 1))),
        Cylinder((0, 0, 0), 1, 1, (0, 0, 2)),
        ConvexPolyhedron(((1, 0, 0), (0, 1, 0), (0, 0, 1), (-1, 0, 0)), (1, 1, 1, 1)),
        ConvexPolyhedron(((1, 0, 0),), (1,)),
    ],
)
def test_shapes_that_are_none_are_refused(shape, circle) -> None:
    with pytest.raises(GeometryError):
        project_scene(one(shape), circle(1, 9, 18, 1), SHAPE)
