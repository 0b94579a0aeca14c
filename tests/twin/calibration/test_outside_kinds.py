"""Causes of shapes that no table has: what is offered holds for the mean of the scan.

The whole is `tests/studies/outside_kinds.py`; a few of each sort are here.
"""

from __future__ import annotations

import pytest
from outside_kinds import FAR_SIGMAS, KINDS, MOVING, scored


@pytest.mark.daily(3)
@pytest.mark.campaign(6)
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_offered_of_a_strange_cause_holds(kind: str) -> None:
    found = scored(kind, 3)
    assert found.worst < FAR_SIGMAS, (found.where, found.said)


@pytest.mark.parametrize("kind", ["ramp", "jump", "shaking"])
def test_the_mean_of_what_moves_is_offered(kind: str) -> None:
    """All of it was refused."""
    assert kind in MOVING
    found = scored(kind, 1)
    assert found.offered, found.said
    assert found.worst < FAR_SIGMAS, found.where


def test_a_right_scan_is_offered() -> None:
    found = scored("right", 1)
    assert found.offered
    assert found.worst < FAR_SIGMAS
