"""The one thread that computes, and the work of a request, which it does block by block.

Numba's kernels use all cores by themselves and release the interpreter, so one thread is
enough and the event loop stays responsive. A job's blocks go to the loop as they are
made.

Steps are computed in the order in which they come, and a lane has one of them in the
queue at a time, so lanes take turns and a long scan never starves a single view. A lane
is one client's batch work or one client's interactive work. A block is requested when the
one before it has been sent, and at most `MAX_IN_HAND` requests of a lane have results on
their way: of a client that does not read no more than these is computed.

`begin` sets the number of threads. Kernels compile when a request needs them for the first time
on a machine; meanwhile `compiling` names them.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Final

import numba
import numpy as np
import numpy.typing as npt

from flexdt.twin import long_work
from flexdt.twin.long_work import Progress, Report
from flexdt.twin.projection import Body, gpu, project_body
from flexdt.twin.projection.kernels.compiling import LOG
from flexdt.twin.projection.pixel_areas import (
    Need,
    Within,
    packed,
    paths_within,
    rays_needed,
)

BLOCK_BYTES: Final = 12 * 2**20
"""Result of one turn of a job [bytes]: below a frame, and short enough to share the machine."""
BLOCK_VIEWS: Final = 32
"""Largest number of views of one turn."""

MAX_IN_HAND: Final = 3
"""Largest number of requests of a lane that are computed or sent."""

Step = Callable[[], object]
"""A piece of work; its value goes to the waiting request."""


class Lane(asyncio.Lock):
    """One client's batch work, or its interactive work; held by the step that
    is in the queue."""

    def __init__(self) -> None:
        """Make a free lane, with `MAX_IN_HAND` places for jobs in hand."""
        super().__init__()
        self.in_hand = asyncio.Semaphore(MAX_IN_HAND)


@dataclass(eq=False)
class ComputeJob:
    """The steps of one request, one after the other.

    Attributes:
        lane: whose steps these are.
        key: interactive requests have one (a newer one takes this one's place).
        error: why it was given up.
    """

    lane: Lane
    key: str | None = None
    error: Exception | None = None
    _turn: asyncio.Task[object] | None = None
    _step: Future[object] | None = None
    _in_hand: bool = False

    @property
    def waits(self) -> bool:
        """Whether a step waits for its turn; False while one is being computed, and without
        a step."""
        running = self._step is not None and self._step.running()
        return self._turn is not None and not (running or self._turn.done())

    def end(self, error: Exception) -> None:
        """Cancel the job: a waiting request gets `error`, and further steps raise it."""
        self.error = self.error or error
        if self._turn is not None:
            self._turn.cancel()

    async def run(self, compute: ComputeThread, step: Step) -> object:
        """Compute a step in its turn on the compute thread and return its value.

        A job that has been given up raises its error at once, and one that is given up meanwhile
        as soon as that happens.

        `compute`: the thread; `step`: function without arguments.
        Raises Exception: the step's, or the one that the job was given up with.
        """
        if self.error is not None:
            raise self.error
        self._turn = asyncio.create_task(self._in_turn(compute, step))
        try:
            return await self._turn
        except asyncio.CancelledError:
            if self.error is None:
                raise
            raise self.error from None

    async def _in_turn(self, compute: ComputeThread, step: Step) -> object:
        """Wait for the lane, put the step into the thread's queue, and return its value.

        At its first step the job also waits until fewer than `MAX_IN_HAND` jobs of the
        lane are in hand; it stays in hand afterwards.
        """
        if not self._in_hand:
            self._in_hand = await self.lane.in_hand.acquire()
        async with self.lane:
            self._step = compute.put(step)
            return await asyncio.wrap_future(self._step)

    def sent(self) -> None:
        """Release the lane: the answer was sent, or its request abandoned."""
        if self._in_hand:
            self._in_hand = False
            self.lane.in_hand.release()


class ComputeThread:
    """Computes steps in a thread of its own.

    Args:
        begin: called first in that thread (thread count, compilation).
    """

    def __init__(self, begin: Callable[[], None]) -> None:
        """Start the thread, with `begin` as its first step; `ready` ends when that is done."""
        self._steps: SimpleQueue[tuple[Future[object], Step] | None] = SimpleQueue()
        self.ready = asyncio.wrap_future(self.put(begin))
        self._thread = threading.Thread(
            target=self._run, name="projector-compute", daemon=True
        )
        self._thread.start()

    def put(self, step: Step) -> Future[object]:
        """Put a step into the queue; return the future of its value."""
        future: Future[object] = Future()
        self._steps.put((future, step))
        return future

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop after the queued steps still wanted."""
        self._steps.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        """Compute queued steps in order until `close` is called; results and errors go to
        the steps' futures.

        A step whose future was canceled before it begins is skipped.
        """
        while (put := self._steps.get()) is not None:
            future, step = put
            if future.set_running_or_notify_cancel():
                try:
                    future.set_result(step())
                except Exception as error:
                    future.set_exception(error)


def projection_steps(
    body: Body, rows: npt.NDArray[np.float64], shape: tuple[int, int], block: int
) -> Iterator[Step]:
    """Yield functions that each project a block of views, (views, rows, cols).

    `rows`: cone_vec (n, 12); `shape`: (rows, cols) of the panel.
    """

    def step(part: npt.NDArray[np.float64]) -> Step:
        """Make the step of some rows."""
        return lambda: project_body(body, part, shape)

    for start in range(0, len(rows), block):
        yield step(rows[start : start + block])


def marking_steps(
    body: Body,
    rows: npt.NDArray[np.float64],
    shape: tuple[int, int],
    block: int,
    need: tuple[Need, float],
) -> Iterator[Step]:
    """Yield functions that each find the rays that a block's pixels need.

    As `projection_steps`; `need`: with the body's weight. Values: `pixel_areas.packed`.
    """

    def step(part: npt.NDArray[np.float64]) -> Step:
        """Make the step of some rows."""
        return lambda: packed(rays_needed(body, part, shape, *need))

    for start in range(0, len(rows), block):
        yield step(rows[start : start + block])


def within_steps(
    body: Body,
    rows: npt.NDArray[np.float64],
    shape: tuple[int, int],
    block: int,
    within: Within,
) -> Iterator[Step]:
    """Yield functions that each project a block of views along several rays of some pixels.

    Args:
        body, rows, shape, block: as of `projection_steps`.
        within: pixels of all views.

    Yields steps whose values are float32 (rays,).
    """
    view = shape[0] * shape[1]

    def step(start: int) -> Step:
        """Make the step of the views from `start` on."""
        part = rows[start : start + block]
        some, _ = within.of_range(start * view, (start + len(part)) * view)
        return lambda: paths_within(body, part, shape, some)

    for start in range(0, len(rows), block):
        yield step(start)


def views_a_block(shape: tuple[int, int]) -> int:
    """Compute how many views a turn computes."""
    return max(1, min(BLOCK_VIEWS, BLOCK_BYTES // (4 * shape[0] * shape[1])))


def begin(threads: int) -> None:
    """Set the thread count of this thread's kernels, and note from now on what compiles.

    `threads`: of the kernels. Raises ValueError: more threads than numba was started with."""
    numba.set_num_threads(threads)
    LOG.setLevel(logging.ERROR)  # whoever waits is told by `compiling`
    long_work.during = _noted


_COMPILING: Final[list[str]] = []
"""Names of the works that compile now."""


def compiling() -> str | None:
    """Say which kernel compiles now; None where none does."""
    return f"{_COMPILING[-1]}, once on this machine" if _COMPILING else None


@contextmanager
def _noted(what: str, progress: Progress = None) -> Iterator[Report]:
    """Note work that compiles while it goes on; shows nothing."""
    if not what.startswith(long_work.COMPILING):
        with long_work.unseen(what, progress) as report:
            yield report
        return
    _COMPILING.append(what)
    try:
        yield long_work.ignore
    finally:
        _COMPILING.remove(what)


def backend() -> str:
    """Name what computes: "numba", or the name of the CUDA device followed by ", numba"."""
    found = gpu.availability()
    if found.present:
        return f"{found.reason} (CUDA), numba"
    return "numba"
