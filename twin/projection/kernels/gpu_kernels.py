"""CUDA kernels: exact Siddon forward, and its transpose with atomic additions; arithmetic on
flat arrays of single precision, and sums of them.

`project_slabs` and `spread_slabs` are for views that cross the whole box and rise at most one
voxel a slab (`gpu.by_slabs` says which); `project_rays` and `spread_rays` for all others.
Imported only where a CUDA device (or numba's simulator of one) has been found: `gpu` decides.

The slab walk. Seen along its faster axis of x and y, called a, a ray goes through slabs one
voxel thick. All axes are mirrored so that the ray moves up them; then in one slab it crosses at
most one plane of the other axis b and at most one of z, and meets at most three voxels: before
both crossings, between them, after both. If shares h >= l of the slab lie behind the crossings,
the slab gives v + h (m - v) + l (w - m). 32 lanes of a warp are 32 neighboring rows of a
detector column: they are in the same slab at the same time and read neighboring voxels of a
few columns.

- *Fixed point.* Where a ray is at slab k (b and z in voxels) is kept as an integer with 44 bits
  behind the point, start + k slope: no rounding adds up, on cards that are 64 times slower in
  double precision, too. The slope is off by 2^-45 at most, a position after 2000 slabs by 6e-11
  voxels; 19 bits before the point hold boxes of up to 2^17 voxels with room for rays beside
  them.
- *Single precision between.* Every 32 slabs the position is split anew into its nearest plane
  (an integer) and the distance from it (single precision): within the 32 slabs a crossing is
  off by at most 1e-5 slabs, 2^-24 (32 + 64) + 2^-24 32 for rounding the sum, the distance and
  the slope, for *any* slope: near a plane the distance itself is small, so that even a slope of
  1e-6 does not enlarge it. The 32 slabs are summed on their own before they join the rest.
- *Floor without a conversion.* y + 1.5 2^23, rounded down, has floor(y) in its lowest bits, one
  instruction; y minus that floor, over the slope and clamped to [0, 1], is the share behind the
  crossing, and is 1 where none was crossed in this slab: the two voxels are then the same.
- *The middle loop asks nothing.* Slabs that all lanes of a warp cross well inside the box are
  walked four at a time without any branch: twelve loads are under way before the first is
  needed, which is what hides the memory's latency. The slabs at both ends are walked by a loop
  that checks each voxel; cells outside count 0.
- *Sides.* A ray that lies in a voxel plane belongs to the voxel above, or below where it moves
  down, however slowly: as on the processor. For the direction to have the same sign there, its
  products are rounded on their own (no fused multiply-add), as they are there.

tests/studies/gpu_code.py holds what the compiler makes of this: registers, loads, instructions.
"""

from __future__ import annotations

import math
import operator

import numpy as np
from numba import config, cuda

config.CUDA_LOW_OCCUPANCY_WARNINGS = (
    0  # one small image is no reason to warn in a server's log
)

BLOCK = (32, 4)
"""Threads a block: detector rows (one warp), and columns."""
UNROLLED_SLABS = 4
"""Slabs at a time in the middle loop."""
ANCHOR_SLABS = 32
"""Slabs between two positions from fixed point; a power of 2."""
FIXED_BITS = 44
"""Bits of a position behind the point."""
FIXED = float(2**FIXED_BITS)
HALF_FIXED = 2 ** (FIXED_BITS - 1)
UNIT = np.float32(1.0 / FIXED)
MAX_POSITION_VOXELS = float(2**18)
"""Limit of positions; larger ones are clipped to it, outside of every box."""
MAGIC = np.float32(1.5 * 2**23)
MAGIC_BITS = 0x4B400000
MARGIN_SLABS = np.float32(0.01)
"""Slabs this near to where a ray enters or leaves the box are checked; single precision places
these points within 4e-3 slabs in boxes of up to 2^14: 3 roundings, each of 2^-24."""
STEEP_INVERSE = np.float32(1e30)
"""Value used for one over a slope of zero."""
ZERO, ONE = np.float32(0), np.float32(1)
NEVER = 1 << 30
MAX_RISE_VOXELS = 0.25
"""Largest rise along z of a ray of `project_columns` in a slab [voxels]."""
LANES = 0xFFFFFFFF

LANES_MEET = not config.ENABLE_CUDASIM
"""Whether lanes of a warp exchange values: in the simulator only where a test lets them."""
FEW_REGISTERS = {} if config.ENABLE_CUDASIM else {"max_registers": 56}
"""Nine blocks of 128 threads on a multiprocessor instead of seven take 0.8 times as long
(H200, 512^3); the rest is stored once every 32 slabs."""

if config.ENABLE_CUDASIM:
    # What the simulator lacks. A lane there exchanges with itself, unless a test lets lanes
    # meet.

    times, plus = operator.mul, operator.add

    def fused(a, b, c):  # noqa: D103
        return np.float32(np.float64(a) * np.float64(b) + np.float64(c))

    def clamped(x):  # noqa: D103
        return np.float32(min(max(x, ZERO), ONE))

    def floor_bits(y):  # noqa: D103
        return np.float32(math.floor(y)), MAGIC_BITS + math.floor(y)

    def narrow(i):  # noqa: D103
        return (int(i) + 2**31) % 2**32 - 2**31

    def place(i):  # noqa: D103
        return int(i) % 2**32

    def exchange(i, step):  # noqa: D103
        return i

    def meet_lanes():  # noqa: D103
        exchange(0, 1)

    def packed(jump, share):  # noqa: D103
        return int(jump) << 32 | int(np.float32(share).view(np.uint32))

    def unpacked(pair):  # noqa: D103
        return int(pair) >> 32, np.uint32(int(pair) % 2**32).view(np.float32)

else:
    from numba.cuda import libdevice

    times, plus = libdevice.dmul_rn, libdevice.dadd_rn
    fused, clamped = libdevice.fmaf_rn, libdevice.saturatef
    narrow, place = np.int32, np.uint32

    @cuda.jit(device=True, inline=True)
    def floor_bits(y):
        """floor(y), and the bits of MAGIC + floor(y), for |y| < 2^22."""
        moved = libdevice.fadd_rd(y, MAGIC)
        return moved - MAGIC, libdevice.float_as_int(moved)

    @cuda.jit(device=True, inline=True)
    def exchange(i, step):
        """Return the i of the lane whose number differs in the bit `step`."""
        return cuda.shfl_xor_sync(LANES, i, step)

    @cuda.jit(device=True, inline=True)
    def meet_lanes():
        """Wait for the lanes of the warp; what they wrote into shared memory is seen by all."""
        cuda.syncwarp(LANES)

    @cuda.jit(device=True, inline=True)
    def packed(jump, share):
        """Pack a 32-bit integer and a float into one number, read by one instruction."""
        return np.int64(jump) << 32 | np.int64(np.uint32(libdevice.float_as_int(share)))

    @cuda.jit(device=True, inline=True)
    def unpacked(pair):
        """Unpack a number of `packed` into its integer and float."""
        return np.int32(pair >> 32), libdevice.int_as_float(np.int32(pair))


@cuda.jit(device=True, inline=True)
def least(i):
    """Return the smallest i of a warp."""
    for step in (16, 8, 4, 2, 1):
        i = min(i, exchange(i, step))
    return i


@cuda.jit(device=True, inline=True)
def most(i):
    """Return the largest i of a warp."""
    for step in (16, 8, 4, 2, 1):
        i = max(i, exchange(i, step))
    return i


@cuda.jit(device=True, inline=True)
def direction(views, view, r, c, axis):
    """Compute pixel (r, c) minus source along an axis, rounded as the processor does."""
    across = times(float(c), views[view, 6 + axis])
    down = times(float(r), views[view, 9 + axis])
    return plus(plus(views[view, 3 + axis], across), down)


@cuda.jit(device=True, inline=True)
def fixed_line(start, slope, n):
    """Compute a line over the slabs, start + k slope, in fixed point of `FIXED_BITS`
    bits; start is cut to `MAX_POSITION_VOXELS`.

    Returns:
        position and slope in fixed point, slope and its inverse in single precision, and
        the places, in slabs, between which the line is within [0, n). A line without
        slope is inside everywhere or from `STEEP_INVERSE` on, nowhere.
    """
    start = min(max(start, -MAX_POSITION_VOXELS), MAX_POSITION_VOXELS)
    position = np.int64(math.floor(start * FIXED))
    rate = np.int64(math.floor(slope * FIXED + 0.5))
    if rate == 0:
        inside = 0 <= (position >> FIXED_BITS) < n
        return (
            position,
            rate,
            ZERO,
            STEEP_INVERSE,
            ZERO if inside else STEEP_INVERSE,
            STEEP_INVERSE,
        )
    steps = np.float32(1.0 / slope)
    enter, leave = np.float32(-start) * steps, np.float32(n - start) * steps
    return position, rate, np.float32(slope), steps, enter, leave


@cuda.jit(device=True, inline=True)
def anchor(position, rate, k):
    """Find the nearest plane at slab k, less the bits of MAGIC, and its signed distance."""
    at = position + k * rate
    plane = (at + HALF_FIXED) >> FIXED_BITS
    return narrow(plane - MAGIC_BITS), np.float32(at - (plane << FIXED_BITS)) * UNIT


@cuda.jit(device=True, inline=True)
def crossing(t, slope, distance, steps):
    """Compute the state t slabs after an anchor. Returns the bits that number the voxel, and the
    share of the slab before that is behind the last plane crossed."""
    y = fused(t, slope, distance)
    floor, bits = floor_bits(y)
    return bits, clamped((y - floor) * steps)


def slab_kernel(transposed):
    """Make the kernel that walks rays slab by slab: forward it writes images, transposed
    (back projection) it adds to voxels. It is compiled at its first launch.
    """

    @cuda.jit(device=True, inline=True)
    def meet(flat, inside, p, share, value):
        """Read the contribution of a share of a slab in voxel p, or (transposed) add that
        share of `value` to it and return 0; 0 outside or for no share.
        """
        if not inside or share <= ZERO:
            return ZERO
        if transposed:
            cuda.atomic.add(flat, place(p), flat.dtype.type(share * value))
            return ZERO
        return share * flat[place(p)]

    @cuda.jit
    def walk(
        flat,
        base,
        hop_x,
        hop_y,
        nx,
        ny,
        nz,
        size_x,
        size_y,
        size_z,
        views,
        start,
        n,
        images,
        rows,
        cols,
        step_r,
        step_c,
        factor,
    ):
        """Walk the ray to a thread's pixel slab by slab: write its line integral, or
        (transposed) add the pixel's value to the voxels.

        Voxel (x, y, z) is flat[base + x hop_x + y hop_y + z] for nx, ny, nz voxels of
        size_x, size_y, size_z [mm]. Rows start to start + n - 1 of `views` are walked: a
        ray each in voxels, and the number of its image. Pixel (r, c) of image k is
        images[k rows cols + r step_r + c step_c]; written values are multiplied by
        factor.
        """
        # Views are fastest in the grid: blocks at work together read the same part of the
        # volume.
        view = start + cuda.blockIdx.x % n
        # Lanes beyond the detector's end go along with its last ray, and write nothing.
        r = cuda.blockIdx.y * BLOCK[0] + cuda.threadIdx.x
        c = cuda.blockIdx.x // n * BLOCK[1] + cuda.threadIdx.y
        pixel = int(views[view, 12]) * rows * cols + r * step_r + c * step_c
        written = r < rows and c < cols
        r, c = min(r, rows - 1), min(c, cols - 1)
        dx = direction(views, view, r, c, 0)
        dy = direction(views, view, r, c, 1)
        dz = direction(views, view, r, c, 2)
        sa, da, na, hop_a = views[view, 0], dx, nx, hop_x
        sb, db, nb, hop_b = views[view, 1], dy, ny, hop_y
        # Axis a is the faster of x and y. All axes are mirrored so that the ray moves up
        # them; the mirrors are in `base` and in the signs of the hops.
        if abs(dy) > abs(dx):
            sa, da, na, hop_a, sb, db, nb, hop_b = sb, db, nb, hop_b, sa, da, na, hop_a
        sz, hop_z = views[view, 2], 1
        length = math.sqrt((dx * size_x) ** 2 + (dy * size_y) ** 2 + (dz * size_z) ** 2)
        if da < 0.0:
            sa, da, base, hop_a = na - sa, -da, base + (na - 1) * hop_a, -hop_a
        if db < 0.0:
            sb, db, base, hop_b = nb - sb, -db, base + (nb - 1) * hop_b, -hop_b
        if dz < 0.0:
            sz, dz, base, hop_z = nz - sz, -dz, base + nz - 1, -1
        each = 1.0 / da
        mb, mz = db * each, dz * each
        at_b, rate_b, slope_b, steps_b, enter_b, leave_b = fixed_line(
            sb - sa * mb, mb, nb
        )
        at_z, rate_z, slope_z, steps_z, enter_z, leave_z = fixed_line(
            sz - sa * mz, mz, nz
        )
        enter = max(max(enter_b, enter_z), ZERO)
        leave = min(min(leave_b, leave_z), np.float32(na))
        scale = np.float32(length * each)
        value = ZERO
        if transposed and written:
            value = np.float32(images[pixel] * scale * factor)
        # Slabs [first, last) that some lane crosses, and [quick, slow) that all cross well
        # inside.
        first, last, quick, slow = NEVER, 0, 0, 0
        if leave + MARGIN_SLABS >= enter:
            first = max(int(math.floor(enter - MARGIN_SLABS)), 0)  # noqa: RUF046
            last = min(int(math.floor(leave + MARGIN_SLABS)) + 1, na)  # noqa: RUF046
            quick = int(math.ceil(enter + MARGIN_SLABS))  # noqa: RUF046
            slow = int(math.floor(leave - MARGIN_SLABS))  # noqa: RUF046
        # Lanes with different axes a have different numbers of slabs, and each keeps to its
        # own.
        first, last = least(narrow(first)), min(most(narrow(last)), narrow(na))
        quick, slow = most(narrow(quick)), least(narrow(slow))
        hop_a, hop_b, hop_z = narrow(hop_a), narrow(hop_b), narrow(hop_z)
        total = ZERO
        begin = narrow(first & -ANCHOR_SLABS)
        while begin < last:
            # In integers of 32 bits that wrap around: only sums that are places have a meaning.
            plane_b, distance_b = anchor(at_b, rate_b, begin)
            plane_z, distance_z = anchor(at_z, rate_z, begin)
            origin = narrow(base + begin * hop_a + plane_b * hop_b + plane_z * hop_z)
            k, end = (
                narrow(max(begin, first) - begin),
                narrow(min(ANCHOR_SLABS, last - begin)),
            )
            inner = narrow(min(max(quick - begin, k), end))
            outer = narrow(min(max(slow - begin, inner), end))
            # Whole groups for the unrolled loop; what is left of the middle goes to the
            # checked one.
            outer = narrow(inner + ((outer - inner) & -UNROLLED_SLABS))
            b, _ = crossing(np.float32(k), slope_b, distance_b, steps_b)
            z, _ = crossing(np.float32(k), slope_z, distance_z, steps_z)
            part = ZERO
            for after in range(2):
                stop = end if after else inner
                while k < stop:  # before and after the middle: each voxel is checked
                    t = np.float32(k + 1)
                    next_b, h = crossing(t, slope_b, distance_b, steps_b)
                    next_z, l = crossing(t, slope_z, distance_z, steps_z)  # noqa: E741
                    h = h if next_b != b else ZERO
                    l = l if next_z != z else ZERO  # noqa: E741
                    mid_b, mid_z = (next_b, z) if h >= l else (b, next_z)
                    h, l = max(h, l), min(h, l)  # noqa: E741
                    # Voxels before both crossings, between them, and after both; either comes
                    # first.
                    p = narrow(origin + k * hop_a)
                    in_b, in_z = 0 <= b + plane_b < nb, 0 <= z + plane_z < nz
                    out_b, out_z = 0 <= next_b + plane_b < nb, 0 <= next_z + plane_z < nz
                    mid = (out_b if mid_b == next_b else in_b) and (
                        out_z if mid_z == next_z else in_z
                    )
                    at = narrow(p + b * hop_b + z * hop_z)
                    part += meet(flat, in_b and in_z, at, ONE - h, value)
                    at = narrow(p + mid_b * hop_b + mid_z * hop_z)
                    part += meet(flat, mid, at, h - l, value)
                    at = narrow(p + next_b * hop_b + next_z * hop_z)
                    part += meet(flat, out_b and out_z, at, l, value)
                    b, z, k = next_b, next_z, narrow(k + 1)
                if after == 0 and k < outer:
                    origin_k = narrow(origin + k * hop_a)
                    level = narrow(origin_k + z * hop_z)
                    p = narrow(level + b * hop_b)
                    t = np.float32(k)
                    while k < outer:
                        for _ in range(UNROLLED_SLABS):
                            t += ONE
                            next_b, h = crossing(t, slope_b, distance_b, steps_b)
                            next_z, l = crossing(t, slope_z, distance_z, steps_z)  # noqa: E741
                            above = narrow(origin_k + next_z * hop_z)
                            w = narrow(above + next_b * hop_b)
                            rise = narrow(above - level)
                            if transposed:
                                h = h if next_b != b else ZERO
                                l = l if rise != 0 else ZERO  # noqa: E741
                            m = narrow(w - rise) if h >= l else narrow(p + rise)
                            h, l = max(h, l), min(h, l)  # noqa: E741
                            if transposed:
                                meet(flat, True, p, ONE - h, value)
                                meet(flat, True, m, h - l, value)
                                meet(flat, True, w, l, value)
                            else:
                                low, mid, high = (
                                    flat[place(p)],
                                    flat[place(m)],
                                    flat[place(w)],
                                )
                                part = fused(
                                    l, high - mid, fused(h, mid - low, part + low)
                                )
                            origin_k = narrow(origin_k + hop_a)
                            level, p = narrow(above + hop_a), narrow(w + hop_a)
                            b, z = next_b, next_z
                        k = narrow(k + UNROLLED_SLABS)
            total += part
            begin = narrow(begin + ANCHOR_SLABS)
        if not transposed and written:
            images[pixel] = total * scale

    return walk


def column_kernel(transposed):
    """Compile the slab walk of views with detector columns parallel to z; forward, or
    transposed (adds to voxels).

    Rays of one column have their line in x and y in common, and a warp has rays of one
    column: each lane finds the crossing of one of the next 32 slabs with the planes of b,
    for all lanes. Rays rise by at most `MAX_RISE_VOXELS` a slab, so that a lane
    knows the slab of its next crossing with a plane of z, and adds up to 8 times from one
    position of fixed point to the next.
    """

    @cuda.jit(device=True, inline=True)
    def meet(flat, inside, p, share, value):
        """Read the contribution of a share of a slab in voxel p, or (transposed) add that
        share of `value` to it and return 0; 0 outside or for no share.
        """
        if not inside or share <= ZERO:
            return ZERO
        if transposed:
            cuda.atomic.add(flat, place(p), flat.dtype.type(share * value))
            return ZERO
        return share * flat[place(p)]

    @cuda.jit(**FEW_REGISTERS)
    def walk(
        flat,
        base,
        hop_x,
        hop_y,
        nx,
        ny,
        nz,
        size_x,
        size_y,
        size_z,
        views,
        start,
        n,
        images,
        rows,
        cols,
        step_r,
        step_c,
        factor,
    ):
        """Walk the rays of a warp together where they share voxel columns; arguments as
        those of `slab_kernel`'s walk.
        """
        view = start + cuda.blockIdx.x % n
        lane, warp = cuda.threadIdx.x, cuda.threadIdx.y
        r = cuda.blockIdx.y * BLOCK[0] + lane
        c = cuda.blockIdx.x // n * BLOCK[1] + warp
        pixel = int(views[view, 12]) * rows * cols + r * step_r + c * step_c
        written = r < rows and c < cols
        r, c = min(r, rows - 1), min(c, cols - 1)
        dx = direction(views, view, r, c, 0)
        dy = direction(views, view, r, c, 1)
        dz = direction(views, view, r, c, 2)
        sa, da, na, hop_a = views[view, 0], dx, nx, hop_x
        sb, db, nb, hop_b = views[view, 1], dy, ny, hop_y
        if abs(dy) > abs(dx):
            sa, da, na, hop_a, sb, db, nb, hop_b = sb, db, nb, hop_b, sa, da, na, hop_a
        sz, hop_z, low_z = views[view, 2], 1, 0
        length = math.sqrt((dx * size_x) ** 2 + (dy * size_y) ** 2 + (dz * size_z) ** 2)
        if da < 0.0:
            sa, da, base, hop_a = na - sa, -da, base + (na - 1) * hop_a, -hop_a
        if db < 0.0:
            sb, db, base, hop_b = nb - sb, -db, base + (nb - 1) * hop_b, -hop_b
        if dz < 0.0:
            sz, dz, low_z, hop_z = nz - sz, -dz, nz - 1, -1
        each = 1.0 / da
        mb, mz = db * each, dz * each
        at_b, rate_b, slope_b, steps_b, enter_b, leave_b = fixed_line(
            sb - sa * mb, mb, nb
        )
        at_z, rate_z, slope_z, steps_z, enter_z, leave_z = fixed_line(
            sz - sa * mz, mz, nz
        )
        enter = max(max(enter_b, enter_z), ZERO)
        leave = min(min(leave_b, leave_z), np.float32(na))
        scale = np.float32(length * each)
        value = ZERO
        if transposed and written:
            value = np.float32(images[pixel] * scale * factor)
        first, last, quick, slow = NEVER, 0, 0, 0
        if leave + MARGIN_SLABS >= enter:
            first = max(int(math.floor(enter - MARGIN_SLABS)), 0)  # noqa: RUF046
            last = min(int(math.floor(leave + MARGIN_SLABS)) + 1, na)  # noqa: RUF046
            quick = int(math.ceil(enter + MARGIN_SLABS))  # noqa: RUF046
            slow = int(math.floor(leave - MARGIN_SLABS))  # noqa: RUF046
        # Rays of one detector column have axis a in common, so the last slab needs no limit.
        first, last = least(narrow(first)), most(narrow(last))
        quick, slow = most(narrow(quick)), least(narrow(slow))
        hop_a, hop_b, hop_z = narrow(hop_a), narrow(hop_b), narrow(hop_z)
        nb, nz, low_z = narrow(nb), narrow(nz), narrow(low_z)
        pairs = cuda.shared.array(128, np.int64)
        places = cuda.shared.array(128, np.int32)
        inside = cuda.shared.array(128, np.int32)
        own = narrow(warp * ANCHOR_SLABS)
        mine = place(own + lane)
        total = ZERO
        begin = narrow(first & -ANCHOR_SLABS)
        while begin < last:
            plane_b, distance_b = anchor(at_b, rate_b, begin)
            plane_z, distance_z = anchor(at_z, rate_z, begin)
            # Each lane works out one slab's crossing of b for all lanes, whose rays are one
            # line in x and y: 32 slabs cost one evaluation.
            b, _ = crossing(np.float32(lane), slope_b, distance_b, steps_b)
            next_b, h = crossing(np.float32(lane + 1), slope_b, distance_b, steps_b)
            here, there = narrow(b + plane_b), narrow(next_b + plane_b)
            # None may write before all have read the last 32 slabs, nor read before all have
            # written.
            meet_lanes()
            pairs[mine] = packed(
                narrow((there - here) * hop_b), h if next_b != b else ZERO
            )
            places[mine] = narrow(base + (begin + lane) * hop_a + here * hop_b)
            # Bit 0: the voxel before the crossing is in the box; bit 1: the one behind it.
            inside[mine] = (1 if 0 <= here < nb else 0) + (2 if 0 <= there < nb else 0)
            meet_lanes()
            k, end = (
                narrow(max(begin, first) - begin),
                narrow(min(ANCHOR_SLABS, last - begin)),
            )
            inner = narrow(min(max(quick - begin, k), end))
            outer = narrow(min(max(slow - begin, inner), end))
            outer = narrow(inner + ((outer - inner) & -UNROLLED_SLABS))
            part = ZERO
            for after in range(2):
                stop = end if after else inner
                if k < stop or (after == 0 and k < outer):
                    y = fused(np.float32(k), slope_z, distance_z)
                    floor, z = floor_bits(y)
                    z = narrow(low_z + (z + plane_z) * hop_z)
                    # Rays rise by a quarter voxel a slab at most: the next plane of z is
                    # known slabs before, by its distance from the anchor, and each slab asks
                    # only whether it has come.
                    ahead = (
                        (floor + ONE) - distance_z
                    ) * steps_z  # exact where it is near
                t = np.float32(k)
                while k < stop:
                    jump, h = unpacked(pairs[place(own + k)])
                    t += ONE
                    # Above 0 in one slab for each plane, the one in which the ray passes it.
                    l = clamped(t - ahead)  # noqa: E741
                    up = narrow(0)
                    if l > ZERO:
                        up = hop_z
                        ahead += steps_z
                    in_b, out_b = (
                        inside[place(own + k)] & 1 != 0,
                        inside[place(own + k)] & 2 != 0,
                    )
                    in_z, out_z = 0 <= z < nz, 0 <= z + up < nz
                    p = narrow(places[place(own + k)] + z)
                    mid = out_b and in_z if h >= l else in_b and out_z
                    m = narrow(p + (jump if h >= l else up))
                    h, l = max(h, l), min(h, l)  # noqa: E741
                    part += meet(flat, in_b and in_z, p, ONE - h, value)
                    part += meet(flat, mid, m, h - l, value)
                    part += meet(flat, out_b and out_z, narrow(p + jump + up), l, value)
                    z, k = narrow(z + up), narrow(k + 1)
                if after == 0 and k < outer:
                    p = narrow(places[place(own + k)] + z)
                    at = place(own + k)
                    while k < outer:
                        for i in range(UNROLLED_SLABS):
                            jump, h = unpacked(pairs[at + place(i)])
                            t += ONE
                            l = clamped(t - ahead)  # noqa: E741
                            up = narrow(0)
                            if l > ZERO:
                                up = hop_z
                                ahead += steps_z
                            m = narrow(p + (jump if h >= l else up))
                            w = narrow(p + jump + up)
                            h, l = max(h, l), min(h, l)  # noqa: E741
                            if transposed:
                                meet(flat, True, p, ONE - h, value)
                                meet(flat, True, m, h - l, value)
                                meet(flat, True, w, l, value)
                            else:
                                low, mid, high = (
                                    flat[place(p)],
                                    flat[place(m)],
                                    flat[place(w)],
                                )
                                part = fused(
                                    l, high - mid, fused(h, mid - low, part + low)
                                )
                            p = narrow(w + hop_a)
                        at = place(at + place(UNROLLED_SLABS))
                        k = narrow(k + UNROLLED_SLABS)
            total += part
            begin = narrow(begin + ANCHOR_SLABS)
        if not transposed and written:
            images[pixel] = total * scale

    return walk


@cuda.jit(device=True, inline=True)
def enter_box(s, d, n, enter, leave):
    """Cut [enter, leave] down to where s + t d is in [0, n); returns (1, 0), which is
    empty, if it never is and d is 0.
    """
    if d == 0.0:
        if s < 0.0 or s >= n:
            return 1.0, 0.0
        return enter, leave
    a = -s / d
    b = (n - s) / d
    return max(enter, min(a, b)), min(leave, max(a, b))


@cuda.jit(device=True, inline=True)
def first_crossing(s, d, n, enter, unit):
    """Find the first crossing of an axis after the entry, in `unit`s of t.

    `s`: the source's place along the axis [voxels]; `d`: the ray's length along it [voxels];
    `n`: voxels along it; `enter`: t of the entry into the box; `unit`: factor on t.
    Returns voxel at entry, distance of the first crossing after it, distance between crossings,
    and crossings until the box ends. Along an axis that the ray does not move on: infinity, 0
    and 1.
    """
    at = plus(s, times(enter, d))
    # On the device, floor gives a float.
    i = min(max(int(math.floor(at)), 0), n - 1)  # noqa: RUF046
    if d > 0.0:
        return (
            i,
            np.float32(max((i + 1 - at) / d * unit, 0.0)),
            np.float32(unit / d),
            n - i,
        )
    if d < 0.0:
        return i, np.float32(max((i - at) / d * unit, 0.0)), np.float32(-unit / d), i + 1
    return i, np.float32(math.inf), np.float32(0.0), 1


def ray_kernel(transposed):
    """Compile the walk of single rays from voxel to voxel; any geometry, forward, or
    transposed (adds to voxels).

    Entry and exit are computed in double precision; the walk counts crossings from the
    entry in single precision (error below 1e-4 of a voxel, not growing with the distance
    to the source).
    """

    @cuda.jit
    def walk(
        flat,
        base,
        hop_x,
        hop_y,
        nx,
        ny,
        nz,
        size_x,
        size_y,
        size_z,
        views,
        start,
        n,
        images,
        rows,
        cols,
        step_r,
        step_c,
        factor,
    ):
        """Walk the ray to a thread's pixel voxel by voxel, in any direction; arguments as
        those of `slab_kernel`'s walk. A ray that misses the box gives 0 or adds nothing.
        """
        view = start + cuda.blockIdx.x % n
        r = cuda.blockIdx.y * BLOCK[0] + cuda.threadIdx.x
        c = cuda.blockIdx.x // n * BLOCK[1] + cuda.threadIdx.y
        if r >= rows or c >= cols:
            return
        pixel = int(views[view, 12]) * rows * cols + r * step_r + c * step_c
        dx = direction(views, view, r, c, 0)
        dy = direction(views, view, r, c, 1)
        dz = direction(views, view, r, c, 2)
        sx, sy, sz = views[view, 0], views[view, 1], views[view, 2]
        # In units of the ray's parameter t from 0 (source) to 1 (pixel).
        enter, leave = enter_box(sx, dx, nx, 0.0, 1.0)
        enter, leave = enter_box(sy, dy, ny, enter, leave)
        enter, leave = enter_box(sz, dz, nz, enter, leave)
        if leave <= enter:
            if not transposed:
                images[pixel] = ZERO
            return
        length = math.sqrt((dx * size_x) ** 2 + (dy * size_y) ** 2 + (dz * size_z) ** 2)
        # Distances are counted in steps of the fastest axis (t times unit), so that single
        # precision resolves them alike for every ray.
        unit = max(abs(dx), max(abs(dy), abs(dz)))
        scale = np.float32(length / unit)
        value = np.float32(images[pixel] * scale * factor) if transposed else ZERO
        if transposed and value == ZERO:
            return
        ix, first_x, every_x, left_x = first_crossing(sx, dx, nx, enter, unit)
        iy, first_y, every_y, left_y = first_crossing(sy, dy, ny, enter, unit)
        iz, first_z, every_z, left_z = first_crossing(sz, dz, nz, enter, unit)
        p = base + ix * hop_x + iy * hop_y + iz
        hop_x = hop_x if dx > 0.0 else -hop_x
        hop_y = hop_y if dy > 0.0 else -hop_y
        hop_z = 1 if dz > 0.0 else -1
        end = np.float32((leave - enter) * unit)
        next_x, next_y, next_z = first_x, first_y, first_z
        done_x, done_y, done_z = 0, 0, 0
        t, total = ZERO, ZERO
        while True:
            upto = min(end, min(next_x, min(next_y, next_z)))
            if transposed:
                cuda.atomic.add(flat, p, flat.dtype.type((upto - t) * value))
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
        if not transposed:
            images[pixel] = total * scale

    return walk


project_slabs, spread_slabs = slab_kernel(False), slab_kernel(True)
project_columns, spread_columns = column_kernel(False), column_kernel(True)
project_rays, spread_rays = ray_kernel(False), ray_kernel(True)


@cuda.jit
def clear(values):
    """Set values to 0 on the device, without sending zeros."""
    i = cuda.grid(1)
    if i < values.size:
        values[i] = 0


@cuda.jit
def unscale(sums, factor, flat):
    """Compute flat += sums / factor, from sums of integers, the same in every run."""
    i = cuda.grid(1)
    if i < flat.size:
        flat[i] += np.float32(sums[i] / factor)


ADD, SUBTRACT, MULTIPLY, MAXIMUM, RATIO = range(5)
DOT, SUM, LARGEST = range(3)
FOLDING = (256, 256)
"""Blocks, and threads a block, of `fold`."""
RUN_NUMBERS = 64
"""Numbers added in single precision before they join the sum in double precision, in
which consumer cards are 64 times slower."""


@cuda.jit
def combine(kind, a, b, number, alone, out):
    """Compute out = a (kind) b, or a (kind) number if alone, one element a thread.

    Args:
        kind: ADD, SUBTRACT, MULTIPLY, MAXIMUM or RATIO.
        a: (k,) float32.
        b: (k,) float32.
        number: second operand if alone; otherwise a RATIO is 0 where b <= number.
        alone: b is not read.
        out: (k,) filled; may be a.
    """
    i = cuda.grid(1)
    if i >= out.size:
        return
    x = a[i]
    y = number if alone else b[i]
    if kind == ADD:
        x += y
    elif kind == SUBTRACT:
        x -= y
    elif kind == MULTIPLY:
        x *= y
    elif kind == MAXIMUM:
        x = max(x, y)
    else:
        x = x / y if y > number else np.float32(0)
    out[i] = x


@cuda.jit
def fold(kind, a, b, parts):
    """Reduce every parts.size-th run of `RUN_NUMBERS` into parts[i], one thread
    each: single precision within a run, double over the runs.

    The bytes of the result are the same at every call. Kinds: DOT adds a b, SUM adds a,
    LARGEST takes the largest a.
    """
    i = cuda.grid(1)
    if i >= parts.size:
        return
    # Which numbers a thread adds depends on `parts` alone, and the host adds the parts in
    # order.
    total = -math.inf if kind == LARGEST else 0.0
    for first in range(i * RUN_NUMBERS, a.size, parts.size * RUN_NUMBERS):
        last = min(first + RUN_NUMBERS, a.size)
        part = a[first]  # single precision within a run
        if kind == DOT:
            part *= b[first]
        for k in range(first + 1, last):
            x = a[k]
            if kind == DOT:
                part += x * b[k]
            elif kind == SUM:
                part += x
            else:
                part = max(part, x)
        if kind == LARGEST:
            total = max(total, float(part))
        else:
            total += part
    parts[i] = total
