"""Output: results go to standard output, progress and warnings to standard error.

With `--json` standard output carries exactly one JSON document.

Progress of a long job is shown by `flexdt.runtime.progress`: a bar on a terminal, which makes
room for each line printed here, and log lines elsewhere.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Final, TextIO

from flexdt.twin.long_work import time_span

COMPLETION_VARIABLE: Final = "_FLEXDT_COMPLETE"
"""Variable of the environment by which a shell requests completions."""
QUIET: Final = frozenset({"-q", "--quiet"})
"""Options that show no progress."""
PROCESS_COMMANDS: Final = ("twin", "projector", "viewer", "gateway")
"""Commands that pass their words on to a process, `--help` among them."""
SERVERS: Final = ("up", *PROCESS_COMMANDS)
"""Commands that run until they are stopped."""


def speak(quiet: bool, verbose: bool) -> None:
    """Set what is told on standard error in addition to warnings and errors.

    `quiet`: no progress; `verbose`: slow steps with their duration, unless quiet, and
    libraries' messages.
    """
    if quiet or verbose:
        import logging

        logging.getLogger("flexdt.progress").setLevel(
            logging.ERROR if quiet else logging.INFO
        )
        if verbose:
            logging.basicConfig(level=logging.INFO, format="%(name)s: %(message)s")


def speaks() -> bool:
    """Return whether `--verbose` was asked for."""
    import logging

    return logging.getLogger("flexdt.progress").level == logging.INFO


def printable() -> None:
    """Set the terminal's streams to write unknown characters as escapes, without an error.

    Only streams of the text kind are changed, standard output and standard error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def hush(stream: TextIO) -> None:
    """Drop further output of a stream whose reader has ended."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


_silences: list[Callable[[], None]] = []
"""Called once, with the first words of a command."""


def _make_room() -> None:
    """End the display of a command without output, and take bars off the line to be
    printed on.
    """
    while _silences:
        _silences.pop()()
    progress = sys.modules.get("flexdt.runtime.progress")  # which costs time to import
    if progress is not None:
        progress.make_room()


@contextmanager
def waited_for(words: Sequence[str]) -> Iterator[None]:
    """Show on a terminal that a command works, until it prints something.

    Nothing is shown without a terminal or words, while the shell completes, of help,
    servers and quiet commands.
    """
    if not (words and sys.stderr.isatty()) or COMPLETION_VARIABLE in os.environ:
        yield
        return
    if words[0].startswith("-") or words[0] in SERVERS or QUIET & {*words}:
        yield
        return
    from flexdt.runtime.progress import silence_shown

    with silence_shown(f"at flexdt {words[0]}") as end:
        _silences.append(end)
        yield


def say(text: str = "", end: str = "\n") -> None:
    """Print text to standard output at once; a closed pipe silences the rest."""
    _make_room()
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        hush(sys.stdout)


def note(text: str) -> None:
    """Write a line to standard error at once; a closed pipe silences the rest."""
    _make_room()
    try:
        print(text, file=sys.stderr, flush=True)
    except BrokenPipeError:
        hush(sys.stderr)


def warn(texts: Iterable[str], about: object = None) -> None:
    """Write warnings to standard error, each after its subject. `about` is the subject, e.g. a
    file; None leaves it out. No texts, no output."""
    for text in texts:
        note(f"warning: {text}" if about is None else f"{about}: warning: {text}")


def emit(document: object) -> None:
    """Write the JSON document of `--json`."""
    say(as_json(document))


def as_json(document: object) -> str:
    """Convert a document to indented JSON; numbers that are not finite become null,
    arrays lists, and unknown objects text.

    Keys are field names, not aliases; the text has no final line end.
    """
    from pydantic_core import to_jsonable_python

    def plain(value: Any) -> object:
        if hasattr(value, "tolist"):
            return value.tolist()
        return str(value)

    known = to_jsonable_python(
        document, by_alias=False, inf_nan_mode="null", fallback=plain
    )
    return json.dumps(known, indent=2, allow_nan=False)


def table(rows: Iterable[Sequence[object]], header: Sequence[str] = ()) -> str:
    """Format rows and their header as text columns, padded to the widest cell; numbers
    are formatted by the caller.

    Empty rows are skipped; returns "" without any row. Columns are two blanks apart,
    left-aligned, without blanks at line ends; all rows must have as many cells as the
    first. Cells are converted by str.
    """
    every = [[str(cell) for cell in row] for row in (header, *rows) if row]
    if not every:
        return ""
    widths = [max(len(row[i]) for row in every) for i in range(len(every[0]))]
    lines = (
        "  ".join(
            cell.ljust(width) for cell, width in zip(row, widths, strict=True)
        ).rstrip()
        for row in every
    )
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """Format a time [s] for people: 3.2 s, 4 min 05 s, 2 h 03 min; "unknown" if not
    finite.
    """
    if not math.isfinite(seconds):
        return "unknown"
    if seconds < 60:
        return f"{seconds:.1f} s"
    return time_span(seconds)


def size(count: float) -> str:
    """Format a number of bytes for people, in units of 1000 up to TB: 12 B, 1.2 GB.

    Bytes are whole, other units have one decimal; larger sizes stay in TB.
    """
    for unit in ("B", "kB", "MB", "GB"):
        if abs(count) < 1000:
            if unit == "B":
                return f"{count:.0f} {unit}"
            return f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
