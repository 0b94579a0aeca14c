"""SIRT of many small objects at once, each with views of its own out of one table of rays."""

from __future__ import annotations

import numpy as np
from numba import prange

from flexdt.measuring import parallel

# mypy: disable-error-code="no-untyped-def,untyped-decorator"


@parallel
def solve(
    first, voxel, length, rows, columns, taken, counts, images, volumes, iterations, smallest
):
    """Improve volumes (objects, voxels) in place; returns each object's sum of squared residuals.

    first (views, rays + 1): where the voxels and lengths [mm] of each ray begin; rows (views, rays)
    and columns (views, voxels): sums of lengths; taken (objects, frames): views, of which the
    first counts (objects,) hold; images (objects, frames, rays): line integrals; smallest: part of
    the largest sum below which sums are not divided by.
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
                    begin, end = first[view, ray], first[view, ray + 1]
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
