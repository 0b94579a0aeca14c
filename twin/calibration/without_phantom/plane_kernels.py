"""Integrals of an object over planes through two sources, each from the two views alike.

Let b be the line through the sources of two views. In a plane through b the rays of either
source cover the plane, and the integral of the views' line integrals g over sin(t) dt, where t
is the angle between ray and b, is that of the object divided by the distance from b: the same
for both, as long as b stays clear of the object. So is the integral over a bin of neighboring
planes, which nothing needs to be smoothed for. A plane is known by its height over the source
at the axis.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import prange

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.kernels.compiling import parallel


@parallel(fastmath=True)
def sum_planes(
    sums: Float32Array,
    views: FloatArray,
    pairs: npt.NDArray[np.intp],
    inwards: FloatArray,
    edges: FloatArray,
    columns: npt.NDArray[np.intp],
    integrals: FloatArray,
    ones: FloatArray,
) -> None:
    """Integrate both views of each pair over bins of planes.

    The rows that a bin covers follow from its two planes column by column; sums of g down
    each column then give its share without a walk along them, and pixels are cut where
    planes cut them. Planes off the panel are limited to its edges; columns behind the
    source add nothing.

    Args:
        sums: (n, cols, rows + 1), sums of g from the first row down.
        views: (n, 12) source, panel's center, u, v; the axis is z through the origin
            [mm].
        pairs: (q, 2) indices of views.
        inwards: (q, 2) horizontal unit vector from the line through the sources to the
            axis.
        edges: (q, k + 1) dz over distance along `inwards` of the planes between the bins.
        columns: (n, 2) first column of a view that the object can reach, and the one
            after them.
        integrals: (q, 2, k) integrals of g, written.
        ones: the same of 1 instead of g, written.
    """
    cols, rows, planes = sums.shape[1], sums.shape[2] - 1, edges.shape[1]
    for q in prange(len(pairs)):
        mx, my = inwards[q]
        cut, above = np.empty(planes), np.empty(planes)
        for side in range(2):
            f = pairs[q, side]
            v = views[f]
            dx, dy, dz = v[3] - v[0], v[4] - v[1], v[5] - v[2]
            m0, mu, mv = dx * mx + dy * my, v[6] * mx + v[7] * my, v[9] * mx + v[10] * my
            # Distance of the panel times the area of a pixel.
            volume = abs(
                dx * (v[7] * v[11] - v[8] * v[10])
                + dy * (v[8] * v[9] - v[6] * v[11])
                + dz * (v[6] * v[10] - v[7] * v[9])
            )
            integrals[q, side] = 0.0
            ones[q, side] = 0.0
            for c in range(columns[f, 0], columns[f, 1]):
                i = c - (cols - 1) / 2.0
                m, z = m0 + i * mu, dz + i * v[8]
                if m <= 0.0:
                    continue
                # Three loops, of which the compiler does the first and the last four at a time.
                for k in range(planes):
                    # Row at which the plane cuts this column, from the upper end of the panel.
                    at = (z - edges[q, k] * m) / (edges[q, k] * mv - v[11]) + rows / 2.0
                    cut[k] = min(max(at, 0.0), float(rows))
                for k in range(planes):
                    whole = min(int(cut[k]), rows - 1)
                    low = sums[f, c, whole]
                    above[k] = low + (cut[k] - whole) * (sums[f, c, whole + 1] - low)
                x, y = dx + i * v[6], dy + i * v[7]
                for k in range(planes - 1):
                    j = (cut[k] + cut[k + 1]) / 2.0 - rows / 2.0
                    px, py, pz = x + j * v[9], y + j * v[10], z + j * v[11]
                    inward = m + j * mv
                    weight = volume / (
                        math.sqrt(px * px + py * py + pz * pz) * inward * inward
                    )
                    height = cut[k + 1] - cut[k]
                    within = math.copysign(1.0, height) * (above[k + 1] - above[k])
                    integrals[q, side, k] += weight * within
                    ones[q, side, k] += weight * abs(height)
