"""A job paused by a full disk or an absent projector continues by itself, with back-off.

Each attempt waits twice as long as the one before, up to half a minute; for a disk also
until there is room for the unwritten data. A user who pauses, steps or moves by hand
takes over: then only `job.resume` continues. Decisions of a user are not retried.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path

from flexdt.runtime.files.directory import free_bytes
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.twin.dataset.dataset_errors import DiskFullError

FIRST_S = 1.0
"""Delay before the first retry [real s]."""
LONGEST_S = 30.0
"""Longest delay between attempts [real s]."""


def transient(error: Exception | None) -> bool:
    """Return whether waiting may remove an error."""
    return isinstance(error, (DiskFullError, ProjectorUnavailable))


class Retry:
    """The next attempt of the job that runs; one at a time.

    Args:
        first_s, longest_s: pauses between attempts [real s].
    """

    def __init__(self, first_s: float = FIRST_S, longest_s: float = LONGEST_S) -> None:
        """Begin without an attempt; the first retry comes after `first_s`, none waits over
        `longest_s`.
        """
        self._first = first_s
        self._longest = longest_s
        self._attempts = 0
        self._task: asyncio.Task[None] | None = None
        self._at = 0.0

    @property
    def waits_s(self) -> float | None:
        """Seconds until the next attempt; None if there is no automatic one."""
        if self._task is None or self._task.done():
            return None
        return max(0.0, self._at - asyncio.get_running_loop().time())

    def schedule(self, error: Exception, go: Callable[[], None]) -> None:
        """Schedule a call of `go` after a pause, unless one is pending.

        It doubles from `first_s` to `longest_s`. If `error` is a full disk, `go` waits
        for room.
        """
        if self.waits_s is None:
            pause = min(self._longest, self._first * 2.0**self._attempts)
            self._attempts += 1
            self._at = asyncio.get_running_loop().time() + pause
            self._task = asyncio.create_task(self._wait(error, go, pause))

    def progressed(self) -> None:
        """Work was done: the next trouble begins with the shortest pause again."""
        if self.waits_s is None:
            self._attempts = 0

    def cancel(self) -> None:
        """Cancel the next attempt and reset the pause, as a user takes over."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._attempts = 0

    async def _wait(self, error: Exception, go: Callable[[], None], pause: float) -> None:
        """Pause, then call `go`; after a full disk pause again as long as it has no room.

        Args:
            error: for which it waits.
            go: resumes the job.
            pause: before each attempt [real s].
        """
        while True:
            await asyncio.sleep(pause)
            if not isinstance(error, DiskFullError) or _has_room(error):
                break
            self._at = asyncio.get_running_loop().time() + pause
        self._task = None
        go()


def _has_room(error: DiskFullError) -> bool:
    """Return whether the data that a full disk refused would fit now.

    It is True, too, if the error has no path or size, or the system does not report free
    space.
    """
    data = error.data if isinstance(error.data, Mapping) else {}
    path = data.get("path")
    need = data.get("bytes")
    if not isinstance(path, str) or not isinstance(need, int):
        return True
    free = free_bytes(Path(path).parent)
    return free is None or free > need
