"""Total variation of a volume, and the two half-steps of its proximal map, as kernels.

The variation is the sum over all voxels of the length of the vector of differences to the next
voxel along z, y and x, each multiplied by `scale` (1 where voxels are cubes); behind the last
voxel the difference is 0. Arrays are C-ordered [z, y, x], dual ones [axis, z, y, x]. Each job
writes one layer, first <= z < last, and reads its neighbors from an array that no job writes.
Arguments are not checked.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels import compiling
from flexdt.twin.projection.kernels.compiling import inline, parallel, sources

SOURCES = sources(compiling)


@inline
def differences(x, k, j, i, scale):
    """Compute the scaled differences of voxel (k, j, i) to the next along z, y and x, a tuple
    of three; 0 at the end of an axis.
    """
    nz, ny, nx = x.shape
    here = x[k, j, i]
    dz = scale[0] * (x[k + 1, j, i] - here) if k + 1 < nz else np.float32(0)
    dy = scale[1] * (x[k, j + 1, i] - here) if j + 1 < ny else np.float32(0)
    dx = scale[2] * (x[k, j, i + 1] - here) if i + 1 < nx else np.float32(0)
    return dz, dy, dx


@parallel
def variation(x, scale, layers, first, last):
    """Compute the total variation of layers first <= k < last, each in double precision, which
    the caller adds up.

    `x`: (nz, ny, nx). `scale`: (3,) factors on the differences. `layers`: (nz,) float64;
    elements first to last - 1 are filled. `first`: first layer. `last`: layer after the last.
    """
    ny, nx = x.shape[1:]
    for k in prange(first, last):
        total = 0.0  # in double precision: millions of small lengths
        for j in range(ny):
            for i in range(nx):
                dz, dy, dx = differences(x, k, j, i, scale)
                total += math.sqrt(dz * dz + dy * dy + dx * dx)
        layers[k] = total


@parallel
def primal_step(z, dual, theta, scale, lowest, allowed, x, first, last):
    """Compute x = max(z - theta D' dual, lowest), D' the transposed differences, in
    layers first <= k < last; 0 where not allowed.

    Args:
        z: (nz, ny, nx).
        dual: (3, nz, ny, nx) along z, y, x.
        theta: length of the step.
        scale: (3,) factors on the differences.
        lowest: values are not less.
        allowed: uint8 (nz, ny, nx), 0 where x must be 0.
        x: (nz, ny, nx) filled.
        first: first layer.
        last: layer after the last.
    """
    ny, nx = x.shape[1:]
    for k in prange(first, last):
        for j in range(ny):
            for i in range(nx):
                if allowed[k, j, i] == 0:
                    x[k, j, i] = np.float32(0)
                    continue
                # D' dual = what the voxel before gave minus what this one gives; the dual of
                # the last voxel along an axis is 0, because its difference is.
                spread = scale[0] * dual[0, k, j, i]
                spread += scale[1] * dual[1, k, j, i]
                spread += scale[2] * dual[2, k, j, i]
                if k > 0:
                    spread -= scale[0] * dual[0, k - 1, j, i]
                if j > 0:
                    spread -= scale[1] * dual[1, k, j - 1, i]
                if i > 0:
                    spread -= scale[2] * dual[2, k, j, i - 1]
                x[k, j, i] = max(z[k, j, i] + theta * spread, lowest)


@parallel
def dual_step(x, ahead, dual, rate, momentum, scale, first, last):
    """Compute dual = ahead + rate D x, shortened to length 1 a voxel, and extrapolate: ahead =
    dual + momentum times the change of dual; in layers first <= k < last.

    Args:
        x: (nz, ny, nx).
        ahead: (3, nz, ny, nx) changed in place.
        dual: (3, nz, ny, nx) changed in place.
        rate: length of the step.
        momentum: of the extrapolation.
        scale: (3,) factors on the differences.
        first: first layer.
        last: layer after the last.
    """
    ny, nx = x.shape[1:]
    one = np.float32(1)
    for k in prange(first, last):
        for j in range(ny):
            for i in range(nx):
                dz, dy, dx = differences(x, k, j, i, scale)
                # A step uphill, then back onto the unit ball: the dual of a length is bounded
                # by 1.
                a = ahead[0, k, j, i] + rate * dz
                b = ahead[1, k, j, i] + rate * dy
                c = ahead[2, k, j, i] + rate * dx
                shorter = one / max(one, np.float32(math.sqrt(a * a + b * b + c * c)))
                a, b, c = a * shorter, b * shorter, c * shorter
                # The extrapolated point needs the change, so that `dual` is written last.
                ahead[0, k, j, i] = a + momentum * (a - dual[0, k, j, i])
                ahead[1, k, j, i] = b + momentum * (b - dual[1, k, j, i])
                ahead[2, k, j, i] = c + momentum * (c - dual[2, k, j, i])
                dual[0, k, j, i], dual[1, k, j, i], dual[2, k, j, i] = a, b, c
