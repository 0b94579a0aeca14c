"""The least of equally spaced trials, of which those at the ends may not have been made."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.twin.calibration.without_phantom.mirror_symmetry import best_dip


def expected(costs: list[float], apart: float) -> tuple[int, float]:
    """Return the least cost's place and the next minimum's ratio, trial by trial."""
    best = min(range(len(costs)), key=lambda k: costs[k])
    dips = [
        k
        for k in range(1, len(costs) - 1)
        if math.isfinite(costs[k - 1] + costs[k] + costs[k + 1])
        and costs[k] <= min(costs[k - 1], costs[k + 1])
    ]
    if best not in dips:
        return best, 0.0
    others = [costs[k] / costs[best] for k in dips if abs(k - best) > apart]
    return best, min(others, default=math.inf)


@pytest.mark.parametrize("seed", range(40))
def test_a_least_cost_beside_a_trial_that_was_not_made_is_no_minimum(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = 1.0 + rng.random(rng.integers(8, 40))
    begin, end = rng.integers(0, 4, 2)
    costs[:begin] = costs[len(costs) - end :] = math.inf
    if seed % 2:
        costs[begin if seed % 4 == 1 else len(costs) - end - 1] = 0.5
    apart = float(rng.integers(1, 4))
    best, ratio = best_dip(costs, apart)
    place, next_best = expected(list(costs), apart)
    assert (best, ratio) == (place, pytest.approx(next_best))
    if seed % 2:
        assert ratio == 0.0
