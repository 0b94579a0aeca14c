"""Real servers for the commands that talk to a twin."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers

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
