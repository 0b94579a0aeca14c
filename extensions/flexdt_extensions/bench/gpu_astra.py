"""ASTRA Toolbox as an independent second projector, for cross-checks on a machine with a GPU.

ASTRA interpolates (Joseph) where flexdt takes exact lengths, so the two agree to its interpolation
error only. Creating ASTRA's 3D objects without a GPU ends the process, so `gpu.availability` is
asked first.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flexdt.measuring import gpu
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Volume


def geometries(
    volume: Volume, cone_vec: ConeVec, shape: tuple[int, int]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """(volume geometry, projection geometry) as ASTRA's dictionaries. Safe without a GPU.

    ASTRA's z, y, x order is flexdt's; its volumes are centred where flexdt's are, in mm.
    """
    nz, ny, nx = volume.shape
    low = [c - s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    high = [c + s / 2 for c, s in zip(volume.center_mm, volume.size_mm, strict=True)]
    space = {
        "GridRowCount": ny,
        "GridColCount": nx,
        "GridSliceCount": nz,
        "option": {
            f"Window{name}{axis}": end[i]
            for i, axis in enumerate("XYZ")
            for name, end in (("Min", low), ("Max", high))
        },
    }
    return space, cone_vec.with_shape(shape).to_astra()


class Resident:
    """A volume and its views on the device, for repeated runs of ASTRA's FP3D_CUDA or BP3D_CUDA.

    Voxels are uploaded once and stay, as `forward` keeps them; images come back with every call.

    Raises:
        GeometryError: no GPU; asking ASTRA would end the process.
    """

    def __init__(
        self,
        volume: Volume,
        cone_vec: ConeVec,
        shape: tuple[int, int],
        algorithm: str = "FP3D_CUDA",
    ) -> None:
        found = gpu.availability()
        if not found.present:
            raise GeometryError(f"ASTRA's 3D projector needs a GPU: {found.reason}")
        import astra
        from numba import cuda

        self._astra = astra
        space, panel = geometries(volume, cone_vec, shape)
        self._voxels = cuda.to_device(np.ascontiguousarray(volume.data))
        # ASTRA keeps (rows, n, cols).
        self._views = cuda.device_array((shape[0], len(cone_vec), shape[1]), np.float32)
        self._volume = astra.data3d.link("-vol", space, _link(astra, self._voxels))
        self._images = astra.data3d.link("-sino", panel, _link(astra, self._views))
        options = astra.astra_dict(algorithm)
        into = "VolumeDataId" if algorithm == "FP3D_CUDA" else "ReconstructionDataId"
        options[into], options["ProjectionDataId"] = self._volume, self._images
        self._algorithm = astra.algorithm.create(options)

    def compute(self) -> None:
        """Run the algorithm; nothing leaves the device."""
        self._astra.algorithm.run(self._algorithm)

    def run(self) -> Float32Array:
        """Project; float32 (rows, n, cols)."""
        self.compute()
        return np.asarray(self._views.copy_to_host(), dtype=np.float32)

    def close(self) -> None:
        """Give the device's memory back."""
        self._astra.algorithm.delete(self._algorithm)
        self._astra.data3d.delete([self._volume, self._images])


def _link(astra: Any, array: Any) -> Any:
    """A contiguous array (z, y, x) on the device as ASTRA takes it."""
    z, y, x = array.shape
    pointer = array.device_ctypes_pointer.value
    return astra.pythonutils.GPULink(pointer, x, y, z, array.dtype.itemsize * x)
