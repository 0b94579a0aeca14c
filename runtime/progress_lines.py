"""Show work that takes seconds: a bar on terminals and in notebooks, lines of the log
elsewhere.

`shown_work` replaces `flexdt.twin.long_work.during` in a process with a clock. Work that ends
within `SILENT_S` shows nothing. Work within other work of the same thread lends it its name
only: there is one bar. Where a program handles the records of the logger `flexdt`, it gets
lines, not a bar; a level above WARNING of the logger `flexdt.progress` silences both.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Final

from flexdt.runtime.progress_bars import Shown, shown_on
from flexdt.twin.long_work import Advance, Pace, Progress, ignore

SILENT_S = 2.0
"""Time for which work goes on unseen, and between two lines of the log [s]."""
DRAWN_S: Final = 0.5
"""Time between two drawings of a bar [s]."""
FOLLOWED: Final = frozenset({"compiling"})
"""First words of works that follow each other as one wait."""
LOG: Final = logging.getLogger("flexdt.progress")
"""Logs lines where there is no bar, and at INFO how long each work took."""


@dataclass(eq=False)
class _Work:
    """Work that goes on.

    Attributes:
        what: its name.
        begun: when it began, or the first of the works of its kind that follow each other [s].
        due: when it is shown next [s].
        done: fraction; None if unknown.
        pace: how fast it goes on.
        inner: name of the work within it, "" if there is none.
        shown: the bar; None before it is drawn.
        lock: held while it is drawn or ended.
        ended: whether it has ended.
        covered: whether other work is shown in its place.
    """

    what: str
    begun: float
    due: float
    done: float | None = None
    pace: Pace = field(default_factory=Pace)
    inner: str = ""
    shown: Shown | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)
    ended: bool = False
    covered: Callable[[], bool] = lambda: False

    def advance(self, done: float) -> None:
        """Set the fraction that is done; 0 or less is ignored. The first one begins the
        measurement of the rate.
        """
        self.pace.advance(done, time.monotonic())
        if done > 0.0:
            self.done = done

    def tell(self) -> None:
        """Draw the work's name, fraction and times, and set when to show it next, after
        `DRAWN_S` for a bar, else `SILENT_S`.

        Nothing is shown if it has ended, while another work covers it, or if the log
        takes no warnings.
        """
        with self.lock:
            if self.ended or self.covered() or not LOG.isEnabledFor(logging.WARNING):
                return
            if self.shown is None:
                self.shown = shown_on(LOG)
            if self.inner:
                what = f"{self.what}: {self.inner}"
            else:
                what = self.what
            now = time.monotonic()
            left_s = None if self.done is None else self.pace.left_s(self.done, now)
            self.shown.show(what, self.done, now - self.begun, left_s)
            self.due = now + (DRAWN_S if self.shown.bar else SILENT_S)

    def end(self) -> None:
        """End the work and close its bar, if it is shown; later calls of `tell` show nothing."""
        with self.lock:
            self.ended = True
            if self.shown is not None:
                self.shown.close()


class _ProgressThread:
    """Shows all work of this process from one thread, which starts with the first."""

    def __init__(self) -> None:
        """Begin without works; the thread starts with the first one."""
        self._works: list[_Work] = []
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    def add(self, work: _Work) -> None:
        """Add a work, to be shown from when it is due; start the thread at the first.

        The thread is woken only for a work due sooner than all others.
        """
        with self._changed:
            sooner = all(work.due < other.due for other in self._works)
            self._works.append(work)
            if self._thread is None:
                self._thread = threading.Thread(
                    target=self._run, name="flexdt-long-work", daemon=True
                )
                self._thread.start()
            elif sooner:
                self._changed.notify()

    def remove(self, work: _Work) -> None:
        """Show a work no longer; it must have been added."""
        with self._changed:
            self._works.remove(work)

    def _run(self) -> None:
        """Show each work when it is due, again and again; runs in a thread until the
        process ends.

        Works are shown without the lock held. An idle thread sleeps until a work is
        added.
        """
        while True:
            with self._changed:
                now = time.monotonic()
                dues = [work.due for work in self._works]
                if not dues or min(dues) > now:
                    self._changed.wait(min(dues) - now if dues else None)
                    continue
                due = [work for work in self._works if work.due <= now]
                for work in due:
                    work.due = now + SILENT_S
            for work in due:
                work.tell()


class _Told:
    """Hand the fraction done on to a caller's function, which hears of the end in any case.

    Args:
        function: the caller's.
    """

    def __init__(self, function: Advance) -> None:
        """Pass fractions to `function`; none has been passed yet."""
        self._function = function
        self._last = -1.0

    def advance(self, done: float) -> None:
        """Hand a fraction on to the caller's function, and remember it."""
        self._last = done
        self._function(done)

    def end(self) -> None:
        """Hand 1.0 to the caller's function, unless 1 was the last fraction."""
        if self._last < 1.0:
            self._function(1.0)


@dataclass(frozen=True)
class _Entered:
    """Work that a thread is in.

    Attributes:
        what: its name.
        advance: takes the fraction done.
        work: the shown work; None for work that shows nothing, or that its caller shows.
    """

    what: str
    advance: Advance
    work: _Work | None = None


class _Threads(threading.local):
    """The works that each thread is in, the outermost first."""

    def __init__(self) -> None:
        """Begin without works, once in each thread."""
        self.works: list[_Entered] = []


_progress_thread = _ProgressThread()
_threads = _Threads()
_last: dict[str, tuple[float, float]] = {}
"""Word of `FOLLOWED` -> when the first of those that follow each other began and the last
ended: one kernel compiles after another."""


def _forget() -> None:
    """Begin anew in a forked process, where no thread but one lives."""
    global _progress_thread, _threads
    _progress_thread = _ProgressThread()
    _threads = _Threads()


os.register_at_fork(after_in_child=_forget)


@contextmanager
def shown_work(what: str, progress: Progress = None) -> Iterator[Advance]:
    """Show the work that goes on inside the context, from when it has taken `SILENT_S`.

    Within other work only its name is shown, with that one's bar.

    Args:
        what: its name, such as "calibrating". Work of the same name within it is the same
            work.
        progress: a function that gets the fraction done instead, with the end in any case
            unless there is an error; False shows nothing; None shows it.

    Yields:
        The function that takes the fraction done, 0 to 1.
    """
    works = _threads.works
    if callable(progress):
        own = _Told(progress)
        with _entered(works, _Entered(what, own.advance)):
            yield own.advance
        own.end()
    elif works and works[-1].what == what:
        yield works[-1].advance
    elif works or progress is False:
        with _entered(works, _Entered(what, ignore)), _renamed(works[0].work, what):
            yield ignore
    else:
        with (
            _show_until_end(what) as work,
            _entered(works, _Entered(what, work.advance, work)),
        ):
            yield work.advance


@contextmanager
def _show_until_end(what: str) -> Iterator[_Work]:
    """Show a work from `SILENT_S` on until the context ends, and log the time it took.

    Work of a kind in `FOLLOWED` that begins within `SILENT_S` of the last one's end is
    shown as one with it.

    Args:
        what: name; its first word is its kind.
    """
    kind = what.split(" ", maxsplit=1)[0]
    now = time.monotonic()
    begun = now
    ended = now
    if kind in FOLLOWED:
        begun, ended = _last.get(kind, (now, now))
    if now > ended + SILENT_S:
        begun = now
    work = _Work(what, begun, max(now, begun + SILENT_S))
    _progress_thread.add(work)
    try:
        yield work
    finally:
        _progress_thread.remove(work)
        work.end()
        _last[kind] = begun, time.monotonic()
        LOG.info("flexdt: %s took %.2f s", what, time.monotonic() - now)


@contextmanager
def _entered(works: list[_Entered], one: _Entered) -> Iterator[None]:
    """Append a work to this thread's works within the context, as the innermost one."""
    works.append(one)
    try:
        yield
    finally:
        works.remove(one)


@contextmanager
def _renamed(outer: _Work | None, what: str) -> Iterator[None]:
    """Show a work with the name of one within it until the context ends, also after an
    error; nothing for None.
    """
    if outer is None:
        yield
        return
    before = outer.inner
    outer.inner = what
    try:
        yield
    finally:
        outer.inner = before


@contextmanager
def silence_shown(what: str) -> Iterator[Callable[[], None]]:
    """Show that a program works, from `SILENT_S` on until its first output or the end of
    the context.

    While this thread shows other work, that is shown instead.

    Args:
        what: name of the program's work.

    Yields:
        A function that ends this, to be called before the first output.
    """
    works, now = _threads.works, time.monotonic()
    work = _Work(what, now, now + SILENT_S, covered=lambda: bool(works))
    left = [work]

    def end() -> None:
        """Show it no longer; a second call does nothing."""
        if left:
            _progress_thread.remove(left.pop())
            work.end()

    _progress_thread.add(work)
    try:
        yield end
    finally:
        end()
