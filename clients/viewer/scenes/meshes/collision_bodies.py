"""Collision bodies of the machine as meshes, bare and grown by the safety margin (mm)."""

from __future__ import annotations

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes.meshes.painted_meshes import cylinder
from flexdt.clients.viewer.scenes.meshes.paints import STEEL
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.geometry.conventions import FloatArray

FINENESS = 2
"""Subdivisions of the ball that a body is grown by: an icosphere, with points along
the axes too."""


def bare(solid: ConvexSolid) -> trimesh.Trimesh:
    """Build the mesh of an upright cylinder (48 sides) or polytope [mm].

    Another solid fails an assertion.
    """
    if isinstance(solid, UprightCylinder):
        size = 2.0 * solid.radius, solid.height
        return cylinder(*size, solid.center, STEEL).mesh
    assert isinstance(solid, Polytope)
    return _hull(solid.vertices)


def grown(body: trimesh.Trimesh, margin_mm: float) -> trimesh.Trimesh:
    """Build the convex body of all points within `margin_mm` of a convex body [mm]: the
    hull of the body's vertices, each with the corners of an icosphere of that radius,
    slightly within the exact one.
    """
    ball = trimesh.creation.icosphere(subdivisions=FINENESS, radius=margin_mm).vertices
    corners = np.asarray(body.vertices)[:, None, :] + np.asarray(ball)[None, :, :]
    return _hull(corners.reshape(-1, 3))


def _hull(points: FloatArray) -> trimesh.Trimesh:
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    return hull
