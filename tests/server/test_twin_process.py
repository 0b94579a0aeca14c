"""Twin and projector as real processes, spoken to as plain `nc` would."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.phantoms import load_phantom
from flexdt.server.twin.main import DEFAULT_SAMPLE

pytestmark = pytest.mark.timeout(120)


class Process:
    """A server module with its `ready` line."""

    def __init__(self, module: str, *options: str) -> None:
        self.child = subprocess.Popen(
            [sys.executable, "-m", module, *options],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.child.stdout is not None
        line = self.child.stdout.readline()
        if not line:
            raise AssertionError(self.child.communicate(timeout=20)[1])
        self.ready: dict[str, Any] = json.loads(line)

    def end(self, number: int = signal.SIGTERM) -> int:
        if self.child.poll() is None:
            self.child.send_signal(number)
        with contextlib.suppress(ValueError):
            self.child.communicate(timeout=90)
        return self.child.returncode


class Wire:
    """JSON lines over a socket; events are kept apart from answers."""

    def __init__(self, port: int) -> None:
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=60)
        self.file = self.socket.makefile("rw", encoding="utf-8", newline="\n")
        self.count = 0
        self.events: list[dict[str, Any]] = []

    def ask(self, method: str, **params: object) -> dict[str, Any]:
        self.count += 1
        request = {"jsonrpc": "2.0", "id": self.count, "method": method, "params": params}
        self.file.write(json.dumps(request) + "\n")
        self.file.flush()
        while True:
            answer: dict[str, Any] = json.loads(self.file.readline())
            if answer.get("method") == "event":
                self.events.append(answer["params"])
            else:
                assert answer["id"] == self.count
                return answer

    def call(self, method: str, **params: object) -> Any:
        answer = self.ask(method, **params)
        assert "error" not in answer, answer
        return answer["result"]

    def wait(self, job: str, *states: str) -> dict[str, Any]:
        until = time.monotonic() + 120.0
        while True:
            status: dict[str, Any] = self.call("job.status", job=job)
            if status["state"] in states:
                return status
            assert time.monotonic() < until, status
            time.sleep(0.02)


def twin(rays: Any, data: Path, *options: str) -> Process:
    address = f"127.0.0.1:{rays.ready['port']}"
    return Process(
        "flexdt.server.twin.main",
        *("--port", "0", "--projector", address, "--data", str(data), *options),
    )


def script(frames: int) -> str:
    """A fly scan of small images; speed and run-up follow the smooth-scan rule at 100 ms."""
    speed = 360.0 / (frames - 1) / 0.1
    run_up = speed * speed / (2 * 22.5) + 0.4 * speed
    rows = [
        "tube\tset power\t20.0\t\tACK\t\t",
        "camera\tset ROI\t700 600 1211 855\t\tACK\t\t",
        "camera\tset exposure\t100.0\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        f"camera\tset number of frames\t{frames}\t\tACK\t\t",
        "ver_tube\tmove absolute\t26.0\t\tno wait\t\t",
        "ver_det\tmove absolute\t20.0\t\tACK\t\t",
        f"rot_obj\tset speed\t{speed}\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{-run_up}\t\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tdi000000.tif\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        f"rot_obj\tmove absolute\t{360.0 + run_up}\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t",
        "",
    ]
    return "\r\n".join(rows)


@pytest.mark.slow  # daily in tests/journeys/test_plain_sockets.py
def test_move_projection_and_script_over_plain_lines(rays: Any, tmp_path: Path) -> None:
    process = twin(rays, tmp_path / "data", "--speed-up", "max")
    try:
        wire = Wire(process.ready["port"])
        assert (
            wire.call("axes.move", targets={"mag_obj": 500}, wait=True)["duration_s"]
            == 3.0
        )
        image = wire.call("projection.get", binning=4)
        assert image["shape"] == [190, 239]
        values = np.frombuffer(base64.b64decode(image["data"]), dtype="<f4")
        assert values.max() > 0.5  # the LEGO phantom stands in the beam
        job = wire.call("script.submit", text=script(46), name="lines")["job"]
        status = wire.wait(job, "done", "failed")
        assert (status["state"], status["frames_done"]) == ("done", 46)
        names = {f.name for f in (tmp_path / "data" / "lines").iterdir()}
        assert {"di000000.tif", "scan_000045.tif", "script.txt", "flexdt.json"} <= names
        assert wire.ask("axes.fly")["error"]["code"] == -32601
        assert wire.ask("axes.move", targets={"mag_obj": 5})["error"]["code"] == -32001
    finally:
        assert process.end() == 0


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_a_projector_killed_in_mid_scan_comes_back_and_nothing_is_lost(
    tmp_path: Path,
) -> None:
    first = Process("flexdt.server.projector.main", "--port", "0", "--threads", "1")
    process = twin(first, tmp_path / "data", "--speed-up", "60")
    second: Process | None = None
    try:
        wire = Wire(process.ready["port"])
        reference = wire.call(
            "script.submit", text=script(61), name="ref", seed=2, speed_up="max"
        )
        wire.wait(reference["job"], "done")
        job = wire.call("script.submit", text=script(61), name="killed", seed=2)["job"]
        while wire.call("job.status", job=job)["frames_done"] < 5:
            time.sleep(0.01)
        first.end(signal.SIGKILL)
        assert wire.call("session.ping")["time"] > 0  # the twin lives on
        second = Process(
            "flexdt.server.projector.main",
            "--threads",
            "1",
            "--port",
            str(first.ready["port"]),
        )
        status = wire.wait(job, "done", "failed", "paused")
        if status["state"] == "paused":  # it was away for longer than the twin's patience
            assert status["error"]["code"] == -32006
            wire.call("job.resume", job=job)
            status = wire.wait(job, "done", "failed")
        assert (status["state"], status["frames_done"]) == ("done", 61)
        for name in (
            "scan_000000.tif",
            "scan_000030.tif",
            "scan_000060.tif",
            "di000000.tif",
        ):
            folder = tmp_path / "data"
            assert (folder / "killed" / name).read_bytes() == (
                folder / "ref" / name
            ).read_bytes()
    finally:
        process.end()
        first.end(signal.SIGKILL)
        if second is not None:
            second.end()


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_sigterm_in_mid_scan_ends_cleanly_and_the_data_set_says_incomplete(
    rays: Any, tmp_path: Path
) -> None:
    process = twin(rays, tmp_path / "data", "--speed-up", "2")
    wire = Wire(process.ready["port"])
    wire.call("script.submit", text=script(361), name="cut", speed_up=20)
    while wire.call("job.status")["frames_done"] < 3:
        time.sleep(0.01)
    assert process.end() == 0
    folder = tmp_path / "data" / "cut"
    document = json.loads((folder / "flexdt.json").read_text())
    assert document["complete"] is False
    assert "stopped" in document["reason"]
    assert "SCRIPT CANCELLED!" in (folder / "scan settings.txt").read_text()
    assert not list(folder.glob(".*"))


@pytest.mark.daily(3)
@pytest.mark.parametrize(
    ("options", "code", "says"),
    [
        (["--host", "0.0.0.0"], 2, "token"),
        (["--truth", "{data}/truth.toml"], 1, "inside the data directory"),
        (["--machine", "warp-drive"], 1, "flexray"),
        (["--profile", "yesterday"], 1, "cwi-2023-08-21"),
        (["--machine", "missing.toml"], 1, "missing.toml: No such file"),
        (["--profile", "missing.toml"], 1, "missing.toml: No such file"),
        (
            ["--machine", "xyzr_cabinet", "--profile", "thesis"],
            1,
            "for machine 'flexray'",
        ),
        (["--speed-up", "-3"], 2, "speed-up"),
        (["--sample", "unicorn"], 1, "lego"),
    ],
)
@pytest.mark.campaign(4)
def test_a_bad_configuration_is_one_readable_line(
    options: list[str], code: int, says: str, tmp_path: Path
) -> None:
    (tmp_path / "truth.toml").write_text("dD_x = 1.0\n")
    words = [o.format(data=tmp_path) for o in options]
    done = subprocess.run(
        [sys.executable, "-m", "flexdt.server.twin.main", "--port", "0", "--data", str(tmp_path),
         *words], capture_output=True, text=True, timeout=200,
        env={k: v for k, v in os.environ.items() if k != "FLEXDT_TOKEN"},
    )  # fmt: skip
    assert done.returncode == code
    assert says in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_a_new_twin_shows_a_sample_without_metal() -> None:
    """Streaks of metal are a poor first volume."""
    phantom = load_phantom(DEFAULT_SAMPLE)
    bodies = [s.material for s in phantom.surfaces]
    assert bodies
    assert len(phantom.beads) == 0
    inside = {*bodies, *(s.material for s in phantom.scene.solids)}
    assert inside <= {"abs", "pla", "water", "air"}
