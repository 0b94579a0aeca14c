"""One thread for linear algebra: for hundreds of columns several cost more than they save."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

MAPPED: Final = Path("/proc/self/maps")
"""Lists the libraries of this process: address, permissions, offset, device, inode, path
(proc(5))."""
NAMES: Final = tuple(
    f"{before}openblas_%s_num_threads{after}"
    for before in ("", "scipy_")
    for after in ("", "64_")
)
"""Functions of OpenBLAS that get and set its threads, as builds name them."""


class _Uses:
    """How many want one thread now, and what was there before the first."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.count = 0
        self.before: list[tuple[Callable[[int], object], int]] = []


_USES: Final = _Uses()


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let each loaded OpenBLAS use one thread within.

    Its threads wait for each other in a call: milliseconds on a busy machine, in a call
    of 0.1 ms. Of overlapping uses the last restores what the first found.
    """
    with _USES.lock:
        _USES.count += 1
        if _USES.count == 1:
            _USES.before = [(put, int(get())) for get, put in _openblas()]
            for put, _ in _USES.before:
                put(1)
    try:
        yield
    finally:
        with _USES.lock:
            _USES.count -= 1
            if _USES.count == 0:
                for put, threads in _USES.before:
                    put(threads)


def _openblas() -> list[tuple[Callable[[], int], Callable[[int], object]]]:
    """List the functions that get and set the threads of each OpenBLAS that is loaded."""
    paths: set[str] = set()
    with suppress(OSError):
        parts = [line.split(maxsplit=5) for line in MAPPED.read_text().splitlines()]
        paths = {p[5] for p in parts if len(p) == 6 and "openblas" in p[5]}
    found: list[tuple[Callable[[], int], Callable[[int], object]]] = []
    for path in sorted(paths):
        with suppress(OSError):
            library = ctypes.CDLL(path)
            names = [n for n in NAMES if hasattr(library, n % "set")]
            found += [(library[n % "get"], library[n % "set"]) for n in names[:1]]
    return found
