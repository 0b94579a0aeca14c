"""Room on the disk for what comes in large: scans and uploads leave some for all that is small.

State, jobs and corrections are small and must be written. What is large is refused before it takes
the last room, so that only other programs can fill the disk; then what must be written goes into
spare files (`runtime/files/spare_files.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flexdt.runtime.files.directory import Directory, free_bytes
from flexdt.runtime.files.own_documents import used_bytes
from flexdt.twin.dataset.dataset_errors import DiskFullError

RESERVE_BYTES: Final = 16 << 20
"""Left free by what is about to begin: for texts, documents and the file system's own needs."""
LAST_BYTES: Final = 4 << 20
"""Left free by each image and each part of an upload."""


@dataclass(frozen=True)
class DiskRoom:
    """The disk of a data directory.

    Attributes:
        root: the data directory.
        quota: bytes that it may hold; None for what the disk holds.
    """

    root: Directory
    quota: int | None = None

    def require(self, what: str, size: int, there: int = 0) -> None:
        """Refuse what the disk cannot hold, or the quota does not allow; it walks the directory.

        Args:
            what: that is about to begin.
            size: bytes it takes.
            there: of these, bytes that are there already.

        Raises:
            DiskFullError: says what is needed and what is free.
        """
        need, free = size + RESERVE_BYTES - there, free_bytes(self.root.path)
        if self.quota is not None:
            left = max(0, self.quota - used_bytes(self.root))
            free = left if free is None else min(free, left)
        if free is not None and free < need:
            raise DiskFullError(
                f"{what} needs {need / 1e6:.1f} MB, of which {RESERVE_BYTES / 1e6:.1f} MB are to "
                f"stay free; {free / 1e6:.1f} MB are free in {self.root.path}",
                {"asked": need, "allowed": free, "path": str(self.root.path)},
            )


def require_last(folder: Path, what: str, size: int) -> None:
    """Refuse what would leave no room for what must be written.

    Args:
        folder: on the disk.
        what: that is to be written, for the message.
        size: its bytes.

    Raises:
        DiskFullError: as if the disk was full.
    """
    free, need = free_bytes(folder), size + LAST_BYTES
    if free is not None and free < need:
        raise DiskFullError(
            f"no room for {what}: {size} bytes asked, {free} bytes free, of which {LAST_BYTES} are "
            "kept for the state",
            {"path": str(folder / what), "bytes": need, "free": free},
        )
