"""Room reserved for state and jobs: spare files, allocated in advance.

A document is written under a temporary name and renamed, as `Directory.put` does. Where
the disk has no room for that, it is written into a spare file, whose blocks it has
already, and that file takes the document's name. It keeps its size (spaces follow the
document), so the file that it replaces becomes a spare file in turn, and there is no end
of such writes. Spare files that are gone are made again as soon as there is room. File
systems that never overwrite a block in place (btrfs, ZFS) may still refuse.
"""

from __future__ import annotations

from contextlib import suppress
from typing import Final

from flexdt.runtime.files.directory import Directory, writing
from flexdt.twin.dataset.dataset_errors import DiskFullError

SPARE_BYTES: Final = 256 << 10
"""Size of a spare file [bytes]; longer documents need room on the disk."""
SPARE_FILES: Final = 8
"""Number of spare files."""
PREFIX: Final = ".reserve-"
NAMES: Final = tuple(f"{PREFIX}{i}" for i in range(SPARE_FILES))


class SpareFiles:
    """The spare files of a directory; callers take turns.

    Args:
        folder: where they are, and the documents.
    """

    def __init__(self, folder: Directory) -> None:
        """Find the usable spare files of a folder, and make the missing ones as far as there
        is room.
        """
        self._folder = folder
        self._there = {name for name in NAMES if self._usable(name)}
        self._refill()

    def keep(self, name: str, data: bytes) -> None:
        """Write a document and wait for the disk; on a full disk into a spare file.

        That holds `SPARE_BYTES`. Missing spare files are then made. Raises
        DatasetWriteError.
        """
        try:
            self._folder.keep(name, data)
        except DiskFullError:
            if len(data) > SPARE_BYTES or not self._keep_in_spare(
                name, data.ljust(SPARE_BYTES)
            ):
                raise
        if len(self._there) < SPARE_FILES:
            self._refill()

    def _keep_in_spare(self, name: str, data: bytes) -> bool:
        """Write a document over a spare file and rename that to the document's name, and
        wait for the disk.

        The replaced document becomes a spare file if it has the size of one. Spare files
        that are not usable are deleted.

        Args:
            name: of the document.
            data: its content, of `SPARE_BYTES`.

        Returns:
            False if there is no usable spare file.

        Raises:
            DatasetWriteError, OSError: the system cannot write.
        """
        for spare in sorted(self._there):
            self._there.discard(spare)
            if not self._usable(
                spare
            ):  # another name of the document, from a change taken back
                with suppress(OSError):
                    self._folder.unlink(spare)
                continue
            with writing(
                self._folder.path / name, f"cannot write {self._folder.path / name}"
            ):
                self._folder.overwrite(spare, data)
                self._save(name)
                self._folder.rename(spare, name)
                self._folder.sync()
            return True
        return False

    def _save(self, name: str) -> None:
        """Keep a document that is about to be replaced as a spare file, by a second name.

        Nothing happens unless it has `SPARE_BYTES` and a spare file is missing.
        """
        about = self._folder.stat(name)
        free = [spare for spare in NAMES if spare not in self._there]
        if about is None or about.st_size != SPARE_BYTES:
            return
        for spare in free:
            with suppress(OSError):
                self._folder.link(name, spare)
                self._there.add(spare)
                return

    def _usable(self, name: str) -> bool:
        """Return whether a spare file exists, of full size and with no other name."""
        about = self._folder.stat(name)
        return about is not None and (about.st_size, about.st_nlink) == (SPARE_BYTES, 1)

    def _refill(self) -> None:
        """Find or make the missing spare files; stop at the first for which there is no room."""
        for name in NAMES:
            if name in self._there:
                continue
            try:
                if not self._usable(name):
                    self._folder.allocate(name, SPARE_BYTES)
            except OSError:  # no room yet, or none for us
                return
            self._there.add(name)
