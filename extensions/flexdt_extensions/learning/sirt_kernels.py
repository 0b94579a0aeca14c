"""SIRT of many small objects at once, each with views of its own out of one table of rays."""

from __future__ import annotations

import numpy as np
from numba import prange

from flexdt.measuring import parallel

# mypy: disable-error-code="no-untyped-def,untyped-decorator"


@parallel
def solve(
    first,
    voxel,
    length,
    rows,
    columns,
    taken,
    counts,
    images,
    volumes,
    iterations,
    smallest,
):
    """Improve volumes by SIRT, in place, all objects in parallel; values stay at least 0.

    Args:
        first: (views, rays + 1) index into `voxel` and `length` at which each ray begins.
        voxel: indices of voxels, ray after ray.
        length: of the rays in these voxels [mm].
        rows: (views, rays) sums of lengths.
        columns: (views, voxels) sums of lengths.
        taken: (objects, frames) views; the first `counts` hold.
        counts: (objects,) numbers of frames.
        images: (objects, frames, rays) line integrals.
        volumes: (objects, voxels) improved in place.
        iterations: number of iterations.
        smallest: share of the largest sum; a smaller sum is not divided by.

    Returns:
        (objects,) sums of squared residuals of the results.
    """
    rays = rows.shape[1]
    squares = np.zeros(len(counts))
    for k in prange(len(counts)):
        x = volumes[k]
        weight = np.zeros(x.size, np.float32)
        longest = np.float32(0)
        for i in range(counts[k]):
            weight += columns[taken[k, i]]
            longest = max(longest, rows[taken[k, i]].max())
        least = smallest * weight.max()
        for j in range(x.size):
            weight[j] = np.float32(1) / weight[j] if weight[j] > least else np.float32(0)
        step = np.empty(x.size, np.float32)
        for iteration in range(iterations + 1):
            step[:] = 0
            square = 0.0
            for i in range(counts[k]):
                view = taken[k, i]
                for ray in range(rays):
                    begin = first[view, ray]
                    end = first[view, ray + 1]
                    total = np.float32(0)
                    for p in range(begin, end):
                        total += length[p] * x[voxel[p]]
                    rest = images[k, i, ray] - total
                    square += rest * rest
                    if rows[view, ray] > smallest * longest:
                        rest /= rows[view, ray]
                        for p in range(begin, end):
                            step[voxel[p]] += length[p] * rest
            if iteration == iterations:
                squares[k] = square
            else:
                for j in range(x.size):
                    x[j] = max(x[j] + weight[j] * step[j], np.float32(0))
    return squares
