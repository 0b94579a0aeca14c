"""Documents of ours: written atomically and safe from a power cut, validated when read.

Any name becomes one plain path component. A document that is damaged (not JSON, numbers
that are not finite, absurd values: whatever its reader does not accept) is set aside, as
`x.unreadable.json` for `x.json`, with one line in the log, and the caller continues
without it.
"""

from __future__ import annotations

import json
import logging
import math
import os
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TypeVar

from flexdt.message_words import reason_of
from flexdt.protocol.field_checks import MAX_STEM, encoded
from flexdt.runtime.files.directory import BEFORE, MAX_READ_BYTES, Directory, writing
from flexdt.runtime.log import log
from flexdt.twin.dataset.dataset_errors import DatasetWriteError, DiskFullError
from flexdt.twin.errors import LimitError

T = TypeVar("T")
Keep = Callable[[str, bytes], None]
"""Writes a file of a folder, safe from a power cut."""
RESERVE = 4
"""Descriptors that are kept for taking changes back."""
ASIDE = ".unreadable"
"""Inserted before the suffix of a file that is set aside; none of our names has two dots."""


def file_stem(name: str) -> str:
    """Encode `name` with percent signs as the stem of a file; different names give
    different stems.

    Raises:
        LimitError: the stem would have more than `MAX_STEM` bytes.
    """
    stem = encoded(name)
    if len(stem) > MAX_STEM:
        raise LimitError(
            f"the name {name[:40]!r}... is too long: {len(stem)} bytes encoded, "
            f"{MAX_STEM} allowed",
            {"asked": len(stem), "allowed": MAX_STEM},
        )
    return stem


@dataclass(frozen=True)
class _Change:
    """A file that was written or deleted.

    Attributes:
        folder, name: where it is.
        data: present content; None without a file.
        before: the name under which the replaced file is kept; None where nothing was, or
            is.
        old: instead, the replaced content.
        keep: writes it.
    """

    folder: Directory
    name: str
    data: bytes | None
    before: str | None
    old: bytes | None = None
    keep: Keep | None = None

    def undo(self) -> None:
        """Restore the earlier content, or delete a file that is new, and wait for the disk.

        Nothing is done if the file has been changed since by another.
        """
        # Another may have written meanwhile, as a server at its end: the newest content stays.
        if not self._is_still():
            return
        if self.before is not None:
            # The kept file replaces the new one in a step: there is no moment without a
            # document.
            self.folder.rename(self.before, self.name)
        elif self.old is not None:
            (self.keep or self.folder.keep)(self.name, self.old)
        else:
            self.folder.unlink(self.name)
        # A rename is atomic, not durable: a power cut could bring the new file back.
        self.folder.sync()

    def _is_still(self) -> bool:
        """Return whether the file is as this change left it: absent, or with the same
        bytes.

        Spaces at the end of a file that `keep` wrote do not count.
        """
        if self.data is None:
            return self.folder.stat(self.name) is None
        found = self.folder.read(self.name, max(MAX_READ_BYTES, len(self.data)))
        return found == self.data or (
            self.keep is not None and found.rstrip(b" ") == self.data
        )


class Changes:
    """Files written one after the other, which can all be restored.

    The replaced file is kept beside the new one under another name until `done` or
    `undo`, so that undoing takes no room: a full disk is the usual reason for it. Some
    descriptors are reserved before the first change, so that undoing is possible where
    the process has none left. `with Changes() as changes:` undoes them if the block
    raises.
    """

    def __init__(self) -> None:
        """Begin without changes."""
        self._made: list[_Change] = []
        self._reserve: list[int] = []

    def put(
        self, folder: Directory, name: str, data: bytes, keep: Keep | None = None
    ) -> None:
        """Write a file like `Directory.keep`, and keep the one it replaces until `done`
        or `undo`.

        The replaced file gets a second name. If a full disk has no room for that, its
        content is kept in memory, but only with `keep`.

        Args:
            folder, name, data: directory, file name and content.
            keep: writes it instead, and may do so on a full disk; spaces may follow the
                data then.

        Raises:
            DatasetWriteError: the system cannot write; `undo` restores the earlier
                changes.
        """
        self._reserved(folder, name)
        before = self._before()
        old = None
        try:
            kept = None
            # A link takes no blocks, and the old content outlives the rename of the new file.
            if _second_name(folder, name, before):
                kept = before
        except DiskFullError:
            if keep is None:
                raise
            kept = None
            old = folder.read(name)
        # Before the write: if that fails half-way, `undo` still removes the second name.
        self._made.append(_Change(folder, name, data, kept, old, keep))
        (keep or folder.keep)(name, data)

    def put_json(self, folder: Directory, name: str, document: object) -> None:
        """Write a JSON document, as `put`."""
        data = json.dumps(document, indent=1, allow_nan=False).encode("utf-8")
        self.put(folder, name, data)

    def remove(self, folder: Directory, *names: str) -> None:
        """Delete files of a folder and wait for the disk once; a missing one is no error.

        They are only renamed, so that `undo` can restore them; `done` deletes them.

        Raises:
            DatasetWriteError: the system refuses.
        """
        gone = False
        for name in names:
            self._reserved(folder, name)
            before = self._before()
            with writing(folder.path / name, f"cannot delete {folder.path / name}"):
                try:
                    folder.rename(name, before)
                except (FileNotFoundError, NotADirectoryError):
                    continue
            # Before the sync, which may fail: the file is away, and `undo` has to know.
            self._made.append(_Change(folder, name, None, before))
            gone = True
        if gone:
            folder.sync()

    def _reserved(self, folder: Directory, name: str) -> None:
        """Reserve descriptors before the first change of a file.

        Raises DatasetWriteError: there are none; nothing has been written."""
        with writing(folder.path / name, f"cannot write {folder.path / name}"):
            while len(self._reserve) < RESERVE:
                self._reserve.append(os.open(os.devnull, os.O_RDONLY))

    def _release(self) -> None:
        """Give the reserved descriptors back."""
        while self._reserve:
            os.close(self._reserve.pop())

    def _before(self) -> str:
        """Return an unused name for a replaced file."""
        # By process, thread and number: other writers at the same time have other names.
        return f"{BEFORE}{os.getpid()}-{threading.get_native_id()}-{len(self._made)}"

    def __enter__(self) -> Changes:
        return self

    def __exit__(
        self, _kind: object, error: BaseException | None, _trace: object
    ) -> None:
        """Confirm the changes at the end of the context, or undo them if it raised (and
        re-raise).
        """
        if error is None:
            self.done()
        else:
            self.undo()

    def done(self) -> None:
        """Confirm the changes: delete the replaced files, as far as the system allows,
        and forget the changes.
        """
        self._release()
        for change in self._made:
            if change.before is not None:
                # What stays is swept at the next start (`settle`), and takes only room.
                with suppress(OSError):
                    change.folder.unlink(change.before)
        self._made.clear()

    def undo(self) -> None:
        """Restore each file, the last one first, and forget the changes.

        A file that somebody else has changed since, or deleted, is left alone. Failures
        are logged.
        """
        self._release()
        # A file that was written twice goes back through its second version to the first.
        for change in reversed(self._made):
            try:
                change.undo()
            except FileNotFoundError:
                continue
            except (OSError, DatasetWriteError) as error:
                log(
                    "a change that was not made is still on the disk",
                    logging.ERROR,
                    file=str(change.folder.path / change.name),
                    reason=str(error),
                )
        # Also second names of files that somebody else has changed since.
        self.done()


def _second_name(folder: Directory, name: str, second: str) -> bool:
    """Give a file a second name, as a link, or as a copy where the system refuses links.

    Args:
        folder: of the file.
        name: of the file.
        second: its second name; a file of that name is removed.

    Returns:
        Whether there is a file called `name`.

    Raises:
        DatasetWriteError: the system refuses.
    """
    with writing(folder.path / name, f"cannot write {folder.path / name}"):
        about = folder.stat(name)
        if about is None:
            return False
        with suppress(FileNotFoundError):
            folder.unlink(
                second
            )  # of a killed writer with the same numbers, as in a container
        try:
            folder.link(name, second)
        except OSError:  # a file system without links
            folder.keep(second, folder.read(name, about.st_size))
    return True


def read_json(data: bytes) -> object:
    """Parse a JSON document in UTF-8; all its numbers must be finite and its texts valid
    Unicode.

    Of a name given twice the last value counts.

    Raises ValueError: it is no such document.
    """
    document = json.loads(
        data.decode("utf-8"), parse_float=_finite, parse_constant=_finite
    )
    json.dumps(document, ensure_ascii=False).encode(
        "utf-8"
    )  # an escaped lone surrogate is no text
    return document


def read_or_set_aside(
    folder: Directory, name: str, read: Callable[[bytes], T], without: str
) -> T | None:
    """Read one of our files with `read`; rename and log a damaged one, see `set_aside`.

    Whatever `read` raises means damage. `without`: how the twin goes on, for the log.
    None without a file.
    """
    try:
        return read(folder.read(name))
    except FileNotFoundError:
        return None
    except Exception as error:  # a flipped bit may trip over anything
        set_aside(folder, name, error, without)
        return None


def set_aside(folder: Directory, name: str, error: object, without: str) -> None:
    """Rename a damaged file to STEM.unreadable.SUFFIX, and log the error; raise nothing.

    One under that name is replaced. `without`: event of the log line; that has the start
    of the reason, also why it was not renamed.
    """
    file = folder.path / name
    aside = f"{file.stem}{ASIDE}{file.suffix}"
    try:
        folder.rename(name, aside)
        kept = aside
    except OSError as refused:
        kept = f"not set aside: {reason_of(refused)}"
    log(without, logging.ERROR, file=str(file), kept=kept, reason=str(error)[:500])


def settle(root: Directory, folders: Sequence[str]) -> None:
    """Clean a data directory and its folders at the start: delete files of killed writers, and
    set aside entries named like a folder that are no directory, such as links.

    `root`: data directory; `folders`: names of the folders in it.
    """
    for folder in (root, *map(root.folder, folders)):
        folder.sweep()
    for name in folders:
        if root.stat(name) is not None and not root.is_directory(name):
            set_aside(root, name, "it is no directory", "a folder of ours is begun anew")


def ours(folder: Directory) -> list[str]:
    """List the names of JSON files and links in a folder, sorted, except those set aside;
    [] if there is no such folder.
    """
    with suppress(FileNotFoundError), folder.entries() as entries:
        names = sorted(e.name for e in entries if e.name.endswith(".json"))
        return [n for n in names if not n.endswith(f"{ASIDE}.json")]
    return []


def _finite(text: str) -> float:
    """Parse a number; raise ValueError for NaN, infinity, or a text that is none."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text} is no finite number")
    return value


def lock_folder(root: Directory) -> Callable[[], None]:
    """Lock a data directory until the end of the process, or a call of the returned function.

    The lock is on the directory itself, not on a file in it: no file can be deleted while
    a twin runs, or replaced by a link beforehand. The system releases it when its holder
    dies. Without effect where a directory cannot be opened (Windows) or locked.

    Args:
        root: the data directory.

    Returns:
        The function that releases the lock.

    Raises:
        DatasetWriteError: another process holds the lock.
    """
    fd = root.fileno()
    if fd is None:
        return lambda: None
    import fcntl

    try:
        # Without waiting: a second twin is told at once instead of standing still.
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise DatasetWriteError(
            f"the data directory {root.path} is used by another twin server",
            {"path": str(root.path), "allowed": "another --data"},
        ) from None
    except OSError:
        return lambda: None

    def release(
        held: Directory = root,
    ) -> None:  # as long as it is referred to, it stays open
        """Unlock the directory; until then the default argument keeps it open."""
        fcntl.flock(fd, fcntl.LOCK_UN)

    return release
