"""`flexdt follow` over real sockets: a scanner that publishes, goes away and comes back."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
import zmq
import zmq.asyncio

from flexdt.clients.cli.command_tree import run
from flexdt.clients.following.frames_beside import FramesBeside
from flexdt.clients.following.listening import endpoint
from flexdt.clients.following.recording import read_recording
from flexdt.clients.following.session import FollowSession, executed_script
from flexdt.phantoms import load_phantom
from flexdt.twin.following.follower import Follower
from flexdt.twin.following.mirror import Alarm
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_profile,
    parse_machine,
)
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.projection import project_scene
from flexdt.twin.script.executed_log import read_log
from tests.support.scanner_traffic import Motor, event, replay

LOG = Path(__file__).parents[1] / "data" / "logs" / "unitom_xl_201106_001.txt"
EXAMPLE = Path(__file__).parents[2] / "examples" / "faulty_scanner.py"
FLEXRAY = builtin_machine("flexray")
MOVE = ("tra_obj", "move absolute", "50.0")


async def until(holds: Callable[[], bool]) -> None:
    """Wait for a condition, however long a loaded machine takes."""
    async with asyncio.timeout(60):
        while not holds():
            await asyncio.sleep(0.01)


def session(tmp_path: Path | None = None) -> tuple[FollowSession, list[Alarm]]:
    alarms: list[Alarm] = []
    follower = Follower(FLEXRAY, builtin_profile(FLEXRAY.default_profile))
    return FollowSession(follower, alarms.append), alarms


def test_it_mirrors_records_and_comes_back_and_sends_nothing(tmp_path: Path) -> None:
    async def work() -> None:
        made, alarms = session()
        with (
            zmq.asyncio.Context() as context,
            (tmp_path / "log").open("wb") as made.record,
        ):
            out = context.socket(zmq.XPUB)  # an XPUB socket hears what subscribers send
            port = out.bind_to_random_port("tcp://127.0.0.1")
            task = asyncio.create_task(made.run(f"tcp://127.0.0.1:{port}"))
            assert await out.recv() == b"\x01", "a subscription, and nothing else"
            for data in (b"\xff no event", event(1, MOVE), event(1, MOVE, "RCV")):
                await out.send(data)
            await out.send(event(1, MOVE, "ACK", "50.0000000000"))
            await until(lambda: made.mirror.positions["tra_obj"] == 50.0)
            assert made.mirror.axes["tra_obj"].heard_s is not None
            assert made.unread == 1
            out.close(linger=0)
            await until(lambda: any(a.kind == "lost" for a in alarms))
            assert not made.mirror.connected
            again = context.socket(zmq.XPUB)
            again.bind(f"tcp://127.0.0.1:{port}")
            await until(lambda: made.mirror.connected)
            assert await again.recv() == b"\x01"
            await again.send(event(2, ("tra_obj", "move absolute", "9999")))
            await until(
                lambda: ("limit", "tra_obj") in [(a.kind, a.about) for a in alarms]
            )
            assert not await again.poll(50), "nothing is ever sent to the scanner"
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
            again.close(linger=0)
        recording = (tmp_path / "log").read_bytes()
        lines, problems = read_log(executed_script(recording, FLEXRAY))
        assert [x.line for x in lines] == [1]
        assert not [p for p in problems if p.severity == "error"]

    asyncio.run(work())


def test_a_real_frame_stands_beside_the_radiograph_of_the_mirrored_pose(
    tmp_path: Path,
) -> None:
    """The frame is of a machine whose axis is aside, which no motor tells; its figure says
    so."""
    made, alarms = session()
    phantom = load_phantom("lego")
    frames, out = tmp_path / "frames", tmp_path / "out"
    frames.mkdir()
    beside = FramesBeside(made.follower, phantom, out)
    axis = FLEXRAY.axes["mag_obj"]
    for data in (
        event(1, ("camera", "set ROI", "800 560 1119 879")),
        event(1, ("camera", "set ROI", ""), "ACK"),
        event(2, ("mag_obj", "move absolute", repr(axis.home))),
        event(2, ("mag_obj", "move absolute", ""), "ACK", f"{axis.home:.10f}"),
    ):  # fmt: skip
        made.message(data)
    camera = made.mirror.camera
    assert camera.shape == (160, 160)
    aside = {**made.mirror.positions, "tra_obj": made.mirror.positions["tra_obj"] + 0.5}
    poses = motor_poses(FLEXRAY, made.follower.profile, camera, aside)
    integrals = project_scene(phantom.scene, poses.cone_vec(), camera.shape)[0]
    counts = np.rint(200 + 10_000 * np.exp(-integrals)).astype(np.uint16)

    async def work() -> None:
        task = asyncio.create_task(made.show_frames(frames, beside))
        await asyncio.sleep(0)
        for name, image in (
            ("di000000.tif", np.full_like(counts, 200)),
            ("io000000.tif", np.full_like(counts, 10_200)),
            ("scan_000000.tif", counts),
        ):  # fmt: skip
            tifffile.imwrite(frames / name, image)
        await until((out / "beside.json").exists)
        tifffile.imwrite(frames / "scan_000001.tif", counts[:50])
        await until(lambda: bool(alarms))
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    asyncio.run(work())
    told = json.loads((out / "beside.json").read_text())
    assert told["file"] == "scan_000000.tif"
    # 0.5 mm aside at SOD 614.9, SDD 1099 and pixels of 0.1496 mm: 6.0 pixels.
    expected = 0.5 * 1099.0 / 614.9192 / 0.1496
    assert abs(abs(told["shift_px"]["columns"]) - expected) < 0.5
    assert abs(told["shift_px"]["rows"]) < 0.5
    picture = cv2.imread(str(out / "beside.png"), cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    assert picture.shape == (160, 320)
    assert "scan_000001.tif" in alarms[-1].message
    assert (alarms[-1].kind, alarms[-1].severity) == ("frame", "warning")


def test_a_recording_is_heard_again_byte_for_byte(tmp_path: Path) -> None:
    """Messages with line ends, bytes that are no text, and a link that is lost in between."""
    made, _ = session()
    raw = [
        json.dumps(json.loads(event(1, MOVE)), indent=4).encode(),
        b"[no stamp] \xff\n[12:00] neither",
        event(1, MOVE, "ACK", "50.0000000000"),
    ]
    with (tmp_path / "log").open("wb") as made.record:
        made.link(True, "")
        for data, after in zip(raw, (0.0, 0.1, 2.1), strict=True):
            made.message(data, made.clock() + after, 0.25)
        made.link(False, "cable")
    recording = (tmp_path / "log").read_bytes()
    found = list(read_recording(recording))
    assert [m.data for m in found][1:-1] == raw
    assert {m.late_s for m in found[1:-1]} == {0.25}
    again, alarms = session()
    again.replay(recording)
    assert again.unread == made.unread == 1
    assert [(a.kind, a.message) for a in alarms] == [
        ("lost", "the link is lost: cable; positions are those heard last")
    ]
    assert again.mirror.positions == made.mirror.positions


def test_a_machine_is_fitted_to_a_recording_as_to_the_log_of_the_same_scan(
    tmp_path: Path,
) -> None:
    lines, _ = read_log(LOG.read_bytes())
    with (tmp_path / "traffic").open("wb") as out:
        for at, data in replay(LOG.read_bytes(), lines):
            hours, seconds = divmod(at, 3600.0)
            clock = (
                f"[{int(hours):02d}:{int(seconds // 60):02d}:{seconds % 60:09.6f} 0.0] "
            )
            out.write(clock.encode() + data + b"\n")
    fitted = {}
    for name, source in (("log", LOG), ("traffic", tmp_path / "traffic")):
        made = tmp_path / f"{name}.toml"
        assert (
            run(
                ["machine", "fit", str(source), "--base", "unitom_xl", "--out", str(made)]
            )
            == 0
        )
        fitted[name] = parse_machine(made.read_text("utf-8"), str(made))
    log, traffic = fitted["log"], fitted["traffic"]
    for name in ("tra_obj", "mag_det", "rot_obj"):
        assert traffic.axes[name].lower == log.axes[name].lower
        assert traffic.axes[name].max_speed == log.axes[name].max_speed
    assert traffic.timing.xray_ready_s == pytest.approx(
        log.timing.xray_ready_s, abs=0.002
    )
    assert traffic.timing.move_s == pytest.approx(log.timing.move_s, abs=0.002)


def test_a_log_of_the_public_monitor_is_heard(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its form: seconds without parts, past midnight; its times are no finer than that."""
    offset = json.dumps(
        {"component": "tra_obj", "command": "move absolute", "arg1": "50", "UUID": "0a-1",
         "reply type": "SENT", "tick count": 1767600381331}
    )  # fmt: skip
    ended = offset.replace("SENT", "ACK").replace('"UUID"', '"reply": "50.4", "UUID"')
    lines = f"[23:59:58] {offset}\n[23:59:59] hello\n[00:00:00] {ended}\n"
    (tmp_path / "zmq_monitor.log").write_text(lines)
    assert run(["follow", "--replay", str(tmp_path / "zmq_monitor.log"), "--json"]) == 0
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert [a["kind"] for a in document["alarms"]] == ["offset"]
    assert document["axes"]["tra_obj"]["position"] == 50.4
    assert document["unread"] == 1
    assert "hello" in document["unread_example"]
    assert "1 messages in no known form" in told.err
    assert run(["follow", "--replay", str(EXAMPLE)]) != 0
    assert run(["follow", "tcp://x", "--replay", str(EXAMPLE)]) == 2


@pytest.mark.slow
def test_a_follower_that_is_busy_for_seconds_finds_a_healthy_machine_healthy() -> None:
    """Its loop stands still while a motor moves and tells of it: times are those of arrival."""
    made, alarms = session()
    axis = FLEXRAY.axes["mag_obj"]
    moved = Motor("mag_obj", axis.home, axis.home - 100.0, axis.speed, axis.acceleration)

    def scanner(out: zmq.Socket[bytes]) -> None:
        began = time.monotonic()
        for at, data in moved.messages(1, 0.0):
            time.sleep(max(0.0, began + at - time.monotonic()))
            out.send(data)

    async def work() -> None:
        with zmq.Context() as context, context.socket(zmq.XPUB) as out:
            out.linger = 0
            port = out.bind_to_random_port("tcp://127.0.0.1")
            task = asyncio.create_task(made.run(f"tcp://127.0.0.1:{port}"))
            assert await asyncio.to_thread(out.recv) == b"\x01"
            sending = asyncio.create_task(asyncio.to_thread(scanner, out))
            await asyncio.sleep(0.4)
            time.sleep(1.2)
            await sending
            await until(lambda: made.mirror.positions["mag_obj"] == moved.target)
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(work())
    assert alarms == []


@pytest.mark.slow
def test_the_example_has_its_three_faults() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    made, alarms = session()

    async def work() -> None:
        scanner = subprocess.Popen([sys.executable, str(EXAMPLE), str(port)])
        task = asyncio.create_task(made.run(f"tcp://127.0.0.1:{port}"))
        try:
            await until(lambda: "lost" in [a.kind for a in alarms])
        finally:
            assert scanner.wait(60) == 0
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    asyncio.run(work())
    errors = [(a.kind, a.about) for a in alarms if a.severity == "error"]
    assert {("slow", "mag_obj"), ("offset", "tra_obj"), ("limits", "tra_obj")} <= set(
        errors
    )
    assert not {k for k, _ in errors} & {"rates", "moved", "off_path", "limit", "failed"}


def test_the_command_says_that_nobody_is_there_and_refuses_what_is_no_address(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["follow", "tcp://127.0.0.1:9", "--for", "0.3", "--json"]) == 4
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert (document["connected"], document["age_s"], document["raised"]) == (
        False,
        None,
        0,
    )
    assert "there has been no connection" in told.err
    assert run(["follow", "tcp://nowhere:99999"]) == 2
    assert "allowed: tcp://HOST[:PORT]" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text", ["", "tcp://", "udp://x", "tcp://x:0", "tcp://x:70000", "a b", "x:y"]
)
def test_what_is_no_address_is_an_error_that_says_what_is(text: str) -> None:
    with pytest.raises(ValueError, match=r"tcp://HOST\[:PORT\]"):
        endpoint(text)
