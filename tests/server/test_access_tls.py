"""Tokens from files and the environment, bind addresses, and TLS on both servers."""

from __future__ import annotations

import asyncio
import ssl
import threading
from pathlib import Path

import numpy as np
import pytest

from flexdt.clients import ConnectionLost, TwinClient
from flexdt.protocol import Method
from flexdt.protocol.fields import Params
from flexdt.server.access import (
    AccessError,
    check_bind,
    is_loopback,
    read_token,
    server_tls,
    token_matches,
)
from flexdt.server.peer import Peer
from flexdt.server.projector.service import serve_projector
from flexdt.server.projector_client import ProjectorClient, ProjectorUnavailable
from flexdt.server.tcp import serve
from flexdt.twin.projection.shapes import Scene, Solid, Sphere

TLS = Path(__file__).parents[1] / "data" / "tls"
CERTIFICATE, KEY = TLS / "test-only-cert.pem", TLS / "test-only-key.pem"


@pytest.mark.parametrize(
    ("host", "loopback"),
    [
        ("127.0.0.1", True),
        ("127.1.2.3", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("", False),
        ("10.0.0.1", False),
        ("localhost.example.org", False),
    ],
)
def test_what_is_a_loopback_address(host: str, loopback: bool) -> None:
    assert is_loopback(host) is loopback
    check_bind(host, "a token of sixteen letters")
    if loopback:
        check_bind(host, None)
    else:
        with pytest.raises(AccessError, match="needs a token"):
            check_bind(host, None)


def test_tokens_come_from_a_file_or_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("FLEXDT_TOKEN", raising=False)
    assert read_token(None) is None
    monkeypatch.setenv("FLEXDT_TOKEN", "from the environment")
    assert read_token(None) == "from the environment"
    file = tmp_path / "token"
    file.write_text("  from the file \nsecond line\n")
    assert read_token(file) == "from the file"
    file.write_text("\n")
    with pytest.raises(AccessError, match="empty"):
        read_token(file)
    with pytest.raises(AccessError, match="missing"):
        read_token(tmp_path / "missing")


def test_tokens_match_only_when_equal() -> None:
    assert token_matches("geheim-ß", "geheim-ß")
    assert not token_matches("geheim", "geheim-ß")
    assert not token_matches("", "x")
    assert not token_matches(None, "x")


def test_tls_files_that_do_not_hold() -> None:
    assert server_tls(None, None) is None
    with pytest.raises(AccessError, match="go together"):
        server_tls(CERTIFICATE, None)
    with pytest.raises(AccessError, match="TLS files"):
        server_tls(KEY, CERTIFICATE)
    with pytest.raises(AccessError, match="TLS files"):
        server_tls(TLS / "missing", KEY)


class _Echo:
    def open(self, peer: Peer) -> _Echo:
        return self

    async def handle(self, method: Method, params: Params) -> object:
        match method.name:
            case "session.hello":
                return {"protocol": "1.0", "server": "echo", "machine": "x"}
        return {"time": 1.0}

    def close(self) -> None:
        pass


def trusting() -> ssl.SSLContext:
    return ssl.create_default_context(cafile=CERTIFICATE)


def test_the_twin_server_speaks_tls_and_only_tls() -> None:
    async def main() -> None:
        server = await serve(_Echo(), ssl=server_tls(CERTIFICATE, KEY))
        port = server.port

        def talk() -> None:
            with TwinClient(port=port, ssl=trusting()) as client:
                assert client.ping() == 1.0
            with pytest.raises(ConnectionLost):  # a client that does not trust the certificate
                TwinClient(port=port, ssl=ssl.create_default_context())
            with pytest.raises(ConnectionLost):
                TwinClient(port=port, timeout_s=5.0)

        await asyncio.to_thread(talk)
        await server.close()

    asyncio.run(main())


def test_the_projector_speaks_tls() -> None:
    async def main() -> None:
        server = await serve_projector(
            memory_limit=2**20, ssl=server_tls(CERTIFICATE, KEY), token="a token of sixteen letters"
        )
        async with ProjectorClient(
            port=server.port, ssl=trusting(), token="a token of sixteen letters"
        ) as client:
            await client.put_scene("s", Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.5),)))
            row = [0, -60, 0, 0, 40, 0, 0.4, 0, 0, 0, 0, -0.4]
            seen = await client.project("s", np.array([row] * 20, float), (501, 501))
            assert seen.nbytes > 2**24
            assert seen[19, 250, 250] == pytest.approx(2.0)
        plain = ProjectorClient(port=server.port, patience_s=0.0)
        with pytest.raises(ProjectorUnavailable):
            await plain.health()
        await server.close()

    asyncio.run(main())
    assert threading.active_count() < 50
