"""A lock that lets one server at a time use a data directory.

The system releases it when its holder dies, however that happens, so a file left behind by a killed
process never keeps the next one out.
"""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from flexdt.server.files.atomic import writing
from flexdt.twin.dataset.dataset_errors import DatasetWriteError

FILE = ".lock"


class FolderLock:
    """The lock of a data directory, held until `release` or the end of the process.

    Args:
        root: the data directory, which must exist.

    Raises:
        DatasetWriteError: another process holds it, named in the message, or the lock file cannot
            be opened.
    """

    def __init__(self, root: Path) -> None:
        path = root / FILE
        with writing(root, f"cannot lock {root}"):
            self._fd: int | None = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        try:
            _lock(self._fd)
        except OSError:
            holder = os.read(self._fd, 20).decode("ascii", "replace").strip()
            self.release()
            raise DatasetWriteError(
                f"the data directory {root} is used by another twin server (process {holder})",
                {"path": str(root), "allowed": "another --data"},
            ) from None
        with suppress(OSError):  # the number is for people: a full disk does not matter
            os.ftruncate(self._fd, 0)
            os.write(self._fd, f"{os.getpid()}\n".encode())  # Windows has no os.pwrite

    def release(self) -> None:
        """Release the lock."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None


def _lock(fd: int) -> None:
    """Take the lock or raise OSError at once; without effect where the system has none."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
