"""Voxel-driven backprojection with FDK's weights for upright panels.

All voxels above one another fall on one line of detector columns, so a column of the image is
interpolated once and every voxel costs one look-up between two rows. Compiled; it refuses to check
its arguments.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

from flexdt.twin.projection.kernel_tools import fetch_next, fused, kernel, parallel, sources
from flexdt.twin.reconstruction import resample_kernels
from flexdt.twin.reconstruction.resample_kernels import (
    MARGIN,
    add_line,
    add_line_wide,
    has_wide_permute,
)

TILE = 8


@fused
def _mix(out, left, right, part):
    """out = left + part * (right - left)."""
    for r in range(out.size):
        out[r] = left[r] + part * (right[r] - left[r])


@kernel
def _add_view(acc, image, g, x, y, z0, dz, line, wide):
    """Add one view to the voxels above one another at (x, y); see `backproject`."""
    cols, rows = image.shape
    x -= g[0]
    y -= g[1]
    depth = x * g[3] + y * g[4]
    if depth <= 0.0:
        return
    inverse = 1.0 / depth
    c = g[8] + (x * g[5] + y * g[6]) * inverse * g[7]
    if c < 0.0 or c > cols - 1:
        return
    i = min(int(c), cols - 2)
    step = -dz * g[9] * inverse
    start = g[10] - (z0 - g[2]) * g[9] * inverse
    # rows fall with z: 0 <= start + k step <= rows - 1
    every = 1.0 / step
    lowest = max(0, math.ceil((rows - 1 - start) * every + 1e-3))
    highest = min(acc.size - 1, math.floor(-start * every - 1e-3))
    if highest < lowest:
        return
    top = int(start + highest * step)
    bottom = min(rows - 1, int(start + lowest * step) + 1)
    _mix(
        line[: bottom - top + 1],
        image[i, top : bottom + 1],
        image[i + 1, top : bottom + 1],
        np.float32(c - i),
    )
    line[bottom - top + 1] = line[bottom - top]
    first = start + lowest * step - top
    weight = np.float32(inverse * inverse)
    if wide:
        add_line_wide(acc, line, lowest, highest - lowest + 1, first, step, weight)
    else:
        add_line(acc, line, lowest, highest - lowest + 1, first, step, weight)


@kernel
def _add_tile(images, views, first_x, first_y, x0, y0, z0, dx, dy, dz, line, volume, wide):
    """Add all views to one tile of voxel columns."""
    ny, nx = volume.shape[:2]
    for view in range(len(images)):
        g = views[view]
        for iy in range(first_y, min(ny, first_y + TILE)):
            y = y0 + iy * dy
            for ix in range(first_x, min(nx, first_x + TILE)):
                _add_view(volume[iy, ix], images[view], g, x0 + ix * dx, y, z0, dz, line, wide)


def _entry_point(key: int, wide: bool):  # type: ignore[no-untyped-def]
    @parallel
    def backproject(images, views, x0, y0, z0, dx, dy, dz, volume, workers):
        """Add views to a volume.

        images: float32 (n, cols, rows), rows contiguous.
        views: float64 (n, 11): source x, y, z; unit normal x, y; unit u x, y; distance in pitches
            of columns; column of the foot point; distance in pitches of rows; row of the foot
            point.
        x0..dz: centre of the first voxel and steps [mm].
        volume: float32 (ny, nx, nz), added to; a value counts with 1 / depth^2.
        workers: threads.
        """
        _ = key
        ny, nx = volume.shape[:2]
        tiles_x = (nx + TILE - 1) // TILE
        tiles = tiles_x * ((ny + TILE - 1) // TILE)
        counter = np.zeros(1, np.int64)
        for _ in prange(workers):
            line = np.zeros(images.shape[2] + 2 + MARGIN, np.float32)
            tile = fetch_next(counter)
            while tile < tiles:
                across, along = tile % tiles_x * TILE, tile // tiles_x * TILE
                _add_tile(images, views, across, along, x0, y0, z0, dx, dy, dz, line, volume, wide)
                tile = fetch_next(counter)

    return backproject


backproject = _entry_point(sources(resample_kernels), has_wide_permute())


@njit(cache=True, error_model="numpy")
def _cubic(t):
    """Weights of four samples at -1, 0, 1, 2 for a point at t (Catmull and Rom; Keys 1981)."""
    t2 = t * t
    t3 = t2 * t
    return (
        0.5 * (-t3 + 2.0 * t2 - t),
        0.5 * (3.0 * t3 - 5.0 * t2 + 2.0),
        0.5 * (-3.0 * t3 + 4.0 * t2 + t),
        0.5 * (t3 - t2),
    )


@njit(cache=True, parallel=True, error_model="numpy")
def warp(images, maps, out):
    """out[n, r, c] = images[n] at maps[n] @ (c, r, 1), bicubic; edges go on as their last pixel."""
    n, rows, cols = out.shape
    for job in prange(n * rows):
        view = job // rows
        r = job % rows
        h = maps[view]
        image = images[view]
        for c in range(cols):
            scale = 1.0 / (h[2, 0] * c + h[2, 1] * r + h[2, 2])
            x = (h[0, 0] * c + h[0, 1] * r + h[0, 2]) * scale
            y = (h[1, 0] * c + h[1, 1] * r + h[1, 2]) * scale
            x = min(max(x, 0.0), cols - 1.0)
            y = min(max(y, 0.0), rows - 1.0)
            i = int(x)
            j = int(y)
            wx = _cubic(x - i)
            wy = _cubic(y - j)
            total = 0.0
            for b in range(4):
                row = image[min(max(j + b - 1, 0), rows - 1)]
                line = 0.0
                for a in range(4):
                    line += wx[a] * row[min(max(i + a - 1, 0), cols - 1)]
                total += wy[b] * line
            out[view, r, c] = total
