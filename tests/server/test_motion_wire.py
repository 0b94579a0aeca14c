"""Several clients of a whole server, in any order, under the eye of the motion oracle: short
form.

The long one is `tests/studies/motion_campaign.py`.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from motion_rules import MACHINES
from wire_rules import data_with_samples, read_here, run_wire_episode

from flexdt.server.scans.stage import Stage
from flexdt.server.storage import stored_samples as store

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def uploads(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(store, "mesh_apart", read_here)
        return data_with_samples(tmp_path_factory.mktemp("uploads"))


@pytest.mark.parametrize("machine", MACHINES)
@pytest.mark.parametrize("seed", range(2))
@pytest.mark.campaign(3)
def test_no_client_brings_anything_into_contact(
    machine: str, seed: int, uploads: Path, tmp_path: Path
) -> None:
    rng = np.random.default_rng([seed, 13])
    episode, history = run_wire_episode(rng, machine, 40, tmp_path / "e", uploads)
    asked = "\n".join(map(str, history))
    assert not episode.found, f"{episode.found[0]}\n{episode.start}\n{asked}"
    assert sum(episode.counts.values()) >= 35


def test_without_a_guard_contacts_are_found(
    uploads: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oracle sees what the server's motors do, jobs and all."""
    monkeypatch.setattr(Stage, "guard", lambda *_, **__: None)
    for seed in range(12):
        rng = np.random.default_rng([seed, 13])
        episode, _ = run_wire_episode(rng, "flexray", 40, tmp_path / str(seed), uploads)
        if "contact" in {v.kind for v in episode.found}:
            return
    pytest.fail("no contact in twelve episodes of a scanner without a guard")
