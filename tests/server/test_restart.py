"""What a twin server knows again after it was killed, and how scans go on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from lab import Process, Refused, Wire, digests, fly_script, twin

from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.two_slots import TwoSlots

pytestmark = [pytest.mark.timeout(240), pytest.mark.slow]


def restarted(process: Process, rays: Process, data: Path, *options: object) -> Process:
    os.kill(process.pid, signal.SIGKILL)
    process.child.wait()
    return twin(rays.port, data, *options)


def until_written(data: Path, holds: Callable[[Any], bool]) -> None:
    """Wait until what the journal has `holds`; it is written a moment later."""
    until = time.monotonic() + 60.0
    while True:
        with contextlib.suppress(ValueError), Directory(data) as folder:
            found = TwoSlots(folder, "journal").read()
            if found is not None and holds(json.loads(found[1])):
                return
        assert time.monotonic() < until
        time.sleep(0.02)


def correction_of(folder: Path) -> Any:
    correction = json.loads((folder / "flexdt.json").read_text())["correction"]
    assert correction["name"] in ("mine", "another")
    return correction


@pytest.mark.campaign(1)
def test_a_killed_twin_is_as_it_was_and_its_scan_goes_on_to_the_same_bytes(
    rays: Process, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    process = twin(rays.port, data, "--speed-up", "max")
    try:
        wire = Wire(process.port)
        wire.call("calibration.apply", parameters={"dD_x": 0.5}, name="mine")
        wire.call("sample.set", name="normal", offset={"x": 2.0, "rz": 30.0})
        wire.call("axes.set", axis="tra_obj", speed=3.0)
        wire.call("camera.set", exposure_ms=80.0)
        wire.call("tube.set", kV=70.0, on=True)
        wire.call("axes.move", targets={"mag_obj": 500.0, "rot_obj": 33.3}, wait=True)
        whole = wire.call("script.submit", text=fly_script(31), name="whole", seed=4)
        wire.wait(whole["job"], "done")
        wire.call("axes.move", targets={"mag_obj": 500.0, "rot_obj": 33.3}, wait=True)
        wire.call("axes.set", axis="rot_obj", speed=22.5)
        wire.call("tube.set", kV=70.0, on=True, power_W=20.0)
        # The same start as the whole one's.
        before = wire.call("state.get")
        wire.call("clock.set", speed_up=1)  # slow, so that the kill comes in the midst
        job = wire.call("script.submit", text=fly_script(31), name="cut", seed=4)["job"]
        queued = wire.call("script.submit", text=fly_script(3), name="later", seed=4)[
            "job"
        ]
        while wire.call("job.status", job=job)["frames_done"] < 7:
            time.sleep(0.01)
        process = restarted(process, rays, data, "--speed-up", "max")
        wire = Wire(process.port)
        state = wire.call("state.get")
        assert state["correction"]["name"] == "mine"
        assert state["sample"]["name"] == "normal"
        assert state["sample"]["offset"]["rz"] == 30.0
        assert state["axes"]["tra_obj"]["speed"] == 3.0
        assert state["tube"]["kV"] == 70.0
        assert state["tube"]["on"] is False  # X-rays never come on by themselves
        assert (
            state["axes"]["mag_obj"]["position"] == before["axes"]["mag_obj"]["position"]
        )
        jobs = {j["job"]: j for j in wire.call("job.list")["jobs"]}
        assert jobs[whole["job"]]["state"] == "done"
        assert jobs[job]["state"] == jobs[queued]["state"] == "incomplete"
        assert "job.resume makes the others" in jobs[job]["error"]["message"]
        there = digests(data / "cut")
        stamps = {n: (data / "cut" / n).stat().st_mtime_ns for n in there}
        assert 7 <= len(there) < 33
        stored = sum(name.startswith("scan_") for name in there)
        assert jobs[job]["frames_done"] == stored
        assert not json.loads((data / "cut" / "flexdt.json").read_text())["complete"]
        # A correction that comes into force now is not that of the frames that are there.
        wire.call("calibration.apply", parameters={"dD_x": 0.9}, name="another")
        wire.call("job.resume", job=job)
        wire.call("job.resume", job=queued)
        status = wire.wait(job, "done", "failed")
        assert (status["state"], status["error"]) == ("done", None)
        assert digests(data / "cut") == digests(data / "whole")
        assert correction_of(data / "cut") == correction_of(data / "whole")
        assert {n: (data / "cut" / n).stat().st_mtime_ns for n in stamps} == stamps
        assert wire.wait(queued, "done", "failed")["state"] == "done"
        assert correction_of(data / "later")["name"] == "another", (
            "none of its frames were made"
        )
        with pytest.raises(Refused, match="-32003"):
            wire.call("job.resume", job=job)
    finally:
        process.end()
    assert not process.logged("error", "critical", "unstructured")


@pytest.mark.campaign(1)
def test_an_estop_survives_a_kill_and_positions_in_flight_are_nearly_kept(
    rays: Process, tmp_path: Path
) -> None:
    data = tmp_path / "data"
    process = twin(rays.port, data, "--sample", "empty")
    try:
        wire = Wire(process.port)
        wire.call("axes.move", targets={"rot_obj": 720.0})
        until_written(data, lambda record: record["positions"]["rot_obj"] > 1.0)
        seen, begun = (
            wire.call("state.get")["axes"]["rot_obj"]["position"],
            time.monotonic(),
        )
        process.kill()
        longest = 22.5 * (time.monotonic() - begun)
        process = twin(rays.port, data)
        wire = Wire(process.port)
        axis = wire.call("state.get")["axes"]["rot_obj"]
        assert not axis["moving"]
        assert 1.0 < axis["position"] <= seen + longest
        wire.call("safety.estop")
        until_written(data, lambda record: record["estop"])
        process = restarted(process, rays, data)
        wire = Wire(process.port)
        assert wire.call("state.get")["safety"]["estop"] is True
        with pytest.raises(Refused, match="-32003"):
            wire.call("axes.move", targets={"rot_obj": 0.0})
        wire.call("safety.reset")
        process.end()
        process = twin(rays.port, data, "--fresh")
        assert Wire(process.port).call("state.get")["axes"]["rot_obj"]["position"] == 0.0
    finally:
        process.end()


@pytest.mark.daily(1)
@pytest.mark.parametrize("content", [b"{", b"", b"null", b'{"schema": 99}', b"\xff" * 99])
@pytest.mark.campaign(1)
def test_a_broken_memory_is_set_aside_and_the_twin_starts(
    content: bytes, rays: Process, tmp_path: Path
) -> None:
    (tmp_path / "state.json").write_bytes(content)
    process = twin(rays.port, tmp_path)
    try:
        assert Wire(process.port).call("state.get")["sample"]["name"] == "gear"
        assert (tmp_path / "state.unreadable.json").read_bytes() == content
        assert [e["event"] for e in process.logged("error")] == [
            "the last state cannot be read; starting anew"
        ]
    finally:
        assert process.end() == 0


def test_two_twins_do_not_share_a_data_directory(rays: Process, tmp_path: Path) -> None:
    first = twin(rays.port, tmp_path)
    try:
        with pytest.raises(RuntimeError, match="is used by another twin"):
            twin(rays.port, tmp_path)
        first.kill()
        twin(rays.port, tmp_path).end()  # a killed twin holds nothing
    finally:
        first.end()
