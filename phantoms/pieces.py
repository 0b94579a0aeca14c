"""What a phantom may consist of besides analytic solids: a filled triangle mesh, a grid of voxels.

Frozen values in the object's frame [mm] with read-only arrays.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.analytic_solids import Vector


class PhantomError(TwinError):
    """A phantom that cannot be built: what was asked, what is allowed, where."""


@dataclass(frozen=True, eq=False)
class Surface:
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

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Surface)
            and (self.material, self.mu_per_mm) == (other.material, other.mu_per_mm)
            and np.array_equal(self.vertices, other.vertices)
            and np.array_equal(self.faces, other.faces)
        )

    __hash__ = None  # type: ignore[assignment]


@dataclass(frozen=True, eq=False)
class Voxels:
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

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, Voxels)
            and (self.voxel_mm, self.center_mm, self.material)
            == (other.voxel_mm, other.center_mm, other.material)
            and np.array_equal(self.data, other.data)
        )

    __hash__ = None  # type: ignore[assignment]


def freeze(target: object, **arrays: npt.NDArray[np.generic]) -> None:
    """Make `arrays` read-only and set them as fields of the frozen dataclass `target`."""
    for name, array in arrays.items():
        array.setflags(write=False)
        object.__setattr__(target, name, array)
