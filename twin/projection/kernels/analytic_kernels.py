"""Exact chords through convex solids, one detector row at a time, in double precision.

A row's rays are cut by one surface after the other (loops a compiler can vectorise), only over the
columns that a solid's shadow can reach. Quadrics and slabs come from `convex`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import kernel, parallel

TINY = 1e-300
BAND = 16
"""Detector rows a job."""


@kernel
def cut_by_slab(t0, t1, at, low, high, rate, step, first):
    """Narrow [t0, t1] to low <= at + t (rate + column * step) <= high."""
    # A ray along the slab gets TINY: both quotients are huge, of one sign where it runs outside (no
    # chord is left) and of two where it runs inside (nothing is cut). No branch, so it vectorises.
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
    """Narrow [t0, t1] to |q + t (d + column * e)| <= 1, all three already mapped by M."""
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
    """row += weight * chord length; d + column * e is the ray from source to pixel [mm]."""
    for i in range(row.size):
        c = first + i
        dx = d[0] + c * e[0]
        dy = d[1] + c * e[1]
        dz = d[2] + c * e[2]
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        row[i] += np.float32(weight * length * max(t1[i] - t0[i], 0.0))


@kernel
def mapped(m, p, out):
    """out = M p for M as nine numbers."""
    for i in range(3):
        out[i] = m[3 * i] * p[0] + m[3 * i + 1] * p[1] + m[3 * i + 2] * p[2]


@parallel
def project_convex(quadric, slabs, slab_range, shadow, rays, weight, channel, out):
    """Fill out (channels, n, rows, cols) with weighted chord lengths.

    rays (n, 12) [mm]: source, first pixel centre minus source, u, v; shadow (n, k, 4) from
    `convex.shadows`; weight, channel (k,) of each solid.
    """
    channels, n, rows, cols = out.shape
    bands = (rows + BAND - 1) // BAND
    for job in prange(n * bands):
        view = job // bands
        row0 = (job - view * bands) * BAND
        row1 = min(rows, row0 + BAND)
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
