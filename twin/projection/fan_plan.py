"""Which rays may travel together: cuts each view's detector into fans for `fan_kernels`.

A fan is what lies between two lines of the detector that are images of planes through the source
parallel to z; it is at most so wide that its rays stay within one voxel of each other in x and y.
Views in which z is seen (nearly) end on have no fans. Pure geometry: no voxels are touched.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.conventions import FloatArray
from flexdt.twin.projection.fan_types import Fans

IntArray = npt.NDArray[np.int64]

FANS = 16
"""Fans a job: their columns fill whole cache lines of the image."""
SPREAD = 0.9
"""Largest lateral spread of a fan [voxels]: less than one, as the kernel's corrections demand."""
WIDEST = 4.0
"""Widest fan [columns]."""
FACING = 0.25
"""Least cosine between any ray and the view's horizontal direction for the view to have fans."""
APART = 0.25
"""Least distance of two fan boundaries in any row, as a share of that in the middle row."""
LEVEL = 1e-12
"""Detector columns whose ends are nearer than this [voxels] in x and y are parallel to z."""


@dataclass(frozen=True, eq=False)
class FanPlan:
    """Fans of several views.

    Attributes:
        lines: (m, 2) boundaries c = a + b r.
        jobs: (k, 3) view, first line, last line; neighbouring lines enclose a fan.
        room: bound on the rays of a fan.
        widest: bound on the columns of a job in any row.
        alone: indices of the views that have no fans.
    """

    lines: FloatArray
    jobs: IntArray
    room: int
    widest: int
    alone: IntArray

    def fans(self, views: FloatArray) -> Fans:
        """The plan of `views` (n, 12) as the kernels take it."""
        return Fans(views, self.lines, self.jobs, self.room, self.widest)


def plan_fans(views: FloatArray, counts: tuple[int, int, int], shape: tuple[int, int]) -> FanPlan:
    """Cut views into fans.

    Args:
        views: (n, 12) source, first pixel centre minus source, u, v in voxel units of the box.
        counts: (nx, ny, nz) voxels of the box.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    source, first, u, v = (views[:, i : i + 3] for i in (0, 3, 6, 9))
    corners = np.stack(
        [first + c * u + r * v for r in (0, rows - 1) for c in (0, cols - 1)], axis=1
    )
    middle = corners.mean(axis=1)
    # The middle row's pixels, along + b u, number the vertical planes by the column b they pass.
    along = first + (rows - 1) / 2 * v
    with np.errstate(all="ignore"):
        ahead = middle[:, :2] / np.linalg.norm(middle[:, :2], axis=1, keepdims=True)
        cosine = np.einsum("nki,ni->nk", corners[:, :, :2], ahead) / np.linalg.norm(corners, axis=2)
        meeting = -_cross(along[:, None], corners) / _cross(u[:, None], corners)
        slope = _cross(v, middle) / _cross(u, middle)
        step = _step(source, u, np.concatenate([corners, middle[:, None]], axis=1), counts)
        # All boundaries meet where z is seen end on; in rows from there to the middle they spread.
        pole = -_cross(u, first) / _cross(u, v)
        apart = (np.array([[0], [rows - 1]]) - pole) / ((rows - 1) / 2 - pole)
    good = (cosine >= FACING).all(axis=1) & np.isfinite(meeting).all(axis=1) & (np.abs(slope) <= 1)
    good &= ~(apart < APART).any(axis=0)
    level = np.abs(v[:, :2]).max(axis=1) * rows < LEVEL
    step = np.where(level, 1.0, step)
    meeting = np.where(good[:, None], meeting, 0.0)
    begin = np.where(level, -0.5, meeting.min(axis=1) - 0.5)
    end = np.where(level, cols - 0.5, meeting.max(axis=1) + 0.5)
    good &= (end - begin) / step < 64 * (rows + cols)
    use = np.flatnonzero(good)
    fans = np.maximum(np.ceil((end - begin)[use] / step[use]), 1).astype(np.int64)
    view = np.repeat(use, fans + 1)
    number = np.concatenate([np.arange(n + 1) for n in fans]) if len(use) else np.zeros(0, np.int64)
    b = begin[view] + (end - begin)[view] * number / np.repeat(fans, fans + 1)
    direction = along[view] + b[:, None] * u[view]
    across = _cross(u[view], direction)
    flat = level[view]
    lines = np.column_stack(
        [
            np.where(flat, b, -_cross(first[view], direction) / across),
            np.where(flat, 0.0, -_cross(v[view], direction) / across),
        ]
    )
    offsets = np.concatenate([[0], np.cumsum(fans + 1)])
    jobs = [
        (n, int(start) + i, int(start) + min(int(count), i + FANS))
        for n, start, count in zip(use, offsets, fans, strict=False)
        for i in range(0, int(count), FANS)
    ]
    table = np.array(jobs, np.int64).reshape(-1, 3)
    gaps = _widths(lines[1:] - lines[:-1], rows)[view[1:] == view[:-1]] if len(use) else np.zeros(1)
    widths = _widths(lines[table[:, 2]] - lines[table[:, 1]], rows) if len(use) else np.zeros(1)
    return FanPlan(
        lines=np.ascontiguousarray(lines),
        jobs=table,
        room=rows * min(cols, int(np.ceil(gaps.max())) + 1),
        widest=min(cols, int(np.ceil(widths.max())) + 1),
        alone=np.flatnonzero(~good),
    )


def _step(
    source: FloatArray, u: FloatArray, rays: FloatArray, counts: tuple[int, int, int]
) -> FloatArray:
    """Columns a fan may span so that its rays stay within SPREAD voxels of each other."""
    ends = np.array([[x, y] for x in (0, counts[0]) for y in (0, counts[1])], dtype=np.float64)
    far = np.linalg.norm(ends - source[:, None, :2], axis=2).max(axis=1)
    turn = np.abs(_cross(rays, u[:, None])) / np.einsum("nki,nki->nk", rays[..., :2], rays[..., :2])
    # The spread is measured along a voxel axis, up to sqrt(2) times that across the ray.
    flat = np.abs(rays[..., :2])
    slant = np.linalg.norm(flat, axis=2) / flat.max(axis=2)
    widest = (slant * turn).max(axis=1) * far
    return np.asarray(np.minimum(WIDEST, SPREAD / widest))


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """z component of a x b."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def _widths(gap: FloatArray, rows: int) -> FloatArray:
    """Largest |a + b r| over the rows."""
    return np.maximum(np.abs(gap[:, 0]), np.abs(gap[:, 0] + gap[:, 1] * (rows - 1)))
