"""The interface between the TCP shell and the application behind it."""

from __future__ import annotations

import pickle
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Protocol

from flexdt.protocol import (
    AnyMethod,
    Codec,
    Connection,
    Message,
    Notification,
    Prepared,
    Request,
    RpcError,
)
from flexdt.protocol.connection import Raw
from flexdt.protocol.fields import Params
from flexdt.protocol.messages import Id, Single

Observe = Callable[[str, float, int | None], None]
"""Called for every answered request: method, seconds, error code or None."""


def unobserved(method: str, seconds: float, code: int | None) -> None:
    """An `Observe` that takes no notice."""


@dataclass(frozen=True)
class Call:
    """A request that another process has read: its validated parameters, or the error in them.

    Attributes:
        answered: whether it wants an answer (a notification does not).
    """

    id: Id
    method: str
    params: Params | RpcError
    answered: bool

    @property
    def message(self) -> Request | Notification:
        """The message as it concerns the order of requests and answers: without parameters."""
        return Request(self.id, self.method) if self.answered else Notification(self.method)


@dataclass(frozen=True)
class Frozen:
    """One message that another process has read, pickled by it.

    Attributes:
        data: to be thawed when its turn comes.
        method: that it calls; empty where it calls none.
    """

    data: bytes
    method: str

    def thawed(self) -> Single | Call:
        """The message."""
        message: Single | Call = pickle.loads(self.data)
        return message


Read = Callable[[Raw, Connection], Awaitable[Frozen | tuple[Frozen, ...]]]
"""Reads a large message of a connection apart from the loop: one message, or those of a batch.

Raises `RpcError` where that takes too much.
"""


class Session(Protocol):
    """The application's state of one connection."""

    async def handle(self, method: AnyMethod, params: Params) -> object:
        """Answer a call: a result model or plain data, or raise `RpcError`."""

    def close(self) -> None:
        """Called once when the connection has ended."""


class Peer(Protocol):
    """A connection as the application sees it."""

    name: str

    @property
    def codec(self) -> Codec:
        """The codec of the connection."""

    def post(self, message: Message | Prepared, slot: str | None = None) -> None:
        """Send an event: the newest of its `slot`, or (None) in order with all others."""

    def close(self, reason: str) -> None:
        """End the connection after what is queued has gone out."""


Open = Callable[[Peer], Session]
"""Opens the application's state of a connection that has been made (and let in)."""
