"""An event loop whose time is virtual: it never sleeps, and the same seed gives the same run.

When nothing is ready the clock jumps to the next timer. Work for threads runs in the loop itself, a
moment drawn from the seed later, so that what runs beside each other comes in many orders. A wait
that nothing can end is an error (`Deadlock`) instead of a test that hangs.
"""

from __future__ import annotations

import asyncio
import random
import selectors
from collections.abc import Callable
from typing import Any

LATER_S = (0.0, 0.0, 0.0004, 0.002, 0.03)
"""How long a thread takes to begin, one of these [virtual s]."""


class Deadlock(Exception):
    """Somebody waits, and nothing is left that could happen."""


class SimulatedLoop(asyncio.SelectorEventLoop):
    """A loop of its own time.

    Args:
        rng: draws when work for threads runs.
        start: its clock at first [s].
    """

    def __init__(self, rng: random.Random, start: float = 0.0) -> None:
        self._now = start
        self._rng = rng
        super().__init__(_Jumps(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self._now

    def jump(self, seconds: float) -> None:
        """Let time pass."""
        self._now += seconds

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Run `func` here, a moment later."""
        done: asyncio.Future[Any] = self.create_future()
        self.call_later(self._rng.choice(LATER_S), _work, done, func, args)
        return done


def _work(done: asyncio.Future[Any], func: Callable[..., Any], args: tuple[Any, ...]) -> None:
    """As a thread: it ends its work even if nobody waits for it any more."""
    try:
        result = func(*args)
    except Exception as error:
        if not done.cancelled():
            done.set_exception(error)
    else:
        if not done.cancelled():
            done.set_result(result)


class _Jumps(selectors.DefaultSelector):
    """Waits for no descriptor: time jumps instead."""

    def __init__(self, loop: SimulatedLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[Any]:
        if timeout is None:
            raise Deadlock("nothing is left that could happen")
        self._loop.jump(timeout)
        return []
