"""Draw a bar on a terminal or in a notebook, or write lines of the log."""

from __future__ import annotations

import html
import logging
import shutil
import sys
from typing import Any, Final, Protocol

WIDTH_CHARS: Final = 24
"""Characters of a bar on a terminal."""
NARROWEST_CHARS: Final = 20
"""Columns; a terminal with fewer counts as one of unknown width."""


class Shown(Protocol):
    """Work on a screen.

    Attributes:
        bar: whether it is drawn over and over in one place.
    """

    bar: bool

    def show(
        self, what: str, done: float | None, seconds: float, left_s: float | None
    ) -> None:
        """Draw it as it is now."""

    def close(self) -> None:
        """Take it away."""


def shown_on(log: logging.Logger) -> Shown:
    """Choose how work is shown: as log lines if the log has handlers, else as a bar in a
    notebook or a terminal, else as lines.

    Args:
        log: whose handlers a program may have set.
    """
    if log.hasHandlers():
        return Lines(log)
    if in_notebook():
        return NotebookBar()
    if sys.stderr is not None and sys.stderr.isatty():
        return TerminalBar()
    return Lines(log)


def in_notebook() -> bool:
    """Whether this process is the kernel of a notebook."""
    shell: Any = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return getattr(shell, "kernel", None) is not None


def time_words(done: float | None, seconds: float, left_s: float | None) -> str:
    """Format how far work is and how long it takes.

    Args:
        done: fraction; None if unknown.
        seconds: since it began.
        left_s: estimate of the time left [s]; None where there is none.

    Example:
        >>> time_words(0.25, 10.0, 30.0), time_words(None, 3.2, None)
        ('25 %, 10 s, about 30 s left', '3 s')
    """
    if done is None:
        return f"{seconds:.0f} s"
    done = min(max(done, 0.0), 1.0)
    text = f"{100 * done:.0f} %, {seconds:.0f} s"
    if left_s is not None:
        text += f", about {left_s:.0f} s left"
    return text


class Lines:
    """Write a line of the log each time."""

    bar = False

    def __init__(self, log: logging.Logger) -> None:
        """Show work as lines of a log."""
        self._log = log

    def show(
        self, what: str, done: float | None, seconds: float, left_s: float | None
    ) -> None:
        """Write a line at level warning: the work, its fraction, and seconds so far and left."""
        self._log.warning(
            "flexdt: still %s (%s)", what, time_words(done, seconds, left_s)
        )

    def close(self) -> None:
        """Leave the lines where they are."""


class TerminalBar:
    """Draw a bar in the last line of a terminal, on standard error."""

    bar = True

    def show(
        self, what: str, done: float | None, seconds: float, left_s: float | None
    ) -> None:
        """Draw the bar over the one drawn before.

        It is cut to the terminal's width, unless that is unknown or at most
        `NARROWEST_CHARS`.

        Args:
            what: name of the work.
            done: fraction, 0 to 1; None, if unknown, draws no bar.
            seconds: since the work began.
            left_s: time left [s]; None if unknown.
        """
        time = time_words(done, seconds, left_s)
        text = f"{what} {time}"
        if done is not None:
            full = round(WIDTH_CHARS * min(max(done, 0.0), 1.0))
            text = f"{what} [{'#' * full}{'.' * (WIDTH_CHARS - full)}] {time}"
        columns = shutil.get_terminal_size().columns
        kept = text
        if columns > NARROWEST_CHARS:
            kept = text[: columns - 1]
        self._write(f"\r\x1b[2K{kept}")

    def close(self) -> None:
        """Clear the line."""
        self._write("\r\x1b[2K")

    @staticmethod
    def _write(text: str) -> None:
        """Write to standard error and flush; errors (it is closed) are ignored."""
        try:
            sys.stderr.write(text)
            sys.stderr.flush()
        except (OSError, ValueError):
            return


class NotebookBar:
    """Draw a bar below the cell of a notebook, which goes when the work has ended."""

    bar = True

    def __init__(self) -> None:
        """Make a bar that has not been shown yet."""
        self._handle: Any = None

    def show(
        self, what: str, done: float | None, seconds: float, left_s: float | None
    ) -> None:
        """Draw the bar and its text in place of those drawn before.

        Args:
            what: name of the work.
            done: fraction, 0 to 1; None gives a bar without a value.
            seconds: since the work began.
            left_s: time left [s]; None if unknown.
        """
        value = ""
        if done is not None:
            value = f' value="{done:.3f}"'
        text = f"{html.escape(what)} {time_words(done, seconds, left_s)}"
        self._draw(
            f'<progress max="1"{value} aria-label="{html.escape(what)}"></progress> {text}'
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
