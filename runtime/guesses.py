"""Wrong tokens at a port: each is logged, and answered the later the more its address has
sent, over however many connections."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from threading import Lock
from typing import Final

from flexdt.runtime.log import Sparing
from flexdt.runtime.waiting_room import neighbourhood

STEP_S: Final = 0.2
"""Time by which each wrong token of an address is answered later than the last [s]."""
MAX_DELAY_S: Final = 5.0
FORGOTTEN_S: Final = 60.0
"""Time without a wrong token after which an address begins anew [s]."""
MAX_ADDRESSES: Final = 4096
"""Largest number of addresses that are counted; beyond it the oldest is forgotten."""


class Guesses:
    """Counts the wrong tokens at one port; any thread may call.

    Args:
        lines: of the port's log; None for lines of its own.
        clock: returns the time [s].
    """

    def __init__(
        self, lines: Sparing | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin without a wrong token."""
        self._lines = lines or Sparing()
        self._clock = clock
        self._counts: dict[str, tuple[int, float]] = {}
        """Address -> wrong tokens, and when the last one came; the oldest first."""
        self._lock = Lock()

    def wrong(self, client: str, host: str) -> float:
        """Count a wrong token, log it, and return how long its answer must wait [s].

        A right token is never late: other clients of the address lose nothing.

        Args:
            client: that sent it, for the log.
            host: its IP address; counted as `neighbourhood` has it.
        """
        address, now = neighbourhood(host), self._clock()
        with self._lock:
            count, last = self._counts.pop(address, (0, now))
            count = 1 if now - last > FORGOTTEN_S else count + 1
            self._counts[address] = count, now
            if len(self._counts) > MAX_ADDRESSES:
                del self._counts[next(iter(self._counts))]
            self._lines.log("wrong token", logging.WARNING, client=client, count=count)
        return min(STEP_S * count, MAX_DELAY_S)
