"""The one thread that computes, and the jobs it works on block by block.

Numba's kernels use all cores by themselves and release the interpreter, so one thread is enough
and the event loop stays responsive. A job's blocks go to the loop as they are made.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.protocol.rpc_errors import RpcError, internal, invalid_params, too_large
from flexdt.server.projector.queue import FairQueue
from flexdt.server.runtime.log import log
from flexdt.twin.errors import TwinError
from flexdt.twin.projection import Volume, forward, project_scene
from flexdt.twin.projection.analytic_solids import Scene

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
        self._untaken: dict[Job, int] = {}

    @property
    def has_room(self) -> bool:
        """Whether a further block may be computed for it."""
        with self._lock:
            return sum(self._untaken.values()) < CREDIT

    def begin(self, job: Job) -> bool:
        """Count a block of `job`; False if the job is over (compute thread)."""
        with self._lock:
            if not job.over:
                self._untaken[job] = self._untaken.get(job, 0) + 1
            return not job.over

    def took(self, job: Job) -> None:
        """The client has taken a block (event loop)."""
        with self._lock:
            self._untaken[job] -= 1

    def finish(self, job: Job) -> None:
        """The job's request has been answered: what was not taken never will be (event loop)."""
        with self._lock:
            job.over = True
            self._untaken.pop(job, None)


@dataclass(eq=False)
class Job:
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
        self.queue: FairQueue[tuple[Job, Step]] = FairQueue(_has_room)
        self.ready: asyncio.Future[None] = self._loop.create_future()
        self._thread = threading.Thread(target=self._run, name="projector-compute", daemon=True)
        self._thread.start()

    def submit(self, job: Job) -> Job:
        """Queue a job's first step."""
        self._next_step(job)
        return job

    def give_up(self, wanted: Callable[[Job], bool], error: Exception) -> int:
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

    def _next_step(self, job: Job, *, front: bool = False) -> None:
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
    volume: Volume | Scene, rows: npt.NDArray[np.float64], shape: tuple[int, int], block: int
) -> Iterator[Step]:
    """Steps of `block` views each; every value is float32 (views, rows, cols)."""

    def step(part: npt.NDArray[np.float64]) -> Step:
        if isinstance(volume, Volume):
            return lambda: forward(volume, part, shape)
        return lambda: project_scene(volume, part, shape)

    for start in range(0, len(rows), block):
        yield step(rows[start : start + block])


def views_a_block(shape: tuple[int, int]) -> int:
    """How many views a turn computes."""
    return max(1, min(BLOCK_VIEWS, BLOCK_BYTES // (4 * shape[0] * shape[1])))
