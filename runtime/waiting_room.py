"""Connections without a place, at every port: which of too many stay.

A connection waits in a `WaitingList` until it has shown the token, if its port has one, or a
request that is served: the token, or without one a request that is served. A newcomer
always gets in, so that it can identify itself; it displaces one of the address that has
most there.
"""

from __future__ import annotations

import ipaddress
from collections import Counter
from typing import Final, Generic, Protocol, TypeVar

MAX_WAITING: Final = 512
"""Largest number of connections of a port that wait.

Where one address opens 167 a second, each of them still has 3 s to identify itself.
"""


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
    """Return the address by which connections are counted: an IPv4 address itself, or the
    first 64 bits of an IPv6 address (one owner's) as a network.

    An IPv4 address written as IPv6 counts as IPv4. A zone is cut off. A text that is no
    address is returned unchanged.
    """
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return str(address)
    return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))
