"""An event loop whose time is virtual: it never sleeps, and the same seed gives the same run.

When nothing is ready the clock jumps to the next timer. Work for threads runs in the loop itself,
at once, or a moment drawn from a seed later, so that what runs beside each other comes in many
orders. A wait that nothing can end is an error (`Deadlock`) instead of a test that hangs; a loop
that runs for ever in a thread (Bluesky's engine does that) waits for the next request instead.
"""

from __future__ import annotations

import asyncio
import random
import selectors
import threading
from collections.abc import Awaitable, Callable, Generator
from typing import Any, TypeVar

T = TypeVar("T")
LATER_S = (0.0, 0.0, 0.0004, 0.002, 0.03)
"""How long a thread takes to begin, one of these [virtual s]."""


class Deadlock(Exception):
    """Somebody waits, and nothing is left that could happen."""


class SimulatedLoop(asyncio.SelectorEventLoop):
    """A loop of its own time.

    Args:
        rng: draws when work for threads runs; None: at once.
        start: its clock at first [s].
    """

    def __init__(self, rng: random.Random | None = None, start: float = 0.0) -> None:
        self._now = start
        self._rng = rng
        self.alone = False
        """Whether it runs until one result is there, so that nobody else can end a wait."""
        super().__init__(_Jumps(self))

    def time(self) -> float:
        """Virtual seconds."""
        return self._now

    def jump(self, seconds: float) -> None:
        """Let time pass."""
        self._now += seconds

    def run_until_complete(self, future: Generator[Any, None, T] | Awaitable[T]) -> T:
        """As any loop does.

        Raises:
            Deadlock: nothing is left that could complete it.
        """
        self.alone = True
        try:
            return super().run_until_complete(future)
        finally:
            self.alone = False

    def come_to_rest(self) -> None:
        """End a thread that runs it."""
        for thread in threading.enumerate():
            if thread.ident == self._thread_id:  # type: ignore[attr-defined]
                self.call_soon_threadsafe(self.stop)
                thread.join()

    def run_in_executor(  # type: ignore[override]
        self, executor: Any, func: Callable[..., Any], *args: Any
    ) -> asyncio.Future[Any]:
        """Run `func` here, soon."""
        done: asyncio.Future[Any] = self.create_future()
        later = 0.0 if self._rng is None else self._rng.choice(LATER_S)
        self.call_later(later, _work, done, func, args)
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
    """Waits for no timer: time jumps instead."""

    def __init__(self, loop: SimulatedLoop) -> None:
        super().__init__()
        self._loop = loop

    def select(self, timeout: float | None = None) -> list[Any]:
        if timeout is None and not self._loop.alone:
            return super().select()
        found = super().select(0.0)
        if not found and timeout is None:
            raise Deadlock("nothing is left that could happen")
        if not found and timeout is not None:
            self._loop.jump(timeout)
        return found
