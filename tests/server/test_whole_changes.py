"""A change is made whole or not at all: forgetting beside resuming, ages, numeric limits."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from in_process import Lab, run, script
from simulation import Simulation

from flexdt.protocol import RpcError
from flexdt.runtime.access import AccessError, TwinLimits, limit_names, with_limits
from flexdt.server.storage.job_files import JobFiles

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
