"""Single views of a volume that is on a CUDA device, by four calls of the driver each.

numba's copies and launches take longer than the kernel of a small view (H200, one view of C1: 1.6
ms by them, .40 ms so). Page-locked memory, a stream and the kernels' arguments are made once and
kept with the volume's copy on the device. The calls are those of cuda-bindings, which numba-cuda
uses itself; kernels and their arguments are found where numba-cuda 0.30 has them. Where names
differ, or a kernel's first image differs from numba's own, `gpu` projects single views as others.
"""

from __future__ import annotations

import ctypes
import importlib
import logging
import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from flexdt.twin.geometry.cone_vec import MIN_SINE
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import gpu
from flexdt.twin.projection.fan_plan import exchanged
from flexdt.twin.projection.kernels.fan_types import Box
from flexdt.twin.projection.volume import Volume

DRIVER: Final = "cuda.bindings.driver"
"""Module of cuda-bindings with the driver's functions."""
ABSENT: Final = (ImportError, AttributeError, LookupError, TypeError)
"""Errors by which a name or a signature of another version shows."""
ARGUMENTS: Final = (
    "array(float32, 1d, C)", *["int64"] * 6, *["float64"] * 3, "array(float64, 2d, C)",
    *["int64"] * 2, "array(float32, 1d, C)", *["int64"] * 4, "float64",
)  # fmt: skip
"""Types of the arguments for which numba has compiled a forward kernel, as it writes them."""
NUMBERS_A_VIEW: Final = 13
"""Numbers of a view in the kernels' table."""
LOGGER = logging.getLogger("flexdt")
_proved: list[Any] = []
"""Kernels whose first image was numba's own."""


@dataclass(frozen=True, eq=False)
class Launch:
    """A kernel ready to be launched.

    Attributes:
        function: the driver's.
        grid: blocks.
        block: threads a block.
        arguments: addresses of the kernel's arguments.
        held: the arguments, which have to stay in memory.
    """

    function: Any
    grid: tuple[int, int]
    block: tuple[int, int]
    arguments: Any
    held: list[Any]


class SingleViews:
    """Single views of one volume on a device.

    Memory is kept for as many calls as were ever under way at a time.
    """

    def __init__(self, volume: Volume, box: Box) -> None:
        """Take a volume and its box, and copy the voxels to the device unless they are
        there.

        A box too large for the slab walk gets an infinite clearance, so that no view is
        clear of it.
        """
        layout = volume.layout
        half = 0.5 * np.array(volume.shape[::-1]) * volume.voxel_xyz
        sides = (layout.low_mm, layout.voxel_mm, volume.center_mm, half, layout.counts)
        self.frame = np.array([np.asarray(side, float) for side in sides])
        self.box = box
        self.voxels = layout.device_copy.uploaded()
        short = max(layout.counts) < gpu.MAX_SIDE_VOXELS and layout.flat.size < 2**31
        self.clearance = gpu.MIN_CLEARANCE if short else math.inf
        self.usable = True
        self.spare: list[ViewMemory] = []

    def project(self, row: FloatArray, image: Float32Array) -> bool:
        """Fill an image (rows, cols) with line integrals of a view, row (12,) [mm].

        Returns False where `gpu` has to project; without the driver's package `usable`
        becomes False. Raises RuntimeError: the driver failed.
        """
        try:
            memory = self._memory((image.shape[0], image.shape[1]))
            if memory is None:
                return False
            done = memory.project(self, row, image)
        except ABSENT as error:
            LOGGER.debug("single views go through numba: %s", error)
            self.usable = False
            return False
        self.spare.append(memory)
        return done

    def _memory(self, shape: tuple[int, int]) -> ViewMemory | None:
        """Take the memory that was spared last, if it is for images of this shape on the
        current device, or make new; None where the device has no room.

        Memory for other images is dropped.
        """
        device = gpu.current_device()
        spared: list[ViewMemory] = []
        # Another thread may have taken it meanwhile.
        with suppress(IndexError):
            spared.append(self.spare.pop())
        for memory in spared:
            if (memory.shape, memory.device) == (shape, device):
                return memory
        if not gpu.has_room(4 * shape[0] * shape[1]):
            return None
        return ViewMemory(device, shape)


class ViewMemory:
    """Memory of one view at a time, on a device and page-locked.

    Args:
        device: number of the current device.
        shape: (rows, cols) of the image.
    """

    def __init__(self, device: int, shape: tuple[int, int]) -> None:
        """Allocate image and table on the device and, page-locked, on the host, with a
        stream; nothing is launched.

        Args:
            device: number of the device.
            shape: image (rows, cols).

        Raises:
            ImportError: the driver's package is missing.
        """
        from numba import cuda

        self.driver = importlib.import_module(DRIVER)
        self.device = device
        self.shape = shape
        pixels = shape[0] * shape[1]
        self.image = cuda.device_array(pixels, np.float32)
        self.table = cuda.device_array((1, NUMBERS_A_VIEW), np.float64)
        self.host_image = cuda.pinned_array(pixels, np.float32)
        self.host_table = cuda.pinned_array((1, NUMBERS_A_VIEW), np.float64)
        self.own_stream = cuda.stream()
        self.stream = self.driver.CUstream(int(self.own_stream.handle))
        self.table_there = self.driver.CUdeviceptr(_address(self.table))
        self.image_there = self.driver.CUdeviceptr(_address(self.image))
        self.launches: dict[int, Launch] = {}

    def project(self, views: SingleViews, row: FloatArray, image: Float32Array) -> bool:
        """Fill an image; see `SingleViews.project`.

        The first image of each kind of view is compared with that of numba's launch; if
        it differs, `views.usable` becomes False.

        Returns:
            Whether it is filled; False for a view that `prepare` calls UNFIT, a kernel
            that is not compiled yet, and one that gives another image than by numba's
            launch.
        """
        from flexdt.twin.projection.kernels import gpu_kernels, view_kernels

        rise = gpu_kernels.MAX_RISE_VOXELS if gpu_kernels.LANES_MEET else -1.0
        kind = view_kernels.prepare(
            row,
            views.frame,
            *self.shape,
            MIN_SINE,
            views.clearance,
            rise,
            self.host_table,
        )
        if kind == view_kernels.UNFIT:
            return False
        launch = self.launches.get(kind)
        if launch is None:
            launch = self._launch(views, kind)
            if launch is None:
                return False
        self._run(launch)
        if kind not in self.launches:
            if not self._proves(views, kind):
                views.usable = False
                return False
            self.launches[kind] = launch
        view_kernels.copy(self.host_image, image.reshape(-1))
        return True

    def _launch(self, views: SingleViews, kind: int) -> Launch | None:
        """Prepare the launch of a kind of view by the driver, with the addresses of its
        arguments.

        Args:
            views: voxels and box.
            kind: of `prepare`.

        Returns:
            The launch, which keeps its arguments alive; None if numba has not compiled
            the kernel for these arguments.
        """
        from flexdt.twin.projection.kernels import gpu_kernels

        walk, grid, sizes = gpu.launch_sizes(kind, 1, self.shape)
        signed = {
            tuple(map(str, kinds)): made
            for kinds, made in gpu.forward_kernels()[walk].overloads.items()
        }
        if ARGUMENTS not in signed:
            return None
        handle = signed[ARGUMENTS]._codelibrary.get_cufunc().handle
        held: list[Any] = [
            *_array(views.voxels),
            *map(ctypes.c_int64, map(int, views.box[2:8])),
            *map(ctypes.c_double, map(float, views.box[8:])),
            *_array(self.table),
            *map(ctypes.c_int64, (0, 1)),
            *_array(self.image),
            *map(ctypes.c_int64, sizes),
            ctypes.c_double(1.0),
        ]
        addresses = (ctypes.c_void_p * len(held))(
            *[ctypes.addressof(one) for one in held]
        )
        function = self.driver.CUfunction(int(handle))
        return Launch(function, grid, gpu_kernels.BLOCK, addresses, held)

    def _run(self, launch: Launch) -> None:
        """Copy the table to the device, launch, copy the image to page-locked memory, and
        wait.

        Raises:
            RuntimeError: the driver gives an error.
        """
        driver = self.driver
        stream = self.stream
        error = driver.cuMemcpyHtoDAsync(
            self.table_there, self.host_table.ctypes.data, self.host_table.nbytes, stream
        )[0]
        error = (
            error
            or driver.cuLaunchKernel(
                launch.function,
                *launch.grid,
                1,
                *launch.block,
                1,
                0,
                stream,
                ctypes.addressof(launch.arguments),
                0,
            )[0]
        )
        error = (
            error
            or driver.cuMemcpyDtoHAsync(
                self.host_image.ctypes.data,
                self.image_there,
                self.host_image.nbytes,
                stream,
            )[0]
        )
        error = error or driver.cuStreamSynchronize(stream)[0]
        if error:
            raise RuntimeError(f"a single view results in {error}")

    def _proves(self, views: SingleViews, kind: int) -> bool:
        """Compare the image with that of numba's launch, once for each kernel of a
        process; a kernel that was equal before is not compared.

        Args:
            views: voxels and box.
            kind: of `prepare`.

        Returns:
            Whether all bytes are equal; a line of the log says if not.
        """
        kernel = gpu.forward_kernels()[kind % gpu.WALK_KINDS]
        if kernel in _proved:
            return True
        rays = self.host_table[:, : NUMBERS_A_VIEW - 1]
        if kind >= gpu.WALK_KINDS:
            rays = exchanged(rays)
        right = np.empty((1, *self.shape), np.float32)
        gpu.project(views.box, views.voxels, rays, right)
        equal = np.array_equal(right.reshape(-1), self.host_image)
        if equal:
            _proved.append(kernel)
        else:
            LOGGER.warning("single views go through numba: another image without it")
        return equal


def _address(array: Any) -> int:
    """Return where an array is on the device."""
    return int(array.device_ctypes_pointer.value)


def _array(array: Any) -> list[ctypes.c_int64]:
    """List what numba passes to a kernel for a C-ordered array on the device: two
    pointers that are not used, size, bytes a number, address, shape and strides.
    """
    item = int(array.dtype.itemsize)
    after = [math.prod(array.shape[i + 1 :]) for i in range(array.ndim)]
    numbers = [0, 0, array.size, item, _address(array)]
    return [
        ctypes.c_int64(n) for n in (*numbers, *array.shape, *(item * k for k in after))
    ]


def project(volume: Volume, box: Box, row: FloatArray, image: Float32Array) -> bool:
    """Fill an image (rows, cols) with line integrals of a volume on the device.

    `row`: (12,) of cone_vec [mm]. Returns False where `gpu` has to project the view, or
    it failed.
    """
    copy = volume.layout.device_copy
    if copy.single_views is None:
        copy.single_views = SingleViews(volume, box)
    views = copy.single_views
    done = [False]

    def fill() -> None:
        done[0] = views.project(row, image)

    return views.usable and gpu.attempt(fill) and done[0]
