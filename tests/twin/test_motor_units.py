"""Motors that count in micrometres, metres or ten-thousandths of a degree do what those in mm and
degrees do.
"""

from __future__ import annotations

import numpy as np
import pytest
from motor_units import UNITS, history, in_units

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.travel import check_target
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script.dry_run import check_script

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


@pytest.mark.parametrize("unit", UNITS)
def test_the_least_rate_is_that_of_the_parts(unit: str) -> None:
    """In mm/s and deg/s, whatever a motor counts in; it was one number for all units."""
    mm, deg = UNITS[unit]
    machine = in_units(builtin_machine(), mm, deg)
    for axis, size in (("mag_obj", mm), ("rot_obj", deg)):
        scanner = ScannerTwin(machine, builtin_profile(machine.default_profile))
        with pytest.raises(LimitError) as refused:
            scanner.set_axis(axis, speed=0.0)
        least, _ = refused.value.data["allowed"]
        assert least * size == pytest.approx(1e-6)
        scanner.set_axis(axis, speed=1.01 * least)
        text = f"{axis} set speed {{:.12f}} ACK"  # a script knows the same one
        assert check_script(text.format(1.01 * least), machine).errors == ()
        [below] = check_script(text.format(0.99 * least), machine).errors
        assert below.message.endswith(f"allowed: from {least:g} on")


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
