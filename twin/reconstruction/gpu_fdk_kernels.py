"""CUDA kernel: voxel-driven backprojection with FDK's weights, as the processor does it.

Neighbouring threads take voxels above one another, which are neighbours in memory and read
neighbouring rows of one detector column; what is common to a voxel column is computed once for RUN
voxels, in double precision. Imported only where a CUDA device (or numba's simulator of one) has
been found. Arguments are not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

BLOCK = (32, 4)
"""Threads a block: along z, and voxel columns along x."""
RUN = 8
"""Voxels a thread, BLOCK[0] apart along z."""


@cuda.jit
def backproject(images, views, first, size, volume):
    """Add views to a volume.

    images: float32 (n, cols, rows), rows contiguous.
    views: float64 (n, 11), as `fdk.view_table` makes them.
    first, size: centre of the first voxel and steps, (3,) x, y, z [mm].
    volume: float32 (ny, nx, nz), added to; a value counts with 1 / depth^2.
    """
    lane = cuda.threadIdx.x
    ix = cuda.blockIdx.y * BLOCK[1] + cuda.threadIdx.y
    iy = cuda.blockIdx.z
    ny, nx, nz = volume.shape
    if ix >= nx or iy >= ny:
        return
    n, cols, rows = images.shape
    begin = cuda.blockIdx.x * (BLOCK[0] * RUN) + lane
    acc = cuda.local.array(8, np.float32)
    for m in range(RUN):
        acc[m] = 0.0
    for view in range(n):
        # Depth, column and the row's line over k: common to the voxels of this column.
        x = first[0] + ix * size[0] - views[view, 0]
        y = first[1] + iy * size[1] - views[view, 1]
        depth = x * views[view, 3] + y * views[view, 4]
        if depth <= 0.0:
            continue
        inverse = 1.0 / depth
        c = views[view, 8] + (x * views[view, 5] + y * views[view, 6]) * inverse * views[view, 7]
        if c < 0.0 or c > cols - 1:
            continue
        i = max(min(int(c), cols - 2), 0)
        across = np.float32(c - i)
        step = -size[2] * views[view, 9] * inverse
        start = views[view, 10] - (first[2] - views[view, 2]) * views[view, 9] * inverse
        # Rows fall with z. The margin at the edges is that of the processor's kernel.
        every = 1.0 / step
        lowest = max(0, int(math.ceil((rows - 1 - start) * every + 1e-3)))  # noqa: RUF046
        highest = min(nz - 1, int(math.floor(-start * every - 1e-3)))  # noqa: RUF046
        weight = np.float32(inverse * inverse)
        for m in range(RUN):
            k = begin + m * BLOCK[0]
            if k < lowest or k > highest:
                continue
            at = start + k * step
            j = min(max(int(at), 0), rows - 1)
            down = np.float32(at - j)
            after = min(j + 1, rows - 1)
            low = images[view, i, j]
            low += across * (images[view, i + 1, j] - low)
            high = images[view, i, after]
            high += across * (images[view, i + 1, after] - high)
            acc[m] += weight * (low + down * (high - low))
    for m in range(RUN):
        k = begin + m * BLOCK[0]
        if k < nz:
            volume[iy, ix, k] += acc[m]
