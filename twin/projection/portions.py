"""Cut work into portions of a fraction of a second, between which Python handles Ctrl-C.

A compiled kernel does not return before its work is done. Its jobs are therefore given to
it in ranges whose estimated time is a quarter of a second. Estimates are of one thread of
a present processor, in nanoseconds; a portion is at least one job. Results do not depend
on portions.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

IntArray = npt.NDArray[np.int64]

PORTION_NS = 2.5e8
"""Estimated time of a portion, summed over all threads [ns]."""
LEVEL_NS = (0.2, 1.5)
"""Time of a fan at a level of a slab [ns]: detector columns parallel to z, and others."""
CROSSING_NS = 100.0
"""Time for a ray of a fan to cross levels and to be found in the image [ns]."""
VOXEL_NS = 4.0
"""Time of a single ray in one voxel [ns]."""
PASS_NS = 3.0
"""Time of a pass over a volume, per voxel [ns]."""


def equal_portions(count: int, job_ns: float, threads: int) -> Iterator[tuple[int, int]]:
    """Yield ranges (first, last) of `count` jobs that take `job_ns` each."""
    step = max(1, int(PORTION_NS * threads / max(job_ns, 1e-3)))
    for first in range(0, count, step):
        yield first, min(first + step, count)


def layer_portions(volume: Float32Array) -> Iterator[tuple[int, int]]:
    """Yield ranges (first, last) of layers of volume (nz, ny, nx) for a pass over it."""
    _, ny, nx = volume.shape
    return equal_portions(len(volume), PASS_NS * ny * nx, 1)


def portions(job_ns: FloatArray, threads: int) -> Iterator[tuple[int, int]]:
    """Yield consecutive ranges (first, last) of jobs, each of about `PORTION_NS` for each
    thread, but of at least one job.

    Args:
        job_ns: (n,) times of the jobs on one thread [ns].
        threads: that work at once.
    """
    ends = np.cumsum(job_ns)
    first = 0
    most = PORTION_NS * threads
    while first < len(ends):
        before = ends[first - 1] if first else 0.0
        last = max(first + 1, int(np.searchsorted(ends, before + most, side="right")))
        yield first, last
        first = last


def turn_portions(
    turns: IntArray, unit_ns: FloatArray, threads: int
) -> Iterator[IntArray]:
    """Yield `fan_plan.Turns.turns` (k, 2) in portions, ranges cut between units.

    Each takes `unit_ns`.
    """
    for first, last in portions(unit_ns, threads):
        inside = np.clip(turns, first, last)
        yield inside[inside[:, 0] < inside[:, 1]]


def ray_ns(counts: tuple[int, int, int]) -> float:
    """Estimate the time of a single ray through a box of `counts` voxels [ns]."""
    return VOXEL_NS * sum(counts)


def fan_job_ns(
    lines: FloatArray,
    jobs: IntArray,
    views: FloatArray,
    counts: tuple[int, int, int],
    pixels: tuple[int, int],
) -> FloatArray:
    """Estimate the times of k jobs on one thread [ns], (k,).

    Rays of a source inside the box are walked one by one. `lines`: (m, 2) fan boundaries;
    `jobs`: (k, 3) view, first, last line; `views`: (n, 12) rays in voxels; `pixels`:
    rows, and columns of the widest job.
    """
    nx, ny, nz = counts
    level = LEVEL_NS[int(bool(lines[:, 1].any()))]
    fans = (jobs[:, 2] - jobs[:, 1]) * (nx + ny) * nz * level
    source = views[jobs[:, 0], :3]
    inside = ((source >= 0) & (source <= np.array(counts))).all(axis=1)
    rays = pixels[0] * pixels[1] * np.where(inside, ray_ns(counts), CROSSING_NS)
    return np.asarray(fans + rays)
