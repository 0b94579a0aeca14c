"""What accumulates over years: written in proportion to the change, bounded, and removable.

Histories of submissions, uploads, corrections, deletions, kills and power cuts are drawn; a
list of what was acknowledged, which shares no code with the server, says what must be known
afterwards.
"""

from __future__ import annotations

import itertools
import json
import os
import random
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from in_process import Lab, run, script
from simulation import Client, Crashed, Fault, Simulation

from flexdt.protocol import RpcError
from flexdt.runtime.access import TwinLimits
from flexdt.runtime.files.directory import Directory, open_data
from flexdt.server.storage import disk_room
from flexdt.server.storage.disk_room import UsedBytes
from flexdt.server.storage.job_files import JobFiles
from flexdt.twin.dataset.dataset_errors import DatasetWriteError

OLD_JOBS = 300
"""Jobs that an earlier version left in its state."""


def upload(sim: Simulation, client: Client, name: str, grey: int) -> Any:
    voxels = bytes([0, 0, grey, 61]) * 8
    return sim.call(
        client, "sample.upload", name=name, kind="voxels", format="raw", shape=[2, 2, 2],
        voxel_mm=[0.5, 0.5, 0.5], total=len(voxels), data=voxels,
    )  # fmt: skip


class History:
    """A twin, and what its clients were told there is."""

    def __init__(self, root: Path, seed: int) -> None:
        self.sim = Simulation(root, seed, speed_up="max")
        self.rng = random.Random(seed)
        self.jobs: list[str] = []
        self.samples: set[str] = set()
        self.corrections: list[str] = []
        self.unsure: set[str] = set()
        """Asked for or deleted when the power was cut: there or not."""
        self.made = 0

    def begin(self) -> None:
        self.sim.start()
        self.client = self.sim.client()

    def step(self) -> None:
        """Ask for something drawn; what a power cut leaves open is noted."""
        name = f"n{self.made}"
        self.made += 1
        what = self.rng.choice(
            ["scan", "scan", "upload", "correct", "forget", "delete", "undo"]
        )
        old = {
            "forget": self.jobs,
            "delete": sorted(self.samples),
            "undo": self.corrections[:-1],
        }
        chosen = self.rng.choice(old[what]) if old.get(what) else name
        try:
            self._ask(what, name, chosen)
        except Crashed:
            self.unsure |= {name, chosen}
            self.sim.cut()
            self.begin()

    def _ask(self, what: str, name: str, chosen: str) -> None:
        call, client = self.sim.call, self.client
        if what == "scan":
            job = call(client, "script.submit", text=script(3), name=name)["job"]
            assert job not in self.jobs
            self.jobs.append(job)
        elif what == "upload":
            upload(self.sim, client, name, self.made % 200)
            self.samples.add(name)
        elif what == "correct":
            call(
                client,
                "calibration.apply",
                parameters={"dD_x": 1e-3 * self.made},
                name=name,
            )
            self.corrections.append(name)
        elif what == "forget" and chosen != name:
            self.sim.advance(60.0)  # the scan ends
            assert call(client, "job.forget", job=chosen)["jobs"] == [chosen]
            self.jobs.remove(chosen)
        elif what == "delete" and chosen != name:
            assert call(client, "sample.delete", name=chosen)["bytes"] == 32
            self.samples.remove(chosen)
        elif what == "undo" and chosen != name:
            assert call(client, "calibration.delete", name=chosen)["name"] == chosen
            self.corrections.remove(chosen)

    def look(self) -> None:
        """All that was acknowledged is known, and nothing else but what a cut left open."""
        call, client = self.sim.call, self.client
        jobs = {j["job"]: j["name"] for j in call(client, "job.list")["jobs"]}
        samples = {
            s["name"] for s in call(client, "sample.list")["samples"] if s["uploaded"]
        }
        there = [c["name"] for c in call(client, "calibration.list")["corrections"]]
        unsure_jobs = {job for job, name in jobs.items() if name in self.unsure}
        assert set(self.jobs) - self.unsure <= set(jobs)
        assert set(jobs) - set(self.jobs) <= unsure_jobs | self.unsure
        assert self.samples ^ samples <= self.unsure
        assert set(self.corrections) ^ set(there) <= self.unsure
        self.jobs, self.samples, self.corrections = list(jobs), samples, there
        self.unsure.clear()


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(3))
def test_what_was_acknowledged_is_known_after_kills_and_power_cuts(
    seed: int, tmp_path: Path
) -> None:
    history = History(tmp_path, seed)
    with history.sim as sim:
        history.begin()
        for _ in range(6):
            for _ in range(history.rng.randint(2, 6)):
                history.step()
            if history.rng.random() < 0.5:
                sim.disk.set(Fault(at=history.rng.randint(0, 12), error=None))
                history.step()
                sim.disk.set(None)
            sim.kill()
            history.begin()
            history.look()


def started(sim: Simulation) -> None:
    sim.start()
    sim.advance(120.0)


def old_state(data: Path, jobs: int) -> list[str]:
    """Turn a directory's state into one of an earlier version; returns the jobs' names."""
    state = json.loads((data / "state.json").read_text())
    state["jobs"] = [
        {"id": f"job-{i}", "name": f"n{i}", "folder": f"n{i}", "phase": "done", "frames_total": 3,
         "frames_done": 3, "duration_s": 9.0, "elapsed_s": 9.0, "speed_up": None, "warnings": [],
         "error": None}
        for i in range(1, jobs + 1)
    ]  # fmt: skip
    state["jobs_made"] = jobs
    (data / "state.json").write_text(json.dumps(state))
    return [job["id"] for job in state["jobs"]]


@pytest.mark.daily(2)
@pytest.mark.parametrize("fault", [0, 1, 7, 150, None])
def test_jobs_of_an_earlier_version_move_to_files_of_their_own(
    fault: int | None, tmp_path: Path
) -> None:
    sim = Simulation(tmp_path)
    with sim:
        sim.start()
        sim.stop()
        names = old_state(sim.data, OLD_JOBS)
        if fault is not None:
            sim.disk.set(Fault(at=fault, error=None))  # the power is cut in the midst
            with pytest.raises(Crashed):
                started(sim)
            sim.cut()
            sim.disk.set(None)
        sim.start()
        assert [j["job"] for j in sim.call(sim.client(), "job.list")["jobs"]] == names
        sim.advance(1.0)
        assert "jobs" not in json.loads((sim.data / "state.json").read_text())
        sim.kill()
        sim.start()
        client = sim.client()
        assert [j["job"] for j in sim.call(client, "job.list")["jobs"]] == names
        job = sim.call(client, "script.submit", text=script(3))["job"]
        assert job == f"job-{OLD_JOBS + 1}"


def test_jobs_of_an_earlier_version_stay_in_the_state_while_the_disk_is_full(
    tmp_path: Path,
) -> None:
    sim = Simulation(tmp_path)
    with sim:
        sim.start()
        sim.stop()
        names = old_state(sim.data, 3)
        write = JobFiles.write
        refused = mock.Mock(side_effect=DatasetWriteError("no room"))
        with mock.patch.object(JobFiles, "write", refused):
            for _ in range(2):
                sim.start()
                assert [
                    j["job"] for j in sim.call(sim.client(), "job.list")["jobs"]
                ] == names
                sim.call(sim.client(), "tube.set", kV=72.0)
                sim.advance(1.0)
                sim.kill()
        assert write is JobFiles.write
        for _ in range(2):
            sim.start()
            sim.advance(1.0)
            assert len(list((sim.data / "jobs" / "status").iterdir())) == 3
            assert [j["job"] for j in sim.call(sim.client(), "job.list")["jobs"]] == names
            sim.kill()


def cost_of(sim: Simulation, ask: Callable[[], object]) -> tuple[int, int]:
    """Changes of the disk and bytes written until an answer is there and all is quiet."""
    sim.advance(1.0)
    written, real = [0], os.write

    def write(fd: int, data: Any) -> int:
        written[0] += len(data)
        return real(fd, data)

    before = len(sim.disk.ops)
    with mock.patch.object(os, "write", write):
        ask()
        sim.advance(1.0)
    return len(sim.disk.ops) - before, written[0]


def costs_of_changes(sim: Simulation, jobs: int, uploads: int) -> list[tuple[int, int]]:
    """Of four changes, in a directory with so many jobs and uploads."""
    sim.start()
    sim.stop()
    old_state(sim.data, jobs)
    started(sim)  # until old jobs have been written, a few in each turn
    client = sim.client()
    sim.call(client, "script.submit", text=script(3))  # makes the folders
    for i in range(1 + uploads):
        upload(sim, client, f"old{jobs}-{i}", i)
    new, scan = f"new{jobs}", {"text": script(3), "name": f"{jobs:06}", "seed": 7}
    costs = [
        cost_of(sim, lambda: sim.call(client, "tube.set", kV=71.0)),
        cost_of(sim, lambda: upload(sim, client, new, 9)),
        cost_of(sim, lambda: sim.call(client, "script.submit", **scan)),
        cost_of(sim, lambda: sim.call(client, "sample.delete", name=new)),
    ]
    sim.stop()
    return costs


def test_a_change_costs_the_disk_the_same_however_much_there_is(tmp_path: Path) -> None:
    sim = Simulation(tmp_path, speed_up="max")
    with sim:
        young, old = costs_of_changes(sim, 0, 0), costs_of_changes(sim, OLD_JOBS, 40)
    for (ops, size), (ops_then, size_then) in zip(young, old, strict=True):
        assert ops == ops_then
        assert abs(size_then - size) <= 64, "names and numbers have other lengths"


def test_ended_jobs_are_kept_by_count_and_by_age(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        today = datetime(2030, 1, 1, tzinfo=UTC)
        lab.twin.jobs._today = lambda: today
        for _ in range(4):
            job = (await c.call("script.submit", text=script(3)))["job"]
            await lab.ended(c, job)
        names = [j["job"] for j in (await c.call("job.list"))["jobs"]]
        assert names == ["job-2", "job-3", "job-4"]
        assert (await c.error("job.status", job="job-1")).code == -32602
        today += timedelta(days=31)
        job = (await c.call("script.submit", text=script(3)))["job"]
        assert (
            [j["job"] for j in (await c.call("job.list"))["jobs"]] == [job] == ["job-5"]
        )
        await lab.ended(c, job)
        await lab.twin.state_store.flush()
        files = {f.name for f in (lab.root / "jobs" / "status").iterdir()}
        assert files == {"job-5.json"}
        assert not list((lab.root / "jobs").glob("*.json")), (
            "complete: nothing goes on from it"
        )

    run(tmp_path, body, limits=TwinLimits(max_ended_jobs=3, ended_job_days=30.0))


def test_what_is_in_use_is_not_deleted_and_the_answer_says_why(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c, other = lab.client(), lab.client()
        voxels = b"\0\0\x80\x3d" * 8
        for name in ("shown", "other", "third"):
            await c.call("sample.upload", name=name, kind="voxels", format="raw", shape=[2, 2, 2],
                         voxel_mm=[0.5, 0.5, 0.5], total=32, data=voxels)  # fmt: skip
        await c.call("sample.set", file="shown")
        error = await c.error("sample.delete", name="shown")
        assert "stands on the stage" in error.message
        lab.projector.limit = 0
        job = (await c.call("script.submit", text=script(3)))["job"]
        await lab.until(lambda: lab.twin.jobs.running, "it runs")
        await c.call("job.pause", job=job)
        await c.call("sample.set", file="other")
        error = await c.error("sample.delete", name="shown")
        assert (error.code, job in error.message) == (-32003, True)
        assert (await c.error("job.forget", job=job)).code == -32003
        assert (await c.call("job.forget", days=0.0))["jobs"] == []
        assert (await other.error("sample.delete", name="third")).code == -32003, (
            "no controller"
        )
        assert (await c.error("sample.delete", name="nothing")).code == -32602
        await c.call("job.abort", job=job)
        await lab.ended(c, job)
        lab.projector.limit = None
        await c.call("sample.delete", name="shown")
        assert not list((lab.root / "samples").glob("shown*"))
        await c.call("calibration.apply", parameters={"dD_x": 0.1}, name="one")
        assert "in force" in (await c.error("calibration.delete", name="one")).message
        await c.call("calibration.apply", parameters={"dD_x": 0.2}, name="two")
        await c.call("calibration.delete", name="one")
        assert (await c.call("calibration.revert"))["correction"] is None
        assert (await c.call("job.forget", job=job))["jobs"] == [job]
        with pytest.raises(RpcError, match="no jobs yet"):
            await c.call("job.status", job=job)
        # What a forgotten scan left goes on if it is submitted again; of one whose data set is
        # gone nothing is left.
        first, second = ["kept", "gone"]
        for name in (first, second):
            lab.projector.limit = lab.projector.views + 1
            job = (await c.call("script.submit", text=script(3), name=name))["job"]
            description = lab.root / name / "flexdt.json"
            await lab.until(description.exists, "it begins")
            await c.call("job.abort", job=job)
            await lab.ended(c, job)
        lab.projector.limit = None
        shutil.rmtree(lab.root / second)
        await c.call("job.forget", days=0.0)
        records = {f.stem for f in (lab.root / "jobs").glob("*.json")}
        assert (first in records, second in records) == (True, False)
        job = (await c.call("script.submit", text=script(3), name=first))["job"]
        assert (await lab.ended(c, job))["state"] == "done"

    run(tmp_path, body)


def test_there_is_a_most_of_samples_and_corrections(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        for name, fits in (("a", True), ("b", True), ("c", False), ("a", True)):
            params = {"name": name, "kind": "voxels", "format": "raw", "shape": [1, 1, 1],
                      "voxel_mm": [0.5, 0.5, 0.5], "total": 4, "data": b"\0\0\x80\x3d"}  # fmt: skip
            if fits:
                await c.call("sample.upload", **params)
            else:
                assert (
                    "sample.delete" in (await c.error("sample.upload", **params)).message
                )
        for number, name in enumerate("ab"):
            await c.call(
                "calibration.apply", parameters={"dD_x": 0.1 + number}, name=name
            )
        refused = await c.error("calibration.apply", parameters={"dD_x": 0.7}, name="c")
        assert "calibration.delete" in refused.message
        await c.call(
            "calibration.apply", parameters={"dD_x": 0.1}, name="a"
        )  # it is there

    run(tmp_path, body, limits=TwinLimits(max_samples=2, max_corrections=2))


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(6))
def test_revert_goes_back_through_what_was_put_in_force_whatever_was_killed(
    seed: int, tmp_path: Path
) -> None:
    """The history has a file of its own; a stack of names is the judge."""
    rng, sim = random.Random(seed), Simulation(tmp_path, seed)
    stack: list[str | None] = []
    with sim:
        sim.start()
        client = sim.client()
        for step in range(25):
            name = f"c{rng.randint(0, 6)}"
            if rng.random() < 0.6:
                number = int(name[1:])
                sim.call(
                    client,
                    "calibration.apply",
                    parameters={"dD_x": number / 8},
                    name=name,
                )
                stack.append(name)
            elif stack:
                sim.call(client, "calibration.revert")
                stack.pop()
            if rng.random() < 0.3:
                sim.kill()
                if (
                    step == 10
                ):  # as an earlier version left it: all in the state, and no file
                    state = json.loads((sim.data / "state.json").read_text())
                    state["corrections"] = stack
                    (sim.data / "state.json").write_text(json.dumps(state))
                    (sim.data / "corrections" / "history").unlink(missing_ok=True)
                sim.start()
                client = sim.client()
            found = sim.call(client, "calibration.get")["correction"]
            assert (found and found["name"]) == (stack[-1] if stack else None)
        size = len(json.loads((sim.data / "state.json").read_text())["corrections"])
        assert size <= 1
        while stack:
            sim.call(client, "calibration.revert")
            stack.pop()
            found = sim.call(client, "calibration.get")["correction"]
            assert (found and found["name"]) == (stack[-1] if stack else None)


@pytest.mark.parametrize("seed", range(4))
def test_what_a_directory_holds_is_counted_without_reading_it_all_again(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, read, moments = random.Random(seed), list[str](), itertools.count(1)
    used = UsedBytes(open_data(tmp_path))
    real = disk_room._read

    def noted(folder: Directory, changed_ns: int) -> Any:
        read.append(folder.path.name)
        return real(folder, changed_ns)

    monkeypatch.setattr(disk_room, "_read", noted)

    def touch(folder: Path) -> None:
        """Its time of change, long ago, as a clock of finer grain would have it."""
        os.utime(folder, ns=(0, next(moments)))

    for number in range(30):
        folders = [d for d in tmp_path.rglob("*") if d.is_dir()]
        files = [f for f in tmp_path.rglob("*") if f.is_file()]
        place = rng.choice([tmp_path, *folders])
        match rng.choice(["file", "file", "folder", "gone", "none"]):
            case "file":
                (place / f"f{number}").write_bytes(bytes(rng.randint(0, 99)))
            case "folder":
                (place / f"d{number}").mkdir()
                touch(place / f"d{number}")
            case "gone" if files:
                place = rng.choice(files).parent
                rng.choice([f for f in place.iterdir() if f.is_file()]).unlink()
            case _:
                place = None  # type: ignore[assignment]
        if place is not None:
            touch(place)
        read.clear()
        assert used.count() == sum(
            f.stat().st_size for f in tmp_path.rglob("*") if f.is_file()
        )
        assert len(read) <= 3, "what has changed, and a new folder in it"


def test_scans_without_names_are_numbered_without_looking_at_all_of_the_day(
    tmp_path: Path,
) -> None:
    async def body(lab: Lab) -> None:
        c, stat, looked = lab.client(), lab.twin.directory.stat, list[str]()
        made = datetime.now(UTC)
        for n in range(1, 41):
            (lab.root / f"{made:%y%m%d}_{n:03d}").mkdir()
        names = []
        with mock.patch.object(
            lab.twin.submissions, "root", mock.Mock(wraps=lab.twin.directory)
        ) as root:
            root.path = lab.twin.directory.path
            root.stat.side_effect = lambda name: looked.append(name) or stat(name)
            for _ in range(3):
                looked.clear()
                job = (await c.call("script.submit", text=script(3)))["job"]
                names.append((await lab.ended(c, job))["name"])
                found = [name for name in looked if name.startswith(f"{made:%y%m%d}_")]
        assert len(set(names)) == 3
        assert names[-1].endswith("_043") or made.day != datetime.now(UTC).day
        assert len(found) < 10

    run(tmp_path, body)


def test_a_setting_does_not_wait_for_thousands_of_old_jobs(tmp_path: Path) -> None:
    """After a start that forgets nearly all of them: turns are short, and each is served
    between two of them.
    """
    sim = Simulation(tmp_path, limits=TwinLimits(max_ended_jobs=10))
    with sim:
        sim.start()
        sim.stop()
        folder = sim.data / "jobs" / "status"
        folder.mkdir(parents=True, exist_ok=True)
        for n in range(1, 2001):
            job = {"schema": 1, "id": f"job-{n}", "name": f"n{n}", "folder": f"n{n}",
                   "phase": "done", "frames_total": 3, "frames_done": 3, "duration_s": 9.0,
                   "ended": datetime.now(UTC).isoformat()}  # fmt: skip
            (folder / f"job-{n}.json").write_text(json.dumps(job))
        sim.start()
        client = sim.client()
        before = len(sim.disk.ops)
        sim.call(client, "axes.set", axis="tra_obj", speed=3.0)
        assert len(sim.disk.ops) - before < 300
        assert len(list(folder.iterdir())) > 1500
        sim.advance(30.0)
        assert len(list(folder.iterdir())) == 10
        sim.kill()
        sim.start()
        client = sim.client()
        assert sim.call(client, "state.get")["axes"]["tra_obj"]["speed"] == 3.0
        page = sim.call(client, "job.list", start=8, count=5)
        assert [job["job"] for job in page["jobs"]] == ["job-1999", "job-2000"]
        assert page["total"] == 10
