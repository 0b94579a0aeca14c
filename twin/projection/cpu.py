"""The projector on the processor: fans of rays where the geometry has them, single rays
elsewhere.

Which kernel runs is chosen from the geometry alone, and both give the same numbers. All lengths
are in voxel units, but for the length of a ray [mm].

Detectors mounted on their side: the fans of `fan_plan` follow a detector's columns. A view in
which images of vertical planes run along the rows instead is projected as the view of a
detector with u and v exchanged, whose image is the transpose; thus the kernels know one
orientation only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.analytic_solids import corner_shadows
from flexdt.twin.projection.fan_plan import (
    IntArray,
    exchanged,
    lying,
    plan_fans,
    plan_turns,
)
from flexdt.twin.projection.kernels.fan_types import Box
from flexdt.twin.projection.portions import (
    equal_portions,
    fan_job_ns,
    portions,
    ray_ns,
    turn_portions,
)
from flexdt.twin.projection.volume import LANE_FLOATS

MAX_TRANSPOSED_BYTES = 64 << 20
"""Largest size of the transposed images held at a time [bytes], at least one image."""
TILE_COLUMNS = 8
"""Detector columns in a job of single rays."""


def runs(views: FloatArray, shape: tuple[int, int]) -> Iterator[tuple[slice, bool]]:
    """Yield ranges of neighboring views of one orientation, each with its transposition.

    The second value is True when rows and columns of these views are exchanged; such a
    range holds at most as many views as fit into `MAX_TRANSPOSED_BYTES` (at least one),
    as their images are copied.

    Args:
        views: (n, 12) rays in voxel units.
        shape: detector (rows, cols).
    """
    on_side = lying(views, shape)
    most = max(1, MAX_TRANSPOSED_BYTES // (4 * shape[0] * shape[1]))
    edges = np.flatnonzero(np.diff(on_side)) + 1
    for begin, end in zip(
        [0, *edges.tolist()], [*edges.tolist(), len(views)], strict=True
    ):
        turned = bool(on_side[begin])
        step = most if turned else end - begin
        for at in range(begin, end, step):
            yield slice(at, min(at + step, end)), turned


def project(
    box: Box, views: FloatArray, out: Float32Array, *, fans: bool = True, side: int = 1
) -> None:
    """Fill out (n, rows, cols) with line integrals, or their means over pixels.

    Views on their side are walked with rows and columns exchanged; those that no fan
    fits, ray by ray.

    Args:
        box: the volume.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box; of
            `side` x `side` rays a pixel, those of the finer panel.
        out: C-ordered float32.
        fans: False to walk every ray on its own.
        side: rays along each side of a pixel. Where fans are columns of rays they are averaged
            where they are walked; other views have an image of all rays first.
    """
    from flexdt.twin.projection.kernels import fan_kernels

    shape = (out.shape[1] * side, out.shape[2] * side)
    counts = (box.nx, box.ny, box.nz)
    if not fans:
        every = np.arange(len(views))
        if side == 1:
            _project_alone(box, views, every, out)
        else:
            _project_averaged(box, views, every, out, side, fans=False)
        return
    for some, turned in runs(views, shape):
        rays = views[some]
        images = out[some]
        seen = shape
        if turned:
            rays = exchanged(rays)
            seen = shape[::-1]
            images = np.empty((len(rays), *images.shape[:0:-1]), np.float32)
        plan = plan_fans(rays, counts, seen, side)
        workers = threads()
        if len(plan.jobs):
            shadows = box_shadows(box, rays, (0, box.nz), seen)
            times = fan_job_ns(
                plan.lines, plan.jobs, rays, counts, (seen[0], plan.widest)
            )
            for first, last in portions(times, workers):
                part = plan.fans(rays, slice(first, last))
                fan_kernels.project_fans(box, part, shadows, workers, side, images)
        if side == 1:
            _project_alone(box, rays, plan.alone, images)
        else:
            _project_averaged(box, rays, plan.alone, images, side)
        if turned:
            out[some] = images.transpose(0, 2, 1)


def _project_averaged(
    box: Box,
    views: FloatArray,
    chosen: IntArray,
    out: Float32Array,
    side: int,
    *,
    fans: bool = True,
) -> None:
    """Fill the chosen views of `out` with means over pixels of `side` x `side` rays, from an
    image of all rays of one view at a time. Arguments as of `project`."""
    from flexdt.twin.projection.kernels import within_kernels

    room = np.empty((1, out.shape[1] * side, out.shape[2] * side), np.float32)
    for view in chosen.tolist():
        project(box, views[view : view + 1], room, fans=fans)
        within_kernels.average_parts(room, side, out[view : view + 1])


def _project_alone(
    box: Box, views: FloatArray, chosen: IntArray, out: Float32Array
) -> None:
    """Fill the chosen views of `out` with line integrals of rays that are walked one by one, on
    all threads. `box`: the volume; `views`: (n, 12) rays in voxel units; `chosen`: indices of
    views; `out`: (n, rows, cols), changed."""
    from flexdt.twin.projection.kernels import siddon_kernels

    jobs = len(chosen) * -(-out.shape[2] // TILE_COLUMNS)
    for first, last in equal_portions(jobs, tile_ns(box, out.shape[1]), threads()):
        siddon_kernels.project_rays(box, views, chosen, out, TILE_COLUMNS, first, last)


def tile_ns(box: Box, rows: int) -> float:
    """Estimate the time of TILE_COLUMNS columns, single rays [ns]."""
    return TILE_COLUMNS * rows * ray_ns((box.nx, box.ny, box.nz))


def spread(
    box: Box,
    views: FloatArray,
    values: Float32Array,
    *,
    clean: bool = True,
    fans: bool = True,
) -> None:
    """Apply the transpose of `project`: add values (n, rows, cols) to box.flat.

    `box`: the volume; its spans are not used. `views`: as in `project`. `values`: C-ordered
    float32. `clean`: True if box.flat holds zeros; otherwise its content is overwritten (if
    there is a view). `fans`: False to walk every ray on its own.
    """
    shape = (values.shape[1], values.shape[2])
    for some, turned in runs(views, shape) if fans else [(slice(None), False)]:
        rays = views[some]
        images = values[some]
        if turned:
            rays = exchanged(rays)
            images = np.ascontiguousarray(images.transpose(0, 2, 1))
        _spread(box, rays, images, clean, fans)
        clean = True  # from now on it holds what is added to


def _spread(
    box: Box, views: FloatArray, values: Float32Array, clean: bool, fans: bool
) -> None:
    """Add the transpose of the projection of `values` to the box's voxels: fans first,
    then single rays.

    No voxel is added to by two threads at once.

    Args:
        box: the layout's voxels, changed in place.
        views: (n, 12) rays in voxels.
        values: (n, rows, cols) images.
        clean: the voxels hold zeros; otherwise each is cleared before its first use.
        fans: views are planned as fans; False: all rays on their own.
    """
    from flexdt.twin.projection.kernels import fan_kernels, siddon_kernels

    shape = (values.shape[1], values.shape[2])
    counts = (box.nx, box.ny, box.nz)
    plan = plan_fans(views if fans else views[:0], counts, shape)
    workers = threads()
    if fans:
        alone = plan.alone
    else:
        alone = np.arange(len(views))
    turns = plan_turns(plan, views, counts, shape, workers)
    slices = z_slices(box.nz, turns.slices)
    marks = np.full((len(slices), 2 * box.nx * box.ny), int(clean), np.int32)
    if len(plan.jobs):
        shadows = np.stack(
            [box_shadows(box, views, (a, b), shape) for a, b in slices.tolist()]
        )
        times = fan_job_ns(plan.lines, plan.jobs, views, counts, (shape[0], plan.widest))
        units = np.add.reduceat(times, turns.units[:, 0])
        for some in turn_portions(turns.turns, units, workers):
            fan_kernels.spread_fans(
                box,
                plan.fans(views),
                some,
                turns.units,
                slices,
                shadows,
                marks,
                workers,
                values,
            )
    if not clean:
        fan_kernels.open_rest(box, slices, marks)
    if len(alone):
        slices = z_slices(box.nz, workers)
        marks = np.ones((len(slices), 2 * box.nx * box.ny), np.int32)
        columns = len(alone) * shape[1]
        # All threads meet every ray, each in its slice.
        for first, last in equal_portions(columns, shape[0] * ray_ns(counts), 1):
            siddon_kernels.spread_rays(
                box, views, alone, values, slices, marks, first, last
            )


def z_slices(nz: int, count: int) -> IntArray:
    """Cut nz levels into at most `count` ranges (s, 2) of about equal height.

    Cuts are at multiples of `LANE_FLOATS` voxels; fewer ranges where there are fewer of
    these."""
    lines = -(-nz // LANE_FLOATS)
    edges = np.unique(np.arange(count + 1) * lines // count) * LANE_FLOATS
    edges[-1] = nz
    return np.column_stack([edges[:-1], edges[1:]]).astype(np.int64)


def box_shadows(
    box: Box, views: FloatArray, levels: tuple[int, int], shape: tuple[int, int]
) -> IntArray:
    """Find the pixels that levels [low, high) of a box can reach. Returns (n, 4) first row, last
    row + 1, first column, last column + 1."""
    ends = [[x, y, z] for x in (0, box.nx) for y in (0, box.ny) for z in levels]
    return corner_shadows(np.array(ends, dtype=np.float64), views, shape)


def threads() -> int:
    """Return the number of the kernels' threads."""
    import numba

    return int(numba.get_num_threads())
