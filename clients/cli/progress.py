"""Progress of a long job: a bar with the time left on a terminal, plain lines elsewhere.

Everything goes to standard error, so that standard output holds the result alone.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from flexdt.clients.cli.console import duration, note

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

PLAIN_INTERVAL_S = 5.0


class ProgressBar:
    """A context manager; call `update` as often as you like.

    Args:
        title: what is going on.
        unit: what is counted, e.g. "frames".
        clock: seconds, monotonic (an argument for tests).
        terminal: draw a bar; None asks standard error.
    """

    def __init__(
        self,
        title: str,
        unit: str = "frames",
        *,
        clock: Callable[[], float] = time.monotonic,
        terminal: bool | None = None,
    ) -> None:
        self._title, self._unit, self._clock = title, unit, clock
        self._terminal = sys.stderr.isatty() if terminal is None else terminal
        self._bar: Progress | None = None
        self._task: TaskID | None = None
        self._begun = self._spoken = clock()
        self._last: tuple[float, float] | None = None

    def __enter__(self) -> ProgressBar:
        if self._terminal:
            from rich.console import Console
            from rich.progress import (
                BarColumn,
                MofNCompleteColumn,
                Progress,
                TextColumn,
                TimeElapsedColumn,
                TimeRemainingColumn,
            )

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn(self._unit),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
                console=Console(stderr=True),
                transient=False,
            )
            self._bar.start()
            self._task = self._bar.add_task(self._title, total=None)
        else:
            note(f"{self._title} ...")
        return self

    def update(self, done: float, total: float | None, text: str | None = None) -> None:
        """Report `done` of `total`; `text` replaces the title."""
        if self._bar is not None and self._task is not None:
            self._bar.update(
                self._task, completed=done, total=total, description=text or self._title
            )
            return
        now = self._clock()
        if now - self._spoken < PLAIN_INTERVAL_S or (done, total or 0.0) == self._last:
            return
        self._spoken, self._last = now, (done, total or 0.0)
        note(self._line(text or self._title, done, total, now - self._begun))

    def _line(self, text: str, done: float, total: float | None, elapsed: float) -> str:
        if not total:
            return f"{text}: {done:g} {self._unit}"
        counted = f"{done:g} of {total:g} {self._unit} " if float(done).is_integer() else ""
        line = f"{text}: {counted}({100 * done / total:.0f} %)"
        if 0 < done < total:
            line += f", about {duration(elapsed * (total - done) / done)} left"
        return line

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
