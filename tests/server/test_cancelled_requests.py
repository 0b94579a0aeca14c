"""Nobody waits for ever: requests that end at any moment, and a server that ends under them."""

from __future__ import annotations

import asyncio
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from cancelled_requests import run_cancelled
from kept_workers import kept_workers

from flexdt.server.scans.frame_pipeline import FramePipeline
from flexdt.server.scans.runner import ScanRunner
from flexdt.testing import Deadlock

STEPS = 20
"""Requests of a history."""


def histories(root: Path, seeds: range) -> Counter[str]:
    """What came of the requests of some histories."""
    found: Counter[str] = Counter()
    with kept_workers():
        for seed in seeds:
            folder = root / str(seed)
            folder.mkdir()
            found += run_cancelled(seed, folder, STEPS)
    return found


@pytest.mark.slow
@pytest.mark.campaign(1)
@pytest.mark.parametrize("block", range(50))
def test_every_request_and_every_server_ends(tmp_path: Path, block: int) -> None:
    found = histories(tmp_path, range(20 * block, 20 * (block + 1)))
    assert sum(n for what, n in found.items() if what.endswith("cut off")) > 20
    assert found["script.submit answered"] > 5
    assert found["job.resume answered"] > 0


def _wakes_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan that is told to go on, to pause or to end is not woken."""
    monkeypatch.setattr(ScanRunner, "_wake", lambda *_: None)


def _swallows_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    """A scan takes the end of the server for an error of its own, and the next may come."""
    honest = ScanRunner.run

    async def run(runner: ScanRunner) -> None:
        try:
            await honest(runner)
        except asyncio.CancelledError:
            raise RuntimeError("the scan has ended") from None

    monkeypatch.setattr(ScanRunner, "run", run)


def _never_tries_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """A resumed scan does not tell the workers that failed."""
    monkeypatch.setattr(FramePipeline, "retry", lambda *_: None)


@pytest.mark.slow
def test_a_service_that_takes_its_end_for_an_error_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The server waited for ever for one that caught its cancellation."""
    _swallows_the_end(monkeypatch)
    histories(tmp_path, range(12, 18))


@pytest.mark.slow
@pytest.mark.parametrize("plant", [_wakes_nobody, _never_tries_again])
def test_a_planted_wait_for_ever_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: Any
) -> None:
    """The test's own test; without the plant the same histories end."""
    plant(monkeypatch)
    with pytest.raises((Deadlock, TimeoutError)):
        histories(tmp_path, range(15))
