"""A disk that fails, or loses its power, at every third change of a whole run.

Start, upload, settings, scans, corrections, scenes, poses, an abort and a resume; see
`whole_run`. Here the ways to fail take turns; `tests/studies/faults.py` has every change in all
of them.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from whole_run import PARTS, WAYS, Part

from flexdt.server.storage.memory import StateStore

Right = dict[str, tuple[Path | None, Part]]


@pytest.fixture(scope="module")
def right(tmp_path_factory: pytest.TempPathFactory) -> Right:
    """Every part undisturbed, and what it began with."""
    before, parts = None, {}
    for name in PARTS:
        part = Part(name, tmp_path_factory.mktemp("right"), before)
        with part.sim:
            part.go()
        parts[name] = (before, part)
        before = part.sim.data
    return parts


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("name", PARTS)
@pytest.mark.campaign(1)
def test_nothing_is_ever_half_done(name: str, right: Right, tmp_path: Path) -> None:
    before, undisturbed = right[name]
    disturbed = 0
    for n in range(0, len(undisturbed.sim.disk.ops), 3):
        part = Part(name, tmp_path / str(n), before, seed=n)
        with part.sim:
            part.go(WAYS[n // 3 % len(WAYS)](n), undisturbed)
        disturbed += bool(part.answers)
        shutil.rmtree(tmp_path / str(n))
    assert disturbed  # some clients were told


def test_a_change_that_comes_before_its_writing_is_found(
    right: Right, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The test's own test: change, then store, as it was once."""
    keep = StateStore.keep

    async def hasty(state_store, take, after=None, files=None):  # type: ignore[no-untyped-def]
        done = take()
        return await keep(state_store, lambda: done, after, files)

    monkeypatch.setattr(StateStore, "keep", hasty)
    before, undisturbed = right["settings"]
    part = Part("settings", tmp_path, before)
    with part.sim, pytest.raises(AssertionError):
        part.go(WAYS[2](12), undisturbed)
