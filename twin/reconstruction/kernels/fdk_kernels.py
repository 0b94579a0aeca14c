"""Voxel-driven backprojection with FDK's weights for upright panels.

All voxels above one another fall on one line of detector columns, so a column of the image is
interpolated once and every voxel costs one look-up between two rows. Arguments are not checked.

Two columns of an image are mixed, and the result, resampled with constant step, is added to a
column of voxels: sixteen voxels at a time by register permutation where the processor has
AVX-512, eight where it has AVX2, one by one elsewhere; the results differ by rounding only.
Registers begin at multiples of their length, so that a slab of a volume that begins at one is
the whole volume's, bit by bit. Places on a line are integers with 44 bits behind the point:
from register to register they are added to, and their whole part is a shift, where in floating
point half the time went.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from llvmlite import ir
from numba import prange, types
from numba.core import cgutils, config
from numba.core.codegen import get_host_cpu_features
from numba.extending import intrinsic

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection.kernels.compiling import (
    fetch_next,
    fused,
    inline,
    kernel,
    parallel,
)
from flexdt.twin.projection.volume import aligned_zeros


def lanes() -> int:
    """Return the float32 voxels in a register of the processor that numba compiles for:
    16 (AVX-512), 8 (AVX2), or 1 where fused multiply-add or AVX2 is missing.

    The features of numba's setting CPU_FEATURES count, else those of this processor.
    """
    stated = config.CPU_FEATURES
    features = (get_host_cpu_features() if stated is None else stated).split(",")
    if "+fma" not in features:
        return 1
    return 16 if "+avx512f" in features else 8 if "+avx2" in features else 1


LANES = lanes()
STEEPEST = 1.9
"""Largest step [samples a voxel] for which LANES voxels are within 2 LANES samples."""
MARGIN = 32
"""Samples after the end of a line that may be read or written, but do not count."""
POINT = 44
"""Bits behind the point of a position on a line."""
EDGE_ROWS = 1e-3
"""Distance beyond the outermost rows within which a voxel is seen [rows]: voxels on the axis are
often exactly before these rows, where rounding must not decide."""

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_INTS = ir.VectorType(ir.IntType(32), LANES)


def _spread(builder: Any, value: Any) -> Any:
    none = ir.Constant(_FLOATS, ir.Undefined)
    one = builder.insert_element(none, value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, none, ir.Constant(_INTS, [0] * LANES))


def _pick(builder: Any, low: Any, high: Any, index: Any) -> Any:
    """Emit the selection of samples by index from two registers, one after the other.

    Args:
        builder: of LLVM's instructions.
        low: the first register.
        high: the second.
        index: register of LANES indices, 0 <= index < 2 LANES.

    Returns:
        The register of the selected samples.
    """

    def permute(name: str, *args: Any) -> Any:
        """Emit a call of the intrinsic `name`, which permutes registers, declared in the
        module if needed; returns the permuted register.
        """
        kind = ir.FunctionType(_FLOATS, [arg.type for arg in args])
        return builder.call(
            cgutils.get_or_insert_function(builder.module, kind, name), args
        )

    if LANES == 16:
        return permute("llvm.x86.avx512.vpermi2var.ps.512", low, index, high)
    # AVX2 permutes one register; of an index only the last three bits count.
    beyond = builder.icmp_signed(">=", index, ir.Constant(_INTS, [LANES] * LANES))
    low, high = (permute("llvm.x86.avx2.permps", half, index) for half in (low, high))
    return builder.select(beyond, high, low)


def _at(
    context: Any, builder: Any, signature: Any, args: Any, array: int, index: Any
) -> Any:
    """Emit the address of LANES float32 values in a numba array.

    Args:
        context, builder, signature, args: of numba's code generator.
        array: number of the array among the arguments.
        index: of the first value, an LLVM integer.

    Returns:
        Pointer to a register.
    """
    data = context.make_array(signature.args[array])(context, builder, args[array]).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


def _load(builder: Any, address: Any) -> Any:
    value = builder.load(address)
    value.align = 4
    return value


def _fma(builder: Any, *args: Any) -> Any:
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
    name = f"llvm.fma.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)


@intrinsic
def mix_lanes(
    typingctx: Any, out: Any, r: Any, left: Any, right: Any, at: Any, one: Any, other: Any
) -> Any:
    """Compute out[r + i] = one * left[at + i] + other * right[at + i], 0 <= i < LANES.

    Not for 1 lane. Neither bounds nor alignment are checked; `out` is changed in place.
    """

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        """Emit the weighted sum of LANES elements of two arrays, stored in the first;
        returns numba's void.
        """
        left = _load(b, _at(context, b, signature, args, 2, args[4]))
        right = _load(b, _at(context, b, signature, args, 3, args[4]))
        mixed = _fma(b, left, _spread(b, args[5]), b.fmul(right, _spread(b, args[6])))
        b.store(mixed, _at(context, b, signature, args, 0, args[1])).align = 4
        return context.get_dummy_value()

    return types.void(out, r, left, right, at, one, other), codegen


@intrinsic
def resample_lanes(
    typingctx: Any, acc: Any, k: Any, line: Any, at: Any, v: Any, step: Any
) -> Any:
    """Add line at (at + v / 2^POINT + i step), linear, to acc[k + i], 0 <= i < LANES.

    Not for 1 lane. Needs 0 <= v / 2^POINT + i step < 2 LANES - 1, which is not checked;
    reads line[at : at + 2 LANES].
    """

    def codegen(context: Any, b: Any, signature: Any, args: Any) -> Any:
        """Emit LLVM code of the linear look-up of LANES places in a line, added to LANES
        elements of the target; returns numba's void.
        """
        target = _at(context, b, signature, args, 0, args[1])
        # line[at : at + 2 LANES] in two registers, between whose samples the permutation picks.
        second = b.add(args[3], ir.IntType(64)(LANES))
        first, second = (
            _load(b, _at(context, b, signature, args, 2, i)) for i in (args[3], second)
        )
        # place[i] = v / 2^POINT + i step; index and share are its whole part and its rest.
        ramp = ir.Constant(_FLOATS, [float(i) for i in range(LANES)])
        steps = b.fmul(ramp, _spread(b, args[5]))
        unit = ir.Constant(_FLOATS, [2.0**-POINT] * LANES)
        place = _fma(b, _spread(b, b.sitofp(args[4], ir.FloatType())), unit, steps)
        index = b.fptosi(place, _INTS)
        share = b.fsub(place, b.sitofp(index, _FLOATS))
        # acc[k + i] += low + share * (high - low), low and high being neighbours.
        low = _pick(b, first, second, index)
        high = _pick(b, first, second, b.add(index, ir.Constant(_INTS, [1] * LANES)))
        after = _fma(b, share, b.fsub(high, low), b.fadd(_load(b, target), low))
        b.store(after, target).align = 4
        return context.get_dummy_value()

    return types.void(acc, k, line, at, v, step), codegen


@fused
def mix_one_by_one(out, left, right, first, count, one, other):
    """Compute out[r] = one * left[first + r] + other * right[first + r], 0 <= r < count,
    one value after the other; `out` is changed in place."""
    for r in range(count):
        out[r] = one * left[first + r] + other * right[first + r]


@kernel
def mix_wide(out, left, right, first, count, one, other):
    """Apply `mix_one_by_one` to LANES at a time; all need LANES - 1 values after their end."""
    for r in range(0, count, LANES):
        mix_lanes(out, r, left, right, first + r, one, other)


@kernel
def add_line(acc, line, first, count, start, step):
    """Add line at (start + k step), linear, to acc[first + k], 0 <= k < count, in place.

    Unchecked: all places are inside the line, with one sample after the last.
    """
    for k in range(count):
        at = start + k * step
        i = np.uint64(at)
        value = line[i]
        acc[first + k] += value + np.float32(at - i) * (line[i + np.uint64(1)] - value)


@kernel
def add_line_wide(acc, line, first, count, start, step):
    """Apply `add_line`, with its arguments, to LANES voxels at a time while that fits;
    one by one for the first up to an aligned voxel, for the rest, and for all if the step
    is `STEEPEST` or more.

    Adds to `acc`, aligned to registers; `line` needs MARGIN samples after its end.
    """
    k = np.int64(0)
    if abs(step) < STEEPEST:
        narrow = np.float32(step)
        k = np.int64(min(-first % LANES, count))
        if k > 0:
            add_line(acc, line, first, k, start, step)
        place = np.int64((start + k * step) * 2.0**POINT)
        on = np.int64(LANES * step * 2.0**POINT)
        # From the first voxel of a register to the one with the lowest place.
        down = np.int64(min(0.0, (LANES - 1) * step) * 2.0**POINT)
        while k + LANES <= count:
            # Rounding may put the lowest a little below the line's beginning.
            base = max((place + down) >> POINT, 0)
            resample_lanes(acc, first + k, line, base, place - (base << POINT), narrow)
            place += on
            k += LANES
    if k < count:
        add_line(acc, line, first + k, count - k, start + k * step, step)


# Chosen here, not in a kernel: an instruction that the processor lacks must not even be
# compiled.
add_column = add_line if LANES == 1 else add_line_wide
mix_columns = mix_one_by_one if LANES == 1 else mix_wide


TILE = 8
WIDE = 64
"""Neighbouring voxels that are computed at a time for few rows."""


@fused
def _times(line, left, right, part):
    """Compute line *= left + part * (right - left)."""
    for r in range(line.size):
        line[r] *= left[r] + part * (right[r] - left[r])


@inline
def _column(g, cols, x, y):
    """Find the column in which a view sees all voxels above one another at (x, y) [mm].

    `g`: (11,) row of the views' table, see `backproject`; `cols`: of the image; `x`: [mm]; `y`:
    [mm].
    Returns depth along the panel's normal [mm], and the column, a fraction from 0 to cols - 1.
    (0, 0) if the voxels are behind the source or beside the image.
    """
    x -= g[0]
    y -= g[1]
    depth = x * g[3] + y * g[4]
    if depth <= 0.0:
        return 0.0, 0.0
    c = g[8] + (x * g[5] + y * g[6]) * (1.0 / depth) * g[7]
    if c < 0.0 or c > cols - 1:
        return 0.0, 0.0
    return depth, c


@inline
def _layers(start, step, rows, count):
    """Find which of the voxels above one another a view sees: those whose rows are on the panel,
    or beside it by `EDGE_ROWS`. `start`: row of the lowest voxel, a fraction; `step`: change of
    the row a voxel, negative; `rows`: of the image; `count`: number of voxels. Returns the
    lowest and the highest one; the highest is below the lowest if there is none."""
    every = 1.0 / step
    lowest = max(0, math.ceil((rows - 1 + EDGE_ROWS - start) * every))
    highest = min(count - 1, math.floor((-EDGE_ROWS - start) * every))
    return lowest, highest


@kernel
def _add_view(acc, image, rows, shares, g, x, y, z0, dz, line):
    """Add one view to the voxels above one another at (x, y), weighted by 1 / depth^2;
    see `backproject`.

    Nothing is added where the column is beyond the image or behind the source, and only
    to voxels whose rows are on the panel (`_layers`). Values are interpolated linearly between
    columns and rows.

    Args:
        acc: (nz,) voxels, changed in place.
        image: (cols, rows) filtered.
        rows: of the image.
        shares: (depths, rows) of a helix; unused otherwise.
        g: (11,) row of the views' table, or (13,) of a helix.
        x: [mm].
        y: [mm].
        z0: lowest voxel's center [mm].
        dz: step along z [mm].
        line: room for a column of the image, overwritten.
    """
    depth, c = _column(g, len(image), x, y)
    if depth == 0.0:
        return
    inverse = 1.0 / depth
    i = min(int(c), len(image) - 2)
    # The row of voxel k is start + k step.
    step = -dz * g[9] * inverse
    start = g[10] - (z0 - g[2]) * g[9] * inverse
    # Rows fall with z (step < 0). A place just before the first row is read along the line
    # through the first two, one just behind the last is the last, which is there twice.
    lowest, highest = _layers(start, step, rows, acc.size)
    if highest < lowest:
        return
    # The column between image columns i and i + 1, only over the rows that are needed, from a
    # whole register on, times the weight.
    top = int(start + highest * step) // LANES * LANES
    bottom = min(rows - 1, int(start + lowest * step) + 1)
    weight, part = inverse * inverse, c - i
    one, other = np.float32(weight * (1.0 - part)), np.float32(weight * part)
    mix_columns(line, image[i], image[i + 1], top, bottom - top + 1, one, other)
    if g.size > 11:
        at = max((depth - g[11]) * g[12], 0.0)
        j = min(int(at), len(shares) - 2)
        _times(
            line[: bottom - top + 1],
            shares[j, top : bottom + 1],
            shares[j + 1, top : bottom + 1],
            np.float32(min(at - j, 1.0)),
        )
    # The look-up at the last row reads one sample more.
    line[bottom - top + 1] = line[bottom - top]
    first = start + lowest * step - top
    add_column(acc, line, lowest, highest - lowest + 1, first, step)


@fused
def _places(at, across, down, weight, size, base, zero, depth, slope, c, turn, row, rise):
    """Compute where a view sees neighboring voxels.

    Numbers that differ little are float32. Places are limited to the image, so that those
    without weight can be read.

    Args:
        at: (n,) int32, filled: index of the sample before each place, column * rows +
            row.
        across, down: (n,) filled: fractions of a column and a row behind it.
        weight: (n,) filled: 1 / depth^2; 0 for voxels behind the source or off the image
            (above and below it by more than `EDGE_ROWS`).
        size: columns and rows of the image.
        base: the column to which `c` is relative.
        zero: the voxel of which `depth`, `c` and `row` are.
        slope: change a voxel of the depth.
        turn, rise: change a voxel of column and row times the depth.
    """
    none, edge = np.float32(0.0), np.float32(EDGE_ROWS)
    first, last, lowest = (
        np.float32(-base),
        np.float32(size[0] - 1 - base),
        np.float32(size[1] - 1),
    )
    for k in range(at.size):
        # c(k) - c = step turn / depth(k) exactly, as both numbers are linear in k:
        # differences from one voxel are small enough for float32, places are not.
        step = np.float32(k - zero)
        far = depth + step * slope
        inverse = np.float32(1.0) / far
        column, line = c + step * turn * inverse, row + step * rise * inverse
        # One condition a line: the compiler does sixteen voxels at a time then.
        part = inverse * inverse if far > none else none
        part = part if column >= first else none
        part = part if column <= last else none
        part = part if line >= -edge else none
        weight[k] = part if line <= lowest + edge else none
        column, line = min(max(column, first), last), min(max(line, none), lowest)
        i = np.int32(column)
        # An integer is cut towards 0, but columns left of `base` are negative.
        i = min(i - np.int32(column < np.float32(i)), np.int32(size[0] - 2 - base))
        j = min(np.int32(line), np.int32(size[1] - 2))
        across[k], down[k] = column - np.float32(i), line - np.float32(j)
        at[k] = (i + np.int32(base)) * np.int32(size[1]) + j


@fused
def _add_places(acc, image, rows, at, across, down, weight):
    """Add a view's values at places, interpolated bilinearly and weighed, to voxels; no bounds
    are checked.

    `acc`: (n,) voxels, changed in place; `image`: (cols * rows,); `rows`: of the image; `at`:
    (n,) index of the sample before each place; `across`: (n,) fraction of a column behind it;
    `down`: (n,) fraction of a row behind it; `weight`: (n,).
    """
    rows = np.uint64(rows)
    for k in range(at.size):
        i = np.uint64(at[k])
        left, below = image[i], image[i + np.uint64(1)]
        upper = left + across[k] * (image[i + rows] - left)
        lower = below + across[k] * (image[i + rows + np.uint64(1)] - below)
        acc[k] += weight[k] * (upper + down[k] * (lower - upper))


@kernel
def _add_few(acc, image, rows, g, x, y, z0, dx, dz, at, parts):
    """Add one view to neighboring voxels along x, layer by layer: for few rows, for
    which full registers would not pay.

    Nothing is added if the farthest voxel is behind the source; single voxels behind it
    or off the image get weight 0.

    Args:
        acc: (nx, nz) voxels from (x, y) on, changed in place; nx at most WIDE.
        image: (cols, rows) filtered.
        rows: of the image.
        g: (11,) row of the views' table, see `backproject`.
        x: of the first voxel [mm].
        y: of all [mm].
        z0: of the lowest [mm].
        dx: step along x [mm].
        dz: step along z [mm].
        at: room for WIDE indices.
        parts: (3, WIDE) room.
    """
    n, cols = len(acc), len(image)
    y -= g[1]
    slope = dx * g[3]
    # Where that one is behind the source, all are.
    zero = n - 1 if slope > 0.0 else 0  # the farthest one
    x += zero * dx - g[0]
    depth = x * g[3] + y * g[4]
    if depth <= 0.0:
        return
    aside = (x * g[5] + y * g[6]) / depth
    c = g[8] + aside * g[7]
    base = math.floor(min(max(c, 0.0), cols - 1.0))
    turn = (dx * g[5] - aside * slope) * g[7]
    at, across, down, weight = at[:n], parts[0, :n], parts[1, :n], parts[2, :n]
    for k in range(acc.shape[1]):
        up = (z0 + k * dz - g[2]) * g[9] / depth
        _places(
            at,
            across,
            down,
            weight,
            (cols, rows),
            base,
            zero,
            np.float32(depth),
            np.float32(slope),
            np.float32(c - base),
            np.float32(turn),
            np.float32(g[10] - up),
            np.float32(up * slope),
        )
        _add_places(acc[:, k], image.reshape(cols * rows), rows, at, across, down, weight)


@kernel
def _add_tile(
    images,
    rows,
    shares,
    views,
    first_x,
    first_y,
    x0,
    y0,
    z0,
    dx,
    dy,
    dz,
    line,
    at,
    parts,
    volume,
):
    """Add all views to one tile of voxel columns, TILE along y and TILE along x; WIDE
    along x for panels of few rows, which have a way of their own (`_add_few`). Tiles end
    at the grid's edges.

    The sum is added to `volume` in place.

    Args:
        images, rows, shares, views, x0, y0, z0, dx, dy, dz, volume: as for `backproject`;
            images without additional rows mean few rows.
        first_x, first_y: the tile's first voxel column.
        line, at, parts: room.
    """
    ny, nx = volume.shape[:2]
    few = images.shape[2] == rows
    last_x = min(nx, first_x + (WIDE if few else TILE))
    # Views outside, voxels inside: the tile stays in the cache while all views pass.
    for view in range(len(images)):
        g, share = views[view], shares[view]
        for iy in range(first_y, min(ny, first_y + TILE)):
            y = y0 + iy * dy
            if few:
                some = volume[iy, first_x:last_x]
                _add_few(
                    some,
                    images[view],
                    rows,
                    g,
                    x0 + first_x * dx,
                    y,
                    z0,
                    dx,
                    dz,
                    at,
                    parts,
                )
                continue
            for ix in range(first_x, last_x):
                x = x0 + ix * dx
                _add_view(
                    volume[iy, ix], images[view], rows, share, g, x, y, z0, dz, line
                )


def _entry_point(lanes: int):  # type: ignore[no-untyped-def]
    """Make `backproject`, to be compiled at its first call, for a number of `lanes`,
    which is part of the disk cache's key; nothing is run.
    """

    @parallel
    def backproject(images, rows, shares, views, x0, y0, z0, dx, dy, dz, volume, workers):
        """Add views to a volume: tiles of voxel columns are taken by the threads one
        after the other.

        Args:
            images: float32 (n, cols, rows and as many more as `room` says), contiguous.
            rows: of the images.
            shares: float32 (n, depths, rows), weights of rows in a helix; else (n, 0, 0).
            views: float64 (n, 11): source x, y, z; unit normal x, y; unit u x, y;
                distance in pitches of columns; column of the foot point; distance in
                pitches of rows; row of the foot point; of a helix (n, 13): first depth of
                the shares, and how many a mm.
            x0, y0, z0: center of the first voxel [mm].
            dx, dy, dz: steps [mm].
            volume: float32 (ny, nx, nz), added to; a value counts with 1 / depth^2.
            workers: threads.
        """
        _ = lanes  # part of the disk cache's key
        ny, nx = volume.shape[:2]
        wide = WIDE if images.shape[2] == rows else TILE
        tiles_x = (nx + wide - 1) // wide
        tiles = tiles_x * ((ny + TILE - 1) // TILE)
        counter = np.zeros(1, np.int64)
        for _ in prange(workers):
            # Each thread has room of its own, and takes the next tile when it is free: a view
            # costs a tile the more, the more of it the view sees.
            line = np.zeros(rows + 2 + MARGIN, np.float32)
            at, parts = np.empty(WIDE, np.int32), np.empty((3, WIDE), np.float32)
            tile = fetch_next(counter)
            while tile < tiles:
                across, along = tile % tiles_x * wide, tile // tiles_x * TILE
                _add_tile(
                    images,
                    rows,
                    shares,
                    views,
                    across,
                    along,
                    x0,
                    y0,
                    z0,
                    dx,
                    dy,
                    dz,
                    line,
                    at,
                    parts,
                    volume,
                )
                tile = fetch_next(counter)

    return backproject


backproject = _entry_point(LANES)


@kernel
def _cover(g, weights, rows, on_panel, radius, x, y, z0, dz, seen):
    """Add a view's weight to the voxels above one another at (x, y) that its rows see; see
    `normalise_coverage`.

    Args:
        g: (11,) row of the views' table.
        weights: (cols,) of the view's rays; the column is rounded down.
        rows: of the image.
        on_panel: first and last column of the panel.
        radius: from the axis to the source [mm].
        x, y: [mm].
        z0, dz: center of the lowest voxel and step along z [mm].
        seen: (nz + 1,) differences of the weight from one voxel to the next, changed in
            place.

    Returns the weight (times depth^-1.5), and the angle [rad] of the lines through the voxels
    that the panel's columns see in this view, 0 off the panel; both 0 if the view does not see
    them.
    """
    depth, c = _column(g, weights.size, x, y)
    if depth == 0.0:
        return 0.0, 0.0
    inverse = 1.0 / depth
    start = g[10] - (z0 - g[2]) * g[9] * inverse
    lowest, highest = _layers(start, -dz * g[9] * inverse, rows, seen.size - 1)
    weight = weights[int(c)]
    # A source that moves on by an angle turns the line to a voxel by radius cos(fan) /
    # distance.
    angle = 0.0
    if on_panel[0] <= c <= on_panel[1]:
        slope = (c - g[8]) / g[7]
        angle = weight * radius * inverse / (1.0 + slope * slope)
    # Between what a wide object's filtered rows fall with (depth^2) and a small one's (depth).
    weight *= inverse * math.sqrt(inverse)
    if lowest <= highest:
        # Only where the weight begins and ends: a view costs two additions, however many
        # voxels it sees.
        seen[lowest] += weight
        seen[highest + 1] -= weight
    return weight, angle


@parallel
def normalise_coverage(
    views,
    weights,
    rows,
    on_panel,
    radius,
    x0,
    y0,
    z0,
    dx,
    dy,
    dz,
    least,
    half_turn,
    volume,
):
    """Divide each voxel by the share of the views' weight that saw it, in place.

    In the other views it is above or below the panel. Voxels whose share is less than
    `least` become NaN, as do those that are not seen along lines of all directions
    (`half_turn`); voxels seen by all views stay.

    Args:
        views: float64 (n, 11), of `backproject`.
        weights: float64 (n, cols) of rays.
        rows: of the images.
        on_panel: first and last column of the panel.
        radius: from the axis to the source [mm].
        x0, y0, z0: center of the first voxel [mm].
        dx, dy, dz: steps [mm].
        least: share of the weight.
        half_turn: pi, or nearly so [rad]; 0 where nothing is beside the panel.
        volume: float32 (ny, nx, nz).
    """
    ny, nx, nz = volume.shape
    for iy in prange(ny):
        seen = np.zeros(nz + 1, np.float64)
        for ix in range(nx):
            seen[:] = 0.0
            total = 0.0
            angles = 0.0
            for view in range(len(views)):
                weight, angle = _cover(
                    views[view],
                    weights[view],
                    rows,
                    on_panel,
                    radius,
                    x0 + ix * dx,
                    y0 + iy * dy,
                    z0,
                    dz,
                    seen,
                )
                total += weight
                angles += angle
            part = 0.0
            for iz in range(nz):
                part += seen[iz]
                if angles < half_turn or part < least * total:
                    volume[iy, ix, iz] = np.nan
                elif part < 0.999999 * total:  # not by rounding alone
                    volume[iy, ix, iz] *= total / part


def room(n: int, cols: int, rows: int, few: bool) -> Float32Array:
    """Allocate zeros for images, (n, cols, rows and more), in aligned columns of full
    registers: one register more than needed if rows fill the last.

    Args:
        n, cols, rows: size of the images.
        few: of a panel of few rows: no more rows, by which the kernel recognizes it.
    """
    shape = (n, cols, rows if few else (rows // LANES + 1) * LANES)
    return aligned_zeros(math.prod(shape)).reshape(shape)


@parallel
def weigh(images, first, factors, across, up, out):
    """Compute out[n, r, c] = images[n, first + r, c] * factors[n, c] / length of the ray
    to (r, c), for all rows of `out`.

    Args:
        images: float32 (n, rows of the panel, cols); rows beyond the panel repeat its
            outermost ones.
        first: row of the panel that is the first of `out`; may be off the panel.
        factors: float64 (n, cols).
        across, up: squares of the ray's horizontal and vertical parts, (n, cols) and (n,
            rows) [mm^2].
        out: float32 (n, rows, cols or more), filled; 0 in columns after these.
    """
    n, rows, padded = out.shape
    cols = factors.shape[1]
    for job in prange(n * rows):
        view = job // rows
        r = job % rows
        high = up[view, r]
        seen = min(max(first + r, 0), images.shape[1] - 1)
        for c in range(cols):
            weight = np.float32(factors[view, c] / math.sqrt(across[view, c] + high))
            out[view, r, c] = images[view, seen, c] * weight
        for c in range(cols, padded):
            out[view, r, c] = np.float32(0)


@parallel
def add_views(images, first, signs, sums):
    """Add images to their sum, and each with its sign to their alternating sum, in place.

    Args:
        images: float32 (n, rows of the panel, cols); rows beyond the panel repeat its
            outermost ones.
        first: row of the panel that is the first of `sums`; may be off the panel.
        signs: float32 (n,): 1, -1 or 0.
        sums: float32 (2, rows, cols): plain, alternating; added to.
    """
    _, rows, cols = sums.shape
    for r in prange(rows):
        seen = min(max(first + r, 0), images.shape[1] - 1)
        plain = sums[0, r]
        alternating = sums[1, r]
        for view in range(len(images)):
            line = images[view, seen]
            sign = signs[view]
            for c in range(cols):
                plain[c] += line[c]
                alternating[c] += sign * line[c]


@parallel
def copy_rows(images, order, first, out):
    """Copy out[n, r, c] = images[order[n], first + r, c], float32, on all cores; the rows must
    exist. `images`: (any number, rows, cols); `order`: (n,) numbers of images; `first`: first
    row that is copied; `out`: (n, rows, cols), filled."""
    n, rows, _ = out.shape
    for job in prange(n * rows):
        out[job // rows, job % rows] = images[order[job // rows], first + job % rows]


@parallel
def respond(spectra, response):
    """Multiply spectra by a filter's response, in place.

    `spectra`: float32 (n, frequencies, 2), real and imaginary; `response`: (frequencies,).
    """
    for k in prange(len(spectra)):
        for f in range(response.size):
            spectra[k, f, 0] *= response[f]
            spectra[k, f, 1] *= response[f]


BLOCK = 32


@parallel
def stand_up(rows_first, start, out):
    """Transpose images into columns, in blocks that stay in the cache: out[n, c, r] =
    rows_first[n, r, start + c].

    Args:
        rows_first: float32 (n, rows, columns before the cut).
        start: first column that is kept.
        out: float32 (n, cols, rows or more); further rows stay as they are.
    """
    n, cols = out.shape[:2]
    rows = rows_first.shape[1]
    blocks = (cols + BLOCK - 1) // BLOCK
    for job in prange(n * blocks):
        view = job // blocks
        left = job % blocks * BLOCK
        for top in range(0, rows, BLOCK):
            for c in range(left, min(left + BLOCK, cols)):
                for r in range(top, min(top + BLOCK, rows)):
                    out[view, c, r] = rows_first[view, r, start + c]


TAPS = 6
PARTS = 1024
"""Number of tabulated places between two samples."""


def lanczos() -> Float32Array:
    """Compute weights of six samples at -2 to 3 for points at 0, 1 / PARTS ... 1 between
    samples 0 and 1: Lanczos' three lobes. Returns float32 (PARTS + 1, TAPS), each row's
    sum 1.
    """
    x = np.arange(PARTS + 1)[:, None] / PARTS - np.arange(-2, 4)
    weights = np.sinc(x) * np.sinc(x / 3.0)
    return np.asarray(weights / weights.sum(axis=1, keepdims=True), dtype=np.float32)


@parallel
def warp(images, maps, weights, out):
    """Sample out[n, r, c] = images[n] at maps[n] @ (c, r, 1); points off the image take
    its edge's value.

    `weights` are those of `lanczos`, for the nearest of PARTS tabulated fractions: with
    three lobes sharp details in a tilted image stay sharper than by cubic interpolation,
    which took contrast from the finest ones.

    Args:
        images: float32 (n, rows, cols).
        maps: float64 (n, 3, 3) homographies.
        weights: float32 (PARTS + 1, TAPS).
        out: float32 (n, rows, wide), filled; as many rows as the images.
    """
    n, rows, wide = out.shape
    cols = images.shape[2]
    for job in prange(n * rows):
        view = job // rows
        r = job % rows
        h = maps[view]
        image = images[view]
        for c in range(wide):
            scale = 1.0 / (h[2, 0] * c + h[2, 1] * r + h[2, 2])
            x = (h[0, 0] * c + h[0, 1] * r + h[0, 2]) * scale
            y = (h[1, 0] * c + h[1, 1] * r + h[1, 2]) * scale
            x = min(max(x, 0.0), cols - 1.0)
            y = min(max(y, 0.0), rows - 1.0)
            i = int(x)
            j = int(y)
            across = weights[int((x - i) * PARTS + 0.5)]
            down = weights[int((y - j) * PARTS + 0.5)]
            total = np.float32(0.0)
            for b in range(TAPS):
                row = image[min(max(j + b - 2, 0), rows - 1)]
                line = np.float32(0.0)
                for a in range(TAPS):
                    line += across[a] * row[min(max(i + a - 2, 0), cols - 1)]
                total += down[b] * line
            out[view, r, c] = total
