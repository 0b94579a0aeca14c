"""Who may connect: connections without a place, and the token.

Connections without a place wait in a `Room`: those that have not shown the token yet, and clients
that came when all places were taken. A newcomer always gets in, so that it can say hello or stop
the scanner; what it displaces belongs to the address that has most there.
"""

from __future__ import annotations

import asyncio
import ipaddress
import logging
from collections import Counter
from collections.abc import Callable
from typing import Protocol

from flexdt.protocol.rpc_errors import not_authorised
from flexdt.runtime.access import token_matches
from flexdt.runtime.log import Sparing

WRONG_TOKENS = 3
"""Wrong tokens after which a connection is closed."""
WAITING = 512
"""Connections that may wait for a hello: where one address opens 167 a second, each of them still
has 3 s for it."""


class Guest(Protocol):
    """A connection that may be in a room."""

    address: str
    """Where it comes from, as `neighbourhood` has it."""
    gone: asyncio.Event
    """Whether it has ended."""

    def end(self) -> None:
        """Cut the connection off."""

    def displace(self) -> None:
        """Say that there is no place, and close the connection."""


class Room:
    """Connections without a place, in the order in which they came.

    Where it is full, the oldest connection of the address that has most goes. A newcomer thus
    always gets in, and an address with many connections displaces its own.

    Args:
        most: connections.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self.guests: dict[Guest, None] = {}

    def enter(self, guest: Guest) -> None:
        """Let a connection in; cuts off another one if need be."""
        self.guests[guest] = None
        if len(self.guests) > self._most:
            [(crowd, _)] = Counter(g.address for g in self.guests).most_common(1)
            oldest = next(g for g in self.guests if g.address == crowd)
            self.leave(oldest)
            oldest.displace()

    def leave(self, guest: Guest) -> None:
        """A connection has a place now, or has ended; it need not be here."""
        self.guests.pop(guest, None)


def neighbourhood(host: str) -> str:
    """The address for a share: an IPv4 address, or the 64 bits of an IPv6 network (one owner's)."""
    try:
        address = ipaddress.ip_address(host.partition("%")[0])
    except ValueError:
        return host
    if address.version == 4:
        return str(address)
    return str(address.ipv4_mapped or ipaddress.ip_network((address, 64), strict=False))


class TokenCheck:
    """The token that a connection has to show.

    Args:
        token: of the server; None where it has none.
        close: ends the connection after too many wrong tokens.
        lines: of the log.
    """

    def __init__(self, token: str | None, close: Callable[[], object], lines: Sparing) -> None:
        self._token, self._close, self._lines = token, close, lines
        self._wrong = 0

    async def check(self, given: str | None, client: str) -> None:
        """Compare a token; each wrong one is answered later than the one before.

        Raises:
            RpcError: -32004, it is not the server's.
        """
        if self._token is None or token_matches(given, self._token):
            return
        self._wrong += 1
        self._lines.log("wrong token", logging.WARNING, client=client, count=self._wrong)
        await asyncio.sleep(0.2 * self._wrong)
        if self._wrong >= WRONG_TOKENS:
            self._close()
        raise not_authorised()
