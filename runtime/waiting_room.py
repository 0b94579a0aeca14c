"""Connections without a place, at every port: which of too many stay, and how late wrong
tokens are answered.

A connection waits in a `WaitingList` until it has shown the token, if its port has one, or a
request that is served: the token, or without one a request that is served. A newcomer
always gets in, so that it can identify itself; it displaces one of the address that has
most there. Wrong tokens (`Guesses`) are logged, and answered the later the more an address
has sent, over however many connections.
"""

from __future__ import annotations

import ipaddress
import logging
import time
from collections import Counter
from collections.abc import Callable
from threading import Lock
from typing import Final, Generic, Protocol, TypeVar

from flexdt.runtime.log import Sparing

MAX_WAITING: Final = 512
"""Largest number of connections of a port that wait.

Where one address opens 167 a second, each of them still has 3 s to identify itself.
"""
STEP_S: Final = 0.2
"""Time by which each wrong token of an address is answered later than the last [s]."""
MAX_DELAY_S: Final = 5.0
FORGOTTEN_S: Final = 60.0
"""Time without a wrong token after which an address begins anew [s]."""
MAX_ADDRESSES: Final = 4096
"""Largest number of addresses that are counted; beyond it the oldest is forgotten."""


class PendingConnection(Protocol):
    """A connection that may be in a room."""

    address: str
    """Where it comes from, as `neighbourhood` has it."""

    def displace(self) -> None:
        """Close the connection: a newer one needs the room."""


_G = TypeVar("_G", bound=PendingConnection)


class WaitingList(Generic[_G]):
    """Connections without a place, in the order in which they came.

    Where it is full, the oldest connection of the address that has most goes. A newcomer
    thus always gets in, and an address with many connections displaces its own.

    Args:
        most: connections.
    """

    def __init__(self, most: int) -> None:
        """Make an empty room for `most` connections."""
        self._most = most
        self.guests: dict[_G, None] = {}

    def enter(self, guest: _G) -> None:
        """Admit a connection; above `most` displace the oldest one of the address that
        has most, which may be this one.
        """
        self.guests[guest] = None
        if len(self.guests) > self._most:
            [(crowd, _)] = Counter(g.address for g in self.guests).most_common(1)
            oldest = next(g for g in self.guests if g.address == crowd)
            self.leave(oldest)
            oldest.displace()

    def leave(self, guest: _G) -> None:
        """Remove a connection that has a place now, or has ended; it need not be here."""
        self.guests.pop(guest, None)


def neighbourhood(host: str) -> str:
    """Return the address by which connections are counted: IPv4, or IPv6's first 64 bits.

    IPv4 within IPv6 counts as IPv4; zones are cut off. Other texts stay.
    """
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return str(address)
    return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))


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
