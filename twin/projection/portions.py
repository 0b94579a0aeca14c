"""Work in portions of a fraction of a second, so that Python hears Ctrl-C between two of them.

A compiled kernel does not return before its work is done. Its jobs are therefore given to it in
ranges whose estimated time is a quarter of a second. Estimates are of one thread of a present
processor, in nanoseconds; a portion is at least one job. Results do not depend on portions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

IntArray = npt.NDArray[np.int64]

PORTION_NS = 2.5e8
"""Estimated time of a portion, of all threads together."""
LEVEL_NS = (0.2, 1.5)
"""A fan at a level of a slab: of a detector whose columns are parallel to z, and of others."""
CROSSING_NS = 100.0
"""A ray of a fan: where it crosses levels, its place in the image."""
VOXEL_NS = 4.0
"""A ray on its own, in each voxel."""
PASS_NS = 3.0
"""A pass over a volume, at each voxel."""


def equal_portions(count: int, job_ns: float, threads: int) -> Iterator[tuple[int, int]]:
    """Ranges (first, last) of `count` jobs that take `job_ns` each."""
    step = max(1, int(PORTION_NS * threads / max(job_ns, 1e-3)))
    for first in range(0, count, step):
        yield first, min(first + step, count)


def layer_portions(volume: Float32Array) -> Iterator[tuple[int, int]]:
    """Ranges (first, last) of layers of volume (nz, ny, nx) for a pass over it."""
    _, ny, nx = volume.shape
    return equal_portions(len(volume), PASS_NS * ny * nx, 1)


def portions(job_ns: FloatArray, threads: int) -> Iterator[tuple[int, int]]:
    """Ranges (first, last) of jobs whose times are `job_ns` (n,)."""
    ends = np.cumsum(job_ns)
    first, most = 0, PORTION_NS * threads
    while first < len(ends):
        before = ends[first - 1] if first else 0.0
        last = max(first + 1, int(np.searchsorted(ends, before + most, side="right")))
        yield first, last
        first = last


def turn_portions(turns: IntArray, unit_ns: FloatArray, threads: int) -> Iterator[IntArray]:
    """The rows of `fan_plan.Turns.turns` in portions.

    Args:
        turns: (k, 2) ranges of units, one after the other; the units of a turn may be cut apart.
        unit_ns: of each unit.
        threads: that share the work.
    """
    for first, last in portions(unit_ns, threads):
        inside = np.clip(turns, first, last)
        yield inside[inside[:, 0] < inside[:, 1]]


def ray_ns(counts: tuple[int, int, int]) -> float:
    """Time of a ray on its own through a box of `counts` voxels."""
    return VOXEL_NS * sum(counts)


def fan_job_ns(
    lines: FloatArray,
    jobs: IntArray,
    views: FloatArray,
    counts: tuple[int, int, int],
    pixels: tuple[int, int],
) -> FloatArray:
    """Times of the jobs of a plan (k,).

    Args:
        lines: (m, 2) fan boundaries c = a + b r.
        jobs: (k, 3) view, first line, last line.
        views: (n, 12) source, first pixel minus source, u, v in voxel units.
        counts: voxels of the box.
        pixels: rows of the image, and columns of the widest job.
    """
    nx, ny, nz = counts
    level = LEVEL_NS[int(bool(lines[:, 1].any()))]
    fans = (jobs[:, 2] - jobs[:, 1]) * (nx + ny) * nz * level
    source = views[jobs[:, 0], :3]
    inside = ((source >= 0) & (source <= np.array(counts))).all(axis=1)
    rays = pixels[0] * pixels[1] * np.where(inside, ray_ns(counts), CROSSING_NS)
    return np.asarray(fans + rays)
