"""Structured logs: each line on standard error is one JSON object.

`log(event, **facts)` goes through `logging`, so a host program may route it elsewhere.
Callers pass the facts that matter, never images, tokens or complete messages.

Lines of both servers carry the id of the request that is being worked on. The twin gives
every request an id (connection and number) and every batch of a scan's frames one (job
and first file). Its requests to the projector carry that id.
"""

from __future__ import annotations

import atexit
import contextlib
import json
import logging
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from logging.handlers import QueueHandler, QueueListener
from typing import TextIO

_CURRENT: ContextVar[str] = ContextVar("flexdt_trace", default="")


def current() -> str:
    """Return the id of the current context; an empty string if there is none."""
    return _CURRENT.get()


@contextmanager
def traced(name: str) -> Iterator[None]:
    """Add the trace `name` to all log lines within the context, and in tasks started in
    it; afterwards the earlier trace is in force.
    """
    token = _CURRENT.set(name)
    try:
        yield
    finally:
        _CURRENT.reset(token)


BURST = 10
"""Number of lines of one kind that are written at once, so that rare ones are all written."""
EVERY_S = 10.0
"""Interval of further lines of the kind [s].

370 lines in the first hour, 70 kB of 200 bytes each, so that a dozen kinds stay below 1
MB an hour.
"""
LOGGER = logging.getLogger("flexdt")
LIBRARIES = ("py.warnings", "asyncio", "websockets")
LEVELS = {name.lower(): level for name, level in logging.getLevelNamesMapping().items()}


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object: time, level, event, facts, and the
    traceback if any."""

    def format(self, record: logging.LogRecord) -> str:
        """Format a record as one line of JSON: time (UTC, ms), level, event, facts,
        traceback if any.

        A fact named time, level or event replaces that. Values that JSON does not have
        are written as text.
        """
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line: dict[str, object] = {
            "time": f"{stamp}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        line.update(getattr(record, "facts", {}))
        if (
            record.exc_info and record.exc_info[0] is not None
        ):  # False where there is none
            line["traceback"] = record.exc_text or self.formatException(record.exc_info)
        return json.dumps(line, default=str)


class Apart(QueueHandler):
    """Writes records from a thread of its own, so that a blocked reader of the
    log does not block the loop.

    Args:
        target: formats and writes.
        room: records kept while the reader is stuck; further ones are dropped and
            counted.
    """

    def __init__(self, target: logging.Handler, room: int = 10_000) -> None:
        """Write records to `target` from a thread of its own, through a queue of `room`
        records.

        The thread starts now. It is stopped when the process exits.
        """
        super().__init__(queue.Queue(room))
        self.dropped = 0
        self._listener = _Listener(self.queue, target)
        self._listener.start()
        atexit.register(self.close)

    def prepare(self, record: logging.LogRecord) -> logging.LogRecord:
        """Keep the traceback as text: the library's own would fold it into the message."""
        if record.exc_info and not record.exc_text:
            record.exc_text = logging.Formatter().formatException(record.exc_info)
        return record

    def enqueue(self, record: logging.LogRecord) -> None:
        """Queue one record; with a full queue it is dropped, and counted in `dropped`."""
        try:
            self.queue.put_nowait(record)
        except queue.Full:
            self.dropped += 1

    def close(self) -> None:
        """Write the queued records and end the thread; a reader that blocks for seconds is
        abandoned."""
        self._listener.stop()
        super().close()


class _Listener(QueueListener):
    _thread: threading.Thread | None

    def stop(self) -> None:
        """End the thread after the queued records, waiting at most 1 s for room in the
        queue and 2 s for its end.

        A second call does nothing.
        """
        thread = self._thread
        self._thread = None
        if thread is not None:
            with contextlib.suppress(queue.Full):
                self.queue.put(None, timeout=1.0)  # type: ignore[attr-defined]
                thread.join(2.0)


def dropped() -> int:
    """Return how many records were dropped while the reader was blocked."""
    return sum(h.dropped for h in LOGGER.handlers if isinstance(h, Apart))


def log(
    event: str, level: int = logging.INFO, *, error: bool = False, **facts: object
) -> None:
    """Write one log line of `facts`, with the trace in force.

    `error`: add the traceback.
    """
    trace = current()
    if trace:
        facts.setdefault("trace", trace)
    LOGGER.log(level, event, exc_info=error, extra={"facts": facts})


class Sparing:
    """Limits lines that others cause: the first of each kind, then one at intervals.

    A line that is written after others of its kind were left out has their number
    (`left_out`).

    Args:
        burst: lines of a kind written at once.
        clock: returns the time [s].
    """

    def __init__(
        self, burst: int = BURST, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Allow `burst` lines of each kind at first; `clock` gives seconds."""
        self._burst = burst
        self._clock = clock
        self._kinds: dict[
            str, tuple[float, float, int]
        ] = {}  # when, lines allowed, left out

    def log(
        self,
        event: str,
        level: int = logging.INFO,
        *,
        kind: str = "",
        error: bool = False,
        **facts: object,
    ) -> None:
        """Write a line like `log`, or only count it if there were too many of its kind.

        A kind may have `burst` lines at once, and one more each `EVERY_S`.

        The next line that is written has the number left out as `left_out`.

        Args:
            event: name of the event.
            level: of `logging`.
            kind: that the line counts for; the event if left out.
            error: add the traceback of the error that is handled.
            facts: further members of the line.
        """
        kind = kind or event
        now = self._clock()
        burst = float(self._burst)
        at, allowed, left_out = self._kinds.get(kind, (now, burst, 0))
        allowed = min(burst, allowed + (now - at) / EVERY_S)
        if allowed < 1.0:
            self._kinds[kind] = (now, allowed, left_out + 1)
            return
        self._kinds = {
            k: v for k, v in self._kinds.items() if v[2] or now - v[0] < EVERY_S * burst
        }
        self._kinds[kind] = (now, allowed - 1.0, 0)
        if left_out:
            facts["left_out"] = left_out
        log(event, level, error=error, **facts)


def set_up(
    stream: TextIO = sys.stderr, level: int = logging.INFO, *, apart: bool = False
) -> None:
    """Send this program's log to `stream` as JSON lines, in place of earlier handlers.

    The root logger's get these lines no longer. `apart`: from a thread of its own, with
    warnings and lines of `LIBRARIES`, as a server.
    """
    handler: logging.Handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    if apart:
        handler = Apart(handler)
        logging.captureWarnings(True)
        for name in LIBRARIES:
            logging.getLogger(name).handlers[:] = [handler]
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(level)
    LOGGER.propagate = False
