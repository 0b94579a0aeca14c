"""One connection's life in an event loop: one task reads, any number of tasks send requests.

The asyncio counterpart of `link` and of `TcpTransport`.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import ssl as tls
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from flexdt.clients.client.transport import ConnectionLost, checked_port
from flexdt.protocol import (
    Answered,
    Codec,
    Connection,
    Correlation,
    Message,
    Notification,
    ProtocolError,
    Role,
)


class AsyncTransport(Protocol):
    """A connection to a server. `open` may be called again after the connection has been lost."""

    async def open(self) -> None:
        """Connect, or raise `ConnectionLost`."""

    async def send(self, message: Message) -> None:
        """Send one message, or raise `ConnectionLost`."""

    async def receive(self) -> list[Message]:
        """At least one message; empty only when the connection has ended.

        Raises:
            ProtocolError: the server ended the connection inside a message.
        """

    def close(self) -> None:
        """End the connection and wake up `receive`; does nothing when there is none."""


class AsyncTcpTransport:
    """Streams of asyncio.

    Args:
        host, port: of the server.
        codec: what to speak; MessagePack carries images without base64.
        timeout_s: for connecting.
        ssl: a client's TLS context; None speaks plain TCP.
    """

    def __init__(
        self,
        host: str,
        port: int,
        *,
        codec: Codec = Codec.MSGPACK,
        timeout_s: float = 5.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        self.host, self.port, self.codec = host, checked_port(port), codec
        self.timeout_s, self.ssl = timeout_s, ssl
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._wire = Connection(codec)

    async def open(self) -> None:
        """Connect anew."""
        self.close()
        try:
            async with asyncio.timeout(self.timeout_s):
                name = None if self.ssl is None else self.host
                self._streams = await asyncio.open_connection(
                    self.host, self.port, ssl=self.ssl, server_hostname=name
                )
        except OSError as error:  # TimeoutError is one
            why = error.strerror or str(error) or "no answer in time"
            if isinstance(error, ConnectionError) and error.errno is not None:
                why = os.strerror(error.errno)  # asyncio has put the address there
            raise ConnectionLost.at_first(self.host, self.port, why, error) from error
        self._wire = Connection(self.codec)

    async def send(self, message: Message) -> None:
        """Send one message; the bytes are handed over whole, so a cancelled call breaks nothing."""
        data = self._wire.send(message)
        if self._streams is None:
            raise ConnectionLost(f"not connected to {self.host}:{self.port}")
        writer = self._streams[1]
        try:
            writer.write(data)
            await writer.drain()
        except OSError as error:
            why = error.strerror or str(error)
            raise ConnectionLost(
                f"the connection to {self.host}:{self.port} broke ({why})", sent=True
            ) from error

    async def receive(self) -> list[Message]:
        """Messages, or an empty list at the end."""
        messages: list[Message] = []
        while not messages:
            streams = self._streams
            if streams is None:
                return []
            try:
                data = await streams[0].read(1 << 18)
            except OSError:
                return []
            if not data:
                if self._streams is not None:  # the server's end of the stream, not our `close`
                    self._wire.receive_end()
                return []
            messages = self._wire.receive_data(data)
        return messages

    def close(self) -> None:
        """Close the streams."""
        streams, self._streams = self._streams, None
        if streams is not None:
            with contextlib.suppress(RuntimeError):  # the loop it belonged to is gone
                streams[1].close()


class AsyncLink:
    """An open connection; made by `opened`.

    Attributes:
        alive: until the connection has ended.
        calls: its open requests; `calls.reason` is what the server reported about the connection.
    """

    def __init__(
        self,
        transport: AsyncTransport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        self._transport, self._on_event, self._on_end = transport, on_event, on_end
        self.calls: Correlation[asyncio.Future[Answered[Any]]] = Correlation(Role.CLIENT)
        self.alive = True
        self._reader = asyncio.create_task(self._read(), name="flexdt-link")

    @classmethod
    async def opened(
        cls,
        transport: AsyncTransport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> AsyncLink:
        """Connect.

        Raises:
            ConnectionLost: no server answers.
        """
        await transport.open()
        return cls(transport, on_event, on_end)

    async def request(
        self, method: str, params: Mapping[str, object], timeout_s: float | None
    ) -> object:
        """Send a request and wait for its result; raises what `Link.request` does."""
        if not self.alive:
            raise ConnectionLost.of(self.calls, sent=False)
        waiter: asyncio.Future[Answered[Any]] = asyncio.get_running_loop().create_future()
        request = self.calls.request(method, params, waiter)
        # A call cancelled while it sends may have handed its bytes over, so its answer may come.
        sent = True
        try:
            async with asyncio.timeout(timeout_s) as limit:
                try:
                    await self._transport.send(request)
                except Exception:
                    sent = False
                    raise
                return (await waiter).result()
        except TimeoutError:
            if not limit.expired():
                raise
            raise TimeoutError(f"no answer to {method} within {timeout_s:g} s") from None
        finally:
            self.calls.abandon(request, sent=sent)
            waiter.cancel()

    async def ended(self) -> None:
        """Wait until the connection has ended."""
        await asyncio.wait([self._reader])

    async def close(self) -> None:
        """End the connection; waiting requests fail."""
        self._transport.close()
        self._reader.cancel()
        await self.ended()

    async def _read(self) -> None:
        try:
            while messages := await self._transport.receive():
                for message in messages:
                    self._take(message)
        except ProtocolError as violation:
            self.calls.violate(violation)
            self._transport.close()
        finally:
            self.alive = False
            for waiter in self.calls.waiting():
                if not waiter.done():
                    waiter.set_exception(ConnectionLost.of(self.calls, sent=True))
            self._on_end()

    def _take(self, message: Message) -> None:
        for item in self.calls.receive(message):
            match item:
                case Answered(waiter) if not waiter.done():
                    waiter.set_result(item)
                case Notification("event", params) if isinstance(params, Mapping):
                    self._on_event(params)
