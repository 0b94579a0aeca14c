"""The projector on the processor: fans of rays where the geometry has them, single rays elsewhere.

Which kernel runs is chosen from the geometry alone, and every choice gives the same numbers. This
module refuses to know about mm (but for the length of a ray): everything comes in voxel units.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.projection.convex import corner_shadows
from flexdt.twin.projection.fan_plan import BoolArray, IntArray, plan_fans
from flexdt.twin.projection.fan_turns import plan_turns
from flexdt.twin.projection.fan_types import Box
from flexdt.twin.projection.volume import LANES

TILE = 8
"""Detector columns a job of single rays."""


def project(box: Box, views: FloatArray, out: Float32Array) -> None:
    """Fill out (n, rows, cols) with line integrals.

    Args:
        box: the volume.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box.
        out: C-ordered float32.
    """
    from flexdt.twin.projection import fan_kernels, siddon_kernels

    shape = (out.shape[1], out.shape[2])
    plan = plan_fans(views, (box.nx, box.ny, box.nz), shape)
    if len(plan.jobs):
        shadows = box_shadows(box, views, (0, box.nz), shape, plan.turned)
        fan_kernels.project_fans(box, plan.fans(), shadows, threads(), out)
    if len(plan.alone):
        siddon_kernels.project_rays(box, views, plan.alone, out, TILE)


def spread(box: Box, views: FloatArray, values: Float32Array, *, clean: bool = True) -> None:
    """The transpose of `project`: values (n, rows, cols) into box.flat.

    Args:
        box: the volume; its spans are not used.
        views: as in `project`.
        values: C-ordered float32.
        clean: box.flat holds zeros; otherwise whatever it holds is overwritten.
    """
    from flexdt.twin.projection import fan_kernels, siddon_kernels

    shape = (values.shape[1], values.shape[2])
    counts = (box.nx, box.ny, box.nz)
    plan = plan_fans(views, counts, shape)
    workers = threads()
    turns = plan_turns(plan, counts, shape, workers)
    slices = z_slices(box.nz, turns.slices)
    marks = np.full((len(slices), 2 * box.nx * box.ny), int(clean), np.int32)
    if len(plan.jobs):
        shadows = np.stack(
            [box_shadows(box, views, (a, b), shape, plan.turned) for a, b in slices.tolist()]
        )
        fan_kernels.spread_fans(
            box, plan.fans(), turns.turns, turns.units, slices, shadows, marks, workers, values
        )
    if not clean:
        fan_kernels.open_rest(box, slices, marks)
    if len(plan.alone):
        slices = z_slices(box.nz, workers)
        marks = np.ones((len(slices), 2 * box.nx * box.ny), np.int32)
        siddon_kernels.spread_rays(box, views, plan.alone, values, slices, marks)


def z_slices(nz: int, count: int) -> IntArray:
    """At most `count` ranges (s, 2) of about equal height, cut at whole cache lines."""
    lines = -(-nz // LANES)
    edges = np.unique(np.arange(count + 1) * lines // count) * LANES
    edges[-1] = nz
    return np.column_stack([edges[:-1], edges[1:]]).astype(np.int64)


def box_shadows(
    box: Box,
    views: FloatArray,
    levels: tuple[int, int],
    shape: tuple[int, int],
    turned: BoolArray,
) -> IntArray:
    """Pixels that levels [low, high) of a box can reach: (n, 4) = first row, last row + 1, first
    column, last column + 1; the other way about in `turned` (n,) views.
    """
    ends = [[x, y, z] for x in (0, box.nx) for y in (0, box.ny) for z in levels]
    shadows = corner_shadows(np.array(ends, dtype=np.float64), views, shape)
    return np.where(turned[:, None], shadows[:, [2, 3, 0, 1]], shadows)


def threads() -> int:
    """How many threads the kernels use."""
    import numba

    return int(numba.get_num_threads())
