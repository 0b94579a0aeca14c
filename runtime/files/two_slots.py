"""A small file of fixed size that is overwritten in place: two slots, each with a record.

A record has a number and a checksum, and goes into the slot of the older one, so that a
write that is cut in the middle leaves the other. The file has its blocks from the start
and stays open: a write needs no room on the disk, no new name and no descriptor, and
waits for no other file's names (`fdatasync`). File systems that never overwrite a block
in place (btrfs, ZFS) may still refuse on a full disk.
"""

from __future__ import annotations

import io
import os
import stat
import zlib
from collections.abc import Callable
from typing import Final

from flexdt.runtime.files.directory import Directory, writing
from flexdt.runtime.files.own_documents import Keep

SLOT_BYTES: Final = 16 << 10
"""Size of a slot [bytes]; the largest record is a little shorter."""
SLOTS: Final = 2
_SUM: Final = 9
_HEAD: Final = _SUM + 17 + 7
"""Bytes before a record: checksum, number, length, each with a space."""


class TwoSlots:
    """The file; callers take turns.

    Args:
        folder: where it is.
        name: of the file.
    """

    def __init__(self, folder: Directory, name: str) -> None:
        """Name the file; nothing is opened yet."""
        self._folder = folder
        self._name = name
        self._file: io.FileIO | None = None
        self._newest: int | None = None
        """Slot of the newest record; None while the file is not known to be whole."""

    def read(self) -> tuple[int, bytes] | None:
        """Read the newest whole record.

        Returns:
            Its number and its bytes; None if there is no file.

        Raises:
            OSError: it cannot be read, or it is no regular file.
            ValueError: neither slot has a whole record.
        """
        try:
            data = self._folder.read(self._name)
        except FileNotFoundError:
            return None
        found = [
            (record, slot)
            for slot in range(SLOTS)
            if (record := _parse(data[slot * SLOT_BYTES :][:SLOT_BYTES])) is not None
        ]
        if not found or len(data) < SLOTS * SLOT_BYTES:
            raise ValueError("it has no whole record")
        newest, self._newest = max(found)
        return newest

    def write(self, number: int, data: bytes, make: Keep | None = None) -> None:
        """Write a record and wait for the disk; a missing file is made.

        After an error the newest record before is still there, and the same slot is used
        for the next one.

        Args:
            number: of the record, larger than those before.
            data: its bytes.
            make: makes the file, instead of `Directory.keep`; bytes may follow.

        Raises:
            DatasetWriteError: the system refuses.
            ValueError: the record is too long for a slot.
        """
        record = _slot(number, data)
        path = self._folder.path / self._name
        with writing(path, f"cannot write {path}"):
            if not self._is_open():
                self._adopt()
            if self._file is not None and self._newest is not None:
                slot = (self._newest + 1) % SLOTS
                _overwrite(self._file.fileno(), record, slot * SLOT_BYTES)
            else:
                slot = 0
                whole = record.ljust(SLOTS * SLOT_BYTES, b"\0")
                (make or self._folder.keep)(self._name, whole)
            self._newest = slot
            if self._file is None:
                self._adopt()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __del__(self) -> None:
        self.close()

    def _is_open(self) -> bool:
        """Return whether the open file is still the one of the name; it is closed if not."""
        if self._file is None:
            return False
        about = self._folder.stat(self._name)
        mine = os.fstat(self._file.fileno())
        if about is not None and (about.st_ino, about.st_dev) == (
            mine.st_ino,
            mine.st_dev,
        ):
            return True
        # Somebody has removed or replaced it: what is written here would not be found.
        self.close()
        self._newest = None
        return False

    def _adopt(self) -> None:
        """Open the file of the name, if it is a whole one that was read or written before,
        and no link.

        Otherwise the next write makes a new one.
        """
        if self._newest is None:
            return
        self._file = None
        about = self._folder.stat(self._name)
        if about is not None and _is_usable(about):
            self._file = self._folder.open_in_place(self._name)
        else:
            self._newest = None


def _is_usable(about: os.stat_result) -> bool:
    """Return whether a file may be overwritten: a regular one of one name, large enough."""
    return (
        stat.S_ISREG(about.st_mode)
        and about.st_nlink == 1
        and about.st_size >= SLOTS * SLOT_BYTES
    )


def _overwrite(file: int, data: bytes, at: int) -> None:
    """Write bytes in place and wait for the disk.

    Raises:
        OSError: the system refuses.
    """
    left = memoryview(data)
    while left.nbytes:
        written = os.pwrite(file, left, at)
        left = left[written:]
        at += written
    # Without the file's times, whose writing would wait for those of all other files.
    sync: Callable[[int], None] = getattr(os, "fdatasync", os.fsync)
    sync(file)


def _slot(number: int, data: bytes) -> bytes:
    """Encode a record with its checksum, number and length.

    Raises ValueError: it is too long.
    """
    body = b"%016d %06d " % (number, len(data)) + data
    if _SUM + len(body) > SLOT_BYTES:
        raise ValueError(f"{len(data)} bytes do not fit into a slot of {SLOT_BYTES}")
    return b"%08x " % zlib.crc32(body) + body


def _parse(slot: bytes) -> tuple[int, bytes] | None:
    """Decode a slot: number and bytes of its record; None if it is not whole."""
    try:
        checksum = int(slot[: _SUM - 1], 16)
        number, length = (int(word) for word in slot[_SUM:_HEAD].split())
    except ValueError:
        return None
    body = slot[_SUM : _HEAD + length]
    if len(body) != _HEAD - _SUM + length or zlib.crc32(body) != checksum:
        return None
    return number, body[_HEAD - _SUM :]
