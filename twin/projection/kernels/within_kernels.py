"""Several rays in the pixels that need them: which pixels an edge of a solid or of a mesh reaches,
and paths along the rays in these. Double precision.

A pixel needs one ray where a solid's chord changes smoothly over its area, and more where the
chord has a kink there: at an outline, or where another face becomes the nearest. Whether it has
one follows from the range, over the pixel, of the distances at which each surface is met; no
sample can miss a part between rays. Of a mesh the kinks lie on its edges, which are drawn onto
the pixels they touch.

How many rays: with k of them a step of height C comes out in k steps, so its error is C / (sqrt(12)
k) as a standard deviation. The rays of a pixel are `rays_aside`: n x n, or n x (n + 1), no two in
one row or column. Marks have both sides together, less one: 1 for one ray, 2 for two, 3 for 2 x 2,
4 for 2 x 3.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels import analytic_kernels
from flexdt.twin.projection.kernels.analytic_kernels import edge_form, locate, mapped
from flexdt.twin.projection.kernels.compiling import inline, kernel, parallel, sources

SOURCES = sources(analytic_kernels)
MAX_MARK = 31
"""Largest mark: 16 x 16 rays."""
STEP_SPREAD = math.sqrt(12.0)
"""Height of a step over the standard deviation of where it falls between two of its steps."""
CURVED_SPREAD = 24.0
"""Square of a slope across a pixel over the error of its middle, relative, of an exponential."""
RIM_REACHES = 2.0
"""Half pixels from the outline of a curved solid within which its chord counts as bent."""
BLOCK, CELL = 16, 4
"""Pixels along a side of the squares that are looked at first, of which quarters follow, and of
those whose pixels are looked at together, at their nearest surfaces."""
PIXELS = CELL * CELL
LEAST_IN, MOST_IN, LEAST_OUT, MOST_OUT = 0, PIXELS, 2 * PIXELS, 3 * PIXELS
"""Where, of a cell's pixels, the ranges of the distances lie at which rays enter and leave."""
QUADRIC_IN, QUADRIC_OUT, RIM = 4 * PIXELS, 5 * PIXELS, 6 * PIXELS
"""The quadric's largest entry and least exit, and 1 where its outline is near."""
FIRSTS, LASTS, COLUMN, ROW = 7 * PIXELS, 8 * PIXELS, 9 * PIXELS, 10 * PIXELS
"""How many surfaces may be the first and the last; column and row."""
CHANGE, SURE, SEVERAL = 11 * PIXELS, 12 * PIXELS, 13 * PIXELS
"""Change of the line integral, its least value, and whether the pixel needs several rays: 1
because the chord changes evenly and fast, 2 because it bends."""
SPARE = 14 * PIXELS
"""From where on each slab has two rows: largest entry, least exit."""


@inline
def mark_of(rays):
    """Compute the mark of a pixel that needs at least so many rays."""
    most = ((MAX_MARK + 1) // 2) ** 2
    rays = min(max(rays, 1.0), most)
    whole = math.ceil(2.0 * math.sqrt(rays))
    return whole - 1 if (whole // 2) * ((whole + 1) // 2) >= rays else whole


@inline
def rays_of(mark):
    """Compute the number of rays of a mark."""
    mark = np.int64(mark)
    return ((mark + 1) // 2) * (mark // 2 + 1)


@inline
def mark_for_step(change, error, counts, least=0.0):
    """Compute the mark of a pixel within which the line integral bends or jumps by at most
    `change`.

    Args:
        change: largest difference of line integrals within the pixel.
        error: permitted, as a standard deviation; part of the open beam for counts.
        counts: whether signals are averaged, which differ by less than line integrals.
        least: no line integral of the pixel is below it.
    """
    height = change
    if counts:
        height = 1.0 - math.exp(-change)
        if least > 0.0:
            height *= math.exp(-least)
    return mark_of(height / (STEP_SPREAD * error))


@inline
def mark_for_slope(change, error, counts, least=0.0):
    """Compute the mark of a pixel across which the line integral changes evenly by `change`:
    its mean is that of the middle, that of signals is not. Arguments as of `mark_for_step`.
    """
    if not counts:
        return 1
    return mark_of(change * change * math.exp(-least) / (CURVED_SPREAD * error))


@inline
def rays_aside(k, mark):
    """Compute the place of ray k of a mark's in its pixel, (columns, rows) from the center."""
    a = (np.int64(mark) + 1) // 2
    b = np.int64(mark) // 2 + 1
    j = k // a
    i = k - j * a
    return (i + (j + 0.5) / b) / a - 0.5, (j + (a - i - 0.5) / a) / b - 0.5


@inline
def slab_ranges(low, high, at, speed, reach):
    """Compute the ranges, over a pixel, of the distances at which its rays enter and leave
    a slab: (least entry, largest entry, least exit, largest exit), in lengths of the rays.

    Args:
        low, high: the slab's limits.
        at: the source's height above its plane.
        speed: height of the ray to the pixel's center, above the source.
        reach: largest change of `speed` within the pixel.
    """
    size = abs(speed)
    if size > reach:
        inverse = 1.0 / ((size - reach) * (size + reach))
        slow = (size + reach) * inverse
        fast = (size - reach) * inverse
        near, far = (low - at, high - at) if speed > 0.0 else (at - high, at - low)
        a0, a1 = (near * fast, near * slow) if near >= 0.0 else (near * slow, near * fast)
        b0, b1 = (far * fast, far * slow) if far >= 0.0 else (far * slow, far * fast)
        return a0, a1, b0, b1
    least = 1.0 / max(size + reach, 1e-300)
    if at < low or at > high:  # some rays may meet it, others not
        gap = low - at if at < low else at - high
        return gap * least, math.inf, 0.0, math.inf
    gap = min(at - low, high - at)
    return -math.inf, -gap * least, gap * least, math.inf


@inline
def quadric_ranges(q, d, u, v, size_px, side):
    """Compute the ranges, over a pixel, at which its rays enter and leave |q + t d| <= 1, as
    `slab_ranges`, and whether the outline is near.

    Args:
        q: (3,) the source, mapped by the quadric's matrix, as are all others.
        d: (3,) ray to the pixel's center.
        u, v: (3,) sides of a detector pixel.
        size_px: detector pixels along a side.
        side: lengths of u and v together.
    """
    a = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    size = math.sqrt(a)
    half = 0.5 * size_px * side
    if size <= 2.0 * half:  # (nearly) along the axis of a cylinder
        return 0.0, 1.0, 0.0, 1.0, True
    middle = -(q[0] * d[0] + q[1] * d[1] + q[2] * d[2]) / a
    x = q[0] + middle * d[0]
    y = q[1] + middle * d[1]
    z = q[2] + middle * d[2]
    away = math.sqrt(x * x + y * y + z * z)
    reach = abs(middle) * half
    if away - reach >= 1.0:
        return 1.0, 1.0, 0.0, 0.0, False
    du = d[0] * u[0] + d[1] * u[1] + d[2] * u[2]
    dv = d[0] * v[0] + d[1] * v[1] + d[2] * v[2]
    xu = x * u[0] + y * u[1] + z * u[2]
    xv = x * v[0] + y * v[1] + z * v[2]
    moved = 0.5 * size_px * (abs(middle * du + xu) + abs(middle * dv + xv)) / a
    bent = 0.5 * size_px * (abs(du) + abs(dv)) / a
    inner = max(away - reach, 0.0)
    outer = away + reach
    largest = math.sqrt(max(1.0 - inner * inner, 0.0)) / size * (1.0 + bent)
    least = math.sqrt(max(1.0 - outer * outer, 0.0)) / size * (1.0 - bent)
    rim = away + RIM_REACHES * reach >= 1.0
    return (
        middle - moved - largest,
        middle + moved - least,
        middle - moved + least,
        middle + moved + largest,
        rim,
    )


@inline
def bends(c, r, size, curved, forms, slabs, room, g, weight, error):
    """Whether, of a square of pixels, one may need several rays for one convex solid.

    Args:
        c, r: column and row of the square's middle.
        size: its side [pixels].
        curved: whether the solid has a quadric.
        forms: of `solid_forms`; the first `slabs` count. Their last two columns are filled with
            the largest entry and the least exit.
        room: of `solid_forms`; room[4] is spare, room[5, 1:] filled with the least entry into
            the solid and the largest exit.
        g: (12,) the view's rays [mm].
        weight, error: as of `mark_convex`.
    """
    # The solid is entered at the largest of its surfaces' entries and left at the least of the
    # exits; chords end at the source and at the panel. Ranges over the square.
    e0, e1, l0, l1 = 0.0, 0.0, 1.0, 1.0
    qa, qb = -math.inf, math.inf
    rim = False
    if curved:
        for i in range(3):
            room[4, i] = room[1, i] + c * room[2, i] + r * room[3, i]
        a0, qa, qb, b1, rim = quadric_ranges(
            room[0], room[4], room[2], room[3], size, room[5, 0]
        )
        e0, e1 = max(e0, a0), max(e1, qa)
        l0, l1 = min(l0, qb), min(l1, b1)
        if l1 <= e0:
            return False
    for j in range(slabs):
        a0, a1, b0, b1 = ranges_of(forms[j], c, r, size)
        forms[j, 6], forms[j, 7] = a1, b0
        e0, e1 = max(e0, a0), max(e1, a1)
        l0, l1 = min(l0, b0), min(l1, b1)
        if l1 <= e0:
            return False
    room[5, 1], room[5, 2] = e0, l1
    x = g[3] + c * g[6] + r * g[9]
    y = g[4] + c * g[7] + r * g[10]
    z = g[5] + c * g[8] + r * g[11]
    sure = max(l0 - e1, 0.0)
    change = ((l1 - e0) - sure) * (math.sqrt(x * x + y * y + z * z) * weight)
    if change <= STEP_SPREAD * error:  # signals differ by less still
        return False
    if rim or l0 <= e1 or change * change > CURVED_SPREAD * error:
        return True
    # All rays meet it. Bent where more than one surface may be the first, or the last.
    entries = exits = 0
    entries += e0 <= 0.0
    exits += l1 >= 1.0
    entries += qa >= e0
    exits += qb <= l1
    for j in range(slabs):
        entries += forms[j, 6] >= e0
        exits += forms[j, 7] <= l1
    return entries > 1 or exits > 1


@kernel
def cell_ranges(curved, forms, slabs, room, g, top, left, weight, error, lane):
    """Fill `lane` with what `mark_cell` asks of each pixel of a cell, in loops without branches,
    so that they vectorise.

    Args:
        curved, forms, slabs, room, g, weight, error: as of `bends`.
        top, left: the cell's first pixel.
        lane: (SPARE + 2 k PIXELS,) filled, in rows of PIXELS. One array: of several the compiler
            would have to ask whether they are the same memory, and gives up.
    """
    for k in range(PIXELS):
        lane[COLUMN + k], lane[ROW + k] = left + k % CELL, top + k // CELL
        lane[LEAST_IN + k] = lane[MOST_IN + k] = lane[RIM + k] = 0.0
        lane[LEAST_OUT + k] = lane[MOST_OUT + k] = 1.0
        lane[QUADRIC_IN + k], lane[QUADRIC_OUT + k] = -math.inf, math.inf
    if curved:
        # Read before the loop: what it writes might else be the same memory.
        q0, q1, q2 = room[0, 0], room[0, 1], room[0, 2]
        f0, f1, f2 = room[1, 0], room[1, 1], room[1, 2]
        u0, u1, u2 = room[2, 0], room[2, 1], room[2, 2]
        v0, v1, v2 = room[3, 0], room[3, 1], room[3, 2]
        half = 0.5 * room[5, 0]
        for k in range(PIXELS):
            # As of `quadric_ranges`.
            c, r = lane[COLUMN + k], lane[ROW + k]
            d0 = f0 + c * u0 + r * v0
            d1 = f1 + c * u1 + r * v1
            d2 = f2 + c * u2 + r * v2
            a = d0 * d0 + d1 * d1 + d2 * d2
            size = math.sqrt(a)
            along = size <= 2.0 * half
            middle = -(q0 * d0 + q1 * d1 + q2 * d2) / a
            x, y, z = q0 + middle * d0, q1 + middle * d1, q2 + middle * d2
            away = math.sqrt(x * x + y * y + z * z)
            reach = abs(middle) * half
            du = d0 * u0 + d1 * u1 + d2 * u2
            dv = d0 * v0 + d1 * v1 + d2 * v2
            xu = x * u0 + y * u1 + z * u2
            xv = x * v0 + y * v1 + z * v2
            moved = 0.5 * (abs(middle * du + xu) + abs(middle * dv + xv)) / a
            bent = 0.5 * (abs(du) + abs(dv)) / a
            inner, outer = max(away - reach, 0.0), away + reach
            largest = math.sqrt(max(1.0 - inner * inner, 0.0)) / size * (1.0 + bent)
            least = math.sqrt(max(1.0 - outer * outer, 0.0)) / size * (1.0 - bent)
            missed = away - reach >= 1.0
            lane[LEAST_IN + k] = max(
                0.0, 0.0 if along else (1.0 if missed else middle - moved - largest)
            )
            lane[QUADRIC_IN + k] = 1.0 if along else middle + moved - least
            lane[QUADRIC_OUT + k] = 0.0 if along else middle - moved + least
            lane[MOST_OUT + k] = min(
                1.0, 1.0 if along else (0.0 if missed else middle + moved + largest)
            )
            lane[RIM + k] = 1.0 if along | (away + RIM_REACHES * reach >= 1.0) else 0.0
            lane[MOST_IN + k] = max(0.0, lane[QUADRIC_IN + k])
            lane[LEAST_OUT + k] = min(1.0, lane[QUADRIC_OUT + k])
    for j in range(slabs):
        low, high, at = forms[j, 0], forms[j, 1], forms[j, 2]
        first_in = SPARE + 2 * PIXELS * j
        last_out = first_in + PIXELS
        s0, s1, s2 = forms[j, 3], forms[j, 4], forms[j, 5]
        reach = 0.5 * (abs(s1) + abs(s2))
        outside = at < low or at > high
        gap = min(at - low, high - at)
        if outside:
            gap = low - at if at < low else at - high
        for k in range(PIXELS):
            # As of `slab_ranges`.
            speed = s0 + lane[COLUMN + k] * s1 + lane[ROW + k] * s2
            size = abs(speed)
            level = size <= reach  # some rays may be along the slab
            inverse = 1.0 / (1.0 if level else (size - reach) * (size + reach))
            slow, fast = (size + reach) * inverse, (size - reach) * inverse
            near = low - at if speed > 0.0 else at - high
            far = high - at if speed > 0.0 else at - low
            least = gap / max(size + reach, 1e-300)
            a0 = near * fast if near >= 0.0 else near * slow
            a1 = near * slow if near >= 0.0 else near * fast
            b0 = far * fast if far >= 0.0 else far * slow
            b1 = far * slow if far >= 0.0 else far * fast
            a0 = (least if outside else -math.inf) if level else a0
            a1 = (math.inf if outside else -least) if level else a1
            b0 = (0.0 if outside else least) if level else b0
            b1 = math.inf if level else b1
            lane[first_in + k], lane[last_out + k] = a1, b0
            lane[LEAST_IN + k], lane[MOST_IN + k] = (
                max(lane[LEAST_IN + k], a0),
                max(lane[MOST_IN + k], a1),
            )
            lane[LEAST_OUT + k], lane[MOST_OUT + k] = (
                min(lane[LEAST_OUT + k], b0),
                min(lane[MOST_OUT + k], b1),
            )
    for k in range(PIXELS):
        lane[FIRSTS + k] = (1.0 if lane[LEAST_IN + k] <= 0.0 else 0.0) + (
            1.0 if lane[QUADRIC_IN + k] >= lane[LEAST_IN + k] else 0.0
        )
        lane[LASTS + k] = (1.0 if lane[MOST_OUT + k] >= 1.0 else 0.0) + (
            1.0 if lane[QUADRIC_OUT + k] <= lane[MOST_OUT + k] else 0.0
        )
    for j in range(slabs):
        first_in = SPARE + 2 * PIXELS * j
        last_out = first_in + PIXELS
        for k in range(PIXELS):
            lane[FIRSTS + k] += 1.0 if lane[first_in + k] >= lane[LEAST_IN + k] else 0.0
            lane[LASTS + k] += 1.0 if lane[last_out + k] <= lane[MOST_OUT + k] else 0.0
    g3, g4, g5, g6, g7, g8 = g[3], g[4], g[5], g[6], g[7], g[8]
    g9, g10, g11 = g[9], g[10], g[11]
    for k in range(PIXELS):
        c, r = lane[COLUMN + k], lane[ROW + k]
        x = g3 + c * g6 + r * g9
        y = g4 + c * g7 + r * g10
        z = g5 + c * g8 + r * g11
        scale = math.sqrt(x * x + y * y + z * z) * weight
        e0, l1 = lane[LEAST_IN + k], lane[MOST_OUT + k]
        all_rays = lane[LEAST_OUT + k] > lane[MOST_IN + k]
        sure = max(lane[LEAST_OUT + k] - lane[MOST_IN + k], 0.0)
        change = ((l1 - e0) - sure) * scale
        bent = (
            (lane[RIM + k] > 0.0)
            | (not all_rays)
            | (lane[FIRSTS + k] > 1.0)
            | (lane[LASTS + k] > 1.0)
        )
        # Below, signals differ by less still.
        seen = (l1 > e0) & (change > STEP_SPREAD * error)
        several = seen & (bent | (change * change > CURVED_SPREAD * error))
        lane[CHANGE + k] = change
        lane[SURE + k] = sure * scale
        lane[SEVERAL + k] = (2.0 if bent else 1.0) if several else 0.0


@kernel
def mark_cell(top, left, r0, r1, c0, c1, lane, filled, error, counts, marks):
    """Raise the marks of a cell of CELL x CELL pixels.

    Args:
        top, left: its first pixel.
        r0, r1, c0, c1: pixels that count.
        lane: filled by `cell_ranges`.
        filled, error, counts: as of `mark_convex`.
        marks: (rows, cols) changed in place.
    """
    for k in range(PIXELS):
        several = lane[SEVERAL + k]
        if several == 0.0:
            continue
        r, c = top + k // CELL, left + k % CELL
        if r < r0 or r >= r1 or c < c0 or c >= c1:
            continue
        change = lane[CHANGE + k]
        least = lane[SURE + k] if filled else 0.0
        need = mark_for_step(change, error, counts, least)
        if several < 2.0:
            need = min(need, mark_for_slope(change, error, counts, least))
        marks[r, c] = max(marks[r, c], need)


@kernel
def nearest_forms(forms, slabs, room, near):
    """Take the slabs by which a solid may be entered or left within a square of pixels, and so
    within all of its pixels, and count them.

    Args:
        forms, slabs, room: as `bends` has left them.
        near: (k, 8) filled.
    """
    count = 0
    for j in range(slabs):
        if forms[j, 6] >= room[5, 1] or forms[j, 7] <= room[5, 2]:
            for i in range(6):
                near[count, i] = forms[j, i]
            count += 1
    return count


@inline
def ranges_of(form, c, r, size):
    """Compute `slab_ranges` of a slab's form for a square of pixels, as of `bends`."""
    speed = form[3] + c * form[4] + r * form[5]
    reach = 0.5 * size * (abs(form[4]) + abs(form[5]))
    return slab_ranges(form[0], form[1], form[2], speed, reach)


@kernel
def solid_forms(quadric, slabs, first, last, g, forms, room):
    """Compute what of a solid is the same for all pixels of a view.

    Args:
        quadric: (13,) of the solid; slabs, first, last: its slabs.
        g: (12,) the view's rays [mm].
        forms: (k, 8) filled for each slab: limits, the source's height, and the height of the
            ray to a pixel as a form of column and row; two are spare.
        room: (6, 3) filled: source, first pixel's ray and the pixel's sides, mapped by the
            quadric's matrix; a spare row; and the lengths of both sides together.
    """
    if quadric[0] != 0.0:
        for i in range(3):
            room[4, i] = g[i] - quadric[10 + i]
        mapped(quadric[1:10], room[4], room[0])
        mapped(quadric[1:10], g[3:6], room[1])
        mapped(quadric[1:10], g[6:9], room[2])
        mapped(quadric[1:10], g[9:12], room[3])
        u, v = room[2], room[3]
        room[5, 0] = math.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2]) + math.sqrt(
            v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
        )
    for j in range(first, last):
        b = slabs[j]
        form = forms[j - first]
        form[0], form[1] = b[3], b[4]
        for i in range(4):
            form[2 + i] = b[0] * g[3 * i] + b[1] * g[3 * i + 1] + b[2] * g[3 * i + 2]


@inline
def odd_bits(k):
    """Take bits 0, 2, 4 and 6 of a number."""
    return (k & 1) | (k >> 1 & 2) | (k >> 2 & 4) | (k >> 3 & 8)


@kernel
def mark_block(
    curved,
    forms,
    slabs,
    near,
    lane,
    room,
    g,
    top,
    left,
    r0,
    r1,
    c0,
    c1,
    weight,
    filled,
    error,
    counts,
    marks,
):
    """Raise the marks of a block of BLOCK x BLOCK pixels: of those of its squares in which the
    chord bends, because a square without a bend has none in any of its pixels.

    Args:
        curved, forms, slabs, room: as of `bends`.
        near, lane: room for as many forms, and for `cell_ranges`.
        g, weight, filled, error, counts: as of `mark_convex`.
        top, left: the block's first pixel.
        r0, r1, c0, c1: pixels that count.
        marks: (rows, cols) changed in place.
    """
    # Along a curve on which each square's quarters follow one another: a square that needs no
    # rays is passed over, of others the quarters are next, and of cells the pixels. Squares
    # before them are done.
    # Not literals, for which `bends` would be compiled a second time.
    k, size = np.int64(0), np.int64(BLOCK)
    while k < BLOCK * BLOCK:
        i, j = top + odd_bits(k >> 1), left + odd_bits(k)
        half = 0.5 * (size - 1)
        several = False
        if i < r1 and j < c1 and i + size > r0 and j + size > c0:
            several = bends(
                j + half, i + half, size, curved, forms, slabs, room, g, weight, error
            )
        if several and size > CELL:
            size //= 2
            continue
        if several:
            few = nearest_forms(forms, slabs, room, near)
            cell_ranges(curved, near, few, room, g, i, j, weight, error, lane)
            mark_cell(i, j, r0, r1, c0, c1, lane, filled, error, counts, marks)
        k += size * size
        size = np.int64(CELL)
        while k % (4 * size * size) == 0 and size < BLOCK:
            size *= 2


@kernel
def cut_rays(quadric, slabs, first, last, g, dx, dy, dz, t0, t1):
    """Fill t0 and t1 with the pieces of rays within a convex solid, in lengths of the rays;
    t1 <= t0 where there is none. Loops without branches, so that they vectorise.

    Args:
        quadric: (13,) of the solid; slabs, first, last: its slabs.
        g: (12,) the view's rays [mm].
        dx, dy, dz: (k,) the rays, from the source to their places on the panel.
        t0, t1: (k,) filled.
    """
    t0[:] = 0.0
    t1[:] = 1.0
    if quadric[0] != 0.0:
        x, y, z = g[0] - quadric[10], g[1] - quadric[11], g[2] - quadric[12]
        qx = quadric[1] * x + quadric[2] * y + quadric[3] * z
        qy = quadric[4] * x + quadric[5] * y + quadric[6] * z
        qz = quadric[7] * x + quadric[8] * y + quadric[9] * z
        qq = qx * qx + qy * qy + qz * qz
        for k in range(dx.size):
            ex = quadric[1] * dx[k] + quadric[2] * dy[k] + quadric[3] * dz[k]
            ey = quadric[4] * dx[k] + quadric[5] * dy[k] + quadric[6] * dz[k]
            ez = quadric[7] * dx[k] + quadric[8] * dy[k] + quadric[9] * dz[k]
            a = ex * ex + ey * ey + ez * ez
            # Along the axis of a cylinder it is inside for all t or for none.
            inverse = 1.0 / max(a, 1e-30)
            middle = -(qx * ex + qy * ey + qz * ez) * inverse
            rx, ry, rz = qx + middle * ex, qy + middle * ey, qz + middle * ez
            inside = 1.0 - (rx * rx + ry * ry + rz * rz)
            half = math.sqrt(max(inside, 0.0) * inverse)
            t0[k] = max(0.0, middle - half)
            t1[k] = min(1.0, middle + half)
        if qq > 1.0:
            for k in range(dx.size):
                t1[k] = t1[k] if t1[k] > t0[k] else -1.0
    for j in range(first, last):
        nx, ny, nz = slabs[j, 0], slabs[j, 1], slabs[j, 2]
        at = nx * g[0] + ny * g[1] + nz * g[2]
        low, high = slabs[j, 3] - at, slabs[j, 4] - at
        for k in range(dx.size):
            speed = nx * dx[k] + ny * dy[k] + nz * dz[k]
            inverse = 1.0 / (speed if speed != 0.0 else 1e-300)
            near, far = low * inverse, high * inverse
            t0[k] = max(t0[k], min(near, far))
            t1[k] = min(t1[k], max(near, far))


@kernel
def by_tiles(places, rows, cols, side, order, ends):
    """Sort pixels by tiles of `side` x `side`, those of a tile in their order.

    Args:
        places: (m,) flat, in images (n, rows, cols), growing.
        rows, cols, side: see above.
        order: (m,) filled with numbers of pixels.
        ends: (tiles + 1,) zeros, filled with the place in `order` of each tile's first pixel,
            and m.
    """
    down, across = (rows + side - 1) // side, (cols + side - 1) // side
    for i in range(places.size):
        line = places[i] // cols
        view = line // rows
        tile = (view * down + (line - view * rows) // side) * across
        ends[tile + (places[i] - line * cols) // side + 1] += 1
    for tile in range(ends.size - 1):
        ends[tile + 1] += ends[tile]
    for i in range(places.size):
        line = places[i] // cols
        view = line // rows
        tile = (view * down + (line - view * rows) // side) * across
        tile += (places[i] - line * cols) // side
        order[ends[tile]] = i
        ends[tile] += 1
    # Dealing out has moved each tile's first place to the next tile's: shift them back.
    for tile in range(ends.size - 2, 0, -1):
        ends[tile] = ends[tile - 1]
    ends[0] = 0


@parallel
def chords_within(
    quadric,
    slabs,
    slab_range,
    shadow,
    rays,
    weight,
    places,
    marks,
    starts,
    shape,
    side,
    out,
):
    """Fill `out` with line integrals of convex solids along several rays of some pixels.

    The rays of a tile's pixels are cut by one surface after the other.

    Args:
        quadric, slabs, slab_range, rays: as of `mark_convex`.
        shadow: (n, k, 4), a pixel wider.
        weight: (k,) factors on the chords.
        places: (m,) flat, in images (n, *shape), growing.
        marks: (m,) of each.
        starts: (m + 1,) place of its first ray.
        shape: (rows, cols).
        side: pixels along a side of a tile.
        out: float32, filled.
    """
    rows, cols = shape
    tiles = len(rays) * ((rows + side - 1) // side) * ((cols + side - 1) // side)
    order = np.empty(places.size, np.int64)
    ends = np.zeros(tiles + 1, np.int64)
    by_tiles(places, rows, cols, side, order, ends)
    for tile in prange(tiles):
        chosen = order[ends[tile] : ends[tile + 1]]
        if chosen.size == 0:
            continue
        view = places[chosen[0]] // (rows * cols)
        g = rays[view]
        row, column = np.empty(chosen.size, np.int64), np.empty(chosen.size, np.int64)
        count = 0
        left, right = cols, 0
        for i in range(chosen.size):
            line = places[chosen[i]] // cols
            row[i], column[i] = line - view * rows, places[chosen[i]] - line * cols
            count += starts[chosen[i] + 1] - starts[chosen[i]]
            left, right = min(left, column[i]), max(right, column[i])
        top, bottom = row[0], row[-1]
        dx, dy, dz = np.empty(count), np.empty(count), np.empty(count)
        t0, t1, total = np.empty(count), np.empty(count), np.zeros(count)
        # Pixels are in the order of their rows: those from one row on are the rays from a place on.
        height = bottom - top + 1
        of_row = np.full(height + 1, count)
        n = 0
        begun = -1
        for i in range(chosen.size):
            while begun < row[i] - top:
                begun += 1
                of_row[begun] = n
            mark = marks[chosen[i]]
            for k in range(rays_of(mark)):
                x, y = rays_aside(k, mark)
                x += column[i]
                y += row[i]
                dx[n] = g[3] + x * g[6] + y * g[9]
                dy[n] = g[4] + x * g[7] + y * g[10]
                dz[n] = g[5] + x * g[8] + y * g[11]
                n += 1
        for s in range(shadow.shape[1]):
            near = shadow[view, s]
            if near[0] > bottom or near[1] <= top or near[2] > right or near[3] <= left:
                continue
            a, b = slab_range[s, 0], slab_range[s, 1]
            p, q = of_row[max(near[0] - top, 0)], of_row[min(near[1] - top, height)]
            if q > p:
                cut_rays(
                    quadric[s],
                    slabs,
                    a,
                    b,
                    g,
                    dx[p:q],
                    dy[p:q],
                    dz[p:q],
                    t0[p:q],
                    t1[p:q],
                )
            factor = weight[s]
            for k in range(p, q):
                total[k] += factor * max(t1[k] - t0[k], 0.0)
        for k in range(count):
            total[k] *= math.sqrt(dx[k] * dx[k] + dy[k] * dy[k] + dz[k] * dz[k])
        n = 0
        for i in range(chosen.size):
            for k in range(starts[chosen[i]], starts[chosen[i] + 1]):
                out[k] = np.float32(total[n])
                n += 1


@parallel
def average_parts(images, n, out):
    """Average images over n x n pixels: columns first, then rows of sums, in single precision.

    Args:
        images: float32 (k, n rows, n cols).
        n: pixels along a side.
        out: float32 (k, rows, cols), filled.
    """
    rows, cols = out.shape[1], out.shape[2]
    share = np.float32(1.0 / (n * n))
    for job in prange(out.shape[0] * rows):
        view = job // rows
        r = job - view * rows
        down = images[view, n * r].copy()
        for i in range(1, n):
            part = images[view, n * r + i]
            for c in range(n * cols):
                down[c] += part[c]
        line = out[view, r]
        for c in range(cols):
            total = down[n * c]
            for j in range(1, n):
                total += down[n * c + j]
            line[c] = total * share


@kernel
def raise_marks(marks, x, y, need):
    """Raise the marks of every pixel that a triangle touches to `need`; of two equal corners
    it is a line.

    Args:
        marks: (rows, cols) changed in place.
        x, y: (3,) columns and rows of its corners.
        need: a mark.
    """
    rows, cols = marks.shape
    low = min(y[0], min(y[1], y[2]))
    high = max(y[0], max(y[1], y[2]))
    if high < -1.0 or low > rows:
        return
    for r in range(max(0, math.floor(low + 0.5)), min(rows, math.floor(high + 0.5) + 1)):
        left, right = math.inf, -math.inf
        for i in range(3):
            j = (i + 1) % 3
            t0, t1 = 0.0, 1.0
            rise = y[j] - y[i]
            # The part of this side within the row.
            if rise != 0.0:
                a = (r - 0.5 - y[i]) / rise
                b = (r + 0.5 - y[i]) / rise
                t0, t1 = max(t0, min(a, b)), min(t1, max(a, b))
            elif abs(y[i] - r) > 0.5:
                continue
            if t0 > t1:
                continue
            p, q = x[i] + t0 * (x[j] - x[i]), x[i] + t1 * (x[j] - x[i])
            left = min(left, min(p, q))
            right = max(right, max(p, q))
        if right < -1.0 or left > cols:
            continue
        for c in range(
            max(0, math.floor(left + 0.5)), min(cols, math.floor(right + 0.5) + 1)
        ):
            marks[r, c] = max(marks[r, c], need)


@kernel
def slopes_of(p, face, g, out):
    """Compute the plane of a face as a form of the pixel, (3,): a ray meets it at a distance in
    proportion to 1 / form.

    `p`: (k, 3) vertices seen from the source; `face`: (3,) numbers of vertices; `g`: (12,) the
    view's rays; `out`: (3,) filled.
    """
    i, j, k = face[0], face[1], face[2]
    ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
    bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    for q in range(3):
        at = 3 + 3 * q
        out[q] = g[at] * nx + g[at + 1] * ny + g[at + 2] * nz


@inline
def slope_at(plane, c, r):
    """Compute the change of a face's distance by a column and by a row, relative to the
    distance; huge where the face is seen edge on.
    """
    form = plane[0] + c * plane[1] + r * plane[2]
    if abs(form) < 1e-12 * (abs(plane[0]) + abs(plane[1]) + abs(plane[2])):
        return 1e12, 1e12
    return -plane[1] / form, -plane[2] / form


def _entry_points(key: int):  # type: ignore[no-untyped-def]
    """Make the entry points that inline kernels of other files; `key` is a hash of their text,
    so that they are compiled anew with it.
    """

    @parallel
    def mark_convex(
        quadric, slabs, slab_range, shadow, rays, weight, filled, error, counts, marks
    ):
        """Raise `marks` to what each pixel needs for convex solids.

        Args:
            quadric, slabs, slab_range: as of `analytic_kernels.project_convex`.
            shadow: (n, k, 4) rows and columns that a solid can reach, a pixel wider.
            rays: (n, 12) [mm]: source, first pixel minus source, u, v.
            weight: (k,) attenuation along the chords [1/mm], not negative.
            filled: whether no solid takes away from another.
            error, counts: as of `mark_for_step`.
            marks: uint8 (n, rows, cols), changed in place.
        """
        _ = key
        rows = marks.shape[1]
        most = 1
        for s in range(len(slab_range)):
            most = max(most, slab_range[s, 1] - slab_range[s, 0])
        bands = (rows + BLOCK - 1) // BLOCK
        for job in prange(len(rays) * bands):
            view = job // bands
            row0 = (job - view * bands) * BLOCK
            row1 = min(rows, row0 + BLOCK)
            g = rays[view]
            room = np.empty((6, 3))
            forms, near = np.empty((most, 8)), np.empty((most, 8))
            lane = np.empty(SPARE + 2 * most * PIXELS)
            for s in range(shadow.shape[1]):
                c0, c1 = shadow[view, s, 2], shadow[view, s, 3]
                r0, r1 = max(row0, shadow[view, s, 0]), min(row1, shadow[view, s, 1])
                if c1 <= c0 or r1 <= r0 or weight[s] == 0.0:
                    continue
                first, last = slab_range[s, 0], slab_range[s, 1]
                solid_forms(quadric[s], slabs, first, last, g, forms, room)
                for left in range(c0 // BLOCK * BLOCK, c1, BLOCK):
                    mark_block(
                        quadric[s, 0] != 0.0,
                        forms,
                        last - first,
                        near,
                        lane,
                        room,
                        g,
                        row0,
                        left,
                        r0,
                        r1,
                        c0,
                        c1,
                        weight[s],
                        filled,
                        error,
                        counts,
                        marks[view],
                    )

    @parallel
    def mark_mesh(
        vertices, faces, edges, rays, inverses, weight, largest, error, counts, marks
    ):
        """Raise `marks` to what each pixel needs for a closed mesh: along edges where the path
        bends, and on faces that are seen steeply.

        Args:
            vertices: (k, 3) [mm].
            faces: (m, 3) numbers of vertices.
            edges: (e, 4) two vertices, and the two faces that share them.
            rays, inverses: as of `analytic_kernels.project_triangles`.
            weight: attenuation [1/mm].
            largest: no path is longer [mm].
            error, counts: as of `mark_for_step`.
            marks: uint8 (n, rows, cols), changed in place.
        """
        _ = key
        for view in prange(len(rays)):
            g = rays[view]
            p = np.empty((len(vertices), 3))
            pixels = np.empty((len(vertices), 3))
            planes = np.empty((len(faces), 3))
            x = np.empty(3)
            y = np.empty(3)
            locate(vertices, g, inverses[view], p, pixels)
            if pixels[:, 2].min() == 0.0:
                # The mesh reaches behind the source: every pixel may have an edge.
                need = max(mark_for_step(largest * weight, error, counts), 1)
                for r in range(marks.shape[1]):
                    for c in range(marks.shape[2]):
                        marks[view, r, c] = max(marks[view, r, c], need)
                continue
            for f in range(len(faces)):
                slopes_of(p, faces[f], g, planes[f])
            for e in range(len(edges)):
                i, j = edges[e, 0], edges[e, 1]
                c = 0.5 * (pixels[i, 0] + pixels[j, 0])
                r = 0.5 * (pixels[i, 1] + pixels[j, 1])
                ax, ay = slope_at(planes[edges[e, 2]], c, r)
                bx, by = slope_at(planes[edges[e, 3]], c, r)
                away = 0.5 * (
                    math.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2 + p[i, 2] ** 2)
                    + math.sqrt(p[j, 0] ** 2 + p[j, 1] ** 2 + p[j, 2] ** 2)
                )
                bend = 0.5 * away * math.sqrt((ax - bx) ** 2 + (ay - by) ** 2)
                need = mark_for_step(min(bend, largest) * weight, error, counts)
                if need > 1:
                    x[0], x[1], x[2] = pixels[i, 0], pixels[j, 0], pixels[j, 0]
                    y[0], y[1], y[2] = pixels[i, 1], pixels[j, 1], pixels[j, 1]
                    raise_marks(marks[view], x, y, need)
            if not counts:
                continue
            for f in range(len(faces)):
                c = r = away = 0.0
                for k in range(3):
                    i = faces[f, k]
                    x[k], y[k] = pixels[i, 0], pixels[i, 1]
                    c += pixels[i, 0] / 3.0
                    r += pixels[i, 1] / 3.0
                    away += math.sqrt(p[i, 0] ** 2 + p[i, 1] ** 2 + p[i, 2] ** 2) / 3.0
                ax, ay = slope_at(planes[f], c, r)
                steep = min(away * math.sqrt(ax * ax + ay * ay), largest) * weight
                need = min(
                    mark_for_slope(steep, error, counts),
                    mark_for_step(steep, error, counts),
                )
                if need > 1:
                    raise_marks(marks[view], x, y, need)

    @parallel
    def triangles_within(vertices, faces, rays, inverses, marks, starts, out, band):
        """Add up path lengths through a closed mesh along several rays of some pixels.

        Args:
            vertices, faces, rays, inverses: as of `analytic_kernels.project_triangles`.
            marks: uint8 (n, rows, cols), 0 in pixels that are left out.
            starts: int64 (n, rows, cols) place of a pixel's first ray.
            out: float64, changed in place: lengths of the rays, then mm.
            band: rows of a job.
        """
        _ = key
        _, rows, cols = marks.shape
        bands = (rows + band - 1) // band
        for job in prange(len(rays) * bands):
            view = job // bands
            row0 = (job - view * bands) * band
            row1 = min(rows, row0 + band)
            if marks[view, row0:row1].max() == 0:
                continue
            g = rays[view]
            p = np.empty((len(vertices), 3))
            pixels = np.empty((len(vertices), 3))
            forms = np.empty((3, 3))
            plane = np.empty(3)
            locate(vertices, g, inverses[view], p, pixels)
            for f in range(len(faces)):
                i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
                front = pixels[i, 2] + pixels[j, 2] + pixels[k, 2]
                if front == 0.0:
                    continue
                first, last, c0, c1 = row0, row1, 0, cols
                if front == 3.0:
                    low = min(pixels[i, 1], min(pixels[j, 1], pixels[k, 1]))
                    high = max(pixels[i, 1], max(pixels[j, 1], pixels[k, 1]))
                    left = min(pixels[i, 0], min(pixels[j, 0], pixels[k, 0]))
                    right = max(pixels[i, 0], max(pixels[j, 0], pixels[k, 0]))
                    if high < row0 - 1 or low > row1 or right < -1 or left > cols:
                        continue
                    first = max(row0, math.floor(low + 0.5 - 1e-6))
                    last = min(row1, math.floor(high + 0.5 + 1e-6) + 1)
                    c0 = max(0, math.floor(left + 0.5 - 1e-6))
                    c1 = min(cols, math.floor(right + 0.5 + 1e-6) + 1)
                if last <= first or c1 <= c0:
                    continue
                edge_form(p, i, j, g, forms[0])
                edge_form(p, j, k, g, forms[1])
                edge_form(p, k, i, g, forms[2])
                slopes_of(p, faces[f], g, plane)
                ax, ay, az = p[j, 0] - p[i, 0], p[j, 1] - p[i, 1], p[j, 2] - p[i, 2]
                bx, by, bz = p[k, 0] - p[i, 0], p[k, 1] - p[i, 1], p[k, 2] - p[i, 2]
                reach = (
                    p[i, 0] * (ay * bz - az * by)
                    + p[i, 1] * (az * bx - ax * bz)
                    + p[i, 2] * (ax * by - ay * bx)
                )
                for r in range(first, last):
                    for c in range(c0, c1):
                        mark = marks[view, r, c]
                        if mark == 0:
                            continue
                        known = 0
                        for q in range(3):
                            value = forms[q, 0] + forms[q, 1] * c + forms[q, 2] * r
                            room = 0.5 * (abs(forms[q, 1]) + abs(forms[q, 2]))
                            flip = (i > j) if q == 0 else ((j > k) if q == 1 else (k > i))
                            if abs(value) > room:
                                known |= 1 if (value > 0.0) != flip else 2
                        if known == 3:  # left of one edge and right of another: outside
                            continue
                        at = starts[view, r, c]
                        for s in range(rays_of(mark)):
                            x, y = rays_aside(s, mark)
                            x += c
                            y += r
                            # As `analytic_kernels.draw_row`: the sides of an edge are computed from
                            # the edge alone, the same way for both its faces.
                            a = (
                                forms[0, 0] + forms[0, 1] * x + forms[0, 2] * y >= 0.0
                            ) != (i > j)
                            b = (
                                forms[1, 0] + forms[1, 1] * x + forms[1, 2] * y >= 0.0
                            ) != (j > k)
                            e = (
                                forms[2, 0] + forms[2, 1] * x + forms[2, 2] * y >= 0.0
                            ) != (k > i)
                            if a == b and b == e:
                                speed = plane[0] + plane[1] * x + plane[2] * y
                                t = reach / speed if speed != 0.0 else 0.0
                                t = min(max(t, 0.0), 1.0)
                                out[at + s] += t if a else -t
            for r in range(row0, row1):
                for c in range(cols):
                    mark = marks[view, r, c]
                    for s in range(rays_of(mark)):
                        x, y = rays_aside(s, mark)
                        dx = g[3] + (c + x) * g[6] + (r + y) * g[9]
                        dy = g[4] + (c + x) * g[7] + (r + y) * g[10]
                        dz = g[5] + (c + x) * g[8] + (r + y) * g[11]
                        out[starts[view, r, c] + s] *= math.sqrt(
                            dx * dx + dy * dy + dz * dz
                        )

    return mark_convex, mark_mesh, triangles_within


mark_convex, mark_mesh, triangles_within = _entry_points(SOURCES)
