"""Images and voxels on a CUDA device with numpy's arithmetic, for methods written in it.

`+`, `-`, `*` and `numpy.maximum`, in place, too, run where the numbers are; nothing is moved
but the numbers that `dot`, `sum` and `max` return.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import gpu
from flexdt.twin.projection.operators import layout_data
from flexdt.twin.projection.volume import DeviceVolume, Volume, blank_layout

UFUNCS = {
    np.add: "ADD",
    np.subtract: "SUBTRACT",
    np.multiply: "MULTIPLY",
    np.maximum: "MAXIMUM",
}
"""numpy function -> name in the kernel, for the functions that are supported."""


@dataclass(frozen=True, eq=False)
class DeviceArray(NDArrayOperatorsMixin):
    """Numbers of single precision on the device.

    Every method raises `gpu.DeviceError` where the device fails.

    Attributes:
        flat: numba's one-dimensional array.
        shape: (n, rows, cols) of images, (nz, ny, nx) of voxels.
        grid: of voxels, by which each is found in `flat`; its layout's content is not
            used.
    """

    flat: Any
    shape: tuple[int, int, int]
    grid: DeviceVolume | None = None

    @classmethod
    def of_images(cls, images: Any) -> DeviceArray:
        """Make an array of images (n, rows, cols), copied from the host, shared on the
        device.

        Raises DeviceError.
        """
        if gpu.is_there(images):
            there = images
        else:
            there = gpu.demand(lambda: gpu.upload(images))
        return cls(there.reshape(images.size), images.shape)

    @classmethod
    def of_volume(cls, volume: DeviceVolume) -> DeviceArray:
        """Share the voxels of a device volume that has memory for all of its grid."""
        return cls(volume.layout.flat, volume.shape, volume)

    @classmethod
    def of_voxels(cls, volume: Volume) -> DeviceArray:
        """Copy a volume's voxels, on its full grid, to the device.

        Raises:
            DeviceError: the device failed.
        """
        layout = blank_layout(volume)
        layout_data(layout)[...] = volume.data
        layout = replace(layout, flat=gpu.demand(lambda: gpu.upload(layout.flat)))
        return cls.of_volume(
            DeviceVolume(layout, volume.shape, volume.voxel_mm, volume.center_mm)
        )

    @property
    def images(self) -> Any:
        """The images as numba's array of that shape; the memory is shared."""
        return self.flat.reshape(self.shape)

    @property
    def volume(self) -> DeviceVolume:
        """The voxels as a volume; the memory is shared."""
        assert self.grid is not None
        return replace(self.grid, layout=replace(self.grid.layout, flat=self.flat))

    def __getitem__(self, views: slice | npt.NDArray[np.intp]) -> DeviceArray:
        """Copy the images of some views, by their indices, into a new array on the
        device; return this array itself for any slice.

        Only slices over all views are used.

        Raises:
            DeviceError: the device failed.
        """
        if isinstance(views, slice):
            return self

        def gather() -> DeviceArray:
            """Copy the chosen views, in their order, into a new array on the device."""
            from numba import cuda

            there = self.images
            each = self.size // max(1, self.shape[0])
            some = cuda.device_array(len(views) * each, np.float32)
            for k, view in enumerate(views):
                some[k * each : (k + 1) * each].copy_to_device(
                    there[int(view)].reshape(each)
                )
            return DeviceArray(some, (len(views), *self.shape[1:]))

        images: DeviceArray = gpu.demand(gather)
        return images

    @property
    def size(self) -> int:
        """Number of elements."""
        return int(np.prod(self.shape))

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: Any, out: Any = None, **options: Any
    ) -> Any:
        """Apply a function of UFUNCS to device arrays, or to one and a number, on the
        device; see `_combine`.

        The result goes into `out` if given, else into a new array. Returns NotImplemented
        for any other function, method, option or operand, and for a number minus an
        array.
        """
        a, b = inputs if len(inputs) == 2 else (self, None)
        if not isinstance(a, DeviceArray) and ufunc is not np.subtract:
            a, b = b, a  # the other three are the same either way round
        if (
            ufunc not in UFUNCS
            or method != "__call__"
            or options
            or not isinstance(a, DeviceArray)
            or not isinstance(b, DeviceArray | float | int | np.number)
        ):
            return NotImplemented
        other = b if isinstance(b, DeviceArray) else float(b)
        return _combine(UFUNCS[ufunc], a, other, None if out is None else out[0])

    def over(self, other: DeviceArray, least: float) -> DeviceArray:
        """Compute self / other; 0 where other <= `least`."""
        return _combine("RATIO", self, other, least=least)

    def copy(self, order: str = "K") -> DeviceArray:
        """Copy the numbers to new memory."""
        return _combine("ADD", self, 0.0)

    def dot(self, other: DeviceArray) -> float:
        """Sum of the products."""
        return float(_fold("DOT", self, other).sum())

    def sum(self) -> float:
        """Sum all numbers."""
        return float(_fold("SUM", self, self).sum())

    def max(self) -> float:
        """Return the largest number."""
        return float(_fold("LARGEST", self, self).max())


def _combine(
    name: str,
    a: DeviceArray,
    b: DeviceArray | float,
    out: DeviceArray | None = None,
    least: float = 0.0,
) -> DeviceArray:
    """Apply a function of the kernel elementwise to `a` and an array or a number `b`.

    Args:
        name: name of the function in the kernel.
        a, b: operands; b is an array or a number.
        out: array for the result, `a` for example; None for new memory.
        least: smallest denominator of a ratio; see `DeviceArray.over`.

    Returns:
        `out`, or a new array with the shape and grid of `a`.

    Raises:
        GeometryError: arrays of different shapes.
        DeviceError: the device failed.
    """
    if isinstance(b, DeviceArray) and b.shape != a.shape:
        raise GeometryError.of_shape(
            "an array on the device", b.shape, a.shape, ", the other's"
        )

    def launch() -> DeviceArray:
        """Launch the kernel into `out`, or into a new device array like `a` if it is
        None, and return it.
        """
        from numba import cuda

        from flexdt.twin.projection.kernels import gpu_kernels as kernels

        made = out
        if made is None:
            made = replace(a, flat=cuda.device_array(a.flat.size, np.float32))
        if isinstance(b, DeviceArray):
            second = (b.flat, np.float32(least), False)
        else:
            second = (a.flat, np.float32(b), True)
        blocks = -(-a.flat.size // gpu.LINEAR)
        kernels.combine[blocks, gpu.LINEAR](
            getattr(kernels, name), a.flat, *second, made.flat
        )
        return made

    combined: DeviceArray = gpu.demand(launch)
    return combined


def _fold(name: str, a: DeviceArray, b: DeviceArray) -> FloatArray:
    """Reduce one or two arrays on the device to partial results.

    Args:
        name: of the kernel's kind: DOT, SUM or LARGEST.
        a: first array.
        b: second array, of the same size; only DOT reads it.

    Returns:
        The parts on the host, in double precision, in an order that is always the same.
    """

    def launch() -> FloatArray:
        """Launch the kernel that folds `a` and `b`, and copy its partial results
        (float64) to the host.
        """
        from numba import cuda

        from flexdt.twin.projection.kernels import gpu_kernels as kernels

        parts = cuda.device_array(kernels.FOLDING[0] * kernels.FOLDING[1], np.float64)
        kernels.fold[kernels.FOLDING](getattr(kernels, name), a.flat, b.flat, parts)
        return np.asarray(parts.copy_to_host())

    folded: FloatArray = gpu.demand(launch)
    return folded
