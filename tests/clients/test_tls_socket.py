"""`TlsSocket` against Python's own `ssl.SSLSocket`: two threads, one connection, all ends."""

from __future__ import annotations

import socket
import ssl
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.client.tls_socket import TlsSocket

TLS = Path(__file__).parents[1] / "data" / "tls"
CERTIFICATE, KEY = TLS / "test-only-cert.pem", TLS / "test-only-key.pem"


@contextmanager
def server(talk: Callable[[ssl.SSLSocket], None]) -> Iterator[socket.socket]:
    """A plain socket connected to a TLS server that does `talk` in a thread."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(CERTIFICATE, KEY)
    here, there = socket.socketpair()

    def run() -> None:
        try:
            with context.wrap_socket(there, server_side=True) as secure:
                talk(secure)
        except OSError:
            there.close()  # the client went away: its side of the test says whether it should have

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield here
    finally:
        here.close()
        thread.join(10.0)
        assert not thread.is_alive()


def trusting() -> ssl.SSLContext:
    return ssl.create_default_context(cafile=CERTIFICATE)


def read(client: TlsSocket, size: int) -> bytes:
    got = bytearray()
    while len(got) < size:
        more = client.recv(size - len(got))
        assert more, f"the connection ended after {len(got)} of {size} bytes"
        got += more
    return bytes(got)


def echo(secure: ssl.SSLSocket) -> None:
    while data := secure.recv(1 << 16):
        secure.sendall(data)


class Watched:
    """OpenSSL's engine, slowed down, that notices when two threads are in it."""

    def __init__(self, engine: ssl.SSLObject) -> None:
        self.engine, self.inside, self.met = engine, 0, 0

    def __getattr__(self, name: str) -> Any:
        def call(*args: Any) -> Any:
            self.inside += 1
            self.met = max(self.met, self.inside)
            try:
                time.sleep(0.0005)
                return getattr(self.engine, name)(*args)
            finally:
                self.inside -= 1

        return call


def test_what_is_written_comes_back_while_another_thread_reads() -> None:
    blocks = [bytes([n]) * 9973 for n in range(200)]
    with server(echo) as plain:
        client = TlsSocket(plain, trusting(), "localhost")
        watched = Watched(client._tls)
        client._tls = watched  # type: ignore[assignment]
        got: list[bytes] = []
        reader = threading.Thread(target=lambda: got.append(read(client, 200 * 9973)))
        reader.start()
        for block in blocks:
            client.sendall(block)
        reader.join(30.0)
        assert got == [b"".join(blocks)]
        assert watched.met == 1


def test_more_than_the_sockets_hold_in_both_directions() -> None:
    """A writer that waits for the server must not keep the reader from emptying the other way."""
    size = 8 << 20
    with server(echo) as plain:
        client = TlsSocket(plain, trusting(), "localhost")
        writer = threading.Thread(target=client.sendall, args=(b"x" * size,), daemon=True)
        writer.start()
        assert read(client, size) == b"x" * size
        writer.join(10.0)


def test_the_end_and_a_broken_end() -> None:
    def polite(secure: ssl.SSLSocket) -> None:
        secure.sendall(b"bye")
        secure.unwrap().close()

    with server(polite) as plain:
        client = TlsSocket(plain, trusting(), "localhost")
        assert read(client, 3) == b"bye"
        assert client.recv(10) == b""

    with server(lambda secure: secure.sendall(b"bye")) as plain:
        client = TlsSocket(plain, trusting(), "localhost")
        assert read(client, 3) == b"bye"
        with pytest.raises(ssl.SSLError):
            client.recv(10)


def test_a_certificate_that_does_not_hold_closes_the_socket() -> None:
    for context, name in ((trusting(), "elsewhere"), (ssl.create_default_context(), "localhost")):
        with server(echo) as plain:
            with pytest.raises(ssl.SSLCertVerificationError):
                TlsSocket(plain, context, name)
            assert plain.fileno() == -1


def test_shutdown_wakes_the_reader() -> None:
    with server(echo) as plain:
        client = TlsSocket(plain, trusting(), "localhost")
        ended: list[BaseException] = []

        def wait() -> None:
            try:
                client.recv(1)
            except OSError as error:
                ended.append(error)

        reader = threading.Thread(target=wait)
        reader.start()
        time.sleep(0.05)
        client.shutdown(socket.SHUT_RDWR)
        reader.join(60.0)
        assert len(ended) == 1
        client.close()
