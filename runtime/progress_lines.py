"""Progress of work that takes seconds, reported every two of them."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

SILENT_S = 2.0
"""Interval of progress lines [s]."""
_last = [0.0, 0.0]
"""Times of the newest line and of the end of the newest work [s]: kernels compile
one by one."""


@contextmanager
def told(what: str) -> Iterator[None]:
    """Report work inside that takes long, to the log and so to standard error.

    Args:
        what: the work, for the line.
    """
    done = threading.Event()
    begun = time.monotonic()
    if begun > _last[1] + SILENT_S:
        _last[0] = begun

    def tell() -> None:
        """Log a line every `SILENT_S` until the work is done."""
        while not done.wait(max(0.0, _last[0] + SILENT_S - time.monotonic())):
            _last[0] = time.monotonic()
            logging.getLogger("flexdt.kernels").warning(
                "flexdt: still %s (%.0f s)", what, _last[0] - begun
            )

    threading.Thread(target=tell, name="flexdt-long-work", daemon=True).start()
    try:
        yield
    finally:
        done.set()
        _last[1] = time.monotonic()
