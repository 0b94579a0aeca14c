"""Exact Siddon along single rays, for any geometry: the path that is always right; and how its
line integrals change with the geometry.

Each ray walks from voxel to voxel (Amanatides and Woo 1987), positions and sum in double
precision, between the focal spot and the pixel center. Coordinates are in voxel units of the
box, derivatives in 1/mm.

A ray from s to e has the integral p = L sum_i mu_i (t[i+1] - t[i]): L its length, mu_i the
value of the i-th voxel it meets, t the parameters of s + t (e - s) at which it goes from one
voxel to the next. Each t[k] belongs to a plane across one axis a, t = (plane - s_a) / (e_a -
s_a), so that it depends on s and e along that axis alone:

    dt / ds_a = (t - 1) / (e_a - s_a),    dt / de_a = -t / (e_a - s_a).

In p, t[k] has the factor L J with the jump J = mu before the plane - mu behind it (outside the
box mu is 0). So two sums for each axis, of J and of J t, are all that a walk along the ray has
to gather. Where a ray runs through an edge of the grid, or within one of its planes, p has a
kink and no derivative; the walk then gives that of one side.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import inline, kernel, parallel
from flexdt.twin.projection.kernels.fan_types import Box


@inline
def clip(s, d, n, enter, leave):
    """Cut [enter, leave] down to the t where s + t d is in [0, n], and return it; leave
    <= enter where there are none. With d = 0 it is unchanged for s in [0, n), else (1,
    0)."""
    if d != 0.0:
        a, b = -s / d, (n - s) / d
        return max(enter, min(a, b)), min(leave, max(a, b))
    # Parallel to the planes: within them for all t or for none. [0, n) is half open, so that a
    # ray in the plane between two voxels belongs to one of them.
    if s < 0.0 or s >= n:
        return 1.0, 0.0
    return enter, leave


@inline
def clip_to_box(nx, ny, nz, sx, sy, sz, dx, dy, dz):
    """Compute ray parameters (enter, leave) of s + t d, 0 <= t <= 1, in a box of unit
    voxels.
    """
    enter, leave = clip(sx, dx, nx, 0.0, 1.0)
    enter, leave = clip(sy, dy, ny, enter, leave)
    return clip(sz, dz, nz, enter, leave)


@inline
def first_step(s, d, n, enter, hop):
    """Find the start of the walk along one axis.

    `s`: the source's place along the axis [voxels]; `d`: the ray's length along it [voxels];
    `n`: voxels along it; `enter`: t of the entry into the box; `hop`: places in memory from one
    voxel to the next. Returns voxel at entry, steps left until the box ends, t of the next
    crossing, t between crossings, and the memory step signed by direction."""
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
    """Set a voxel column, flat[first : first + nz], to zero before the first addition to it.
    marks[at] is set once that has been done, so memory with old values needs no pass of its
    own."""
    if marks[at] == 0:
        marks[at] = 1
        flat[first : first + nz] = np.float32(0)


@kernel
def ray_of(box, g, r, c):
    """Compute the ray from the source to pixel (r, c): its three components [voxels], and its
    length [mm].
    """
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    dz = g[5] + c * g[8] + r * g[11]
    x, y, z = dx * box.size_x, dy * box.size_y, dz * box.size_z
    return dx, dy, dz, math.sqrt(x * x + y * y + z * z)


@inline
def walk_ray(box, g, r, c, value, transposed):
    """Compute the line integral of the ray to pixel (r, c), voxel by voxel; transposed,
    add the pixel's value to the voxels, which are opened first. A ray that misses the box
    gives 0 and adds nothing.

    Args:
        box: voxels; transposed, changed in place, and its spans are the marks of
            `open_column`, two for each voxel column.
        g: (12,) source, first pixel minus source, u, v [voxels].
        r: row.
        c: column.
        value: of the pixel, for the transpose.
        transposed: add value times the ray's length in each voxel to that voxel.

    Returns:
        The integral, float32; meaningless if transposed.
    """
    dx, dy, dz, length = ray_of(box, g, r, c)
    nx, ny, nz = box.nx, box.ny, box.nz
    enter, leave = clip_to_box(nx, ny, nz, g[0], g[1], g[2], dx, dy, dz)
    if leave <= enter:
        return np.float32(0)
    ix, left_x, next_x, every_x, hop_x = first_step(g[0], dx, nx, enter, box.hop_x)
    iy, left_y, next_y, every_y, hop_y = first_step(g[1], dy, ny, enter, box.hop_y)
    iz, left_z, next_z, every_z, hop_z = first_step(g[2], dz, nz, enter, 1)
    flat = box.flat
    marks = box.spans
    column = box.base + ix * box.hop_x + iy * box.hop_y
    mark = 2 * (iy * nx + ix)
    mark_x, mark_y = (2 if hop_x > 0 else -2), (2 * nx if hop_y > 0 else -2 * nx)
    p = column + iz
    t = enter
    total = 0.0
    scaled = value * length
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
            p = p + hop_x
            column = column + hop_x
            mark = mark + mark_x
        elif next_y == upto:
            left_y -= 1
            if left_y == 0:
                break
            next_y += every_y
            p = p + hop_y
            column = column + hop_y
            mark = mark + mark_y
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
def project_rays(box, views, chosen, out, tile, first_job, last_job):
    """Fill the chosen views of `out` with line integrals, each ray on its own.

    `box`: voxels. `views`: (n, 12) source, first pixel center minus source, u, v in voxel units
    of the box. `chosen`: (k,) indices of views. `out`: (n, rows, cols). `tile`: columns of a
    job; of each chosen view one job after the other. `first_job`: number of the first job.
    `last_job`: number of the job after the last.
    """
    rows, cols = out.shape[1:]
    tiles = (cols + tile - 1) // tile
    for job in prange(first_job, last_job):
        view = chosen[job // tiles]
        first = job % tiles * tile
        for c in range(first, min(cols, first + tile)):
            for r in range(rows):
                out[view, r, c] = walk_ray(box, views[view], r, c, np.float32(0), False)


@parallel
def spread_rays(box, views, chosen, values, slices, marks, first_column, last_column):
    """Apply the transpose of `project_rays` to columns of the chosen views: add to
    box.flat.

    Each job owns a range of z and walks every ray whose pixel is not 0, so that no two
    jobs write the same voxel. Voxel columns are opened at the first addition.

    Args:
        box: voxels, changed in place.
        views: (n, 12) rays in voxels.
        chosen: (k,) numbers of views.
        values: (n, rows, cols) images.
        slices: (s, 2) ranges of z.
        marks: (s, 2 nx ny): see `open_column`.
        first_column: first column, counted through all chosen views.
        last_column: column after the last.
    """
    rows, cols = values.shape[1:]
    for job in prange(len(slices)):
        z0, z1 = slices[job, 0], slices[job, 1]
        piece = Box(
            box.flat,
            marks[job],
            box.base + z0,
            box.hop_x,
            box.hop_y,
            box.nx,
            box.ny,
            z1 - z0,
            box.size_x,
            box.size_y,
            box.size_z,
        )
        g = np.empty(12)
        for column in range(first_column, last_column):
            view = chosen[column // cols]
            c = column % cols
            for i in range(12):
                g[i] = views[view, i]
            g[2] -= z0
            for r in range(rows):
                if values[view, r, c] != np.float32(0):
                    walk_ray(piece, g, r, c, values[view, r, c], True)


@inline
def faces(s, d, n):
    """Compute t at which the ray s + t d enters and leaves [0, n]; (-inf, inf) if d is 0."""
    if d > 0.0:
        return -s / d, (n - s) / d
    if d < 0.0:
        return (n - s) / d, -s / d
    return -math.inf, math.inf


@kernel
def walk_jumps(flat, base, step_x, step_y, nx, ny, nz, sx, sy, sz, dx, dy, dz):
    """Walk a ray like `walk_ray` and sum up the terms of its derivatives.

    Args:
        flat: voxels, flat[base + x step_x + y step_y + z].
        base: index of voxel (0, 0, 0).
        step_x: elements from x to x + 1.
        step_y: elements from y to y + 1.
        nx: voxels along x.
        ny: voxels along y.
        nz: voxels along z.
        sx: the source's x [voxels].
        sy: its y.
        sz: its z.
        dx: the ray's length along x, from source to pixel [voxels].
        dy: along y.
        dz: along z.

    Returns:
        sum of values times lengths in the ray parameter t; then the sums of J and of J t
        over the planes across x, of those across y, and z. J is the value before a plane
        minus that behind it; faces of the box count, with 0 outside. All 0 for a ray that
        misses the box.
    """
    jx = jy = jz = mx = my = mz = total = 0.0
    enter, leave = clip_to_box(nx, ny, nz, sx, sy, sz, dx, dy, dz)
    if leave <= enter:
        return total, jx, mx, jy, my, jz, mz
    ix, left_x, next_x, every_x, hop_x = first_step(sx, dx, nx, enter, step_x)
    iy, left_y, next_y, every_y, hop_y = first_step(sy, dy, ny, enter, step_y)
    iz, left_z, next_z, every_z, hop_z = first_step(sz, dz, nz, enter, 1)
    # p runs through memory with the ray; `value` is that of the voxel it is in.
    p = base + ix * step_x + iy * step_y + iz
    value = np.float64(flat[p])
    near_x, far_x = faces(sx, dx, nx)
    near_y, far_y = faces(sy, dy, ny)
    near_z, far_z = faces(sz, dz, nz)
    # Into the box through the face that is reached last: a jump from 0. A ray that begins
    # inside (enter = 0, whatever the geometry) meets no face there.
    if enter > 0.0:
        if near_x >= near_y and near_x >= near_z:
            jx, mx = -value, -value * enter
        elif near_y >= near_z:
            jy, my = -value, -value * enter
        else:
            jz, mz = -value, -value * enter
    t = enter
    while True:
        # The nearest of the three next planes ends the piece in this voxel. Its axis gets the
        # jump; at an edge, where two are equally near, the first one does (see above: a kink).
        upto = min(next_x, min(next_y, next_z))
        if upto >= leave:
            break
        total += (upto - t) * value
        t = upto
        if next_x == upto:
            left_x -= 1
            if left_x == 0:
                break
            next_x += every_x
            p += hop_x
            jump = value - flat[p]
            jx += jump
            mx += jump * t
        elif next_y == upto:
            left_y -= 1
            if left_y == 0:
                break
            next_y += every_y
            p += hop_y
            jump = value - flat[p]
            jy += jump
            my += jump * t
        else:
            left_z -= 1
            if left_z == 0:
                break
            next_z += every_z
            p += hop_z
            jump = value - flat[p]
            jz += jump
            mz += jump * t
        value -= (
            jump  # jump = before - behind, so that this is the voxel behind the plane
        )
    total += (leave - t) * value
    # Out through the face that is reached first, a jump to 0; none if the ray ends inside.
    if leave < 1.0:
        if far_x <= far_y and far_x <= far_z:
            jx += value
            mx += value * leave
        elif far_y <= far_z:
            jy += value
            my += value * leave
        else:
            jz += value
            mz += value * leave
    return total, jx, mx, jy, my, jz, mz


@inline
def ends(total, length, d, jumps, moments):
    """Compute derivatives of the line integral by one coordinate of source and of pixel.

    Args:
        total: sum of values times ray parameter; the integral is total * length.
        length: of the ray [mm].
        d: the ray's extent along this axis [mm]; with 0 the planes count nothing.
        jumps: sum of J over the planes across this axis, see `walk_jumps`.
        moments: sum of J t over them.

    Returns:
        The derivative by the source's coordinate, and by the pixel's [1/mm].
    """
    stretch = total * d / length  # the ray grows longer
    if d == 0.0:
        return -stretch, stretch
    return length * (moments - jumps) / d - stretch, stretch - length * moments / d


@kernel
def ray_derivatives(box, g, r, c):
    """Compute derivatives of the integral of the ray to pixel (r, c).

    Args:
        box: voxels.
        g: (12,) source, first pixel minus source, u, v [voxels].
        r: row.
        c: column.

    Returns:
        Six derivatives [1/mm]: with respect to the source's x, y, z and the pixel centre's x,
        y, z.
    """
    dx, dy, dz, length = ray_of(box, g, r, c)
    total, jx, mx, jy, my, jz, mz = walk_jumps(
        box.flat,
        box.base,
        box.hop_x,
        box.hop_y,
        box.nx,
        box.ny,
        box.nz,
        g[0],
        g[1],
        g[2],
        dx,
        dy,
        dz,
    )
    sx, ex = ends(total, length, dx * box.size_x, jx, mx)
    sy, ey = ends(total, length, dy * box.size_y, jy, my)
    sz, ez = ends(total, length, dz * box.size_z, jz, mz)
    return sx, sy, sz, ex, ey, ez


@parallel
def gather(box, views, weights, tile, parts, first_job, last_job):
    """Sum weight times derivative over the pixels of a view, with respect to its twelve
    numbers; pixels of weight 0 are skipped.

    A pixel's center is D + (c - (cols - 1) / 2) u + (r - (rows - 1) / 2) v, so that what
    it gets goes to D, u and v with these factors. Each job, `tile` columns of one view,
    adds into a row of its own of parts (n * tiles, 12): no two write to the same place,
    and the sums do not depend on the number of threads.

    Args:
        box: the volume.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box.
        weights: float32 (n, rows, cols).
        tile: columns a job.
        parts: float64 zeros; row view * tiles + k belongs to the k-th tile of a view, a
            job.
        first_job, last_job: range of jobs.
    """
    _, rows, cols = weights.shape
    tiles = (cols + tile - 1) // tile
    for job in prange(first_job, last_job):
        view = job // tiles
        first = job % tiles * tile
        part = parts[job]
        for c in range(first, min(cols, first + tile)):
            across = c - (cols - 1) / 2
            # Sums of one column: of a source's derivatives, of a pixel's, and of these times
            # the row, which is what v gets. `across` is the same all along, so that u needs no
            # sums.
            s0 = s1 = s2 = e0 = e1 = e2 = d0 = d1 = d2 = 0.0
            for r in range(rows):
                w = np.float64(weights[view, r, c])
                if w != 0.0:
                    down = r - (rows - 1) / 2
                    sx, sy, sz, ex, ey, ez = ray_derivatives(box, views[view], r, c)
                    s0, s1, s2 = s0 + w * sx, s1 + w * sy, s2 + w * sz
                    e0, e1, e2 = e0 + w * ex, e1 + w * ey, e2 + w * ez
                    d0, d1, d2 = (
                        d0 + w * down * ex,
                        d1 + w * down * ey,
                        d2 + w * down * ez,
                    )
            part[0] += s0
            part[1] += s1
            part[2] += s2
            part[3] += e0
            part[4] += e1
            part[5] += e2
            part[6] += across * e0
            part[7] += across * e1
            part[8] += across * e2
            part[9] += d0
            part[10] += d1
            part[11] += d2


@parallel
def follow(box, views, change, tile, out, first_job, last_job):
    """Apply the transpose of `gather`: compute the effect of a change of the views on each
    pixel.

    Args:
        box: voxels.
        views: (n, 12) rays in voxels.
        change: (n, 12) change of the cone_vec rows [mm].
        tile: columns of a job; each job, columns of one view, has pixels of its own.
        out: (n, rows, cols) filled.
        first_job: number of the first job.
        last_job: number of the job after the last.
    """
    _, rows, cols = out.shape
    tiles = (cols + tile - 1) // tile
    for job in prange(first_job, last_job):
        view = job // tiles
        first = job % tiles * tile
        m = change[view]
        for c in range(first, min(cols, first + tile)):
            across = c - (cols - 1) / 2
            for r in range(rows):
                down = r - (rows - 1) / 2
                sx, sy, sz, ex, ey, ez = ray_derivatives(box, views[view], r, c)
                out[view, r, c] = np.float32(
                    sx * m[0]
                    + sy * m[1]
                    + sz * m[2]
                    + ex * (m[3] + across * m[6] + down * m[9])
                    + ey * (m[4] + across * m[7] + down * m[10])
                    + ez * (m[5] + across * m[8] + down * m[11])
                )
