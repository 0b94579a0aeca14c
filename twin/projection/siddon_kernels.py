"""Exact Siddon along single rays, for any geometry: the path that is always right.

Each ray walks from voxel to voxel (Amanatides and Woo 1987), positions and sum in double
precision, between the focal spot and the pixel centre. The kernels know the grid in voxel units
only; they refuse to know about mm, cropping and shapes of images beyond what they are given.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.fan_types import Box
from flexdt.twin.projection.kernel_tools import kernel, parallel


@kernel
def ray_integral(flat, base, step_x, step_y, nx, ny, nz, sx, sy, sz, dx, dy, dz):
    """Sum of values times ray parameter along s + t d, 0 <= t <= 1, in a box [0, n] of unit voxels.

    Multiply by the length of d [mm] for the line integral. A component of d may be zero.
    """
    enter, leave = 0.0, 1.0
    if dx != 0.0:
        a, b = -sx / dx, (nx - sx) / dx
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sx < 0.0 or sx >= nx:
        return 0.0
    if dy != 0.0:
        a, b = -sy / dy, (ny - sy) / dy
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sy < 0.0 or sy >= ny:
        return 0.0
    if dz != 0.0:
        a, b = -sz / dz, (nz - sz) / dz
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sz < 0.0 or sz >= nz:
        return 0.0
    if leave <= enter:
        return 0.0
    ix = min(max(math.floor(sx + enter * dx), 0), nx - 1)
    iy = min(max(math.floor(sy + enter * dy), 0), ny - 1)
    iz = min(max(math.floor(sz + enter * dz), 0), nz - 1)
    p = base + ix * step_x + iy * step_y + iz
    # Steps left until the box ends, next crossing, crossing interval and memory step, per axis.
    if dx > 0.0:
        left_x, next_x, every_x, hop_x = nx - ix, (ix + 1 - sx) / dx, 1.0 / dx, step_x
    elif dx < 0.0:
        left_x, next_x, every_x, hop_x = ix + 1, (ix - sx) / dx, -1.0 / dx, -step_x
    else:
        left_x, next_x, every_x, hop_x = 1, math.inf, 0.0, 0
    if dy > 0.0:
        left_y, next_y, every_y, hop_y = ny - iy, (iy + 1 - sy) / dy, 1.0 / dy, step_y
    elif dy < 0.0:
        left_y, next_y, every_y, hop_y = iy + 1, (iy - sy) / dy, -1.0 / dy, -step_y
    else:
        left_y, next_y, every_y, hop_y = 1, math.inf, 0.0, 0
    if dz > 0.0:
        left_z, next_z, every_z, hop_z = nz - iz, (iz + 1 - sz) / dz, 1.0 / dz, 1
    elif dz < 0.0:
        left_z, next_z, every_z, hop_z = iz + 1, (iz - sz) / dz, -1.0 / dz, -1
    else:
        left_z, next_z, every_z, hop_z = 1, math.inf, 0.0, 0
    # Rounding, or a ray within a voxel plane, may put a first crossing before the entry.
    next_x, next_y, next_z = max(next_x, enter), max(next_y, enter), max(next_z, enter)
    t = enter
    total = 0.0
    while True:
        upto = min(next_x, min(next_y, next_z))
        if upto >= leave:
            return total + (leave - t) * flat[p]
        total += (upto - t) * flat[p]
        t = upto
        if next_x == upto:
            left_x -= 1
            if left_x == 0:
                return total
            next_x += every_x
            p += hop_x
        elif next_y == upto:
            left_y -= 1
            if left_y == 0:
                return total
            next_y += every_y
            p += hop_y
        else:
            left_z -= 1
            if left_z == 0:
                return total
            next_z += every_z
            p += hop_z


@kernel
def open_column(flat, marks, at, first, nz):
    """Zero a voxel column, flat[first : first + nz], before anything is added to it: once, which
    marks[at] remembers. Memory that holds old values thus needs no pass of its own.
    """
    if marks[at] == 0:
        marks[at] = 1
        flat[first : first + nz] = np.float32(0)


@kernel
def ray_spread(flat, marks, base, step_x, step_y, nx, ny, nz, sx, sy, sz, dx, dy, dz, value):
    """The transpose of `ray_integral`: adds value times ray parameter to each voxel passed."""
    enter, leave = 0.0, 1.0
    if dx != 0.0:
        a, b = -sx / dx, (nx - sx) / dx
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sx < 0.0 or sx >= nx:
        return
    if dy != 0.0:
        a, b = -sy / dy, (ny - sy) / dy
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sy < 0.0 or sy >= ny:
        return
    if dz != 0.0:
        a, b = -sz / dz, (nz - sz) / dz
        enter, leave = max(enter, min(a, b)), min(leave, max(a, b))
    elif sz < 0.0 or sz >= nz:
        return
    if leave <= enter:
        return
    ix = min(max(math.floor(sx + enter * dx), 0), nx - 1)
    iy = min(max(math.floor(sy + enter * dy), 0), ny - 1)
    iz = min(max(math.floor(sz + enter * dz), 0), nz - 1)
    p = base + ix * step_x + iy * step_y + iz
    # Steps left until the box ends, next crossing, crossing interval and memory step, per axis.
    if dx > 0.0:
        left_x, next_x, every_x, hop_x = nx - ix, (ix + 1 - sx) / dx, 1.0 / dx, step_x
    elif dx < 0.0:
        left_x, next_x, every_x, hop_x = ix + 1, (ix - sx) / dx, -1.0 / dx, -step_x
    else:
        left_x, next_x, every_x, hop_x = 1, math.inf, 0.0, 0
    if dy > 0.0:
        left_y, next_y, every_y, hop_y = ny - iy, (iy + 1 - sy) / dy, 1.0 / dy, step_y
    elif dy < 0.0:
        left_y, next_y, every_y, hop_y = iy + 1, (iy - sy) / dy, -1.0 / dy, -step_y
    else:
        left_y, next_y, every_y, hop_y = 1, math.inf, 0.0, 0
    if dz > 0.0:
        left_z, next_z, every_z, hop_z = nz - iz, (iz + 1 - sz) / dz, 1.0 / dz, 1
    elif dz < 0.0:
        left_z, next_z, every_z, hop_z = iz + 1, (iz - sz) / dz, -1.0 / dz, -1
    else:
        left_z, next_z, every_z, hop_z = 1, math.inf, 0.0, 0
    # Rounding, or a ray within a voxel plane, may put a first crossing before the entry.
    next_x, next_y, next_z = max(next_x, enter), max(next_y, enter), max(next_z, enter)
    t = enter
    column, mark = p - iz, 2 * (iy * nx + ix)
    mark_x, mark_y = (2 if hop_x > 0 else -2), (2 * nx if hop_y > 0 else -2 * nx)
    open_column(flat, marks, mark, column, nz)
    while True:
        upto = min(next_x, min(next_y, next_z))
        if upto >= leave:
            flat[p] += np.float32((leave - t) * value)
            return
        flat[p] += np.float32((upto - t) * value)
        t = upto
        if next_x == upto:
            left_x -= 1
            if left_x == 0:
                return
            next_x += every_x
            p, column, mark = p + hop_x, column + hop_x, mark + mark_x
            open_column(flat, marks, mark, column, nz)
        elif next_y == upto:
            left_y -= 1
            if left_y == 0:
                return
            next_y += every_y
            p, column, mark = p + hop_y, column + hop_y, mark + mark_y
            open_column(flat, marks, mark, column, nz)
        else:
            left_z -= 1
            if left_z == 0:
                return
            next_z += every_z
            p += hop_z


@kernel
def ray_of(box, g, r, c):
    """Direction of pixel (r, c) from the source in voxels, and its length [mm]."""
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    dz = g[5] + c * g[8] + r * g[11]
    x, y, z = dx * box.size_x, dy * box.size_y, dz * box.size_z
    return dx, dy, dz, math.sqrt(x * x + y * y + z * z)


@kernel
def project_one(box, g, r, c):
    """Line integral of the ray to pixel (r, c)."""
    dx, dy, dz, length = ray_of(box, g, r, c)
    t = ray_integral(
        box.flat, box.base, box.hop_x, box.hop_y, box.nx, box.ny, box.nz,
        g[0], g[1], g[2], dx, dy, dz,
    )  # fmt: skip
    return np.float32(t * length)


@kernel
def spread_one(box, g, r, c, value):
    """The transpose of `project_one`; box.spans are the marks of `open_column`."""
    dx, dy, dz, length = ray_of(box, g, r, c)
    ray_spread(
        box.flat, box.spans, box.base, box.hop_x, box.hop_y, box.nx, box.ny, box.nz,
        g[0], g[1], g[2], dx, dy, dz, value * length,
    )  # fmt: skip


@parallel
def project_rays(box, views, chosen, out, tile):
    """Fill the chosen views of out (n, rows, cols) with line integrals.

    views (n, 12): source, first pixel centre minus source, u, v in voxel units of the box; chosen:
    indices of views; tile: columns a job.
    """
    rows, cols = out.shape[1:]
    tiles = (cols + tile - 1) // tile
    for job in prange(len(chosen) * tiles):
        view = chosen[job // tiles]
        first = job % tiles * tile
        for c in range(first, min(cols, first + tile)):
            for r in range(rows):
                out[view, r, c] = project_one(box, views[view], r, c)


@parallel
def spread_rays(box, views, chosen, values, slices, marks):
    """The transpose of `project_rays`: adds to box.flat. Each job owns a range of z, slices (s, 2),
    and meets every ray, so that no two jobs write the same voxel; marks (s, 2 nx ny): see
    `open_column`.
    """
    rows, cols = values.shape[1:]
    for job in prange(len(slices)):
        z0, z1 = slices[job, 0], slices[job, 1]
        piece = Box(
            box.flat, marks[job], box.base + z0, box.hop_x, box.hop_y, box.nx, box.ny, z1 - z0,
            box.size_x, box.size_y, box.size_z,
        )  # fmt: skip
        for view in chosen:
            g = views[view].copy()
            g[2] -= z0
            for c in range(cols):
                for r in range(rows):
                    if values[view, r, c] != np.float32(0):
                        spread_one(piece, g, r, c, values[view, r, c])
