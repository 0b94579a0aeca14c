"""The schedule of the transpose: which fans may add to the voxels at the same time.

Seen along z a fan is a wedge with its point in the source. Neighbouring fans share voxel columns,
fans with enough others between them share none. So the jobs of a view are gathered into units, and
first all even units are worked on, each by one thread, then all odd ones: no locks, no second copy
of the volume, and sums in the same order every time. Where wedges are too narrow for that (source
close to the volume), threads share out the range of z instead. The drawing in
docs/performance.md shows units and turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.fan_plan import FanPlan

IntArray = npt.NDArray[np.int64]

APART = 8.0
"""Least width of a unit where it enters the volume [voxels]: a fan reaches at most two voxel
columns beyond its own lines, its neighbour but one likewise."""


@dataclass(frozen=True, eq=False)
class Turns:
    """The order of work.

    Attributes:
        turns: (k, 2) ranges of units; all of a range may be worked on at the same time.
        units: (m, 2) ranges of jobs of the plan.
        slices: into how many ranges of z each unit is to be cut, so that no thread is idle.
    """

    turns: IntArray
    units: IntArray
    slices: int


def plan_turns(
    plan: FanPlan,
    views: FloatArray,
    counts: tuple[int, int, int],
    shape: tuple[int, int],
    workers: int,
) -> Turns:
    """Order the jobs of a plan.

    Args:
        plan: of these views.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box.
        counts: (nx, ny, nz) voxels of the box.
        shape: detector (rows, cols).
        workers: threads.
    """
    jobs = plan.jobs
    none = np.zeros((0, 2), np.int64)
    if len(jobs) == 0:
        return Turns(none, none, workers)
    width = _widths(plan, views, counts, shape)
    ends = np.flatnonzero(np.diff(jobs[:, 0])) + 1
    turns: list[tuple[int, int]] = []
    units: list[tuple[int, int]] = []
    fewest = len(jobs)
    alone = False
    for first, stop in zip([0, *ends.tolist()], [*ends.tolist(), len(jobs)], strict=True):
        cuts = _cuts(width[first:stop])
        if workers == 1 or len(cuts) < 4:
            # One after the other: joins what came before if that was so as well.
            if alone:
                units[-1] = (units[-1][0], stop)
            else:
                turns.append((len(units), len(units) + 1))
                units.append((first, stop))
            alone, fewest = True, 1
            continue
        alone = False
        pairs = [(first + a, first + b) for a, b in pairwise(cuts)]
        for half in (pairs[0::2], pairs[1::2]):
            turns.append((len(units), len(units) + len(half)))
            units.extend(half)
        fewest = min(fewest, len(pairs) // 2)
    return Turns(np.array(turns), np.array(units), -(-workers // fewest))


def _cuts(width: FloatArray) -> list[int]:
    """Ends of runs of jobs that are at least APART wide; a remainder joins the last run."""
    cuts, gathered = [0], 0.0
    for i, w in enumerate(width.tolist()):
        gathered += w
        if gathered >= APART:
            cuts.append(i + 1)
            gathered = 0.0
    if len(cuts) == 1:
        return [0, len(width)]
    cuts[-1] = len(width)
    return cuts


def _widths(
    plan: FanPlan, views: FloatArray, counts: tuple[int, int, int], shape: tuple[int, int]
) -> FloatArray:
    """How wide each job is where the box is nearest to the source [voxels], (k,)."""
    view, first, last = plan.jobs.T
    r = (shape[0] - 1) / 2
    of = views[view]

    def towards(line: IntArray) -> FloatArray:
        c = plan.lines[line, 0] + plan.lines[line, 1] * r
        flat = of[:, 3:5] + c[:, None] * of[:, 6:8] + r * of[:, 9:11]
        return np.asarray(flat / np.linalg.norm(flat, axis=1)[:, None])

    a, b = towards(first), towards(last)
    sine = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    source = of[:, :2]
    outside = source - np.clip(source, 0.0, np.array(counts[:2], dtype=np.float64))
    return np.asarray(np.linalg.norm(outside, axis=1) * sine)
