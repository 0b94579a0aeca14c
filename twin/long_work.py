"""Name work that takes seconds, so that whoever has a clock and a screen can show how far it
is; and decide what is said of it, and when.

All times are arguments. A share is rounded down and stands below 100 % until the work ends.
The time left follows the rate so far, on a clock that stands still while kernels compile; an
estimate that proves wrong by more than a factor of `MAX_ERROR_FACTOR` is the last one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from typing import Final, Protocol, TypeAlias, TypeVar

Part = TypeVar("Part")
Advance: TypeAlias = Callable[[float], None]
"""Takes the fraction of the work that is done, 0 to 1."""
Progress: TypeAlias = bool | Advance | None
"""What callers choose: None or True for a bar after two seconds, False for silence, or a
function that is called with the fraction done and shows it in its own way."""
LINE_INTERVALS_S: Final = (2.0, 5.0, 15.0, 60.0)
"""Time from the begin of work to its first line, and from each line to the next; the last one
repeats [s]. Work that ends within the first shows nothing."""
RATED_FRACTION: Final = 0.1
"""Progress from whose duration the time left is estimated."""
MAX_ERROR_FACTOR: Final = 2.0
"""Ratio of times left, estimated and true, from which on no more estimates are given."""
LEAST_LEFT_S: Final = 1.0
"""Shortest time left that is stated [s]."""
COMPILING: Final = "compiling"
"""First word of the names of works that compile kernels."""


class Report(Protocol):
    """Takes how far work is."""

    def __call__(self, done: float, detail: str = "", *, steady: bool = True) -> None:
        """Take the fraction of the work that is done.

        Args:
            done: 0 to 1; 0 if it is not known.
            detail: more words, such as "26 of 100 frames".
            steady: equal fractions take equal times, so that the time left can be
                estimated.
        """


class Announcer(Protocol):
    """Shows work while it goes on."""

    def __call__(
        self, what: str, progress: Progress = None
    ) -> AbstractContextManager[Report]:
        """Enter with the work's name and the caller's choice; yields what takes the
        fraction."""


class Told:
    """Hand fractions on to a caller's function: they grow, and 1 is told at the end only.

    Args:
        function: the caller's.
    """

    def __init__(self, function: Advance) -> None:
        self._function = function
        self._last = 0.0

    def __call__(self, done: float, detail: str = "", *, steady: bool = True) -> None:
        """Hand a fraction on, unless it is smaller than an earlier one, or the whole."""
        if self._last <= done < 1.0:
            self._last = done
            self._function(done)

    def end(self) -> None:
        """Hand on the end."""
        self._function(1.0)


@contextmanager
def unseen(what: str, progress: Progress = None) -> Iterator[Report]:
    """Show nothing; a function among the choices is called all the same."""
    if not callable(progress):
        yield ignore
        return
    told = Told(progress)
    yield told
    told.end()


def ignore(done: float, detail: str = "", *, steady: bool = True) -> None:
    """Take the fraction that is done, and do nothing."""


def in_units(report: Report, unit: str) -> Callable[..., None]:
    """Make a function that reports work counted in units.

    Args:
        report: takes the fraction.
        unit: of the counts, such as "frames".

    Returns:
        A function of the units done, of all (None or 0 if unknown), and of the state that
        the work is in ("" while it goes on).

    Example:
        >>> told = []
        >>> in_units(lambda done, detail: told.append((done, detail)), "frames")(26, 104)
        >>> told
        [(0.25, '26 of 104 frames')]
    """

    def count(done: float, total: float | None, state: str = "") -> None:
        """Report the share, and the counts where they are whole numbers."""
        words = [state]
        if not total:
            words.append(f"{done:g} {unit}")
        elif float(done).is_integer():
            words.append(f"{done:g} of {total:g} {unit}")
        report(done / total if total else 0.0, ", ".join(filter(None, words)))

    return count


class Passes:
    """Tell the fraction done of work that passes over all of its parts an unknown number of
    times.

    After n passes n / (n + 1) of it is taken as done, which tells nothing about the time left.

    Args:
        count: parts in a pass.

    Attributes:
        report: takes the fraction done.

    Example:
        >>> told, passes = [], Passes(2)
        >>> passes.report = lambda done, steady: told.append(done)
        >>> _ = [passes.step() for _ in range(4)]
        >>> told[1::2]
        [0.5, 0.6666666666666667]
    """

    def __init__(self, count: int) -> None:
        """Expect `count` steps (at least one); the fraction goes nowhere until `report` is set."""
        self._count = max(count, 1)
        self._seen = 0
        self.report: Report = ignore

    def step(self) -> None:
        """Count one more part and report the fraction taken as done: n / (n + 1) after n
        passes, below 1.
        """
        self._seen += 1
        passes = self._seen / self._count
        self.report(1.0 - 1.0 / (1.0 + passes), steady=False)

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
class WorkClock:
    """A clock that stands still while kernels compile, in whatever thread.

    Attributes:
        compiling: number of kernels that compile now.
        since_s: when the first of them began.
        lost_s: time for which it stood still before.
    """

    compiling: int = 0
    since_s: float = 0.0
    lost_s: float = 0.0

    def stop(self, now_s: float) -> None:
        """Stand still until as many calls of `go_on` as of `stop`."""
        if not self.compiling:
            self.since_s = now_s
        self.compiling += 1

    def go_on(self, now_s: float) -> None:
        """Go on, if nothing else compiles."""
        self.compiling -= 1
        if not self.compiling:
            self.lost_s += now_s - self.since_s

    def at(self, now_s: float) -> float:
        """Read the clock [s]."""
        return (self.since_s if self.compiling else now_s) - self.lost_s


@dataclass(eq=False)
class TimeLeft:
    """Estimate the time left from the rate since the first fraction above 0.

    What comes before that fraction is preparation. All times are of a `WorkClock`.

    Attributes:
        first, first_s: first fraction, and when it was done; None before it.
        done, done_s: last one that differed, and when it was done.
        soonest_s, latest_s: between them lie the ends by which no estimate given so far is
            wrong by more than `MAX_ERROR_FACTOR`.
        wrong: whether one was.
    """

    first: float | None = None
    first_s: float = 0.0
    done: float = 0.0
    done_s: float = 0.0
    soonest_s: float = -math.inf
    latest_s: float = math.inf
    wrong: bool = False

    def report(self, done: float, at_s: float) -> None:
        """Take a fraction above 0; one that is not larger than the last changes nothing."""
        if self.first is None:
            self.first = self.done = done
            self.first_s = self.done_s = at_s
        elif done > self.done:
            self.done = done
            self.done_s = at_s
        end_s = self.end_s
        if end_s is not None and not self.soonest_s <= end_s <= self.latest_s:
            self.wrong = True

    @property
    def end_s(self) -> float | None:
        """The end, extrapolated; None before `RATED_FRACTION` has been done at the
        measured rate.
        """
        if self.first is None or self.done - self.first < RATED_FRACTION:
            return None
        whole_s = (self.done_s - self.first_s) / (self.done - self.first)
        return self.done_s + whole_s * (1.0 - self.done)

    def seconds(self, at_s: float) -> float | None:
        """Estimate the time left [s], for people to read; None where there is none, below
        `LEAST_LEFT_S`, and after an estimate that was wrong.
        """
        end_s = self.end_s
        if self.wrong or end_s is None or end_s - at_s < LEAST_LEFT_S:
            return None
        left_s = end_s - at_s
        self.soonest_s = max(self.soonest_s, at_s + left_s / MAX_ERROR_FACTOR)
        self.latest_s = min(self.latest_s, at_s + left_s * MAX_ERROR_FACTOR)
        return left_s


@dataclass(eq=False)
class Rhythm:
    """When the next line about work is due: ever later, as `LINE_INTERVALS_S` has it.

    Attributes:
        due_s: time of the next line.
        lines: number of lines written.
    """

    due_s: float
    lines: int = 0

    @classmethod
    def begun(cls, begun_s: float) -> Rhythm:
        """Begin with work that begins."""
        return cls(begun_s + LINE_INTERVALS_S[0])

    def after(self, begun_s: float) -> Rhythm:
        """Go on: a thousand short works of a name write as few lines as a long one."""
        return Rhythm(max(self.due_s, begun_s + LINE_INTERVALS_S[0]), self.lines)

    def write(self, now_s: float) -> bool:
        """Return whether a line is due, which is then taken as written."""
        if now_s < self.due_s:
            return False
        self.lines += 1
        self.due_s = now_s + LINE_INTERVALS_S[min(self.lines, len(LINE_INTERVALS_S) - 1)]
        return True


@dataclass(eq=False)
class Course:
    """What is known of work that goes on.

    Attributes:
        what: its name.
        begun_s: when it began.
        clock: stands still while kernels compile.
        done: fraction; None if unknown.
        detail: more words about it.
        inner: name of the work within it, "" if there is none.
        time_left: estimates it.
    """

    what: str
    begun_s: float
    clock: WorkClock = field(default_factory=WorkClock)
    done: float | None = None
    detail: str = ""
    inner: str = ""
    time_left: TimeLeft = field(default_factory=TimeLeft)

    def report(
        self, done: float, detail: str = "", *, steady: bool = True, now_s: float
    ) -> None:
        """Take how far it is (`Report`); a smaller fraction than before is ignored, as are
        0 and less.
        """
        self.detail = detail
        if done <= 0.0:
            return
        self.done = max(done, self.done or 0.0)
        if steady:
            self.time_left.report(self.done, self.clock.at(now_s))

    @property
    def title(self) -> str:
        """Its name, and that of the work within it."""
        return ": ".join(filter(None, (self.what, self.inner)))

    @property
    def percent(self) -> int | None:
        """Whole percents that are done, at most 99; None if unknown."""
        return None if self.done is None else min(math.floor(100.0 * self.done), 99)

    def times(self, now_s: float) -> str:
        """Format how far it is, how long it takes, and how long it will take.

        While kernels compile the time left is left out.

        Example:
            >>> course = Course("measuring", begun_s=0.0)
            >>> for step in (1, 2, 3):
            ...     course.report(step / 8, f"{step} of 8 images", now_s=40.0 * step)
            >>> course.times(now_s=130.0)
            '3 of 8 images, 37 %, 2 min 10 s, about 3 min 10 s left'"""
        words = [self.detail]
        if self.percent is not None:
            words.append(f"{self.percent} %")
        words.append(time_span(now_s - self.begun_s))
        if not self.clock.compiling:
            left_s = self.time_left.seconds(self.clock.at(now_s))
            if left_s is not None:
                words.append(f"about {time_span(left_s)} left")
        return ", ".join(filter(None, words))


def time_span(seconds: float) -> str:
    """Format a time span [s] for people: 3 s, 4 min 05 s, 2 h 03 min."""
    minutes, rest = divmod(round(seconds), 60)
    if not minutes:
        return f"{rest} s"
    hours, minutes = divmod(minutes, 60)
    if not hours:
        return f"{minutes} min {rest:02d} s"
    return f"{hours} h {minutes:02d} min"


during: Announcer = unseen
"""Announces the work named by its argument; `flexdt.runtime.progress` replaces it."""
