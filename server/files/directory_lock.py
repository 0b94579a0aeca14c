"""A lock that lets one server at a time use a data directory.

It is held on the directory itself, not on a file in it: there is nothing that somebody could delete
while a twin runs, or replace by a link beforehand. The system releases it when its holder dies,
however that happens.
"""

from __future__ import annotations

import os
from pathlib import Path

from flexdt.server.files.atomic import writing
from flexdt.twin.dataset.dataset_errors import DatasetWriteError


class FolderLock:
    """The lock of a data directory, held until `release` or the end of the process.

    Without effect on Windows, where a directory cannot be opened.

    Args:
        root: the data directory, which must exist.

    Raises:
        DatasetWriteError: another process holds it, or the directory cannot be opened.
    """

    def __init__(self, root: Path) -> None:
        self._fd: int | None = None
        try:
            import fcntl
        except ImportError:  # Windows
            return
        with writing(root, f"cannot lock {root}"):
            self._fd = os.open(root, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise DatasetWriteError(
                f"the data directory {root} is used by another twin server",
                {"path": str(root), "allowed": "another --data"},
            ) from None
        except OSError:  # a file system without locks
            pass

    def release(self) -> None:
        """Release the lock."""
        if self._fd is not None:
            os.close(self._fd)
            self._fd = None
