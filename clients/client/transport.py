"""How a client's messages reach a server: over TCP, or in tests straight into a function.

A transport opens a connection, sends single messages and receives messages; the client above it
does not know which transport it has. Request ids belong to `link`, retries to `policy`.
"""

from __future__ import annotations

import contextlib
import socket
import ssl as tls
import threading
from typing import Any, Protocol

from flexdt.clients.client.tls_socket import TlsSocket
from flexdt.protocol import Codec, Connection, Correlation, Message


class ConnectionLost(ConnectionError):
    """The connection could not be made or has ended.

    Attributes:
        sent: whether a request had been (or may have been) sent, so that it is unknown whether
            the server carried it out.
    """

    def __init__(self, message: str, *, sent: bool = False) -> None:
        super().__init__(message)
        self.sent = sent

    @classmethod
    def at_first(cls, host: str, port: int, why: str, error: OSError) -> ConnectionLost:
        """The error of a connection that could not be made."""
        nobody = isinstance(error, ConnectionRefusedError)
        hint = ": start one with `flexdt up`" if nobody else ""
        return cls(f"no server at {host}:{port} ({why}){hint}")

    @classmethod
    def of(cls, calls: Correlation[Any], *, sent: bool) -> ConnectionLost:
        """The error of a request whose connection has ended, with the reason if one is known."""
        if calls.violation is not None:
            return cls(f"the server broke the protocol: {calls.violation}", sent=sent)
        why = "" if calls.reason is None else f": {calls.reason.message}"
        return cls(f"the server ended the connection{why}", sent=sent)


class Transport(Protocol):
    """A connection to a server. `open` may be called again after the connection has been lost."""

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
        """Block until at least one message has come; empty only when the connection has ended.

        Raises:
            ProtocolError: the server ended the connection inside a message.
        """

    def close(self) -> None:
        """End the connection and wake up `receive`; does nothing when there is none."""


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
            raise ConnectionLost.at_first(self.host, self.port, why, error) from error
        self._wire = Connection(self.codec)
        self._socket = made

    def send(self, message: Message) -> None:
        """Send one message; several threads may do so at once."""
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
                if self._socket is not None:  # the server's end of the stream, not our `close`
                    self._wire.receive_end()
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
