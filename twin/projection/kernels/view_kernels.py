"""Compiled steps of a single view on a CUDA device: its rays with the walk they allow, and its
image from page-locked memory.

In NumPy the rays of one view take as long as the view on a device (H200, C1: .14 ms).
"""

from __future__ import annotations

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import kernel, parallel, serial

COPIED_NUMBERS = 1 << 16
"""Numbers that a thread copies at a time."""
UNFIT = -1
"""Kind of a view that `prepare` does not judge."""
LYING = 3
SLABS = 1
UPRIGHT = 1
"""What a panel on its side, the slab walk, and upright columns add to a view's kind."""


@parallel
def copy(source, target):
    """Copy numbers (k,) to others by all cores."""
    for part in prange((source.size + COPIED_NUMBERS - 1) // COPIED_NUMBERS):
        for i in range(
            part * COPIED_NUMBERS, min(source.size, (part + 1) * COPIED_NUMBERS)
        ):
            target[i] = source[i]


@serial(error_model="numpy")
def prepare(row, frame, rows, cols, least_sine, clearance, rise, table):
    """Convert one view to the line of a device's table, and find the walk that it allows.

    Same numbers as `operators.voxel_rays`, and same walk as `gpu.launcher` chooses.

    Args:
        row: (12,) source, detector's center, u and v [mm].
        frame: (5, 3) low corner of the occupied box, voxel, center and half sides of the
            whole box [mm]; voxels of the occupied box.
        rows: of the detector.
        cols: of the detector.
        least_sine: smallest sine of u with v, and of a panel with the ray to its center.
        clearance: least distance of the box from source and panel over their distance;
            infinite for a box that the slab walk does not take.
        rise: largest rise of rays in a slab for upright columns [voxels].
        table: (1, 13) filled: source, first pixel minus source, step from lane to lane,
            step from row to row [voxels], and 0.

    Returns:
        The kind: LYING + SLABS + UPRIGHT, each where it holds; UNFIT where pixels have no
        rays of their own or the panel cuts the whole box.
    """
    if not _spreads_behind(row, frame, least_sine):
        return UNFIT
    low = frame[0]
    voxel = frame[1]
    rays = table[0]
    for a in range(3):
        first = row[3 + a] - (cols - 1) / 2 * row[6 + a] - (rows - 1) / 2 * row[9 + a]
        rays[a] = (row[a] - low[a]) / voxel[a]
        rays[3 + a] = (first - row[a]) / voxel[a]
        rays[6 + a] = row[6 + a] / voxel[a]
        rays[9 + a] = row[9 + a] / voxel[a]
    rays[12] = 0.0
    # The tests of `gpu` for many views: alone, a view must get the same walk.
    steepest = _steepest(rays, rows, cols)
    slabs = steepest <= 1.0 and _is_clear(rays, frame[4], clearance)
    mx = rays[3] + (cols - 1) / 2 * rays[6] + (rows - 1) / 2 * rays[9]
    my = rays[4] + (cols - 1) / 2 * rays[7] + (rows - 1) / 2 * rays[10]
    # Lanes go along the step that moves less across the middle ray, seen along z: they read
    # the same voxel columns. On a panel that lies on its side that is u.
    lying = abs(rays[9] * my - rays[10] * mx) > abs(rays[6] * my - rays[7] * mx)
    if lying:
        for a in range(3):
            rays[6 + a], rays[9 + a] = rays[9 + a], rays[6 + a]
    kind = 0
    if lying:
        kind += LYING
    if slabs:
        kind += SLABS
        if rays[9] == 0.0 and rays[10] == 0.0 and steepest <= rise:
            kind += UPRIGHT
    return kind


@kernel
def _length(x, y, z):
    return np.sqrt(x * x + y * y + z * z)


@kernel
def _spreads_behind(row, frame, least_sine):
    """Return whether each pixel has a ray of its own, and the panel is behind the whole
    box; arguments as those of `prepare`.
    """
    ux, uy, uz, vx, vy, vz = row[6], row[7], row[8], row[9], row[10], row[11]
    bx, by, bz = row[3] - row[0], row[4] - row[1], row[5] - row[2]
    area = _length(ux, uy, uz) * _length(vx, vy, vz)
    x = uy * vz - uz * vy
    y = uz * vx - ux * vz
    z = ux * vy - uy * vx
    # Not `<=`: a view with NaN is unfit, too.
    if not _length(x, y, z) > least_sine * area:
        return False
    depth = x * bx + y * by + z * bz
    if not abs(depth) > least_sine * area * _length(bx, by, bz):
        return False
    centre = frame[2]
    half = frame[3]
    middle = (
        x * (centre[0] - row[0]) + y * (centre[1] - row[1]) + z * (centre[2] - row[2])
    )
    # How far the box's farthest corner is beyond its centre, along the normal.
    beyond = abs(x) * half[0] + abs(y) * half[1] + abs(z) * half[2]
    if depth < 0.0:
        middle = -middle
    return middle + beyond <= abs(depth)


@kernel
def _steepest(rays, rows, cols):
    """Compute a bound of the voxels that rays rise for each along the faster one of x and
    y, as `gpu.rises`; rays as `prepare` makes them; infinite where rays go along
    different ways."""
    mx = 2.0 * rays[3] + (cols - 1) * rays[6] + (rows - 1) * rays[9]
    my = 2.0 * rays[4] + (cols - 1) * rays[7] + (rows - 1) * rays[10]
    # A ray gains along its faster axis at least its part along any of the five ways (axes;
    # the middle ray over root 2). |z| over that part is greatest at a corner of the panel,
    # and the least of five bounds is one.
    diagonal = np.sqrt(2.0 * (mx * mx + my * my))
    best = np.inf
    for way in range(5):
        ahead_x, ahead_y = mx / diagonal, my / diagonal
        if way < 2:
            ahead_x, ahead_y = 1.0 - 2.0 * way, 0.0
        elif way < 4:
            ahead_x, ahead_y = 0.0, 5.0 - 2.0 * way
        most = 0.0
        for corner in range(4):
            c = (corner // 2) * (cols - 1)
            r = (corner % 2) * (rows - 1)
            x = rays[3] + c * rays[6] + r * rays[9]
            y = rays[4] + c * rays[7] + r * rays[10]
            z = rays[5] + c * rays[8] + r * rays[11]
            ahead = ahead_x * x + ahead_y * y
            most = max(most, abs(z) / ahead if ahead > 0.0 else np.inf)
        best = min(best, most)
    return best


@kernel
def _is_clear(rays, counts, clearance):
    """Return whether the source is before the box and the panel's plane behind it, as
    `gpu.clear_of`; arguments as those of `prepare`.
    """
    nearest = 0.0
    farthest = 0.0
    depth = 0.0
    for a in range(3):
        b, c = (a + 1) % 3, (a + 2) % 3
        normal = rays[6 + b] * rays[9 + c] - rays[6 + c] * rays[9 + b]
        # A box's extent along a normal is a sum over its axes: each adds its lower or upper
        # end.
        nearest += min(normal * counts[a], 0.0) - rays[a] * normal
        farthest += max(normal * counts[a], 0.0) - rays[a] * normal
        depth += rays[3 + a] * normal
    if depth < 0.0:
        nearest, farthest, depth = -farthest, -nearest, -depth
    return nearest > clearance * depth and farthest < (1.0 - clearance) * depth
