"""Programs in numba's simulator of a CUDA device: it is chosen when numba is imported."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any


def run_simulated(program: str, *arguments: str) -> None:
    """Run a program, which has to end without an error, in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


def two_devices() -> list[int]:
    """In the simulator: two devices, of which neither may touch an array of the other's.

    Returns the device of each kernel launched from now on.
    """
    import numpy as np
    from numba import cuda
    from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
    from numba.cuda.simulator.kernel import FakeCUDAKernel

    inside, launches = [0], []
    owners: dict[int, tuple[Any, int]] = {}  # by the array whose memory it is, which is kept

    class Device:
        def __init__(self, number: int) -> None:
            self.number = number

        def __enter__(self) -> None:
            inside.append(self.number)

        def __exit__(self, *_: object) -> None:
            inside.pop()

    def of(array: Any) -> tuple[Any, int]:
        root = array._ary
        while isinstance(root.base, np.ndarray):
            root = root.base
        return owners.setdefault(id(root), (root, inside[-1]))

    begin, fetch, call = FakeCUDAArray.__init__, FakeCUDAArray.copy_to_host, FakeCUDAKernel.__call__

    def begun(self: Any, *arguments: Any, **options: Any) -> None:
        begin(self, *arguments, **options)
        of(self)

    def fetched(self: Any, *arguments: Any, **options: Any) -> Any:
        assert of(self)[1] == inside[-1]
        return fetch(self, *arguments, **options)

    def called(self: Any, *arguments: Any) -> Any:
        if not self._device:  # a kernel, not a function that one calls
            launches.append(inside[-1])
            arrays = [a for a in arguments if isinstance(a, FakeCUDAArray)]
            assert {of(a)[1] for a in arrays} == {inside[-1]}
        return call(self, *arguments)

    FakeCUDAArray.__init__, FakeCUDAArray.copy_to_host = begun, fetched
    FakeCUDAKernel.__call__ = called
    cuda.gpus.lst = (Device(0), Device(1))
    return launches
