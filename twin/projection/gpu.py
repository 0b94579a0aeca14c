"""The projector on a CUDA device, used where there is one with room.

Needs the extra `gpu` (numba-cuda). Functions and results (to 1e-4 of the maximum) are those of the
processor. Probing never loads a library that ends the process without a device: the driver is
looked for first, and ASTRA is imported only after that succeeded. A call runs wholly on the device
or wholly on the processor.
"""

from __future__ import annotations

import ctypes
import sys
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.kernels.fan_types import Box

DRIVERS = {"win32": "nvcuda.dll"}
"""Name of the CUDA driver's library by platform, where it is not libcuda.so.1."""
CHUNK_BYTES = 256 * 2**20
"""Images on the device at a time."""
SPARE_BYTES = 256 * 2**20
"""What must stay free on a device: for the driver, and for whoever else uses it."""


@dataclass(frozen=True)
class Availability:
    """Whether a device can be used, with its name or the reason why not."""

    present: bool
    reason: str


@cache
def availability() -> Availability:
    """Whether projections can run on a CUDA device; probed once, never raises.

    NUMBA_DISABLE_CUDA=1 in the environment answers no.
    """
    from numba import config

    if config.ENABLE_CUDASIM:
        return Availability(True, "numba's CUDA simulator")
    try:
        ctypes.CDLL(DRIVERS.get(sys.platform, "libcuda.so.1"))
    except OSError:
        return Availability(False, "no CUDA driver on this machine")
    try:
        from numba import cuda

        if not cuda.is_available():
            return Availability(False, "numba finds no CUDA device (extra: flexdt[gpu])")
        name = cuda.get_current_device().name
    except Exception as error:
        # Drivers fail in many ways; each means: use the processor.
        return Availability(False, f"the CUDA driver does not answer: {error}")
    return Availability(True, name.decode() if isinstance(name, bytes) else str(name))


def upload(flat: Float32Array) -> Any:
    """Copy voxels to the device, where they stay as long as the result is referenced."""
    from numba import cuda

    return cuda.to_device(flat)


def free_bytes() -> int | None:
    """Memory free on the device; None where it does not say (the simulator)."""
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return None
    return int(cuda.current_context().get_memory_info().free)


def has_room(needed: int) -> bool:
    """Whether the device can take `needed` bytes more; True where it does not say."""
    free = free_bytes()
    return free is None or needed + SPARE_BYTES <= free


def usable(voxel_bytes: int, images: Float32Array) -> bool:
    """Whether a device has room for these voxels and for the images of one portion."""
    if not availability().present:
        return False
    portion = images[_chunks(images)[0]].nbytes if len(images) else 0
    return has_room(voxel_bytes + portion)


def project(box: Box, voxels: Any, views: FloatArray, out: Float32Array) -> None:
    """Fill out (n, rows, cols) with line integrals.

    Args:
        box: the volume; its flat array is not touched.
        voxels: the same array as `upload` returned it.
        views: (n, 12) source, first pixel minus source, u, v in voxel units.
        out: C-ordered float32.
    """
    from numba import cuda

    for part in _chunks(out):
        images = cuda.device_array(out[part].shape, np.float32)
        _launch(box, voxels, views[part], images, transposed=False)
        images.copy_to_host(out[part])


def spread(box: Box, views: FloatArray, values: Float32Array) -> None:
    """The transpose of `project`: adds values (n, rows, cols) to box.flat."""
    from numba import cuda

    voxels = cuda.to_device(box.flat)
    for part in _chunks(values):
        _launch(box, voxels, views[part], cuda.to_device(values[part]), transposed=True)
    voxels.copy_to_host(box.flat)


def _launch(box: Box, voxels: Any, views: FloatArray, images: Any, *, transposed: bool) -> None:
    from numba import cuda

    from flexdt.twin.projection.kernels.gpu_kernels import BLOCK, rays

    n, rows, cols = images.shape
    grid = (-(-rows // BLOCK[0]), -(-cols // BLOCK[1]), n)
    rays[grid, (*BLOCK, 1)](
        voxels,
        box.base,
        cuda.to_device(np.array([box.hop_x, box.hop_y], np.int64)),
        cuda.to_device(np.array([box.nx, box.ny, box.nz], np.int64)),
        cuda.to_device(np.ascontiguousarray(views)),
        cuda.to_device(np.array([box.size_x, box.size_y, box.size_z])),
        images,
        transposed,
    )


def _chunks(images: Float32Array) -> list[slice]:
    """Views in portions that fit the device; grids hold at most 65535 of them."""
    each = max(1, images[:1].nbytes)
    count = int(min(max(1, CHUNK_BYTES // each), 65535))
    return [slice(i, i + count) for i in range(0, len(images), count)]
