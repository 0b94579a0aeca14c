"""Token and TLS from the command line, against servers that want both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.slow

TLS = Path(__file__).parents[1] / "data" / "tls"
CERTIFICATE = TLS / "test-only-cert.pem"
TOKEN = "a token of many letters"


@pytest.fixture(scope="module")
def locked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    folder = tmp_path_factory.mktemp("locked")
    token = folder / "token"
    token.write_text(TOKEN + "\n")
    options = {
        "data": folder / "data",
        "sample": "empty",
        "token-file": token,
        "tls-cert": CERTIFICATE,
        "tls-key": TLS / "test-only-key.pem",
    }
    with Servers(options, folder / "servers.log") as servers:
        yield "localhost:{1}".format(*servers.address), token


def state(server: str, *words: str) -> int:
    return run(["state", "--server", server, *words])


def test_with_token_and_certificate(
    locked: tuple[str, Path],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    server, token = locked
    monkeypatch.setenv("FLEXDT_TLS_CA", str(CERTIFICATE))
    assert state(server, "--token-file", str(token)) == 0
    assert "rot_obj" in capsys.readouterr().out


def test_without_either_it_is_refused(
    locked: tuple[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    server, token = locked
    wrong = tmp_path / "wrong"
    wrong.write_text("another token of many letters")
    assert state(server, "--token-file", str(token)) == 4
    assert state(server, "--token-file", "missing") == 1
    monkeypatch.setenv("FLEXDT_TLS_CA", str(CERTIFICATE))
    assert state(server) == 4
    assert state(server, "--token-file", str(wrong)) == 4
    monkeypatch.setenv("FLEXDT_TLS_CA", str(token))
    assert state(server) == 1
    captured = capsys.readouterr()
    assert captured.out == ""
    assert TOKEN not in captured.err
    assert len(captured.err.splitlines()) == 5
