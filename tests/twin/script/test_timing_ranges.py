"""The 90 % ranges of a fitted machine, on simulated machines and by hand.

The machines are those of `tests/support/timed_rigs.py`: their logs, kinematics and times
share no code with the fit, and the fit knows nothing of their families.
"""

from __future__ import annotations

import math
import random

import pytest
import timing_ranges
from timed_rigs import FAMILIES, UNSEEN, Rig

from flexdt.twin.machine.description import Spread, Timing
from flexdt.twin.script.log_fit import LogRow
from flexdt.twin.script.planning.time_ranges import total_range


@pytest.mark.slow
def test_ranges_hold_the_next_scan_of_50_machines() -> None:
    found = timing_ranges.study(50, seed=17)
    inside = {group: share["percent"] for group, share in found["inside"].items()}
    assert 85.0 <= inside["lines, all"] <= 95.0
    assert 85.0 <= inside["totals, all"] <= 95.0
    for family in FAMILIES:
        assert inside[f"lines, {family}"] >= 85.0
        assert inside[f"totals, {family}"] >= 80.0
    assert found["limits_wrong"] == 0


def test_ranges_half_as_wide_would_not_hold() -> None:
    """So the bound of the study is one that ranges can miss."""
    held = []
    for index in range(9):
        rig = Rig(random.Random(index), FAMILIES[index % 3])
        found, _ = timing_ranges.next_scan(rig, 1 + index % 4)
        for row in found.rows:
            assert row.p5_s is not None
            assert row.p95_s is not None
            margin = (
                row.p95_s - row.predicted_s
                if row.error_s > 0
                else row.predicted_s - row.p5_s
            )
            held.append(abs(row.error_s) <= 0.5 * margin + 0.0005)
    assert sum(held) < 0.8 * len(held)


@pytest.mark.parametrize(
    ("n", "count", "squares"), [(1, 1, 1.0), (1, 3, 6.0), (4, 4, 6.4)]
)
def test_what_a_total_is_uncertain_by(n: int, count: int, squares: float) -> None:
    """Variances of a sum whose terms share the error of a mean, worked out by hand."""
    spread = {"xrayon": Spread(p5_s=1.0, p95_s=6.0, n=n)}
    timing = Timing(source="measured", xrayon_s=2.0, drift=0.1, spread=spread)
    rows = [LogRow(1, "on", 2.0, 2.0, None, None, "xrayon")] * count
    low, high = total_range(rows, 2.0 * count + 50.0, timing) or (0.0, 0.0)
    assert 2.0 * count + 50.0 - low == pytest.approx(
        1.0 * math.sqrt(squares) + 0.2 * count
    )
    assert high - 2.0 * count - 50.0 == pytest.approx(
        4.0 * math.sqrt(squares) + 0.2 * count
    )
    low, _ = total_range(rows, 0.1, timing) or (1.0, 1.0)
    assert low == 0.0  # no scan takes less than no time


@pytest.mark.slow
def test_rare_kinds_of_families_that_nothing_was_chosen_by() -> None:
    """A kind with one or two lines a scan, known from three to eight times."""
    found = timing_ranges.study(48, seed=17, families=UNSEEN)
    rare = ("xrayon", "xray_ready", "xrayoff", "xrayoff_again", "write_settings")
    shares = [found["inside"][f"lines, kind {kind}, n >= 3"] for kind in rare]
    count = sum(share["n"] for share in shares)
    assert count > 150
    assert 85.0 <= sum(s["percent"] * s["n"] for s in shares) / count <= 95.0
