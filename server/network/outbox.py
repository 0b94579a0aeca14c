"""The send queue of a connection.

Messages go straight to the transport while the client keeps up. Otherwise state-like
events keep the newest value per slot and ordered ones a bounded queue. Sending never
blocks; a caller that has to wait for a slow client awaits `room`.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Protocol

from pydantic import BaseModel

from flexdt.protocol import Connection, Prepared, RpcError
from flexdt.protocol import messages as m
from flexdt.protocol.rpc_errors import internal
from flexdt.runtime.access import ConnectionLimits

WRITE_BYTES = 1 << 18
"""Largest number of bytes given to the transport at a time; it copies the bytes that it
cannot send at once."""


class SendTarget(Protocol):
    """A connection as its send queue sees it."""

    wire: Connection
    limits: ConnectionLimits
    transport: asyncio.Transport

    def abort(self, reason: str) -> None:
        """Abort the connection."""

    def log(
        self,
        event: str,
        level: int = logging.INFO,
        *,
        error: bool = False,
        **facts: object,
    ) -> None:
        """Write a line about the connection."""


class Outbox:
    """The send queue: replies and ordered events in order, then the newest
    value of each slot."""

    def __init__(self, link: SendTarget) -> None:
        """Make an empty queue to a connection that takes bytes."""
        self.link = link
        self.ready = asyncio.Event()
        self.ready.set()
        self.over = False
        self.queue: deque[bytes] = deque()
        self.unsent = 0
        self.slots: dict[str, m.Message | Prepared] = {}

    def reply(self, message: m.Response | m.Failure) -> None:
        """Send or queue an answer."""
        self.send(self.encode(message))

    def send(self, body: Sequence[bytes]) -> None:
        """Send or queue the body from `encode`, or several of them as a batch.

        A batch that is too large is replaced by one error without an id. Dropped if the
        connection has ended or is closing.
        """
        wire = self.link.wire
        try:
            pieces = wire.framed(body)
        except RpcError as error:  # `encode` has seen to it that this is a batch
            pieces = wire.framed(wire.body(m.Failure(None, error)))
        self._put_all(pieces)

    def encode(self, message: m.Response | m.Failure) -> list[bytes]:
        """Encode an answer; if that is impossible, encode an error with its id instead.

        Too large for a message: that error. Values that are not finite, or of a wrong
        type: an internal error, and a log line that names the place.

        Returns:
            The pieces of the body; nothing is sent.
        """
        wire = self.link.wire
        try:
            body = wire.body(message)
            wire.framed(body)
        except RpcError as error:
            return wire.body(m.Failure(message.id, error))
        except (ValueError, TypeError, OverflowError):
            where = _not_finite(m.to_plain(message))
            self.link.log("reply not sent", logging.ERROR, error=True, where=where)
            return wire.body(m.Failure(message.id, internal()))
        return body

    def event(self, message: m.Message | Prepared, slot: str | None) -> None:
        """Send an event now, or keep it while the transport is full: newest of its slot,
        or in order.

        Nothing if the connection has ended or is closing. An event that cannot be
        encoded is logged and dropped. A connection whose queue has `max_events` writes
        or more is aborted at an event that would be sent.

        Args:
            message: notification, or its bytes.
            slot: of which only the newest event is kept; None keeps all, in order.
        """
        if self.over or self.link.transport.is_closing():
            return
        if slot is not None and not self.ready.is_set():
            # A slot keeps its place in the row: one that is filled often does not pass the
            # others.
            self.slots[slot] = message
            return
        # Ordered events cannot be left out: a client that does not take them is cut off.
        if len(self.queue) >= self.link.limits.max_events:
            # At once: the transport tells of its end in a later turn, and events may come
            # before.
            self.over = True
            self.link.abort(f"{len(self.queue)} events unread")
            return
        self._put_event(message)

    def _put_event(self, message: m.Message | Prepared) -> None:
        """Encode and send an event; one that cannot be encoded is logged and dropped."""
        try:
            self._put_all(self.link.wire.pieces(message))
        except (RpcError, ValueError, TypeError, OverflowError):
            self.link.log("event not sent", logging.ERROR, error=True)

    def _put_all(self, pieces: Sequence[bytes]) -> None:
        """Send or queue pieces: one write if they have at most `WRITE_BYTES` together.

        Else each piece in writes of its own of at most `WRITE_BYTES`.
        """
        # Each write costs a system call; joining small pieces costs less than a second one.
        if sum(map(len, pieces)) <= WRITE_BYTES:
            self._put(b"".join(pieces))
            return
        for piece in pieces:
            for at in range(0, len(piece), WRITE_BYTES):
                self._put(piece[at : at + WRITE_BYTES])

    def _put(self, data: bytes) -> None:
        """Write bytes to the transport if it takes them, else queue them.

        Dropped if the connection has ended or is closing.
        """
        if self.over or self.link.transport.is_closing():
            return  # asyncio would complain of every write to a connection that is gone
        # The transport may call `pause` within `write`: the next piece is then queued behind.
        if self.ready.is_set():
            self.link.transport.write(data)
        else:
            self.queue.append(data)
            self.unsent += len(data)

    def pause(self) -> None:
        """Stop writing: the transport is full."""
        self.ready.clear()

    def resume(self) -> None:
        """Mark the transport as ready; write the queue, then the events of slots,
        until it is full.

        Slots are written in the order in which they were filled. The queue is
        dropped if the transport is closing.
        """
        self.ready.set()
        # Each write may fill the transport again, which clears `ready`.
        while self.queue and self.ready.is_set():
            data = self.queue.popleft()
            self.unsent -= len(data)
            if not self.link.transport.is_closing():
                self.link.transport.write(data)
        # Slots last: answers in the queue may be older than the state in a slot.
        while self.slots and self.ready.is_set():
            slot = next(iter(self.slots))
            self._put_event(self.slots.pop(slot))

    async def room(self) -> None:
        """Wait until at most `max_unsent` bytes are queued, or the connection has ended."""
        while self.unsent > self.link.limits.max_unsent and not self.over:
            await self.ready.wait()

    async def flushed(self) -> None:
        """Wait until queue and slots have been handed to the transport, or the connection has
        ended. It does not wait until the transport has sent them."""
        while (self.queue or self.slots) and not self.over:
            await self.ready.wait()

    def lost(self) -> None:
        """Drop the queue, as the connection ended, and wake who waits to send."""
        self.over = True
        self.queue.clear()
        self.slots.clear()
        self.ready.set()


def _not_finite(value: object, path: str = "$") -> str | None:
    """Find the path of the first number that JSON cannot represent, for the log.

    Depth first, in the order of keys and items.

    Args:
        value: of a message: model, mapping, list, tuple or number; others count as
            finite.
        path: to the value.

    Returns:
        "PATH: NUMBER", for example "$.result.x: nan"; None if all are finite.
    """
    match value:
        case float():
            if math.isfinite(value):
                return None
            return f"{path}: {value}"
        case BaseModel():
            return _not_finite(value.model_dump(), path)
        case Mapping():
            inner = [(f"{path}.{key}", v) for key, v in value.items()]
        case list() | tuple():
            inner = [(f"{path}[{i}]", v) for i, v in enumerate(value)]
        case _:
            return None
    return next((found for p, v in inner if (found := _not_finite(v, p))), None)
