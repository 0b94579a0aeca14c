"""The crossed campaign: at every state that a drawn history reaches, every safe and every urgent
method is called in every legal spelling, and gives its result.
"""

from __future__ import annotations

import pytest
from kept_workers import kept_workers
from safety_histories import all_are_called, episode

from flexdt.twin.collision import guard, relative, retreat
from flexdt.twin.scanner import joining, safety, state


def found(seeds: range, steps: int, *, dear: bool = False) -> list[str]:
    """What the histories of these seeds found, each with its seed."""
    with kept_workers():
        return [
            f"{seed}: {what}"
            for seed in seeds
            for what in episode(seed, steps, dear=dear).found
        ]


def test_the_campaign_calls_every_safe_and_urgent_method() -> None:
    assert all_are_called() == set()


def test_every_safety_answer_comes_at_every_state_of_a_few_histories() -> None:
    assert found(range(6), 6) == []


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("block", range(40))
def test_every_answer_comes_at_every_state_of_two_thousand_histories(block: int) -> None:
    assert found(range(50 * block, 50 * (block + 1)), 8, dear=True) == []


@pytest.mark.slow
def test_the_campaign_finds_a_pose_behind_the_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the rule of corrections taken away, a history reaches a pose without a geometry."""
    monkeypatch.setattr(state, "require_before_source", lambda *_: None)
    assert any("not in front of the source" in what for what in found(range(10, 13), 8))


@pytest.mark.slow
def test_the_campaign_finds_motors_that_escape(monkeypatch: pytest.MonkeyPatch) -> None:
    """With no sweep at all, the oracle sees parts in each other."""
    monkeypatch.setattr(guard.SceneGuard, "__call__", lambda *_: None)
    assert any("oracle" in what and "mm lost" in what for what in found(range(1, 4), 8))


@pytest.mark.slow
def test_the_campaign_finds_a_micrometre_a_request(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the allowance of record 15 back, a margin is lost by steps that each keep it."""

    def planted(gap: float, margin: float) -> float:
        return gap - 1e-3 if gap < margin + 0.006 else real(gap, margin)

    real = safety.floor
    for module in (relative, retreat, joining):
        monkeypatch.setattr(module, "floor", planted)
    assert any("oracle" in what and "mm lost" in what for what in found(range(2, 3), 8))
