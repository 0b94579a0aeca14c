"""The guard when the sample or the correction changes while motion is pending, over the wire.

A bar of 300 mm fits between source and panel along x only. Whatever was programmed on the empty
stage must halt, stay paused or fail before the bar comes to the panel.
"""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import trimesh
from lab import Process, Refused, Wire, twin

pytestmark = [pytest.mark.timeout(300), pytest.mark.slow]

MARGIN_MM = 1.0
SLOW = 0.01
"""Speed-up at which nothing gets anywhere while a test makes its requests."""
TURN = [{"rot_obj": float(max(0, angle))} for angle in range(-240, 181, 4)]
"""A while of images at 0 degrees first, so that a test finds the stage there."""


@pytest.fixture(scope="module")
def server(rays: Process, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Process]:
    process = twin(rays.port, tmp_path_factory.mktemp("data"))
    wire = Wire(process.port)
    stl = trimesh.creation.box((300.0, 20.0, 20.0)).export(file_type="stl")
    data = base64.b64encode(stl).decode()
    wire.call(
        "sample.upload", name="bar", format="stl", unit="mm", total=len(stl), data=data
    )
    wire.close()
    yield process
    process.end()
    assert not process.logged("error", "critical", "unstructured")


@pytest.fixture
def wire(server: Process) -> Iterator[Wire]:
    """An empty stage at 0 degrees, panel 84 mm behind the axis, time as it goes."""
    w = Wire(server.port)
    w.call("safety.reset")
    w.call("sample.set", name="empty")
    w.call("clock.set", speed_up="max")
    w.call("camera.set", roi=[900, 700, 963, 763], exposure_ms=50.0)
    w.call(
        "axes.move",
        targets={"mag_det": 700.0, "rot_obj": 0.0, "mag_obj": 600.0},
        wait=True,
    )
    w.call("clock.set", speed_up=1.0)
    yield w
    for job in w.call("job.list")["jobs"]:
        if job["state"] in ("queued", "running", "paused"):
            w.call("job.abort", job=job["job"])
            w.wait(job["job"], "aborted", "failed")
    w.call("axes.stop")
    while w.call("calibration.get")["correction"] is not None:
        w.call("calibration.revert")
    w.close()


def at_rest(wire: Wire) -> dict[str, Any]:
    """The state once all motion has ended, time running as fast as it may."""
    wire.call("clock.set", speed_up="max")
    until = time.monotonic() + 60.0
    while time.monotonic() < until:
        state: dict[str, Any] = wire.call("state.get")
        if not any(axis["moving"] for axis in state["axes"].values()):
            return state
        time.sleep(0.01)
    raise AssertionError("it never comes to rest")


def refused(wire: Wire, method: str, **params: object) -> Refused:
    with pytest.raises(Refused) as caught:
        wire.call(method, **params)
    return caught.value


def warned(warnings: list[str], *parts: str) -> None:
    (words,) = warnings
    assert "would collide in " in words
    assert "blocked attempt 1 of 3" in words
    assert all(part in words for part in parts)


@pytest.mark.parametrize("how", ["move", "jog"])
@pytest.mark.campaign(1)
def test_a_bar_put_on_a_turning_stage_halts_it_before_the_panel(
    wire: Wire, how: str
) -> None:
    wire.call("clock.set", speed_up=SLOW)
    if how == "move":
        wire.call("axes.move", targets={"rot_obj": 180.0})
    else:
        wire.call("axes.jog", axis="rot_obj", velocity=20.0, lease_s=10.0)
    warned(wire.call("sample.set", name="bar")["warnings"], "sample", "detector")
    state = at_rest(wire)
    # By hand: the panel is 125 mm behind the axis. The corner at (150, 10) comes as far back at
    # 52 degrees, but is still beside the panel then, and meets its side soon after.
    assert 52.0 < state["axes"]["rot_obj"]["position"] < 57.0
    assert MARGIN_MM <= state["safety"]["clearance_mm"] < 1.5
    assert (state["safety"]["state"], state["safety"]["blocked_attempts"]) == ("ok", 1)


def test_a_correction_while_the_panel_comes_nearer_halts_it_in_time(wire: Wire) -> None:
    wire.call("clock.set", speed_up="max")
    nearest = refused(wire, "axes.move", targets={"mag_det": 500.0}).data["last_free"][
        "mag_det"
    ]
    wire.call("axes.move", targets={"mag_det": 720.0}, wait=True)
    wire.call("clock.set", speed_up=SLOW)
    wire.call("axes.move", targets={"mag_det": nearest + 1.0})
    warned(
        wire.call("calibration.apply", parameters={"dD_z": -8.0})["warnings"], "detector"
    )
    state = at_rest(wire)
    assert state["axes"]["mag_det"]["position"] == pytest.approx(nearest + 8.0, abs=0.1)
    assert state["safety"]["clearance_mm"] >= MARGIN_MM


def test_a_jog_that_is_cut_short_says_so_and_a_free_one_clears_the_count(
    wire: Wire,
) -> None:
    assert refused(wire, "axes.move", targets={"mag_det": 500.0}).code == -32002
    assert at_rest(wire)["safety"]["blocked_attempts"] == 1
    wire.call(
        "axes.jog", axis="rot_obj", velocity=0.0, lease_s=1.0
    )  # no motion, so no free one
    assert wire.call("state.get")["safety"]["blocked_attempts"] == 1
    assert (
        wire.call("axes.jog", axis="mag_det", velocity=50.0, lease_s=2.0)["warnings"]
        == []
    )
    assert at_rest(wire)["safety"]["blocked_attempts"] == 0
    (words,) = wire.call("axes.jog", axis="mag_det", velocity=-50.0, lease_s=10.0)[
        "warnings"
    ]
    rests = at_rest(wire)["axes"]["mag_det"]["position"]
    assert "detector" in words
    assert f"would collide: the jog ends before, at mag_det={rests:g}" in words


def test_a_stage_that_is_too_close_at_rest_is_refused_and_nothing_changes(
    wire: Wire,
) -> None:
    wire.call("clock.set", speed_up="max")
    said = refused(wire, "axes.move", targets={"mag_det": 500.0})
    wire.call(
        "axes.move",
        targets={"mag_det": said.data["last_free"]["mag_det"] + 0.5},
        wait=True,
    )
    before = wire.call("state.get")
    again = refused(wire, "calibration.apply", parameters={"dD_z": -1.0})
    assert (again.code, set(again.data["pair"])) == (-32002, set(said.data["pair"]))
    wire.call("axes.move", targets={"rot_obj": 90.0, "mag_det": 660.0}, wait=True)
    bar = refused(wire, "sample.set", name="bar")
    assert (bar.code, "sample" in bar.data["pair"]) == (-32002, True)
    after = wire.call("state.get")
    for part in ("sample", "correction", "safety"):
        kept = {
            k: v
            for k, v in (after[part] or {}).items()
            if k not in ("clearance_mm", "pair")
        }
        was = {
            k: v
            for k, v in (before[part] or {}).items()
            if k not in ("clearance_mm", "pair")
        }
        assert kept | {"blocked_attempts": 0} == was | {"blocked_attempts": 0}


def test_a_scene_that_moves_nothing_halts_what_is_not_free_of_it(wire: Wire) -> None:
    wire.call("sample.set", name="bar")
    scene = wire.call("scene.save")["document"]
    wire.call("sample.set", name="empty")
    wire.call("clock.set", speed_up=SLOW)
    wire.call("axes.move", targets={"rot_obj": 180.0})
    scene["positions"] = {"tra_obj": 0.0}
    wire.call("scene.load", document=scene)
    state = at_rest(wire)
    assert state["safety"]["clearance_mm"] >= MARGIN_MM
    assert 52.0 < state["axes"]["rot_obj"]["position"] < 57.0
    assert state["sample"]["name"] == "bar"


def test_a_scene_whose_motion_is_not_free_changes_nothing(wire: Wire) -> None:
    wire.call("sample.set", name="bar")
    scene = wire.call("scene.save")["document"]
    wire.call("sample.set", name="empty")
    scene["positions"] = {"rot_obj": 180.0}
    said = refused(wire, "scene.load", document=scene)
    assert (said.code, set(said.data["pair"])) == (-32002, {"sample", "detector"})
    state = at_rest(wire)
    assert state["axes"]["rot_obj"]["position"] == 0.0
    assert state["sample"]["name"] in (None, "", "empty")


def running(wire: Wire, name: str, poses: list[dict[str, float]] = TURN) -> str:
    """A job that has made its first image and is far from its end."""
    wire.call("clock.set", speed_up=5.0)
    job = str(
        wire.call("trajectory.submit", poses=poses, exposure_ms=50.0, name=name)["job"]
    )
    until = time.monotonic() + 60.0
    while wire.call("job.status", job=job)["frames_done"] < 1:
        assert time.monotonic() < until
        time.sleep(0.01)
    wire.call("clock.set", speed_up=1.0)
    return job


def test_a_paused_job_does_not_go_on_into_a_sample_that_was_put_there(wire: Wire) -> None:
    job = running(wire, "paused")
    assert wire.call("job.pause", job=job)["state"] == "paused"
    at = wire.call("state.get")["axes"]["rot_obj"]["target"]
    assert wire.call("sample.set", name="bar")["warnings"] == []
    for method in ("job.resume", "job.step"):
        said = refused(wire, method, job=job)
        assert (said.code, set(said.data["pair"])) == (-32002, {"sample", "detector"})
        assert said.data["time_s"] > 0.0
        status = wire.call("job.status", job=job)
        assert (status["state"], status["error"]["code"]) == ("paused", -32002)
    state = at_rest(wire)
    assert state["axes"]["rot_obj"]["position"] == at
    assert state["safety"]["clearance_mm"] > 30.0
    wire.call("sample.set", name="empty")
    assert wire.call("job.resume", job=job)["state"] == "running"
    assert wire.wait(job, "done", "failed", "paused")["state"] == "done"


def test_a_correction_under_a_running_job_pauses_it(wire: Wire) -> None:
    wire.call("clock.set", speed_up="max")
    nearest = refused(wire, "axes.move", targets={"mag_det": 500.0}).data["last_free"][
        "mag_det"
    ]
    wire.call("axes.move", targets={"mag_det": 700.0}, wait=True)
    poses = [*TURN, {"mag_det": nearest + 1.0}]
    job = running(wire, "corrected", poses)
    warned(
        wire.call("calibration.apply", parameters={"dD_z": -8.0})["warnings"], "detector"
    )
    status = wire.wait(job, "paused", "done", "failed")
    assert (status["state"], status["error"]["code"]) == ("paused", -32002)
    assert refused(wire, "job.resume", job=job).code == -32002
    wire.call("calibration.revert")
    wire.call("clock.set", speed_up="max")
    assert wire.call("job.resume", job=job)["error"] is None
    assert wire.wait(job, "done", "failed", "paused")["state"] == "done"


def test_a_queued_job_is_checked_with_what_then_stands_on_the_stage(wire: Wire) -> None:
    first = running(wire, "first")
    second = wire.call("trajectory.submit", poses=TURN, exposure_ms=50.0, name="second")[
        "job"
    ]
    wire.call("job.pause", job=first)
    wire.call("sample.set", name="bar")
    wire.call("job.abort", job=first)
    status = wire.wait(second, "done", "failed", "paused")
    assert (status["state"], status["error"]["code"]) == ("failed", -32002)
    assert status["error"]["data"]["collisions"]
    assert wire.call("state.get")["safety"]["clearance_mm"] > 30.0


def test_a_data_set_names_the_sample_that_stands_there_when_the_scan_begins(
    wire: Wire,
) -> None:
    first = running(wire, "ahead")
    answer = wire.call(
        "trajectory.submit", poses=TURN[-2:], exposure_ms=50.0, name="behind"
    )
    wire.call("job.pause", job=first)
    wire.call("sample.set", name="normal-3")
    wire.call("clock.set", speed_up="max")
    wire.call("job.abort", job=first)
    assert wire.wait(answer["job"], "done", "failed")["state"] == "done"
    document = json.loads((Path(answer["dataset"]) / "flexdt.json").read_text())
    assert document["sample"]["name"] == "normal-3"


@pytest.mark.campaign(1)
def test_an_aborted_job_is_not_queued_again_into_another_sample(wire: Wire) -> None:
    job = running(wire, "again")
    wire.call("job.abort", job=job)
    wire.wait(job, "aborted")
    wire.call("clock.set", speed_up="max")
    wire.call("axes.move", targets={"rot_obj": 0.0}, wait=True)
    wire.call("sample.set", name="bar")
    said = refused(wire, "job.resume", job=job)
    assert (said.code, said.data["collisions"][0]["pair"]) == (
        -32002,
        ["detector", "sample"],
    )
    assert wire.call("job.status", job=job)["state"] == "aborted"
    assert wire.call("state.get")["axes"]["rot_obj"]["position"] == 0.0
    wire.call("sample.set", name="lego")
    wire.call("job.resume", job=job)
    status = wire.wait(job, "done", "failed", "paused")
    assert status["state"] == "done"
    assert "although lego is on the stage" in status["warnings"][1]
