"""Compiled kernels in files: which folders are looked into, and which is written.

    FLEXDT_CACHE, NUMBA_CACHE_DIR     what the user or a module file says
    PREFIX/share/flexdt/kernels       for everyone here, by `flexdt kernels --for-everyone`
    the user's cache folder           ~/.cache/flexdt/kernels on Linux
    TMPDIR/flexdt-kernels-UID         private

All are read, in this order. What this process compiles goes to the first that takes it, but
never into the folder for everyone, which may lie on a read-only disk. An item is written under
another name and renamed, and is never changed: several processes, versions of flexdt and kinds
of machine share a folder. Items hold code that this process will run: a folder in which anybody
may write is left alone, and so is one of another user, unless a variable names it.
"""

from __future__ import annotations

import hashlib
import logging
import os
import stat
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path
from typing import Final, assert_never

import platformdirs

from flexdt.message_words import reason_of

LOG = logging.getLogger("flexdt.kernels")
FOLDER: Final = "kernels"
ENDING: Final = ".kernel"
DIGEST_BYTES: Final = hashlib.sha256().digest_size
MAX_AGE_S: Final = 180 * 86400.0
"""Age of an item after which it is deleted and, if still used, compiled anew [s]."""
UNKEPT_MESSAGE: Final = (
    "flexdt: compiled kernels are not kept, and every process compiles its own: no folder could"
    " be written (%s); set FLEXDT_CACHE to one that can"
)


class Owner(Enum):
    """Whose folder kernels are taken from."""

    ANYBODY = "anybody"
    TRUSTED = "root, the owner of the installation, this user"
    USER = "this user, and no other may enter"


@dataclass(frozen=True)
class Place:
    """A folder for compiled kernels, and who may write there."""

    folder: Path
    chosen_by: str
    """What named it."""
    owner: Owner
    written: bool = True
    """Whether this process may write there."""

    @cached_property
    def refusal(self) -> str | None:
        """Why what lies there is not used; None where it is, or where nothing is there."""
        private = self.owner is Owner.USER
        try:
            seen = os.lstat(self.folder) if private else os.stat(self.folder)
        except FileNotFoundError:
            return None
        except OSError as error:
            return reason_of(error)
        if not stat.S_ISDIR(seen.st_mode):
            return "not a folder"
        if not hasattr(os, "getuid"):
            return None
        if seen.st_mode & (0o077 if private else stat.S_IWOTH):
            return "others may write there"
        if seen.st_uid not in self._trusted(seen.st_uid):
            return "belongs to another user"
        return None

    def _trusted(self, of_folder: int) -> set[int]:
        match self.owner:
            case Owner.ANYBODY:
                return {of_folder}
            case Owner.TRUSTED:
                return {0, os.getuid(), os.stat(sys.prefix).st_uid}
            case Owner.USER:
                return {os.getuid()}
            case never:
                assert_never(never)


def shared_folder() -> Path:
    """Return the folder of the kernels that serve all users of this installation."""
    return Path(sys.prefix) / "share" / "flexdt" / FOLDER


def places(environment: Mapping[str, str] = os.environ) -> tuple[Place, ...]:
    """List the folders in the order in which they are looked into."""
    found = [
        Place(Path(environment[name]), name, Owner.ANYBODY)
        for name in ("FLEXDT_CACHE", "NUMBA_CACHE_DIR")
        if environment.get(name)
    ]
    found.append(
        Place(shared_folder(), "this installation", Owner.TRUSTED, written=False)
    )
    user_cache = _user_cache()
    if user_cache is not None:
        found.append(Place(user_cache / FOLDER, "the user's cache", Owner.TRUSTED))
    try:
        temporary = Path(tempfile.gettempdir())
    except FileNotFoundError:
        return tuple(found)
    user = getattr(os, "getuid", lambda: "user")()
    return (*found, Place(temporary / f"flexdt-{FOLDER}-{user}", "TMPDIR", Owner.USER))


def _user_cache() -> Path | None:
    """Return the user's cache folder of flexdt; None for a user without a home."""
    try:
        folder = platformdirs.user_cache_path("flexdt", appauthor=False)
    except RuntimeError:
        return None
    return folder if folder.is_absolute() else None


class KernelFiles:
    """Compiled kernels in the files of some places.

    Args:
        places: in the order in which they are looked into.
    """

    def __init__(self, places: tuple[Place, ...]) -> None:
        """Look into `places`; nothing is read or written yet."""
        self.places = places
        self._unsuitable: dict[Path, str] = {}
        self._tended = False

    def __repr__(self) -> str:
        """Name the places in use."""
        return (
            f"KernelFiles({', '.join(str(place.folder) for place in self._readable())})"
        )

    def load(self, name: str) -> bytes | None:
        """Return what was saved under a name, whole and unchanged; None without it."""
        for place in self._readable():
            try:
                content = (place.folder / (name + ENDING)).read_bytes()
            except OSError:
                continue
            data = content[DIGEST_BYTES:]
            if hashlib.sha256(data).digest() == content[:DIGEST_BYTES]:
                return data
        return None

    def holds(self, beginning: str) -> bool:
        """Return whether an item's name begins so."""
        return any(
            path.name.startswith(beginning)
            for place in self._readable()
            for path in items(place.folder)
        )

    def save(self, name: str, data: bytes) -> None:
        """Keep data in the first place that can be written; a warning, once, if none can."""
        place = self._write(name, data)
        if place is None:
            if not self._tended:
                LOG.warning(UNKEPT_MESSAGE, self.told())
        elif not self._tended:
            delete_old(place.folder, time.time() - MAX_AGE_S)
        self._tended = True

    def writable(self) -> Place | None:
        """Return the place that would take an item."""
        return self._write("probe", b"", keep=False)

    def told(self) -> str:
        """Name the places that could not be written, and why."""
        return "; ".join(f"{folder}: {why}" for folder, why in self._unsuitable.items())

    def _readable(self) -> Iterator[Place]:
        return (place for place in self.places if place.refusal is None)

    def _write(self, name: str, data: bytes, *, keep: bool = True) -> Place | None:
        for place in self.places:
            if not place.written or place.folder in self._unsuitable:
                continue
            if place.refusal is not None:
                self._unsuitable[place.folder] = place.refusal
                continue
            try:
                put(
                    place.folder,
                    name,
                    data,
                    private=place.owner is Owner.USER,
                    keep=keep,
                )
            except OSError as error:
                self._unsuitable[place.folder] = reason_of(error)
                continue
            return place
        return None


def items(folder: Path) -> list[Path]:
    """List the files of kernels in a folder; none where it cannot be read."""
    try:
        return sorted(path for path in folder.iterdir() if path.suffix == ENDING)
    except OSError:
        return []


def put(
    folder: Path, name: str, data: bytes, *, private: bool = False, keep: bool = True
) -> None:
    """Write an item as a whole, or nothing.

    Args:
        folder: made if missing.
        private: made for its owner alone.
        keep: False: the item is deleted again.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(0o700 if private else 0o755, parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".part", delete=False) as file:
        written = Path(file.name)
        try:
            file.write(hashlib.sha256(data).digest() + data)
            file.flush()
            if keep and not private:
                os.chmod(written, stat.S_IMODE(folder.stat().st_mode) & 0o666)
        except BaseException:
            written.unlink()
            raise
    if keep:
        written.replace(folder / (name + ENDING))
    else:
        written.unlink()


def delete_old(folder: Path, before_s: float) -> None:
    """Delete the items of a folder that were written before a time [s since 1970]."""
    for path in items(folder):
        with suppress(OSError):
            if path.stat().st_mtime < before_s:
                path.unlink()


def opened() -> KernelFiles:
    """Return the kernels of this process's places."""
    return KernelFiles(places())


def kept_in() -> Path | None:
    """Return the folder for what is compiled here; None if none is writable."""
    place = opened().writable()
    return None if place is None else place.folder


def publish() -> Path:
    """Copy all kernels that this process may read into the folder for everyone.

    Returns:
        That folder.

    Raises:
        OSError: it cannot be written.
    """
    shared = shared_folder()
    shared.mkdir(0o755, parents=True, exist_ok=True)
    for place in places():
        if place.folder == shared or place.refusal is not None:
            continue
        for item in items(place.folder):
            data = item.read_bytes()[DIGEST_BYTES:]
            put(shared, item.stem, data)
    return shared


def clear(places: tuple[Place, ...]) -> list[Path]:
    """Delete the kernels of all places that this process may change, and the folders if they
    are empty then.

    Returns:
        The folders in which something was deleted.
    """
    changed = []
    for place in places:
        deleted = [path for path in items(place.folder) if _deleted(path)]
        if deleted:
            changed.append(place.folder)
            with suppress(OSError):
                place.folder.rmdir()
    return changed


def _deleted(path: Path) -> bool:
    try:
        path.unlink()
    except OSError:
        return False
    return True
