"""The supervisor against small fake services in real processes: order, restart, stop,
orphans."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flexdt.clients.launch import up as launch_up
from flexdt.clients.launch.up import main as up_main
from flexdt.clients.launch.up import services
from flexdt.runtime import process as processes
from flexdt.runtime import supervisor as module
from flexdt.runtime.process_settings import Address, UpSettings
from flexdt.runtime.settings import parse
from flexdt.runtime.supervisor import Addresses, Service, ServiceError, Supervisor
from flexdt.twin import long_work

pytestmark = pytest.mark.slow

FAKE = """
import json, os, signal, socket, sys, time
mode, folder, port = sys.argv[1], sys.argv[2], int(sys.argv[3])
mine = sum(name.startswith(f"{mode}-") for name in os.listdir(folder))  # starts before this one
open(f"{folder}/{mode}-{os.getpid()}.started", "w").close()
if mode == "killed-early" and mine < 2:
    os.kill(os.getpid(), signal.SIGKILL)
if mode == "killed-then-refused" and mine < 3:
    os.kill(os.getpid(), signal.SIGKILL) if mine == 0 else sys.exit(4)
if mode == "mute":
    time.sleep(600)
if mode == "slow":
    time.sleep(0.3)
if mode == "working":  # in a child, as a compiler might
    import subprocess
    code = "import time; any(time.process_time() > 4 for _ in iter(int, 1))"
    subprocess.run([sys.executable, "-c", code], check=True)
if mode == "wordy":
    print("x" * 300_000, flush=True)
    print("[" * 100_000, flush=True)
if mode == "parent":
    import subprocess
    held = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    open(f"{folder}/held-{held.pid}.started", "w").close()
if mode == "dies-early":
    print("not json", flush=True)
    sys.exit(3)
if mode == "stubborn":
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
server = socket.create_server(("127.0.0.1", port))
print("chatter before", flush=True)
if mode == "compiles":  # until the next one has been started
    at = {"bound": mode, "host": "127.0.0.1", "port": server.getsockname()[1]}
    print(json.dumps(at), flush=True)
    while not any(name.startswith("two-") for name in os.listdir(folder)):
        time.sleep(0.02)
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
    # A loaded machine adds no notes of its own.
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (1e6,))

    def make(mode: str) -> Service:
        def command(known: Addresses) -> tuple[str, ...]:
            port = known[mode].port if mode in known else 0
            return ("fake_service", mode, str(tmp_path), str(port))

        return Service(mode, command)

    return make


def started(folder: Path, mode: str) -> list[int]:
    return sorted(
        int(p.stem.rpartition("-")[2]) for p in folder.glob(f"{mode}-*.started")
    )


def answers(at: Address) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((at.host, at.port)) == 0


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
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.0,))
    slow = replace(fake("one"), slow="it compiles")
    notes = supervise([slow, fake("two")], None)[1]
    assert [note for note in notes if "still starting" not in note] == [
        "waiting for the one: it compiles",
        "waiting for the two",
    ]


def test_the_next_starts_while_one_that_has_its_address_compiles(
    fake: Callable[..., Service],
) -> None:
    addresses, notes = supervise([fake("compiles"), fake("two")], None)
    assert list(addresses) == ["compiles", "two"]
    assert notes == []


def test_dead_service_is_restarted_on_its_address(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    async def kill(sup: Supervisor, notes: list[str]) -> None:
        before = sup.addresses["one"]
        os.kill(started(tmp_path, "one")[0], signal.SIGKILL)
        await wait_for(lambda: len(started(tmp_path, "one")) == 2)
        await wait_for(lambda: answers(before))
        assert sup.addresses["one"] == before

    _, notes = supervise([fake("one"), fake("two")], kill)
    assert notes == ["the one ended (killed by SIGKILL); starting it again"]


def test_a_service_that_keeps_dying_ends_no_other_and_is_told_ever_less_often(
    tmp_path: Path, fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FIRST_PAUSE_S", 0.001)
    monkeypatch.setattr(module, "LONGEST_PAUSE_S", 0.001)

    async def wait(sup: Supervisor, notes: list[str]) -> None:
        await wait_for(lambda: len(started(tmp_path, "crashes")) > 17)
        address = sup.addresses["one"]
        socket.create_connection((address.host, address.port)).close()

    _, notes = supervise([fake("one"), fake("crashes")], wait)
    assert len(started(tmp_path, "one")) == 1
    assert [n.partition("; ")[0] for n in notes] == [
        *["the crashes ended (exit code 7)"] * 5,
        "the crashes ended (exit code 7) for the 8th time in a row",
        "the crashes ended (exit code 7) for the 16th time in a row",
    ]


def test_pauses_grow_to_half_a_minute_and_begin_anew_after_steady_work() -> None:
    ends = module.Ends()
    assert [ends.after(0.1) for _ in range(9)] == [
        0.0,
        0.5,
        1.0,
        2.0,
        4.0,
        8.0,
        16.0,
        30.0,
        30.0,
    ]
    assert ends.after(10.0) == 0.0
    assert ends.after(3.0) == 0.5
    ends.row = 10**6
    assert ends.after(0.0) == 30.0


@pytest.mark.parametrize("at", ["first", "last"])
def test_a_service_killed_before_it_was_ready_is_started_again(
    at: str, tmp_path: Path, fake: Callable[..., Service]
) -> None:
    services = [fake("killed-early"), fake("one")]
    addresses, notes = supervise(services if at == "first" else services[::-1], None)
    assert set(addresses) == {"one", "killed-early"}
    assert len(started(tmp_path, "killed-early")) == 3
    assert notes == [
        "the killed-early ended (killed by SIGKILL, while starting); starting it again",
        "the killed-early ended (killed by SIGKILL, while starting); starting it again in 0.5 s",
    ]


def test_once_it_was_killed_a_code_of_its_own_ends_nothing_either(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    """What a kill leaves behind may refuse the next start for a moment."""
    addresses, notes = supervise([fake("one"), fake("killed-then-refused")], None)
    assert set(addresses) == {"one", "killed-then-refused"}
    assert [n.partition(" (")[2].partition(")")[0] for n in notes] == [
        "killed by SIGKILL, while starting",
        "exit code 4, while starting",
        "exit code 4, while starting",
    ]


def test_children_killed_at_random_moments_come_back_on_their_ports(
    tmp_path: Path, fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "LONGEST_PAUSE_S", 0.05)
    chance = random.Random(8)

    async def kill(sup: Supervisor, _: list[str]) -> None:
        before = dict(sup.addresses)
        for _ in range(40):
            await asyncio.sleep(chance.random() * 0.3)
            name = chance.choice(list(before))
            if (process := sup._running.get(name)) is not None:
                with contextlib.suppress(ProcessLookupError):
                    process.kill()
        for address in before.values():
            await wait_for(lambda at=address: answers(at))  # type: ignore[misc]
        assert sup.addresses == before

    supervise([fake("one"), fake("slow"), fake("two")], kill)
    everyone = [p for name in ("one", "slow", "two") for p in started(tmp_path, name)]
    assert len(everyone) > 20
    assert not any(alive(pid) for pid in everyone)


def test_what_an_ended_service_started_does_not_outlive_it(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    """It would hold the pipe, and perhaps the port or the lock of the data directory."""

    async def kill(sup: Supervisor, notes: list[str]) -> None:
        (held,) = started(tmp_path, "held")
        assert alive(held)
        sup._running["parent"].kill()
        await wait_for(lambda: len(started(tmp_path, "parent")) == 2)
        await wait_for(lambda: not alive(held))

    supervise([fake("parent")], kill)
    asyncio.run(
        wait_for(lambda: not any(alive(pid) for pid in started(tmp_path, "held")))
    )


def test_a_service_that_says_nothing_is_ended_and_started_again(
    tmp_path: Path, fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "STALLED_S", 2.0)
    notes: list[str] = []

    async def scenario() -> None:
        stop = asyncio.Event()
        sup = Supervisor([fake("mute")], lambda _: None, notes.append)
        running = asyncio.create_task(sup.run(stop))
        await wait_for(lambda: len(started(tmp_path, "mute")) >= 2)
        stop.set()
        await running

    asyncio.run(scenario())
    assert (
        notes[0]
        == "the mute ended (it did nothing for 2 s, while starting); starting it again"
    )
    assert not any(alive(pid) for pid in started(tmp_path, "mute"))


def test_a_start_may_take_as_long_as_it_works(
    tmp_path: Path, fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four seconds of work where one second of nothing would end it."""
    monkeypatch.setattr(module, "STALLED_S", 1.0)
    monkeypatch.setattr(long_work, "LINE_INTERVALS_S", (0.5,))
    _, notes = supervise([fake("working")], None)
    assert len(started(tmp_path, "working")) == 1
    told = [note for note in notes if "is still starting" in note]
    assert notes == ["waiting for the working", *told], "no end, no second start"
    assert told


def test_processor_time_is_that_of_all_processes_of_a_session() -> None:
    # A tenth more than is asked below: the kernel counts in ticks of 10 ms, each part cut off.
    spin = "import time; any(time.process_time() > 1.1 for _ in iter(int, 1))"
    code = (
        "import subprocess, sys, time\n"
        f"subprocess.run([sys.executable, '-c', '{spin}'])\n"
        "print('done', flush=True)\n"
        "time.sleep(600)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, start_new_session=True
    )
    assert process.stdout is not None
    process.stdout.readline()
    used_s = processes.session_seconds(process.pid)
    process.kill()
    process.wait()
    process.stdout.close()
    assert used_s is not None
    assert 1.0 <= used_s < 5.0
    assert processes.session_seconds(process.pid) is None


def test_lines_that_are_no_ready_line_harm_nobody(fake: Callable[..., Service]) -> None:
    assert list(supervise([fake("wordy")], None)[0]) == ["wordy"]


def test_a_system_without_room_for_a_process_is_asked_again(
    fake: Callable[..., Service], monkeypatch: pytest.MonkeyPatch
) -> None:
    spawn, refused = asyncio.create_subprocess_exec, [True, True]

    async def full(*words: Any, **options: Any) -> Any:
        if refused and refused.pop():
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        return await spawn(*words, **options)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", full)
    addresses, notes = supervise([fake("one")], None)
    assert list(addresses) == ["one"]
    assert notes[0].startswith(
        "the one ended (no process: Resource temporarily unavailable"
    )


def test_a_service_that_never_starts_is_an_error_with_its_exit_code(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
    with pytest.raises(
        ServiceError, match=r"dies-early did not start \(exit code 3\)"
    ) as caught:
        supervise([fake("one"), fake("dies-early")], None)
    assert caught.value.exit_code == 3
    assert not any(alive(pid) for pid in started(tmp_path, "one"))


def test_a_printing_service_never_blocks(
    tmp_path: Path, fake: Callable[..., Service]
) -> None:
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
        "from flexdt.runtime.supervisor import Service, Supervisor\n"
        f"s = Service('one', lambda known: ('fake_service', 'one', {str(tmp_path)!r}, '0'))\n"
        "asyncio.run(Supervisor([s], lambda a: print('ready', flush=True), print)"
        ".run(asyncio.Event()))\n"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdout=subprocess.PIPE
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"ready\n"
        pid = started(tmp_path, "one")[0]
        assert alive(pid)
        parent.kill()
    deadline = time.monotonic() + 60
    while alive(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not alive(pid)


def test_up_ends_where_a_port_is_taken(
    capfd: pytest.CaptureFixture[str],
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert up_main(["--port", str(port), "--projector-port", "0"]) == 4
    captured = capfd.readouterr()
    assert captured.out == ""
    assert f"cannot listen on 127.0.0.1:{port}" in captured.err


def test_up_starts_nothing_where_the_gateway_lacks_its_package(
    capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def run_supervisor(*_: object) -> None:
        raise AssertionError("nothing is to start")

    monkeypatch.setattr(launch_up, "Supervisor", run_supervisor)
    monkeypatch.setitem(sys.modules, "zmq", None)
    assert up_main(["--port", "0", "--projector-port", "0", "--gateway-port", "0"]) == 1
    captured = capfd.readouterr()
    assert captured.out == ""
    said = "flexdt up: --gateway-port: pyzmq is missing: pip install 'flexdt[gateway]'\n"
    assert captured.err == said


def test_addresses_read_as_urls_have_them() -> None:
    assert str(Address("127.0.0.1", 1)) == "127.0.0.1:1"
    assert str(Address("::1", 1)) == "[::1]:1"


@pytest.mark.parametrize(
    ("words", "handed"),
    [([], []), (["--projector-memory", "3GiB"], ["--memory-limit", "3GiB"])],
)
def test_up_hands_the_projector_its_memory(words: list[str], handed: list[str]) -> None:
    first = services(parse(UpSettings, words))[0]
    assert first.name == "projector"
    command = list(first.command({}))
    assert command[command.index("55001") + 1 :] == handed


def test_up_hands_the_twin_further_projectors(tmp_path: Path) -> None:
    words = [
        "--projectors",
        "lab:1,[::1]:2",
        "--projector-token-file",
        str(tmp_path / "token"),
    ]
    twin = services(parse(UpSettings, words))[1]
    assert twin.name == "twin"
    command = list(twin.command({"projector": Address("127.0.0.1", 7)}))
    assert command[command.index("--projector") + 1] == "127.0.0.1:7"
    assert command[command.index("--projectors") + 1] == "lab:1,[::1]:2"
    assert command[command.index("--projector-token-file") + 1] == str(tmp_path / "token")


def test_up_refuses_what_is_no_address(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as error:
        parse(UpSettings, ["--projectors", "lab:1,nowhere"])
    assert error.value.code == 2
    assert "nowhere" in capsys.readouterr().err
