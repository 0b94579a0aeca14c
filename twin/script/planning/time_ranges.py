"""90 % range of the time of a step or a scan, by a machine's logs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Protocol

from flexdt.twin.machine.description import Timing
from flexdt.twin.script.planning.plan_values import PlanStep

Range = tuple[float, float]


class _OfKind(Protocol):
    @property
    def kind(self) -> str: ...


def step_range(step: PlanStep, timing: Timing) -> Range | None:
    """Compute (5 %, 95 %) of how long the script waits for a step [s].

    None if no time of the machine is measured.
    """
    if not timing.spread:
        return None
    below, above = _margins(step.kind, timing)
    return max(0.0, step.holds_s - below), step.holds_s + above


def total_range(
    steps: Iterable[_OfKind], duration_s: float, timing: Timing
) -> Range | None:
    """Compute (5 %, 95 %) of a scan's duration [s], or None as for `step_range`.

    Steps are independent of each other, but the error of a kind's median, from n times,
    is common to all its steps: the variance of one step's error is (1 + 1/n) of the
    command's own, that of N steps N + N^2 / n. The drift of all times is common to all
    steps and added to that, as systematic errors are.

    Args:
        steps: of a plan, or lines of a log.
        duration_s: predicted.
        timing: of the machine.
    """
    if not timing.spread:
        return None
    squares = [0.0, 0.0]
    common = 0.0
    for kind, count in Counter(step.kind for step in steps).items():
        n = 1
        if kind in timing.spread:
            n = timing.spread[kind].n
        common += count * timing.drift * timing.seconds(kind)
        for i, margin in enumerate(_margins(kind, timing)):
            squares[i] += (count + count**2 / n) / (1.0 + 1.0 / n) * margin**2
    below, above = (math.sqrt(square) + common for square in squares)
    return max(0.0, duration_s - below), duration_s + above


def _margins(kind: str, timing: Timing) -> Range:
    """Return how far a time of a kind may be below and above its median [s].

    Without a measured spread it may be from 0 to twice the assumed time.
    """
    middle = timing.seconds(kind)
    spread = timing.spread.get(kind)
    if spread is None:
        return middle, middle
    return middle - spread.p5_s, spread.p95_s - middle
