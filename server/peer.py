"""The seam between the TCP shell and an application: what each may ask of the other.

It refuses to hold any of either.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from flexdt.protocol import Message, Method, Prepared
from flexdt.protocol.fields import Params

Observe = Callable[[str, float, int | None], None]
"""Told of every answered request: method, seconds, error code or None."""


class Session(Protocol):
    """What the application keeps for one connection."""

    async def handle(self, method: Method, params: Params) -> object:
        """Answer a call: a result model or plain data, or raise `RpcError`."""

    def close(self) -> None:
        """The connection is gone; called once."""


class Peer(Protocol):
    """What the application may do with a connection."""

    name: str

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        """Send an event: the newest of its `slot`, or (None) in order with all others."""

    def close(self, reason: str) -> None:
        """End the connection after what is queued has gone out."""


class App(Protocol):
    """An application served over TCP."""

    def open(self, peer: Peer) -> Session:
        """A connection has been made (and let in)."""
