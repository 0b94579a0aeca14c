"""Nothing acknowledged is lost, and nobody's work is ended by an observer: drawn
interleavings of several clients, slow disks and kills."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from crossed_changes import run_crossed
from in_process import script
from simulation import Simulation

from flexdt.runtime.files.own_documents import Changes
from flexdt.server.storage.job_files import JobFiles
from flexdt.server.storage.memory import StateStore
from flexdt.server.storage.sample_uploads import Incoming, Upload, UploadHead
from flexdt.server.twin.core import ControlLease


@pytest.mark.daily(12)
@pytest.mark.campaign(24)
@pytest.mark.parametrize("seed", range(1000))
def test_what_was_acknowledged_is_there_after_a_kill_at_any_moment(
    seed: int, tmp_path: Path
) -> None:
    outcome = run_crossed(tmp_path, seed)
    assert outcome.kills == 3
    assert outcome.looks >= 3


@pytest.mark.parametrize("after_s", [0.0, 0.05, 5.0])
def test_an_answered_abort_is_there_after_a_kill_at_once(
    tmp_path: Path, after_s: float
) -> None:
    with Simulation(tmp_path) as sim:
        sim.start()
        client = sim.client()
        job = sim.call(client, "script.submit", text=script(3), name="scan")["job"]
        sim.advance(after_s)
        assert sim.call(client, "job.abort", job=job)["state"] == "aborted"
        sim.kill()
        sim.start()
        [found] = sim.call(sim.client(), "job.list")["jobs"]
        assert found["state"] == "aborted"


def _forgets_in_memory_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    def remove(files: JobFiles, changes: Changes, jobs: Any) -> None:
        """Leave the files."""

    monkeypatch.setattr(JobFiles, "remove", remove)
    monkeypatch.setattr(JobFiles, "delete", lambda *_: None)


def _ends_in_memory_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StateStore, "_put_jobs", lambda *_: None)


def _takes_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = Incoming.take

    def take(incoming: Incoming, upload: Upload) -> tuple[UploadHead, bytes]:
        """Take whoever's upload lies under the name, as it was once."""
        return honest(incoming, incoming._open.get(upload.head.name, upload))

    monkeypatch.setattr(Incoming, "take", take)


def _lets_observers_act(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ControlLease, "require", lambda *_: None)
    monkeypatch.setattr(ControlLease, "ensure_allowed", lambda *_: None)


@pytest.mark.parametrize(
    ("plant", "seed"),
    [
        (_forgets_in_memory_alone, 2),
        (_ends_in_memory_alone, 0),
        (_takes_by_name, 10),
        (_lets_observers_act, 0),
    ],
)
def test_a_planted_defect_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant: Any, seed: int
) -> None:
    """The test's own test; without the plant these histories are found in order."""
    plant(monkeypatch)
    with pytest.raises(AssertionError):
        run_crossed(tmp_path, seed)
