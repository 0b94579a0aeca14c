"""A data directory as one tar file with checksums, and back into an empty folder.

A twin may run while its directory is copied: all that it writes appears under its name only when
whole, so no file is half. Documents are copied before the images that they tell of, the state of
the whole before all others; so the copy is what a twin that was killed would leave, and a scan that
was going on is resumed from it. Links and files whose names begin with a dot are left out.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import shutil
import stat
import tarfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Final

from flexdt.clients.failure import CommandError
from flexdt.server.files.directory_lock import FILE, FolderLock

DATA: Final = "data/"
"""Where the directory's files are in the archive."""
MANIFEST: Final = "manifest.json"
MAX_MANIFEST: Final = 1 << 30
LAST: Final = "state.json"
"""What a twin looks for first gets its name last."""
BLOCK: Final = 1 << 20
NO_FOLLOW: Final = getattr(os, "O_NOFOLLOW", 0)
BINARY: Final = getattr(os, "O_BINARY", 0)


@dataclass
class Copied:
    """What went into an archive, or came out of it.

    Attributes:
        files: path below the directory -> {"bytes", "sha256"}.
        left_out: links and special files, by path.
    """

    files: dict[str, dict[str, Any]] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)

    @property
    def bytes(self) -> int:
        """Of all files."""
        return sum(file["bytes"] for file in self.files.values())


def back_up(root: Path, archive: Path) -> Copied:
    """Copy a data directory into a new archive, which appears only when whole.

    Raises:
        CommandError: no such directory, or an archive that exists or lies inside it.
        OSError: something cannot be read or written.
    """
    if not root.is_dir():
        raise CommandError(f"{root}: is no directory")
    if archive.exists() or not archive.absolute().parent.is_dir():
        raise CommandError(f"{archive}: exists, or its folder does not")
    if archive.resolve().is_relative_to(root.resolve()):
        raise CommandError(f"{archive}: lies inside {root}; allowed: anywhere else")
    part = archive.with_name(f".{archive.name}.{os.getpid()}.part")
    copied = Copied()
    try:
        with part.open("xb") as out:
            with tarfile.open(fileobj=out, mode="w", format=tarfile.PAX_FORMAT) as tar:
                for documents in (True, False):
                    for path in sorted(_found(root, copied), key=lambda p: (p.count("/"), p)):
                        if path.endswith(".json") == documents and path not in copied.files:
                            _pack(tar, root, path, copied)
                text = json.dumps({"version": 1, "files": copied.files}).encode()
                info = tarfile.TarInfo(MANIFEST)
                info.size = len(text)
                tar.addfile(info, io.BytesIO(text))
            out.flush()
            os.fsync(out.fileno())
        os.replace(part, archive)
    finally:
        part.unlink(missing_ok=True)
    return copied


def restore(archive: Path, root: Path) -> Copied:
    """Unpack an archive into a folder that is empty or made for it; all of it or nothing.

    Raises:
        CommandError: the folder is not empty, or the archive is damaged or none of `back_up`.
        OSError: something cannot be read or written.
    """
    if root.is_symlink() or (root.exists() and (not root.is_dir() or any(root.iterdir()))):
        raise CommandError(f"{root}: is not an empty folder; nothing was changed")
    new = not root.exists()
    if new:
        root.mkdir()
    inside = root / ".restoring"
    lock = None
    try:
        lock = FolderLock(root)
        inside.mkdir()
        copied = _unpack(archive, inside)
        for entry in sorted(inside.iterdir(), key=lambda e: (e.name == LAST, e.name)):
            os.rename(entry, root / entry.name)
        inside.rmdir()
    except BaseException as error:
        shutil.rmtree(root if new else inside, ignore_errors=True)
        if not new and lock is not None:
            (root / FILE).unlink(missing_ok=True)
        if isinstance(error, tarfile.TarError | EOFError | ValueError | KeyError | TypeError):
            raise CommandError(f"{archive}: is damaged or no backup: {error}") from None
        raise
    finally:
        if lock is not None:
            lock.release()
    return copied


def _found(root: Path, copied: Copied) -> Iterator[str]:
    """Paths of the regular files below `root`, with slashes."""
    left = [""]
    while left:
        folder = left.pop()
        with suppress(FileNotFoundError), os.scandir(root / folder) as entries:
            for entry in entries:
                path = f"{folder}{entry.name}"
                if entry.name.startswith("."):
                    continue
                if entry.is_dir(follow_symlinks=False):
                    left.append(f"{path}/")
                elif entry.is_file(follow_symlinks=False):
                    yield path
                elif path not in copied.left_out:
                    copied.left_out.append(path)


@dataclass
class _Summed:
    """A file that adds up what is read from it."""

    file: IO[bytes]
    sum: Any = field(default_factory=hashlib.sha256)

    def read(self, count: int = -1) -> bytes:
        block = self.file.read(count)
        self.sum.update(block)
        return block


def _pack(tar: tarfile.TarFile, root: Path, path: str, copied: Copied) -> None:
    try:
        opened = os.open(root / path, os.O_RDONLY | NO_FOLLOW | BINARY)
    except FileNotFoundError:  # gone since it was listed
        return
    with os.fdopen(opened, "rb") as file:
        about = os.fstat(opened)
        if not stat.S_ISREG(about.st_mode):
            return
        info = tarfile.TarInfo(DATA + path)
        info.size, info.mtime = about.st_size, about.st_mtime
        summed = _Summed(file)
        tar.addfile(info, summed)
        copied.files[path] = {"bytes": info.size, "sha256": summed.sum.hexdigest()}


def _unpack(archive: Path, inside: Path) -> Copied:
    """All files below `inside`, compared with the manifest."""
    found: dict[str, dict[str, Any]] = {}
    manifest = None
    with tarfile.open(archive, "r:") as tar:
        for info in tar:
            if info.type not in (tarfile.REGTYPE, tarfile.AREGTYPE) or manifest is not None:
                raise ValueError(f"{info.name!r} is no plain file, or comes after the manifest")
            file = tar.extractfile(info)
            assert file is not None
            if info.name == MANIFEST:
                if info.size > MAX_MANIFEST:
                    raise ValueError(f"a manifest of {info.size} bytes")
                manifest = json.loads(file.read())["files"]
                continue
            path = _plain(info.name)
            (inside / path).parent.mkdir(parents=True, exist_ok=True)
            summed = _Summed(file)
            # In folders that nobody else knows, under names that do not exist: no link is followed.
            flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | NO_FOLLOW | BINARY
            with os.fdopen(os.open(inside / path, flags, 0o644), "wb") as out:
                shutil.copyfileobj(summed, out, BLOCK)
                out.flush()
                os.fsync(out.fileno())
            os.utime(inside / path, (info.mtime, info.mtime))
            found[path] = {"bytes": info.size, "sha256": summed.sum.hexdigest()}
    if manifest is None:
        raise ValueError("it has no manifest, so its end is missing")
    different = sorted(k for k in found.keys() | manifest.keys() if found.get(k) != manifest.get(k))
    if different:
        raise ValueError(f"{len(different)} files differ from the manifest: {different[:3]}")
    return Copied(found)


def _plain(name: str) -> str:
    """The path below the directory of a member of an archive.

    Raises:
        ValueError: it is none of `back_up`, or leads elsewhere.
    """
    path = name.removeprefix(DATA)
    parts = path.split("/")
    if path == name or any(not p or p[0] == "." or set(p) & set("\\:\0") for p in parts):
        raise ValueError(f"{name!r} is no path of a data directory")
    return path
