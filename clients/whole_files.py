"""Files that appear under their name only when they are whole, and room for them."""

from __future__ import annotations

import shutil
from pathlib import Path


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; one of that name is replaced as a whole."""
    part = path.with_name(path.name + ".part")
    try:
        part.write_bytes(content.encode() if isinstance(content, str) else content)
        part.replace(path)
    finally:  # a disk that is full leaves no part
        part.unlink(missing_ok=True)


def nearest_there(path: Path) -> Path:
    """`path` if it is there, else the nearest folder above it that is."""
    there = path.absolute()
    while not there.exists():
        there = there.parent
    return there


def free_bytes(path: Path) -> int:
    """Bytes free where `path` is, or will be."""
    return shutil.disk_usage(nearest_there(path)).free
