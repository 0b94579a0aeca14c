"""The event loop of a server process: how long its turns hold it, and what it complains of.

Whoever waits for the loop, an E-stop too, waits for the turn under way. So the time from where the
loop wakes to where it looks at its sockets again is measured, every time; what another thread keeps
the interpreter for is in it while the loop has something to do.
"""

from __future__ import annotations

import asyncio
import logging
import selectors
from time import perf_counter
from typing import Any

from flexdt.server.log import log
from flexdt.server.metrics import Histogram

COMPLAIN_S = 10.0
"""The same complaint is logged once in so long."""
BACKLOG = 128
"""Connections that the system keeps until they are accepted."""


class Holds:
    """How long turns of the loop took [s]."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Count from now on."""
        self.turns = Histogram()
        self._worst = 0.0
        self._begun = False

    def observe(self, seconds: float) -> None:
        """A turn has ended; the one in which counting began does not count."""
        if not self._begun:
            self._begun = True
            return
        self.turns.observe(seconds)
        self._worst = max(self._worst, seconds)

    def worst(self) -> float:
        """The longest since this was last asked."""
        worst, self._worst = self._worst, 0.0
        return worst


class _Watched(selectors.DefaultSelector):
    """Tells the time between two looks at the sockets."""

    def __init__(self, holds: Holds) -> None:
        super().__init__()
        self._holds = holds
        self._woke: float | None = None

    def select(self, timeout: float | None = None) -> Any:
        """As any selector."""
        now = perf_counter()
        if self._woke is not None:
            self._holds.observe(now - self._woke)
        events = super().select(timeout)
        # A look that does not wait takes no time, unless another thread has the interpreter.
        self._woke = now if timeout is not None and timeout <= 0.0 else perf_counter()
        return events


class ServerLoop(asyncio.SelectorEventLoop):
    """asyncio's loop, watched."""

    def __init__(self) -> None:
        self.holds = Holds()
        super().__init__(_Watched(self.holds))
        self.set_exception_handler(Complaints())


class Complaints:
    """Logs what asyncio tells the loop's exception handler: each complaint once in a while.

    A process without descriptors would else write of nothing else: every connection that cannot be
    accepted is a complaint.
    """

    def __init__(self) -> None:
        self._last: dict[str, tuple[float, int]] = {}

    def __call__(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """One complaint."""
        what, error = str(context.get("message")), context.get("exception")
        expected = isinstance(error, OSError)
        kind = f"{what} {type(error).__name__}"
        at, more = self._last.get(kind, (-COMPLAIN_S, 0))
        now = loop.time()
        if now - at < COMPLAIN_S:
            self._last[kind] = (at, more + 1)
            return
        self._last = {k: v for k, v in self._last.items() if now - v[0] < COMPLAIN_S}
        self._last[kind] = (now, 0)
        if expected or error is None:
            log("event loop", logging.WARNING, message=what, reason=str(error), before=more)
            return
        try:
            raise error
        except BaseException:
            log("event loop", logging.ERROR, error=True, message=what, before=more)


def one_at_a_time(server: asyncio.Server) -> None:
    """For a server made with `backlog=1`: let the system keep as many connections as usual.

    asyncio tries to accept `backlog` connections in one go, and when descriptors run out it sets up
    a new attempt for each that failed, so that attempts multiply a hundredfold every second. Of one
    at a time there is one. It also lets connections take turns with requests.
    """
    for listening in server.sockets:
        with listening.dup() as same:
            same.listen(BACKLOG)
