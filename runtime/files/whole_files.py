"""Files that appear under their name only when they are complete, and room for them."""

from __future__ import annotations

import errno
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from flexdt.message_words import reason_of

NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Numbers of the system's errors where a disk or a quota is full."""
FULL_BYTES: Final = 64 << 10
"""Free bytes below which a disk is full for a library that gives no number with its error."""
OF_LIBRARIES: Final = re.compile(r"No space left|errno = (\d+)|requested and \d+ written")
"""Texts by which HDF5 (with the system's number), tifffile and NumPy report a refused write."""


def require_bytes(path: Path, needed: int) -> None:
    """Check that a disk has room for a file, before it is written.

    Raises OSError: ENOSPC, with path and both sizes.
    """
    free = free_bytes(path)
    if needed > free:
        problem = (
            f"{os.strerror(errno.ENOSPC)}: it takes {needed} bytes; {free} bytes are free"
        )
        raise OSError(errno.ENOSPC, problem, str(path))


@contextmanager
def room_named(path: Path) -> Iterator[None]:
    """Convert errors of a full disk, of any library, within the context to one OSError
    that names the requested file.

    An error of a known library text, or without a number while less than `FULL_BYTES` are
    free, counts as a full disk. An error that names another file is raised as it is.

    Args:
        path: requested file; the written one may be a temporary one beside it.

    Raises:
        OSError: of a full disk, with the system's number, `path` and the free bytes;
            another one with `path` and the system's own words.
        RuntimeError: of a library, for another reason.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        number = getattr(error, "errno", None)
        file = getattr(error, "filename", None)
        if file is not None and path.name not in Path(str(file)).name:
            raise  # another file, such as one that is read meanwhile
        free = free_bytes(path)
        words = OF_LIBRARIES.search(str(error))
        if number is None and words is not None:
            number = int(words[1] or errno.ENOSPC)
        if number is None and free < FULL_BYTES:
            number = errno.ENOSPC
        if number in NO_ROOM:
            problem = f"{os.strerror(number)}; {free} bytes are free"
            raise OSError(number, problem, str(path)) from None
        if number is None or not isinstance(error, OSError):
            raise
        raise OSError(number, reason_of(error), str(path)) from None


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a hidden path to write, which replaces `path` at the end.

    Raises OSError.
    """
    part = path.with_name(f".{path.name}.part")
    try:
        with room_named(path):
            yield part
            part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file, text as UTF-8; one of that name is replaced as a whole."""
    with whole_file(path) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def nearest_there(path: Path) -> Path:
    """Return `path`, made absolute, or the nearest folder above it that exists."""
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
