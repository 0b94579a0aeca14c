"""CUDA kernels of FDK, and of total variation, as the processor does them.

FDK: weights, filter, and backprojection. Neighboring threads take neighboring rows of one
detector column (weights and filter), or voxels above one another, which read such rows.

Total variation, see `tv_kernels`: lengths of differences, and both half-steps, one thread a
voxel. Volumes are flat: voxel (z, y, x) is number z + stride (x + nx y), and what lies between
nz and stride is 0. Dual variables are three such arrays behind one another, of z, y and x.

Imported only where a CUDA device (or numba's simulator of one) has been found. Arguments are
not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import config, cuda

from flexdt.twin.reconstruction.kernels.fdk_kernels import EDGE_ROWS

BLOCK = (32, 4)
"""Threads a block: along z, and voxel columns along x; each is one warp."""
RUN = 8
"""Voxels of a thread, BLOCK[0] apart along z; columns of a thread of the filter."""
PLANE = (32, 8)
"""Threads a block of `weigh` and `convolve`: rows, and columns, of which eight are one sector
of memory in an image whose columns are neighbors."""
BITS = 32
"""Bits of a row's number behind the point."""
FIXED = float(2**BITS)
UNIT = np.float32(1.0 / FIXED)
STEEP = float(2**30)
"""Largest number of rows from voxel to voxel; beyond it, at most one voxel is on the
panel."""

if config.ENABLE_CUDASIM:

    def narrow(i):  # noqa: D103
        return int(i)

    def place(i):  # noqa: D103
        return int(i) % 2**32

else:
    narrow, place = np.int32, np.uint32


@cuda.jit
def weigh(images, top, factors, across, up, out):
    """Compute out[n, c, r] = images[n, top + r, c] * factors[n, c] / sqrt(across[n, c] + up[n,
    r]), one pixel a thread.

    Rows and columns are swapped; rows off the panel repeat its outermost ones. See
    `fdk_kernels.weigh`.
    `images`: float32 (n, rows of the panel, cols); `top`: row of the panel that is the first of
    `out`; `factors` and `across`: float32 (n, cols); `up`: float32 (n, rows); `out`: float32 (n,
    cols, rows), filled."""
    r = cuda.blockIdx.x * PLANE[0] + cuda.threadIdx.x
    c = cuda.blockIdx.y * PLANE[1] + cuda.threadIdx.y
    view = cuda.blockIdx.z
    if c < out.shape[1] and r < out.shape[2]:
        weight = factors[view, c] / math.sqrt(across[view, c] + up[view, r])
        out[view, c, r] = (
            images[view, min(max(top + r, 0), images.shape[1] - 1), c] * weight
        )


@cuda.jit
def convolve(weighted, taps, start, out):
    """Convolve rows with symmetric taps: out[n, c, r] = sum over j of weighted[n, j, r] *
    taps[|start + c - j|].

    A thread computes RUN neighboring columns: from one j to the next the taps move on by
    one place, so that two numbers are read for RUN products.

    Args:
        weighted: float32 (n, wide, rows), rows contiguous.
        taps: float32 (wide + RUN,) at least.
        start: column of `weighted` that is the first of `out`.
        out: float32 (n, cols, rows), filled.
    """
    r = cuda.blockIdx.x * PLANE[0] + cuda.threadIdx.x
    c = (cuda.blockIdx.y * PLANE[1] + cuda.threadIdx.y) * RUN
    view = cuda.blockIdx.z
    cols, rows = out.shape[1], out.shape[2]
    if c >= cols or r >= rows:
        return
    acc = cuda.local.array(8, np.float32)
    near = cuda.local.array(8, np.float32)
    for m in range(RUN):
        acc[m] = 0.0
        near[m] = taps[abs(start + c + m + 1)]  # those of j = -1
    for j in range(weighted.shape[1]):
        x = weighted[view, j, r]
        for m in range(RUN - 1, 0, -1):
            near[m] = near[m - 1]
        near[0] = taps[abs(start + c - j)]
        for m in range(RUN):
            acc[m] += x * near[m]
    for m in range(RUN):
        if c + m < cols:
            out[view, c + m, r] = acc[m]


LENGTH = 4096
"""Largest number of columns of a padded row: two such rows fit into a block's shared
memory."""
THREADS = 256
"""Threads in a block of `filter_rows`, which filters two rows."""
SIDES = 128
"""Number of partial sums over the two edges of two rows: 32 of each."""


@cuda.jit(device=True, inline=True)
def prism_path(lengths, view, low, share, slant, c):
    """Compute path length times attenuation of a ray through the prisms of its row's two
    bands, interpolated.

    Args:
        lengths: (n, bands, wide), over the ray's horizontal length [1/mm]; the last band
            stands for the one after it.
        view: number of the image.
        low, share: lower band of the row, and how much the next one counts.
        slant: length of the ray from source to pixel [mm].
        c: column.
    """
    high = min(low + 1, lengths.shape[1] - 1)
    lower = lengths[view, low, c]
    return (lower + share * (lengths[view, high, c] - lower)) * slant


@cuda.jit(device=True, inline=True)
def edge_sum(
    images, top, lengths, band, share, across, up, before, edge, view, r, side, part
):
    """Compute a 32nd of the sum, over an edge's columns, of a row less the prisms' path lengths:
    every 32nd column from `part` on; 0 if there is none.

    The first arguments are those of `filter_rows`.

    `view`: number of the image. `r`: row; off the panel its outermost row is read. `side`: 0
    left, 1 right. `part`: which 32nd.
    """
    row = min(max(top + r, 0), images.shape[1] - 1)
    first = images.shape[2] - edge if side else 0
    total = np.float32(0)
    for c in range(first + part, first + edge, 32):
        slant = math.sqrt(across[view, before + c] + up[view, r])
        path = prism_path(lengths, view, band[r], share[r], slant, before + c)
        total += images[view, row, c] - path
    return total


@cuda.jit(device=True, inline=True)
def weighted_pixel(
    images,
    top,
    factors,
    across,
    up,
    lengths,
    band,
    share,
    fade,
    before,
    rests,
    view,
    r,
    c,
    which,
):
    """Compute a pixel of a widened row with FDK's weight: on the panel the image's (rows
    off it repeat its outermost one), beside it the prisms' path and the fading rest; see
    `fdk_kernels.weigh`.

    The first arguments are those of `filter_rows`.

    Args:
        rests: (4,) residual of the prisms at the low (2 `which`) and the high edge (2
            `which` + 1) of the row.
        view: number of the image.
        r: row.
        c: column among the widened ones.
        which: 0 or 1, of the block's two rows.
    """
    slant = math.sqrt(across[view, c] + up[view, r])
    if c < before or c >= before + images.shape[2]:
        rest = rests[2 * which + (1 if c >= before else 0)]
        value = prism_path(lengths, view, band[r], share[r], slant, c) + rest * fade[c]
    else:
        value = images[view, min(max(top + r, 0), images.shape[1] - 1), c - before]
    return value * (factors[view, c] / slant)


@cuda.jit
def filter_rows(
    images,
    top,
    before,
    edge,
    factors,
    across,
    up,
    lengths,
    band,
    share,
    cut,
    fade,
    response,
    cosines,
    sines,
    start,
    out,
):
    """Continue rows beyond the panel's edges, weigh and filter them.

    A block of THREADS takes two rows as the real and the imaginary part of one signal,
    through a Fourier transform in its shared memory, forward to the order of reversed
    bits and back from it. The last row of an odd number is paired with itself.

    Args:
        images: float32 (n, rows of the panel, cols); row `top` is the first that is
            needed.
        top: see images; rows off the panel repeat its outermost ones.
        before: columns that go into the filter before the panel's first.
        edge: columns at an edge whose mean is continued; 0 where no column is beyond.
        factors, across, up: float32 (n, wide), (n, wide), (n, rows) of
            `fdk_kernels.weigh`.
        lengths, band, share, cut, fade: of `truncation_kernels.continue_rows`, float32
            and int32.
        response: float32 (length,) over the length, a power of 2 up to LENGTH, in the
            order of reversed bits.
        cosines, sines: float32 (length / 2,) of 2 pi k / length.
        start: first column of the filtered rows that is kept.
        out: float32 (n, cols, rows), filled.
    """
    real = cuda.shared.array(4096, np.float32)
    imaginary = cuda.shared.array(4096, np.float32)
    rests = cuda.shared.array(4, np.float32)
    thread, view = cuda.threadIdx.x, cuda.blockIdx.y
    length, wide, rows = response.size, factors.shape[1], out.shape[2]
    r = 2 * cuda.blockIdx.x
    second = min(r + 1, rows - 1)
    # Until the rows are there, `real` is room for the partial sums of their edges.
    for part in range(thread, SIDES, THREADS):
        which = part // 32
        row = second if which >= 2 else r
        real[part] = edge_sum(
            images,
            top,
            lengths,
            band,
            share,
            across,
            up,
            before,
            edge,
            view,
            row,
            which % 2,
            part % 32,
        )
    cuda.syncthreads()
    for which in range(thread, 4, THREADS):
        total = np.float32(0)
        for part in range(32):
            total += real[which * 32 + part]
        row = second if which >= 2 else r
        rests[which] = total * cut[row] / np.float32(max(edge, 1))
    cuda.syncthreads()
    for c in range(thread, length, THREADS):
        # The filter is real and even: two rows go through it as the real and the imaginary
        # part of one signal without mixing.
        a, b = np.float32(0), np.float32(0)
        if c < wide:
            a = weighted_pixel(
                images,
                top,
                factors,
                across,
                up,
                lengths,
                band,
                share,
                fade,
                before,
                rests,
                view,
                r,
                c,
                0,
            )
            b = weighted_pixel(
                images,
                top,
                factors,
                across,
                up,
                lengths,
                band,
                share,
                fade,
                before,
                rests,
                view,
                second,
                c,
                1,
            )
        real[c], imaginary[c] = a, b
    # Decimation in frequency takes the natural order to that of reversed bits, in which the
    # response is; decimation in time takes it back. So nothing is ever permuted.
    half, step = narrow(length // 2), narrow(1)
    while half > 0:
        cuda.syncthreads()
        for j in range(thread, length // 2, THREADS):
            k = j & (half - 1)
            low, high = place(2 * j - k), place(2 * j - k + half)
            cosine, sine = cosines[place(k * step)], sines[place(k * step)]
            a, b, c, d = real[low], imaginary[low], real[high], imaginary[high]
            real[low], imaginary[low] = a + c, b + d
            c, d = a - c, b - d
            real[high], imaginary[high] = c * cosine + d * sine, d * cosine - c * sine
        half, step = narrow(half // 2), narrow(step * 2)
    cuda.syncthreads()
    for c in range(thread, length, THREADS):
        real[c] *= response[c]
        imaginary[c] *= response[c]
    # With sines of the other sign: the inverse, whose 1 / length is in the response.
    half, step = narrow(1), narrow(length // 2)
    while half < length:
        cuda.syncthreads()
        for j in range(thread, length // 2, THREADS):
            k = j & (half - 1)
            low, high = place(2 * j - k), place(2 * j - k + half)
            cosine, sine = cosines[place(k * step)], sines[place(k * step)]
            a, b, c, d = real[low], imaginary[low], real[high], imaginary[high]
            c, d = c * cosine - d * sine, d * cosine + c * sine
            real[low], imaginary[low] = a + c, b + d
            real[high], imaginary[high] = a - c, b - d
        half, step = narrow(half * 2), narrow(step // 2)
    cuda.syncthreads()
    for c in range(thread, out.shape[1], THREADS):
        out[view, c, r] = real[start + c]
        if r + 1 < rows:
            out[view, c, r + 1] = imaginary[start + c]


@cuda.jit
def backproject(images, cols, rows, views, first, size, volume):
    """Add views to a volume, interpolated linearly between columns and rows.

    The line of rows that a voxel column meets is the same for all its voxels. The threads
    of a warp, which have one voxel column in common, find it in double precision for as
    many views at a time, one each; then every thread goes through these views for RUN
    voxels with rows in fixed point. Voxels behind the source or off the panel get nothing
    of a view.

    Args:
        images: float32 (n * cols * rows,), rows of a column beside each other; fewer than
            2^32.
        cols, rows: of an image.
        views: float64 (n, 11), as `fdk_views.view_table` makes them.
        first, size: center of the first voxel and steps, (3,) x, y, z [mm].
        volume: float32 (ny, nx, nz), added to; a value counts with 1 / depth^2.
    """
    lane, warp = cuda.threadIdx.x, cuda.threadIdx.y
    ix = cuda.blockIdx.y * BLOCK[1] + warp
    iy = cuda.blockIdx.z
    _, nx, nz = volume.shape
    n, rows = len(views), narrow(rows)
    columns = cuda.shared.array((4, 32), np.int32)
    parts = cuda.shared.array((4, 32), np.float32)
    weights = cuda.shared.array((4, 32), np.float32)
    lowest = cuda.shared.array((4, 32), np.int32)
    highest = cuda.shared.array((4, 32), np.int32)
    starts = cuda.shared.array((4, 32), np.int64)
    steps = cuda.shared.array((4, 32), np.int64)
    begin = cuda.blockIdx.x * (BLOCK[0] * RUN) + lane
    acc = cuda.local.array(8, np.float32)
    for m in range(RUN):
        acc[m] = 0.0
    for base in range(0, n, BLOCK[0]):
        view = base + lane
        cuda.syncthreads()
        # No voxel, unless the view is found to see the column.
        highest[warp, lane] = -1
        lowest[warp, lane] = 0
        if view < n and ix < nx:
            x = first[0] + ix * size[0] - views[view, 0]
            y = first[1] + iy * size[1] - views[view, 1]
            depth = x * views[view, 3] + y * views[view, 4]
            if depth > 0.0:
                inverse = 1.0 / depth
                c = views[view, 8] + (x * views[view, 5] + y * views[view, 6]) * (
                    inverse * views[view, 7]
                )
                if 0.0 <= c <= cols - 1:
                    i = max(min(int(c), cols - 2), 0)
                    step = -size[2] * views[view, 9] * inverse
                    start = (
                        views[view, 10]
                        - (first[2] - views[view, 2]) * views[view, 9] * inverse
                    )
                    # Rows fall with z. What is seen at the edges is as in the processor's
                    # kernels.
                    every = 1.0 / step
                    end = rows - 1 + EDGE_ROWS
                    low = max(0, int(math.ceil((end - start) * every)))  # noqa: RUF046
                    high = min(nz - 1, int(math.floor((-EDGE_ROWS - start) * every)))  # noqa: RUF046
                    lowest[warp, lane] = low
                    highest[warp, lane] = high
                    columns[warp, lane] = i
                    parts[warp, lane] = c - i
                    weights[warp, lane] = inverse * inverse
                    # Counted from the lowest voxel that is seen: its row is on the panel, so
                    # that fixed point holds it, and adding steps rounds nothing.
                    starts[warp, lane] = int((start + low * step) * FIXED)
                    steps[warp, lane] = int(max(step, -STEEP) * FIXED)
        cuda.syncthreads()
        for v in range(min(BLOCK[0], n - base)):
            low = lowest[warp, v]
            high = highest[warp, v]
            if begin > high or begin + (RUN - 1) * BLOCK[0] < low:
                continue
            left = place((base + v) * cols + columns[warp, v]) * place(rows)
            right = left + place(rows)
            across = parts[warp, v]
            weight = weights[warp, v]
            at = starts[warp, v] + (begin - low) * steps[warp, v]
            rate = BLOCK[0] * steps[warp, v]
            for m in range(RUN):
                k = begin + m * BLOCK[0]
                if low <= k <= high:
                    # `EDGE_ROWS` and rounding may put a place just before the first row.
                    held = max(at, 0)
                    j = min(narrow(held >> BITS), rows - 1)
                    after = place(min(j + 1, rows - 1))
                    # As 32 bits without a sign it is what stands behind the point.
                    down = np.float32(place(held)) * UNIT
                    up = images[left + place(j)]
                    up += across * (images[right + place(j)] - up)
                    under = images[left + after]
                    under += across * (images[right + after] - under)
                    acc[m] += weight * (up + down * (under - up))
                at += rate
    if ix < nx:
        for m in range(RUN):
            k = begin + m * BLOCK[0]
            if k < nz:
                volume[iy, ix, k] += acc[m]


ZERO, ONE = np.float32(0), np.float32(1)


@cuda.jit(device=True, inline=True)
def differences(x, i, k, column, counts, stride, scale):
    """Compute the scaled differences of a voxel to the next along z, y and x, a tuple of three;
    0 for the last of an axis.

    `x`: flat voxels; `i`: index of the voxel; `k`: its z; `column`: number of its voxel column;
    `counts`: voxels along z, y, x; `stride`: places from one voxel column to the next; `scale`:
    (3,) factors."""
    # The next along z is the next in memory, along x a column further, along y nx columns.
    nz, ny, nx = counts
    here = x[i]
    dz = scale[0] * (x[i + 1] - here) if k + 1 < nz else ZERO
    dy = scale[1] * (x[i + nx * stride] - here) if column // nx + 1 < ny else ZERO
    dx = scale[2] * (x[i + stride] - here) if column % nx + 1 < nx else ZERO
    return dz, dy, dx


@cuda.jit
def lengths(x, counts, stride, scale, out):
    """Fill `out` with the length of each voxel's differences, whose sum is the total
    variation; 0 for places between voxel columns (beyond nz); one voxel a thread.

    Args:
        x, counts, stride, scale: as those of `differences`.
        out: flat, as many as `x`, filled.
    """
    i = cuda.grid(1)
    if i < x.size:
        k, column = i % stride, i // stride
        out[i] = ZERO
        if k < counts[0]:
            dz, dy, dx = differences(x, i, k, column, counts, stride, scale)
            out[i] = math.sqrt(dz * dz + dy * dy + dx * dx)


@cuda.jit
def primal_step(z, dual, theta, counts, stride, scale, lowest, allowed, x):
    """Compute x = max(z - theta D' dual, lowest), D' the transposed differences, one
    voxel a thread; 0 where not allowed and at places between voxel columns.

    Args:
        z: flat voxels.
        dual: three arrays of that size, one after the other: along z, y, x.
        theta: length of the step.
        counts: voxels along z, y, x.
        stride: places from one voxel column to the next.
        scale: (3,) factors on the differences.
        lowest: values are not less.
        allowed: 0 where x must be 0.
        x: flat voxels, filled.
    """
    i = cuda.grid(1)
    if i >= z.size:
        return
    k, column, size = i % stride, i // stride, z.size
    x[i] = ZERO
    if k < counts[0] and allowed[i] > ZERO:
        # What this voxel gives less what the voxels before it gave along each axis: see
        # `tv_kernels.primal_step`. counts[2] columns are a row along x.
        spread = (
            scale[0] * dual[i] + scale[1] * dual[size + i] + scale[2] * dual[2 * size + i]
        )
        if k > 0:
            spread -= scale[0] * dual[i - 1]
        if column >= counts[2]:
            spread -= scale[1] * dual[size + i - counts[2] * stride]
        if column % counts[2] > 0:
            spread -= scale[2] * dual[2 * size + i - stride]
        x[i] = max(z[i] + theta * spread, lowest)


@cuda.jit
def dual_step(x, ahead, dual, rate, momentum, counts, stride, scale):
    """Compute dual = ahead + rate D x, shortened to length 1 a voxel, and extrapolate: ahead =
    dual + momentum times the change of dual; one voxel a thread.

    Places between voxel columns stay. D x are the `differences`.

    `x`: flat voxels. `ahead`: three arrays of that size, one after the other; changed in place.
    `dual`: likewise; changed in place. `rate`: length of the step. `momentum`: of the
    extrapolation. `counts`: voxels along z, y, x. `stride`: places from one voxel column to the
    next. `scale`: (3,) factors on the differences.
    """
    i = cuda.grid(1)
    if i >= x.size or i % stride >= counts[0]:
        return
    # i, j and k are this voxel's places in the three arrays of a dual variable.
    j, k = i + x.size, i + 2 * x.size
    dz, dy, dx = differences(x, i, i % stride, i // stride, counts, stride, scale)
    a, b, c = ahead[i] + rate * dz, ahead[j] + rate * dy, ahead[k] + rate * dx
    shorter = ONE / max(ONE, math.sqrt(a * a + b * b + c * c))
    a, b, c = a * shorter, b * shorter, c * shorter
    ahead[i] = a + momentum * (a - dual[i])
    ahead[j] = b + momentum * (b - dual[j])
    ahead[k] = c + momentum * (c - dual[k])
    dual[i], dual[j], dual[k] = a, b, c
