"""A directory that is reached by its descriptor, so that no link below it is ever followed.

The path of the topmost directory belongs to its owner, who may use links in it.
Everything below is opened one component after the other, relative to the descriptor of
the directory above it: a link that is planted there, even between two calls, is an error
that names it or an entry like any other. Only regular files are opened.

A file is written under a temporary name, flushed to the disk, and renamed, so that it
appears under its own name only when complete. All methods may be called from several
threads. Systems that open no directories (Windows) get paths instead.
"""

from __future__ import annotations

import errno
import io
import itertools
import os
import stat
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, Final

from flexdt.message_words import reason_of
from flexdt.twin.dataset import dataset_errors as ds
from flexdt.twin.dataset.file_names import plain_name

TEMPORARY: Final = ".part-"
"""Prefix of temporary names; no plain name starts with a dot, so they never collide."""
BEFORE: Final = ".before-"
"""Prefix of the name under which a replaced file is kept until the change is complete."""
MAX_READ_BYTES: Final = 256 << 20
"""Largest file that is read as a whole, where its size is not known [bytes].

The record of a scan of 200 000 poses has about 50 MB; a sparse file may claim any size.
"""
CGROUP_LIMIT: Final = Path("/sys/fs/cgroup/memory.max")
CGROUP_USED: Final = Path("/sys/fs/cgroup/memory.current")
CGROUP_STATISTICS: Final = Path("/sys/fs/cgroup/memory.stat")
MEMORY_INFORMATION: Final = Path("/proc/meminfo")
FALLBACK_MEMORY_BYTES: Final = 4 << 30
"""Memory assumed where the system does not report it (Windows) [bytes]."""

_NO_ROOM: Final = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_RELATIVE: Final = hasattr(os, "O_DIRECTORY")
_DIRECTORY: Final = (
    os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
)
_NO_FOLLOW: Final = getattr(os, "O_NOFOLLOW", 0)
_BINARY: Final = getattr(os, "O_BINARY", 0)
_READ: Final = os.O_RDONLY | _NO_FOLLOW | _BINARY | getattr(os, "O_NONBLOCK", 0)
_WRITE: Final = os.O_RDWR | _NO_FOLLOW | _BINARY
_NEW: Final = os.O_RDWR | os.O_CREAT | os.O_EXCL | _NO_FOLLOW | _BINARY
_TEMPORARY_NUMBERS: Final = itertools.count()

Write = Callable[[int, memoryview], int]


@contextmanager
def writing(path: Path, refused: str) -> Iterator[None]:
    """Convert an OSError in the context to `DatasetWriteError`, or `DiskFullError`.

    `refused`: the failed operation, for the message.
    """
    try:
        yield
    except OSError as error:
        kind = ds.DiskFullError if error.errno in _NO_ROOM else ds.DatasetWriteError
        raise kind(
            f"{refused}: {reason_of(error)}",
            {"path": str(path), "errno": error.errno},
        ) from None


def write_some(fd: int, data: memoryview) -> int:
    """Write to a descriptor; return how many bytes it took."""
    return os.write(fd, data)


class Directory:
    """A directory, held open until `close`.

    Args:
        path: of the directory; it must exist.
        sync: flush every file to the disk before it gets its name; without it a power cut
            may leave an empty file, a killed process never does.
        write: writes bytes to a descriptor and returns how many (tests let it fail).
        above: the directory it is in, see `folder`; None for the topmost.

    Raises:
        DatasetWriteError: there is no such directory.
    """

    def __init__(
        self,
        path: Path,
        *,
        sync: bool = True,
        write: Write = write_some,
        above: Directory | None = None,
    ) -> None:
        """Name a folder; the topmost one (`above` None) is opened now where the system
        can.

        `sync` waits for the disk at each file, `write` is the function that writes some
        bytes. A folder below another (`above`) is opened at each call, until `held`.

        Raises:
            DatasetError: it cannot be opened.
        """
        self.path = path
        self._above = above
        self._sync = sync
        self._write = write
        self._fd: int | None = None
        self._closed = False
        self._busy = 0
        self._idle = threading.Condition()
        if above is None and _RELATIVE:
            with writing(path, f"cannot use folder {path}"):
                self._fd = os.open(path, _DIRECTORY)

    def folder(
        self, name: str, *, sync: bool = True, write: Write = write_some
    ) -> Directory:
        """Return the directory called `name` in this one, which need not exist yet.

        It is opened for every call, unless it is `held`."""
        return Directory(self.path / name, sync=sync, write=write, above=self)

    def fileno(self) -> int | None:
        """Return the descriptor of one that is held open; None on a system without."""
        return self._fd

    def held(self) -> Directory:
        """Hold a folder below another open until `close`, whatever its name is then.

        Raises DatasetWriteError: none, or a link.
        """
        assert self._above is not None
        with writing(self.path, f"cannot use folder {self.path}"):
            self._fd = self._open_below(self._above)
            self._above = None
        return self

    def make(self) -> None:
        """Make a folder below another if it is missing, and wait for the disk; nothing
        for the topmost folder.

        Raises:
            DatasetNameError: a link or a file is in its place.
            DatasetWriteError: the system refuses.
        """
        if self._above is None:
            return
        with (
            writing(self.path, f"cannot make {self.path}"),
            self._above._opened() as above,
        ):
            try:
                os.mkdir(self._above._at(self.path.name), dir_fd=above)
            except FileExistsError:
                if self._above.is_directory(self.path.name):
                    return
                raise ds.DatasetNameError(
                    f"{self.path} is a link or a file; nothing is written through it",
                    {"path": str(self.path)},
                ) from None
            self._above.sync()

    def put(self, name: str, data: bytes | memoryview) -> None:
        """Write a file; a file or a link of that name is replaced as a whole.

        Raises DatasetNameError: no plain name (or of `BEFORE`); DiskFullError;
        DatasetWriteError.
        """
        if not name.startswith(BEFORE):
            plain_name(name)
        try:
            with self._opened() as fd:
                self._store(fd, name, memoryview(data).cast("B"))
        except OSError as error:
            raise self._failed(name, error, memoryview(data).nbytes) from None

    def keep(self, name: str, data: bytes) -> None:
        """Write like `put`, in a directory that is made if missing; safe when this returns."""
        self.make()
        self.put(name, data)
        self.sync()

    def overwrite(self, name: str, data: bytes) -> None:
        """Write the first bytes of an existing file in place, flushed to the disk.

        Raises OSError: no such regular file, or refused.
        """
        file = self._open_in_place(name)
        try:
            left = memoryview(data)
            while left.nbytes:
                left = left[self._write(file, left) :]
            os.fsync(file)
        finally:
            os.close(file)

    def open_in_place(self, name: str) -> io.FileIO:
        """Open a regular file, unbuffered, to be overwritten in place; a link is not
        followed.

        Raises:
            OSError: there is no such regular file, or the system refuses.
        """
        return io.FileIO(self._open_in_place(name), "r+")

    def _open_in_place(self, name: str) -> int:
        """Return the descriptor of `open_in_place`, which the caller closes."""
        with self._opened() as fd:
            file = os.open(self._at(name), _WRITE, dir_fd=fd)
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(errno.EINVAL, "it is no regular file", str(self.path / name))
        return file

    def allocate(self, name: str, size: int) -> None:
        """Make a file of `size` bytes whose blocks are reserved on the disk, in place of
        its namesake.

        The namesake is deleted first, also if this fails. The bytes are zeros.

        Args:
            name: of the file.
            size: [bytes].

        Raises:
            OSError: the system refuses, as for want of room; then there is no such file.
        """
        with self._opened() as fd:
            with suppress(FileNotFoundError):
                os.unlink(self._at(name), dir_fd=fd)
            file = os.open(self._at(name), _NEW, 0o644, dir_fd=fd)
            try:
                try:
                    _allocate(file, size)
                    os.fsync(file)
                finally:
                    os.close(file)
            except OSError:
                with suppress(OSError):
                    os.unlink(self._at(name), dir_fd=fd)
                raise

    def nameless(self) -> BinaryIO:
        """Make an open file without a name, for reading and writing, unbuffered; it is gone when
        it is closed or its process ends.

        Raises OSError: the system refuses.
        """
        with self._opened() as fd:
            name, file = self._temporary(fd, 0o600, getattr(os, "O_TEMPORARY", 0))
            if _RELATIVE:
                os.unlink(name, dir_fd=fd)
        return os.fdopen(file, "w+b", buffering=0)

    def open(self, name: str) -> BinaryIO:
        """Open a regular file for reading; a link is not followed.

        Args:
            name: of the file.

        Returns:
            The binary file, which the caller closes.

        Raises:
            FileNotFoundError: there is none.
            OSError: it is no regular file, or cannot be opened.
        """
        with self._opened() as fd:
            try:
                file = os.open(self._at(name), _READ, dir_fd=fd)
            except OSError as error:
                if error.errno != errno.ELOOP:
                    raise
                raise OSError(
                    error.errno, "it is a link", str(self.path / name)
                ) from None
        if not stat.S_ISREG(os.fstat(file).st_mode):
            os.close(file)
            raise OSError(errno.EINVAL, "it is no regular file", str(self.path / name))
        return open(
            name, "rb", opener=lambda *_: file
        )  # some readers want to know a name

    def read(self, name: str, most: int = MAX_READ_BYTES) -> bytes:
        """Read a regular file of at most `most` bytes; a link is not followed.

        Raises:
            OSError: as `open`, or it has more.
        """
        with self.open(name) as file:
            size = os.fstat(file.fileno()).st_size
            if size > most:
                what = f"it has {size} bytes, {most} allowed"
                raise OSError(errno.EFBIG, what, str(self.path / name))
            return file.read(size)

    def link(self, name: str, second: str, to: Directory | None = None) -> None:
        """Give a file a second name, here or in another directory; links are not
        followed.

        Raises OSError: no such file, the name is taken, or no links.
        """
        target = self if to is None else to
        with self._opened() as fd, target._opened() as other:
            names = self._at(name), target._at(second)
            os.link(*names, src_dir_fd=fd, dst_dir_fd=other, follow_symlinks=False)

    def rename(self, name: str, new: str) -> None:
        """Rename an entry, replacing one of the new name. Raises OSError: there is none, or the
        system refuses."""
        with self._opened() as fd:
            os.replace(self._at(name), self._at(new), src_dir_fd=fd, dst_dir_fd=fd)

    def unlink(self, name: str) -> None:
        """Delete an entry that is no directory. Raises OSError: there is none, or the system
        refuses."""
        with self._opened() as fd:
            os.unlink(self._at(name), dir_fd=fd)

    def discard(self, *names: str) -> None:
        """Delete entries that are no directories, and wait for the disk once; a missing
        one is no error.

        Raises:
            DatasetWriteError: the system refuses one; later ones stay.
        """
        gone = False
        for name in names:
            refused = writing(self.path / name, f"cannot delete {self.path / name}")
            with refused, suppress(FileNotFoundError, NotADirectoryError):
                self.unlink(name)
                gone = True
        if gone:
            self.sync()

    def stat(self, name: str) -> os.stat_result | None:
        """Return the status of an entry, of a link itself.

        Returns None if there is no such entry or folder. Raises OSError: the system
        refuses for another reason.
        """
        try:
            with self._opened() as fd:
                return os.stat(self._at(name), dir_fd=fd, follow_symlinks=False)
        except (FileNotFoundError, NotADirectoryError):
            return None

    def is_directory(self, name: str) -> bool:
        """Return whether `name` is a directory and no link to one."""
        about = self.stat(name)
        return about is not None and stat.S_ISDIR(about.st_mode)

    @contextmanager
    def entries(self) -> Iterator[Iterator[os.DirEntry[str]]]:
        """Open the listing of everything in the directory, hidden and temporary names
        included, as `os.scandir`; closed with the context.

        Raises:
            OSError: there is no such directory.
        """
        with self._opened() as fd:
            if fd is None:
                with os.scandir(self.path) as found:
                    yield found
                return
            own_fd = os.open(
                ".", _DIRECTORY, dir_fd=fd
            )  # with a place in the listing of its own
            try:
                with os.scandir(own_fd) as found:
                    yield found
            finally:
                os.close(own_fd)

    def names(self) -> set[str]:
        """List the names of the regular files in it but hidden (also temporary) ones;
        links and folders are left out.

        Returns:
            The names; empty if there is no such directory.
        """
        with suppress(FileNotFoundError, NotADirectoryError), self.entries() as entries:
            return {
                e.name
                for e in entries
                if not e.name.startswith(".") and e.is_file(follow_symlinks=False)
            }
        return set()

    def sweep(self, left: Sequence[str] = (TEMPORARY, BEFORE)) -> None:
        """Delete the files that killed writers left, whose names begin with one of
        `left`; those that cannot be deleted stay.
        """
        with suppress(OSError), self.entries() as entries:
            stale = [e.name for e in entries if e.name.startswith(tuple(left))]
            for name in stale:
                with suppress(OSError):
                    self.unlink(name)

    def sync(self) -> None:
        """Make the last changes of names safe from a power cut. Raises DatasetWriteError:
        the system refuses.
        """
        with writing(self.path, f"cannot write {self.path}"), self._opened() as fd:
            if fd is not None:
                os.fsync(fd)

    def close(self) -> None:
        """Wait until no call is under way, then close the descriptor, if it holds one;
        later calls raise OSError.
        """
        with self._idle:
            self._idle.wait_for(lambda: self._busy == 0)
            self._closed = True
            if self._fd is not None:
                os.close(self._fd)
                self._fd = None

    def __enter__(self) -> Directory:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __del__(self) -> None:
        self.close()

    @contextmanager
    def _opened(self) -> Iterator[int | None]:
        """Provide the directory's descriptor within the context, None on a system without
        such descriptors.

        A folder below another is opened for the context alone. A held one cannot be
        closed meanwhile.

        Raises:
            OSError: the folder has been closed, or cannot be opened.
        """
        if self._above is not None:
            fd = self._open_below(self._above)
            try:
                yield fd
            finally:
                if fd is not None:
                    os.close(fd)
            return
        with self._idle:
            if self._closed:
                raise OSError(errno.EBADF, "the folder has been closed")
            self._busy += 1
        try:
            yield self._fd
        finally:
            with self._idle:
                self._busy -= 1
                self._idle.notify_all()

    def _open_below(self, above: Directory) -> int | None:
        """Open this folder's descriptor below another, not through a link; None if
        unsupported.

        Raises OSError.
        """
        if not _RELATIVE:
            return None
        with above._opened() as fd:
            return os.open(above._at(self.path.name), _DIRECTORY | _NO_FOLLOW, dir_fd=fd)

    def _at(self, name: str) -> str:
        """Check that `name` is one component of a path; return it, or the whole path.

        Raises OSError. Descriptors need the name alone.
        """
        if name in ("", ".", "..") or "/" in name or "\0" in name:
            raise OSError(errno.EINVAL, "no name of an entry", name)
        if _RELATIVE:
            return name
        return str(self.path / name)

    def _temporary(self, fd: int | None, mode: int, flags: int = 0) -> tuple[str, int]:
        """Make a new file under an unused name that begins with `TEMPORARY`; names in use are
        skipped.

        `fd`: descriptor of the folder; None where the system has none. `mode`: permissions.
        `flags`: further flags of `os.open`.
        Returns the name and its open descriptor.
        Raises OSError: the system refuses.
        """
        while True:
            # Processes in containers may share a number, and killed ones leave files behind.
            number = (
                f"{os.getpid()}-{threading.get_native_id()}-{next(_TEMPORARY_NUMBERS)}"
            )
            name = self._at(f"{TEMPORARY}{number}")
            with suppress(FileExistsError):
                return name, os.open(name, _NEW | flags, mode, dir_fd=fd)

    def _store(self, fd: int | None, name: str, data: memoryview) -> None:
        """Write a file under a temporary name and rename it; nothing is left of a
        failure.

        With `sync` it is flushed before, the folder is not. `fd`: of the folder; None if
        unsupported. Raises OSError.
        """
        temporary, file = self._temporary(fd, 0o644)
        try:
            try:
                while data.nbytes:
                    data = data[self._write(file, data) :]
                if self._sync:
                    os.fsync(file)
            finally:
                os.close(file)
            os.replace(temporary, self._at(name), src_dir_fd=fd, dst_dir_fd=fd)
        except OSError:
            with suppress(OSError):
                os.unlink(temporary, dir_fd=fd)
            raise

    def _failed(self, name: str, error: OSError, size: int) -> ds.DatasetWriteError:
        """Convert a system error to DiskFullError or DatasetWriteError; returned, not
        raised.

        It has path, size, error number and free bytes (None if unknown).

        Args:
            name: of the file.
            error: of the system.
            size: of the file [bytes].
        """
        path = str(self.path / name)
        data = {
            "path": path,
            "bytes": size,
            "errno": error.errno,
            "free": free_bytes(self.path),
        }
        if error.errno in _NO_ROOM:
            free = ""
            if data["free"] is not None:
                free = f", {data['free']} bytes free"
            return ds.DiskFullError(f"no room for {path}: {size} bytes asked{free}", data)
        return ds.DatasetWriteError(f"cannot write {path}: {reason_of(error)}", data)


def _allocate(file: int, size: int) -> None:
    """Reserve `size` bytes for a new file, so that later writes need no room; on systems
    without `posix_fallocate` by writing zeros.
    """
    allocate = getattr(os, "posix_fallocate", None)
    if allocate is not None:
        allocate(file, 0, size)
        return
    zeros = memoryview(bytes(size))
    while zeros.nbytes:
        zeros = zeros[os.write(file, zeros) :]


def free_bytes(path: Path) -> int | None:
    """Return the bytes free for this user on a disk; None if unknown."""
    try:
        usage = os.statvfs(path)
    except (OSError, AttributeError):
        return None
    return usage.f_bavail * usage.f_frsize


def memory_bytes() -> int:
    """Return the machine's memory, or the container's limit if that is less [bytes].

    Where the system does not report it, it is `FALLBACK_MEMORY_BYTES`.
    """
    memory = FALLBACK_MEMORY_BYTES
    with suppress(AttributeError, ValueError):
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    with suppress(OSError, ValueError):  # no container, or none with a limit ("max")
        return min(memory, int(CGROUP_LIMIT.read_text(encoding="ascii")))
    return memory


def free_memory_bytes() -> int:
    """Estimate the memory that new work can have, cached files included [bytes]; in a
    container at most the rest of its limit.

    It is at least 0. Where the system does not report it (not Linux), it is half of the
    memory.
    """
    free = memory_bytes() // 2
    with suppress(OSError, ValueError, KeyError):
        free = 1024 * _fields(MEMORY_INFORMATION)["MemAvailable:"]
    with suppress(
        OSError, ValueError, KeyError
    ):  # no container, or none with a limit ("max")
        limit = int(CGROUP_LIMIT.read_text(encoding="ascii"))
        used = int(CGROUP_USED.read_text(encoding="ascii"))
        free = min(free, limit - used + _fields(CGROUP_STATISTICS)["inactive_file"])
    return max(free, 0)


def _fields(file: Path) -> dict[str, int]:
    """Parse a file of lines "name number ...": name -> first number; other lines are skipped."""
    lines = (line.split() for line in file.read_text(encoding="ascii").splitlines())
    return {
        words[0]: int(words[1])
        for words in lines
        if len(words) > 1 and words[1].isdigit()
    }


def open_data(root: Path) -> Directory:
    """Open a twin's data directory, made if missing, and check that it can be written.

    The caller closes it. A full disk is no error: state and jobs have room
    (`spare_files`). Raises DatasetWriteError.
    """
    refused = f"the data directory {root} cannot be written"
    with writing(root, refused):
        root.mkdir(parents=True, exist_ok=True)
        directory = Directory(root)
    with suppress(ds.DiskFullError), writing(root, refused):
        directory.nameless().close()
    return directory
