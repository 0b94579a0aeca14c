"""Who waits for work that takes seconds hears every two of them what is done."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from flexdt import long_work

SILENT_S = 2.0


@contextmanager
def told(what: str) -> Iterator[None]:
    """Tell the log, and so standard error, of work that goes on inside."""
    done, begun = threading.Event(), time.monotonic()

    def tell() -> None:
        while not done.wait(SILENT_S):
            seconds = time.monotonic() - begun
            logging.getLogger("flexdt.kernels").warning("flexdt: still %s (%.0f s)", what, seconds)

    threading.Thread(target=tell, name="flexdt-long-work", daemon=True).start()
    try:
        yield
    finally:
        done.set()


def watch() -> None:
    """Tell of the twin's long work in this process."""
    long_work.during = told
