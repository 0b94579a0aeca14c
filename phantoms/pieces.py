"""Parts of a phantom besides analytic solids: a filled triangle mesh, a grid of voxels.

Frozen values in the object's frame [mm] with read-only arrays; the boxes around them and
the size of a phantom that is made of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import (
    PACK,
    Lengths,
    Number,
    PhantomError,
    Place,
    Text,
    packed,
)
from flexdt.twin.errors import shape_words
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import analytic_solids as analytic
from flexdt.twin.projection.analytic_solids import as_convex
from flexdt.twin.values import ArrayValue

if TYPE_CHECKING:
    pass


@dataclass(frozen=True, eq=False)
class Surface(ArrayValue):
    """A closed triangle mesh filled with one material.

    Attributes:
        vertices: float64 (v, 3) [mm], object frame, read-only.
        faces: int32 (f, 3) indices, outward by the right-hand rule, read-only.
        material: name.
        mu_per_mm: attenuation inside [1/mm].
    """

    vertices: Annotated[FloatArray, packed("<f8"), PACK]
    faces: Annotated[npt.NDArray[np.int32], packed("<i4"), PACK]
    material: Text
    mu_per_mm: Number

    def __post_init__(self) -> None:
        """Copy vertices (n, 3) and faces (m, 3) read-only; raise PhantomError for an unknown
        vertex.
        """
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
        material: name; None where only the attenuation is known, or there are several.
        labels: uint8 [z, y, x], read-only: which of `materials` fills each voxel, counted
            from 1, 0 for nothing; None unless there are several.
        materials: their names.
    """

    data: Annotated[npt.NDArray[np.float32], packed("<f4"), PACK]
    voxel_mm: Lengths
    center_mm: Place = (0.0, 0.0, 0.0)
    material: Text | None = None
    labels: Annotated[npt.NDArray[np.uint8], packed("|u1"), PACK] | None = None
    materials: tuple[Text, ...] = ()

    def __post_init__(self) -> None:
        """Copy the values (z, y, x) as read-only float32, and the labels, if given, as uint8.

        Raises:
            PhantomError: they are not 3-D, empty or not finite, or if labels have another
                shape or a number without a material.
        """
        data = np.array(self.data, dtype=np.float32)
        if data.ndim != 3 or data.size == 0:
            message = f"voxels have shape {shape_words(data.shape)}"
            shape = list(data.shape)
            raise PhantomError.instead(message, shape, "(z, y, x), none of them 0")
        if not np.isfinite(data).all():
            raise PhantomError("voxels hold values that are not finite")
        freeze(self, data=data)
        if self.labels is not None:
            labels = np.array(self.labels, dtype=np.uint8)
            if labels.shape != data.shape or int(labels.max()) > len(self.materials):
                raise PhantomError(
                    f"labels have shape {shape_words(labels.shape)} and end at {labels.max()}; "
                    "allowed: shape "
                    f"{shape_words(data.shape)}, 0 to {len(self.materials)}"
                )
            freeze(self, labels=labels)


def freeze(target: object, **arrays: npt.NDArray[np.generic]) -> None:
    """Make `arrays` read-only and set them as fields of the frozen dataclass `target`."""
    for name, array in arrays.items():
        array.setflags(write=False)
        object.__setattr__(target, name, array)


def boxes(
    scene: analytic.Scene, surfaces: Sequence[Surface] = (), voxels: Voxels | None = None
) -> list[tuple[FloatArray, FloatArray]]:
    """List the low and high corner, (3,) each [mm], of the box around each part: solids,
    surfaces, then the voxels (whole grid, empty ones included). [] without parts.
    """
    corners = [bounds(solid.shape) for solid in scene.solids]
    corners += [(one.vertices.min(axis=0), one.vertices.max(axis=0)) for one in surfaces]
    if voxels is not None:
        half = np.array(voxels.voxel_mm) * voxels.data.shape[::-1] / 2.0
        corners.append(
            (np.array(voxels.center_mm) - half, np.array(voxels.center_mm) + half)
        )
    return corners


def size_about_origin(
    scene: analytic.Scene, surfaces: Sequence[Surface] = ()
) -> analytic.Vector:
    """Compute the full extent along x, y, z [mm] of the box about the origin that contains
    everything.

    Voxels are not looked at.
    Raises PhantomError: there is nothing."""
    corners = boxes(scene, surfaces)
    if not corners:
        raise PhantomError("a phantom needs at least one solid or mesh")
    x, y, z = (2.0 * np.abs(np.array(corners)).max(axis=(0, 1))).tolist()
    return (x, y, z)


def bounds(shape: analytic.Shape) -> tuple[FloatArray, FloatArray]:
    """Compute the corners of the smallest axis-aligned box around the shape, (3,) each [mm].

    Exact for cylinders and ellipsoids, too.

    Args:
        shape: any shape of a solid.

    Raises:
        GeometryError: a shape that cannot be, such as an unbounded polyhedron.
    """
    one = as_convex(shape)
    if isinstance(
        shape, analytic.Cylinder
    ):  # the corners that `as_convex` gives are those of a prism
        axis = np.asarray(shape.axis)
        half = np.abs(axis) * shape.height / 2.0
        half = half + shape.radius * np.sqrt(np.maximum(1.0 - axis**2, 0.0))
    elif one.semi_axes is not None:
        half = np.linalg.norm(one.semi_axes, axis=0)
    else:
        assert one.corners is not None
        return one.corners.min(axis=0), one.corners.max(axis=0)
    return one.center - half, one.center + half
