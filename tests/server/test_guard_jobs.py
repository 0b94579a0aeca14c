"""What a job was checked with stays as it is until it runs."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from flexdt.protocol import RpcError
from flexdt.server.scans.jobs import Jobs
from flexdt.server.scans.scan_job import JobInputs
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script import plan_poses

M = builtin_machine()
P = builtin_profile(M.default_profile)


def test_nothing_is_changed_while_a_job_is_being_opened(tmp_path: Path) -> None:
    async def main() -> None:
        clock = TwinClock("max")
        jobs = Jobs(ScannerTwin(M, P, clock.now()), clock, lambda job: None)
        asked, answer = asyncio.Event(), asyncio.Event()

        async def prepare() -> JobInputs:
            asked.set()
            await answer.wait()
            raise LimitError("it does not hold after all")

        work = asyncio.create_task(jobs.work())
        jobs.require_idle("a move")
        plan = plan_poses([{"rot_obj": 5.0}], M, P)
        job = jobs.draft("scan", str(tmp_path / "scan"), plan, prepare)
        jobs.enqueue(job)
        await asyncio.wait_for(asked.wait(), 60)
        with pytest.raises(
            RpcError, match="a move is refused while job-1 begins"
        ) as refused:
            jobs.require_idle("a move")
        assert refused.value.code == -32003
        answer.set()
        while job.phase != "failed":
            await asyncio.sleep(0.001)
        jobs.require_idle("a move")

        asked.clear()
        answer.clear()
        given_up = jobs.draft("again", str(tmp_path / "again"), plan, prepare)
        jobs.enqueue(given_up)
        await asyncio.wait_for(asked.wait(), 60)
        jobs.abort(given_up)
        jobs.require_idle("a move")  # at once: it will not run any more
        work.cancel()

    asyncio.run(asyncio.wait_for(main(), 100))
