"""The id of the request that is being worked on, for logs of both servers.

The twin gives every request an id (connection and number) and every batch of a scan's frames one
(job and first file); what it asks of the projector bears that id, and each log line carries it. It
refuses to carry anything else.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_CURRENT: ContextVar[str] = ContextVar("flexdt_trace", default="")


def current() -> str:
    """The id in force here, "" where there is none."""
    return _CURRENT.get()


@contextmanager
def traced(name: str) -> Iterator[None]:
    """Whatever is done inside bears the id `name`; threads and tasks begun there too."""
    token = _CURRENT.set(name)
    try:
        yield
    finally:
        _CURRENT.reset(token)
