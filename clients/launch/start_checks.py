"""Checks of servers' settings before any process is started."""

from __future__ import annotations

import errno
import os
from os import PathLike
from pathlib import Path


def require_startable(
    machine: str | PathLike[str] | None = None,
    profile: str | PathLike[str] | None = None,
    sample: str | None = None,
    data: Path | None = None,
) -> None:
    """Check the words that a twin server is started with.

    Of a sample only the name, and not where the data folder may hold one. None: the
    FleX-ray, its profile, the twin's own sample and folder.

    Raises TwinError: an unknown name, or a wrong file; OSError: the folder cannot be
    written.
    """
    from flexdt.library import machines

    if machine is not None or profile is not None:
        machines.profile(profile, machines.machine(machine), _text(machine))
    if data is not None:
        _require_folder(data)
    if sample is not None and not _may_keep_samples(data):
        _require_sample(sample)


def _text(word: str | PathLike[str] | None) -> str | None:
    """Return a name or path as text."""
    return None if word is None else str(word)


def _require_folder(folder: Path) -> None:
    """Check that a folder can be written, or made.

    A path that exists but is no folder raises NotADirectoryError.
    Raises OSError: it cannot; names the folder.
    """
    from flexdt.runtime.files.writable import require_writable

    if folder.exists() and not folder.is_dir():
        why = os.strerror(errno.ENOTDIR)
        raise NotADirectoryError(errno.ENOTDIR, why, str(folder))
    require_writable(folder)


def _may_keep_samples(data: Path | None) -> bool:
    """Check whether a data folder may hold uploads, whose names the twin alone knows."""
    return data is not None and data.is_dir() and any(data.iterdir())


def _require_sample(name: str) -> None:
    """Check that a sample ships.

    "" and the empty stage are always allowed.
    Raises UnknownNameError: it does not; lists those that do."""
    from flexdt.phantoms import load_phantom
    from flexdt.twin.scanner.state import EMPTY_STAGE

    if name not in ("", EMPTY_STAGE):
        load_phantom(name)
