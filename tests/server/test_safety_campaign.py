"""The crossed campaign: at every state that a drawn history reaches, every safe and every urgent
method is called in every legal spelling, and gives its result.
"""

from __future__ import annotations

import pytest
from safety_histories import all_are_called, episode

from flexdt.twin.scanner import state


def found(seeds: range, steps: int, *, dear: bool = False) -> list[str]:
    """What the histories of these seeds found, each with its seed."""
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
@pytest.mark.campaign(1)
@pytest.mark.parametrize("block", range(40))
def test_every_answer_comes_at_every_state_of_two_thousand_histories(block: int) -> None:
    assert found(range(50 * block, 50 * (block + 1)), 8, dear=True) == []


@pytest.mark.slow
def test_the_campaign_finds_a_pose_behind_the_source(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """With the rule of corrections taken away, a history reaches a pose without a geometry."""
    monkeypatch.setattr(state, "require_before_source", lambda *_: None)
    assert any("not in front of the source" in what for what in found(range(30), 8))
