"""Scans and jobs of the twin server: scripts, trajectories, pauses, full disks, taking up
again."""

from __future__ import annotations

import asyncio
import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from in_process import ROI, Lab, digest, run, script

from flexdt.server.scans.scan_job import JobInputs


def test_a_script_becomes_a_data_set_with_the_same_bytes_at_any_speed_up(
    tmp_path: Path,
) -> None:
    found: list[dict[str, str]] = []

    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("state.subscribe", topics=["job"])
        for name, speed in (("a", "max"), ("b", 400.0), ("c", 900.0)):
            answer = await c.call(
                "script.submit", text=script(), name=name, speed_up=speed, seed=11
            )
            status = await lab.ended(c, answer["job"])
            assert (status["state"], status["error"]) == ("done", None)
            assert (status["frames_done"], status["frames_total"]) == (9, 9)
            folder = lab.root / name
            assert (folder / "script.txt").read_bytes() == script().encode()
            document = json.loads((folder / "flexdt.json").read_text())
            assert document["complete"] is True
            assert document["noise"]["seed"] == 11
            found.append(digest(folder))
        assert len(found[0]) == 10
        assert found[0] == found[1] == found[2]
        other = await c.call("script.submit", text=script(), name="d", seed=12)
        await lab.ended(c, other["job"])
        assert digest(lab.root / "d")["scan_000000.tif"] != found[0]["scan_000000.tif"]
        phases = [e["data"]["state"] for e in c.of("job") if e["data"]["job"] == "job-1"]
        assert phases[0] == "queued"
        assert phases[-1] == "done"
        assert lab.twin.clock.speed_up == "max"  # a job's speed-up ends with it

    run(tmp_path, body)


def test_moves_are_refused_during_a_scan_and_allowed_in_a_pause(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        reference = await c.call(
            "script.submit", text=script(), name="ref", seed=3, speed_up="max"
        )
        await lab.ended(c, reference["job"])
        lab.projector.limit = lab.projector.views + 3
        job = (await c.call("script.submit", text=script(), name="paused", seed=3))["job"]
        await lab.until(lambda: lab.twin.jobs.running, "it runs")
        for method, params in (
            ("axes.move", {"targets": {"tra_obj": 30.0}}),
            ("axes.jog", {"axis": "tra_obj", "velocity": 1.0}),
            ("sample.set", {"name": "lego"}),
            ("camera.set", {"averages": 2}),
        ):
            e = await c.error(method, **params)
            assert (e.code, e.data["job"]) == (-32003, job)
        await c.call(
            "clock.set", speed_up=20.0
        )  # on a slow machine it must not run to its end
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).frames_done >= 3,
            "3 frames",
        )
        status = await c.call("job.pause", job=job)
        assert status["state"] == "paused"
        lab.projector.limit = None
        await c.call("axes.move", targets={"tra_obj": 30.0, "mag_obj": 500.0}, wait=True)
        await c.call("sample.set", name="lego")
        stepped = await c.call("job.step", job=job)
        assert stepped["state"] == "paused"
        assert (await c.call("job.resume", job=job))["state"] == "running"
        status = await lab.ended(c, job)
        assert status["state"] == "done"
        assert digest(lab.root / "paused") == digest(lab.root / "ref")
        state = await c.call("state.get")
        assert state["axes"]["tra_obj"]["position"] == 0.0
        assert (await c.error("job.pause", job=job)).code == -32003

    run(tmp_path, body, virtual=True, speed_up=150.0)


def test_stop_during_a_scan_pauses_it_and_abort_leaves_it_incomplete(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c, watcher = lab.client(), lab.client()
        job = (await c.call("script.submit", text=script(), name="cut"))["job"]
        await lab.until(lambda: lab.twin.jobs.running, "it runs")
        await watcher.call("axes.stop")
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused",
            "it pauses",
        )
        status = await watcher.call("job.abort", job=job, reason="sure enough")
        assert status["state"] == "aborted"
        document = json.loads((lab.root / "cut" / "flexdt.json").read_text())
        assert document["complete"] is False
        assert document["reason"] == "aborted: sure enough"
        assert not list((lab.root / "cut").glob(".*"))
        assert lab.twin.jobs.current is None

    run(tmp_path, body, virtual=True, speed_up=50.0)


def test_an_interrupted_scan_is_taken_up_by_name_even_by_another_server(
    tmp_path: Path,
) -> None:
    async def first(lab: Lab) -> None:
        c = lab.client()
        await c.call("axes.move", targets={"tra_obj": 12.0, "mag_obj": 500.0}, wait=True)
        await c.call("sample.set", name="normal", offset={"x": 1.0})
        whole = await c.call(
            "script.submit", text=script(), name="whole", seed=5, speed_up="max"
        )
        await lab.ended(c, whole["job"])
        lab.projector.limit = lab.projector.views + 4
        await c.call("script.submit", text=script(), name="cut", seed=5)
        await lab.until(
            lambda: (
                lab.twin.jobs.current is not None
                and lab.twin.jobs.status(lab.twin.jobs.current).frames_done >= 4
            ),
            "4 frames",
        )

    run(
        tmp_path, first, virtual=True, speed_up=150.0
    )  # the server is stopped in the midst of it
    cut = tmp_path / "cut"
    document = json.loads((cut / "flexdt.json").read_text())
    assert document["complete"] is False
    there = digest(cut)
    assert 4 <= len(there) < 10
    stamps = {f.name: f.stat().st_mtime_ns for f in cut.glob("*.tif")}

    async def second(lab: Lab) -> None:
        c = lab.client()
        e = await c.error("script.submit", text=script() + "# changed", name="cut")
        assert (e.code, "another" in e.message) == (-32602, True)
        views = lab.projector.views
        job = await c.call("script.submit", text=script(), name="cut")
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        assert lab.projector.views - views == 10 - len(
            there
        )  # the dark needs no projection
        assert digest(cut) == digest(tmp_path / "whole")
        assert {n: (cut / n).stat().st_mtime_ns for n in stamps} == stamps
        assert (await c.error("script.submit", text=script(), name="cut")).code == -32602
        assert (await c.error("script.submit", text=script(), name="../x")).code == -32602

    run(tmp_path, second)


def test_a_projector_that_is_gone_pauses_the_job_with_its_code(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        reference = await c.call("script.submit", text=script(), name="ref", seed=3)
        await lab.ended(c, reference["job"])
        lab.projector.down = True
        job = (await c.call("script.submit", text=script(), name="gone", seed=3))["job"]
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused",
            "it pauses",
        )
        status = await c.call("job.status", job=job)
        assert status["error"]["code"] == -32006
        lab.projector.down = False
        c.close()  # the client goes; the scan goes on without it
        await lab.client().call("job.resume", job=job)
        status = await lab.ended(lab.client(), job)
        assert (status["state"], status["error"]) == ("done", None)
        assert digest(lab.root / "gone") == digest(lab.root / "ref")

    run(tmp_path, body)


def test_a_full_disk_pauses_the_job_and_no_partial_file_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flexdt.server.storage import dataset_writer
    from flexdt.twin.dataset.dataset_errors import DiskFullError

    real = dataset_writer.DatasetWriter.put
    full = [True]

    def put(self: Any, name: str, image: Any) -> None:
        if full[0] and name == "scan_000005.tif":
            raise DiskFullError("no room for scan_000005.tif", {"free": 0})
        real(self, name, image)

    monkeypatch.setattr(dataset_writer.DatasetWriter, "put", put)

    async def body(lab: Lab) -> None:
        c = lab.client()
        job = (await c.call("script.submit", text=script(), name="full", seed=3))["job"]
        await lab.until(
            lambda: lab.twin.jobs.status(lab.twin.jobs.get(job)).state == "paused",
            "it pauses",
        )
        status = await c.call("job.status", job=job)
        assert status["error"]["code"] == -32001
        assert "no room" in status["error"]["message"]
        assert not (lab.root / "full" / "scan_000005.tif").exists()
        full[0] = False
        await c.call("job.resume", job=job)
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body)


def test_a_scan_that_does_not_fit_on_the_disk_is_refused_before_it_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from flexdt.server.storage import disk_room

    monkeypatch.setattr(disk_room, "free_bytes", lambda path: 20 << 20)

    async def body(lab: Lab) -> None:
        c = lab.client()
        lines = ["tube\txrayon\t\t\tACK\t\t", "camera\tset ROI\t0 0 1943 1535\t\tACK\t\t"]
        for i in range(6):  # 1.5 MB each, and 16 MiB for the rest
            lines += [
                "camera\ttake image\t\t\tACK\t\t",
                f"camera\tsave image\tscan_{i:06d}.tif\t\tACK\t\t",
            ]
        e = await c.error("script.submit", text="\r\n".join([*lines, ""]))
        assert e.code == -32001
        assert e.data["allowed"] == 20 << 20
        assert lab.twin.jobs.all() == []

    run(tmp_path, body)


def test_a_bad_script_is_refused_with_all_its_problems_and_nothing_moves(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        bad = script().replace("set exposure\t2000.0", "set exposure\tlong") + (
            "mag_obj\tfly\t3\t\tACK\t\t\r\nwing_obj\tmove absolute\t3\t\tACK\t\t\r\n"
        )
        e = await c.error("script.submit", text=bad)
        assert e.code == -32005
        assert {"line", "column", "message", "code", "severity"} <= set(e.data[0])
        assert len([p for p in e.data if p["severity"] == "error"]) >= 3
        report = await c.call("script.check", text=bad)
        assert report["ok"] is False
        assert lab.twin.jobs.all() == []
        assert lab.twin.clock.now() == 0.0

    run(tmp_path, body)


def test_a_trajectory_is_played_and_checked(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        await c.call("camera.set", roi=ROI)
        poses = [{"rot_obj": 10.0 * i, "mag_obj": 500.0 + i} for i in range(5)]
        report = await c.call("trajectory.check", poses=poses, exposure_ms=50.0)
        assert (report["ok"], report["frames"]) == (True, 5)
        job = await c.call(
            "trajectory.submit", poses=poses, exposure_ms=50.0, name="played"
        )
        assert (await lab.ended(c, job["job"]))["state"] == "done"
        document = json.loads((lab.root / "played" / "flexdt.json").read_text())
        shown = [f["positions"] for f in document["frames"] if f["kind"] == "projection"]
        assert [(p["rot_obj"], p["mag_obj"]) for p in shown] == [
            (p["rot_obj"], p["mag_obj"]) for p in poses
        ]
        answer = await c.call("trajectory.submit", poses=[{"mag_obj": 1.0}])
        assert "mag_obj" in answer["warnings"][0]  # clamped, as the machine file says

    run(tmp_path, body)


def test_jobs_queue_and_a_queued_one_can_be_aborted(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        lab.projector.limit = 0
        jobs = [(await c.call("script.submit", text=script(), speed_up=800.0))["job"]
                for _ in range(3)]  # fmt: skip
        assert (await c.call("job.abort", job=jobs[1]))["state"] == "aborted"
        lab.projector.limit = None
        assert (await lab.ended(c, jobs[2]))["state"] == "done"
        states = [j["state"] for j in (await c.call("job.list"))["jobs"]]
        assert states == ["done", "aborted", "done"]
        names = [j["name"] for j in (await c.call("job.list"))["jobs"]]
        assert len(set(names)) == 3

    run(tmp_path, body)


def test_a_scan_that_is_being_opened_ends_when_its_data_set_is_at_rest(
    tmp_path: Path,
) -> None:
    """Whoever reads "aborted" may delete the data set: nothing writes to it any more."""

    async def body(lab: Lab) -> None:
        c, anyone = lab.client(), lab.client()
        await c.call("clock.set", speed_up=1.0)  # the scan waits for a slow move to end
        await c.call("axes.move", targets={"tra_obj": 1.0})
        name = (await c.call("script.submit", text=script(), name="early"))["job"]
        job = lab.twin.jobs.get(name)
        prepare = job.prepare
        assert prepare is not None
        opened, written = asyncio.Event(), asyncio.Event()

        async def slow() -> JobInputs:
            made = await prepare()
            opened.set()
            await written.wait()
            return made

        job.prepare = slow
        await opened.wait()
        answer = await anyone.call("job.abort", job=name, reason="no")
        assert answer["state"] == "queued"
        assert (await c.error("job.forget", job=name)).code == -32003
        assert (await c.error("job.resume", job=name)).code == -32003
        assert (await c.call("job.forget", days=0.0))["jobs"] == []
        await c.call("axes.move", targets={"mag_obj": 401.0})  # it does not run any more
        written.set()
        assert (await lab.ended(c, name))["state"] == "aborted"
        document = json.loads((lab.root / "early" / "flexdt.json").read_text())
        assert document["reason"] == "aborted: no"
        shutil.rmtree(lab.root / "early")
        assert (await c.call("job.forget", days=0.0))["jobs"] == [name]
        assert not list((lab.root / "jobs").glob("*.json"))

    run(tmp_path, body, virtual=True)


def test_a_scan_that_is_being_prepared_can_be_aborted_and_stopped(tmp_path: Path) -> None:
    """Before a scan's first motion there is a while of checking and opening files."""

    async def body(lab: Lab) -> None:
        c, anyone = lab.client(), lab.client()
        await c.call("clock.set", speed_up=1.0)  # the scan waits for a slow move to end
        await c.call("axes.move", targets={"tra_obj": 100.0})
        job = (await c.call("script.submit", text=script(), name="early"))["job"]
        await lab.until(lambda: lab.twin.jobs.current is not None, "its turn has come")
        assert (await anyone.call("job.abort", job=job, reason="no"))[
            "state"
        ] == "aborted"
        await anyone.call("axes.stop")
        await lab.until(lambda: lab.twin.jobs.current is None, "it has ended")
        state = await c.call("state.get")
        assert state["axes"]["rot_obj"]["target"] == 0.0
        assert state["axes"]["tra_obj"]["target"] < 100.0
        assert (await c.call("job.status", job=job))["state"] == "aborted"
        assert not (lab.root / "early").exists(), "it had not begun"

        await c.call("axes.move", targets={"tra_obj": 100.0})
        job = (await c.call("script.submit", text=script()))["job"]
        await lab.until(lambda: lab.twin.jobs.current is not None, "its turn has come")
        await anyone.call("axes.stop")
        await lab.until(lambda: lab.twin.jobs.get(job).phase == "paused", "it pauses")
        status = await c.call("job.status", job=job)
        assert "stop was commanded" in status["error"]["message"]
        state = await c.call("state.get")
        assert state["axes"]["rot_obj"]["position"] == 0.0
        await c.call("clock.set", speed_up="max")
        await c.call("job.resume", job=job)
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body, virtual=True)
