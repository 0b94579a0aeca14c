"""CUDA kernels of `tv_kernels`, one thread a voxel: lengths of differences, and both half-steps.

Volumes are flat: voxel (z, y, x) is number z + stride (x + nx y), and what lies between nz and
stride is 0. Dual variables are three such arrays behind one another, of z, y and x. Imported only
where a CUDA device (or numba's simulator of one) has been found. Arguments are not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import cuda

ZERO, ONE = np.float32(0), np.float32(1)


@cuda.jit(device=True, inline=True)
def differences(x, i, k, column, counts, stride, scale):
    """Scaled differences of a voxel to the next along z, y and x; 0 behind the last."""
    # The next along z is the next in memory, along x a column further, along y nx columns.
    nz, ny, nx = counts
    here = x[i]
    dz = scale[0] * (x[i + 1] - here) if k + 1 < nz else ZERO
    dy = scale[1] * (x[i + nx * stride] - here) if column // nx + 1 < ny else ZERO
    dx = scale[2] * (x[i + stride] - here) if column % nx + 1 < nx else ZERO
    return dz, dy, dx


@cuda.jit
def lengths(x, counts, stride, scale, out):
    """out = the length of each voxel's differences, of which the sum is the total variation."""
    i = cuda.grid(1)
    if i < x.size:
        k, column = i % stride, i // stride
        out[i] = ZERO
        if k < counts[0]:
            dz, dy, dx = differences(x, i, k, column, counts, stride, scale)
            out[i] = math.sqrt(dz * dz + dy * dy + dx * dx)


@cuda.jit
def primal_step(z, dual, theta, counts, stride, scale, lowest, allowed, x):
    """x = the allowed values next to z - theta D' dual, with the differences' transpose D'."""
    i = cuda.grid(1)
    if i >= z.size:
        return
    k, column, size = i % stride, i // stride, z.size
    x[i] = ZERO
    if k < counts[0] and allowed[i] > ZERO:
        # What this voxel gives less what the voxels before it gave along each axis: see
        # `tv_kernels.primal_step`. counts[2] columns are a row along x.
        spread = scale[0] * dual[i] + scale[1] * dual[size + i] + scale[2] * dual[2 * size + i]
        if k > 0:
            spread -= scale[0] * dual[i - 1]
        if column >= counts[2]:
            spread -= scale[1] * dual[size + i - counts[2] * stride]
        if column % counts[2] > 0:
            spread -= scale[2] * dual[2 * size + i - stride]
        x[i] = max(z[i] + theta * spread, lowest)


@cuda.jit
def dual_step(x, ahead, dual, rate, momentum, counts, stride, scale):
    """dual = ahead + rate D x, shortened to length 1 voxel by voxel; then ahead = dual + momentum
    times what dual has changed.
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
