"""One connection's life in an event loop: a task reads, any number of tasks ask.

The asyncio sibling of `link` and of `TcpTransport`; ids, answers and events are `answers`'.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import ssl as tls
from collections.abc import Callable, Mapping
from typing import Protocol

from flexdt.clients.answers import Answers, result
from flexdt.clients.transport import ConnectionLost, checked_port
from flexdt.protocol import Codec, Connection, Failure, Message, Response, RpcError


class AsyncTransport(Protocol):
    """A way to a server. `open` may be called again after the connection has been lost."""

    async def open(self) -> None:
        """Connect, or raise `ConnectionLost`."""

    async def send(self, message: Message) -> None:
        """Send one message, or raise `ConnectionLost`."""

    async def receive(self) -> list[Message]:
        """At least one message; empty only when the connection has ended."""

    def close(self) -> None:
        """End the connection and wake up `receive`; harmless when there is none."""


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
            raise ConnectionLost(f"no server at {self.host}:{self.port} ({why})") from error
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
    """An open connection; make one with `opened`."""

    def __init__(
        self,
        transport: AsyncTransport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        self._transport, self._on_end = transport, on_end
        self._answers: Answers[asyncio.Future[Response | Failure]] = Answers(on_event)
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
            ConnectionLost: nobody answers.
        """
        await transport.open()
        return cls(transport, on_event, on_end)

    @property
    def reason(self) -> RpcError | None:
        """What the server said about the connection as a whole."""
        return self._answers.reason

    @reason.setter
    def reason(self, value: RpcError | None) -> None:
        self._answers.reason = value

    async def request(
        self, method: str, params: Mapping[str, object], timeout_s: float | None
    ) -> object:
        """Ask and wait for the answer; raises what `Link.request` does."""
        if not self.alive:
            raise self._answers.lost(sent=False)
        waiter: asyncio.Future[Response | Failure] = asyncio.get_running_loop().create_future()
        request = self._answers.expect(method, params, waiter)
        try:
            async with asyncio.timeout(timeout_s) as limit:
                await self._transport.send(request)
                answer = await waiter
        except TimeoutError:
            if not limit.expired():
                raise
            raise TimeoutError(f"no answer to {method} within {timeout_s:g} s") from None
        finally:
            self._answers.forget(request)
            waiter.cancel()
        return result(answer)

    async def close(self) -> None:
        """End the connection; waiting requests fail."""
        self._transport.close()
        self._reader.cancel()
        await asyncio.wait([self._reader])

    async def _read(self) -> None:
        try:
            while messages := await self._transport.receive():
                for message in messages:
                    for waiter, answer in self._answers.take(message):
                        if not waiter.done():
                            waiter.set_result(answer)
        finally:
            self.alive = False
            for waiter in self._answers.waiting():
                if not waiter.done():
                    waiter.set_exception(self._answers.lost(sent=True))
            self._on_end()
