"""Open HDF5 files that strangers wrote: a damaged one ends in an error, never the process.

Some damage ends a process inside the HDF5 library itself (a segmentation fault for 1 of 600 files
with exchanged bytes), which no `except` sees. So a child process, forked where the system can,
walks through the file first; what it survives, this process reads.
"""

from __future__ import annotations

import faulthandler
import os
import subprocess
import sys
import threading
import warnings
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Final

from flexdt.library.optional.extras import package
from flexdt.twin.dataset.dataset_errors import DatasetFormatError

SMALL_BYTES: Final = 1 << 20
"""Largest data set that is read whole on the way; of others three members are."""
PATIENCE_CPU_S: Final = 60
"""Processor time that a child has: of a healthy file it reads hardly any pixels (assumed)."""
MAX_SOUND: Final = 64
"""Files that are remembered as sound, by what a change of them changes."""
FORKS: Final = sys.platform.startswith("linux")
"""Whether a fork is safe: of other systems' libraries some are not."""
_sound: OrderedDict[tuple[int, ...], None] = OrderedDict()
_lock: Final = threading.Lock()


@contextmanager
def hdf5_file(path: Path, what: str) -> Iterator[Any]:
    """Open an HDF5 file for reading, if it is sound.

    Raises TwinError: `what` needs h5py; DatasetFormatError, OSError.
    """
    h5py = package("h5py", what)
    _require_sound(path, h5py)
    with h5py.File(path) as file:
        yield file


def _require_sound(path: Path, h5py: Any) -> None:
    """Let a child walk through a file, unless one has.

    Raises:
        DatasetFormatError: the child did not come back.
    """
    about = path.stat()
    key = (about.st_dev, about.st_ino, about.st_size, about.st_mtime_ns)
    with _lock:
        if key in _sound:
            _sound.move_to_end(key)
            return
    if not (_survived_fork if FORKS else _survived_program)(path, h5py):
        said = f"{path} is no HDF5 file, or a damaged one: reading it ends the process"
        raise DatasetFormatError(said, {"path": str(path)})
    with _lock:
        _sound[key] = None
        while len(_sound) > MAX_SOUND:
            _sound.popitem(last=False)


def _survived_fork(path: Path, h5py: Any) -> bool:
    """Return whether a fork of this process walks through a file."""
    with warnings.catch_warnings():
        # The child calls HDF5 alone, whose lock this thread holds: no other can be inside.
        warnings.simplefilter("ignore", DeprecationWarning)
        with h5py._objects.phil:
            child = os.fork()
            if not child:
                _end_as_child(path, h5py)
    _, status = os.waitpid(child, 0)
    return os.WIFEXITED(status)


def _end_as_child(path: Path, h5py: Any) -> None:
    """Walk through a file and end this process, whatever happens; nothing is printed."""
    try:
        faulthandler.disable()
        import resource  # POSIX alone has it, and there alone is forked

        resource.setrlimit(resource.RLIMIT_CPU, (PATIENCE_CPU_S, PATIENCE_CPU_S))
        nowhere = os.open(os.devnull, os.O_RDWR)
        for stream in (0, 1, 2):
            os.dup2(nowhere, stream)
        walk(path, h5py)
    finally:
        os._exit(0)  # an error is no harm: the parent meets it, too


def _survived_program(path: Path, h5py: Any) -> bool:
    """Return whether a program of its own walks through a file."""
    code = f"import h5py; from {__name__} import walk; walk({str(path)!r}, h5py)"
    try:
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, timeout=PATIENCE_CPU_S
        )
    except subprocess.TimeoutExpired:
        return False
    return done.returncode in (0, 1)


def walk(path: Path | str, h5py: Any) -> None:
    """Read the structure of a file, its attributes, small data sets, and members of others.
    `path`: of the file; `h5py`: the package. Raises Exception: any that the library has for a
    damaged file."""
    with h5py.File(path) as file:
        _attributes(file)
        file.visititems(lambda _, item: _visit(item))


def _visit(item: Any) -> None:
    """Read the attributes of an object, and some of its values; errors are passed over."""
    with suppress(Exception):
        _attributes(item)
    with suppress(Exception):
        for name in item:
            item.get(name, getlink=True)
            item.get(name)
    with suppress(Exception):
        if item.nbytes <= SMALL_BYTES:
            item[()]
        else:
            item.id.get_storage_size()
            for at in (0, len(item) // 2, len(item) - 1):
                item[at]


def _attributes(item: Any) -> None:
    for name in item.attrs:
        with suppress(Exception):
            item.attrs[name]
