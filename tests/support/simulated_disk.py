"""A disk that fails when it is told to: the n-th change of it, from then on, or by a power cut.

Between the servers' file operations and a real directory: every change (open to write, write,
fsync, rename, link, mkdir, unlink) is counted and noted in `ops`, and may fail with any error.
After a power cut only what was made safe is there for certain: a file's bytes since its fsync,
a name since its directory's; of the rest, directory by directory, the last changes are lost, as
many as drawn.
"""

from __future__ import annotations

import errno
import itertools
import os
import random
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal
from unittest import mock

Kind = Literal["open", "write", "fsync", "replace", "link", "unlink", "mkdir"]
NUMBERED = re.compile(r"(\.(?:part|before)-)([\d-]+)")
"""Temporary names of `runtime/files/directory.py`."""
TAKES_ROOM: tuple[Kind, ...] = ("open", "write", "link", "mkdir")
"""What a full disk refuses: new files, bytes beyond a file's end, and names that a directory
has not had (a name that it had leaves its place there)."""
REAL: dict[str, Callable[..., Any]] = {
    name: getattr(os, name)
    for name in ("open", "close", "write", "pwrite", "ftruncate", "fsync", "fdatasync", "replace",
                 "rename", "link", "unlink", "remove", "mkdir", "posix_fallocate")
}  # fmt: skip


@dataclass(frozen=True)
class Fault:
    """What goes wrong.

    Attributes:
        at: number of the change of the disk, from 0, since the fault was set.
        error: an errno; None cuts the power.
        lasting: everything after it fails, too; of a full disk what takes room.
        short: a write takes half of its bytes instead of failing (other changes go through).
    """

    at: int
    error: int | None = errno.ENOSPC
    lasting: bool = False
    short: bool = False


class Disk:
    """One directory whose changes are watched.

    Args:
        root: the directory; it must exist.
        rng: draws what a power cut loses.
    """

    def __init__(self, root: Path, rng: random.Random) -> None:
        """Watch a directory, with no fault set and all that is in it safe."""
        self.root = root
        self.ops: list[tuple[Kind, str]] = []
        """Every change so far: what, and the path from the root."""
        self.named: set[str] = set()
        """Every path from the root that was opened or changed, or was to be."""
        self.fault: Fault | None = None
        self.off = False
        """No change gets through: the process is dead, or the power is cut."""
        self.failed = 0
        """Changes that failed so far."""
        self._from = 0
        self._rng = rng
        self._ordinals: dict[str, int] = {}
        self._paths: dict[int, Path] = {}
        self._bytes: set[int] = set()
        """Inodes of files whose bytes are not safe."""
        self._in_place: list[tuple[int, int, bytes]] = []
        """Bytes that were overwritten in place and whose successors are not safe: inode,
        place, and what was there; oldest first."""
        self._names: list[tuple[Path, Callable[[], None]]] = []
        """Changes of names that are not safe: directory, and how to take it back; oldest
        first."""
        self._kept = root.parent / f".{root.name}-before"
        self._count = itertools.count()

    def set(self, fault: Fault | None) -> None:
        """From now on this goes wrong."""
        self.fault, self._from = fault, len(self.ops)

    @contextmanager
    def watched(self) -> Iterator[None]:
        """Inside, the system's calls go through this disk."""
        names = {name: getattr(self, f"_{name}") for name in REAL}
        with mock.patch.multiple(os, **names):
            yield

    def on(self) -> None:
        """The next process may use it."""
        self.off = False
        self._paths.clear()

    def cut(self) -> None:
        """Cut the power: what was not safe may be lost, and no change gets through any
        more.

        Of each directory the latest changes of names are taken back, a drawn number of
        them; files whose bytes are not safe are cut at a drawn length.
        """
        self.off = True
        keep: dict[Path, int] = {}
        for folder in sorted({folder for folder, _ in self._names}):
            keep[folder] = self._rng.randint(0, sum(f == folder for f, _ in self._names))
        seen: dict[Path, int] = {}
        lost = []
        for folder, back in self._names:
            seen[folder] = seen.get(folder, 0) + 1
            if seen[folder] > keep[folder]:
                lost.append(back)
        for back in reversed(lost):
            back()
        for file in sorted(self.root.rglob("*")):
            if file.is_file() and file.stat().st_ino in self._bytes:
                os.truncate(file, self._rng.randint(0, file.stat().st_size))
            if file.is_file():
                self._tear(file)
        self._safe()

    def _tear(self, file: Path) -> None:
        """Let what was overwritten in place come back in part: of each write a drawn
        number of its first bytes stays.
        """
        inode = file.stat().st_ino
        for _, at, old in [w for w in reversed(self._in_place) if w[0] == inode]:
            kept = self._rng.randint(0, len(old))
            with file.open("r+b") as out:
                out.seek(at + kept)
                out.write(old[kept:])

    def _safe(self) -> None:
        self._names.clear()
        self._bytes.clear()
        self._in_place.clear()
        shutil.rmtree(self._kept, ignore_errors=True)

    # The system's calls -------------------------------------------------------------------------

    def _open(
        self, path: Any, flags: int, mode: int = 0o777, *, dir_fd: int | None = None
    ) -> int:
        """Open a file, and watch it if it is below the root and written (a directory in
        any case).
        """
        real = self._path(path, dir_fd)
        writes = bool(flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
        new = real is not None and writes and not os.path.lexists(real)
        if real is not None and writes:
            self._change("open", real, new)
        fd: int = REAL["open"](path, flags, mode, dir_fd=dir_fd)
        if real is not None and (
            writes or real.is_dir()
        ):  # others close files behind our back
            self._paths[fd] = real
            if new and real.exists():
                self._names.append((real.parent, lambda: _unlink(real)))
        return fd

    def _close(self, fd: int) -> None:
        self._paths.pop(fd, None)
        REAL["close"](fd)

    def _write(self, fd: int, data: Any) -> int:
        """Write, half of the data where the fault is a short write; the bytes are not
        safe then.
        """
        if fd in self._paths:
            more = os.lseek(fd, 0, os.SEEK_CUR) + len(data) > os.fstat(fd).st_size
            if self._change("write", self._paths[fd], more):
                data = memoryview(data)[: max(1, len(data) // 2)]
            self._bytes.add(os.fstat(fd).st_ino)
        written: int = REAL["write"](fd, data)
        return written

    def _pwrite(self, fd: int, data: Any, offset: int) -> int:
        """Write at a place, half of the data where the fault is a short write; what was
        there may come back until it is safe.
        """
        if fd in self._paths:
            about = os.fstat(fd)
            if self._change("write", self._paths[fd], offset + len(data) > about.st_size):
                data = memoryview(data)[: max(1, len(data) // 2)]
            old = os.pread(fd, len(data), offset)
            self._in_place.append((about.st_ino, offset, old))
        written: int = REAL["pwrite"](fd, data, offset)
        return written

    def _posix_fallocate(self, fd: int, offset: int, length: int) -> None:
        """Allocate room; counted as a write."""
        if fd in self._paths:
            self._change("write", self._paths[fd])
            self._bytes.add(os.fstat(fd).st_ino)
        REAL["posix_fallocate"](fd, offset, length)

    def _ftruncate(self, fd: int, length: int) -> None:
        if fd in self._paths:
            self._change("write", self._paths[fd])
        REAL["ftruncate"](fd, length)

    def _fsync(self, fd: int) -> None:
        """Make a file's bytes, or a directory's names, safe; files not watched are left
        alone.
        """
        path = self._paths.get(fd)
        if path is None:
            return  # a disk in memory needs none
        self._change("fsync", path)
        inode = os.fstat(fd).st_ino
        self._bytes.discard(inode)
        self._in_place = [write for write in self._in_place if write[0] != inode]
        if path.is_dir():
            self._names = [
                (folder, back) for folder, back in self._names if folder != path
            ]

    _fdatasync = _fsync

    def _replace(
        self,
        src: Any,
        dst: Any,
        *,
        src_dir_fd: int | None = None,
        dst_dir_fd: int | None = None,
    ) -> None:
        """Rename over a name, which is not safe until its directory is; what was there is
        kept for that.
        """
        source, target = self._path(src, src_dir_fd), self._path(dst, dst_dir_fd)
        if source is not None and target is not None:
            self._change("replace", target)
            before = self._keep(target)

            def back() -> None:
                """Take the renaming back: the new file gets its old name, and what was
                replaced comes back.
                """
                if target.exists():
                    REAL["replace"](target, source)
                if before is not None:
                    REAL["replace"](before, target)

            self._names.append((target.parent, back))
        REAL["replace"](src, dst, src_dir_fd=src_dir_fd, dst_dir_fd=dst_dir_fd)

    _rename = _replace

    def _link(
        self,
        src: Any,
        dst: Any,
        *,
        src_dir_fd: int | None = None,
        dst_dir_fd: int | None = None,
        follow_symlinks: bool = True,
    ) -> None:
        """Make a second name, which is not safe until its directory is.

        It takes room if the root has not had the name before.
        """
        self._path(src, src_dir_fd)
        before = len(self.named)
        target = self._path(dst, dst_dir_fd)
        if target is not None and not os.path.lexists(target):
            self._change("link", target, len(self.named) > before)
            self._names.append((target.parent, lambda: _unlink(target)))
        REAL["link"](
            src,
            dst,
            src_dir_fd=src_dir_fd,
            dst_dir_fd=dst_dir_fd,
            follow_symlinks=follow_symlinks,
        )

    def _unlink(self, path: Any, *, dir_fd: int | None = None) -> None:
        """Remove a name, which may come back until its directory is safe; none there
        fails as usual.
        """
        real = self._path(path, dir_fd)
        if real is not None and os.path.lexists(real):
            self._change("unlink", real)
            before = self._keep(real)
            if before is not None:
                self._names.append((real.parent, lambda: REAL["replace"](before, real)))
        REAL["unlink"](path, dir_fd=dir_fd)

    _remove = _unlink

    def _mkdir(self, path: Any, mode: int = 0o777, *, dir_fd: int | None = None) -> None:
        """Make a directory, which may be lost with all in it until its parent is safe."""
        real = self._path(path, dir_fd)
        if real is not None and not os.path.lexists(real):
            self._change("mkdir", real)
            self._names.append(
                (real.parent, lambda: shutil.rmtree(real, ignore_errors=True))
            )
        REAL["mkdir"](path, mode, dir_fd=dir_fd)

    def _path(self, path: Any, dir_fd: int | None) -> Path | None:
        """Where a path or descriptor is if below the root, else None; the name is noted
        in `named`.
        """
        if isinstance(path, int):
            return self._paths.get(path)
        name = Path(os.fsdecode(path))
        if dir_fd is not None:
            if dir_fd not in self._paths:
                return None
            name = self._paths[dir_fd] / name
        name = name.absolute()
        if not name.is_relative_to(self.root):
            return None
        self.named.add(str(name.relative_to(self.root)))
        return name

    def _keep(self, file: Path) -> Path | None:
        """Keep what a change is about to replace: a copy, or a second name while it is
        not safe.

        Returns:
            The file beside the root; None if there was no file.
        """
        if not file.is_file():
            return None
        with suppress(FileExistsError):
            REAL["mkdir"](self._kept)
        kept = self._kept / str(next(self._count))
        REAL["link"](file, kept, follow_symlinks=False)
        if not kept.is_symlink() and kept.stat().st_ino not in self._bytes:
            copy = kept.with_suffix(".copy")
            shutil.copyfile(kept, copy)
            REAL["replace"](copy, kept)
        return kept

    def _ordinal(self, temporary: re.Match[str]) -> str:
        """The numbers of temporary names go on from run to run; in `ops` they count from 0."""
        number = self._ordinals.setdefault(temporary[0], len(self._ordinals))
        return f"{temporary[1]}{number}"

    def _change(self, kind: Kind, path: Path, takes_room: bool = True) -> bool:
        """Count a change, or fail; whether a write is to be short.

        Args:
            kind, path: what, and of what.
            takes_room: whether it does, if its kind may; what is written in place does not.
        """
        if self.off:
            raise OSError(errno.EIO, "the power is cut")
        number = len(self.ops) - self._from
        self.ops.append(
            (kind, NUMBERED.sub(self._ordinal, str(path.relative_to(self.root))))
        )
        fault = self.fault
        if (
            fault is None
            or number < fault.at
            or (number > fault.at and not fault.lasting)
        ):
            return False
        if fault.short:
            return number == fault.at and kind == "write"
        if fault.error is None:
            self.off = True
            raise OSError(errno.EIO, "the power is cut")
        room = takes_room and kind in TAKES_ROOM
        if fault.lasting and fault.error == errno.ENOSPC and not room:
            return False
        self.failed += 1
        raise OSError(fault.error, os.strerror(fault.error))


def _unlink(path: Path) -> None:
    if os.path.lexists(path):
        REAL["unlink"](path)
