"""Line integrals through voxels and their transpose in double precision, by sorted crossings.

Shares nothing with the kernels: every plane that a ray crosses is a number, these are sorted,
and the voxel of each piece is the one that holds its middle.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
NUMBERS = 2_000_000
"""Crossings at a time."""


@dataclass(frozen=True)
class VoxelGrid:
    """Where voxels are.

    Attributes:
        counts: (nx, ny, nz).
        voxel_mm, center_mm: (3,) x, y, z.
    """

    counts: npt.NDArray[np.int64]
    voxel_mm: Floats
    center_mm: Floats


def ray_ends(rows: Floats, shape: tuple[int, int]) -> tuple[Floats, Floats]:
    """Sources and pixel centres [mm], each (n * rows * cols, 3), of rows (n, 12) of a
    geometry.

    Rays are in the order of view, row, column.
    """
    r, c = np.meshgrid(np.arange(shape[0]), np.arange(shape[1]), indexing="ij")
    across, down = (c - (shape[1] - 1) / 2).ravel(), (r - (shape[0] - 1) / 2).ravel()
    pixels = (
        rows[:, None, 3:6]
        + across[None, :, None] * rows[:, None, 6:9]
        + down[None, :, None] * rows[:, None, 9:12]
    )
    sources = np.broadcast_to(rows[:, None, 0:3], pixels.shape)
    return sources.reshape(-1, 3), pixels.reshape(-1, 3)


def pieces(
    grid: VoxelGrid, starts: Floats, ends: Floats
) -> Iterator[tuple[slice, Floats, npt.NDArray[np.int64]]]:
    """Cut rays at the planes of a grid, portion by portion, so that memory stays bounded.

    Args:
        grid: the voxels.
        starts, ends: (n, 3) of the rays [mm].

    Yields:
        Which rays, the lengths of their pieces [mm], and the numbers of the voxels these
        lie in (z slowest). Pieces outside the grid have length 0 and number 0.
    """
    low = grid.center_mm - grid.counts * grid.voxel_mm / 2
    each = int(grid.counts.sum()) + 5
    step = max(1, NUMBERS // each)
    for first in range(0, len(starts), step):
        some = slice(first, first + step)
        start, way = starts[some], ends[some] - starts[some]
        cuts = [np.zeros((len(start), 1)), np.ones((len(start), 1))]
        for axis in range(3):
            planes = low[axis] + np.arange(grid.counts[axis] + 1) * grid.voxel_mm[axis]
            with np.errstate(divide="ignore", invalid="ignore"):
                t = (planes - start[:, axis, None]) / way[:, axis, None]
            cuts.append(
                np.clip(np.nan_to_num(t, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)
            )
        t = np.sort(np.concatenate(cuts, axis=1), axis=1)
        middle = start[:, None] + 0.5 * (t[:, 1:] + t[:, :-1])[:, :, None] * way[:, None]
        index = np.floor((middle - low) / grid.voxel_mm).astype(np.int64)
        inside = ((index >= 0) & (index < grid.counts)).all(axis=2)
        lengths = np.diff(t, axis=1) * np.linalg.norm(way, axis=1)[:, None]
        nx, ny, _ = grid.counts
        number = (index[:, :, 2] * ny + index[:, :, 1]) * nx + index[:, :, 0]
        yield some, np.where(inside, lengths, 0.0), np.where(inside, number, 0)


def line_integrals(grid: VoxelGrid, data: Floats, starts: Floats, ends: Floats) -> Floats:
    """Sum of length times value for each ray; data (nz, ny, nx)."""
    out = np.zeros(len(starts))
    flat = np.asarray(data, np.float64).ravel()
    for some, lengths, number in pieces(grid, starts, ends):
        out[some] = (lengths * flat[number]).sum(axis=1)
    return out


def spread_back(grid: VoxelGrid, values: Floats, starts: Floats, ends: Floats) -> Floats:
    """The transpose: sum of length times value for each voxel, (nz, ny, nx)."""
    size = int(np.prod(grid.counts))
    out = np.zeros(size)
    flat = np.asarray(values, np.float64).ravel()
    for some, lengths, number in pieces(grid, starts, ends):
        weights = lengths * flat[some, None]
        out += np.bincount(number.ravel(), weights.ravel(), size)
    nx, ny, nz = grid.counts
    return out.reshape(nz, ny, nx)
