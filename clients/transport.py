"""How a client's messages reach a server: over TCP, or straight into a function for tests.

A transport opens, sends one message, and receives what comes; the client above it does not know
which one it has. It refuses to know methods, ids and retries (see `link`).
"""

from __future__ import annotations

import contextlib
import queue
import socket
import ssl as tls
import threading
from collections.abc import Callable, Iterable
from typing import Protocol

from flexdt.clients.tls_socket import TlsSocket
from flexdt.protocol import Codec, Connection, Message


class ConnectionLost(ConnectionError):
    """The connection could not be made or has ended.

    Attributes:
        sent: whether a request had been (or may have been) sent, so that it is unknown whether
            the server carried it out.
    """

    def __init__(self, message: str, *, sent: bool = False) -> None:
        super().__init__(message)
        self.sent = sent


class Transport(Protocol):
    """A way to a server. `open` may be called again after the connection has been lost."""

    def open(self) -> None:
        """Connect.

        Raises:
            ConnectionLost: says who does not answer.
        """

    def send(self, message: Message) -> None:
        """Send one message; may block.

        Raises:
            ConnectionLost: the connection has ended.
            RpcError, ValueError, TypeError: the message cannot be encoded.
        """

    def receive(self) -> list[Message]:
        """Block until at least one message has come; empty only when the connection has ended."""

    def close(self) -> None:
        """End the connection and wake up `receive`; harmless when there is none."""


def checked_port(port: int) -> int:
    """`port`, if a server can be there.

    Raises:
        ValueError: says what is allowed.
    """
    if type(port) is not int or not 1 <= port <= 65535:
        raise ValueError(f"port {port!r} is not a number from 1 to 65535")
    return port


class TcpTransport:
    """A blocking socket.

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
        self._socket: socket.socket | TlsSocket | None = None
        self._wire = Connection(codec)
        self._sending = threading.Lock()

    def __repr__(self) -> str:
        return f"TcpTransport({self.host!r}, {self.port}, codec={self.codec})"

    def open(self) -> None:
        """Connect anew."""
        self.close()
        try:
            plain = socket.create_connection((self.host, self.port), self.timeout_s)
            plain.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            made = plain if self.ssl is None else TlsSocket(plain, self.ssl, self.host)
            made.settimeout(None)
        except OSError as error:
            why = error.strerror or str(error)
            raise ConnectionLost(f"no server at {self.host}:{self.port} ({why})") from error
        self._wire = Connection(self.codec)
        self._socket = made

    def send(self, message: Message) -> None:
        """Send one message."""
        data = self._wire.send(message)
        with self._sending:
            if self._socket is None:
                raise ConnectionLost(f"not connected to {self.host}:{self.port}")
            try:
                self._socket.sendall(data)
            except OSError as error:
                why = error.strerror or str(error)
                raise ConnectionLost(
                    f"the connection to {self.host}:{self.port} broke ({why})", sent=True
                ) from error

    def receive(self) -> list[Message]:
        """Messages, or an empty list at the end."""
        messages: list[Message] = []
        while not messages:
            connected = self._socket
            if connected is None:
                return []
            try:
                data = connected.recv(1 << 18)
            except OSError:
                return []
            if not data:
                return []
            messages = self._wire.receive_data(data)
        return messages

    def close(self) -> None:
        """Close the socket."""
        connected, self._socket = self._socket, None
        if connected is not None:
            with contextlib.suppress(OSError):  # the peer may have been faster
                connected.shutdown(socket.SHUT_RDWR)
            connected.close()


class InProcessTransport:
    """Messages go to a function and its answers come back, through the codec on both ways.

    Args:
        handler: takes a message, returns the messages to answer with (none, one or several).
        codec: what the two ends speak.
    """

    def __init__(
        self, handler: Callable[[Message], Iterable[Message]], codec: Codec = Codec.MSGPACK
    ) -> None:
        self.handler, self.codec = handler, codec
        self.opened = 0
        self._inbox: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._client, self._server = Connection(codec), Connection()
        self._alive = False

    def open(self) -> None:
        """Start afresh."""
        self.opened += 1
        self._inbox = queue.SimpleQueue()
        self._client, self._server = Connection(self.codec), Connection()
        self._alive = True

    def send(self, message: Message) -> None:
        """Hand the message to the handler; its answers wait to be received."""
        if not self._alive:
            raise ConnectionLost("not connected")
        for received in self._server.receive_data(self._client.send(message)):
            for answer in self.handler(received):
                self.push(answer)

    def push(self, message: Message) -> None:
        """Send something from the server's side, such as an event."""
        self._inbox.put(self._server.send(message))

    def receive(self) -> list[Message]:
        """Messages, or an empty list at the end."""
        messages: list[Message] = []
        while not messages:
            data = self._inbox.get()
            if not data:
                return []
            messages = self._client.receive_data(data)
        return messages

    def close(self) -> None:
        """End the connection."""
        self._alive = False
        self._inbox.put(b"")
