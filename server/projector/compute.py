"""The one thread that computes, and the jobs it works on block by block.

Numba's kernels use all cores by themselves and release the interpreter, so one thread is enough
and the event loop stays responsive. A job's blocks go to the loop as they are made.

Lanes of the queue take turns, so a long scan never starves a single view. A lane is one client's
batch work or one client's interactive work. Within a lane tasks keep their order. Thread-safe: one
thread takes, any thread puts.

`begin` sets the number of threads and compiles before the first request.
"""

from __future__ import annotations

import asyncio
import logging
import os
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final, Generic, TypeVar

import numba
import numpy as np
import numpy.typing as npt

from flexdt.protocol.rpc_errors import RpcError, internal, invalid_params, too_large
from flexdt.runtime import compile_ahead
from flexdt.runtime.log import log
from flexdt.twin.errors import TwinError
from flexdt.twin.projection import Body, gpu, project_body
from flexdt.twin.projection.analytic import warm_up_forward
from flexdt.twin.projection.kernels.compiling import LOG

T = TypeVar("T")


class FairQueue(Generic[T]):
    """Round-robin over lanes.

    Args:
        ready: whether a lane may be served now (its client has room for results).
    """

    def __init__(self, ready: Callable[[Hashable], bool] = lambda lane: True) -> None:
        self._ready = ready
        self._lanes: OrderedDict[Hashable, deque[T]] = OrderedDict()
        self._changed = threading.Condition()
        self._closed = False

    def __len__(self) -> int:
        with self._changed:
            return sum(len(lane) for lane in self._lanes.values())

    def put(self, lane: Hashable, task: T, *, front: bool = False) -> None:
        """Add a task to the end of its lane (or put one back to the front)."""
        with self._changed:
            waiting = self._lanes.setdefault(lane, deque())
            if front:
                waiting.appendleft(task)
            else:
                waiting.append(task)
            self._changed.notify()

    def take(self) -> T | None:
        """Wait for a task of the lane whose turn it is; None once the queue is closed."""
        with self._changed:
            while not self._closed:
                for lane, waiting in self._lanes.items():
                    if self._ready(lane):
                        task = waiting.popleft()
                        if waiting:
                            self._lanes.move_to_end(lane)
                        else:
                            del self._lanes[lane]
                        return task
                self._changed.wait()
            return None

    def remove(self, wanted: Callable[[T], bool]) -> list[T]:
        """Take out all tasks that are `wanted`, in order."""
        out: list[T] = []
        with self._changed:
            for lane in list(self._lanes):
                kept: deque[T] = deque()
                for task in self._lanes[lane]:
                    (out if wanted(task) else kept).append(task)
                if kept:
                    self._lanes[lane] = kept
                else:
                    del self._lanes[lane]
        return out

    def wake(self) -> None:
        """A lane may have become ready."""
        with self._changed:
            self._changed.notify()

    def close(self) -> None:
        """No more tasks; `take` returns None."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


COMPILE_BACK_AFTER_S: Final = 60.0
"""So that the first scan of a new installation has both cores."""
BLOCK_BYTES: Final = 12 * 2**20
"""Result of one turn of a job: below a frame, and short enough to share the machine fairly."""
BLOCK_VIEWS: Final = 32
CREDIT: Final = 3
"""Blocks a client may have computed but not taken."""

Step = Callable[[], object]
"""A piece of work; its value goes to whoever waits for the job."""


class Customer:
    """A client as the compute thread sees it: how many results it has yet to take."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._untaken: dict[ComputeJob, int] = {}

    @property
    def has_room(self) -> bool:
        """Whether a further block may be computed for it."""
        with self._lock:
            return sum(self._untaken.values()) < CREDIT

    def begin(self, job: ComputeJob) -> bool:
        """Count a block of `job`; False if the job is over (compute thread)."""
        with self._lock:
            if not job.over:
                self._untaken[job] = self._untaken.get(job, 0) + 1
            return not job.over

    def took(self, job: ComputeJob) -> None:
        """The client has taken a block (event loop)."""
        with self._lock:
            self._untaken[job] -= 1

    def finish(self, job: ComputeJob) -> None:
        """The job's request has been answered: what was not taken never will be (event loop)."""
        with self._lock:
            job.over = True
            self._untaken.pop(job, None)


@dataclass(eq=False)
class ComputeJob:
    """Steps of one request, run in order; results arrive in `results` on the event loop.

    Attributes:
        customer: whose it is.
        steps: the work, made lazily.
        key: interactive requests have one (a newer one takes this one's place).
    """

    customer: Customer
    steps: Iterator[Step]
    key: str | None = None
    results: asyncio.Queue[object] = field(default_factory=asyncio.Queue)
    over: bool = False

    @property
    def lane(self) -> Hashable:
        """Interactive and batch work of one client take turns."""
        return (self.customer, self.key is not None)

    def end(self, error: Exception) -> None:
        """Give up the job (event loop only): whoever waits for it gets `error`."""
        if not self.over:
            self.over = True
            self.results.put_nowait(error)

    async def next(self) -> object:
        """The next result.

        Raises:
            RpcError: the job failed, was cancelled or superseded.
        """
        result = await self.results.get()
        if isinstance(result, Exception):
            raise result
        return result


class ComputeThread:
    """Runs jobs in a thread of its own.

    Args:
        begin: called first in that thread (thread count, compilation).
    """

    def __init__(self, begin: Callable[[], None]) -> None:
        self._begin = begin
        self._loop = asyncio.get_running_loop()
        self.queue: FairQueue[tuple[ComputeJob, Step]] = FairQueue(_has_room)
        self.ready: asyncio.Future[None] = self._loop.create_future()
        self._thread = threading.Thread(target=self._run, name="projector-compute", daemon=True)
        self._thread.start()

    def submit(self, job: ComputeJob) -> ComputeJob:
        """Queue a job's first step."""
        self._next_step(job)
        return job

    def give_up(self, wanted: Callable[[ComputeJob], bool], error: Exception) -> int:
        """End all jobs that wait and are `wanted`; how many there were."""
        removed = self.queue.remove(lambda task: wanted(task[0]))
        for job, _ in removed:
            job.end(error)
        return len(removed)

    def close(self, timeout_s: float = 5.0) -> None:
        """Stop after the current step."""
        self.queue.close()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            self._begin()
        except Exception as error:
            self._post(self.ready.set_exception, error)
            return
        self._post(self.ready.set_result, None)
        while (task := self.queue.take()) is not None:
            job, step = task
            if not job.customer.begin(job):
                continue
            result = _guarded(step)
            if not isinstance(result, Exception):
                self._next_step(job, front=True)
            self._post(job.results.put_nowait, result)

    def _next_step(self, job: ComputeJob, *, front: bool = False) -> None:
        step = next(job.steps, None)
        if step is not None and not job.over:
            self.queue.put(job.lane, (job, step), front=front)

    def _post(self, call: Callable[..., object], value: object) -> None:
        try:
            self._loop.call_soon_threadsafe(call, value)
        except RuntimeError:
            self.queue.close()  # the loop has ended, so nobody wants results any more


def _has_room(lane: Hashable) -> bool:
    assert isinstance(lane, tuple)
    customer = lane[0]
    return isinstance(customer, Customer) and customer.has_room


def _guarded(step: Step) -> object:
    """The step's value, or the error to answer with."""
    try:
        return step()
    except RpcError as error:
        return error
    except TwinError as error:
        return invalid_params(error.message, [], error.data or None)
    except MemoryError as error:
        return too_large(f"a result ({error})", "more", 0, "bytes of free memory")
    except Exception:
        log("computation failed", logging.ERROR, error=True)
        return internal()


def projection_steps(
    body: Body, rows: npt.NDArray[np.float64], shape: tuple[int, int], block: int
) -> Iterator[Step]:
    """Steps of `block` views each; every value is float32 (views, rows, cols)."""

    def step(part: npt.NDArray[np.float64]) -> Step:
        return lambda: project_body(body, part, shape)

    for start in range(0, len(rows), block):
        yield step(rows[start : start + block])


def views_a_block(shape: tuple[int, int]) -> int:
    """How many views a turn computes."""
    return max(1, min(BLOCK_VIEWS, BLOCK_BYTES // (4 * shape[0] * shape[1])))


def begin(threads: int) -> None:
    """Set the thread count of this thread's kernels, and load or compile those that project; those
    that project back, which few ask for, are compiled meanwhile and behind all other work.

    Raises:
        ValueError: more threads than numba was started with.
    """
    numba.set_num_threads(threads)
    LOG.setLevel(logging.ERROR)  # the supervisor says what is waited for
    warm_up_forward()
    threading.Thread(target=_compile_back, name="projector-compiling", daemon=True).start()


def _compile_back() -> None:
    time.sleep(COMPILE_BACK_AFTER_S)
    os.nice(10)  # Linux: of this thread, and of the process that it starts
    if not compile_ahead.is_compiled("back projection"):
        compile_ahead.elsewhere("back projection")


def backend() -> str:
    """What computes: "numba" on the processor, or the name of the CUDA device before it."""
    found = gpu.availability()
    return f"{found.reason} (CUDA), numba" if found.present else "numba"
