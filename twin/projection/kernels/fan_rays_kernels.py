"""From detector pixels to a fan of rays ready to walk: directions, sorting, first crossings.

Coordinates of a fan: t along the dominant axis of its central ray, l lateral, z; unit voxels; t
and l mirrored so that rays grow in both. No voxel is read here.
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.projection.kernels.compiling import kernel, maker
from flexdt.twin.projection.kernels.fan_types import Collected, Fan, Grid, Rays, Work
from flexdt.twin.projection.kernels.fan_walk_kernels import NONE, SLOPE_BINS, ZERO

MIN_SPREAD_VOXELS = 1e-7
"""Lateral spread [voxels] below which the rays of a fan share one line."""
MAX_DRIFT_VOXELS = 0.95
"""Largest distance [voxels] of a ray from its reference line: the corrections reach one
voxel."""
ON_AXIS = 0.2
"""Rays drifting less than this [voxels] across the box travel alone: 1 / m grows without
bound."""


@kernel
def oriented(box, g, lines, line, rows):
    """Compute the box as seen along the central ray of the fan between `line` and the
    next: a `Grid`.

    Axis t is the one of x and y along which that ray goes faster (y if alike), l the
    other; both are mirrored where the ray goes backwards.

    Args:
        box: voxels.
        g: (12,) source, first pixel minus source, u, v [voxels].
        lines: (m, 2) column of each line in row 0, and its slope.
        line: number of the first one.
        rows: the detector's rows.
    """
    r = 0.5 * (rows - 1)
    c = 0.5 * (
        lines[line, 0] + lines[line + 1, 0] + (lines[line, 1] + lines[line + 1, 1]) * r
    )
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    # t is the axis along which the central ray goes faster, so that slopes dl / dt are at most
    # 1.
    sx = box.size_x**2
    sy = box.size_y**2
    sz = box.size_z**2
    if abs(dy) >= abs(dx):
        axis = 1
        dl = dx
        dt = dy
        sl = g[0]
        st = g[1]
        square_l = sx
        square_t = sy
        nl = box.nx
        nt = box.ny
        hop_l = box.hop_x
        hop_t = box.hop_y
    else:
        axis = 0
        dl = dy
        dt = dx
        sl = g[1]
        st = g[0]
        square_l = sy
        square_t = sx
        nl = box.ny
        nt = box.nx
        hop_l = box.hop_y
        hop_t = box.hop_x
    base = box.base
    span_base = 0
    span_l, span_t = (1, box.nx) if axis == 1 else (box.nx, 1)
    # Mirroring is done by steps in memory of the other sign, from the last voxel.
    sign_l = math.copysign(1.0, dl)
    sign_t = math.copysign(1.0, dt)
    if sign_l < 0:
        sl = nl - sl
        base = base + (nl - 1) * hop_l
        hop_l = -hop_l
        span_base = span_base + (nl - 1) * span_l
        span_l = -span_l
    if sign_t < 0:
        st = nt - st
        base = base + (nt - 1) * hop_t
        hop_t = -hop_t
        span_base = span_base + (nt - 1) * span_t
        span_t = -span_t
    return Grid(
        axis,
        sign_l,
        sign_t,
        base,
        hop_l,
        hop_t,
        span_base,
        span_l,
        span_t,
        nl,
        nt,
        box.nz,
        sl,
        st,
        g[2],
        square_l,
        square_t,
        sz,
    )


@kernel
def columns_of(lines, first, last, cols, starts, ends):
    """Find the columns between two lines in each row.

    `lines`: (m, 2) column of each line in row 0, and its slope; `first`: number of the first
    line; `last`: number of the last line; `cols`: of the image; `starts`: (rows,) filled with
    the first column, 0 to cols; `ends`: (rows,) filled with the column after the last, 0 to
    cols.
    Returns the largest number of columns in a row, 1 at least.
    """
    a = lines[first]
    b = lines[last]
    width = 1
    for r in range(starts.size):
        # Up to the next line, but without it: each pixel belongs to one fan.
        starts[r] = min(max(math.ceil(a[0] + a[1] * r), 0), cols)
        ends[r] = min(max(math.ceil(b[0] + b[1] * r), 0), cols)
        width = max(width, ends[r] - starts[r])
    return width


@kernel
def collect(collected, grid, g, lines, line, starts, width, shadow, side):
    """Collect the pixels of a fan, with slope, rise and span of their rays; returns their
    number.

    Pixels that the box cannot reach are left out.

    Args:
        collected: filled.
        grid: the box as seen along the fan.
        g: (12,) source, first pixel minus source, u, v [voxels].
        lines: (m, 2) column of each line in row 0, and its slope.
        line: number of the fan's first line.
        starts: first column of the job's buffer in each row.
        width: its columns.
        shadow: rows and columns that the box can reach, the first of them the buffer's
            first.
        side: rays along each side of a pixel, for the place in the buffer; more than one only
            of whole columns.
    """
    row = collected.row
    column = collected.column
    slot = collected.slot
    low = lines[line]
    high = lines[line + 1]
    top = shadow[0]
    bottom = shadow[1]
    n = 0
    if low[1] == 0.0 and high[1] == 0.0:
        # Whole columns: the same range in every row.
        c0 = max(math.ceil(low[0]), shadow[2])
        c1 = min(math.ceil(high[0]), shadow[3])
        for c in range(c0, c1):
            at = c // side - starts[top] - top // side * width
            for i in range(bottom - top):
                row[n + i] = top + i
                column[n + i] = c
                slot[n + i] = (top + i) // side * width + at
            n += bottom - top
    else:
        for r in range(top, bottom):
            c0 = max(math.ceil(low[0] + low[1] * r), shadow[2])
            c1 = min(math.ceil(high[0] + high[1] * r), shadow[3])
            at = (r - top) * width - starts[r]
            for c in range(c0, c1):
                row[n] = r
                column[n] = c
                slot[n] = at + c
                n += 1
    t = grid.axis
    el = 1 - grid.axis
    # Directions as the mirrored box has them.
    t0 = grid.sign_t * g[3 + t]
    tc = grid.sign_t * g[6 + t]
    tr = grid.sign_t * g[9 + t]
    l0 = grid.sign_l * g[3 + el]
    lc = grid.sign_l * g[6 + el]
    lr = grid.sign_l * g[9 + el]
    z0 = g[5]
    zc = g[8]
    zr = g[11]
    slope = collected.slope
    rise = collected.rise
    span = collected.span
    for q in range(n):
        r = row[q]
        c = column[q]
        dt = t0 + c * tc + r * tr
        inverse = 1.0 / dt
        slope[q] = (l0 + c * lc + r * lr) * inverse
        rise[q] = (z0 + c * zc + r * zr) * inverse
        span[q] = dt
    return n


@kernel
def describe(grid, collected, n):
    """Compute the `Fan` of n (at least one) collected rays: slope of its reference line,
    range of slopes and rises, slabs, whether it spreads, and whether its rays can be
    walked together.

    They cannot with the source in the box, rays that end within it, spreading rays nearly
    along an axis (`ON_AXIS`), or rays that drift more than `MAX_DRIFT_VOXELS` off
    the line.
    """
    slope = collected.slope[:n]
    rise = collected.rise[:n]
    span = collected.span[:n]
    m_low = slope[0]
    m_high = slope[0]
    rise_low = rise[0]
    rise_high = rise[0]
    nearest = span[0]
    for q in range(n):
        m_low = min(m_low, slope[q])
        m_high = max(m_high, slope[q])
        rise_low = min(rise_low, rise[q])
        rise_high = max(rise_high, rise[q])
        nearest = min(nearest, span[q])
    m0 = 0.5 * (m_low + m_high)
    # Where the reference line is within one column of the box, in front of the source.
    begin = max(0.0, grid.st)
    stop = float(grid.nt)
    if m0 > 0.0:
        begin = max(begin, grid.st + (-1.0 - grid.sl) / m0)
        stop = min(stop, grid.st + (grid.nl + 1.0 - grid.sl) / m0)
    elif grid.sl < -1.0 or grid.sl > grid.nl + 1.0:
        stop = begin
    begin = min(begin, float(grid.nt))
    j0 = math.floor(begin)
    j1 = max(min(grid.nt, math.ceil(max(stop, begin))), j0)
    # The reference line has the mean slope, so a ray lies farthest beside it at the far end.
    far = max(j1 - grid.st, 0.0)
    drift = 0.5 * (m_high - m_low) * far
    spread = drift > MIN_SPREAD_VOXELS
    inside = grid.st > 0.0 and -1.0 < grid.sl < grid.nl + 1.0
    too_short = nearest <= 0.0 or nearest < far
    on_axis = spread and m_low * grid.nt < ON_AXIS
    together = not (inside or too_short or on_axis or drift > MAX_DRIFT_VOXELS)
    low = m_low - m0
    width = m_high - m_low
    return Fan(m0, low, width, rise_low, rise_high, j0, j1, begin, spread, together)


@kernel
def sort_by_slope(grid, fan, collected, rays, bins, n):
    """Sort the rays that meet the box by slope (in bins) into `rays`, and fill `bins`;
    returns their number.

    Within a bin the order is that of the pixels; rays that miss the box are left out.

    Args:
        grid: the box as seen along the fan.
        fan: of the rays.
        collected: n collected rays; their bins are filled in.
        rays: filled with slope, rise and slot in the new order.
        bins: (BINS + 1,) filled with the first place of each bin.
        n: number of collected rays.
    """
    slope = collected.slope
    rise = collected.rise
    slot = collected.slot
    part = collected.bin
    reach0 = fan.begin - grid.st
    reach1 = fan.j1 - grid.st
    to_slope = rays.slope
    to_rise = rays.rise
    to_slot = rays.slot
    if not fan.spread:
        # All in one bin.
        at = np.uint64(0)
        for q in range(n):
            z0 = grid.sz + rise[q] * reach0
            z1 = grid.sz + rise[q] * reach1
            to_slope[at], to_rise[at], to_slot[at] = slope[q], rise[q], slot[q]
            met = (max(z0, z1) >= 0.0) & (min(z0, z1) <= grid.nz)
            at += np.uint64(met)
        bins[0] = 0
        bins[1:] = at
        return bins[SLOPE_BINS]
    # A counting sort: count the rays of each bin, turn counts into first places, deal out.
    bins[:] = 0
    scale = SLOPE_BINS / fan.width
    top = SLOPE_BINS - 1.0
    for q in range(n):
        z0 = grid.sz + rise[q] * reach0
        z1 = grid.sz + rise[q] * reach1
        met = max(z0, z1) >= 0.0 and min(z0, z1) <= grid.nz
        part[q] = (
            min(max((slope[q] - fan.m0 - fan.low) * scale, 0.0), top) if met else -1.0
        )
    for q in range(n):
        if part[q] >= 0.0:
            bins[np.uint64(part[q]) + np.uint64(1)] += 1
    for b in range(SLOPE_BINS):
        bins[b + 1] += bins[b]
    for q in range(n):
        if part[q] >= 0.0:
            b = np.uint64(part[q])
            at = np.uint64(bins[b])
            bins[b] += 1
            to_slope[at] = slope[q]
            to_rise[at] = rise[q]
            to_slot[at] = slot[q]
    # Dealing out has moved each bin's first place to the next bin's: shift them back.
    for b in range(SLOPE_BINS, 0, -1):
        bins[b] = bins[b - 1]
    bins[0] = 0
    return bins[SLOPE_BINS]


@kernel
def start(grid, fan, rays, work, n):
    """Initialise n sorted rays for their walk, and list their first z crossings by slab.

    Crossings behind the last slab are not listed; nor do rays without a z crossing in the
    box have one.

    Args:
        grid: the box as seen along the fan.
        fan: of the rays.
        rays: slopes and rises are read, all else is filled in.
        work: lists of crossings are filled in, sums set to zero.
        n: number of rays.
    """
    slope = rays.slope[:n]
    rise = rays.rise[:n]
    weight = rays.weight[:n]
    tilt = rays.tilt[:n]
    ratio = rays.ratio[:n]
    length = rays.length[:n]
    cross = rays.cross[:n]
    pace = rays.pace[:n]
    level = rays.level[:n]
    acc = rays.acc[:n]
    m0 = fan.m0
    sz = grid.sz
    st = grid.st
    nz = float(grid.nz)
    square_l = grid.square_l
    square_t = grid.square_t
    square_z = grid.square_z
    reach = fan.begin - st
    begin = fan.begin
    for q in range(n):
        m = slope[q]
        up = rise[q]
        inverse = 1.0 / m
        # The numbers of the walk's three corrections, in single precision as its sums are.
        weight[q] = np.float32(inverse)
        tilt[q] = np.float32(m - m0)
        ratio[q] = np.float32(m0 * inverse - 1.0)
        length[q] = np.float32(
            math.sqrt(m * m * square_l + square_t + up * up * square_z)
        )
        # A ray that is still below or above the box is in the level next to it: it enters
        # from there.
        k = min(max(np.floor(sz + up * reach), -1.0), nz)
        plane = k + 1.0 if up > 0.0 else k
        every = 1.0 / up
        pace[q] = every
        there = 0.0 <= plane <= nz and up != 0.0
        # Not before begin: a ray (nearly) within a voxel plane would cross it at the source.
        cross[q] = max(st + (plane - sz) * every, begin) if there else math.inf
        level[q] = np.uint32(np.int32(k) + 1)
        acc[q] = ZERO
    if not fan.spread:
        # Rays of one line have the same slope; what is left of the ratio is rounding.
        ratio[:] = ZERO
    # A list for each slab, linked through the rays: crossings are met in the order of slabs
    # without being sorted.
    head = work.head
    following = rays.following
    for j in range(fan.j0, fan.j1):
        head[j] = NONE
    stop = float(fan.j1)
    for q in range(n):
        t = cross[q]
        if t < stop:
            slab = np.uint64(t)
            following[q] = head[slab]
            head[slab] = q
    work.total[:] = ZERO
    work.moment[:] = ZERO


@maker
def make_collected(room):
    """Create arrays, not initialized, for fans of up to `room` pixels."""
    return Collected(
        row=np.empty(room),
        column=np.empty(room),
        slope=np.empty(room),
        rise=np.empty(room),
        span=np.empty(room),
        slot=np.empty(room, np.uint32),
        bin=np.empty(room),
    )


@maker
def make_rays(room):
    """Create arrays (not initialized) for fans of up to `room` rays."""
    f32 = np.float32
    u32 = np.uint32
    return Rays(
        slope=np.empty(room),
        rise=np.empty(room),
        slot=np.empty(room, u32),
        cross=np.empty(room),
        pace=np.empty(room),
        acc=np.empty(room, f32),
        weight=np.empty(room, f32),
        tilt=np.empty(room, f32),
        ratio=np.empty(room, f32),
        level=np.empty(room, u32),
        following=np.empty(room, u32),
        length=np.empty(room, f32),
        picked=np.empty(room, f32),
    )


@maker
def make_work(slabs, levels):
    """Create a worker's arrays for a box of up to `slabs` slabs and `levels` levels; sums
    are zero, the others not initialized.
    """
    f32 = np.float32
    return Work(
        head=np.empty(slabs + 2, np.uint32),
        bins=np.empty(SLOPE_BINS + 1, np.int64),
        total=np.zeros(levels + 2, f32),
        moment=np.zeros(levels + 2, f32),
        jump=np.zeros(levels + 2, f32),
        zeros=np.zeros(levels + 2, f32),
    )
