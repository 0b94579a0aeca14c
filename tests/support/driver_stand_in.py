"""The driver's functions that `single_view` calls, in numba's simulator of a CUDA device.

Arguments of kernels are read from the addresses given, as a device's driver reads them: arrays
as numba passes them, seven numbers and more of 8 bytes each.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np

ARRAYS = {
    "array(float32, 1d, C)": (np.float32, 1),
    "array(float64, 2d, C)": (np.float64, 2),
}
"""Type of an argument, as numba writes it -> type of its numbers, and its dimensions."""
SCALARS = {"int64": ctypes.c_int64, "float64": ctypes.c_double}
UNUSED_NUMBERS = 2
"""Numbers before the size of an array."""


class Driver(ModuleType):
    """Stands for `cuda.bindings.driver`.

    Attributes:
        calls: names of the functions called.
        fails: gives the error of a call by its name, 0 for none.
        spoils: changes an image that is copied to the host, in place.
    """

    CUstream = CUdeviceptr = CUfunction = int

    def __init__(self) -> None:
        """Begin with no calls, no kernels and nothing that fails."""
        super().__init__("cuda.bindings.driver")
        self.calls: list[str] = []
        self.fails: Callable[[str], Any] = lambda name: 0
        self.spoils: Callable[[Any], None] = lambda image: None
        self.kernels: list[tuple[Any, tuple[str, ...]]] = []

    def _called(self, name: str) -> Any:
        self.calls.append(name)
        return self.fails(name)

    def cuMemcpyHtoDAsync(  # noqa: N802
        self, there: int, host: int, size: int, stream: int
    ) -> tuple[Any]:
        """Copy bytes to the device."""
        ctypes.memmove(there, host, size)
        return (self._called("to the device"),)

    def cuMemcpyDtoHAsync(  # noqa: N802
        self, host: int, there: int, size: int, stream: int
    ) -> tuple[Any]:
        """Copy bytes of single precision to the host."""
        ctypes.memmove(host, there, size)
        self.spoils(_numbers(host, (size // 4,), np.float32))
        return (self._called("to the host"),)

    def cuStreamSynchronize(self, stream: int) -> tuple[Any]:  # noqa: N802
        """Wait for nothing."""
        return (self._called("wait"),)

    def cuLaunchKernel(self, function: int, *given: int) -> tuple[Any]:  # noqa: N802
        """Run a kernel with the arguments at the addresses of a list.

        Args:
            function: the kernel's number in `kernels`.
            given: grid and block (three numbers each), shared bytes, the stream, the
                address of the list of addresses, and the extra options; a third
                dimension, shared memory and options are refused with AssertionError.

        Returns:
            The error code, alone in a tuple as the driver returns it.
        """
        grid, block, (shared, _, addresses, extra) = given[:3], given[3:6], given[6:]
        assert (grid[2], block[2], shared, extra) == (1, 1, 0, 0), given
        kernel, kinds = self.kernels[function]
        count = sum(
            UNUSED_NUMBERS + 3 + 2 * ARRAYS[kind][1] if kind in ARRAYS else 1
            for kind in kinds
        )
        places = iter((ctypes.c_void_p * count).from_address(addresses))
        kernel[grid[:2], block[:2]](*[_argument(kind, places) for kind in kinds])
        return (self._called("launch"),)


def _argument(kind: str, places: Any) -> Any:
    """Read an argument of a kernel from the next of the addresses.

    Args:
        kind: numba's name of its type; a scalar is at one address, an array at seven or
            more.
        places: the addresses, which go on.

    Returns:
        The number, or an array over the same memory.
    """
    if kind in SCALARS:
        return SCALARS[kind].from_address(next(places)).value
    number, dimensions = ARRAYS[kind]
    for _ in range(UNUSED_NUMBERS):
        next(places)
    read = [
        ctypes.c_int64.from_address(next(places)).value for _ in range(3 + 2 * dimensions)
    ]
    size, item, address = read[:3]
    shape, strides = tuple(read[3 : 3 + dimensions]), tuple(read[3 + dimensions :])
    array = _numbers(address, shape, number)
    assert (array.size, array.itemsize, array.strides) == (size, item, strides), read
    return array


def _numbers(address: int, shape: tuple[int, ...], number: Any) -> Any:
    """Numbers at an address, shared."""
    size = int(np.prod(shape)) * np.dtype(number).itemsize
    return np.frombuffer((ctypes.c_char * size).from_address(address), number).reshape(
        shape
    )


def stand_in() -> Driver:
    """In the simulator: let `single_view` find a driver, and the kernels that it
    launches.

    Numba's simulator and `sys.modules` stay patched for the process; the cached probe of
    devices is cleared.

    Returns:
        The driver that is found.
    """
    from numba import cuda
    from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
    from numba.cuda.simulator.kernel import FakeCUDAKernel

    from flexdt.twin.projection import gpu, single_view

    driver = Driver()
    sys.modules[single_view.DRIVER] = driver
    FakeCUDAArray.device_ctypes_pointer = property(
        lambda self: ctypes.c_void_p(self._ary.ctypes.data)
    )
    real_stream = cuda.stream

    def stream() -> Any:
        made = real_stream()
        return SimpleNamespace(handle=len(driver.calls), real=made)

    def overloads(kernel: Any) -> dict[Any, Any]:
        """What numba has compiled of a kernel: nothing before its first launch.

        Each look gives the kernel another number with the driver.
        """
        if kernel.grid_dim is None:
            return {}
        driver.kernels.append((kernel, single_view.ARGUMENTS))
        handle = len(driver.kernels) - 1
        library = SimpleNamespace(get_cufunc=lambda: SimpleNamespace(handle=handle))
        return {single_view.ARGUMENTS: SimpleNamespace(_codelibrary=library)}

    cuda.stream = stream
    FakeCUDAKernel.overloads = property(overloads)
    gpu._probe.cache_clear()
    return driver
