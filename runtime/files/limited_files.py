"""Read files from outside whole, within their row of the table of input limits."""

from __future__ import annotations

from pathlib import Path


def limited_bytes(path: Path, form: str) -> bytes:
    """Read a file of a format of `LIMITS`. Raises InputLimitError: it has more bytes than
    allowed; OSError: it cannot be read.
    """
    from flexdt.twin.input_limits import read_limited

    with path.open("rb") as file:
        return read_limited(file, form, str(path))


def limited_text(path: Path, form: str, encoding: str = "utf-8") -> str:
    """Read a text of a format of `LIMITS`; every line ends with a line feed alone.

    Raises:
        InputLimitError: it has more bytes than its format may have.
        OSError: it cannot be read.
        UnicodeDecodeError: it is not of this encoding.
    """
    text = limited_bytes(path, form).decode(encoding)
    return text.replace("\r\n", "\n").replace("\r", "\n")
