"""Room on the disk for large data: scans and uploads leave some for all that is small.

State, jobs and corrections are small and must be written. Large data are rejected before
they take the last room, so that only other programs can fill the disk; then state and
jobs are written into spare files (`runtime/files/spare_files.py`).
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Final

from flexdt.runtime.files.directory import Directory, free_bytes
from flexdt.twin.dataset.dataset_errors import DiskFullError

RESERVE_BYTES: Final = 16 << 20
"""Room that new scans and uploads leave free: for texts, documents and the file system."""
MIN_SETTLED_NS: Final = 2 * 10**9
"""Age from which a folder's time of change shows every change [ns]."""
LAST_BYTES: Final = 4 << 20
"""Room that each image and each part of an upload leaves free."""


@dataclass(frozen=True)
class _Seen:
    """State of a folder: its time of change, bytes of its own files, and its folders."""

    changed_ns: int
    nbytes: int
    folders: tuple[str, ...]


class UsedBytes:
    """How many bytes a directory holds; folders that have not changed are not read again.

    Args:
        root: the directory.
    """

    def __init__(self, root: Directory) -> None:
        """Count below `root`; nothing has been read yet."""
        self._root = root
        self._seen: dict[str, _Seen] = {}

    def count(self) -> int:
        """Sum up the bytes of all files in the directory and its folders; links are not
        followed.

        Folders that have not changed since the last call are not listed again.

        Returns the sum; 0 if the directory cannot be read.
        """
        with suppress(OSError):
            changed_ns = os.stat(self._root.fileno() or self._root.path).st_mtime_ns
            counted: dict[str, _Seen] = {}
            total = self._count(self._root, "", changed_ns, counted)
            self._seen = counted  # without folders that have gone
            return total
        return 0

    def _count(
        self, folder: Directory, name: str, changed_ns: int, there: dict[str, _Seen]
    ) -> int:
        """Sum up a folder and those in it, and record each in `there`; unchanged folders
        are not listed again.

        A folder is unchanged if its time of modification is, and is more than
        `MIN_SETTLED_NS` ago. Folders that have gone or cannot be read count 0.

        Args:
            folder: to be summed up.
            name: of the folder, relative to the directory, for `there`.
            changed_ns: its time of modification [ns].
            there: folder -> its listing; changed.

        Returns:
            Bytes.
        """
        seen = self._seen.get(name)
        # A change within the clock's grain does not show: a young folder is read again.
        old = time.time_ns() - changed_ns > MIN_SETTLED_NS
        if seen is None or seen.changed_ns != changed_ns or not old:
            seen = _read(folder, changed_ns)
        there[name] = seen
        total = seen.nbytes
        for inner in seen.folders:
            with suppress(OSError):  # it may have gone meanwhile
                about = folder.stat(inner)
                if about is not None:
                    below = folder.folder(inner)
                    total += self._count(
                        below, f"{name}/{inner}", about.st_mtime_ns, there
                    )
        return total


def _read(folder: Directory, changed_ns: int) -> _Seen:
    """Read the names of a folder's folders, and the sum of its files' sizes.

    Entries that cannot be read are skipped; links count with their own size.

    Args:
        folder: to be read, without what its folders contain.
        changed_ns: its time of modification [ns], kept with the result.
    """
    nbytes = 0
    folders = list[str]()
    with folder.entries() as entries:
        for entry in entries:
            with suppress(OSError):
                if entry.is_dir(follow_symlinks=False):
                    folders.append(entry.name)
                else:
                    nbytes += entry.stat(follow_symlinks=False).st_size
    return _Seen(changed_ns, nbytes, tuple(folders))


@dataclass(frozen=True)
class DiskRoom:
    """The disk of a data directory.

    Attributes:
        root: the data directory.
        quota: bytes that it may hold; None: no limit but the disk's.
    """

    root: Directory
    quota: int | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock, init=False, repr=False)

    @cached_property
    def _used(self) -> UsedBytes:
        return UsedBytes(self.root)

    def require(self, what: str, size: int, there: int = 0) -> None:
        """Check that the disk and the quota have room for `size` and `RESERVE_BYTES`.

        Nothing is checked without a quota where free space is unknown.

        Args:
            what: that is about to begin, for the message.
            size: bytes it takes.
            there: of these, bytes that are there already.

        Raises:
            DiskFullError: they have not; names the needed and the free room.
        """
        need = size + RESERVE_BYTES - there
        free = free_bytes(self.root.path)
        if self.quota is not None:
            with self._lock:
                left = max(0, self.quota - self._used.count())
            free = left if free is None else min(free, left)
        if free is not None and free < need:
            raise DiskFullError(
                f"{what} needs {need / 1e6:.1f} MB, of which {RESERVE_BYTES / 1e6:.1f} MB "
                f"are to stay free; {free / 1e6:.1f} MB are free in {self.root.path}",
                {"asked": need, "allowed": free, "path": str(self.root.path)},
            )


def require_last(folder: Path, what: str, size: int) -> None:
    """Check that writing leaves `LAST_BYTES` of room for the state.

    Nothing is checked where free space is unknown.

    `folder`: on the disk; `what`: that is to be written, for the message; `size`: its bytes.
    Raises DiskFullError: it does not.
    """
    free = free_bytes(folder)
    need = size + LAST_BYTES
    if free is not None and free < need:
        raise DiskFullError(
            f"no room for {what}: {size} bytes asked, {free} bytes free, of which "
            f"{LAST_BYTES} are "
            "kept for the state",
            {"path": str(folder / what), "bytes": need, "free": free},
        )
