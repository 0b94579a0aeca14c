"""Meshes against analytic solids whose surface they are exactly, and against themselves."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import rotation_about
from flexdt.twin.projection import TriangleMesh, project_mesh, project_scene
from flexdt.twin.projection.analytic_solids import Box, ConvexPolyhedron, Scene, Solid

SHAPE = (90, 100)


def as_mesh(shape) -> TriangleMesh:
    return TriangleMesh(shape.vertices, shape.faces)


def scene(shape) -> Scene:
    return Scene((Solid(shape, "abs", 1.0),))


@pytest.mark.parametrize(
    "tilt", [{}, {"roll": 0.4, "pitch_tilt": 0.3, "yaw": 0.2, "height": 2.0}]
)
def test_a_box_of_triangles_is_the_analytic_box(tilt, circle) -> None:
    turn = rotation_about((1, 2, 3), 0.8)
    box = trimesh.creation.box((1.0, 2.0, 1.5))
    vertices = box.vertices @ turn.T + (0.2, 0.1, -0.3)
    geometry = circle(5, 8.0, 16.0, 0.08, start=0.2, **tilt)
    got = project_mesh(TriangleMesh(vertices, box.faces), geometry, SHAPE)
    axes = tuple(map(tuple, turn.T))
    exact = project_scene(
        scene(Box((0.2, 0.1, -0.3), (1.0, 2.0, 1.5), axes)), geometry, SHAPE
    )
    assert exact.max() > 1
    # Pixels within rounding of the silhouette may fall on either side.
    assert np.abs(got - exact).max() < 1e-6


def test_an_icosphere_is_the_polyhedron_of_its_own_planes(circle) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    planes = ConvexPolyhedron(
        tuple(map(tuple, ball.face_normals)),
        tuple(
            float(n @ t[0])
            for n, t in zip(ball.face_normals, ball.triangles, strict=True)
        ),
    )
    geometry = circle(2, 8.0, 16.0, 0.05, start=0.3)
    got = project_mesh(as_mesh(ball), geometry, SHAPE)
    assert np.abs(got - project_scene(scene(planes), geometry, SHAPE)).max() < 1e-6


def test_rays_through_edges_and_vertices_count_once(circle) -> None:
    # Axis-aligned views of a subdivided cube: whole rows of pixels lie on its edges and
    # vertices.
    box = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide().subdivide()
    geometry = ConeVec.from_vectors(
        (0, -1e6, 0), (0, 1e6, 0), (0.25, 0, 0), (0, 0, -0.25)
    )
    got = project_mesh(as_mesh(box), geometry, (15, 15))
    # Magnification 2: pixels within 2 of the centre, in steps of 1/4, see the cube.
    inside = np.abs(np.arange(15) - 7) * 0.25 < 1.99
    assert np.allclose(got[0][np.ix_(inside, inside)], 2.0, atol=1e-4)


def test_a_body_with_a_cavity_and_two_bodies(circle) -> None:
    outer = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    inner.invert()
    hollow = trimesh.util.concatenate([outer, inner])
    geometry = circle(1, 8.0, 16.0, 0.05)
    inner.invert()
    difference = project_mesh(as_mesh(outer), geometry, SHAPE) - project_mesh(
        as_mesh(inner), geometry, SHAPE
    )
    assert np.allclose(
        project_mesh(as_mesh(hollow), geometry, SHAPE), difference, atol=1e-6
    )


def test_mean_path_is_the_volume_of_a_concave_body() -> None:
    # Nearly parallel rays: sum of path times pixel area is the volume, whatever the shape.
    torus = trimesh.creation.torus(2.0, 0.7, major_sections=64, minor_sections=32)
    distance = 1e7
    towards = np.array([0.3, -1, 0.2])
    u = np.array([1, 0.3, 0]) / np.hypot(1, 0.3) * 0.02
    v = np.cross(towards, u) / np.linalg.norm(towards)
    # The detector is behind the body, 10 mm from its middle.
    geometry = ConeVec.from_vectors(distance * towards, -1e-6 * distance * towards, u, v)
    mesh = as_mesh(torus)
    total = project_mesh(mesh, geometry, (320, 320)).sum() * 0.02**2
    assert total == pytest.approx(mesh.volume_mm3, rel=2e-3)


def test_source_inside_and_detector_inside() -> None:
    box = as_mesh(trimesh.creation.box((2.0, 2.0, 2.0)))
    inside = ConeVec.from_vectors((0.1, 0, 0.1), (0.1, 9, 0.1), (0.1, 0, 0), (0, 0, -0.1))
    assert project_mesh(box, inside, (3, 3))[0, 1, 1] == pytest.approx(1.0, abs=1e-6)
    short = ConeVec.from_vectors(
        (0.1, -9, 0.1), (0.1, 0.5, 0.1), (0.1, 0, 0), (0, 0, -0.1)
    )
    assert project_mesh(box, short, (3, 3))[0, 1, 1] == pytest.approx(2.0, abs=1e-6)
    behind = ConeVec.from_vectors((0.1, 5, 0.1), (0.1, 9, 0.1), (0.1, 0, 0), (0, 0, -0.1))
    assert not project_mesh(box, behind, (3, 3)).any()


def test_meshes_that_do_not_close_are_refused() -> None:
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    with pytest.raises(GeometryError, match="not closed"):
        TriangleMesh(box.vertices, box.faces[1:])
    with pytest.raises(GeometryError, match="not closed"):
        TriangleMesh(box.vertices, np.vstack([box.faces[:1, ::-1], box.faces[1:]]))
    with pytest.raises(GeometryError, match="names vertex"):
        TriangleMesh(box.vertices[:-1], box.faces)
    with pytest.raises(GeometryError, match="shape"):
        TriangleMesh(box.vertices[:, :2], box.faces)


def test_out_is_filled(circle) -> None:
    box = as_mesh(trimesh.creation.box((1.0, 1.0, 1.0)))
    out = np.empty((1, *SHAPE), np.float32)
    geometry = circle(1, 8.0, 16.0, 0.05)
    assert project_mesh(box, geometry, SHAPE, out) is out
    assert np.allclose(out, project_mesh(box, geometry, SHAPE))
