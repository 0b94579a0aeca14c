"""Exact Siddon along single rays, for any geometry: the path that is always right.

Each ray walks from voxel to voxel (Amanatides and Woo 1987), positions and sum in double
precision, between the focal spot and the pixel centre. Coordinates are in voxel units of the box.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import inline, kernel, parallel
from flexdt.twin.projection.kernels.fan_types import Box


@inline
def clip(s, d, n, enter, leave):
    """Narrow [enter, leave] to the t for which s + t d lies in [0, n]; (1, 0) if there are none."""
    if d != 0.0:
        a, b = -s / d, (n - s) / d
        return max(enter, min(a, b)), min(leave, max(a, b))
    # Parallel to the planes: within them for all t or for none. [0, n) is half open, so that a ray
    # in the plane between two voxels belongs to one of them.
    if s < 0.0 or s >= n:
        return 1.0, 0.0
    return enter, leave


@inline
def clip_to_box(nx, ny, nz, sx, sy, sz, dx, dy, dz):
    """Ray parameters (enter, leave) of s + t d, 0 <= t <= 1, in a box of unit voxels."""
    enter, leave = clip(sx, dx, nx, 0.0, 1.0)
    enter, leave = clip(sy, dy, ny, enter, leave)
    return clip(sz, dz, nz, enter, leave)


@inline
def first_step(s, d, n, enter, hop):
    """Where the walk along one axis begins.

    Returns:
        voxel at entry, steps left until the box ends, t of the next crossing, t between crossings,
        and the memory step signed by direction.
    """
    # Rounding at the entry may give the voxel before the box or behind it.
    i = min(max(math.floor(s + enter * d), 0), n - 1)
    # Rounding, or a ray within a voxel plane, may put a first crossing before the entry.
    if d > 0.0:
        return i, n - i, max((i + 1 - s) / d, enter), 1.0 / d, hop
    if d < 0.0:
        return i, i + 1, max((i - s) / d, enter), -1.0 / d, -hop
    return i, 1, math.inf, 0.0, 0


@kernel
def open_column(flat, marks, at, first, nz):
    """Zero a voxel column, flat[first : first + nz], before the first addition to it.

    marks[at] is set once that has been done, so memory with old values needs no pass of its own.
    """
    if marks[at] == 0:
        marks[at] = 1
        flat[first : first + nz] = np.float32(0)


@kernel
def ray_of(box, g, r, c):
    """Direction of pixel (r, c) from the source in voxels, and its length [mm]."""
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    dz = g[5] + c * g[8] + r * g[11]
    x, y, z = dx * box.size_x, dy * box.size_y, dz * box.size_z
    return dx, dy, dz, math.sqrt(x * x + y * y + z * z)


@inline
def walk_ray(box, g, r, c, value, transposed):
    """Line integral of the ray to pixel (r, c); transposed, adds value times its length in each
    voxel to that voxel, and box.spans are the marks of `open_column`, two for each voxel column.
    """
    dx, dy, dz, length = ray_of(box, g, r, c)
    nx, ny, nz = box.nx, box.ny, box.nz
    enter, leave = clip_to_box(nx, ny, nz, g[0], g[1], g[2], dx, dy, dz)
    if leave <= enter:
        return np.float32(0)
    ix, left_x, next_x, every_x, hop_x = first_step(g[0], dx, nx, enter, box.hop_x)
    iy, left_y, next_y, every_y, hop_y = first_step(g[1], dy, ny, enter, box.hop_y)
    iz, left_z, next_z, every_z, hop_z = first_step(g[2], dz, nz, enter, 1)
    flat, marks = box.flat, box.spans
    column, mark = box.base + ix * box.hop_x + iy * box.hop_y, 2 * (iy * nx + ix)
    mark_x, mark_y = (2 if hop_x > 0 else -2), (2 * nx if hop_y > 0 else -2 * nx)
    p, t, total, scaled = column + iz, enter, 0.0, value * length
    if transposed:
        open_column(flat, marks, mark, column, nz)
    while True:
        # The nearest of the three next crossings ends the piece of the ray in voxel p.
        upto = min(next_x, min(next_y, next_z))
        piece = min(upto, leave) - t
        if transposed:
            flat[p] += np.float32(piece * scaled)
        else:
            total += piece * flat[p]
        if upto >= leave:
            break
        t = upto
        if next_x == upto:
            left_x -= 1
            if left_x == 0:
                break
            next_x += every_x
            p, column, mark = p + hop_x, column + hop_x, mark + mark_x
        elif next_y == upto:
            left_y -= 1
            if left_y == 0:
                break
            next_y += every_y
            p, column, mark = p + hop_y, column + hop_y, mark + mark_y
        else:
            left_z -= 1
            if left_z == 0:
                break
            next_z += every_z
            p += hop_z
        if transposed:
            open_column(flat, marks, mark, column, nz)
    return np.float32(total * length)


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
                out[view, r, c] = walk_ray(box, views[view], r, c, np.float32(0), False)


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
                        walk_ray(piece, g, r, c, values[view, r, c], True)
