"""The fans of a view: groups of rays that may travel together, for `fan_kernels`.

A fan is the area between two lines of the detector that are images of planes through the
source parallel to z; its width is bounded so that its rays stay within one voxel of each
other in x and y. Views in which z is seen (nearly) end on have no fans. Pure geometry: no
voxels are touched.

For the transpose, `Turns` says which fans may add to the voxels at the same time. Seen along z
a fan is a wedge with its point in the source. Neighboring fans share voxel columns, fans with
enough others between them share none. So the jobs of a view are gathered into units, and first
all even units are worked on, each by one thread, then all odd ones: no locks, no second copy of
the volume, and sums in the same order every time. Where wedges are too narrow for that (source
close to the volume), threads share out the range of z instead. The drawing in
docs/performance.md shows units and turns.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection.kernels.fan_types import Fans

IntArray = npt.NDArray[np.int64]

FANS_A_JOB = 16
"""Fans in a job: their columns fill whole cache lines of the image."""
MAX_SPREAD_VOXELS = 0.9
"""Largest lateral spread of a fan [voxels]: less than one, as the kernel's corrections
demand."""
MAX_FAN_COLUMNS = 4.0
"""Widest fan [columns]."""
MIN_FACING_COSINE = 0.25
"""Least cosine between any ray and the view's horizontal direction for the view to have
fans."""
MIN_GAP_SHARE = 0.25
"""Least distance of two fan boundaries in any row, as a share of that in the middle
row."""
MAX_FANS_A_PIXEL_LINE = 64
"""Largest number of fans of a view, per row and column of the detector."""
EXCHANGED = [0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8]
"""Order of a view's numbers (source, first pixel minus source, u, v) with u and v
exchanged."""
MAX_LEVEL_OFFSET_VOXELS = 1e-12
"""Largest distance in x and y of the ends of a detector column parallel to z [voxels]."""
MIN_UNIT_WIDTH = 8.0
"""Least width of a unit where it enters the volume [voxels]. A fan reaches at most two
voxel columns beyond its own lines, and so does its second neighbor."""


def lying(views: FloatArray, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Find views in which images of vertical planes follow the rows more than the columns.

    `views`: (n, 12) source, first pixel minus source, u, v in voxel units; `shape`: detector
    (rows, cols).
    Returns (n,) bool.
    """
    rows, cols = shape
    first, u, v = (views[:, i : i + 3] for i in (3, 6, 9))
    middle = first + (cols - 1) / 2 * u + (rows - 1) / 2 * v

    def across(a: FloatArray) -> FloatArray:
        return np.asarray(np.abs(a[:, 0] * middle[:, 1] - a[:, 1] * middle[:, 0]))

    return np.asarray(across(v) > across(u))


def exchanged(views: FloatArray) -> FloatArray:
    """Exchange the rays' rows and columns."""
    return np.ascontiguousarray(views[:, EXCHANGED])


@dataclass(frozen=True, eq=False)
class FanPlan:
    """Fans of several views.

    Attributes:
        lines: (m, 2) boundaries c = a + b r.
        jobs: (k, 3) view, first line, last line; neighboring lines enclose a fan.
        room: bound on the rays of a fan.
        widest: bound on the columns of a job in any row.
        alone: indices of the views that have no fans.
    """

    lines: FloatArray
    jobs: IntArray
    room: int
    widest: int
    alone: IntArray

    def fans(self, views: FloatArray, some: slice = slice(None)) -> Fans:
        """Return the plan of `views` (n, 12), or `some` jobs, as `Fans`."""
        return Fans(views, self.lines, self.jobs[some], self.room, self.widest)


def plan_fans(
    views: FloatArray, counts: tuple[int, int, int], shape: tuple[int, int], side: int = 1
) -> FanPlan:
    """Cut views into fans.

    Of level views, whose columns are parallel to z, each column is a fan; the others are
    cut as `_plan_tilted`. A view that has a corner whose ray is more than
    `MIN_FACING_COSINE` (a cosine, seen along z) off the panel's middle, or that tilts too
    much, gets no fans: `alone` lists it.

    Args:
        views: (n, 12) source, first pixel center minus source, u, v in voxel units of the
            box.
        counts: (nx, ny, nz) voxels of the box.
        shape: detector (rows, cols), of rays.
        side: rays along each side of a pixel. With several a job has whole pixels, and views
            whose fans are no columns have none.
    """
    rows, cols = shape
    first, u, v = (views[:, i : i + 3] for i in (3, 6, 9))
    corners = first[:, None] + np.array([0, cols - 1, 0, cols - 1])[:, None] * u[:, None]
    corners += np.array([0, 0, rows - 1, rows - 1])[:, None] * v[:, None]
    flat = corners[:, :, :2]
    ahead = flat.mean(axis=1)
    # cosine >= MIN_FACING_COSINE for all corners, without roots of zero
    along = np.einsum("nki,ni->nk", flat, ahead)
    size = (
        np.einsum("nki,nki->nk", corners, corners)
        * np.einsum("ni,ni->n", ahead, ahead)[:, None]
    )
    facing = ((along > 0) & (along**2 >= MIN_FACING_COSINE**2 * size)).all(axis=1)
    level = np.abs(v[:, :2]).max(axis=1) * rows < MAX_LEVEL_OFFSET_VOXELS
    parts = [_plan_level(np.flatnonzero(facing & level), shape, side)]
    tilted = np.flatnonzero(facing & ~level)
    if len(tilted) and side == 1:
        parts.append(_plan_tilted(tilted, views[tilted], corners[tilted], counts, shape))
    shift = len(parts[0].lines) * np.array([0, 1, 1])
    done = np.concatenate([part.jobs[:, 0] for part in parts])
    alone = np.ones(len(views), np.bool_)
    alone[done] = False
    return FanPlan(
        lines=np.ascontiguousarray(np.concatenate([part.lines for part in parts])),
        jobs=np.concatenate([part.jobs + i * shift for i, part in enumerate(parts)]),
        room=max(part.room for part in parts),
        widest=max(part.widest for part in parts),
        alone=np.flatnonzero(alone),
    )


def _plan_level(chosen: IntArray, shape: tuple[int, int], side: int) -> FanPlan:
    """Plan views with detector columns parallel to z: each column is a fan, in all views.

    Args:
        chosen: (n,) numbers of these views.
        shape: the detector's (rows, cols), of rays.
        side: rays along each side of a pixel.
    """
    rows, cols = shape
    edges = np.arange(cols + 1) - 0.5
    fans = side * max(1, FANS_A_JOB // side)
    starts = np.arange(0, cols, fans)
    jobs = np.empty((len(chosen), len(starts), 3), np.int64)
    jobs[:, :, 0] = chosen[:, None]
    jobs[:, :, 1] = starts
    jobs[:, :, 2] = np.minimum(starts + fans, cols)
    lines = np.column_stack([edges, np.zeros(cols + 1)])
    return FanPlan(lines, jobs.reshape(-1, 3), rows, min(cols, fans), chosen)


def _plan_tilted(
    chosen: IntArray,
    views: FloatArray,
    corners: FloatArray,
    counts: tuple[int, int, int],
    shape: tuple[int, int],
) -> FanPlan:
    """Plan fans between images of vertical planes for the `chosen` views that can have
    them.

    `alone` lists those that cannot: planes seen more than 45 degrees off the columns, a
    pole closer than `MIN_GAP_SHARE` to the panel, or more fans than
    `MAX_FANS_A_PIXEL_LINE` times rows and columns.

    Args:
        chosen: indices of views.
        views: (n, 12) in voxel units of the box.
        corners: rays to the detector's corners.
        counts: (nx, ny, nz) voxels of the box.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    first, u, v = (views[:, i : i + 3] for i in (3, 6, 9))
    middle = corners.mean(axis=1)
    # The middle row's pixels, along + b u, number the vertical planes by the column b they
    # pass.
    along = first + (rows - 1) / 2 * v
    with np.errstate(all="ignore"):
        meeting = -_cross(along[:, None], corners) / _cross(u[:, None], corners)
        slope = _cross(v, middle) / _cross(u, middle)
        rays = np.concatenate([corners, middle[:, None]], axis=1)
        step = _fan_columns(views[:, 0:3], u, rays, counts)
        # All boundaries meet where z is seen end on; in rows from there to the middle they
        # spread.
        pole = -_cross(u, first) / _cross(u, v)
        apart = (np.array([[0], [rows - 1]]) - pole) / ((rows - 1) / 2 - pole)
        good = np.isfinite(meeting).all(axis=1) & (np.abs(slope) <= 1)
        good &= ~(apart < MIN_GAP_SHARE).any(axis=0)
        begin = meeting.min(axis=1) - 0.5
        end = meeting.max(axis=1) + 0.5
        good &= (end - begin) / step < MAX_FANS_A_PIXEL_LINE * (rows + cols)
    use = np.flatnonzero(good)
    begin = begin[use]
    end = end[use]
    along = along[use]
    first = first[use]
    u = u[use]
    v = v[use]
    fans = np.maximum(np.ceil((end - begin) / step[use]), 1).astype(np.int64)
    view, number = _expand_counts(fans + 1)
    b = begin[view] + (end - begin)[view] * number / fans[view]
    direction = along[view] + b[:, None] * u[view]
    across = _cross(u[view], direction)
    lines = np.column_stack(
        [-_cross(first[view], direction) / across, -_cross(v[view], direction) / across]
    )
    starts = np.concatenate([[0], np.cumsum(fans + 1)[:-1]])
    of, part = _expand_counts(-(-fans // FANS_A_JOB))
    begins = part * FANS_A_JOB
    ends = np.minimum(begins + FANS_A_JOB, fans[of])
    jobs = np.column_stack([chosen[use[of]], starts[of] + begins, starts[of] + ends])
    gaps = _widths((lines[1:] - lines[:-1])[view[1:] == view[:-1]], rows)
    widths = _widths(lines[jobs[:, 2]] - lines[jobs[:, 1]], rows)
    return FanPlan(
        lines=lines,
        jobs=jobs.astype(np.int64),
        room=rows * min(cols, int(np.ceil(gaps.max(initial=0.0))) + 1),
        widest=min(cols, int(np.ceil(widths.max(initial=0.0))) + 1),
        alone=chosen[~good],
    )


def _expand_counts(counts: IntArray) -> tuple[IntArray, IntArray]:
    """Expand counts to owners and positions: (2, 3) gives (0, 0, 1, 1, 1) and (0, 1, 0,
    1, 2).
    """
    group = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return group, np.arange(len(group)) - starts[group]


def _fan_columns(
    source: FloatArray, u: FloatArray, rays: FloatArray, counts: tuple[int, int, int]
) -> FloatArray:
    """Compute the columns a fan may span so that its rays stay within `MAX_SPREAD_VOXELS`.

    Args:
        source: (n, 3) [voxels].
        u: (n, 3) step of a column.
        rays: (n, k, 3) directions of k rays of each view.
        counts: the box's voxels along x, y and z.

    Returns (n,) columns, at most `MAX_FAN_COLUMNS`.
    """
    ends = np.array(
        [[x, y] for x in (0, counts[0]) for y in (0, counts[1])], dtype=np.float64
    )
    far = np.linalg.norm(ends - source[:, None, :2], axis=2).max(axis=1)
    turn = np.abs(_cross(rays, u[:, None])) / np.einsum(
        "nki,nki->nk", rays[..., :2], rays[..., :2]
    )
    # The spread is measured along a voxel axis, up to sqrt(2) times that across the ray.
    flat = np.abs(rays[..., :2])
    slant = np.linalg.norm(flat, axis=2) / flat.max(axis=2)
    widest = (slant * turn).max(axis=1) * far
    return np.asarray(np.minimum(MAX_FAN_COLUMNS, MAX_SPREAD_VOXELS / widest))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute the z component of a x b."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _widths(gap: FloatArray, rows: int) -> FloatArray:
    """Compute the largest |a + b r| over the rows."""
    return np.maximum(np.abs(gap[:, 0]), np.abs(gap[:, 0] + gap[:, 1] * (rows - 1)))


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
    """Order the jobs of a plan so that threads never add to the same voxel at a time.

    The jobs of a view are gathered to units at least `MIN_UNIT_WIDTH` voxels wide; every
    second unit is of one turn, the rest of the next. Neighboring views with fewer than
    three units, and all with one worker, are one unit for one thread.

    Args:
        plan: of these views.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box.
        counts: (nx, ny, nz) voxels of the box.
        shape: detector (rows, cols).
        workers: threads.

    Returns:
        Turns (ranges of units), units (ranges of jobs), and into how many slices of z the
        box must be cut to occupy all threads; empty ranges without jobs.
    """
    jobs = plan.jobs
    none = np.zeros((0, 2), np.int64)
    if len(jobs) == 0:
        return Turns(none, none, workers)
    width = _image_widths(plan, views, counts, shape)
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
            alone = True
            fewest = 1
            continue
        alone = False
        pairs = [(first + a, first + b) for a, b in pairwise(cuts)]
        for half in (pairs[0::2], pairs[1::2]):
            turns.append((len(units), len(units) + len(half)))
            units.extend(half)
        fewest = min(fewest, len(pairs) // 2)
    return Turns(np.array(turns), np.array(units), -(-workers // fewest))


def _cuts(width: FloatArray) -> list[int]:
    """List bounds of runs of jobs that are at least MIN_UNIT_WIDTH wide together,
    beginning with 0 and ending with the number of jobs; a remainder joins the last run.
    """
    cuts = [0]
    gathered = 0.0
    for i, w in enumerate(width.tolist()):
        gathered += w
        if gathered >= MIN_UNIT_WIDTH:
            cuts.append(i + 1)
            gathered = 0.0
    if len(cuts) == 1:
        return [0, len(width)]
    cuts[-1] = len(width)
    return cuts


def _image_widths(
    plan: FanPlan, views: FloatArray, counts: tuple[int, int, int], shape: tuple[int, int]
) -> FloatArray:
    """Compute each job's width where the box is nearest to the source.

    Args:
        plan: k jobs.
        views: (n, 12) rays in voxels.
        counts: the box's voxels along x, y and z.
        shape: the detector's (rows, cols).

    Returns:
        (k,) [voxels]; 0 with a source inside the box.
    """
    view, first, last = plan.jobs.T
    r = (shape[0] - 1) / 2
    of = views[view]

    def directions_to(line: IntArray) -> FloatArray:
        c = plan.lines[line, 0] + plan.lines[line, 1] * r
        flat = of[:, 3:5] + c[:, None] * of[:, 6:8] + r * of[:, 9:11]
        return np.asarray(flat / np.linalg.norm(flat, axis=1)[:, None])

    a = directions_to(first)
    b = directions_to(last)
    sine = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    source = of[:, :2]
    outside = source - np.clip(source, 0.0, np.array(counts[:2], dtype=np.float64))
    return np.asarray(np.linalg.norm(outside, axis=1) * sine)
