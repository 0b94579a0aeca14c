"""Files that appear under their name only when they are complete, and room for them."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a path to write; the file replaces `path` as a whole, and a
    failure leaves nothing."""
    part = path.with_name(f".{path.name}.part")
    try:
        yield part
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; one of that name is replaced as a whole."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def nearest_there(path: Path) -> Path:
    """Return `path` if it exists, else the nearest folder above it that does."""
    place = path.absolute()
    while not place.exists():
        place = place.parent
    return place


def bytes_of(path: Path) -> int:
    """Sum up the size of a file, or of all files in a folder, such as a volume
    in `.zarr` [bytes]."""
    files = (f for f in path.rglob("*") if f.is_file()) if path.is_dir() else iter([path])
    return sum(file.stat().st_size for file in files)


def free_bytes(path: Path) -> int:
    """Return the bytes free where `path` is, or will be."""
    return shutil.disk_usage(nearest_there(path)).free
