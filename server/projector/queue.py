"""The order of computation: lanes take turns, so a long scan never starves a single view.

A lane is one client's batch work or one client's interactive work. Within a lane tasks keep their
order. Thread-safe: one thread takes, any thread puts.
"""

from __future__ import annotations

import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

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
