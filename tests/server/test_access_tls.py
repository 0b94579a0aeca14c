"""Tokens from files and the environment, bind addresses, and TLS on both servers."""

from __future__ import annotations

import asyncio
import shutil
import ssl
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from lab import Process, Wire, twin

from flexdt.clients import ConnectionLost, TwinClient
from flexdt.protocol import Method, RpcError
from flexdt.protocol.fields import Params
from flexdt.runtime.access import (
    AccessError,
    ConnectionLimits,
    check_bind,
    client_tls,
    is_loopback,
    read_token,
    server_tls,
    token_matches,
)
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import serve
from flexdt.server.projector.service import serve_projector
from flexdt.twin.projection.analytic_solids import Scene, Solid, Sphere
from tests.support.projector_user import ProjectorUser

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
        server = await serve(_Echo().open, ssl=server_tls(CERTIFICATE, KEY))
        port = server.port

        def talk() -> None:
            with TwinClient(port=port, ssl=trusting()) as client:
                assert client.ping() == 1.0
            with pytest.raises(
                ConnectionLost
            ):  # a client that does not trust the certificate
                TwinClient(port=port, ssl=ssl.create_default_context())
            with pytest.raises(ConnectionLost):
                TwinClient(port=port, timeout_s=60.0)

        await asyncio.to_thread(talk)
        await server.close()

    asyncio.run(main())


def test_one_too_many_is_told_so_over_tls() -> None:
    async def main() -> None:
        limits = ConnectionLimits(max_clients=1)
        server = await serve(
            _Echo().open, ssl=server_tls(CERTIFICATE, KEY), limits=limits
        )

        def talk() -> None:
            with TwinClient(port=server.port, ssl=trusting()) as client:
                for _ in range(3):
                    with TwinClient(port=server.port, ssl=trusting()) as late:
                        assert late.ping() == 1.0
                        with pytest.raises(RpcError, match="too many clients"):
                            late.state()
                assert client.ping() == 1.0

        await asyncio.to_thread(talk)
        await server.close()

    asyncio.run(main())


def test_the_projector_speaks_tls() -> None:
    async def main() -> None:
        server = await serve_projector(
            memory_limit=2**20,
            ssl=server_tls(CERTIFICATE, KEY),
            token="a token of sixteen letters",
        )
        async with ProjectorUser(
            port=server.port, ssl=trusting(), token="a token of sixteen letters"
        ) as client:
            await client.put("s", Scene((Solid(Sphere((0, 0, 0), 2.0), "steel", 0.5),)))
            row = [0, -60, 0, 0, 40, 0, 0.4, 0, 0, 0, 0, -0.4]
            seen = await client.project("s", np.array([row] * 20, float), (501, 501))
            assert seen.nbytes > 2**24
            assert seen[19, 250, 250] == pytest.approx(2.0)
        plain = ProjectorUser(port=server.port, patience_s=0.0)
        with pytest.raises(ProjectorUnavailable):
            await plain.health()
        await server.close()

    asyncio.run(main())
    assert threading.active_count() < 50


def self_signed(folder: Path, name: str) -> tuple[Path, Path]:
    """A fresh certificate for the loopback and its key; the kept one where openssl is
    missing."""
    openssl = shutil.which("openssl")
    if openssl is None:
        return CERTIFICATE, KEY
    certificate, key = folder / f"{name}-cert.pem", folder / f"{name}-key.pem"
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes",
         "-days", "2", "-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1",
         "-keyout", str(key), "-out", str(certificate)],
        check=True,
        capture_output=True,
    )  # fmt: skip
    return certificate, key


@pytest.mark.timeout(180)
@pytest.mark.slow
def test_a_twin_and_a_projector_on_another_host_speak_tls(tmp_path: Path) -> None:
    certificate, key = self_signed(tmp_path, "projector")
    stranger, _ = self_signed(tmp_path, "stranger")
    token = tmp_path / "token"
    token.write_text("a token of sixteen letters\n")
    # As for another host: the projector listens on every address, which needs a token.
    rays = Process(
        "flexdt.server.projector.main", "--host", "0.0.0.0", "--port", 0, "--threads", 1,
        "--token-file", token, "--tls-cert", certificate, "--tls-key", key,
    )  # fmt: skip
    try:
        words = ("--projector-token-file", token, "--projector-tls-ca", certificate)
        server = twin(rays.port, tmp_path / "data", "--sample", "normal-3", *words)
        try:
            wire = Wire(server.port)
            wire.call("camera.set", roi=[900, 700, 1027, 827])
            image = wire.call("projection.get", kind="line_integral")
            assert image["shape"] == [64, 64]
        finally:
            server.end()
        assert not server.logged("error", "critical", "unstructured")

        async def refused(ssl: ssl.SSLContext | None) -> None:
            client = ProjectorUser(port=rays.port, patience_s=0.0, ssl=ssl)
            with pytest.raises(ProjectorUnavailable):
                await client.health()
            await client.close()

        asyncio.run(refused(None))
        if stranger != certificate:
            asyncio.run(refused(client_tls(stranger)))
    finally:
        rays.end()


def test_a_certificate_that_cannot_be_read_is_said(tmp_path: Path) -> None:
    assert client_tls(None) is None
    for file in (KEY, tmp_path / "missing"):
        with pytest.raises(AccessError, match="TLS certificates"):
            client_tls(file)
