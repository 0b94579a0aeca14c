"""FDK's backprojection on a CUDA device if it has room, else on the processor.

Both take views in parts and hand out the volume at the end; the volume stays where it is computed
until then. They give the same numbers (to 1e-5 of the maximum). Views come weighted and filtered.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.cpu import threads

MOST_COLUMNS = 65_535
"""Voxel columns along y that a device's grid can hold."""


class Backprojector(Protocol):
    """Adds filtered views to a volume."""

    def add(self, columns: Float32Array, table: FloatArray) -> None:
        """Add views: columns (n, cols, rows), table (n, 11) of `fdk.view_table`."""

    def volume(self) -> Float32Array:
        """What has been added up, (ny, nx, nz)."""


def device_takes(like: Volume) -> bool:
    """Whether there is a device that has room for the grid of `like`."""
    nz, ny, nx = like.shape
    return gpu.availability().present and ny <= MOST_COLUMNS and gpu.has_room(4 * nz * ny * nx)


class OnProcessor:
    """On the processor, all threads."""

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._first, self._size = _grid(like)
        self._data = np.zeros((ny, nx, nz), np.float32)

    def add(self, columns: Float32Array, table: FloatArray) -> None:
        """See `Backprojector`."""
        from flexdt.twin.reconstruction import fdk_kernels

        fdk_kernels.backproject(columns, table, *self._first, *self._size, self._data, threads())

    def volume(self) -> Float32Array:
        """See `Backprojector`."""
        return self._data


class OnDevice:
    """On a CUDA device.

    Raises:
        gpu.DeviceError: from each method; the device failed, and what was added is lost.
    """

    def __init__(self, like: Volume) -> None:
        nz, ny, nx = like.shape
        self._data: Any = None

        def prepare() -> None:
            from numba import cuda

            first, size = _grid(like)
            self._first, self._size = (
                cuda.to_device(np.array(first)),
                cuda.to_device(np.array(size)),
            )
            self._data = cuda.to_device(np.zeros((ny, nx, nz), np.float32))

        _try(prepare)

    def add(self, columns: Float32Array, table: FloatArray) -> None:
        """See `Backprojector`."""

        def launch() -> None:
            from numba import cuda

            from flexdt.twin.reconstruction.gpu_fdk_kernels import BLOCK, RUN, backproject

            ny, nx, nz = self._data.shape
            grid = (-(-nz // (BLOCK[0] * RUN)), -(-nx // BLOCK[1]), ny)
            backproject[grid, (*BLOCK, 1)](
                cuda.to_device(columns),
                cuda.to_device(np.ascontiguousarray(table)),
                self._first,
                self._size,
                self._data,
            )

        _try(launch)

    def volume(self) -> Float32Array:
        """See `Backprojector`."""
        out = np.empty(self._data.shape, np.float32)
        _try(lambda: self._data.copy_to_host(out))
        return out


def _try(work: Callable[[], object]) -> None:
    if not gpu.attempt(work):
        raise gpu.DeviceError


def _grid(like: Volume) -> tuple[list[float], list[float]]:
    """Centre of the first voxel and steps (x, y, z) [mm]."""
    nz, ny, nx = like.shape
    steps = list(like.voxel_xyz)
    counts = (nx, ny, nz)
    first = [c - (n - 1) / 2 * d for c, n, d in zip(like.center_mm, counts, steps, strict=True)]
    return first, steps
