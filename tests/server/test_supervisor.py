"""The supervisor against small fake services in real processes: order, restart, stop, orphans."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from flexdt.server import supervisor as module
from flexdt.server.supervisor import Address, Addresses, Service, ServiceError, Supervisor
from flexdt.server.up import main as up_main
from flexdt.server.up import parser, port_problem, services

FAKE = """
import json, os, signal, socket, sys, time
mode, folder, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
open(f"{folder}/{mode}-{os.getpid()}.started", "w").close()
if mode == "dies-early":
    print("not json", flush=True)
    sys.exit(3)
if mode == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
server = socket.create_server(("127.0.0.1", port))
print("chatter before", flush=True)
print(json.dumps({"ready": mode, "host": "127.0.0.1", "port": server.getsockname()[1]}), flush=True)
if mode == "chatty":
    for _ in range(200_000):
        print("x" * 20)
    sys.stdout.flush()
    open(f"{folder}/chatty.done", "w").close()
if mode == "crashes":
    time.sleep(0.05)
    os._exit(7)
while True:
    time.sleep(0.05)
"""


@pytest.fixture
def fake(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Service]:
    (tmp_path / "fake_service.py").write_text(FAKE)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(module, "SILENT_S", 1e6)  # a loaded machine adds no notes of its own

    def make(mode: str, *, restart: bool = False) -> Service:
        def command(known: Addresses) -> tuple[str, ...]:
            port = known[mode].port if mode in known else 0
            return ("fake_service", mode, str(tmp_path), str(port))

        return Service(mode, command, restart)

    return make


def started(folder: Path, mode: str) -> list[int]:
    return sorted(int(p.stem.rpartition("-")[2]) for p in folder.glob(f"{mode}-*.started"))


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


async def wait_for(condition: Callable[[], bool], seconds: float = 90.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.02)


def supervise(
    services: list[Service], during: Callable[[Supervisor, list[str]], object] | None
) -> tuple[Addresses, list[str]]:
    """Run until ready, await `during`'s coroutine or the end, stop; addresses and notes."""
    found: list[Addresses] = []
    notes: list[str] = []

    async def scenario() -> None:
        stop = asyncio.Event()
        sup = Supervisor(services, found.append, notes.append)
        running = asyncio.create_task(sup.run(stop))
        await wait_for(lambda: bool(found) or running.done())
        if during is not None and not running.done():
            acting = asyncio.ensure_future(during(sup, notes))  # type: ignore[arg-type]
            await asyncio.wait({acting, running}, return_when=asyncio.FIRST_COMPLETED)
            if acting.done():
                acting.result()
            acting.cancel()
        stop.set()
        await running

    asyncio.run(scenario())
    return found[0], notes


def test_services_start_in_order_and_stop_without_orphans(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    async def connect(sup: Supervisor, _: list[str]) -> None:
        for address in sup.addresses.values():
            socket.create_connection((address.host, address.port)).close()

    addresses, notes = supervise([fake("one"), fake("two")], connect)
    assert list(addresses) == ["one", "two"]
    assert notes == []
    pids = started(tmp_path, "one") + started(tmp_path, "two")
    assert len(pids) == 2
    assert not any(alive(pid) for pid in pids)


def test_who_waits_is_told_for_what(
    fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "SILENT_S", 0.0)
    slow = replace(fake("one"), slow="it compiles")
    assert supervise([slow, fake("two")], None)[1] == [
        "waiting for the one: it compiles",
        "waiting for the two",
    ]


def test_dead_service_is_restarted_on_its_address(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    async def kill(sup: Supervisor, notes: list[str]) -> None:
        before = sup.addresses["one"]
        os.kill(started(tmp_path, "one")[0], signal.SIGKILL)
        await wait_for(lambda: len(started(tmp_path, "one")) == 2)

        def answers() -> bool:
            with socket.socket() as probe:
                return probe.connect_ex((before.host, before.port)) == 0

        await wait_for(answers)
        assert sup.addresses["one"] == before

    _, notes = supervise([fake("one", restart=True), fake("two")], kill)
    assert notes == ["the one ended (killed by SIGKILL); starting it again"]


def test_a_service_that_keeps_dying_is_given_up(fake: Callable[..., Service]) -> None:
    told: list[list[str]] = []

    async def wait(sup: Supervisor, notes: list[str]) -> None:
        told.append(notes)
        await asyncio.sleep(90)  # the end comes before

    with pytest.raises(ServiceError, match=r"crashes ended \(exit code 7\) for the 6th time"):
        supervise([fake("crashes", restart=True)], wait)
    assert len(told[0]) == module.MAX_RESTARTS


def test_end_of_an_essential_service_ends_all(tmp_path: Path, fake: Callable[..., Service]) -> None:
    with pytest.raises(ServiceError, match="crashes ended by itself") as caught:
        supervise([fake("one"), fake("crashes")], lambda *_: asyncio.sleep(90))
    assert caught.value.exit_code == 7
    assert not any(alive(pid) for pid in started(tmp_path, "one"))


def test_a_service_that_never_starts_is_an_error_with_its_exit_code(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    with pytest.raises(ServiceError, match=r"dies-early did not start \(exit code 3\)") as caught:
        supervise([fake("one"), fake("dies-early")], None)
    assert caught.value.exit_code == 3
    assert not any(alive(pid) for pid in started(tmp_path, "one"))


def test_a_printing_service_never_blocks(tmp_path: Path, fake: Callable[..., Service]) -> None:
    async def wait(*_: object) -> None:
        await wait_for((tmp_path / "chatty.done").exists)

    supervise([fake("chatty")], wait)


def test_a_stubborn_service_is_killed(
    tmp_path: Path, fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STOP_GRACE_S", 0.3)
    _, notes = supervise([fake("stubborn")], None)
    assert notes == ["the stubborn did not stop; killing it"]
    assert not any(alive(pid) for pid in started(tmp_path, "stubborn"))


def test_children_stop_when_the_parent_is_killed_outright(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    fake("one")
    script = (
        "import asyncio, sys\n"
        "from flexdt.server.supervisor import Service, Supervisor\n"
        f"s = Service('one', lambda known: ('fake_service', 'one', {str(tmp_path)!r}, '0'))\n"
        "asyncio.run(Supervisor([s], lambda a: print('ready', flush=True), print)"
        ".run(asyncio.Event()))\n"
    )
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"ready\n"
        pid = started(tmp_path, "one")[0]
        assert alive(pid)
        parent.kill()
    deadline = time.monotonic() + 60
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def test_up_refuses_a_taken_port(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert up_main(["--port", str(port), "--projector-port", "0"]) == 4
    captured = capsys.readouterr()
    assert captured.out == ""
    assert f"cannot listen on 127.0.0.1:{port}" in captured.err


def test_port_zero_is_always_free() -> None:
    assert port_problem("127.0.0.1", 0) is None


def test_addresses_read_as_urls_have_them() -> None:
    assert str(Address("127.0.0.1", 1)) == "127.0.0.1:1"
    assert str(Address("::1", 1)) == "[::1]:1"


@pytest.mark.parametrize(
    ("words", "handed"), [([], []), (["--projector-memory", "3GiB"], ["--memory-limit", "3GiB"])]
)
def test_up_hands_the_projector_its_memory(words: list[str], handed: list[str]) -> None:
    first = services(parser().parse_args(words))[0]
    assert first.name == "projector"
    command = list(first.command({}))
    assert command[command.index("55001") + 1 :] == handed
