"""Output: results go to standard output, progress and warnings to standard error.

With `--json` standard output carries exactly one JSON document.
"""

from __future__ import annotations

import io
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from typing import Any


def printable() -> None:
    """What the terminal's encoding cannot write comes out as an escape, not as an error."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def hush() -> None:
    """Discard further output: its reader has ended (`flexdt ... | head`)."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def say(text: str = "", end: str = "\n") -> None:
    """A line of the result, to standard output."""
    try:
        print(text, end=end, flush=True)
    except BrokenPipeError:
        hush()


def note(text: str) -> None:
    """Write a line of progress or a warning to standard error."""
    print(text, file=sys.stderr, flush=True)


def emit(document: object) -> None:
    """Write the JSON document of `--json`; numbers that are not finite become null."""
    say(json.dumps(plain(document), indent=2, allow_nan=False))


def plain(value: Any) -> Any:
    """Convert a value to JSON's types: numbers, text, lists and objects."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, str | bool | int) or value is None:
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if hasattr(value, "model_dump"):
        return plain(value.model_dump(mode="json"))
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, Sequence):
        return [plain(item) for item in value]
    return str(value)


def table(rows: Sequence[Sequence[str]], header: Sequence[str] = ()) -> str:
    """Text columns, padded; numbers are the caller's to format."""
    every = [tuple(header), *map(tuple, rows)] if header else [tuple(row) for row in rows]
    if not every:
        return ""
    widths = [max(len(row[i]) for row in every) for i in range(len(every[0]))]
    lines = (
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in every
    )
    return "\n".join(lines)


def duration(seconds: float) -> str:
    """A time span for people: 3.2 s, 4 min 05 s, 2 h 03 min."""
    if not math.isfinite(seconds):
        return "unknown"
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02d} min"


def size(count: float) -> str:
    """A number of bytes for people: 1.2 GB."""
    for unit in ("B", "kB", "MB", "GB"):
        if abs(count) < 1000:
            return f"{count:.0f} {unit}" if unit == "B" else f"{count:.1f} {unit}"
        count /= 1000
    return f"{count:.1f} TB"
