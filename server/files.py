"""Files that appear whole or not at all.

`file_stem` turns any name into one plain path component. It refuses to choose folders.
"""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from flexdt.twin.errors import LimitError

MAX_STEM = 180


def file_stem(name: str) -> str:
    """`name`, percent-encoded, as the stem of a file; different names give different stems.

    Raises:
        LimitError: it is too long for a file system.
    """
    stem = quote(name, safe=" ")
    if len(stem) > MAX_STEM:
        raise LimitError(
            f"the name {name[:40]!r}... is too long: {len(stem)} bytes encoded, {MAX_STEM} allowed",
            {"asked": len(stem), "allowed": MAX_STEM},
        )
    return stem


def write_atomically(path: Path, data: bytes) -> None:
    """Write `data` under a temporary name beside `path`, then give it its name.

    Raises:
        OSError: nothing appears under `path` (an older file there stays).
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise
