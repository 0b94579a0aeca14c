"""Files that appear under their final name only when whole, inside one folder and nowhere else.

A file is written under a temporary name in the same folder, flushed to the disk, and renamed; all
of it relative to the folder's own descriptor where the system can, so that a link planted meanwhile
is never followed. Only plain names are accepted. The classes may be used from several threads.
"""

from __future__ import annotations

import errno
import itertools
import os
import stat
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

from flexdt.twin.dataset.dataset_errors import DatasetNameError, DatasetWriteError, DiskFullError
from flexdt.twin.dataset.file_names import plain_name

TEMPORARY: Final = ".part-"
"""Prefix of temporary names; no plain name starts with a dot, so they never collide."""

_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_RELATIVE: Final = {os.open, os.unlink, os.rename} <= os.supports_dir_fd
_NO_FOLLOW: Final = getattr(os, "O_NOFOLLOW", 0)
_BINARY: Final = getattr(os, "O_BINARY", 0)

Write = Callable[[int, memoryview], int]


@contextmanager
def writing(path: Path, refused: str) -> Iterator[None]:
    """Turn the system's refusals inside into `DatasetWriteError`, of a full disk `DiskFullError`.

    Args:
        path: of what is written.
        refused: what cannot be done, for the message.
    """
    try:
        yield
    except OSError as error:
        kind = DiskFullError if error.errno in _NO_ROOM else DatasetWriteError
        raise kind(
            f"{refused}: {error.strerror or error}", {"path": str(path), "errno": error.errno}
        ) from None


def write_some(fd: int, data: memoryview) -> int:
    """Write to a descriptor; returns how many bytes it took."""
    return os.write(fd, data)


class AtomicFolder:
    """A folder to put whole files into.

    Args:
        path: the folder; it must exist and be no link.
        sync: flush every file to the disk before it gets its name; without it a power cut may
            leave an empty file, a killed process never does.
        write: writes bytes to a descriptor and returns how many (tests let it fail).

    Raises:
        DatasetWriteError: there is no such folder.
    """

    def __init__(self, path: Path, *, sync: bool = True, write: Write = write_some) -> None:
        self.path, self._sync, self._write = path, sync, write
        self._counter = itertools.count()
        self._busy = 0
        self._idle = threading.Condition()
        flags = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | _NO_FOLLOW
        with writing(path, f"cannot use folder {path}"):
            self._fd: int | None = os.open(path, flags) if _RELATIVE else None

    def put(self, name: str, data: bytes | memoryview) -> None:
        """Write a file; one of that name is replaced as a whole.

        Args:
            name: plain file name.
            data: its content.

        Raises:
            DatasetNameError: the name is not plain.
            DiskFullError: no room; nothing is left behind.
            DatasetWriteError: any other refusal of the system.
        """
        plain_name(name)
        # The thread's name, too: others may have objects of their own for the same folder.
        temporary = f"{TEMPORARY}{os.getpid()}-{threading.get_native_id()}-{next(self._counter)}"
        with self._idle:
            self._busy += 1
        try:
            self._store(temporary, name, memoryview(data).cast("B"))
        except OSError as error:
            with suppress(OSError):
                os.unlink(self._at(temporary), dir_fd=self._fd)
            raise self._failed(name, error, memoryview(data).nbytes) from None
        finally:
            with self._idle:
                self._busy -= 1
                self._idle.notify_all()

    def names(self) -> set[str]:
        """Names of the whole, regular files in it."""
        with os.scandir(self.path) as entries:
            return {
                e.name
                for e in entries
                if not e.name.startswith(".") and e.is_file(follow_symlinks=False)
            }

    def sweep(self) -> int:
        """Delete what killed writers left behind; returns how many files that was."""
        with os.scandir(self.path) as entries:
            stale = [e.name for e in entries if e.name.startswith(TEMPORARY)]
        for name in stale:
            with suppress(OSError):
                os.unlink(self._at(name), dir_fd=self._fd)
        return len(stale)

    def sync(self) -> None:
        """Make the names safe: until then a power cut may undo the last changes of the folder.

        Raises:
            DatasetWriteError: the system refuses.
        """
        if self._fd is None:  # this system has no descriptors of folders
            return
        with writing(self.path, f"cannot write {self.path}"):
            os.fsync(self._fd)

    def close(self) -> None:
        """Give the folder's descriptor back, once no file is being written."""
        with self._idle:
            self._idle.wait_for(lambda: self._busy == 0)
            if self._fd is not None:
                os.close(self._fd)
                self._fd = None

    def __enter__(self) -> AtomicFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _store(self, temporary: str, name: str, data: memoryview) -> None:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | _NO_FOLLOW | _BINARY
        try:
            fd = os.open(self._at(temporary), flags, 0o644, dir_fd=self._fd)
        except FileExistsError:  # left by a killed writer with the same numbers, as in a container
            os.unlink(self._at(temporary), dir_fd=self._fd)
            fd = os.open(self._at(temporary), flags, 0o644, dir_fd=self._fd)
        try:
            while data.nbytes:
                data = data[self._write(fd, data) :]
            if self._sync:
                os.fsync(fd)
        finally:
            os.close(fd)
        os.replace(self._at(temporary), self._at(name), src_dir_fd=self._fd, dst_dir_fd=self._fd)

    def _at(self, name: str) -> str:
        if _RELATIVE:
            if self._fd is None:
                raise OSError(errno.EBADF, "the folder has been closed")
            return name
        return str(self.path / name)

    def _failed(self, name: str, error: OSError, size: int) -> DatasetWriteError:
        path = str(self.path / name)
        data = {"path": path, "bytes": size, "errno": error.errno, "free": free_bytes(self.path)}
        if error.errno in _NO_ROOM:
            free = "" if data["free"] is None else f", {data['free']} bytes free"
            return DiskFullError(f"no room for {path}: {size} bytes asked{free}", data)
        return DatasetWriteError(f"cannot write {path}: {error.strerror or error}", data)


def free_bytes(path: Path) -> int | None:
    """Bytes free for this user on the disk of `path`; None where the system does not say."""
    try:
        usage = os.statvfs(path)
    except (OSError, AttributeError):
        return None
    return usage.f_bavail * usage.f_frsize


def make_folder(root: Path, name: str) -> Path:
    """Make (or find) the folder `name` directly inside `root`.

    Args:
        root: the data directory; made if missing.
        name: plain name.

    Returns:
        Its path.

    Raises:
        DatasetNameError: the name is not plain, or a link stands there.
        DatasetWriteError: it cannot be made.
    """
    path = root / plain_name(name, "data set")
    with writing(path, f"cannot make {path}"):
        root.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            path.mkdir()
            with AtomicFolder(root) as parent:
                parent.sync()
        mode = os.lstat(path).st_mode
    if not stat.S_ISDIR(mode):
        raise DatasetNameError(
            f"{path} is a link or a file; nothing is written through it", {"path": str(path)}
        )
    return path


def probe(root: Path) -> None:
    """Check that files can be written into the data directory.

    Raises:
        DatasetWriteError: they cannot; says why.
    """
    with writing(root, f"the data directory {root} cannot be written"):
        root.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=root):
            pass
