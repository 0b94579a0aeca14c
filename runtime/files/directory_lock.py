"""A lock that lets one server at a time use a data directory.

It is held on the directory itself, not on a file in it: there is nothing that somebody could delete
while a twin runs, or replace by a link beforehand. The system releases it when its holder dies,
however that happens.
"""

from __future__ import annotations

from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.dataset_errors import DatasetWriteError


class FolderLock:
    """The lock of a data directory, held until `release` or the end of the process.

    Without effect on Windows, where a directory cannot be opened.

    Args:
        root: the data directory.

    Raises:
        DatasetWriteError: another process holds it.
    """

    def __init__(self, root: Directory) -> None:
        self._root = root
        try:
            self._lock(exclusive=True)
        except BlockingIOError:
            raise DatasetWriteError(
                f"the data directory {root.path} is used by another twin server",
                {"path": str(root.path), "allowed": "another --data"},
            ) from None

    def release(self) -> None:
        """Release the lock."""
        self._lock(exclusive=False)

    def _lock(self, *, exclusive: bool) -> None:
        fd = self._root.fileno()
        if fd is None:  # Windows
            return
        import fcntl

        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB if exclusive else fcntl.LOCK_UN)
        except BlockingIOError:
            raise
        except OSError:  # a file system without locks
            pass
