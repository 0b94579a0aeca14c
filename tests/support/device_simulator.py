"""Programs in numba's simulator of a CUDA device: it is chosen when numba is imported."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from typing import Any


def run_simulated(program: str, *arguments: str) -> None:
    """Run a program in a process of its own, with numba's simulator of devices.

    Args:
        program: Python, as a text.
        arguments: of the program.

    Raises:
        AssertionError: it ends with an error; the message is what it wrote of it.
        subprocess.TimeoutExpired: it takes longer than 300 s.
    """
    done = subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr


def two_devices() -> list[int]:
    """In the simulator: make two devices, of which neither may touch an array of the
    other's.

    An array belongs to the device that was entered (`with cuda.gpus[i]`) when its memory
    was first seen, the first device outside of any. Numba's simulator stays patched for
    the process.

    Returns:
        The list to which every kernel launch from now on adds the number of its device.
    """
    import numpy as np
    from numba import cuda
    from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray
    from numba.cuda.simulator.kernel import FakeCUDAKernel

    inside, launches = [0], []
    owners: dict[
        int, tuple[Any, int]
    ] = {}  # by the array whose memory it is, which is kept

    class Device:
        def __init__(self, number: int) -> None:
            self.number = number

        def __enter__(self) -> None:
            inside.append(self.number)

        def __exit__(self, *_: object) -> None:
            inside.pop()

    def of(array: Any) -> tuple[Any, int]:
        """Return the memory of an array and the number of its device; an unknown one gets
        the present.
        """
        root = array._ary
        while isinstance(root.base, np.ndarray):
            root = root.base
        return owners.setdefault(id(root), (root, inside[-1]))

    begin, fetch, call = (
        FakeCUDAArray.__init__,
        FakeCUDAArray.copy_to_host,
        FakeCUDAKernel.__call__,
    )

    def begun(self: Any, *arguments: Any, **options: Any) -> None:
        """Make an array as the simulator does, and note its device."""
        begin(self, *arguments, **options)
        of(self)

    def fetched(self: Any, *arguments: Any, **options: Any) -> Any:
        """Copy to the host; AssertionError if the array is not of the device entered."""
        assert of(self)[1] == inside[-1]
        return fetch(self, *arguments, **options)

    def called(self: Any, *arguments: Any) -> Any:
        """Note a launch and run it; AssertionError if an argument is not of the device
        entered.
        """
        if not self._device:  # a kernel, not a function that one calls
            launches.append(inside[-1])
            arrays = [a for a in arguments if isinstance(a, FakeCUDAArray)]
            assert {of(a)[1] for a in arrays} == {inside[-1]}
        return call(self, *arguments)

    FakeCUDAArray.__init__, FakeCUDAArray.copy_to_host = begun, fetched
    FakeCUDAKernel.__call__ = called
    cuda.gpus.lst = (Device(0), Device(1))
    return launches


def as_on_a_device(block: tuple[int, int] = (32, 4)) -> None:
    """In the simulator: run kernels as a device does, and refuse what a device only
    breaks at.

    Warps are 32 lanes that exchange values, which all of them have to reach; the threads
    of a block wait for each other there and at `syncthreads`. Every index of an array has
    to be inside it. Threads run one at a time, each until it waits: a run is the same
    every time. Numba's simulator and `gpu_kernels` stay patched for the process.

    Args:
        block: threads a block of the projector's kernels; rows have to fill warps.
    """
    from numba.cuda.simulator import kernel, kernelapi
    from numba.cuda.simulator.cudadrv.devicearray import FakeCUDAArray

    from flexdt.twin.projection.kernels import gpu_kernels

    def local(self: Any, shape: Any, kind: Any) -> CheckedArray:
        return CheckedArray(FakeCUDAArray(allocate_local(self, shape, kind)))

    def shared(self: Any, shape: Any, kind: Any) -> CheckedArray:
        """Return the one array of a block for the line that asks; the first thread there
        makes it.
        """
        caller = sys._getframe(1)
        place = caller.f_code, caller.f_lineno
        if place not in self._allocations:
            self._allocations[place] = CheckedArray(
                FakeCUDAArray(allocate_local(self, shape, kind))
            )
        return self._allocations[place]

    def called(self: Any, *arguments: Any) -> Any:
        """Call a device function directly; launch a kernel as the simulator does."""
        # The globals of a device function are those of the kernel that calls it.
        return self.fn(*arguments) if self._device else call(self, *arguments)

    call, allocate_local = kernel.FakeCUDAKernel.__call__, kernelapi.FakeCUDALocal.array
    kernel.FakeCUDAKernel.__call__ = called
    kernel.FakeWithinKernelCUDAArray = CheckedArray
    kernel.BlockManager = Block
    kernelapi.FakeCUDALocal.array = local
    kernelapi.FakeCUDAShared.array = shared
    gpu_kernels.exchange = exchange
    gpu_kernels.LANES_MEET = True
    gpu_kernels.BLOCK = block


WARP = 32


def exchange(value: int, step: int) -> int:
    """What a kernel's `exchange` returns: the value of the lane that differs in the bit
    `step`.

    It waits until all threads of the block have come so far, ended, or wait elsewhere.

    Raises:
        RuntimeError: lanes of the warp left the kernel, or went another way, before.
    """
    thread: Any = threading.current_thread()
    warp, lane = divmod(thread.thread_id, WARP)
    thread.exchanges += 1
    given = thread.block.given.setdefault((warp, thread.exchanges), {})
    given[lane] = (value, step)
    thread.syncthreads()
    if set(given) != set(range(WARP)) or {step for _, step in given.values()} != {step}:
        raise RuntimeError(f"lanes {sorted(given)} exchange, of {WARP}, in one call")
    return int(given[lane ^ step][0])


class CheckedArray:
    """An array in a kernel; an index outside raises IndexError, a negative one, too."""

    def __init__(self, item: Any) -> None:
        """Take over the memory of a simulator's array; nothing is copied."""
        self._ary = item._ary
        self.dtype, self.shape, self.size = (
            self._ary.dtype,
            self._ary.shape,
            self._ary.size,
        )

    def _inside(self, index: Any) -> Any:
        """Return an index as it is.

        Raises:
            IndexError: it has too few or too many parts, or one is negative or beyond its
                length.
        """
        places = index if isinstance(index, tuple) else (index,)
        if len(places) != len(self.shape):
            raise IndexError(f"{len(places)} indices of an array of shape {self.shape}")
        for place, count in zip(places, self.shape, strict=True):
            if not 0 <= place < count:
                raise IndexError(f"index {index} of an array of shape {self.shape}")
        return index

    def __getitem__(self, index: Any) -> Any:
        return self._ary[self._inside(index)]

    def __setitem__(self, index: Any, value: Any) -> None:
        self._ary[self._inside(index)] = value

    def __len__(self) -> int:
        return len(self._ary)


class Lane(threading.Thread):
    """A thread of a kernel, which runs when it is let, until it waits or ends."""

    def __init__(
        self, block: Block, block_index: Any, thread_index: Any, number: int
    ) -> None:
        """Make a thread that does not run before `turn` is released.

        Args:
            block: whose kernel it runs.
            block_index, thread_index: what the kernel reads as `blockIdx` and
                `threadIdx`.
            number: in the block, x fastest.
        """
        super().__init__(daemon=True)
        self.block, self.blockIdx, self.threadIdx = block, block_index, thread_index
        self.thread_id, self.exchanges = number, 0
        self.ended, self.abort, self.error = False, False, None
        self.turn = threading.Lock()
        self.turn.acquire()

    def run(self) -> None:
        """Run the kernel once it is this thread's turn; not at all if the block aborts.

        What it raises is left in `error`, with the thread's place noted, and `waiting` is
        released.
        """
        self.turn.acquire()
        try:
            if not self.abort:
                self.block.work()
        except Exception as error:
            error.add_note(f"thread {self.threadIdx} of block {self.blockIdx}")
            self.error = error
        self.ended = True
        self.block.waiting.release()

    def syncthreads(self) -> None:
        """Wait until all threads of the block that have not ended are here."""
        self.block.waiting.release()
        self.turn.acquire()
        if self.abort:
            raise RuntimeError("the block was given up")


class Block:
    """Numba's BlockManager, with threads that take turns."""

    def __init__(self, kernel: Any, grid: Any, block: Any, debug: Any) -> None:
        """Keep a kernel and the size of its blocks; the grid and the debug flag do not
        matter here.
        """
        self._kernel, self._block = kernel, block
        self.given: dict[tuple[int, int], dict[int, tuple[int, int]]] = {}
        self.waiting = threading.Lock()
        self.waiting.acquire()

    def run(self, place: Any, *arguments: Any) -> None:
        """Run all threads of one block to their ends, in turns.

        After the first error the threads that have not begun do not run, and those that
        wait are told to abort.

        Args:
            place: the block's index in the grid.
            arguments: of the kernel.

        Raises:
            Exception: what the first thread to fail met.
        """
        import numpy as np
        from numba.cuda.simulator.kernelapi import Dim3

        self.work = lambda: self._kernel(*arguments)
        # Numbered as on a device, x fastest.
        indices = [index[::-1] for index in np.ndindex(*self._block[::-1])]
        lanes = [Lane(self, Dim3(*place), Dim3(*at), i) for i, at in enumerate(indices)]
        for lane in lanes:
            lane.start()
        live, error = lanes, None
        while live:
            for lane in live:
                lane.abort = error is not None
                lane.turn.release()
                self.waiting.acquire()
                error = error or lane.error
            live = [lane for lane in live if not lane.ended]
        if error is not None:
            raise error
