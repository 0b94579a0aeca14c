"""The projector on a CUDA device, used where there is one with room.

Needs the extra `gpu` (numba-cuda). Functions and results (to 1e-4 of the maximum) are those of the
processor. Probing never loads a library that ends the process without a device: the driver is
looked for first, and ASTRA is imported only after that succeeded; then one ray is projected and
spread back, because a driver that answers need not have a compiler that works. A call runs wholly
on the device or wholly on the processor. Where the device fails, now or later, one line of the log
says so and the processor computes: nothing ends for a device's sake.
"""

from __future__ import annotations

import ctypes
import logging
import sys
from collections.abc import Callable
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
VIEWS_A_THREAD = 7 / 16
"""A volume of the host is worth its way to the device and back from so many views on, for each
thread of the processor (measured: about 7 views beside 16 threads)."""
LOGGER = logging.getLogger("flexdt")


class DeviceError(Exception):
    """The device failed at something that is to be begun anew on the processor."""


@dataclass(frozen=True)
class Availability:
    """Whether a device can be used, with its name or the reason why not."""

    present: bool
    reason: str


_failed: list[Availability] = []
"""What the device failed of, once it has."""


def availability() -> Availability:
    """Whether projections can run on a CUDA device; probed once, never raises.

    NUMBA_DISABLE_CUDA=1 in the environment answers no.
    """
    return _failed[0] if _failed else _probed()


@cache
def _probed() -> Availability:
    from numba import config

    if not config.ENABLE_CUDASIM:
        try:
            ctypes.CDLL(DRIVERS.get(sys.platform, "libcuda.so.1"))
        except OSError:
            return Availability(False, "no CUDA driver on this machine")
    try:
        from numba import cuda

        if not cuda.is_available():
            return Availability(False, "numba finds no CUDA device (extra: flexdt[gpu])")
        name: Any = "numba's CUDA simulator"
        if not config.ENABLE_CUDASIM:
            name = cuda.get_current_device().name
    except Exception as error:
        # Drivers fail in many ways; each means: use the processor.
        return Availability(False, f"the CUDA driver does not answer: {error}")
    try:
        _project_one_ray()
    except Exception as error:
        LOGGER.warning("the CUDA device is not used: a first ray failed: %s", error)
        return Availability(False, f"a first ray on the CUDA device failed: {error}")
    return Availability(True, name.decode() if isinstance(name, bytes) else str(name))


def _project_one_ray() -> None:
    """A ray along x through two voxels of 0.5 mm, and back.

    Raises:
        Exception: whatever numba or the driver meets, or a wrong number.
    """
    box = Box(np.array([1, 3], np.float32), None, 0, 1, 2, 2, 1, 1, 0.5, 0.5, 0.5)
    views = np.array([[-1.0, 0.5, 0.5, 4.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])
    image = np.zeros((1, 1, 1), np.float32)
    project(box, upload(box.flat), views, image)
    box.flat.fill(0.0)
    spread(box, views, np.ones((1, 1, 1), np.float32))
    found = [float(image[0, 0, 0]), *box.flat.tolist()]
    if not np.allclose(found, [2.0, 0.5, 0.5], rtol=1e-5):
        raise ArithmeticError(f"found {found} instead of [2.0, 0.5, 0.5]")


def attempt(work: Callable[[], object]) -> bool:
    """Whether the device did some work; where it fails, the caller turns to the processor.

    A device that lacks memory may be asked again; one that fails otherwise is given up for good.
    """
    try:
        work()
    except Exception as error:
        if "OUT_OF_MEMORY" in str(error).upper().replace(" ", "_"):
            LOGGER.warning("the CUDA device lacks memory; the processor computes: %s", error)
        elif not _failed:
            LOGGER.warning("the CUDA device failed; the processor computes from now on: %s", error)
            _failed.append(Availability(False, f"the CUDA device failed: {error}"))
        return False
    return True


def upload(flat: Float32Array) -> Any:
    """Copy voxels to the device, where they stay as long as the result is referenced."""
    from numba import cuda

    return cuda.to_device(flat)


def free_bytes() -> int | None:
    """Memory free on the device, 0 where it fails; None where it does not say (the simulator)."""
    from numba import config, cuda

    if config.ENABLE_CUDASIM:
        return None
    free = [0]

    def ask() -> None:
        free[0] = int(cuda.current_context().get_memory_info().free)

    attempt(ask)
    return free[0]


def has_room(needed: int) -> bool:
    """Whether the device can take `needed` bytes more; True where it does not say."""
    free = free_bytes()
    return free is None or needed + SPARE_BYTES <= free


def usable(voxel_bytes: int, images: Float32Array, threads: int) -> bool:
    """Whether a device has room for these voxels and for the images of one portion, and pays.

    Args:
        voxel_bytes: that would have to be moved there; 0 for voxels that are there.
        images: (n, rows, cols).
        threads: of the processor.
    """
    if not availability().present or (voxel_bytes and len(images) < VIEWS_A_THREAD * threads):
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
