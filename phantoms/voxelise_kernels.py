"""Compiled loops of the voxeliser; `voxelise` is the only caller and checks all arguments.

Columns run along z. Coverage along z is exact: a voxel that a horizontal face cuts is
filled by the fraction of its height that is inside.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.projection.kernels.compiling import linked, serial

# mypy: disable-error-code="no-untyped-def,untyped-decorator,no-untyped-call,misc"


@linked
def _add_interval(data, iy, ix, low, high, value):
    """Add `value` times the covered fraction to the voxels of one column; heights in voxels.

    Ends outside the grid are cut to it.

    Args:
        data: (z, y, x), changed.
        iy: row of the column.
        ix: column of the grid.
        low: lower end [voxels].
        high: upper end [voxels].
        value: that is added to a covered voxel.
    """
    nz = data.shape[0]
    low = max(low, 0.0)
    high = min(high, float(nz))
    if high <= low:
        return
    first, last = int(low), min(int(high), nz - 1)
    if first == last:
        data[first, iy, ix] += value * (high - low)
        return
    data[first, iy, ix] += value * (first + 1 - low)
    for k in range(first + 1, last):
        data[k, iy, ix] += value
    data[last, iy, ix] += value * (high - last)


@serial
def add_convex(data, low, high, x0, y0, oversample, value):
    """Add one convex solid, given by its interval in each sub-column, to `data`.

    Args:
        data: (z, y, x), changed.
        low: lower ends (rows, cols) of sub-columns [voxels].
        high: upper ends; low > high where the column misses.
        x0: index of the first voxel along x.
        y0: index of the first voxel along y.
        oversample: sub-columns a voxel along x and along y.
        value: attenuation of one sub-column's share.
    """
    for j in range(low.shape[0]):
        for i in range(low.shape[1]):
            if high[j, i] > low[j, i]:
                _add_interval(
                    data,
                    y0 + j // oversample,
                    x0 + i // oversample,
                    low[j, i],
                    high[j, i],
                    value,
                )


@linked
def _side(ax, ay, bx, by, px, py):
    """Compute the signed crossing of the ray from (px, py) towards +x with the edge a -> b.

    The end points are put in a fixed order first, so both triangles on an edge get the same
    answer to the last bit and no column slips through or counts twice.
    `ax`: x of the edge's first end; likewise the other places. `ay`: y of the edge's first end.
    `bx`: x of its last end. `by`: y of its last end. `px`: x of the ray's origin. `py`: y of the
    ray's origin.
    Returns +1 for an edge that rises, -1 for one that falls, 0 without a crossing.
    """
    if (ay > py) == (by > py):
        return 0
    if ay < by or (ay == by and ax < bx):
        lx, ly, hx, hy = ax, ay, bx, by
    else:
        lx, ly, hx, hy = bx, by, ax, ay
    if px < lx + (py - ly) * (hx - lx) / (hy - ly):
        return 1 if by > ay else -1
    return 0


@linked
def _winding(t, px, py):
    """Compute the winding number of the projected triangle t (3, 3) about (px, py):
    -1, 0 or +1."""
    return (
        _side(t[0, 0], t[0, 1], t[1, 0], t[1, 1], px, py)
        + _side(t[1, 0], t[1, 1], t[2, 0], t[2, 1], px, py)
        + _side(t[2, 0], t[2, 1], t[0, 0], t[0, 1], px, py)
    )


@linked
def _height(t, px, py):
    """Compute the height of the plane of a triangle above (px, py), cut to the triangle's
    heights.

    Args:
        t: (3, 3) corners; not vertical.
        px: x of the place.
        py: y of the place.
    """
    ux, uy, uz = t[1, 0] - t[0, 0], t[1, 1] - t[0, 1], t[1, 2] - t[0, 2]
    vx, vy, vz = t[2, 0] - t[0, 0], t[2, 1] - t[0, 1], t[2, 2] - t[0, 2]
    area = ux * vy - uy * vx
    dx, dy = px - t[0, 0], py - t[0, 1]
    z = t[0, 2] + ((dx * vy - dy * vx) * uz + (ux * dy - uy * dx) * vz) / area
    low = min(t[0, 2], t[1, 2], t[2, 2])
    high = max(t[0, 2], t[1, 2], t[2, 2])
    return min(max(z, low), high)


@linked
def _span(low, high, n):
    """Compute the sub-column indices whose centers i + 0.5 can be in [low, high]."""
    return max(int(np.floor(low - 0.5)), 0), min(int(np.ceil(high - 0.5)) + 1, n)


@serial
def cross(triangles, starts, counts, heights, signs):
    """Count the surface crossings of every sub-column; write their heights and signs,
    too, unless `heights` is empty.

    A sub-column is hit at its middle; vertical triangles give none.

    Args:
        triangles: (n, 3, 3), x and y in sub-columns, z in voxels.
        starts: (rows, cols), where in heights and signs those of a sub-column begin.
        counts: int32 (rows, cols), to be zero; changed.
        heights: of all crossings, changed; empty to count only.
        signs: +1 or -1 of all crossings, changed.
    """
    listing = heights.size > 0
    for f in range(triangles.shape[0]):
        t = triangles[f]
        i0, i1 = _span(
            min(t[0, 0], t[1, 0], t[2, 0]),
            max(t[0, 0], t[1, 0], t[2, 0]),
            counts.shape[1],
        )
        j0, j1 = _span(
            min(t[0, 1], t[1, 1], t[2, 1]),
            max(t[0, 1], t[1, 1], t[2, 1]),
            counts.shape[0],
        )
        for j in range(j0, j1):
            for i in range(i0, i1):
                w = _winding(t, i + 0.5, j + 0.5)
                if w != 0:
                    if listing:
                        at = starts[j, i] + counts[j, i]
                        heights[at] = _height(t, i + 0.5, j + 0.5)
                        signs[at] = w
                    counts[j, i] += 1


@serial
def add_surface(data, starts, counts, heights, signs, oversample, value):
    """Fill between crossings of `data` wherever the winding number is not zero.

    A column that does not close is filled between its crossings only.

    Overlapping bodies fill once, inward shells are cavities.

    Args:
        data: (z, y, x), changed.
        starts: (rows, cols), where in heights and signs those of a sub-column begin.
        counts: (rows, cols) crossings of each sub-column.
        heights: of all crossings [voxels].
        signs: +1 or -1 of all crossings.
        oversample: sub-columns a voxel along x and along y.
        value: attenuation of one sub-column's share.

    Returns:
        The number of columns whose crossings do not close.
    """
    leaks = 0
    for j in range(counts.shape[0]):
        for i in range(counts.shape[1]):
            a, n = starts[j, i], counts[j, i]
            if n == 0:
                continue
            order = np.argsort(heights[a : a + n])
            winding = 0
            for k in range(n):
                here = a + order[k]
                if winding != 0:
                    _add_interval(
                        data,
                        j // oversample,
                        i // oversample,
                        heights[a + order[k - 1]],
                        heights[here],
                        value,
                    )
                winding += signs[here]
            if winding != 0:
                leaks += 1
    return leaks
