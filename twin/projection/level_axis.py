"""How each view is to be walked: along which axis levels are stacked, or ray by ray.

A ray acts wherever it passes from one level to the next, so levels should be stacked along the
axis that rays are most nearly at right angles to. That is z for a source beside the object, and x
or y for one well above or below it, or for a detector of a single row. Turning the volume and the
geometry cyclically, (x, y, z) to (y, z, x) or (z, x, y), brings either axis to where the kernels
have z; images stay as they are.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import fan_plan
from flexdt.twin.projection.fan_plan import FACING, SPREAD, WIDEST
from flexdt.twin.projection.volume import Volume

Order = tuple[int, int, int]
ORDERS: tuple[Order, Order, Order] = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
"""Axes of the volume that take the places of x, y and z: levels along z, x and y."""
NO_FANS = 3
"""Beside the indices into ORDERS: fans would hold so few rays that each is faster on its own."""
CROSSING, LEVEL, SLAB = (10.5, 15.5), (0.1, 1.0), 35.0
"""Time of a ray of a fan at a level, and of a fan in a slab: of each level there, and beside them
[ns]. Pairs: fans of rays in one plane, and others."""
ALONE, VIEW = 2.75, 5e5
"""Time of a ray on its own at a voxel, and of planning the fans of a view [ns]. All of these were
fitted to drawn geometries, each timed all four ways (`tests/studies/walks.py`), on two busy cores;
only their ratios count."""
PREFERRED = 0.75
"""Another axis takes less than this share of the time, or is not worth another layout."""


def in_order(geometry: ConeVec, order: Order) -> ConeVec:
    """The geometry of `Volume.in_order`; the images are the same."""
    if order == ORDERS[0]:
        return geometry
    rows = geometry.rows.reshape(-1, 4, 3)[:, :, list(order)].reshape(-1, 12)
    return ConeVec(rows, geometry.detector_shape)


def by_level_axis(
    volume: Volume, geometry: ConeVec, shape: tuple[int, int]
) -> Iterator[tuple[slice, Order, bool]]:
    """Ranges of neighbouring views, each with the volume's order to project them in, and whether
    in fans.
    """
    rays = geometry.rays(shape)
    rays[:, :3] -= volume.center_mm
    axes = level_axes(rays / np.tile(volume.voxel_xyz, 4), volume.shape, shape)
    edges = [0, *(np.flatnonzero(np.diff(axes)) + 1).tolist(), len(axes)]
    for begin, end in pairwise(edges if len(axes) else []):
        fans = bool(axes[begin] != NO_FANS)
        yield slice(begin, end), ORDERS[axes[begin] if fans else 0], fans


def level_axes(
    rays: FloatArray, counts: tuple[int, int, int], shape: tuple[int, int]
) -> npt.NDArray[np.intp]:
    """Index into ORDERS of each view, or NO_FANS.

    Args:
        rays: (n, 12) source relative to the volume's centre, first pixel minus source, u, v in
            voxel units.
        counts: (nz, ny, nx) voxels.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    source, first, u, v = (rays[:, i : i + 3] for i in (0, 3, 6, 9))
    r, c = np.meshgrid([0, (rows - 1) / 2, rows - 1], [0, (cols - 1) / 2, cols - 1])
    towards = first[:, None] + r.reshape(-1, 1) * v[:, None] + c.reshape(-1, 1) * u[:, None]
    middle = towards[:, 4]
    size = np.abs(towards) / np.maximum(np.linalg.norm(towards, axis=2, keepdims=True), 1e-9)
    every = rows * cols * size.mean(axis=1)
    through = (np.array(counts[::-1]) / np.maximum(size[:, 4], 1e-9)).min(axis=1)
    times = np.empty((len(rays), 4))
    times[:, NO_FANS] = through * ALONE * every.sum(axis=1)
    for i, (a, b, w) in enumerate(ORDERS):

        def across(step: FloatArray, a: int = a, b: int = b) -> FloatArray:
            return np.asarray(np.abs(step[:, a] * middle[:, b] - step[:, b] * middle[:, a]))

        # Fans follow the images of planes along w: columns, or rows where those lie closer to them.
        lying = across(v) > across(u)
        steps, columns = np.where(lying, rows, cols), np.where(lying[:, None], v, u)
        along, length = np.where(lying[:, None], u, v), np.where(lying, cols, rows)
        flat = np.abs(along[:, [a, b]]).max(axis=1) * length < fan_plan.LEVEL
        far = np.hypot(source[:, a], source[:, b]) + 0.5 * math.hypot(counts[2 - a], counts[2 - b])
        wide = across(columns) * far / np.maximum(np.hypot(middle[:, a], middle[:, b]), 1e-9) ** 2
        fans = steps * np.where(flat, 1.0, np.maximum(wide / SPREAD, 1.0 / WIDEST))
        levels = np.minimum(counts[2 - w], np.abs(along[:, w]) * length)
        slab = SLAB + np.where(flat, *LEVEL) * levels
        crossings = np.where(flat, *CROSSING) * every[:, w]
        slabs = np.maximum(size[:, :, a], size[:, :, b]).mean(axis=1)
        facing = (np.hypot(size[:, :, a], size[:, :, b]) >= FACING).all(axis=1)
        fanned = VIEW + through * (crossings + fans * slab * slabs)
        times[:, i] = np.where(facing, fanned, np.inf)
    times[:, 1:NO_FANS] /= PREFERRED
    return np.asarray(np.argmin(times, axis=1))
