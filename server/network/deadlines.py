"""Named timeouts of a connection."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


class Deadlines:
    """Named timeouts of a connection.

    Args:
        on_timeout: called with the name and the seconds of one that has run out.
    """

    def __init__(self, on_timeout: Callable[[str, float], object]) -> None:
        self._on_timeout = on_timeout
        self._timers: dict[str, asyncio.TimerHandle] = {}

    def start(self, name: str, seconds: float | None) -> None:
        """Start a timeout that calls `on_timeout` with name and seconds (None: none).

        Nothing if that name's has not been stopped.
        """
        if seconds is not None and name not in self._timers:
            self._timers[name] = asyncio.get_running_loop().call_later(
                seconds, self._on_timeout, name, seconds
            )

    def stop(self, name: str) -> None:
        """Cancel a timeout if it is running."""
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()

    def clear(self) -> None:
        """Cancel all timeouts; names stay taken until `stop`."""
        for timer in self._timers.values():
            timer.cancel()
