"""The id of the request that is being worked on, for logs of both servers.

The twin gives every request an id (connection and number) and every batch of a scan's frames one
(job and first file). Its requests to the projector carry that id, and so does each log line.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_CURRENT: ContextVar[str] = ContextVar("flexdt_trace", default="")


def current() -> str:
    """The id of the current context; an empty string where there is none."""
    return _CURRENT.get()


@contextmanager
def traced(name: str) -> Iterator[None]:
    """Set the id for the duration of the context, and for tasks started in it."""
    token = _CURRENT.set(name)
    try:
        yield
    finally:
        _CURRENT.reset(token)
