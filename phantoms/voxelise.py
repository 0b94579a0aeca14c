"""A phantom as voxels of attenuation: exact coverage along z, sub-columns across.

Analytic solids and triangle meshes are voxelised along the same columns. A mesh is filled
by the winding number with an edge rule on which both neighbors of an edge agree, so that
closed meshes cannot leak. Open meshes, and grids that do not fit into memory, are errors.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.pieces import Surface, Voxels, bounds
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.projection.analytic_solids import Scene, Shape, Vector, as_convex

MAX_VOXELS: Final = 1 << 30
"""Largest number of voxels of a grid."""
MAX_LEAK_SHARE: Final = 1e-3
"""Largest part of columns that do not close: a mesh with a few bad faces is still filled."""

_Interval = tuple[FloatArray, FloatArray]


def voxelise(
    scene: Scene,
    surfaces: Sequence[Surface],
    size_mm: Vector,
    voxel_mm: float,
    oversample: int,
) -> Volume:
    """Sample the attenuation [1/mm] of a scene and of meshes on a grid about the origin.

    The grid is rounded up to whole voxels, at least one along each axis. Overlaps add up;
    negative solids take away.

    `scene`: analytic solids, added up; `surfaces`: triangle meshes to add; `size_mm`: content of
    the grid, along x, y, z [mm]; `voxel_mm`: voxel edge [mm]; `oversample`: sub-columns per
    voxel along x and along y, 1 to 16.
    Returns volume, data float32 [z, y, x].
    Raises PhantomError: another oversample, an edge that is not above 0 and finite, a grid of
    more than `MAX_VOXELS`, or a mesh that is not closed.
    """
    if not (math.isfinite(voxel_mm) and voxel_mm > 0.0):
        raise PhantomError(f"voxel size is {voxel_mm} mm; allowed: above 0")
    if not 1 <= oversample <= 16:
        raise PhantomError(f"oversample is {oversample}; allowed: 1 to 16")
    counts = [max(math.ceil(s / voxel_mm - 1e-9), 1) for s in size_mm]
    if math.prod(counts) > MAX_VOXELS:
        grid = " x ".join(map(str, counts))
        message = f"{grid} voxels of {voxel_mm:g} mm are too many"
        raise PhantomError.instead(message, math.prod(counts), MAX_VOXELS)
    data = np.zeros(counts[::-1], dtype=np.float32)
    for solid in scene.solids:
        _add_solid(data, solid.shape, solid.mu_per_mm, voxel_mm, oversample)
    for surface in surfaces:
        _add_surface(data, surface, voxel_mm, oversample)
    return Volume(data, (voxel_mm, voxel_mm, voxel_mm))


def as_volume(voxels: Voxels) -> Volume:
    """Convert a ready grid to the projector's volume."""
    return Volume(voxels.data, voxels.voxel_mm, voxels.center_mm)


def _add_solid(
    data: npt.NDArray[np.float32],
    shape: Shape,
    mu: float,
    voxel_mm: float,
    oversample: int,
) -> None:
    """Add a convex solid to `data` [z, y, x], with `oversample` columns per voxel
    along x and y.

    Heights are exact in each column; nothing is added for a shape outside the grid.

    Args:
        data: attenuation [1/mm], changed.
        shape: convex.
        mu: attenuation of the solid [1/mm].
        voxel_mm: spacing.
        oversample: columns per voxel along each of x and y.
    """
    from flexdt.phantoms import voxelise_kernels as kernels

    nz, ny, nx = data.shape
    low, high = bounds(shape)
    x0, x1 = _range(low[0], high[0], nx, voxel_mm)
    y0, y1 = _range(low[1], high[1], ny, voxel_mm)
    if x1 <= x0 or y1 <= y0:
        return
    step = voxel_mm / oversample
    x = (np.arange((x1 - x0) * oversample) + 0.5) * step + (x0 - nx / 2.0) * voxel_mm
    y = (np.arange((y1 - y0) * oversample) + 0.5) * step + (y0 - ny / 2.0) * voxel_mm
    bottom, top = _columns(shape, x[None, :], y[:, None])
    shape_2d = (len(y), len(x))
    kernels.add_convex(
        data,
        np.ascontiguousarray(np.broadcast_to(bottom / voxel_mm + nz / 2.0, shape_2d)),
        np.ascontiguousarray(np.broadcast_to(top / voxel_mm + nz / 2.0, shape_2d)),
        x0,
        y0,
        oversample,
        mu / oversample**2,
    )


def _add_surface(
    data: npt.NDArray[np.float32], surface: Surface, voxel_mm: float, oversample: int
) -> None:
    """Add a filled mesh to `data`, in place.

    Overlapping bodies fill once, inward shells are cavities; a voxel's share is that of
    its columns.

    Args:
        data: attenuation [1/mm], (z, y, x), changed.
        surface: closed.
        voxel_mm: spacing.
        oversample: columns per voxel along each of x and y.

    Raises:
        PhantomError: more than `MAX_LEAK_SHARE` of the columns do not end.
    """
    from flexdt.phantoms import voxelise_kernels as kernels

    nz, ny, nx = data.shape
    scale = np.array([oversample, oversample, 1.0]) / voxel_mm
    shift = np.array([nx * oversample, ny * oversample, nz]) / 2.0
    triangles = np.ascontiguousarray((surface.vertices * scale + shift)[surface.faces])
    counts = np.zeros((ny * oversample, nx * oversample), dtype=np.int32)
    starts = np.zeros(counts.shape, dtype=np.int64)
    kernels.cross(triangles, starts, counts, np.empty(0), np.empty(0, dtype=np.int8))
    ends = np.cumsum(counts, dtype=np.int64).reshape(counts.shape)
    starts = ends - counts
    total = int(ends[-1, -1])
    heights = np.empty(total)
    signs = np.empty(total, dtype=np.int8)
    kernels.cross(triangles, starts, np.zeros_like(counts), heights, signs)
    leaks = kernels.add_surface(
        data,
        starts,
        counts,
        heights,
        signs,
        oversample,
        surface.mu_per_mm / oversample**2,
    )
    hit = int(np.count_nonzero(counts))
    if leaks > MAX_LEAK_SHARE * hit:
        raise PhantomError(
            f"the mesh is not closed: {leaks} of {hit} columns through it do not end; "
            "repair it (close holes, orient faces) and try again",
            {"asked": leaks, "allowed": int(MAX_LEAK_SHARE * hit)},
        )


def _range(low: float, high: float, n: int, voxel_mm: float) -> tuple[int, int]:
    """Return first and last + 1 of n voxels, about 0, in an extent [mm]."""
    return (
        max(math.floor(low / voxel_mm + n / 2.0 - 1e-9), 0),
        min(math.ceil(high / voxel_mm + n / 2.0 + 1e-9), n),
    )


def _columns(shape: Shape, x: FloatArray, y: FloatArray) -> _Interval:
    """Compute the lowest and highest z [mm] of a convex shape above each (x, y), exactly.

    Lower > upper where the column misses it.
    """
    one = as_convex(shape)
    bottom, top = _between_slabs(one.slabs, x, y)
    if one.curved:
        low, high = _quadric(one.matrix, one.center, x, y)
        bottom = np.maximum(bottom, low)
        top = np.minimum(top, high)
    return bottom, top


def _quadric(
    to_unit: FloatArray, center: FloatArray, x: FloatArray, y: FloatArray
) -> _Interval:
    """Solve for the interval where |to_unit (p - center)| <= 1 along z; unbounded in an upright
    cylinder.

    Columns that only touch miss.

    Args:
        to_unit: (3, 3), maps the quadric to the unit sphere or cylinder.
        center: (3,) [mm].
        x: of the columns, broadcast with y [mm].
        y: of the columns [mm].

    Returns lower and upper end [mm]; an empty interval ends before it begins.
    """
    cx, cy, cz = center
    direction = to_unit[:, 2]
    a = float(direction @ direction)
    start = [to_unit[k, 0] * (x - cx) + to_unit[k, 1] * (y - cy) for k in range(3)]
    b = sum(direction[k] * start[k] for k in range(3))
    c = sum(s * s for s in start) - 1.0
    if a < 1e-18:
        inside = c <= 0.0
        return np.where(inside, -np.inf, np.inf), np.where(inside, np.inf, -np.inf)
    square = b * b - a * c
    half = np.sqrt(np.maximum(square, 0.0)) / a
    middle = cz - b / a
    return middle - half, np.where(square > 0.0, middle + half, -np.inf)


def _between_slabs(slabs: FloatArray, x: FloatArray, y: FloatArray) -> _Interval:
    """Compute the interval along z where low <= n . p <= high for all slabs.

    A slab parallel to z leaves all or nothing of a column.

    Args:
        slabs: (k, 5): normal (3), low, high [mm].
        x: of the columns, broadcast with y [mm].
        y: of the columns [mm].

    Returns:
        Lower and upper end [mm]; an empty interval ends before it begins.
    """
    zero = np.zeros(np.broadcast_shapes(x.shape, y.shape))
    bottom = zero - np.inf
    top = zero + np.inf
    for nx, ny, nz, low, high in slabs:
        across = nx * x + ny * y
        if abs(nz) < 1e-12:
            top = np.where((low <= across) & (across <= high), top, -np.inf)
            continue
        lower, upper = (low, high) if nz > 0.0 else (high, low)
        bottom = np.maximum(bottom, (lower - across) / nz)
        top = np.minimum(top, (upper - across) / nz)
    return bottom, top
