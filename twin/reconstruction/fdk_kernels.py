"""Voxel-driven backprojection with FDK's weights for upright panels.

All voxels above one another fall on one line of detector columns, so a column of the image is
interpolated once and every voxel costs one look-up between two rows. Compiled; it refuses to check
its arguments.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit, prange

TILE = 8
FAST = {"contract", "nsz", "arcp", "nnan", "reassoc"}


@njit(cache=True, fastmath=FAST, error_model="numpy")
def _add_line(acc, line, first, count, start, step, weight):
    """acc[first + k] += weight * line(start + k step), linear between samples; all inside."""
    for k in range(count):
        at = start + np.float32(k) * step
        i = np.int32(at)
        part = at - np.float32(i)
        j = np.uint64(np.uint32(i))
        a = line[j]
        acc[first + k] += weight * (a + part * (line[j + np.uint64(1)] - a))


@njit(cache=True, parallel=True, fastmath=FAST, error_model="numpy")
def backproject(images, views, x0, y0, z0, dx, dy, dz, volume):
    """Add views to a volume.

    images: float32 (n, cols, rows), rows contiguous.
    views: float64 (n, 11): source x, y, z; unit normal x, y; unit u x, y; distance in pitches of
        columns; column of the foot point; distance in pitches of rows; row of the foot point.
    x0..dz: centre of the first voxel and steps [mm].
    volume: float32 (ny, nx, nz), added to; a value counts with 1 / depth^2.
    """
    n, cols, rows = images.shape
    ny, nx, nz = volume.shape
    tiles_x = (nx + TILE - 1) // TILE
    tiles_y = (ny + TILE - 1) // TILE
    for tile in prange(tiles_x * tiles_y):
        first_x = (tile % tiles_x) * TILE
        first_y = (tile // tiles_x) * TILE
        line = np.zeros(rows + 2, np.float32)
        for view in range(n):
            g = views[view]
            for iy in range(first_y, min(ny, first_y + TILE)):
                y = y0 + iy * dy - g[1]
                for ix in range(first_x, min(nx, first_x + TILE)):
                    x = x0 + ix * dx - g[0]
                    depth = x * g[3] + y * g[4]
                    if depth <= 0.0:
                        continue
                    across = (x * g[5] + y * g[6]) / depth
                    c = g[8] + across * g[7]
                    if c < 0.0 or c > cols - 1:
                        continue
                    i = min(int(c), cols - 2)
                    part = np.float32(c - i)
                    step = -dz * g[9] / depth
                    start = g[10] - (z0 - g[2]) * g[9] / depth
                    # rows fall with z: 0 <= start + k step <= rows - 1
                    lowest = max(0, math.ceil((rows - 1 - start) / step + 1e-3))
                    highest = min(nz - 1, math.floor(-start / step - 1e-3))
                    if highest < lowest:
                        continue
                    top = int(start + highest * step)
                    bottom = min(rows - 1, int(start + lowest * step) + 1)
                    left, right = images[view, i], images[view, i + 1]
                    for r in range(top, bottom + 1):
                        line[r - top] = left[r] + part * (right[r] - left[r])
                    line[bottom - top + 1] = line[bottom - top]
                    _add_line(
                        volume[iy, ix],
                        line,
                        lowest,
                        highest - lowest + 1,
                        np.float32(start + lowest * step - top),
                        np.float32(step),
                        np.float32(1.0 / (depth * depth)),
                    )


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
