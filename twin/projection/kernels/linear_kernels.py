"""Projection of a smooth volume: values between voxel centers are interpolated, and each pixel is
an area.

A ray is followed plane by plane, through the centers of the voxels along the axis x or y that it
is nearest to. On a plane the volume is interpolated linearly both ways (Joseph 1982), and averaged
over the rectangle that the pixel covers there: voxels finer than the pixel all count, and none
more than the others. Both averages are differences of integrals of the interpolation. Along z the
integral is a running sum, at the edges between rows, which neighbors share.

The transpose repeats the same numbers the other way round. A thread owns a plane, so that sums do
not depend on the number of threads. Coordinates are in voxel units of the box; a voxel's center is
at its index + 0.5.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import inline, kernel, parallel

SEGMENTS_A_PIXEL = 8.0
"""Rows of a column share their place across it as long as it changes by less than this part of
the pixel."""
SMALLEST = 1e-6
"""Smallest width of a pixel on a plane [voxels]."""


@inline
def area_below(x):
    """Compute the integral of the hat function, 1 - |x| within 1 of 0, from -infinity to x."""
    if x <= -1.0:
        return 0.0
    if x >= 1.0:
        return 1.0
    if x < 0.0:
        return 0.5 * (x + 1.0) * (x + 1.0)
    return 1.0 - 0.5 * (1.0 - x) * (1.0 - x)


@kernel
def prepare_column(box, g, c, rows, along, across, factor):
    """Compute what one column's rays need on every plane; returns the axis of the planes, 0 for
    x, 1 for y, or -1 where its rays do not go one way along it.

    Args:
        box: voxels.
        g: (12,) source, first pixel minus source, u, v [voxels].
        c: the column.
        rows: of the detector.
        along: (rows + 1,) filled: change of z by a plane, at the edges between rows.
        across: (rows + 1,) filled: the same of the other axis.
        factor: (rows,) filled: mm of the ray by a plane, over the change of `along` in the row.
    """
    r = 0.5 * (rows - 1)
    dx = g[3] + c * g[6] + r * g[9]
    dy = g[4] + c * g[7] + r * g[10]
    m = 0 if abs(dx) > abs(dy) else 1
    a = 1 - m
    sign = 0.0
    for e in range(rows + 1):
        r = e - 0.5
        dm = g[3 + m] + c * g[6 + m] + r * g[9 + m]
        if dm == 0.0 or sign * dm < 0.0:
            return -1
        sign = dm
        along[e] = (g[5] + c * g[8] + r * g[11]) / dm
        across[e] = (g[3 + a] + c * g[6 + a] + r * g[9 + a]) / dm
    for r in range(rows):
        x = g[3] + c * g[6] + r * g[9]
        y = g[4] + c * g[7] + r * g[10]
        z = g[5] + c * g[8] + r * g[11]
        dm = x if m == 0 else y
        x, y, z = x * box.size_x, y * box.size_y, z * box.size_z
        step = along[r + 1] - along[r]
        if abs(step) < SMALLEST * SMALLEST:
            return -1
        factor[r] = math.sqrt(x * x + y * y + z * z) / abs(dm) / step
    return m


@parallel
def prepare(box, g, main, along, across, factor):
    """Fill `main` (cols,), `along` and `across` (cols, rows + 1) and `factor` (cols,
    rows) for a view, see `prepare_column`.
    """
    cols, rows = factor.shape
    for c in prange(cols):
        main[c] = prepare_column(box, g, c, rows, along[c], across[c], factor[c])


@inline
def width_across(g, c, m, rows, across, there):
    """Compute the width of a column's pixels on a plane, across it [voxels].

    `g`: (12,) of the view; `c`: column; `m`: axis of the planes; `rows`: of the detector;
    `across`: (rows + 1,) of the column; `there`: distance of the plane from the source along its
    axis.
    """
    a = 1 - m
    r = 0.5 * (rows - 1)
    dm = g[3 + m] + c * g[6 + m] + r * g[9 + m]
    slope = (g[3 + a] + c * g[6 + a] + r * g[9 + a]) / dm
    u = there / dm * (g[6 + a] - slope * g[6 + m])
    v = there * (across[rows] - across[0]) / rows
    return max(math.sqrt(u * u + v * v), SMALLEST)


@kernel
def walk_plane(box, g, c, m, plane, along, across, values, line, sums, transposed):
    """Add a plane's part of a column's integrals to `values`; transposed, add the column's
    values to the plane's voxels.

    Args:
        box: voxels; transposed, changed in place, and its spans are not used.
        g: (12,) source, first pixel minus source, u, v [voxels].
        c: column.
        m: axis of the planes, 0 for x, 1 for y.
        plane: number of the plane.
        along, across: of the column, see `prepare_column`.
        values: (rows,) integrals in units of `factor`, changed in place unless transposed.
        line: (nz + 3,) room.
        sums: (nz + 3,) room.
        transposed: see above.
    """
    rows = values.size
    there = plane + 0.5 - g[m]
    dm = g[3 + m] + c * g[6 + m] + 0.5 * (rows - 1) * g[9 + m]
    if there * dm <= 0.0:  # behind the source
        return
    if m == 0:
        na, hop_m, hop_a = box.ny, box.hop_x, box.hop_y
        span_m, span_a = 2, 2 * box.nx
    else:
        na, hop_m, hop_a = box.nx, box.hop_y, box.hop_x
        span_m, span_a = 2 * box.nx, 2
    source = g[1 - m]
    first = source + there * across[0]
    last = source + there * across[rows]
    width = width_across(g, c, m, rows, across, there)
    half = 0.5 * width
    if max(first, last) + half <= -0.5 or min(first, last) - half >= na + 0.5:
        return
    count = 1 + np.int64(abs(last - first) / width * SEGMENTS_A_PIXEL)
    count = min(count, rows)
    inverse = 1.0 / there
    nz = box.nz
    for part in range(count):
        r0 = part * rows // count
        r1 = (part + 1) * rows // count
        middle = source + there * 0.5 * (across[r0] + across[r1])
        i0 = max(math.floor(middle - half - 0.5), 0)
        i1 = min(math.ceil(middle + half + 0.5), na)
        z0 = g[2] + there * along[r0]
        z1 = g[2] + there * along[r1]
        low, high = min(z0, z1), max(z0, z1)
        k0 = max(math.floor(low - 0.5), 0)
        k1 = min(math.floor(high - 0.5) + 2, nz)
        if i1 <= i0 or k1 <= k0:
            continue
        if not transposed:
            # Levels at which there is anything.
            s0, s1 = k1, k0
            for i in range(i0, i1):
                at = plane * span_m + i * span_a
                s0 = min(s0, max(k0, box.spans[at]))
                s1 = max(s1, min(k1, box.spans[at + 1]))
            k0, k1 = s0, s1
            if k1 <= k0:
                continue
        # Voxel k is at line[k - k0 + 1]; beside it are zeros, one before and two behind.
        n = k1 - k0
        for k in range(n + 3):
            line[k] = 0.0
            sums[k] = 0.0
        shift = g[2] - 0.5 - k0 + 1.0
        if not transposed:
            for i in range(i0, i1):
                weight = (
                    area_below(middle + half - i - 0.5)
                    - area_below(middle - half - i - 0.5)
                ) / width
                at = box.base + plane * hop_m + i * hop_a + k0
                row = box.flat[at : at + n]
                for k in range(n):
                    line[k + 1] += weight * row[k]
            for k in range(n + 2):
                sums[k + 1] = sums[k] + line[k]
            before = 0.0
            for e in range(r0, r1 + 1):
                # The integral up to z: whole voxels below, and parts of two hats.
                z = shift + there * along[e]
                if z <= 0.0:
                    total = 0.0
                elif z >= n + 1.0:
                    total = sums[n + 2]
                else:
                    k = np.int64(z)
                    f = z - k
                    rest = 1.0 - f
                    total = (
                        sums[k]
                        + line[k] * (1.0 - 0.5 * rest * rest)
                        + line[k + 1] * 0.5 * f * f
                    )
                if e > r0:
                    values[e - 1] += (total - before) * inverse
                before = total
        else:
            before = 0.0
            for e in range(r0, r1 + 1):
                value = 0.0
                if e < r1:
                    value = values[e]
                part_of = (before - value) * inverse
                before = value
                z = shift + there * along[e]
                if z <= 0.0:
                    continue
                if z >= n + 1.0:
                    sums[n + 2] += part_of
                    continue
                k = np.int64(z)
                f = z - k
                rest = 1.0 - f
                sums[k] += part_of
                line[k] += part_of * (1.0 - 0.5 * rest * rest)
                line[k + 1] += part_of * 0.5 * f * f
            for k in range(n + 1, -1, -1):
                line[k] += sums[k + 1]
                sums[k] += sums[k + 1]
            for i in range(i0, i1):
                weight = (
                    area_below(middle + half - i - 0.5)
                    - area_below(middle - half - i - 0.5)
                ) / width
                at = box.base + plane * hop_m + i * hop_a + k0
                row = box.flat[at : at + n]
                for k in range(n):
                    row[k] += np.float32(weight * line[k + 1])


@parallel
def project_linear(box, g, main, along, across, factor, image):
    """Fill an image (rows, cols) with line integrals of the interpolated volume.

    Args:
        box: voxels with their spans.
        g: (12,) source, first pixel minus source, u, v [voxels].
        main, along, across, factor: of `prepare`.
        image: filled; 0 in columns without an axis.
    """
    cols, rows = factor.shape
    for c in prange(cols):
        values = np.zeros(rows)
        line = np.empty(box.nz + 3)
        sums = np.empty(box.nz + 3)
        m = main[c]
        if m >= 0:
            for plane in range(box.nx if m == 0 else box.ny):
                walk_plane(
                    box, g, c, m, plane, along[c], across[c], values, line, sums, False
                )
        for r in range(rows):
            image[r, c] = np.float32(values[r] * factor[c, r])


@parallel
def spread_linear(box, g, main, along, across, factor, image, m):
    """Apply the transpose of `project_linear` to the columns whose planes lie across axis m: add
    to box.flat.

    Arguments as of `project_linear`; image: (rows, cols).
    """
    cols, rows = factor.shape
    planes = box.ny
    if m == 0:
        planes = box.nx
    for plane in prange(planes):
        values = np.empty(rows)
        line = np.empty(box.nz + 3)
        sums = np.empty(box.nz + 3)
        for c in range(cols):
            if main[c] == m:
                for r in range(rows):
                    values[r] = image[r, c] * factor[c, r]
                walk_plane(
                    box, g, c, m, plane, along[c], across[c], values, line, sums, True
                )
