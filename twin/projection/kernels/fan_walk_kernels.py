"""How a fan of rays walks through the voxels, forward and transposed: the inner loops.

The reference line goes slab by slab along the dominant axis t. S[k] (total) is the integral of
level k along it so far, by contiguous multiply-adds along z. A ray acts only where it passes
from one level to the next, taking the difference of two integrals. Three exact corrections make
rays that only nearly share the line equal to each ray's own walk:

- lengths: the crossing of a lateral plane p lies at t_p = s_t + (p - s_l) / m, linear in 1 / m
  of the ray's slope m. With Q[k] (moment) the sum of (t_p - s_t) times the jump there,
  S[k] + (m0 / m - 1) Q[k] is S[k] of a ray of slope m instead of the line's m0;
- order: a ray that passes a grid vertex on the other side than the line, d beyond it, differs
  by d / m times the mixed difference of the four columns around the vertex;
- inside a slab, at a z crossing, the ray's own column is looked up.

All identities are exact. Crossings are computed in double precision, sums are kept in single.
Levels count from 1; 0 and nz + 1 lie outside. The drawing in docs/performance.md shows the
terms.
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.projection.kernels.compiling import fused, inline, kernel, prefetch
from flexdt.twin.projection.kernels.siddon_kernels import open_column

NONE = np.uint32(0xFFFFFFFF)
"""End of a list of rays."""
ONE = np.uint32(1)
ZERO = np.float32(0)
PREFETCH_SLABS = 3
"""Slabs between prefetching a voxel column and using it."""
SETTLE_SLABS = 64
"""Slabs after which each ray takes over its level's integral; see `settle`."""
SLOPE_BINS = 64
"""Rays of a fan are sorted by slope into this many bins."""


@fused
def add_one(total, a, column):
    """Add a * column to total."""
    for k in range(total.size):
        total[k] += a * column[k]


@fused
def add_two(total, a, first, b, second):
    """Add a * first + b * second to total."""
    for k in range(total.size):
        total[k] += a * first[k] + b * second[k]


@fused
def add_jump(total, moment, a, first, b, second, arm):
    """Add a * first + b * second to total and arm * (first - second) to moment."""
    for k in range(total.size):
        total[k] += a * first[k] + b * second[k]
        moment[k] += arm * (first[k] - second[k])


@fused
def mix(out, right, left, right_before, left_before):
    """Compute out = (right - left) - (right_before - left_before)."""
    for k in range(out.size):
        out[k] = (right[k] - left[k]) - (right_before[k] - left_before[k])


@inline
def part_of(rays, first, last):
    """Select arrays that the correction at a vertex changes (acc, weight, tilt, level,
    picked), as views, of rays first to last - 1 of a sorted fan.
    """
    some = slice(first, last)
    return (
        rays.acc[some],
        rays.weight[some],
        rays.tilt[some],
        rays.level[some],
        rays.picked[some],
    )


@fused
def correct(part, jump, offset, reach):
    """Subtract max(0, offset + tilt * reach) * weight * jump[level] from acc, ray by ray.

    offset + tilt * reach is d, the distance of a ray beyond the vertex; weight is 1 / m.
    """
    acc, weight, tilt, level, picked = part
    # Two loops: gathering by level cannot be vectorised, the arithmetic can.
    for q in range(acc.size):
        picked[q] = jump[level[q]]
    for q in range(acc.size):
        beyond = offset + tilt[q] * reach
        acc[q] -= (beyond if beyond > ZERO else ZERO) * weight[q] * picked[q]


@fused
def correct_back(part, jump, offset, reach):
    """Apply the transpose of `correct`: jump[level] -= max(0, ...) * weight * acc."""
    acc, weight, tilt, level, picked = part
    for q in range(acc.size):
        beyond = offset + tilt[q] * reach
        picked[q] = (beyond if beyond > ZERO else ZERO) * weight[q] * acc[q]
    for q in range(acc.size):
        jump[level[q]] -= picked[q]


@inline
def column_at(grid, j, i):
    """Compute the place in memory of (l = i, t = j)."""
    return grid.base + j * grid.hop_t + i * grid.hop_l


@inline
def mark_of(grid, j, i):
    """Compute the index of (l = i, t = j) in spans or marks."""
    return 2 * (grid.span_base + j * grid.span_t + i * grid.span_l)


@inline
def occupied(spans, grid, j, i):
    """Return the levels - 1, [first, last), of voxel column (l = i, t = j) that are not
    empty; (nz, 0) for an empty column or one outside.
    """
    if i < 0 or i >= grid.nl or j < 0 or j >= grid.nt:
        return grid.nz, 0
    at = mark_of(grid, j, i)
    first, last = np.int64(spans[at]), np.int64(spans[at + 1])
    if last <= first:
        return grid.nz, 0
    return first, last


@inline
def levels_between(grid, fan, t0, t1):
    """Find the levels - 1, [w0, w1), that the fan can touch from t0 to t1, with one to
    spare, clipped to the box.
    """
    a, b = t0 - grid.st, t1 - grid.st
    low = grid.sz + min(fan.rise_low * a, fan.rise_low * b) - 1.0
    high = grid.sz + max(fan.rise_high * a, fan.rise_high * b) + 2.0
    w0 = min(max(math.floor(low), 0), grid.nz)
    w1 = min(max(math.floor(high), w0), grid.nz)
    return w0, w1


@inline
def difference(flat, grid, j, i, a, b):
    """Compute level a minus level b of `flat` in voxel column (l = i, t = j); 0 for a
    column outside, and levels outside count as 0. Level k + 1 is voxel z = k.
    """
    if i < 0 or i >= grid.nl:
        return ZERO
    inside = np.uint32(grid.nz)
    at = np.uint64(column_at(grid, j, i))
    low, high = ZERO, ZERO
    if a - ONE < inside:
        low = flat[at + np.uint64(a - ONE)]
    if b - ONE < inside:
        high = flat[at + np.uint64(b - ONE)]
    return low - high


@inline
def cross_levels(flat, grid, fan, rays, work, j, r0, r1, share):
    """Process all z crossings in slab j from the list head[j]: add their integrals to the
    rays, and list each ray's next crossing.

    The integral inside the slab is counted from the reference line's column r0 to the
    ray's own. Rays that share the line change columns where it does: (x - r1) / m would
    be the same, but rays within a voxel plane have slopes of rounding errors, by which
    nothing can be divided.

    Args:
        flat: voxels.
        grid: the box as seen along the fan.
        fan: of the rays.
        rays: sorted rays; crossings, levels and sums are changed.
        work: lists of crossings and the reference line's sums; the lists are changed.
        j: number of the slab.
        r0: column of the reference line at the slab's beginning.
        r1: at its end.
        share: of the slab, that the line is in r0.
    """
    cross = rays.cross
    pace = rays.pace
    slope = rays.slope
    weight = rays.weight
    ratio = rays.ratio
    all_acc = rays.acc
    all_level = rays.level
    following = rays.following
    head = work.head
    total = work.total
    moment = work.moment
    stop = float(fan.j1)
    inside = np.uint32(grid.nz)
    both = np.uint32(grid.nz - 1)
    first = 0 <= r0 < grid.nl
    second = r1 > r0 and 0 <= r1 < grid.nl
    at0 = np.uint64(column_at(grid, j, r0) - 1)
    at1 = np.uint64(column_at(grid, j, r1) - 1)
    r = head[j]
    while r != NONE:
        later = following[r]
        t = cross[r]
        every = pace[r]
        m = slope[r]
        w = weight[r]
        step = np.int32(math.copysign(1.0, every))
        level = all_level[r]
        acc = all_acc[r]
        while True:
            after = np.uint32(np.int32(level) + step)
            here, there = ZERO, ZERO
            # Unsigned: level 0 becomes a large number, so one comparison checks both.
            if min(level, after) - ONE < both:
                if first:
                    here = flat[at0 + np.uint64(level)] - flat[at0 + np.uint64(after)]
                if second:
                    there = flat[at1 + np.uint64(level)] - flat[at1 + np.uint64(after)]
            else:
                here = difference(flat, grid, j, r0, level, after)
                if second:
                    there = difference(flat, grid, j, r1, level, after)
            # The integral up to the start of the slab, then the piece from there to the
            # crossing as though the ray were in column r0 all along.
            acc += (total[level] - total[after]) + np.float32(t - j) * here
            if not fan.spread:
                if r1 > r0:
                    acc += np.float32(max(t - j - share, 0.0)) * (there - here)
            else:
                x = grid.sl + m * (t - grid.st)
                acc += ratio[r] * (moment[level] - moment[after])
                # The line has changed from r0 to r1 by now: the ray has spent (x - r1) / m in
                # r1.
                if r1 > r0:
                    acc += np.float32(max(x - r1, 0.0)) * w * (there - here)
                # The ray itself, at lateral position x, may be in a column beside those of the
                # line: each plane between adds its distance / m times the difference of its two
                # columns.
                if x < r0:
                    at = r0
                    while x < at:
                        there = difference(flat, grid, j, at - 1, level, after)
                        acc += np.float32(at - x) * w * (here - there)
                        here = there
                        at -= 1
                elif x >= r1 + 1:
                    at = r1
                    here = there if r1 > r0 else here
                    while x >= at + 1:
                        at += 1
                        there = difference(flat, grid, j, at, level, after)
                        acc += np.float32(x - at) * w * (there - here)
                        here = there
            level = after
            t += abs(every)
            if (
                level - ONE >= inside
            ):  # the ray has left the box through its top or bottom
                break
            if (
                t >= j + 1
            ):  # the next crossing is in a later slab: wait on that slab's list
                if t < stop:
                    slab = np.uint64(t)
                    following[r] = head[slab]
                    head[slab] = r
                break
        cross[r] = t
        all_level[r] = level
        all_acc[r] = acc
        r = later


@inline
def add_pair(flat, grid, j, i, a, b, value):
    """Apply the transpose of `difference`, with its arguments: add value to level a of
    `flat`, subtract it from level b; outside nothing is changed.
    """
    if i < 0 or i >= grid.nl:
        return
    inside = np.uint32(grid.nz)
    at = np.uint64(column_at(grid, j, i))
    if a - ONE < inside:
        flat[at + np.uint64(a - ONE)] += value
    if b - ONE < inside:
        flat[at + np.uint64(b - ONE)] -= value


@inline
def cross_levels_back(flat, grid, fan, rays, work, j, r0, r1, share):
    """Apply the transpose of `cross_levels`, with the same arguments: `total` and
    `moment` of `work`, and voxels of `flat` beside the line, are added each level's
    share.

    Crossings of the rays and their lists are changed too, as by `cross_levels`.
    """
    cross = rays.cross
    pace = rays.pace
    slope = rays.slope
    weight = rays.weight
    ratio = rays.ratio
    value = rays.acc
    all_level = rays.level
    following = rays.following
    head = work.head
    total = work.total
    moment = work.moment
    stop = float(fan.j1)
    inside = np.uint32(grid.nz)
    r = head[j]
    while r != NONE:
        later = following[r]
        t = cross[r]
        every = pace[r]
        m = slope[r]
        level = all_level[r]
        y = value[r]
        step = np.int32(math.copysign(1.0, every))
        w = weight[r] * y
        while True:
            after = np.uint32(np.int32(level) + step)
            total[level] -= y
            total[after] += y
            left = np.float32(t - j) * y
            at = r0
            if not fan.spread:
                if r1 > r0:
                    part = np.float32(max(t - j - share, 0.0)) * y
                    add_pair(flat, grid, j, r1, level, after, part)
                    left -= part
            else:
                x = grid.sl + m * (t - grid.st)
                moment[level] -= ratio[r] * y
                moment[after] += ratio[r] * y
                while x < at:
                    part = np.float32(at - x) * w
                    add_pair(flat, grid, j, at, level, after, left + part)
                    left = -part
                    at -= 1
                while x >= at + 1:
                    part = np.float32(x - at - 1) * w
                    add_pair(flat, grid, j, at, level, after, left - part)
                    left = part
                    at += 1
            add_pair(flat, grid, j, at, level, after, left)
            level = after
            t += abs(every)
            if level - ONE >= inside:
                break
            if t >= j + 1:
                if t < stop:
                    slab = np.uint64(t)
                    following[r] = head[slab]
                    head[slab] = r
                break
        cross[r] = t
        all_level[r] = level
        r = later


@inline
def pass_vertices(flat, spans, grid, fan, rays, work, n, j, x, transposed):
    """Correct the rays that pass a grid vertex of plane t = j on the other side than the
    reference line; only the two vertices next to the line are examined.

    Args:
        flat: voxels; transposed, changed in place.
        spans: occupied levels of each voxel column.
        grid: the box as seen along the fan.
        fan: of the rays.
        rays: sorted rays; their sums are changed unless transposed.
        work: bins, and room for the jump.
        n: number of rays.
        j: number of the plane.
        x: place of the reference line there, l = x.
        transposed: voxels receive the rays' values.
    """
    bins = work.bins
    jump = work.jump
    zeros = work.zeros
    w0, w1 = levels_between(grid, fan, j, j)
    reach = j - grid.st
    if w1 <= w0 or reach <= 0:
        return
    below = math.floor(x)
    for side in range(2):
        # side 0: the vertex on the right (passed by rays of large tilt), side 1: on the left.
        # Rays stay within one voxel of the line, so no vertex farther away concerns them.
        p = below + 1 - side
        if p < 0 or p > grid.nl:
            continue
        gap = p - x if side == 0 else x - p
        # Only bins of slope that can hold a ray beyond the vertex; `correct` clamps d at 0 for
        # the rays of the outermost bin that are not.
        if side == 0:
            part = (gap / reach - fan.low) / fan.width * SLOPE_BINS
            first, last = bins[min(max(math.floor(part), 0), SLOPE_BINS)], n
        else:
            part = (-gap / reach - fan.low) / fan.width * SLOPE_BINS
            first, last = 0, bins[min(max(math.floor(part) + 1, 0), SLOPE_BINS)]
        if last <= first:
            continue
        # Levels at which any of the four columns holds something: elsewhere the jump is zero.
        # Transposed, the columns are written to, whatever they hold.
        v0, v1 = w0, w1
        if not transposed:
            low, high = grid.nz, 0
            for corner in range(4):
                f, e = occupied(spans, grid, j - corner // 2, p - corner % 2)
                low, high = min(low, f), max(high, e)
            v0, v1 = max(w0, low), min(w1, high)
            if v1 <= v0:
                continue
            jump[1 + w0 : 1 + v0] = ZERO
            jump[1 + v1 : 1 + w1] = ZERO
        # Columns around the vertex: a here (t >= j) on the right, b here on the left, c before
        # (t < j) on the right, d before on the left; zeros where the box has ended.
        at = column_at(grid, j, p)
        here, before = j < grid.nt, j > 0
        right, left = p < grid.nl, p > 0
        a = flat[at + v0 : at + v1] if here and right else zeros[v0:v1]
        at -= grid.hop_l
        b = flat[at + v0 : at + v1] if here and left else zeros[v0:v1]
        at -= grid.hop_t
        d = flat[at + v0 : at + v1] if before and left else zeros[v0:v1]
        at += grid.hop_l
        c = flat[at + v0 : at + v1] if before and right else zeros[v0:v1]
        offset = np.float32(-gap)
        arm = np.float32(reach if side == 0 else -reach)
        if transposed:
            jump[w0 : w1 + 2] = ZERO
            correct_back(part_of(rays, first, last), jump, offset, arm)
            received = jump[1 + v0 : 1 + v1]
            one = np.float32(1)
            if here and right:
                add_one(a, one, received)
            if here and left:
                add_one(b, -one, received)
            if before and right:
                add_one(c, -one, received)
            if before and left:
                add_one(d, one, received)
        else:
            mix(jump[1 + v0 : 1 + v1], a, b, c, d)
            correct(part_of(rays, first, last), jump, offset, arm)


@inline
def pass_slab(flat, spans, grid, fan, work, j, r0, r1, share, transposed):
    """Add slab j along the reference line to S and Q (or, transposed, from them to the
    slab).

    The line is in column r0 for `share` of the slab, for the rest in r1. Q takes the jump
    between them at its distance from the source (arm).

    Args:
        flat: voxels; transposed, changed in place.
        spans: occupied levels of each voxel column.
        grid: the box as seen along the fan.
        fan: of the rays.
        work: its total is S, its moment Q; changed unless transposed.
        j: number of the slab.
        r0: column of the reference line at the slab's beginning.
        r1: at its end.
        share: of the slab, that the line is in r0.
        transposed: see above.
    """
    total = work.total
    moment = work.moment
    w0, w1 = levels_between(grid, fan, j, j + 1)
    if not transposed:
        low0, high0 = occupied(spans, grid, j, r0)
        low1, high1 = occupied(spans, grid, j, r1)
        w0, w1 = max(w0, min(low0, low1)), min(w1, max(high0, high1))
    if w1 <= w0:
        return
    first = 0 <= r0 < grid.nl
    second = r1 > r0 and 0 <= r1 < grid.nl
    a, b = np.float32(share), np.float32(1.0 - share)
    arm = np.float32(j + share - grid.st)
    lever = fan.spread and r1 > r0
    s = total[1 + w0 : 1 + w1]
    q = moment[1 + w0 : 1 + w1]
    at0, at1 = column_at(grid, j, r0), column_at(grid, j, r1)
    if transposed:
        if first:
            c0 = flat[at0 + w0 : at0 + w1]
            if lever:
                add_two(c0, a, s, arm, q)
            else:
                add_one(c0, a, s)
        if second:
            c1 = flat[at1 + w0 : at1 + w1]
            if lever:
                add_two(c1, b, s, -arm, q)
            else:
                add_one(c1, b, s)
    elif first and second:
        c0 = flat[at0 + w0 : at0 + w1]
        c1 = flat[at1 + w0 : at1 + w1]
        if lever:
            add_jump(s, q, a, c0, b, c1, arm)
        else:
            add_two(s, a, c0, b, c1)
    elif first:
        c0 = flat[at0 + w0 : at0 + w1]
        add_one(s, a, c0)
        if lever:
            add_one(q, arm, c0)
    elif second:
        c1 = flat[at1 + w0 : at1 + w1]
        add_one(s, b, c1)
        if lever:
            add_one(q, -arm, c1)


@inline
def prefetch_slab(flat, spans, grid, fan, j, transposed):
    """Prefetch the voxel columns of slab j on the reference line and, transposed, those
    beside it that are to be opened.

    Levels that the fan cannot touch, and forward those that hold nothing, are left out.

    Args:
        flat: voxels; not changed.
        spans: occupied levels of each voxel column; transposed, marks of the open ones.
        grid: the box as seen along the fan.
        fan: of the rays.
        j: number of the slab.
        transposed: see above.
    """
    x = grid.sl + fan.m0 * (j - grid.st)
    w0, w1 = levels_between(grid, fan, j, j + 1)
    r0, r1 = math.floor(x), math.floor(x + fan.m0)
    beside = 1 if transposed and fan.spread else 0
    for i in range(max(r0 - beside, 0), min(r1 + beside, grid.nl - 1) + 1):
        at = column_at(grid, j, i)
        low, high = w0, w1
        if transposed:
            if spans[mark_of(grid, j, i)] == 0:
                low, high = 0, grid.nz
            elif i < r0 or i > r1:
                continue
        else:
            f, e = occupied(spans, grid, j, i)
            low, high = max(w0, f), min(w1, e)
        if low < high:
            for q in range(at + low, at + high + 16, 16):
                prefetch(flat, q)


@inline
def open_slab(flat, marks, grid, j, i0, i1):
    """Open the voxel columns l = i0 to i1 (inclusive, those outside the grid left out) of
    slab j, so that they may be added to; see `siddon_kernels.open_column`.

    Args:
        flat: voxels; columns that are opened are set to 0.
        marks: of the voxel columns, changed: 0 until one is open.
        grid: the box as seen along the fan.
        j: number of the slab.
        i0: first column.
        i1: last column.
    """
    for i in range(max(i0, 0), min(i1, grid.nl - 1) + 1):
        mark = mark_of(grid, j, i)
        if marks[mark] == 0:
            open_column(flat, marks, mark, column_at(grid, j, i), grid.nz)


@inline
def settle(rays, work, n, spread):
    """Add the integral of its level to each ray, and start all levels again from zero; rays
    that do not spread have no moments.

    Integrals of levels grow along the whole line, a ray takes a difference of two:
    without this, a ray with a short path through a long volume would lose digits.
    """
    acc = rays.acc
    ratio = rays.ratio
    level = rays.level
    total = work.total
    moment = work.moment
    if spread:
        for q in range(n):
            k = level[q]
            acc[q] += total[k] + ratio[q] * moment[k]
        moment[:] = ZERO
    else:
        for q in range(n):
            acc[q] += total[level[q]]
    total[:] = ZERO


@inline
def share_out(rays, work, n):
    """Replace the sums in `work` by the rays' values and first moments, added up in each
    level: these are what the voxels of that level receive."""
    acc = rays.acc
    ratio = rays.ratio
    level = rays.level
    total = work.total
    moment = work.moment
    total[:] = ZERO
    moment[:] = ZERO
    for q in range(n):
        k = level[q]
        total[k] += acc[q]
        moment[k] += ratio[q] * acc[q]


@kernel
def walk(flat, spans, grid, fan, rays, work, n, transposed):
    """Carry a sorted fan of n rays through its slabs: fill the rays' sums, or
    (transposed) add them to the voxels.

    Every `SETTLE_SLABS` slabs the sums of levels are settled and begin again.

    Args:
        flat: voxels; transposed, changed in place.
        spans: occupied levels of each voxel column; transposed, marks of those that are
            open, see `siddon_kernels.open_column`.
        grid: the box as seen along the fan.
        fan: of the rays.
        rays: sorted rays, initialized by `start`.
        work: room.
        n: number of rays.
        transposed: see above.
    """
    x = grid.sl + fan.m0 * (fan.j0 - grid.st)
    r0 = math.floor(x)
    # Rays beside the line reach one voxel column farther than it does.
    beside = 1 if fan.spread else 0
    if transposed:
        share_out(rays, work, n)
        if fan.j0 > 0:
            # The vertices of a plane reach into the slab before it.
            open_slab(flat, spans, grid, fan.j0 - 1, r0 - 1, r0 + 1)
    # One slab more than there are: its vertices are on the far side of the last slab.
    for j in range(fan.j0, fan.j1 + 1):
        if (j - fan.j0) % SETTLE_SLABS == SETTLE_SLABS - 1:
            if transposed:
                share_out(rays, work, n)
            else:
                settle(rays, work, n, fan.spread)
        # Not x + m0: rounding would add up along the line.
        after = grid.sl + fan.m0 * (j + 1 - grid.st)
        r0, r1 = math.floor(x), max(math.floor(x + fan.m0), math.floor(after))
        if transposed and j < grid.nt:
            open_slab(flat, spans, grid, j, r0 - beside, r1 + beside)
        if fan.spread:
            pass_vertices(flat, spans, grid, fan, rays, work, n, j, x, transposed)
        if j == fan.j1:
            break
        if j + PREFETCH_SLABS < fan.j1:
            prefetch_slab(flat, spans, grid, fan, j + PREFETCH_SLABS, transposed)
        # Within one slab the line, of slope 0 <= m0 <= 1, is in column r0 and then perhaps in
        # r1.
        share = min(max((r1 - x) / fan.m0, 0.0), 1.0) if r1 > r0 else 1.0
        if transposed:
            cross_levels_back(flat, grid, fan, rays, work, j, r0, r1, share)
        else:
            cross_levels(flat, grid, fan, rays, work, j, r0, r1, share)
        pass_slab(flat, spans, grid, fan, work, j, r0, r1, share, transposed)
        x = after
    if not transposed:
        settle(rays, work, n, fan.spread)
