"""What a phantom may consist of besides analytic solids: a filled triangle mesh, a grid of voxels.

Frozen values in the object's frame [mm] with read-only arrays; the boxes around them and the size
of a phantom that is made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import singledispatch

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Shape,
    Sphere,
    Vector,
)
from flexdt.twin.values import ArrayValue


class PhantomError(TwinError):
    """A phantom that cannot be built: what was asked, what is allowed, where."""


@dataclass(frozen=True, eq=False)
class Surface(ArrayValue):
    """A closed triangle mesh filled with one material.

    Attributes:
        vertices: float64 (v, 3) [mm], object frame, read-only.
        faces: int32 (f, 3) indices, outward by the right-hand rule, read-only.
        material: name.
        mu_per_mm: attenuation inside [1/mm].
    """

    vertices: FloatArray
    faces: npt.NDArray[np.int32]
    material: str
    mu_per_mm: float

    def __post_init__(self) -> None:
        vertices = np.array(self.vertices, dtype=np.float64).reshape(-1, 3)
        faces = np.array(self.faces, dtype=np.int32).reshape(-1, 3)
        if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
            raise PhantomError(f"a face names vertex {faces.max()} of {len(vertices)}")
        freeze(self, vertices=vertices, faces=faces)


@dataclass(frozen=True, eq=False)
class Voxels(ArrayValue):
    """Attenuation on a grid about `center_mm`.

    Attributes:
        data: float32 [z, y, x], attenuation [1/mm], read-only.
        voxel_mm: voxel edges along x, y, z [mm].
        center_mm: of the grid, object frame [mm].
        material: name; None where only the attenuation is known.
    """

    data: npt.NDArray[np.float32]
    voxel_mm: Vector
    center_mm: Vector = (0.0, 0.0, 0.0)
    material: str | None = None

    def __post_init__(self) -> None:
        data = np.array(self.data, dtype=np.float32)
        if data.ndim != 3 or data.size == 0:
            raise PhantomError(
                f"voxels have shape {data.shape}; allowed: (z, y, x), none of them 0",
                {"asked": list(data.shape)},
            )
        if not np.isfinite(data).all():
            raise PhantomError("voxels hold values that are not finite")
        freeze(self, data=data)


def freeze(target: object, **arrays: npt.NDArray[np.generic]) -> None:
    """Make `arrays` read-only and set them as fields of the frozen dataclass `target`."""
    for name, array in arrays.items():
        array.setflags(write=False)
        object.__setattr__(target, name, array)


def size_about_origin(scene: Scene, surfaces: Sequence[Surface] = ()) -> Vector:
    """Full extent along x, y, z [mm] of the box about the origin that holds everything.

    Raises:
        PhantomError: there is nothing.
    """
    corners = [corner for solid in scene.solids for corner in bounds(solid.shape)]
    corners += [end for one in surfaces for end in (one.vertices.min(0), one.vertices.max(0))]
    if not corners:
        raise PhantomError("a phantom needs at least one solid or mesh")
    x, y, z = (2.0 * np.abs(np.array(corners)).max(axis=0)).tolist()
    return (x, y, z)


@singledispatch
def bounds(shape: Shape) -> tuple[FloatArray, FloatArray]:
    """Corners of an axis-aligned box around the shape, (3,) each [mm]."""
    raise PhantomError(f"no extent of a {type(shape).__name__}")


@bounds.register
def _(shape: Sphere) -> tuple[FloatArray, FloatArray]:
    center = np.asarray(shape.center)
    return center - shape.radius, center + shape.radius


@bounds.register
def _(shape: Box) -> tuple[FloatArray, FloatArray]:
    half = np.abs(np.asarray(shape.axes)).T @ (np.asarray(shape.size) / 2.0)
    return np.asarray(shape.center) - half, np.asarray(shape.center) + half


@bounds.register
def _(shape: Ellipsoid) -> tuple[FloatArray, FloatArray]:
    half = np.linalg.norm(np.asarray(shape.axes).T * np.asarray(shape.semi_axes), axis=1)
    return np.asarray(shape.center) - half, np.asarray(shape.center) + half


@bounds.register
def _(shape: Cylinder) -> tuple[FloatArray, FloatArray]:
    axis = np.asarray(shape.axis)
    half = np.abs(axis) * shape.height / 2.0
    half = half + shape.radius * np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    return np.asarray(shape.center) - half, np.asarray(shape.center) + half


@bounds.register
def _(shape: ConvexPolyhedron) -> tuple[FloatArray, FloatArray]:
    corners = polyhedron_vertices(shape)
    return corners.min(axis=0), corners.max(axis=0)


def polyhedron_vertices(shape: ConvexPolyhedron) -> FloatArray:
    """Corners of a bounded intersection of half-spaces, (n, 3) [mm].

    Raises:
        PhantomError: the half-spaces have no common inside, or an unbounded one.
    """
    from scipy.optimize import linprog
    from scipy.spatial import HalfspaceIntersection, QhullError

    normals, offsets = np.asarray(shape.normals), np.asarray(shape.offsets)
    # The centre of the largest inscribed ball is an interior point.
    best = linprog(
        [0.0, 0.0, 0.0, -1.0],
        A_ub=np.column_stack([normals, np.linalg.norm(normals, axis=1)]),
        b_ub=offsets,
        bounds=[(None, None)] * 3 + [(0.0, None)],
    )
    if best.status != 0 or best.x[3] <= 0.0:
        raise PhantomError("a convex polyhedron has no inside or is not bounded")
    try:
        corners = HalfspaceIntersection(
            np.column_stack([normals, -offsets]), best.x[:3]
        ).intersections
    except QhullError as error:
        raise PhantomError(f"a convex polyhedron cannot be built: {error}") from None
    return np.asarray(corners, dtype=np.float64)
