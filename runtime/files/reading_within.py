"""Open files of data sets for reading, without links where strangers name the paths."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from flexdt.runtime.files.directory import Directory

_confined: Directory | None = None


@contextmanager
def confined(root: Directory) -> Iterator[None]:
    """Let this process read nothing through a link below `root` in the context.

    Strangers request paths of servers.
    """
    global _confined
    before = _confined
    _confined = root
    try:
        yield
    finally:
        _confined = before


def within(path: Path) -> Directory | None:
    """Return the directory at a path that is below the one that reading is `confined` to;
    nothing is looked up on the disk.

    Returns:
        The directory; None if reading is not confined or the path is elsewhere.
    """
    if _confined is None or not path.is_relative_to(_confined.path):
        return None
    directory = _confined
    for name in path.relative_to(_confined.path).parts:
        directory = directory.folder(name)
    return directory


def opened(path: Path) -> BinaryIO:
    """Open a file for reading; links are not followed if `confined`.

    Raises OSError.
    """
    folder = within(path.parent)
    if folder is None:
        return path.open("rb")
    return folder.open(path.name)
