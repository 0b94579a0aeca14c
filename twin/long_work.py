"""Name work that takes seconds, so that whoever has a clock and a screen can show how far it
is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from typing import Final, Protocol, TypeAlias, TypeVar

Part = TypeVar("Part")
Advance: TypeAlias = Callable[[float], None]
"""Takes the fraction of the work that is done, 0 to 1."""
Progress: TypeAlias = bool | Advance | None
"""What callers choose: None or True for a bar after two seconds, False for silence, or a
function that is called with the fraction done and shows it in its own way."""
RATED_FRACTION: Final = 0.1
"""Progress from whose duration the time left is estimated."""


class Announcer(Protocol):
    """Shows work while it goes on."""

    def __call__(
        self, what: str, progress: Progress = None
    ) -> AbstractContextManager[Advance]:
        """Enter with the work's name and the caller's choice; yields what takes the
        fraction."""


@contextmanager
def unseen(what: str, progress: Progress = None) -> Iterator[Advance]:
    """Show nothing; a function among the choices is called all the same."""
    yield progress if callable(progress) else ignore


def ignore(done: float) -> None:
    """Take the fraction that is done, and do nothing."""


class Passes:
    """Tell the fraction done of work that passes over all of its parts an unknown number of
    times.

    After n passes n / (n + 1) of it is taken as done.

    Args:
        count: parts in a pass.

    Attributes:
        advance: takes the fraction done.

    Example:
        >>> told, passes = [], Passes(2)
        >>> passes.advance = told.append
        >>> _ = [passes.step() for _ in range(4)]
        >>> told[1::2]
        [0.5, 0.6666666666666667]
    """

    def __init__(self, count: int) -> None:
        """Expect `count` steps (at least one); the fraction goes nowhere until `advance` is set."""
        self._count = max(count, 1)
        self._seen = 0
        self.advance: Advance = ignore

    def step(self) -> None:
        """Count one more part and call `advance` with the fraction taken as done: n / (n
        + 1) after n passes, below 1.
        """
        self._seen += 1
        passes = self._seen / self._count
        self.advance(1.0 - 1.0 / (1.0 + passes))

    def counting(self, read: Callable[[int], Part]) -> Callable[[int], Part]:
        """Wrap a function that reads a part by index, so that each call counts one step
        before it reads.
        """

        def one(index: int) -> Part:
            """Count one step, then read the part of that index."""
            self.step()
            return read(index)

        return one


@dataclass(eq=False)
class Pace:
    """Measures how fast work goes on after its first fraction.

    What comes before that is preparation, such as a kernel that is compiled.

    Attributes:
        first: first fraction above 0; None before it.
        since_s: when that was done.
    """

    first: float | None = None
    since_s: float = 0.0

    def advance(self, done: float, now_s: float) -> None:
        """Begin the measurement at the first fraction above 0; later ones change nothing."""
        if self.first is None and done > 0.0:
            self.first, self.since_s = done, now_s

    def left_s(self, done: float, now_s: float) -> float | None:
        """Estimate the time left at the pace since the first fraction above 0 [s].

        Args:
            done: fraction.
            now_s: time.

        Returns:
            Seconds; None before `RATED_FRACTION` has been done at that pace, and at the
            end.
        """
        if self.first is None or done >= 1.0:
            return None
        paced = done - self.first
        if paced < RATED_FRACTION:
            return None
        return (now_s - self.since_s) * (1.0 - done) / paced


during: Announcer = unseen
"""Announces the work named by its argument; `flexdt.runtime.progress_lines` replaces it."""
