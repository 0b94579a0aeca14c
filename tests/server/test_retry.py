"""The pauses between a paused job's attempts, in virtual time."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

import pytest

from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.scans import job_retries
from flexdt.server.scans.job_retries import Retry, transient
from flexdt.server.scans.runner import hopeless
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.dataset.dataset_errors import DiskFullError
from flexdt.twin.errors import GeometryError, LimitError, TwinError


def run(main: Coroutine[Any, Any, None]) -> None:
    loop = SimulatedLoop(random.Random(1))
    try:
        loop.run_until_complete(main)
    finally:
        loop.close()


def now() -> float:
    return asyncio.get_running_loop().time()


def test_each_pause_is_twice_the_last_one_up_to_the_longest() -> None:
    async def main() -> None:
        attempts = Retry()
        assert attempts.waits_s is None
        pauses = []
        for _ in range(7):
            done = asyncio.Event()
            begun = now()
            attempts.schedule(ProjectorUnavailable("gone"), done.set)
            assert attempts.waits_s == pytest.approx(
                2.0 ** len(pauses) if len(pauses) < 5 else 30
            )
            attempts.schedule(
                ProjectorUnavailable("gone"), pytest.fail
            )  # the pending one stays
            await done.wait()
            pauses.append(now() - begun)
            assert attempts.waits_s is None
        assert pauses == pytest.approx([1, 2, 4, 8, 16, 30, 30])

    run(main())


@pytest.mark.parametrize("how", ["progressed", "cancel"])
def test_progress_and_a_takeover_begin_with_the_first_pause_again(how: str) -> None:
    async def main() -> None:
        attempts = Retry(first_s=0.5, longest_s=10.0)
        for expected in (0.5, 1.0, 2.0):
            attempts.schedule(ProjectorUnavailable("gone"), lambda: None)
            assert attempts.waits_s == pytest.approx(expected)
            await asyncio.sleep(expected + 0.1)
        getattr(attempts, how)()
        attempts.schedule(ProjectorUnavailable("gone"), pytest.fail)
        assert attempts.waits_s == pytest.approx(0.5)
        attempts.progressed()  # while one is pending nothing has been done yet
        assert attempts.waits_s == pytest.approx(0.5)
        attempts.cancel()
        assert attempts.waits_s is None
        await asyncio.sleep(60.0)

    run(main())


def test_a_full_disk_is_asked_again_after_the_same_pause_until_there_is_room(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    free = [100, 1000, 1001, None]
    monkeypatch.setattr(job_retries, "free_bytes", lambda folder: free.pop(0))
    error = DiskFullError("full", {"path": str(tmp_path / "a.tif"), "bytes": 1000})

    async def main() -> None:
        attempts, done = Retry(), asyncio.Event()
        begun = now()
        attempts.schedule(error, done.set)
        await asyncio.sleep(1.25)
        assert attempts.waits_s == pytest.approx(0.75)
        await done.wait()
        assert now() - begun == pytest.approx(3.0)
        assert free == [None]

    run(main())


def test_which_errors_waiting_may_help() -> None:
    full = DiskFullError("full", {})
    assert transient(full)
    assert transient(ProjectorUnavailable("gone"))
    assert not transient(None)
    assert not transient(LimitError("far"))
    assert [
        hopeless(e) for e in (LimitError("a"), GeometryError("b"), TwinError("c"))
    ] == [True] * 3
    assert not hopeless(full)
