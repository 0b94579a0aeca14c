"""Boxes around solids and meshes, and the size of a phantom that is made of them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch

import numpy as np

from flexdt.phantoms.pieces import PhantomError, Surface
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
    from flexdt.phantoms.surface import polyhedron_vertices

    corners = polyhedron_vertices(shape)
    return corners.min(axis=0), corners.max(axis=0)
