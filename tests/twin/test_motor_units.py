"""Motors that count in micrometres, metres or ten-thousandths of a degree do what those in mm and
degrees do.
"""

from __future__ import annotations

import numpy as np
import pytest
from motor_units import UNITS, history

from flexdt.twin.machine.description import builtin_machine
from flexdt.twin.machine.travel import check_target

NEAR_MM = 0.01
"""Positions of parts agree to the tolerance of a sweep."""


def differing(seed: int) -> int:
    """Number of units in which the same requests were refused otherwise, or brought parts to
    other places; nothing but a refusal is raised in any.
    """
    base = history(seed, 1.0, 1.0)
    assert base.raised == []
    others = 0
    for name, (mm, deg) in UNITS.items():
        told = history(seed, mm, deg)
        assert told.raised == [], name
        places = zip(told.places, base.places, strict=True)
        far = max(abs(there[m] - here[m]) for there, here in places for m in here)
        others += told.refused != base.refused or far > NEAR_MM
    return others


@pytest.mark.parametrize("seed", [3, 6])
def test_requests_in_other_units_come_to_the_same(seed: int) -> None:
    """Issue 80: a path was said to jump by a share of a micrometre, and every request while
    a motor halted along a path raised ValueError (these two seeds); in metres a halt left the
    path by up to 10 um, and no motion shorter than 50 mm began before a contact."""
    assert differing(seed) == 0


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("block", range(12))
def test_three_hundred_histories_in_other_units_raise_nothing(block: int) -> None:
    """A request that ends at the margin is decided by rounding; all others alike."""
    histories = [differing(seed) for seed in range(25 * block, 25 * (block + 1))]
    assert sum(histories) <= 5  # of 100


def test_a_machine_knows_what_its_motors_count_in() -> None:
    machine = builtin_machine()
    assert {machine.counts(name) for name in machine.axes} == {1.0}
    geometry = {**machine.geometry, "object_y": {"mag_obj": 1e-3, "tra_obj": 0.25}}
    other = machine.model_copy(update={"geometry": geometry})
    assert other.counts("mag_obj") == pytest.approx(1000.0)
    assert other.counts("tra_obj") == 1.0  # by the part that it moves farthest
    upper = other.axes["mag_obj"].upper
    assert check_target(other, "mag_obj", np.nextafter(upper + 5e-7, np.inf)) == upper
