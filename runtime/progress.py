"""Show work that takes seconds: rows with bars on terminals (by rich), a bar in notebooks,
lines of the log elsewhere.

`shown_work` replaces `flexdt.twin.long_work.during` in a process with a clock; what is said,
and when, is decided there. Work that ends within two seconds shows nothing. Work within other
work of the same thread lends it its name only: there is one bar. Where a program handles the
records of the logger `flexdt`, it gets lines, not a bar; a level above WARNING of the logger
`flexdt.progress` silences both.
"""

from __future__ import annotations

import html
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from typing import Any, Final, Protocol, TextIO

from flexdt.twin import long_work
from flexdt.twin.long_work import (
    Course,
    Progress,
    Report,
    Rhythm,
    Told,
    WorkClock,
    ignore,
)

DRAWN_S: Final = 0.5
"""Time between two drawings of a bar [s]."""
LOG: Final = logging.getLogger("flexdt.progress")
"""Logs lines where there is no bar, and at INFO how long each work took."""


class Shown(Protocol):
    """Work on a screen.

    Attributes:
        bar: whether it is drawn over and over in one place.
    """

    bar: bool

    def show(self, what: str, done: float | None, times: str) -> None:
        """Draw it as it is now.

        Args:
            what: name of the work.
            done: fraction below 1; None if unknown.
            times: how far it is and how long it takes, in words.
        """

    def close(self) -> None:
        """Take it away."""


def shown_on(log: logging.Logger) -> Shown:
    """Choose how work is shown: as log lines if the log has handlers, else as a bar in a
    notebook or a terminal that can move its cursor, else as lines.

    Args:
        log: whose handlers a program may have set.
    """
    if log.hasHandlers():
        return Lines(log)
    if in_notebook():
        return NotebookBar()
    stream = standard_error()
    if stream is not None and stream.isatty():
        terminal = _Terminal.of(stream)
        if not terminal.dumb:
            return TerminalBar(terminal)
    return Lines(log)


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell: Any = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def standard_error() -> TextIO | None:
    """Return the stream that bars are drawn on; None without one."""
    return sys.stderr


class Lines:
    """Write a line of the log each time."""

    bar = False

    def __init__(self, log: logging.Logger) -> None:
        self._log = log

    def show(self, what: str, done: float | None, times: str) -> None:
        """Write a line at level warning."""
        self._log.warning("flexdt: still %s (%s)", what, times)

    def close(self) -> None:
        """Leave the lines where they are."""


class _Terminal:
    """Rows of bars at the bottom of a terminal, shared by all works of this process.

    Args:
        stream: of the terminal.
    """

    _current: _Terminal | None = None

    def __init__(self, stream: TextIO) -> None:
        """Prepare for a stream; nothing is drawn yet."""
        # Here, because most processes never draw a bar.
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Rows

        self.stream = stream
        console = Console(file=stream, force_jupyter=False)
        self.dumb = not console.is_terminal or console.is_dumb_terminal
        # Standard output and error are left alone: they are the program's, and another
        # thread draws. Whoever prints calls `make_room`.
        self._rows = Rows(
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.fields[times]}", markup=False),
            console=console,
            auto_refresh=False,
            transient=True,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        self._lock = threading.Lock()
        self._drawn = False

    @classmethod
    def of(cls, stream: TextIO) -> _Terminal:
        """Return the rows of a stream, the present ones if they are on it."""
        if cls._current is None or cls._current.stream is not stream:
            cls._current = cls(stream)
        return cls._current

    def draw(self, row: Any, what: str, done: float | None, times: str) -> Any:
        """Draw all rows, with new content of one of them.

        Args:
            row: its number; None for a new one.
            what, done, times: as for `Shown.show`.

        Returns:
            The number of the row.
        """
        total = None if done is None else 1.0
        share = done or 0.0
        with self._lock, suppress(OSError, ValueError):  # the stream may be closed
            if row is None:
                # Adding a row draws the others, which know nothing of this one yet.
                row = self._rows.add_task("", visible=False, times="")
            self._rows.update(
                row,
                description=what,
                total=total,
                completed=share,
                times=times,
                visible=True,
            )
            if not self._drawn:
                self._rows.start()
                # A program that is killed must not leave a terminal without a cursor.
                self._rows.console.show_cursor(True)
                self._drawn = True
            self._rows.refresh()
        return row

    def remove(self, row: Any) -> None:
        """Remove a row; the others are drawn again in time."""
        with self._lock:
            self._clear()
            self._rows.remove_task(row)

    def clear(self) -> None:
        """Hide all rows until `draw`."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        """Take all rows off the screen; the lock is held."""
        if self._drawn:
            self._drawn = False
            with suppress(OSError, ValueError):
                self._rows.stop()


class TerminalBar:
    """A row with a bar at the bottom of a terminal.

    Args:
        terminal: the rows.
    """

    bar = True

    def __init__(self, terminal: _Terminal) -> None:
        """Take a place among the rows, which is not drawn yet."""
        self._terminal = terminal
        self._row: Any = None

    def show(self, what: str, done: float | None, times: str) -> None:
        """Draw the row; without a fraction its bar pulses."""
        self._row = self._terminal.draw(self._row, what, done, times)

    def close(self) -> None:
        """Remove the row, if it was drawn."""
        if self._row is not None:
            self._terminal.remove(self._row)


class NotebookBar:
    """Draw a bar below the cell of a notebook, which goes when the work has ended."""

    bar = True

    def __init__(self) -> None:
        """Make a bar that has not been shown yet."""
        self._handle: Any = None

    def show(self, what: str, done: float | None, times: str) -> None:
        """Draw the bar and its text in place of those drawn before; None for `done` gives
        a bar without a value.
        """
        value = ""
        if done is not None:
            value = f' value="{done:.3f}"'
        name = html.escape(what)
        self._draw(
            f'<progress max="1"{value} aria-label="{name}"></progress> '
            f"{name} {html.escape(times)}"
        )

    def close(self) -> None:
        """Leave an empty place where the bar was; nothing if it was never shown."""
        if self._handle is not None:
            self._draw("")

    def _draw(self, markup: str) -> None:
        """Show HTML: as a new output the first time, later in its place."""
        from IPython.display import HTML, display

        if self._handle is None:
            self._handle = display(HTML(markup), display_id=True)  # type: ignore[no-untyped-call]
        else:
            self._handle.update(HTML(markup))  # type: ignore[no-untyped-call]


@dataclass(eq=False)
class _Work:
    """Work that goes on.

    Attributes:
        course: what is known of it.
        rhythm: when lines about it are written.
        due: when it is shown next [s].
        shown: the bar; None before it is drawn.
        lock: held while it is drawn or ended.
        ended: whether it has ended.
        covered: whether other work is shown in its place.
    """

    course: Course
    rhythm: Rhythm
    due: float
    shown: Shown | None = None
    lock: threading.Lock = field(default_factory=threading.Lock)
    ended: bool = False
    covered: Callable[[], bool] = lambda: False

    def report(self, done: float, detail: str = "", *, steady: bool = True) -> None:
        """Take the fraction that is done (`long_work.Report`)."""
        with _facts:
            self.course.report(done, detail, steady=steady, now_s=time.monotonic())

    def tell(self) -> None:
        """Draw the bar, or write a line if one is due, and set when to do so next.

        Nothing is shown if it has ended, while another work covers it, or if the log
        takes no warnings.
        """
        with self.lock:
            if self.ended or not LOG.isEnabledFor(logging.WARNING):
                return
            if self.covered():
                self._hide()
                return
            if self.shown is None:
                self.shown = shown_on(LOG)
            now = time.monotonic()
            if self.shown.bar or self.rhythm.write(now):
                self._show(self.shown, now)
            self.due = now + DRAWN_S if self.shown.bar else self.rhythm.due_s

    def _show(self, shown: Shown, now: float) -> None:
        """Draw the work on `shown` as it is now."""
        with _facts:
            percent = self.course.percent
            times = self.course.times(now)
        shown.show(self.course.title, None if percent is None else percent / 100.0, times)

    def end(self) -> None:
        """End the work and close its bar, if it is shown; later calls of `tell` show nothing."""
        with self.lock:
            self.ended = True
            self._hide()

    def _hide(self) -> None:
        """Take it off the screen."""
        if self.shown is not None:
            self.shown.close()
            self.shown = None


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
                    # Also for one that shows nothing now, which sets no later time itself.
                    work.due = now + long_work.LINE_INTERVALS_S[0]
            for work in due:
                work.tell()


@dataclass(frozen=True)
class _Entered:
    """Work that a thread is in.

    Attributes:
        what: its name.
        report: takes the fraction done.
        work: the shown work; None for work that shows nothing, or that its caller shows.
    """

    what: str
    report: Report
    work: _Work | None = None


class _Threads(threading.local):
    """The works that each thread is in, the outermost first."""

    def __init__(self) -> None:
        self.works: list[_Entered] = []


@dataclass(frozen=True)
class _Past:
    """The last work of a kind: when the first of those that follow each other began, when it
    ended itself, and when the next line is due."""

    begun_s: float
    ended_s: float
    rhythm: Rhythm


_facts = threading.Lock()
"""Held while courses and the clock change: several threads report to one work, and another
one reads."""
_clock = WorkClock()
_progress_thread = _ProgressThread()
_threads = _Threads()
_past: dict[str, _Past] = {}
"""Kind of work -> the last one of it."""


def _forget() -> None:
    """Begin anew in a forked process, where no thread but one lives."""
    global _clock, _facts, _progress_thread, _threads
    _clock = WorkClock()
    _facts = threading.Lock()
    _progress_thread = _ProgressThread()
    _threads = _Threads()
    _Terminal._current = None


os.register_at_fork(after_in_child=_forget)


@contextmanager
def shown_work(what: str, progress: Progress = None) -> Iterator[Report]:
    """Show the work that goes on inside the context, from when it has taken two seconds.

    Within other work only its name is shown, with that one's bar. While kernels compile,
    no work has an estimate of the time left.

    Args:
        what: its name, such as "calibrating". Work of the same name within it is the same
            work.
        progress: a function that gets the fraction done instead, with the end in any case
            unless there is an error; False shows nothing; None shows it.

    Yields:
        The function that takes the fraction done, 0 to 1.
    """
    works = _threads.works
    compiles = what.split(" ", maxsplit=1)[0] == long_work.COMPILING
    with _clock_stopped() if compiles else nullcontext():
        if callable(progress):
            told = Told(progress)
            with _entered(works, _Entered(what, told)):
                yield told
            told.end()
        elif works and works[-1].what == what:
            yield works[-1].report
        elif works or progress is False:
            with _entered(works, _Entered(what, ignore)), _renamed(works[0].work, what):
                yield ignore
        else:
            with (
                _show_until_end(what, long_work.COMPILING if compiles else what) as work,
                _entered(works, _Entered(what, work.report, work)),
            ):
                yield work.report


@contextmanager
def _clock_stopped() -> Iterator[None]:
    """Let the clock by which rates are measured stand still within the context."""
    with _facts:
        clock = _clock
        clock.stop(time.monotonic())
    try:
        yield
    finally:
        with _facts:
            clock.go_on(time.monotonic())


@contextmanager
def _show_until_end(what: str, kind: str) -> Iterator[_Work]:
    """Show a work until the context ends, and log the time it took.

    Works of a kind that follow each other within the time that shows nothing write lines as
    one work would. Kernels that compile one after another are one wait: it goes on from the
    begin of the first.

    Args:
        what: name.
        kind: what is remembered of it for the next one.
    """
    silent_s = long_work.LINE_INTERVALS_S[0]
    now = time.monotonic()
    begun = now
    rhythm = Rhythm.begun(now)
    past = _past.get(kind)
    if past is not None and now <= past.ended_s + silent_s:
        rhythm = past.rhythm.after(now)
        if kind == long_work.COMPILING:
            begun = past.begun_s
            rhythm = past.rhythm
    course = Course(what, begun, _clock)
    work = _Work(course, rhythm, max(now, begun + silent_s))
    _progress_thread.add(work)
    try:
        yield work
    finally:
        _progress_thread.remove(work)
        work.end()
        _past[kind] = _Past(begun, time.monotonic(), rhythm)
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
    before = outer.course.inner
    outer.course.inner = what
    try:
        yield
    finally:
        outer.course.inner = before


@contextmanager
def silence_shown(what: str) -> Iterator[Callable[[], None]]:
    """Show that a program works, until its first output or the end of the context.

    While this thread shows other work, that is shown instead.

    Args:
        what: name of the program's work.

    Yields:
        A function that ends this, to be called before the first output.
    """
    works, now = _threads.works, time.monotonic()
    rhythm = Rhythm.begun(now)
    work = _Work(
        Course(what, now, _clock), rhythm, rhythm.due_s, covered=lambda: bool(works)
    )
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


def make_room() -> None:
    """Take bars off the terminal for a line; they come back in time."""
    if _Terminal._current is not None:
        _Terminal._current.clear()
