"""Where a phantom stands: as its file has it, or with the middle of its box on the axis."""

from __future__ import annotations

from dataclasses import replace
from typing import Final, Literal, assert_never, get_args

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import Surface
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import (
    Box,
    ConvexPolyhedron,
    Cylinder,
    Ellipsoid,
    Scene,
    Shape,
    Solid,
    Sphere,
    Vector,
)

Place = Literal["keep", "centred"]
"""Whether a sample stays where it is, or the middle of its box comes to the axis at the
reference height, the origin of the object's frame."""
UNMOVED_MM: Final = 1e-9
"""A move by less is none."""


def placed(
    phantom: Phantom, place: Place, at_mm: npt.ArrayLike = (0.0, 0.0, 0.0)
) -> Phantom:
    """Put a phantom at a place; its description says by how much that moved it.

    Args:
        phantom: as it is.
        place: "keep" counts from where it is, "centred" from the middle of its box.
        at_mm: where that origin or middle goes, x, y, z of the object's frame [mm].

    Returns:
        The phantom there; itself where nothing moves. Its size is then that of the box
        about the object's origin that holds it.

    Raises:
        PhantomError: another place.
    """
    if place not in get_args(Place):
        raise PhantomError.instead(f"place {place!r}", place, list(get_args(Place)))
    to = np.asarray(at_mm, dtype=np.float64)
    match place:
        case "keep":
            by = to
        case "centred":
            corners = phantom.boxes if len(phantom.boxes) else np.zeros((1, 2, 3))
            by = to - (corners[:, 0].min(axis=0) + corners[:, 1].max(axis=0)) / 2.0
        case _:
            assert_never(place)
    if np.abs(by).max() < UNMOVED_MM:
        return phantom
    return _moved(phantom, by)


def _moved(phantom: Phantom, by: FloatArray) -> Phantom:
    """Move all that a phantom is made of by a vector (3,) [mm]."""
    scene = Scene(
        tuple(
            Solid(_moved_shape(one.shape, by), one.material, one.mu_per_mm)
            for one in phantom.scene.solids
        )
    )
    surfaces = tuple(
        Surface(one.vertices + by, one.faces, one.material, one.mu_per_mm)
        for one in phantom.surfaces
    )
    voxels = phantom.voxels
    if voxels is not None:
        voxels = replace(voxels, center_mm=_vector(np.array(voxels.center_mm) + by))
    words = ", ".join(f"{along:.6g}" for along in by)
    made = replace(
        phantom,
        description=f"{phantom.description}, moved by ({words}) mm",
        scene=scene,
        surfaces=surfaces,
        voxels=voxels,
        beads=phantom.beads + by,
    )
    return replace(made, size_mm=_vector(2.0 * np.abs(made.boxes).max(axis=(0, 1))))


def _moved_shape(shape: Shape, by: FloatArray) -> Shape:
    match shape:
        case Sphere() | Box() | Cylinder() | Ellipsoid():
            return replace(shape, center=_vector(np.array(shape.center) + by))
        case ConvexPolyhedron(normals, offsets):
            further = np.array(offsets) + np.array(normals).reshape(-1, 3) @ by
            return ConvexPolyhedron(normals, tuple(further.tolist()))
        case _:
            assert_never(shape)


def _vector(values: FloatArray) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
