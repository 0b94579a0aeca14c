"""Frames on their way from a scan to its files: bounded, batched, and each done exactly once.

A scan adds frames; a few workers take waiting frames, in batches of one kind, and pass
each batch to `produce`. At real-time pace every frame is processed at once, at full speed
batches fill up; the result does not depend on it. When `produce` fails the worker keeps
its batch and waits to be told to try again, so nothing is lost and nothing is done twice.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

T = TypeVar("T")


@dataclass(eq=False, repr=False)
class FramePipeline(Generic[T]):
    """A bounded queue of frames with workers that process them.

    Attributes:
        produce: makes and stores a batch; its errors are passed to `failed`.
        failed: called with the exception when a batch could not be made.
        kind: frames of different kinds never share a batch.
        batch: most frames a batch.
        workers: batches in the making at a time.
        room: most frames waiting.
    """

    produce: Callable[[Sequence[T]], Awaitable[None]]
    failed: Callable[[Exception], None]
    kind: Callable[[T], Hashable]
    batch: int = 4
    workers: int = 2
    room: int = 16

    def __post_init__(self) -> None:
        """Begin empty, with retries allowed; no task runs yet."""
        self._waiting: deque[T] = deque()
        self._busy = 0
        self._changed = asyncio.Condition()
        self._retry_allowed = asyncio.Event()
        self._retry_allowed.set()
        self._tasks: list[asyncio.Task[None]] = []

    def open(self) -> None:
        """Start the workers; before that, frames only wait."""
        self._tasks = [
            asyncio.create_task(self._process_batches()) for _ in range(self.workers)
        ]

    @property
    def full(self) -> bool:
        """True if no frame can be added now."""
        return len(self._waiting) >= self.room

    @property
    def idle(self) -> bool:
        """True if all added frames have been made."""
        return not self._waiting and self._busy == 0

    async def put(self, frame: T) -> None:
        """Add a frame to the queue's end, once it has room."""
        async with self._changed:
            await self._changed.wait_for(lambda: not self.full)
            self._waiting.append(frame)
            self._changed.notify_all()

    async def drained(self) -> None:
        """Wait until every frame put in has been made; at once if there is none."""
        async with self._changed:
            await self._changed.wait_for(lambda: self.idle)

    def retry(self) -> None:
        """Let the workers that failed try their batches again."""
        self._retry_allowed.set()

    async def close(self) -> None:
        """Stop the workers; frames that are not made are dropped."""
        for worker in self._tasks:
            worker.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _process_batches(self) -> None:
        """Take batches of waiting frames and produce each until it succeeds; end only by
        cancellation.

        Several such tasks run at a time. Each wakes whoever waits for room or for the
        end.
        """
        while True:
            async with self._changed:
                await self._changed.wait_for(lambda: bool(self._waiting))
                batch = self._next_batch()
                self._busy += 1
                self._changed.notify_all()
            await self._produce_until_done(batch)
            async with self._changed:
                self._busy -= 1
                self._changed.notify_all()

    def _next_batch(self) -> list[T]:
        """Remove the next batch from the queue: consecutive frames of one kind, at most
        `batch`.

        The queue must not be empty.
        """
        batch = [self._waiting.popleft()]
        kind = self.kind(batch[0])
        while (
            self._waiting
            and len(batch) < self.batch
            and self.kind(self._waiting[0]) == kind
        ):
            batch.append(self._waiting.popleft())
        return batch

    async def _produce_until_done(self, batch: Sequence[T]) -> None:
        """Produce a batch; after any exception call `failed`, wait for `retry`, and
        produce the whole batch again.
        """
        while True:
            try:
                await self.produce(batch)
            except Exception as error:
                self._retry_allowed.clear()
                self.failed(error)
                await self._retry_allowed.wait()
            else:
                return
