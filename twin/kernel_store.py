"""Where compiled kernels are kept between processes, as the process decides."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Protocol


class KernelStore(Protocol):
    """Bytes by name, for longer than a process lives. No method raises for the disk's sake."""

    def load(self, name: str) -> bytes | None:
        """Return what was saved under a name, whole; None without it."""

    def save(self, name: str, data: bytes) -> None:
        """Keep data under a name, if anything can be kept."""

    def holds(self, beginning: str) -> bool:
        """Return whether anything is kept whose name begins so."""


class NoStore:
    """Keep nothing."""

    def load(self, name: str) -> None:
        """Return None."""
        return

    def save(self, name: str, data: bytes) -> None:
        """Do nothing."""

    def holds(self, beginning: str) -> bool:
        """Return False."""
        return False


opened_by: Callable[[], KernelStore] = NoStore
"""Makes the process's store when the first kernel asks for it; `flexdt` sets it."""


@cache
def store() -> KernelStore:
    """Return the process's store, made by `opened_by` at the first call."""
    return opened_by()
