"""A TLS connection that one thread may read while another writes.

OpenSSL's connections are not for two threads at a time: a read that meets the server's session
tickets while a request is being written corrupts the connection. Python's `ssl.SSLSocket` does not
guard against that before 3.13; when 3.13 is the oldest supported version, this module can go. Here
OpenSSL works on memory buffers under a lock that is held only briefly; only plain sockets block.
"""

from __future__ import annotations

import contextlib
import socket
import ssl as tls
import threading
from typing import Final

RECORDS: Final = 1 << 18
"""Bytes read from the plain socket at a time."""


class TlsSocket:
    """The client's end of a TLS connection, with the calls of a blocking socket.

    Args:
        plain: a connected socket, which this object takes over.
        context: a client's TLS context.
        server_hostname: the name that the certificate must be for.

    Raises:
        OSError: the handshake failed; `plain` is closed. `ssl.SSLError` is one.
    """

    def __init__(self, plain: socket.socket, context: tls.SSLContext, server_hostname: str) -> None:
        self._plain = plain
        self._in, self._out = tls.MemoryBIO(), tls.MemoryBIO()
        self._tls = context.wrap_bio(self._in, self._out, server_hostname=server_hostname)
        self._engine = threading.Lock()  # around every use of the three above; never while blocking
        self._sending = threading.Lock()  # keeps the records in the order in which they were made
        try:
            self._shake_hands()
        except BaseException:
            plain.close()
            raise

    def settimeout(self, seconds: float | None) -> None:
        """As `socket.settimeout`."""
        self._plain.settimeout(seconds)

    def sendall(self, data: bytes) -> None:
        """Send all of `data`.

        Raises:
            OSError: the connection has ended.
        """
        with self._sending:
            with self._engine:
                self._tls.write(data)
                records = self._out.read()
            self._plain.sendall(records)

    def recv(self, size: int) -> bytes:
        """At least one byte and at most `size`; none when the server has ended the connection.

        Raises:
            OSError: the connection broke.
        """
        while True:
            with self._engine, contextlib.suppress(tls.SSLWantReadError):
                try:
                    return self._tls.read(size)
                except tls.SSLZeroReturnError:
                    return b""
            # A reply that OpenSSL may have made (to a new key) is sent with the next request.
            self._fill()

    def shutdown(self, how: int) -> None:
        """End the plain connection; wakes up `recv` in another thread."""
        self._plain.shutdown(how)

    def close(self) -> None:
        """Close the plain socket."""
        self._plain.close()

    def _shake_hands(self) -> None:
        while True:
            try:
                self._tls.do_handshake()
            except tls.SSLWantReadError:
                self._plain.sendall(self._out.read())
                self._fill()
            except tls.SSLError:
                with contextlib.suppress(OSError):  # the alert says why; the server may have gone
                    self._plain.sendall(self._out.read())
                raise
            else:
                self._plain.sendall(self._out.read())
                return

    def _fill(self) -> None:
        records = self._plain.recv(RECORDS)
        with self._engine:
            if records:
                self._in.write(records)
            else:
                self._in.write_eof()
