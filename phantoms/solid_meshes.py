"""Closed triangle meshes of a phantom's pieces, for the scene and for collisions.

Each analytic solid becomes one closed convex mesh in the frame of the X-ray side. A hole
(negative attenuation in a body) is turned inside out in the joined mesh, so that signed
volumes add up; there are no boolean operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, assert_never, cast

import numpy as np

from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.pieces import Surface, Voxels
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import analytic_solids as analytic
from flexdt.twin.projection.analytic_solids import polyhedron_corners

if TYPE_CHECKING:
    import trimesh

SPHERE_SUBDIVISIONS = 3
"""Number of times that an icosahedron's triangles are quartered."""
CYLINDER_SECTIONS = 48
"""Number of sides of the prism of a cylinder."""


@dataclass(frozen=True, eq=False)
class SurfacePart:
    """One closed mesh of a phantom.

    Attributes:
        mesh: outward triangles [mm, object frame], also for a hole.
        material: name.
        hole: whether it removes material instead of adding it.
    """

    mesh: trimesh.Trimesh
    material: str
    hole: bool


def parts_of(
    scene: analytic.Scene,
    surfaces: Sequence[Surface],
    voxels: Voxels | None,
    beads: FloatArray,
    *,
    around: bool = False,
) -> tuple[SurfacePart, ...]:
    """Make one closed mesh of each piece of a phantom; voxels become the box around them.

    In that order; meshes of surfaces are not changed, and the box has the material
    "voxels".

    Args:
        scene: analytic solids.
        surfaces: triangle meshes.
        voxels: ready grid, or None.
        beads: (k, 3) bead centers [mm]: spheres there are never holes.
        around: round solids are inside their meshes, not the other way round.

    Returns:
        Each with its material, and whether it is a hole.
    """
    import trimesh

    out = [
        SurfacePart(solid_mesh(s, around), s.material, hole=_is_hole(s, beads))
        for s in scene.solids
    ]
    for surface in surfaces:
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        out.append(SurfacePart(mesh, surface.material, hole=False))
    if voxels is not None:
        box = trimesh.creation.box(
            extents=np.array(voxels.data.shape[::-1]) * np.asarray(voxels.voxel_mm)
        )
        box.apply_translation(voxels.center_mm)
        out.append(SurfacePart(box, "voxels", hole=False))
    return tuple(out)


def joined(parts: Sequence[SurfacePart]) -> trimesh.Trimesh:
    """Join copies of all parts into one mesh, holes turned inside out.

    Parts that overlap are not united.

    `parts`: meshes [mm] with their marks for holes.
    Raises PhantomError: there is nothing to join.
    """
    import trimesh

    if not parts:
        raise PhantomError("a phantom without any solid has no mesh")
    meshes = [part.mesh.copy() for part in parts]
    for part, mesh in zip(parts, meshes, strict=True):
        if part.hole:
            mesh.invert()
    return cast("trimesh.Trimesh", trimesh.util.concatenate(meshes))


def _is_hole(solid: analytic.Solid, beads: FloatArray) -> bool:
    """Return whether a solid is a hole: negative, and not a bead that absorbs less
    than its body.

    A bead is a ball whose center is exactly among `beads`.
    """
    if solid.mu_per_mm >= 0.0:
        return False
    if isinstance(solid.shape, analytic.Sphere) and len(beads):
        return not bool((beads == np.asarray(solid.shape.center)).all(axis=1).any())
    return True


def solid_mesh(solid: analytic.Solid, around: bool = False) -> trimesh.Trimesh:
    """Make the closed outward mesh of one solid [mm].

    Boxes and polyhedra are exact in both cases.

    Args:
        solid: the solid.
        around: the mesh of a round shape encloses it instead of being inscribed.

    Returns:
        A new mesh; round shapes have many flat faces.
    """
    mesh = _mesh(solid.shape)
    if around and isinstance(solid.shape, analytic.Sphere | analytic.Ellipsoid):
        mesh.vertices = (
            solid.shape.center + (mesh.vertices - solid.shape.center) * _ball_around()
        )
    elif around and isinstance(solid.shape, analytic.Cylinder):
        axis = np.asarray(solid.shape.axis)
        out = mesh.vertices - solid.shape.center
        along = np.outer(out @ axis, axis)
        across = (out - along) / np.cos(np.pi / CYLINDER_SECTIONS)
        mesh.vertices = solid.shape.center + along + across
    return mesh


@lru_cache
def _unit_ball() -> trimesh.Trimesh:
    """Make the polyhedron inscribed in a ball of radius 1; cached, as it takes milliseconds."""
    import trimesh

    ball: trimesh.Trimesh = trimesh.creation.icosphere(SPHERE_SUBDIVISIONS, radius=1.0)
    return ball


@lru_cache
def _ball_around() -> float:
    """Compute the scale at which the inscribed polyhedron of a ball contains the ball."""
    ball = _unit_ball()
    corners = ball.vertices[ball.faces[:, 0]]
    return 1.0 / float(np.einsum("ij,ij->i", ball.face_normals, corners).min())


def _mesh(shape: analytic.Shape) -> trimesh.Trimesh:
    """Make the mesh of a shape [mm]; round shapes are inscribed.

    Boxes and polyhedra are exact.

    Args:
        shape: of a solid.
    """
    import trimesh

    mesh: trimesh.Trimesh
    match shape:
        case analytic.Sphere(center, radius):
            ball = _unit_ball()
            mesh = trimesh.Trimesh(
                ball.vertices * radius + center, ball.faces, process=False
            )
        case analytic.Ellipsoid(center, semi_axes, axes):
            mesh = _unit_ball().copy()
            mesh.apply_transform(_placed(np.asarray(axes).T * semi_axes, center))
        case analytic.Box(center, size, axes):
            mesh = trimesh.creation.box(size, _placed(np.asarray(axes).T, center))
        case analytic.Cylinder(center, radius, height, axis):
            half = np.asarray(axis) * height / 2.0
            ends = np.stack([center - half, center + half])
            mesh = trimesh.creation.cylinder(
                radius, sections=CYLINDER_SECTIONS, segment=ends
            )
        case analytic.ConvexPolyhedron():
            mesh = trimesh.convex.convex_hull(polyhedron_corners(shape))
        case _:
            assert_never(shape)
    return mesh


def _placed(linear: FloatArray, center: tuple[float, float, float]) -> FloatArray:
    """Make the (4, 4) matrix of a linear map (3, 3) followed by a shift to `center` [mm]."""
    transform = np.eye(4)
    transform[:3, :3] = linear
    transform[:3, 3] = center
    return transform
