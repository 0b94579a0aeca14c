"""Structured logs: one JSON object a line on standard error.

`log(event, **facts)` goes through `logging`, so a host program may route it elsewhere. It refuses
to log images, tokens or whole messages: callers pass the facts that matter.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from typing import TextIO

LOGGER = logging.getLogger("flexdt")


class JsonLines(logging.Formatter):
    """Formats a record as one JSON object: time, level, event, facts, and the traceback if any."""

    def format(self, record: logging.LogRecord) -> str:
        """One line of JSON."""
        stamp = time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created))
        line: dict[str, object] = {
            "time": f"{stamp}.{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "event": record.getMessage(),
        }
        line.update(getattr(record, "facts", {}))
        if record.exc_info and record.exc_info[0] is not None:  # False where there is none
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def log(event: str, level: int = logging.INFO, *, error: bool = False, **facts: object) -> None:
    """Write one line; `error` adds the traceback of the exception being handled."""
    LOGGER.log(level, event, exc_info=error, extra={"facts": facts})


def set_up(stream: TextIO = sys.stderr, level: int = logging.INFO) -> None:
    """Send this program's log to `stream` as JSON lines (for a process's main)."""
    handler = logging.StreamHandler(stream)
    handler.setFormatter(JsonLines())
    LOGGER.handlers[:] = [handler]
    LOGGER.setLevel(level)
    LOGGER.propagate = False
