"""`LocalTwin` starts its own servers and ends them, whatever happens inside."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest

import flexdt as fx
from flexdt.clients.cli.command_tree import run
from flexdt.clients.cli.commands import process_commands
from flexdt.clients.launch import processes as local_twin


def gone(address: tuple[str, int]) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(address) != 0


@pytest.mark.slow
def test_an_exception_inside_ends_the_servers_and_the_temporary_data() -> None:
    local = fx.LocalTwin(sample="normal-2")
    seen = []

    def breaks() -> None:
        with local as twin:
            assert twin.state().sample.name == "normal-2"
            assert local.start() is twin  # once is enough
            seen.extend([local.address, local.data, local._now()[1].pid])
            assert local.data.is_dir()
            assert not gone(local.address)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        breaks()
    address, data, pid = seen
    assert gone(address)
    assert not data.exists()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)
    with pytest.raises(RuntimeError, match="not running"):
        _ = local.address


class Fake:
    """Servers that are none; say whether they were ended."""

    ended = 0
    address = ("127.0.0.1", 1)

    def __init__(self, options: dict[str, object], log: Path, *, viewer: bool) -> None:
        assert options == {
            "physics": "poly",
            "scatter": "off",
            "speed-up": "max",
            "rays": "auto",
            "data": log.parent / "data",
        }

    def __enter__(self) -> Fake:
        return self

    def __exit__(self, *_: object) -> None:
        Fake.ended += 1


def test_a_client_that_cannot_connect_leaves_no_server(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def fails(*_: object) -> None:
        raise ConnectionError("no")

    monkeypatch.setattr(local_twin, "Servers", Fake)
    monkeypatch.setattr(local_twin, "TwinClient", fails)
    local = fx.LocalTwin(physics="poly")
    with pytest.raises(ConnectionError):
        local.start()
    assert Fake.ended == 1
    local.stop()
    assert Fake.ended == 1


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"machine": "flexrai"}, "'flexrai'.*did you mean 'flexray'"),
        ({"profile": "nothing"}, "'nothing'"),
        ({"sample": "leggo"}, "'leggo'.*did you mean 'lego'"),
        ({"data": "file"}, "file: Not a directory"),
        ({"data": "file/below"}, "below: Not a directory"),
    ],
)
def test_what_does_not_hold_is_refused_before_a_process_starts(
    given: dict[str, str], says: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    monkeypatch.setattr(local_twin.subprocess, "Popen", None)
    with pytest.raises(local_twin.ServersError, match=says) as refused:
        fx.LocalTwin(**given).start()  # type: ignore[arg-type]
    assert len(refused.value.lines) == 1
    begun: list[object] = []
    monkeypatch.setattr(process_commands, "become", lambda *words: begun.append(words))
    [[option, value]] = given.items()
    assert run(["up", f"--{option}", value]) == 1
    assert not begun
    # A viewer reads a data folder, if it can.
    assert option != "data" or (run(["viewer", "--data", value]), len(begun)) == (0, 1)
