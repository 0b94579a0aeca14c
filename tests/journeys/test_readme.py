"""The README's commands, one by one, against real servers; its `nc` lines with plain
sockets."""

from __future__ import annotations

import json
import re
import shlex
import socket
from pathlib import Path
from typing import Any

import pytest
import tifffile

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers

pytestmark = pytest.mark.slow
COLLISION = 3
"""Exit code of a check that finds one."""

README = (Path(__file__).resolve().parents[2] / "README.md").read_text()


def shell_lines() -> list[str]:
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    text = "".join(blocks).replace("\\\n", " ")
    return [line.partition(" #")[0].strip() for line in text.splitlines()]


def promises() -> dict[str, tuple[int, str]]:
    """Commands with the line and the words that the comment behind them promises."""
    found = re.findall(r"^flexdt (.+?) +# line (\d+): (.+)$", README, re.MULTILINE)
    return {command: (int(line), what) for command, line, what in found}


def netcat(address: tuple[str, int], text: str) -> list[Any]:
    """`echo TEXT | nc -N`: send, close our side, read until the server closes its side."""
    with socket.create_connection(address, timeout=60) as connection:
        connection.sendall(text.encode() + b"\n")
        connection.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: connection.recv(65536), b""))
    return [json.loads(line) for line in answer.splitlines()]


@pytest.fixture(scope="module")
def here(servers: Servers, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("readme")


def test_the_five_minutes(
    servers: Servers,
    here: Path,
    data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(here)
    examples = Path(__file__).resolve().parents[2] / "examples"
    (here / "examples").symlink_to(examples)
    commands = [
        shlex.split(line)[1:] for line in shell_lines() if line.startswith("flexdt ")
    ]
    assert len(commands) >= 7
    talking = {"state", "sample", "move", "snap", "run"}
    names = set()
    for words in commands:
        names.add(words[0])
        server = (
            ["--server", "{}:{}".format(*servers.address)] if words[0] in talking else []
        )
        promised = promises().get(shlex.join(words))
        code = run([*words, *server])
        told = capsys.readouterr().err
        assert code == (
            COLLISION if promised and "detector-too-near" in words[1] else 0
        ), told
        if promised is not None:
            line, what = promised
            assert re.search(
                rf"{re.escape(words[1])}:{line}:\d+: .*{re.escape(what)}", told
            ), told
    assert len(promises()) == 2
    assert talking | {"check", "script"} <= names
    assert (here / "view.png").read_bytes().startswith(b"\x89PNG")
    assert (here / "report.html").is_file()
    folder = data_dir / "first"
    assert len(list(folder.glob("scan_*.tif"))) == 180
    assert tifffile.imread(folder / "scan_000000.tif").shape == (760, 956)


def test_the_netcat_lines(servers: Servers, here: Path) -> None:
    requests = [
        json.loads(m)
        for line in shell_lines()
        for m in re.findall(r"^echo '(.*?)'", line)
    ]
    assert [r["method"] for r in requests] == ["axes.move", "projection.get"]
    for request in requests:
        (answer,) = netcat(servers.address, json.dumps(request))
        assert answer["id"] == request["id"]
        assert "error" not in answer
    # The third line builds its request with jq from a file.
    jq = next(line for line in shell_lines() if line.startswith("jq "))
    (built,) = re.findall(r"jq -cRs '(.*?)' mine.txt", jq)
    assert built == '{jsonrpc:"2.0",id:3,method:"script.submit",params:{text:.}}'
    text = (here / "mine.txt").read_bytes().decode()
    request = {
        "jsonrpc": "2.0",
        "id": 3,
        "method": "script.submit",
        "params": {"text": text},
    }
    (answer,) = netcat(servers.address, json.dumps(request))
    job = answer["result"]["job"]
    (answer,) = netcat(
        servers.address,
        json.dumps(
            {"jsonrpc": "2.0", "id": 4, "method": "job.abort", "params": {"job": job}}
        ),
    )
    assert "error" not in answer


def test_the_python_lines(
    servers: Servers, here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of a running twin; the others run with the library's page."""
    monkeypatch.chdir(here)
    _, client = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    names: dict[str, Any] = {}
    host, port = servers.address
    exec(client.replace("TwinClient()", f"TwinClient({host!r}, {port})"), names)
    assert names["image"].shape == (760, 956)


def test_every_link_leads_somewhere() -> None:
    root = Path(__file__).resolve().parents[2]
    links = re.findall(r"\]\((?!https?:)([^)#]+)", README)
    assert len(links) > 5
    assert [link for link in links if not (root / link).exists()] == []
