"""CUDA kernels: exact Siddon with one thread for each ray, and its transpose with atomic additions.

Entry and exit are computed in double precision; the walk counts crossings from the entry in single
precision (error below 1e-4 of a voxel, not growing with the distance to the source). Imported only
where a CUDA device (or numba's simulator of one) has been found: `gpu` decides.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

BLOCK = (32, 4)
"""Threads a block: neighbouring rows read neighbouring voxels."""


@cuda.jit(device=True)
def enter_box(s, d, n, enter, leave):
    """Narrow [enter, leave] to where s + t d lies in [0, n)."""
    if d == 0.0:
        if s < 0.0 or s >= n:
            return 1.0, 0.0
        return enter, leave
    a = -s / d
    b = (n - s) / d
    return max(enter, min(a, b)), min(leave, max(a, b))


@cuda.jit(device=True)
def first_crossing(s, d, n, enter, unit):
    """Voxel at entry, distance of the first crossing after it, distance between crossings and
    crossings until the box ends; distances in `unit`s of t.
    """
    at = s + enter * d
    # On the device, floor gives a float.
    i = min(max(int(math.floor(at)), 0), n - 1)  # noqa: RUF046
    if d > 0.0:
        return i, np.float32(max((i + 1 - at) / d * unit, 0.0)), np.float32(unit / d), n - i
    if d < 0.0:
        return i, np.float32(max((i - at) / d * unit, 0.0)), np.float32(-unit / d), i + 1
    return i, np.float32(math.inf), np.float32(0.0), 1


@cuda.jit(device=True)
def walk_ray(flat, base, hops, counts, g, dx, dy, dz, value, transposed):
    """Sum of values times lengths along a ray, or (transposed) adds value times lengths.

    Lengths are in units of the ray's parameter t from 0 (source) to 1 (pixel).
    """
    enter, leave = 0.0, 1.0
    enter, leave = enter_box(g[0], dx, counts[0], enter, leave)
    enter, leave = enter_box(g[1], dy, counts[1], enter, leave)
    enter, leave = enter_box(g[2], dz, counts[2], enter, leave)
    if leave <= enter:
        return 0.0
    # Distances are counted in steps of the fastest axis (t times unit), so that single precision
    # resolves them alike for every ray.
    unit = max(abs(dx), max(abs(dy), abs(dz)))
    ix, first_x, every_x, left_x = first_crossing(g[0], dx, counts[0], enter, unit)
    iy, first_y, every_y, left_y = first_crossing(g[1], dy, counts[1], enter, unit)
    iz, first_z, every_z, left_z = first_crossing(g[2], dz, counts[2], enter, unit)
    hop_x = hops[0] if dx > 0.0 else -hops[0]
    hop_y = hops[1] if dy > 0.0 else -hops[1]
    hop_z = 1 if dz > 0.0 else -1
    p = base + ix * hops[0] + iy * hops[1] + iz
    end = np.float32((leave - enter) * unit)
    next_x, next_y, next_z = first_x, first_y, first_z
    done_x, done_y, done_z = 0, 0, 0
    t = np.float32(0.0)
    total = np.float32(0.0)
    share = np.float32(value / unit)  # transposed: what a distance of 1 adds to a voxel
    while True:
        upto = min(end, min(next_x, min(next_y, next_z)))
        if transposed:
            cuda.atomic.add(flat, p, (upto - t) * share)
        else:
            total += (upto - t) * flat[p]
        t = upto
        if upto >= end:
            break
        # Counted from the entry: rounding does not add up.
        if next_x == upto:
            done_x += 1
            if done_x == left_x:
                break
            next_x = first_x + np.float32(done_x) * every_x
            p += hop_x
        elif next_y == upto:
            done_y += 1
            if done_y == left_y:
                break
            next_y = first_y + np.float32(done_y) * every_y
            p += hop_y
        else:
            done_z += 1
            if done_z == left_z:
                break
            next_z = first_z + np.float32(done_z) * every_z
            p += hop_z
    return total / unit


@cuda.jit
def rays(flat, base, hops, counts, views, scale, images, transposed):
    """images (n, rows, cols): filled with line integrals or, transposed, added to flat."""
    r, c, view = cuda.grid(3)
    if view >= images.shape[0] or r >= images.shape[1] or c >= images.shape[2]:
        return
    g = views[view]
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    dz = g[5] + c * g[8] + r * g[11]
    x, y, z = dx * scale[0], dy * scale[1], dz * scale[2]
    length = math.sqrt(x * x + y * y + z * z)
    value = images[view, r, c] * length if transposed else 0.0
    if transposed and value == 0.0:
        return
    total = walk_ray(flat, base, hops, counts, g, dx, dy, dz, value, transposed)
    if not transposed:
        images[view, r, c] = total * length
