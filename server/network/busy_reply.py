"""The error sent to a connection when the server already has as many as it may have.

The error has to be in the client's codec, which follows from the client's first byte. An excess
connection therefore waits for that byte for a limited time, at the cost of a socket and a timer. It
has no session and no worker and does not count as a client.
"""

from __future__ import annotations

import asyncio

from flexdt.protocol import Connection, Failure, RpcError

MOST = 512
"""Excess connections that may wait for their error; any more are aborted without one."""


class TurnedAway(asyncio.Protocol):
    """An excess connection; takes over the transport from the protocol that accepted it.

    Args:
        transport: of the connection.
        error: that it gets.
        timeout_s: within which it must send a byte, read the error and disconnect [s].
        others: all excess connections; this one is a member until it ends.
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
        """End the connection, because the server stops."""
        self._transport.abort()

    def data_received(self, data: bytes) -> None:
        """Send the error in the codec that the first byte selects."""
        if self._told or self._transport.is_closing():
            return  # read and discard: closing with bytes unread would lose the answer
        self._told = True
        wire = Connection()
        wire.receive_data(data[:1])
        self._transport.write(wire.send(Failure(None, self._error)))
        if self._transport.can_write_eof():
            self._transport.write_eof()
        else:  # TLS says goodbye by itself
            self._transport.close()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection has ended."""
        self._timer.cancel()
        self._others.discard(self)
        self.gone.set()
