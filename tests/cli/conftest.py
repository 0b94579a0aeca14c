"""Real servers for the commands that talk to a twin."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.cli.boundary import run
from flexdt.clients.demo.processes import Servers


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def servers(data_dir: Path) -> Iterator[Servers]:
    options = {"data": data_dir, "speed-up": "max"}
    with Servers(options, data_dir.parent / "servers.log") as running:
        yield running


Answer = tuple[int, str, str]


@pytest.fixture
def flexdt(servers: Servers, capsys: pytest.CaptureFixture[str]) -> Callable[..., Answer]:
    """Run a command against the servers: (exit code, standard output, standard error)."""

    def call(*words: str) -> Answer:
        capsys.readouterr()
        code = run([*words, "--server", "{}:{}".format(*servers.address)])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return code, captured.out, captured.err

    return call


@pytest.fixture
def document(flexdt: Callable[..., Answer]) -> Callable[..., Any]:
    """The JSON document of a command that succeeds."""

    def call(*words: str) -> Any:
        code, out, err = flexdt(*words, "--json")
        assert code == 0, err
        return json.loads(out)

    return call
