"""Stops that come between two awaits: whatever was about to move, or to go on, does not."""

from __future__ import annotations

import asyncio
import re
import threading
from pathlib import Path

import pytest
from in_process import Client, Lab, run, script

from flexdt.protocol import RpcError
from flexdt.twin.scanner.joining import UnsweptProgramme

FLY = {"frames": 60, "speed": 5.0, "exposure": 500.0}


async def in_a_scan(lab: Lab, client: Client, frames: int = 1) -> str:
    """A fly scan of `client` that has made so many frames."""
    name = (await client.call("script.submit", text=script(**FLY), name="scan"))["job"]
    job = lab.twin.jobs.get(name)
    await lab.until(
        lambda: job.runner is not None and job.runner.progress.frames_done >= frames
    )
    return str(name)


def angle(lab: Lab) -> float:
    return lab.twin.scanner.positions(lab.twin.clock.now())["rot_obj"]


@pytest.mark.parametrize("stop", ["axes.stop", "safety.estop", "job.pause"])
def test_a_stop_and_a_resume_at_once_return_to_the_plan(
    tmp_path: Path, stop: str
) -> None:
    """The run went on exposing at planned positions, with the motors standing still."""

    async def body(lab: Lab) -> None:
        client = lab.client()
        job = await in_a_scan(lab, client)
        await client.call(stop)
        if stop == "safety.estop":
            await client.call("safety.reset")
        await client.call("job.resume", job=job)
        runner = lab.twin.jobs.get(job).runner
        assert runner is not None
        await lab.until(lambda: runner.progress.what != "" and not runner._stop_due)
        made = runner.progress.frames_done
        await lab.until(lambda: runner.progress.frames_done > made + 1)
        assert lab.twin.scanner.moving(lab.twin.clock.now())
        assert lab.twin.scanner.tube.on
        await client.call("job.abort", job=job)

    run(tmp_path, body, virtual=True, speed_up=20.0)


@pytest.mark.parametrize("stop", ["axes.stop", "safety.estop"])
@pytest.mark.parametrize("turns", [1, 3, 10])
@pytest.mark.daily(3)
def test_a_stop_while_the_rest_of_a_scan_is_swept_pauses_it(
    tmp_path: Path, stop: str, turns: int
) -> None:
    async def body(lab: Lab) -> None:
        client = lab.client()
        job = await in_a_scan(lab, client)
        await client.call("job.pause", job=job)
        await lab.until(lambda: not lab.twin.scanner.moving(lab.twin.clock.now()))
        at = angle(lab)
        resumed = asyncio.ensure_future(client.call("job.resume", job=job))
        for _ in range(turns):
            await asyncio.sleep(0)
        await lab.client().call(stop)
        await asyncio.sleep(0.3)
        status = await client.call("job.status", job=job)
        assert status["state"] == "paused"
        assert re.search("was commanded|E-stop is in force", status["error"]["message"])
        assert abs(angle(lab) - at) < 20.0
        assert not lab.twin.scanner.moving(lab.twin.clock.now())
        await resumed
        await client.call("job.abort", job=job)
        # What had paused it is not why it ended.
        status = await client.call("job.status", job=job)
        assert (status["state"], status["error"]) == ("aborted", None)

    run(tmp_path, body, virtual=True, speed_up=20.0)


def test_nothing_is_moved_or_set_while_the_rest_of_a_scan_is_swept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The scan went on with another voltage, or took the motors away from who moved them."""
    swept, certified = threading.Event(), UnsweptProgramme.certified
    wait = lambda self: (swept.wait(60.0), certified(self))[1]  # noqa: E731

    async def body(lab: Lab) -> None:
        client = lab.client()
        job = await in_a_scan(lab, client)
        await client.call("job.pause", job=job)
        await client.call("tube.set", kV=50.0)
        monkeypatch.setattr(UnsweptProgramme, "certified", wait)
        resumed = asyncio.ensure_future(client.call("job.resume", job=job))
        await asyncio.sleep(0)
        for method, params in (
            ("tube.set", {"kV": 60.0}),
            ("axes.move", {"targets": {"rot_obj": 1}}),
        ):
            assert (await client.error(method, **params)).code == -32003
        swept.set()
        await resumed
        await lab.until(lambda: lab.twin.jobs.running)
        assert lab.twin.scanner.tube.kV == 90.0
        await client.call("job.abort", job=job)

    run(tmp_path, body, virtual=True, speed_up=20.0)


@pytest.mark.parametrize("stop", ["axes.stop", "safety.estop"])
def test_a_scene_that_is_being_loaded_moves_nothing_after_a_stop(
    tmp_path: Path, stop: str
) -> None:
    async def body(lab: Lab) -> None:
        client = lab.client()
        document = (await client.call("scene.save"))["document"]
        document["positions"]["rot_obj"] = 45.0
        loading = asyncio.ensure_future(client.call("scene.load", document=document))
        for _ in range(4):
            await asyncio.sleep(0)
        assert not loading.done()
        await lab.client().call(stop)
        with pytest.raises(RpcError):
            await loading
        assert lab.twin.scanner.targets(lab.twin.clock.now())["rot_obj"] == 0.0
        if stop == "safety.estop":
            with pytest.raises(RpcError, match="E-stop"):
                await client.call("scene.load", document=document)
            assert lab.twin.scanner.targets(lab.twin.clock.now())["rot_obj"] == 0.0

    run(tmp_path, body, virtual=True, speed_up=1.0)


@pytest.mark.parametrize("end", ["scene", "gone"])
def test_later_legs_of_a_planned_way_end_with_other_motion_and_with_the_controller(
    tmp_path: Path, end: str
) -> None:
    async def body(lab: Lab) -> None:
        client, scanner, clock = lab.client(), lab.twin.scanner, lab.twin.clock
        document = (await client.call("scene.save"))["document"]
        scanner.set_axis("mag_obj", speed=5.0)
        targets = {"mag_det": 400.0, "mag_obj": 200.0}
        way = await client.call("axes.move", targets=targets, plan=True)
        assert len(way["moves"]) == 2
        await lab.until(lambda: scanner.moving(clock.now()))
        if end == "scene":
            document["positions"]["mag_obj"] = 300.0
            await client.call("scene.load", document=document)
        else:
            client.close()
        await lab.until(lambda: not scanner.moving(clock.now()))
        await asyncio.sleep(0.2)
        assert scanner.targets(clock.now())["mag_det"] == 1059.0

    run(tmp_path, body, virtual=True, speed_up=50.0)


def test_a_stop_before_a_scan_goes_on_sets_nothing(tmp_path: Path) -> None:
    """X-rays came on although it was paused, and went off again when it was resumed."""

    async def body(lab: Lab) -> None:
        client = lab.client()
        name = await in_a_scan(lab, client, frames=3)
        await client.call("job.abort", job=name)
        await client.call("tube.set", on=False)
        resumed = asyncio.ensure_future(client.call("job.resume", job=name))
        await lab.until(
            lambda: lab.twin.jobs.current is not None and lab.twin.jobs._preparing
        )
        await client.call("axes.stop")
        await resumed
        job = lab.twin.jobs.get(name)  # the one that takes its place
        await lab.until(lambda: job.phase == "paused")
        assert not lab.twin.scanner.tube.on
        await client.call("job.resume", job=name)
        runner = job.runner
        assert runner is not None
        made = runner.progress.frames_done
        await lab.until(lambda: runner.progress.frames_done > made + 1)
        assert lab.twin.scanner.tube.on
        await client.call("job.abort", job=name)

    run(tmp_path, body, virtual=True, speed_up=20.0)
