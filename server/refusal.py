"""What a connection gets when the server has as many as it may have: a reason it can read.

A refusal is an answer in the client's own codec, which the client's first byte tells; so a
connection too many waits for that byte, for a while, at the cost of a socket and a timer. It is no
client: no session, no worker, no place among those that are counted. It refuses to read requests.
"""

from __future__ import annotations

import asyncio

from flexdt.protocol import Connection, Failure, RpcError

MOST = 512
"""Connections that wait to be told; any more are cut off without a word."""


class TurnedAway(asyncio.Protocol):
    """One connection too many; made while its transport has another protocol.

    Args:
        transport: of the connection.
        error: what it is told.
        timeout_s: how long it may take to say something, hear the answer and go [s].
        others: those like it; it is among them until its end.
    """

    def __init__(
        self,
        transport: asyncio.Transport,
        error: RpcError,
        timeout_s: float,
        others: set[TurnedAway],
    ) -> None:
        self._transport, self._error, self._others = transport, error, others
        self.gone = asyncio.Event()
        self._told = False
        others.add(self)
        self._timer = asyncio.get_running_loop().call_later(timeout_s, transport.abort)
        transport.set_protocol(self)
        if len(others) > MOST:
            transport.abort()

    def end(self) -> None:
        """The server ends."""
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """The first byte tells the codec."""
        if self._told or self._transport.is_closing():
            return  # what comes is thrown away: a socket closed over it would lose the answer
        self._told = True
        wire = Connection()
        wire.receive_data(data[:1])
        self._transport.write(wire.send(Failure(None, self._error)))
        if self._transport.can_write_eof():
            self._transport.write_eof()
        else:  # TLS says goodbye by itself
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone."""
        self._timer.cancel()
        self._others.discard(self)
        self.gone.set()
