"""Compiled passes that bring a volume into the layout of `volume.Layout`: a blocked transpose
from [z, y, x] to z contiguous, and the occupied range of each voxel column. `volume` computes
positions and crops.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from flexdt.twin.projection.kernels.compiling import parallel

BLOCK_VOXELS = 32
"""Edge of a block [voxels]: two blocks are 8 kB, a quarter of a usual first cache."""


@parallel
def transpose(data, flat, stride_x, stride_y, adding, first_y, last_y):
    """Copy data to flat[y * stride_y + x * stride_x + z] for first_y <= y < last_y, in
    blocks that fit the first cache.

    Args:
        data: (nz, ny, nx) float32.
        flat: changed in place.
        stride_x: elements from x to x + 1.
        stride_y: elements from y to y + 1.
        adding: data is added to the values in flat; otherwise it replaces them.
        first_y: first y.
        last_y: y after the last.
    """
    nz, _, nx = data.shape
    for y in prange(first_y, last_y):
        for x0 in range(0, nx, BLOCK_VOXELS):
            x1 = min(nx, x0 + BLOCK_VOXELS)
            for z0 in range(0, nz, BLOCK_VOXELS):
                z1 = min(nz, z0 + BLOCK_VOXELS)
                # Reading goes along x and writing along z; a block of both stays in the cache,
                # so that no line of memory is fetched twice.
                for x in range(x0, x1):
                    at = y * stride_y + x * stride_x
                    for z in range(z0, z1):
                        held = flat[at + z] if adding else np.float32(0)
                        flat[at + z] = held + data[z, y, x]


@parallel
def occupied(flat, stride_x, stride_y, nz, first, last, first_y, last_y):
    """Fill `first` and `last` for first_y <= y < last_y: the range of z outside which a
    voxel column is zero.

    Args:
        flat: voxels, flat[y * stride_y + x * stride_x + z].
        stride_x: elements from x to x + 1.
        stride_y: elements from y to y + 1.
        nz: voxels along z.
        first: (ny, nx) filled with the first z that is not zero, nz in an empty column.
        last: (ny, nx) filled with the z after the last.
        first_y: first y.
        last_y: y after the last.
    """
    nx = first.shape[1]
    for y in prange(first_y, last_y):
        for x in range(nx):
            column = flat[y * stride_y + x * stride_x : y * stride_y + x * stride_x + nz]
            # From both ends: most columns end within a few voxels of air.
            low = 0
            while low < nz and column[low] == np.float32(0):
                low += 1
            high = nz
            while high > low and column[high - 1] == np.float32(0):
                high -= 1
            first[y, x] = low
            last[y, x] = high


CHECKED_NUMBERS = 1 << 16
"""Numbers that a thread checks at a time."""
SIZE_BITS = np.uint32(0x7FFFFFFF)
INFINITE_BITS = np.uint32(0x7F800000)
"""Bits of a float32 without its sign, and those of infinity; NaN has larger ones."""


@parallel
def unfit_parts(bits):
    """Count the runs of `CHECKED_NUMBERS` float32 numbers, given as uint32 bits, in which
    any is not finite; 0 if all are finite.
    """
    runs = (bits.size + CHECKED_NUMBERS - 1) // CHECKED_NUMBERS
    unfit = 0
    for run in prange(runs):
        some = bits[run * CHECKED_NUMBERS : min(bits.size, (run + 1) * CHECKED_NUMBERS)]
        most = np.uint32(0)
        for i in range(len(some)):
            most = max(most, np.uint32(some[i] & SIZE_BITS))
        if most >= INFINITE_BITS:
            unfit += 1
    return unfit


@parallel
def touch(flat):
    """Write a zero into every page of fresh zeros, so that each thread brings in pages of its
    own.

    `flat`: (k,) float32 zeros; every 1024th number is written."""
    chunk = 1 << 19
    for part in prange((flat.size + chunk - 1) // chunk):
        for i in range(part * chunk, min(flat.size, (part + 1) * chunk), 1024):
            flat[i] = np.float32(0)
