"""A program written for the scanner, with plain pyzmq, drives a real twin process."""

from __future__ import annotations

import asyncio
import itertools
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
import zmq

from flexdt.clients.following.session import FollowSession
from flexdt.clients.launch.processes import Servers
from flexdt.library.reading.folders import load_dataset
from flexdt.twin.following.follower import Follower
from flexdt.twin.machine.description import builtin_machine, builtin_profile

pytestmark = pytest.mark.slow

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "acquila_client.py"
FIELDS = {"component", "comp_phys", "command", "arg1", "arg2", "reply", "reply type", "comp_type",
          "tick count", "UUID"}  # fmt: skip


UUIDS = itertools.count(os.getpid() * 10**6)


class Program:
    """Written from the interface's description alone."""

    def __init__(self, out: int, into: int) -> None:
        self.context = zmq.Context()
        self.hear = self.context.socket(zmq.SUB)
        self.hear.subscribe(b"")
        self.hear.connect(f"tcp://127.0.0.1:{out}")
        self.say = self.context.socket(zmq.PUB)
        self.say.connect(f"tcp://127.0.0.1:{into}")
        self._meet()

    def _meet(self) -> None:
        """ZeroMQ drops what is sent before both ends know each other: knock until heard."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            uuid = self.send("scanner", "status_time_get")
            if self.events(uuid, 0.3):
                while self.hear.poll(300):
                    self.hear.recv()
                return
        raise AssertionError("the gateway does not answer")

    def event(
        self, component: str, command: str, *arguments: object, **more: object
    ) -> Any:
        arg1, arg2 = (*map(str, arguments), "", "")[:2]
        return {"component": component, "comp_phys": "", "command": command, "arg1": arg1,
                "arg2": arg2, "reply": "", "reply type": "", "comp_type": "other",
                "tick count": 1234, "UUID": next(UUIDS)} | more  # fmt: skip

    def send(
        self, component: str, command: str, *arguments: object, **more: object
    ) -> Any:
        event = self.event(component, command, *arguments, **more)
        self.say.send_string(json.dumps(event))
        return event["UUID"]

    def events(self, uuid: object, seconds: float = 90.0) -> list[dict[str, Any]]:
        """Replies to a command, up to ACK or ERR."""
        out: list[dict[str, Any]] = []
        deadline = time.monotonic() + seconds
        while self.hear.poll(max(0, int(1000 * (deadline - time.monotonic())))):
            event = json.loads(self.hear.recv_string())
            if event["UUID"] == uuid and event["reply type"] not in ("", "SEND"):
                assert set(event) == FIELDS
                out.append(event | {"at": time.monotonic()})
                if event["reply type"] in ("ACK", "ERR"):
                    return out
        return out

    def do(self, *words: object) -> str:
        uuid = self.send(*words)  # type: ignore[arg-type]
        events = self.events(uuid)
        kinds = [e["reply type"] for e in events]
        assert kinds[0] == "RCV", (words, events)
        assert kinds[-1] == "ACK", (words, events)
        assert set(kinds[1:-1]) <= {"FDB"}
        return str(events[-1]["reply"])

    def fails(self, *words: object) -> str:
        events = self.events(self.send(*words))  # type: ignore[arg-type]
        assert [e["reply type"] for e in events][-1] == "ERR", events
        return str(events[-1]["reply"])

    def close(self) -> None:
        self.context.destroy(linger=0)


@pytest.fixture(scope="module")
def data_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def servers(data_dir: Path) -> Iterator[Servers]:
    options = {"data": data_dir, "speed-up": "max", "gateway-port": 0}
    with Servers(options, data_dir.parent / "servers.log") as running:
        yield running


@pytest.fixture
def ports(servers: Servers) -> tuple[int, int]:
    ready: Any = servers.ready["gateway"]
    return int(ready["port"]), int(ready["inbound"])


@pytest.fixture
def program(ports: tuple[int, int]) -> Iterator[Program]:
    made = Program(*ports)
    yield made
    made.close()


def test_motors_tube_and_camera_obey(program: Program, plain: Any) -> None:
    moved = struct.unpack_from(
        ">2d", program.do("mag_obj", "move absolute", "590.25").encode("latin-1")
    )
    assert moved == (590.25, 590.25)
    reply = program.do("mag_obj", "move absolute", 590.0).encode("latin-1")
    assert len(reply) == 267
    assert struct.unpack_from(">d", reply)[0] == 590.0
    assert struct.unpack_from(">2d", reply, 40) == struct.unpack_from(">2d", reply, 143)
    assert program.do("mag_obj", "status_position_get") == "590.0000000000"
    program.do("tube", "set kV", 70)
    program.do("tube", "set power", "30.5")
    assert program.do("camera", "set exposure", 40) == "40.000000"
    program.do("camera", "set ROI", "800 620 1199 939")
    assert program.do("rot_obj", "set speed", "12.5") == "12.5000000000"
    state = plain.call("state.get")
    assert state["axes"]["mag_obj"]["position"] == 590.0
    assert (state["tube"]["kV"], state["tube"]["power_W"]) == (70.0, 30.5)
    assert state["camera"]["exposure_ms"] == 40.0
    assert state["axes"]["rot_obj"]["speed"] == 12.5
    program.do("tube", "xrayon")
    program.do("tube", "REPEAT UNTIL TRUE status_XReady_get")
    assert program.do("tube", "status_XReady_get") == "TRUE"
    assert "200 x 160" in program.do("camera", "take image")
    program.do("tube", "xrayoff")
    assert program.do("tube", "status_XReady_get") == "FALSE"
    assert plain.call("state.get")["controller"] is None, (
        "control goes back when nothing runs"
    )


def test_replies_bear_the_commands_uuid_and_tick(program: Program) -> None:
    for uuid in (2**53 + 1, 2**64 + 5, -26481, 1.2345e18, "an-id-of-text"):
        asked = program.send(
            "tube", "set kV", 80, UUID=uuid, **{"tick count": 1380210404}
        )
        events = program.events(asked)
        assert [e["reply type"] for e in events] == ["RCV", "ACK"]
        assert {e["tick count"] for e in events} == {1380210404}
        assert {e["comp_type"] for e in events} == {"tube"}
    program.send("tube", "set kV", 81, UUID=0)
    given = [json.loads(program.hear.recv_string()) for _ in range(3)]
    assert [e["reply type"] for e in given] == ["", "RCV", "ACK"]
    (uuid,) = {e["UUID"] for e in given}
    assert isinstance(uuid, int)
    assert uuid > 0


def test_long_commands_say_how_far_they_are(program: Program, plain: Any) -> None:
    program.do("mag_obj", "move absolute", 500)
    plain.call("clock.set", speed_up=1)
    plain.call("session.control", action="release")
    try:
        events = program.events(program.send("mag_obj", "move absolute", 900))
    finally:
        plain.call("clock.set", speed_up="max")
        plain.call("session.control", action="release")
    feedback = [e for e in events if e["reply type"] == "FDB"]
    assert len(feedback) >= 3  # 8.9 s of the twin, and as many here
    places = [float(e["reply"]) for e in feedback]
    assert places == sorted(places)
    assert 500 < places[0] < places[-1] <= 900


def test_errors_name_what_is_allowed(program: Program) -> None:
    assert "kV 200 is outside [0, 90]" in program.fails("tube", "set kV", 200)
    assert "it knows: xrayon" in program.fails("tube", "explode")
    assert "no component 'tra_sky'; the twin has" in program.fails(
        "tra_sky", "move absolute", 1
    )
    assert "the twin has: scanner" in program.fails("heater", "set temp", 20)
    program.say.send_string("no json")
    while True:
        event = json.loads(program.hear.recv_string())
        if event["component"] == "gateway":
            break
    assert event["reply type"] == "ERR"
    assert "not a JSON object" in event["reply"]


def test_a_line_beyond_a_limit_ends_at_the_limit_switch(program: Program) -> None:
    """As in a script: the FleX-ray's machine file says `on_limit = "clamp"`."""
    program.do("mag_obj", "move absolute", 5000)
    assert float(program.do("mag_obj", "status_position_get")) == 996.0
    assert float(program.do("mag_obj", "set speed", 10**6)) == 50.0
    program.do("mag_obj", "move absolute", 600)
    program.do("mag_det", "move absolute", 1060)  # Listing 1 asks for it
    assert float(program.do("mag_det", "status_position_get")) == 1059.0


def test_absurd_events_end_nothing(program: Program, servers: Servers) -> None:
    """One with a lone surrogate ended the gateway, six of them the twin and the projector,
    too."""
    pids = children(servers.pid)
    for _ in range(8):
        program.say.send_string(
            json.dumps({"component": "tube\ud800", "command": "xray on"})
        )
    for words in (
        ("mag_obj", "move absolute", "1e300"), ("mag_obj", "set speed", "1e-300"),
        ("mag_obj", "move absolute", -(2**70)),  # the source stands before that limit
        ("tube", "set kV", 10**9), ("tube", "set power", "0"), ("camera", "set exposure", "1e9"),
        ("camera", "set ROI", "1000000 1000000 1000000 1000000"), ("camera", "set mode", "\x00"),
        ("camera", "set number of averages", "100000"), ("scanner", "run script", "\x00" * 1000),
        ("scanner", "pause", "[" * 100_000),
        ("camera", "take and save image sequence", "a", -1),
    ):  # fmt: skip
        assert "internal error" not in program.fails(*words), words
    for target in (10**9, 600):  # to a limit, as at its switch, and back
        program.do("mag_obj", "move absolute", target)
    assert float(program.do("scanner", "status_time_get")) > 0
    assert children(servers.pid) == pids, "nobody was started again"


def test_a_component_of_somebody_else_hears_and_answers(
    program: Program, ports: tuple[int, int]
) -> None:
    heater = Program(*ports)
    asked = program.send("heater", "set temp", 20)
    while True:
        event = json.loads(heater.hear.recv_string())
        if event["component"] == "heater" and event["reply type"] == "":
            break
    for kind, reply in (("RCV", ""), ("FDB", "19 C"), ("ACK", "20 C")):
        heater.say.send_string(json.dumps(event | {"reply type": kind, "reply": reply}))
    events = program.events(asked)
    assert [e["reply type"] for e in events] == ["RCV", "FDB", "ACK"]
    assert events[-1]["reply"] == "20 C"
    heater.close()


def test_a_scan_in_steps(program: Program, data_dir: Path) -> None:
    do = program.do
    do("scanner", "set output path", r"E:\lab\..\steps")
    do("camera", "set ROI", "800 620 1199 939")
    do("tube", "xrayoff")
    do("camera", "take image")
    do("camera", "save image", r"E:\lab\steps\di000000.tif")
    do("tube", "xrayon")
    assert do("tube", "REPEAT UNTIL TRUE status_XReady_get") == "TRUE"
    do("tra_obj", "move absolute", -140)
    do("camera", "take image")
    do("camera", "save image", r"E:\lab\steps\io000000.tif")
    do("tra_obj", "move absolute", 0)
    for i in range(4):
        do("rot_obj", "move absolute", 30.0 * i)
        do("camera", "take image")
        path = do("camera", "save image", rf"..\..\scan_{i:06d}.tif")
        assert Path(path).parent == data_dir / "steps"
    assert "has scan_000003.tif already" in program.fails(
        "camera", "save image", "scan_000003.tif"
    )
    data = load_dataset(data_dir / "steps")
    assert data.complete
    assert (len(data), len(data.darks), len(data.flats)) == (4, 1, 1)
    assert np.allclose(data.angles_deg, [0, 30, 60, 90])
    assert data.line_integrals(0).max() > 0.5, "something stands in the beam"
    dark, flat = (tifffile.imread(data.folder / f"{n}000000.tif") for n in ("di", "io"))
    assert flat.mean() > 10 * dark.mean()


def test_without_an_output_path_the_files_own_folder_counts(
    servers: Servers, data_dir: Path, tmp_path: Path
) -> None:
    process, program = start_gateway("{}:{}".format(*servers.address), data_dir)
    program.do("camera", "take image")
    path = Path(program.do("camera", "save image", r"E:\lab\own\scan_000000.tif"))
    assert path == data_dir / "own" / "scan_000000.tif"
    assert tifffile.imread(path).dtype == np.uint16
    stop_gateway(process, program)


def test_the_example_takes_a_scan_in_motion(
    servers: Servers, ports: tuple[int, int], data_dir: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-W", "error", str(EXAMPLE), "127.0.0.1", *map(str, ports)],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "19 images in" in done.stdout
    assert "flexdt" not in EXAMPLE.read_text().split('"""', 2)[2], (
        "a program for the scanner"
    )
    data = load_dataset(data_dir / "example")
    texts = load_dataset(data_dir / "example", ignore_document=True)
    assert data.complete
    # The scanner's rule: image i at i * 360 / (N - 1), whatever the network did meanwhile.
    assert np.allclose(data.angles_deg, 20.0 * np.arange(19), atol=1e-9)
    assert np.abs(texts.cone_vec.rows - data.cone_vec.rows).max() < 1e-4
    assert (data.folder / "script.txt").read_bytes().count(b"\r\n") == 25


def test_a_sequence_can_be_aborted(program: Program, plain: Any) -> None:
    program.do("camera", "set number of frames", 121)
    plain.call("clock.set", speed_up=1)
    plain.call("session.control", action="release")
    running = program.send("camera", "take and save image sequence", "long_", 0)
    deadline = time.monotonic() + 60
    while not any(j["state"] == "running" for j in plain.call("job.list")["jobs"]):
        assert time.monotonic() < deadline
    aborting = program.send("scanner", "abort script")
    # The two end in either order, and each in its own words.
    ended: dict[Any, dict[str, Any]] = {}

    def both(event: dict[str, Any]) -> bool:
        if event["reply type"] in ("ACK", "ERR"):
            ended[event["UUID"]] = event
        return {running, aborting} <= set(ended)

    all_until(program, both)
    assert ended[aborting]["reply type"] == "ACK"
    assert "ended aborted" in ended[running]["reply"]
    plain.call("clock.set", speed_up="max")
    plain.call("session.control", action="release")
    jobs = plain.call("job.list")["jobs"]
    assert jobs[-1]["state"] == "aborted"


def all_until(
    program: Program, last: Callable[[dict[str, Any]], bool]
) -> list[dict[str, Any]]:
    """Everything that is heard up to an event."""
    out: list[dict[str, Any]] = []
    while program.hear.poll(90_000):
        out.append(json.loads(program.hear.recv_string()))
        if last(out[-1]):
            return out
    raise AssertionError(out)


def test_clients_hear_what_others_command(
    program: Program, plain: Any, fly_script: Callable[..., str]
) -> None:
    """The wire, which the viewer uses, and scripts; a client's own command is told once."""
    program.do("mag_obj", "move absolute", 580)
    program.do("camera", "set exposure", 55)
    plain.call("axes.move", targets={"mag_obj": 610.0, "tra_obj": 12.0}, wait=True)
    plain.call("session.control", action="release")
    ends: set[str] = set()

    def both(event: dict[str, Any]) -> bool:
        if event["reply type"] == "ACK":
            ends.add(event["component"])
        return {"mag_obj", "tra_obj"} <= ends

    told = all_until(program, both)
    sent = [
        (e["component"], e["command"], e["arg1"]) for e in told if not e["reply type"]
    ]
    assert sorted(sent) == [
        ("mag_obj", "move absolute", "610.0000000000"),
        ("tra_obj", "move absolute", "12.0000000000"),
    ]
    for name, at in (("mag_obj", 610.0), ("tra_obj", 12.0)):
        kinds = [e["reply type"] for e in told if e["component"] == name]
        assert (kinds[0], kinds[1], kinds[-1]) == ("", "RCV", "ACK")
        reply = next(
            e for e in told if (e["component"], e["reply type"]) == (name, "ACK")
        )
        assert struct.unpack_from(">d", reply["reply"].encode("latin-1")) == (at,)
    text = fly_script(13)
    job = plain.call("script.submit", text=text, name="heard")["job"]
    lines = [tuple(line.split("\t")[:4]) for line in text.split("\r\n") if line.strip()]
    final, count = lines[-1], 0

    def over(event: dict[str, Any]) -> bool:
        nonlocal count
        count += not event["reply type"]
        return (
            count == len(lines)
            and event["reply type"] == "ACK"
            and event["command"] == final[1]
        )

    told = all_until(program, over)
    heard = [
        (e["component"], e["command"], e["arg1"], e["arg2"])
        for e in told
        if not e["reply type"]
    ]
    assert heard == [(*line, "", "")[:4] for line in lines]
    by_key: dict[object, list[str]] = {}
    for e in told:
        by_key.setdefault(e["UUID"], []).append(e["reply type"])
    assert all(k[:2] == ["", "RCV"] and k[-1] == "ACK" for k in by_key.values())
    assert plain.call("job.status", job=job)["state"] == "done"


def test_a_component_of_somebody_else_takes_part_in_a_scripted_scan(
    program: Program, ports: tuple[int, int], plain: Any
) -> None:
    heater = Program(*ports)
    lines = ("heater\tset temp\t20\t\tACK\t\t", "tube\txrayoff\t\t\tACK\t\t")
    text = "".join(f"{line}\r\n" for line in lines)
    job = plain.call("script.submit", text=text, name="heated")["job"]
    plain.call("session.control", action="release")
    asked = all_until(heater, lambda e: e["component"] == "heater")[-1]
    assert (asked["reply type"], asked["command"], asked["arg1"]) == (
        "",
        "set temp",
        "20",
    )
    for kind, reply in (("RCV", ""), ("ACK", "20 C")):
        heater.say.send_string(json.dumps(asked | {"reply type": kind, "reply": reply}))
    told = program.events(asked["UUID"])
    assert [(e["reply type"], e["reply"]) for e in told] == [("RCV", ""), ("ACK", "20 C")]
    heater.close()
    while plain.call("job.status", job=job)["state"] != "done":
        time.sleep(0.02)


def test_who_follows_the_gateway_sees_where_its_machine_differs(
    ports: tuple[int, int], plain: Any
) -> None:
    """What is known has another limit and a faster motor than the machine that is served."""
    flexray = builtin_machine("flexray")
    tra, mag = flexray.axes["tra_obj"], flexray.axes["mag_obj"]
    known = {
        "tra_obj": tra.model_copy(update={"upper": tra.upper + 40.0}),
        "mag_obj": mag.model_copy(
            update={"speed": 3 * mag.speed, "max_speed": 3 * mag.speed}
        ),
    }
    machine = flexray.model_copy(update={"axes": {**flexray.axes, **known}})
    alarms: list[tuple[str, str]] = []
    follower = Follower(machine, builtin_profile(flexray.default_profile))
    session = FollowSession(follower, lambda a: alarms.append((a.kind, a.about)))

    async def until(holds: Callable[[], bool]) -> None:
        async with asyncio.timeout(90):
            while not holds():
                await asyncio.sleep(0.02)

    async def work() -> None:
        task = asyncio.create_task(session.run(f"tcp://127.0.0.1:{ports[0]}"))
        await until(lambda: session.mirror.connected)
        for at in range(
            1, 600
        ):  # ZeroMQ drops what is sent before both ends know each other
            await asyncio.to_thread(
                plain.call, "axes.move", targets={"tra_obj": 0.1 * at}, wait=True
            )
            await asyncio.sleep(0.1)
            if ("limits", "tra_obj") in alarms:
                break
        assert ("limits", "tra_obj") in alarms
        await asyncio.to_thread(plain.call, "clock.set", speed_up=1)
        at = plain.call("state.get")["axes"]["mag_obj"]["position"]
        target = at + (250.0 if at < 600.0 else -250.0)
        await asyncio.to_thread(
            plain.call, "axes.move", targets={"mag_obj": target}, wait=True
        )
        await until(lambda: abs(session.mirror.positions["mag_obj"] - target) < 1e-6)
        assert ("slow", "mag_obj") in alarms
        assert session.mirror.axes["mag_obj"].speed == mag.speed, (
            "as the motor's reply says"
        )
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    try:
        asyncio.run(work())
    finally:
        plain.call("clock.set", speed_up="max")
        plain.call("session.control", action="release")


def children(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def start_gateway(twin: str, data: Path) -> tuple[subprocess.Popen[str], Program]:
    process = subprocess.Popen(
        [sys.executable, "-m", "flexdt.clients.gateway.main", "--port", "0", "--server", twin,
         "--data", str(data)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    ready = json.loads(process.stdout.readline())
    return process, Program(ready["port"], ready["inbound"])


def stop_gateway(process: subprocess.Popen[str], program: Program) -> None:
    program.close()
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 0
    assert process.stdout is not None
    process.stdout.close()


def test_without_a_twin_commands_fail_and_say_so(tmp_path: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        nobody = probe.getsockname()[1]
    process, program = start_gateway(f"127.0.0.1:{nobody}", tmp_path)
    assert "cannot be reached" in program.fails("tube", "xrayon")
    stop_gateway(process, program)


def test_without_pyzmq_it_says_what_to_install(tmp_path: Path) -> None:
    program = (
        "import sys; sys.modules['zmq'] = None; from flexdt.clients.gateway.main import main; "
        "sys.exit(main(['--port', '0']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=200, check=False,
        cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 1
    assert done.stderr.strip() == (
        "flexdt gateway: pyzmq is missing: pip install 'flexdt[gateway]'"
    )


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
@pytest.mark.campaign(1)
def test_others_are_kept_out(host: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.clients.gateway.main", "--bind", host, "--port", "0"],
        capture_output=True, text=True, timeout=200, check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 2
    assert "SSH tunnel" in done.stderr
    assert "Traceback" not in done.stderr
