"""Exact chords through convex solids, and path lengths through closed triangle meshes. Double
precision.

*Solids*, one detector row at a time: a row's rays are cut by one surface after the other (loops
a compiler can vectorise), only over the columns that a solid's shadow can reach. Quadrics and
slabs come from `analytic_solids`.

*Meshes*, triangle by triangle instead of ray by ray: the signed distances at which a ray leaves
(+) and enters (-) the solid add up to its path length, so each triangle is drawn once onto the
pixels it covers. Whether a ray passes left or right of an edge is computed from the edge alone,
the same way for both its triangles: no ray slips through between them or is counted twice.
`analytic` has checked that the mesh is closed.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import fetch_next, kernel, maker, parallel

TINY = 1e-300
BAND_ROWS = 16
"""Detector rows in a job."""


@kernel
def cut_by_slab(t0, t1, at, low, high, rate, step, first):
    """Cut the pieces [t0, t1] of the rays to a run of columns down to a slab, in place; t1 < t0
    where nothing is left. A ray along the slab keeps all or loses all.

    `t0`: (k,) beginnings, in lengths of the rays; `t1`: (k,) ends; `at`: the source's height
    above the slab's plane; `low`: lower limit, low <= at + t (rate + column * step); `high`:
    upper limit; `rate`: height of the ray to column 0; `step`: change of it by a column;
    `first`: the first ray's column.
    """
    # A ray along the slab gets TINY: both quotients are huge, of one sign where it runs outside
    # (no chord is left) and of two where it runs inside (nothing is cut). No branch, so it
    # vectorises.
    for i in range(t0.size):
        speed = rate + (first + i) * step
        inverse = 1.0 / (speed if speed != 0.0 else TINY)
        a = (low - at) * inverse
        b = (high - at) * inverse
        lower = min(a, b)
        upper = max(a, b)
        t0[i] = lower if lower > t0[i] else t0[i]
        t1[i] = upper if upper < t1[i] else t1[i]


@kernel
def cut_by_quadric(t0, t1, q, d, e, first):
    """Cut the pieces [t0, t1] of the rays to a run of columns down to |q + t (d + column
    * e)| <= 1, in place; t1 <= t0 where nothing is left.

    A ray along a cylinder's axis keeps all inside it and loses all outside.

    Args:
        t0: (k,) beginnings, in lengths of the rays.
        t1: (k,) ends.
        q: (3,) the source, mapped by the quadric's matrix M, as are d and e.
        d: (3,) direction of the ray to column 0.
        e: (3,) change of it by a column.
        first: the first ray's column.
    """
    qq = q[0] * q[0] + q[1] * q[1] + q[2] * q[2]
    for i in range(t0.size):
        c = first + i
        dx = d[0] + c * e[0]
        dy = d[1] + c * e[1]
        dz = d[2] + c * e[2]
        a = dx * dx + dy * dy + dz * dz
        if a > TINY:
            middle = -(q[0] * dx + q[1] * dy + q[2] * dz) / a
            # The closest point, not b^2 - 4ac: no cancellation for a small ball far away.
            x = q[0] + middle * dx
            y = q[1] + middle * dy
            z = q[2] + middle * dz
            inside = 1.0 - (x * x + y * y + z * z)
            half = math.sqrt(max(inside, 0.0) / a)
            lower = middle - half
            upper = middle + half
        elif qq <= 1.0:  # along the axis of a cylinder, inside it: only its slab cuts
            lower = -math.inf
            upper = math.inf
        else:
            lower = math.inf
            upper = -math.inf
        t0[i] = lower if lower > t0[i] else t0[i]
        t1[i] = upper if upper < t1[i] else t1[i]


@kernel
def add_chords(row, t0, t1, weight, d, e, first):
    """Add weight * chord length [mm] to a row of pixels.

    `row`: (k,) changed in place. `t0`: (k,) beginnings of the chords, in lengths of the rays.
    `t1`: (k,) ends; no chord where t1 < t0. `weight`: factor. `d`: (3,) ray from source to pixel
    of column 0 [mm]. `e`: (3,) its change by a column [mm]. `first`: the first pixel's column.
    """
    for i in range(row.size):
        c = first + i
        dx = d[0] + c * e[0]
        dy = d[1] + c * e[1]
        dz = d[2] + c * e[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        row[i] += np.float32(weight * length * max(t1[i] - t0[i], 0.0))


@kernel
def mapped(m, p, out):
    """Compute out = M p for M as nine numbers."""
    for i in range(3):
        out[i] = m[3 * i] * p[0] + m[3 * i + 1] * p[1] + m[3 * i + 2] * p[2]


@parallel
def project_convex(
    quadric, slabs, slab_range, shadow, rays, weight, channel, out, first_job, last_job
):
    """Fill `out` with weighted chord lengths of convex solids, job by job: BAND_ROWS rows
    of a view each.

    The rows of these jobs are set to zero in every channel first. Chords end at the
    source and at the pixel.

    Args:
        quadric: (k, 13) whether a solid is curved, its matrix and center.
        slabs: slabs of all solids, one after the other.
        slab_range: (k, 2) first slab of each solid and the one after its last.
        shadow: (n, k, 4) rows and columns that a solid can reach, from
            `analytic_solids.shadows`.
        rays: (n, 12) [mm]: source, first pixel center minus source, u, v.
        weight: (k,) factors on the chord lengths.
        channel: (k,) the solid's channel in `out`.
        out: (channels, n, rows, cols).
        first_job: number of the first job.
        last_job: number of the job after the last.
    """
    channels, _, rows, cols = out.shape
    bands = (rows + BAND_ROWS - 1) // BAND_ROWS
    for job in prange(first_job, last_job):
        view = job // bands
        row0 = (job - view * bands) * BAND_ROWS
        row1 = min(rows, row0 + BAND_ROWS)
        # A job owns its rows of the view in every channel, so jobs need no order.
        for k in range(channels):
            out[k, view, row0:row1] = np.float32(0)
        g = rays[view]
        begin = np.empty(cols)
        end = np.empty(cols)
        d = np.empty(3)
        md = np.empty(3)
        me = np.empty(3)
        mq = np.empty(3)
        q = np.empty(3)
        e = g[6:9]
        for s in range(shadow.shape[1]):
            c0, c1 = shadow[view, s, 2], shadow[view, s, 3]
            if c1 <= c0:
                continue
            m = quadric[s, 1:10]
            curved = quadric[s, 0] != 0.0
            if curved:
                for i in range(3):
                    q[i] = g[i] - quadric[s, 10 + i]
                mapped(m, q, mq)
                mapped(m, e, me)
            for r in range(max(row0, shadow[view, s, 0]), min(row1, shadow[view, s, 1])):
                for i in range(3):
                    d[i] = g[3 + i] + r * g[9 + i]
                # A chord ends at the source and at the pixel, in lengths of the ray.
                t0, t1 = begin[c0:c1], end[c0:c1]
                t0[:] = 0.0
                t1[:] = 1.0
                if curved:
                    mapped(m, d, md)
                    cut_by_quadric(t0, t1, mq, md, me, c0)
                for j in range(slab_range[s, 0], slab_range[s, 1]):
                    b = slabs[j]
                    at = b[0] * g[0] + b[1] * g[1] + b[2] * g[2]
                    rate = b[0] * d[0] + b[1] * d[1] + b[2] * d[2]
                    step = b[0] * e[0] + b[1] * e[1] + b[2] * e[2]
                    cut_by_slab(t0, t1, at, b[3], b[4], rate, step, c0)
                add_chords(out[channel[s], view, r, c0:c1], t0, t1, weight[s], d, e, c0)


MESH_BAND_ROWS = 64
"""Detector rows in a job of meshes."""


@kernel
def edge_form(p, i, j, g, form):
    """Compute an edge's affine function a + b c + e r of the pixel into form[0:3].

    It is positive where the ray passes to the left of the edge from the lower to the
    higher vertex number; p (k, 3) seen from the source.
    """
    a, b = (i, j) if i < j else (j, i)
    # p_a x (p_b - p_a): the difference of far vertices would lose the digits that matter.
    ex, ey, ez = p[b, 0] - p[a, 0], p[b, 1] - p[a, 1], p[b, 2] - p[a, 2]
    x = p[a, 1] * ez - p[a, 2] * ey
    y = p[a, 2] * ex - p[a, 0] * ez
    z = p[a, 0] * ey - p[a, 1] * ex
    # The ray to pixel (c, r) is g[3:6] + c g[6:9] + r g[9:12]: its product with p_a x (p_b -
    # p_a) is affine in c and r, so that three numbers say for every pixel on which side it
    # passes.
    for k in range(3):
        at = 3 + 3 * k
        form[k] = g[at] * x + g[at + 1] * y + g[at + 2] * z


@kernel
def draw_row(line, forms, flips, plane, r, c0, c1):
    """Add the signed distances of one triangle to a row of pixels, in lengths of their
    rays: + where the ray leaves the solid, - where it enters; distances are cut to 0
    (source) and 1 (pixel).

    Args:
        line: (cols,) sums of the row, changed in place.
        forms: (3, 3) the edges' forms, from `edge_form`.
        flips: (3,) edges that the triangle runs through from the higher vertex number.
        plane: (4,) the triangle's plane: form of the pixel, and the source's distance.
        r: row.
        c0: first column.
        c1: column after the last.
    """
    a0, b0 = forms[0, 0] + forms[0, 2] * r, forms[0, 1]
    a1, b1 = forms[1, 0] + forms[1, 2] * r, forms[1, 1]
    a2, b2 = forms[2, 0] + forms[2, 2] * r, forms[2, 1]
    n0, n1 = plane[0] + plane[2] * r, plane[1]
    reach = plane[3]
    f0, f1, f2 = flips[0], flips[1], flips[2]
    # `!=` undoes the order of the vertices: an edge that the triangle runs through from the
    # higher number to the lower has the triangle on its other side. Left of all three edges the
    # ray leaves the solid there (+), right of all three it enters (-).
    for c in range(c0, c1):
        left0 = (a0 + b0 * c >= 0.0) != f0
        left1 = (a1 + b1 * c >= 0.0) != f1
        left2 = (a2 + b2 * c >= 0.0) != f2
        if left0 == left1 and left1 == left2:
            speed = n0 + n1 * c
            # In lengths of the ray, from the source (0) to the pixel (1): what lies behind
            # either counts as there, so that a solid that is cut by the panel is cut off at it.
            t = reach / speed if speed != 0.0 else 0.0
            t = min(max(t, 0.0), 1.0)
            line[c] += t if left0 else -t


@kernel
def draw_triangle(sums, p, pixels, face, g, row0, row1, cols, forms, flips, plane):
    """Draw one triangle onto rows row0 to row1 - 1: add its signed distances to `sums`.

    Nothing for a triangle behind the source or beside the rows; of one that reaches
    behind the source every pixel is tried.

    Args:
        sums: (row1 - row0, cols) changed in place.
        p: (k, 3) vertices seen from the source.
        pixels: (k, 3) their column, row, and 1 in front of the source, 0 behind it.
        face: (3,) numbers of its vertices.
        g: (12,) source, first pixel minus source, u, v [mm].
        row0: first row of `sums`.
        row1: row after the last.
        cols: the detector's columns.
        forms: (3, 3) room.
        flips: (3,) room.
        plane: (4,) room.
    """
    i, j, k = face[0], face[1], face[2]
    front = pixels[i, 2] + pixels[j, 2] + pixels[k, 2]
    if front == 0.0:
        return
    # A triangle that reaches behind the source has no bounding box of pixels: every pixel is
    # tried.
    first, last, c0, c1 = row0, row1, 0, cols
    if front == 3.0:
        low = min(pixels[i, 1], min(pixels[j, 1], pixels[k, 1]))
        high = max(pixels[i, 1], max(pixels[j, 1], pixels[k, 1]))
        if high < row0 - 1 or low > row1:
            return
        left = min(pixels[i, 0], min(pixels[j, 0], pixels[k, 0]))
        right = max(pixels[i, 0], max(pixels[j, 0], pixels[k, 0]))
        if right < -1 or left > cols:
            return
        # Each pixel is tested, so the margin changes nothing; one left out would be a hole.
        first = max(row0, math.ceil(low - 1e-6))
        last = min(row1, math.floor(high + 1e-6) + 1)
        c0 = max(0, math.ceil(left - 1e-6))
        c1 = min(cols, math.floor(right + 1e-6) + 1)
    if last <= first or c1 <= c0:
        return
    edge_form(p, i, j, g, forms[0])
    edge_form(p, j, k, g, forms[1])
    edge_form(p, k, i, g, forms[2])
    flips[0], flips[1], flips[2] = i > j, j > k, k > i
    # The plane of the triangle: a ray d meets it at t = (p_i . n) / (d . n), and d . n is
    # affine in the pixel as the edges are.
    ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    for q in range(3):
        at = 3 + 3 * q
        plane[q] = g[at] * nx + g[at + 1] * ny + g[at + 2] * nz
    plane[3] = p[i, 0] * nx + p[i, 1] * ny + p[i, 2] * nz
    for r in range(first, last):
        draw_row(sums[r - row0], forms, flips, plane, r, c0, c1)


@kernel
def locate(vertices, g, inverse, p, pixels):
    """Transform vertices to positions seen from the source and compute their pixel
    coordinates.

    Args:
        vertices: (k, 3) [mm].
        g: (12,) source, first pixel minus source, u, v [mm].
        inverse: (3, 3) of the matrix with columns u, v, first pixel minus source.
        p: (k, 3) filled with positions minus source.
        pixels: (k, 3) filled with column, row and 1; 0 as the third for a vertex behind
            the source.
    """
    for i in range(len(vertices)):
        x = vertices[i, 0] - g[0]
        y = vertices[i, 1] - g[1]
        z = vertices[i, 2] - g[2]
        p[i, 0], p[i, 1], p[i, 2] = x, y, z
        depth = inverse[2, 0] * x + inverse[2, 1] * y + inverse[2, 2] * z
        if depth > 1e-9:
            pixels[i, 0] = (
                inverse[0, 0] * x + inverse[0, 1] * y + inverse[0, 2] * z
            ) / depth
            pixels[i, 1] = (
                inverse[1, 0] * x + inverse[1, 1] * y + inverse[1, 2] * z
            ) / depth
            pixels[i, 2] = 1.0
        else:
            pixels[i, 2] = 0.0


@maker
def make_band(vertices, cols):
    """Create a worker's arrays, not initialized: sums (MESH_BAND_ROWS, cols), positions
    and pixels of the vertices (k, 3) each, edge forms (3, 3), flips (3,), plane (4,).
    """
    return (
        np.empty((MESH_BAND_ROWS, cols)),
        np.empty((vertices, 3)),
        np.empty((vertices, 3)),
        np.empty((3, 3)),
        np.empty(3, np.bool_),
        np.empty(4),
    )


@parallel
def project_triangles(vertices, faces, rays, inverses, workers, out, first_job, last_job):
    """Fill `out` with path lengths through a closed mesh, job by job: MESH_BAND_ROWS rows
    of a view each.

    Args:
        vertices: (k, 3) [mm].
        faces: (m, 3) numbers of vertices.
        rays: (n, 12) [mm]: source, first pixel minus source, u, v.
        inverses: (n, 3, 3) of the matrix with columns u, v, first pixel minus source.
        workers: number of threads.
        out: (n, rows, cols) [mm].
        first_job: number of the first job.
        last_job: number of the job after the last.
    """
    rows, cols = out.shape[1:]
    bands = (rows + MESH_BAND_ROWS - 1) // MESH_BAND_ROWS
    counter = np.full(1, first_job, np.int64)
    for _ in prange(workers):
        sums, p, pixels, forms, flips, plane = make_band(len(vertices), cols)
        seen = -1
        job = fetch_next(counter)
        while job < last_job:
            view = job // bands
            row0 = job % bands * MESH_BAND_ROWS
            row1 = min(rows, row0 + MESH_BAND_ROWS)
            g = rays[view]
            if view != seen:
                locate(vertices, g, inverses[view], p, pixels)
                seen = view
            sums[:] = 0.0
            for f in range(len(faces)):
                draw_triangle(
                    sums, p, pixels, faces[f], g, row0, row1, cols, forms, flips, plane
                )
            for r in range(row0, row1):
                for c in range(cols):
                    total = sums[r - row0, c]
                    dx = g[3] + c * g[6] + r * g[9]
                    dy = g[4] + c * g[7] + r * g[10]
                    dz = g[5] + c * g[8] + r * g[11]
                    length = math.sqrt(dx * dx + dy * dy + dz * dz)
                    out[view, r, c] = np.float32(total * length)
            job = fetch_next(counter)
