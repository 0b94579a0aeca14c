"""A change is made whole or not at all: forgetting beside resuming, ages, numeric limits."""

from __future__ import annotations

import os
import random
import resource
from contextlib import suppress
from pathlib import Path

import pytest
from in_process import Lab, run, script
from simulation import Simulation

from flexdt.protocol import RpcError
from flexdt.runtime.access import AccessError, TwinLimits, limit_names, with_limits
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.storage.job_files import JobFiles
from flexdt.twin.dataset.dataset_errors import DatasetWriteError

DAYS = limit_names(TwinLimits())


@pytest.mark.parametrize("seed", range(12))
def test_a_job_is_forgotten_or_goes_on(tmp_path: Path, seed: int) -> None:
    """Asked at the same time, in either order, on a disk of drawn delays: what was answered
    holds after a kill.
    """
    rng = random.Random(seed)
    with Simulation(tmp_path, seed) as sim:
        sim.start()
        client, other = sim.client(), sim.client()
        job = sim.call(client, "script.submit", text=script(3), name="scan")["job"]
        sim.advance(rng.uniform(0.1, 3.0))
        sim.call(client, "job.abort", job=job)
        sim.advance(1.0)
        asked = {
            "resume": lambda: sim.begin(client, "job.resume", job=job),
            "forget": lambda: sim.begin(client, "job.forget", job=job),
            "upload": lambda: sim.begin(
                other, "sample.upload", name="a", kind="voxels", format="raw",
                shape=[1, 1, 1], voxel_mm=[1.0] * 3, total=4, data=b"\0\0\x80\x3d"),
        }  # fmt: skip
        names = list(asked)
        rng.shuffle(names)
        begun = {}
        for name in names:
            begun[name] = asked[name]()
            sim.advance(rng.choice((0.0, 0.001, 0.03)))
        answers = {}
        for name, task in begun.items():
            try:
                answers[name] = sim.answer(task)
            except RpcError as error:
                answers[name] = error
        goes_on = not isinstance(answers["resume"], RpcError)
        gone = not isinstance(answers["forget"], RpcError)
        assert goes_on != gone or names.index("resume") < names.index("forget")
        if goes_on and not gone:
            assert answers["resume"]["state"] in ("queued", "running")
        known = [j["job"] for j in sim.call(client, "job.list")["jobs"]]
        assert known == ([] if gone else [job])
        sim.kill()
        sim.start()
        listed = sim.call(sim.client(), "job.list")["jobs"]
        assert [j["job"] for j in listed] == known
        assert len(JobFiles(sim.twin.directory).read()) == len(known)


def test_ages_that_no_calendar_has(tmp_path: Path) -> None:
    async def body(lab: Lab) -> None:
        c = lab.client()
        job = (await c.call("script.submit", text=script(3)))["job"]
        await lab.ended(c, job)
        assert (await c.call("job.forget", days=1e6))["jobs"] == []
        assert (await c.call("job.forget", days=0.0))["jobs"] == [job]
        job = (await c.call("script.submit", text=script(3)))["job"]
        await lab.ended(c, job)

    longest = with_limits(["ended_job_days=999999999"], TwinLimits())
    run(tmp_path, body, limits=longest)


@pytest.mark.parametrize("word", [f"{n}=1e300" for n in DAYS] + ["ended_job_days=1e9"])
def test_a_limit_that_its_use_cannot_have_is_refused_with_a_sentence(word: str) -> None:
    with pytest.raises(AccessError, match="must be at most"):
        with_limits([word], TwinLimits())


@pytest.mark.parametrize("left", range(12))
def test_a_change_for_which_descriptors_are_wanting_is_undone(
    tmp_path: Path, left: int
) -> None:
    """However few there are: it is refused before its first write, or taken back."""
    (tmp_path / "inner" / "deep").mkdir(parents=True)
    with Directory(tmp_path) as root:
        deep = root.folder("inner").folder("deep")
        for folder in (root, deep):
            folder.keep("a", b"old")
            folder.keep("b", b"old")
        taken = []
        limits = resource.getrlimit(resource.RLIMIT_NOFILE)
        resource.setrlimit(resource.RLIMIT_NOFILE, (256, limits[1]))
        try:
            with suppress(OSError):
                while True:
                    taken.append(os.open(os.devnull, os.O_RDONLY))
            for _ in range(left):
                os.close(taken.pop())
            with (
                pytest.raises((DatasetWriteError, ZeroDivisionError)),
                Changes() as changes,
            ):
                _change_all(changes, root, deep, taken)
        finally:
            for fd in taken:
                os.close(fd)
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        for folder in (root, deep):
            assert [folder.read(name) for name in ("a", "b")] == [b"old", b"old"]
            assert {f.name for f in folder.path.iterdir() if f.is_file()} == {"a", "b"}


def _change_all(
    changes: Changes, root: Directory, deep: Directory, taken: list[int]
) -> None:
    """Change files, take all descriptors that are left, and fail."""
    for folder in (root, deep):
        changes.put(folder, "a", b"new")
        changes.remove(folder, "b")
    with suppress(OSError):
        while True:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    raise ZeroDivisionError
