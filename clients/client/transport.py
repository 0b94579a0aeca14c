"""How a client's messages reach a server: over TCP, or in tests straight into a function.

A transport opens a connection, sends single messages and receives messages; the client above it
does not know which transport it has; retries belong to `client`. `Link` gives requests their
ids and is one connection's life in an event loop: one task reads, any number of tasks send
requests.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import ssl as tls
from collections.abc import Callable, Mapping
from typing import Any, Final, Protocol

from flexdt.message_words import reason_of
from flexdt.protocol import (
    MAX_FRAME,
    Answered,
    Codec,
    Connection,
    Correlation,
    Message,
    Notification,
    ProtocolError,
    Role,
    RpcError,
)
from flexdt.protocol.methods.session_messages import SESSION_PING
from flexdt.twin import long_work
from flexdt.twin.errors import LimitError, TwinError

READ_BYTES: Final = 1 << 18
ASK_AFTER_S: Final = 2.0
"""Time without an answer after which a server is asked what it works at, and again [s]."""


class ConnectionLost(TwinError, ConnectionError):
    """The connection could not be made or has ended.

    Attributes:
        sent: whether a request had been (or may have been) sent, so that it is unknown whether
            the server carried it out.
    """

    def __init__(self, message: str, *, sent: bool = False) -> None:
        super().__init__(message)
        self.sent = sent

    @classmethod
    def of(cls, calls: Correlation[Any], *, sent: bool) -> ConnectionLost:
        """Build (not raise) the error of a request whose connection has ended, with a
        violation of the protocol or the server's reason if one is known.

        A violation comes before the server's reason; `sent` is passed on.
        """
        if calls.violation is not None:
            return cls(f"the server broke the protocol: {calls.violation}", sent=sent)
        if calls.reason is None:
            why = ""
        else:
            why = f": {calls.reason.message}"
        return cls(f"the server ended the connection{why}", sent=sent)


class NoTwinError(ConnectionError):
    """Another program than a twin answers at the address."""


class Transport(Protocol):
    """A connection to a server. `open` may be called again after the connection has been
    lost.

    Attributes:
        place: of the server, for people.
    """

    @property
    def place(self) -> str:
        """Address of the server, for people."""

    async def open(self) -> None:
        """Connect, or raise `ConnectionLost`."""

    async def send(self, message: Message) -> None:
        """Send one message, or raise `ConnectionLost`."""

    async def receive(self) -> list[Message]:
        """Wait for messages: at least one; an empty list only when the connection has
        ended.

        Raises:
            ProtocolError: the server ended the connection inside a message.
        """

    def close(self) -> None:
        """End the connection and wake up `receive`; does nothing when there is none."""


class TcpTransport:
    """Transport over TCP by asyncio streams, plain or with TLS.

    Args:
        host, port: of the server.
        codec: of the messages; MessagePack carries images without base64.
        timeout_s: for connecting [s].
        ssl: a client's TLS context; None for plain TCP.

    Raises:
        ValueError: the port is outside the allowed range.
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
        """Store where and how to connect; nothing is opened before `open`.

        `host`: name or address. `port`: from 1 to 65535. `codec`: of the messages. `timeout_s`:
        limit of the time to connect. `ssl`: for TLS; the server's certificate must name `host`.
        Raises LimitError: another port.
        """
        if type(port) is not int or not 1 <= port <= 65535:
            raise LimitError.instead(
                f"port is {port!r}", str(port), "a number from 1 to 65535"
            )
        self.host = host
        self.port = port
        self.codec = codec
        self.timeout_s = timeout_s
        self.ssl = ssl
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._wire = Connection(codec)

    @property
    def place(self) -> str:
        """HOST:PORT of the server."""
        return f"{self.host}:{self.port}"

    def __repr__(self) -> str:
        return f"TcpTransport({self.host!r}, {self.port}, codec={self.codec})"

    async def open(self) -> None:
        """Connect to the server; an earlier connection is closed.

        With TLS the certificate is checked for `host`. The new connection starts with an
        empty message buffer.

        Raises:
            ConnectionLost: no server answers at the address within `timeout_s`; names the
                cause, and `flexdt up` if the connection was refused.
        """
        self.close()
        try:
            async with asyncio.timeout(self.timeout_s):
                if self.ssl is None:
                    name = None
                else:
                    name = self.host
                self._streams = await asyncio.open_connection(
                    self.host,
                    self.port,
                    ssl=self.ssl,
                    server_hostname=name,
                    limit=MAX_FRAME,
                )
        except OSError as error:  # TimeoutError is one
            why = reason_of(error, "no answer in time")
            number = error.errno
            if number is None and f"[Errno {errno.ECONNREFUSED}]" in why:
                number = errno.ECONNREFUSED  # of each of the addresses that a name has
            if number == errno.ECONNREFUSED or (
                isinstance(error, ConnectionError) and number
            ):
                why = os.strerror(number)  # asyncio has put the address there
            if number == errno.ECONNREFUSED:
                hint = ": start one with `flexdt up`"
            else:
                hint = ""
            raise ConnectionLost(
                f"no server at {self.host}:{self.port} ({why}){hint}"
            ) from error
        self._wire = Connection(self.codec)

    async def send(self, message: Message) -> None:
        """Send one message; all its bytes are queued at once, so a canceled call breaks
        nothing.

        Waits until the stream's buffer has room. A message that cannot be encoded raises
        the codec's error before anything is sent.

        Raises:
            ConnectionLost: there is no connection, or it has ended; its `sent` is True if
                it broke while the bytes were sent.
        """
        data = self._wire.send(message)
        if self._streams is None:
            raise ConnectionLost(f"not connected to {self.host}:{self.port}")
        writer = self._streams[1]
        try:
            writer.write(data)
            await writer.drain()
        except OSError as error:
            why = reason_of(error)
            raise ConnectionLost(
                f"the connection to {self.host}:{self.port} broke ({why})", sent=True
            ) from error

    async def receive(self) -> list[Message]:
        """Wait for messages and return them; an empty list at the end of the connection.

        A lost connection ends it as well, without an error. At least one message
        otherwise. An empty list also without a connection, or after `close`.

        Raises:
            ProtocolError: the server ended the connection inside a message.
        """
        messages: list[Message] = []
        while not messages:
            streams = self._streams
            if streams is None:
                return []
            try:
                data = await streams[0].read(READ_BYTES)
            except OSError:
                return []
            if not data:
                if (
                    self._streams is not None
                ):  # the server's end of the stream, not our `close`
                    self._wire.receive_end()
                return []
            messages = self._wire.receive_data(data)
        return messages

    def close(self) -> None:
        """Close the connection, if there is one; does nothing if its event loop has
        ended.

        `receive` wakes up and returns an empty list. It does not wait for the end.
        """
        streams = self._streams
        self._streams = None
        if streams is not None:
            with contextlib.suppress(RuntimeError):  # the loop it belonged to is gone
                streams[1].close()


class Link:
    """An open connection, read by a task of its own.

    Args:
        transport: has been opened.
        on_event: called with the params of every event.
        on_end: called once, when the connection has ended.

    Attributes:
        alive: until the connection has ended.
        calls: its open requests; `calls.reason` is the server's report about the
            connection.
    """

    def __init__(
        self,
        transport: Transport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        """Start a task in the running event loop that reads messages from an open transport.

        `transport`: open; `on_event`: called with the parameters of each event; `on_end`: called
        when the connection has ended.
        """
        self._transport = transport
        self._on_event = on_event
        self._on_end = on_end
        self.calls: Correlation[asyncio.Future[Answered[Any]]] = Correlation(Role.CLIENT)
        self.alive = True
        self._reader = asyncio.create_task(self._read(), name="flexdt-link")

    async def request(
        self, method: str, params: Mapping[str, object], timeout_s: float | None
    ) -> object:
        """Send a request and wait for its result.

        The id is freed if the call is canceled or timed out, and a late answer is
        ignored. The result is as the codec decoded it, not validated.

        Args:
            method: name of the method.
            params: its parameters by name.
            timeout_s: longest silence [s]; None for any. A server that says in time that it
                works at the request is waited for.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the connection ended; `.sent` says whether the request had been
                sent.
            TimeoutError: no answer, and no sign of work, in time.
        """
        if not self.alive:
            raise ConnectionLost.of(self.calls, sent=False)
        waiter: asyncio.Future[Answered[Any]] = asyncio.get_running_loop().create_future()
        request = self.calls.request(method, params, waiter)
        # A call cancelled while it sends may have handed its bytes over, so its answer may
        # come.
        sent = True
        try:
            async with asyncio.timeout(timeout_s) as limit:
                try:
                    await self._transport.send(request)
                except Exception:
                    sent = False
                    raise
                if timeout_s is not None and method != SESSION_PING.name:
                    await self._while_worked_at(method, waiter, timeout_s, limit)
                return (await waiter).result()
        except TimeoutError:
            if not limit.expired():
                raise
            raise TimeoutError(f"no answer to {method} within {timeout_s:g} s") from None
        finally:
            self.calls.abandon(request, sent=sent)
            waiter.cancel()

    async def _while_worked_at(
        self,
        method: str,
        waiter: asyncio.Future[Answered[Any]],
        timeout_s: float,
        limit: asyncio.Timeout,
    ) -> None:
        """Wait for an answer; ask a server that is silent whether it works at the request, and
        put off the limit whenever it says so. What takes long is shown as the work's name.

        Args:
            method: that was called.
            waiter: of its answer.
            timeout_s: by which the limit is put off [s].
            limit: of the request.
        """
        loop = asyncio.get_running_loop()
        with contextlib.ExitStack() as shown:
            told = ""
            while True:
                await asyncio.wait([waiter], timeout=min(ASK_AFTER_S, 0.5 * timeout_s))
                if waiter.done():
                    return
                try:
                    pong = await self.request(SESSION_PING.name, {}, timeout_s)
                except (RpcError, ConnectionLost, TimeoutError):
                    return
                # Requests of a connection are worked at one after the other.
                if not isinstance(pong, Mapping) or not pong.get("serving"):
                    return
                limit.reschedule(loop.time() + timeout_s)
                if (what := pong.get("working")) and what != told:
                    told = str(what)
                    shown.close()
                    shown.enter_context(
                        long_work.during(f"waiting for {method}: the projector is {told}")
                    )

    async def ended(self) -> None:
        """Wait for the connection's end."""
        await asyncio.wait([self._reader])

    async def close(self) -> None:
        """End the connection; waiting requests fail."""
        self._transport.close()
        self._reader.cancel()
        await self.ended()

    async def _read(self) -> None:
        """Handle messages until the connection ends, then fail all open requests with
        ConnectionLost.

        A violation of the protocol is recorded and closes the connection; it is not
        raised. In every case `alive` becomes False and `on_end` is called once.
        """
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
        """Give a message's answers to the requests that wait, and events to `on_event`.

        Only notifications "event" with an object as params are events.
        """
        for item in self.calls.receive(message):
            match item:
                case Answered(waiter) if not waiter.done():
                    waiter.set_result(item)
                case Notification("event", params) if isinstance(params, Mapping):
                    self._on_event(params)
