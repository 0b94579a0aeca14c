"""Forward projection, its adjoint, and its derivatives by the geometry: the public functions of
the voxel projectors.

Arguments are checked and brought into voxel units here. A CUDA device computes where there is
one with room for the volume, the processor otherwise; both give exact Siddon lengths. Rays run
from the focal spot through the pixel's center and on: a panel before or inside the volume cuts
none of them (`virtual_panel`).

Each view is walked along the axis on which its levels are stacked, or ray by ray. A ray acts
wherever it passes from one level to the next, so levels should be stacked along the axis that
rays are most nearly at right angles to. That is z for a source beside the object, and x or y
for one well above or below it, or for a detector of a single row. Turning the volume and the
geometry cyclically, (x, y, z) to (y, z, x) or (z, x, y), brings either axis to where the
kernels have z; images stay as they are.

The derivatives are exact for a volume of voxels, almost everywhere: a line integral is a smooth
function of the ray as long as the ray meets the same voxels in the same order. They are what
registration, alignment and training need. Computed on the processor, ray by ray.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, LimitError, shape_words
from flexdt.twin.geometry.cone_vec import ConeVec, check_spread
from flexdt.twin.geometry.cone_vec import check_shape as check_shape
from flexdt.twin.geometry.conventions import Float32Array, FloatArray, as_numbers
from flexdt.twin.geometry.virtual_panel import (
    relaxed_gradient,
    run_through,
    stretched,
    stretched_steps,
    stretches,
)
from flexdt.twin.projection import cpu, fan_plan, gpu, linear, single_view
from flexdt.twin.projection.cpu import TILE_COLUMNS
from flexdt.twin.projection.fan_plan import (
    MAX_FAN_COLUMNS,
    MAX_SPREAD_VOXELS,
    MIN_FACING_COSINE,
)
from flexdt.twin.projection.finer_pixels import (
    FORWARD_BYTES,
    averaged,
    batches,
    divided,
    finer,
    voxel_rays_a_side,
)
from flexdt.twin.projection.kernels.fan_types import Box
from flexdt.twin.projection.linear import Model, check_model
from flexdt.twin.projection.portions import equal_portions
from flexdt.twin.projection.volume import (
    DeviceVolume,
    Grid,
    Layout,
    Volume,
    as_volume,
    blank_layout,
    bring_over,
    room_like,
)
from flexdt.twin.rays_a_pixel import Rays, check_rays
from flexdt.twin.signatures import public

Order = tuple[int, int, int]
ORDERS: tuple[Order, Order, Order] = ((0, 1, 2), (1, 2, 0), (2, 0, 1))
"""Axes of the volume that take the places of x, y and z: levels along z, x and y."""
NO_FANS = 3
"""Code of single rays, after the indices into ORDERS: fans would hold too few rays to
pay."""
FAN_CROSSING_NS = (10.5, 15.5)
FAN_LEVEL_NS = (0.1, 1.0)
FAN_SLAB_NS = 35.0
"""Time of a ray of a fan at a level, of a fan in a slab at each level, and of a fan in
a slab apart from its levels [ns]. Pairs: fans of rays in one plane, and others."""
RAY_VOXEL_NS = 2.75
PLAN_VIEW_NS = 5e5
"""Time of a single ray at a voxel, and of planning the fans of a view [ns]. All of
these were fitted to drawn geometries, each timed all four ways
(walks.py of 52ade1c), on two busy cores; only their ratios count."""
MAX_TIME_SHARE = 0.75
"""Largest share of the time that another axis may take to be worth another layout."""
MIN_PARALLEL_BYTES = 16 * 2**20
"""Size of projections from which on all cores check them together [bytes]."""
Shape2 = tuple[int, int]


def in_order(geometry: ConeVec, order: Order) -> ConeVec:
    """Return the geometry with axes permuted as by `Volume.in_order`.

    `order` has the old axes in the place of x, y and z.
    """
    if order == ORDERS[0]:
        return geometry
    rows = geometry.rows.reshape(-1, 4, 3)[:, :, list(order)].reshape(-1, 12)
    return ConeVec(rows, geometry.detector_shape)


def by_level_axis(
    volume: Volume, geometry: ConeVec, shape: tuple[int, int]
) -> Iterator[tuple[slice, Order, bool]]:
    """Yield ranges of neighboring views with the best axis to stack levels along, by
    estimated time; nothing without views.

    Returns:
        Tuples of the range, the volume's order for projecting it, and whether rays travel
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
    """Choose an index into ORDERS for each view, or NO_FANS, by estimated time.

    Orders other than the first must take less than `MAX_TIME_SHARE` of the time of the
    others. An order is not chosen if some ray is within acos(`MIN_FACING_COSINE`) of its
    level axis.

    Args:
        rays: (n, 12) source relative to the volume's center, first pixel minus source, u,
            v in voxel units.
        counts: (nz, ny, nx) voxels.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    source, first, u, v = (rays[:, i : i + 3] for i in (0, 3, 6, 9))
    r, c = np.meshgrid([0, (rows - 1) / 2, rows - 1], [0, (cols - 1) / 2, cols - 1])
    towards = (
        first[:, None] + r.reshape(-1, 1) * v[:, None] + c.reshape(-1, 1) * u[:, None]
    )
    middle = towards[:, 4]
    size = np.abs(towards) / np.maximum(
        np.linalg.norm(towards, axis=2, keepdims=True), 1e-9
    )
    every = rows * cols * size.mean(axis=1)
    through = (np.array(counts[::-1]) / np.maximum(size[:, 4], 1e-9)).min(axis=1)
    times = np.empty((len(rays), 4))
    times[:, NO_FANS] = through * RAY_VOXEL_NS * every.sum(axis=1)
    if (times[:, NO_FANS] < PLAN_VIEW_NS).all():  # less than any fans take
        return np.full(len(rays), NO_FANS)
    for i, (a, b, w) in enumerate(ORDERS):

        def across(step: FloatArray, a: int = a, b: int = b) -> FloatArray:
            return np.asarray(
                np.abs(step[:, a] * middle[:, b] - step[:, b] * middle[:, a])
            )

        # Fans follow the images of planes along w: columns, or rows where those lie closer to
        # them.
        lying = across(v) > across(u)
        steps = np.where(lying, rows, cols)
        columns = np.where(lying[:, None], v, u)
        along = np.where(lying[:, None], u, v)
        length = np.where(lying, cols, rows)
        flat = (
            np.abs(along[:, [a, b]]).max(axis=1) * length
            < fan_plan.MAX_LEVEL_OFFSET_VOXELS
        )
        far = np.hypot(source[:, a], source[:, b]) + 0.5 * math.hypot(
            counts[2 - a], counts[2 - b]
        )
        wide = (
            across(columns)
            * far
            / np.maximum(np.hypot(middle[:, a], middle[:, b]), 1e-9) ** 2
        )
        fans = steps * np.where(
            flat, 1.0, np.maximum(wide / MAX_SPREAD_VOXELS, 1.0 / MAX_FAN_COLUMNS)
        )
        levels = np.minimum(counts[2 - w], np.abs(along[:, w]) * length)
        slab = FAN_SLAB_NS + np.where(flat, *FAN_LEVEL_NS) * levels
        crossings = np.where(flat, *FAN_CROSSING_NS) * every[:, w]
        slabs = np.maximum(size[:, :, a], size[:, :, b]).mean(axis=1)
        facing = (np.hypot(size[:, :, a], size[:, :, b]) >= MIN_FACING_COSINE).all(axis=1)
        fanned = PLAN_VIEW_NS + through * (crossings + fans * slab * slabs)
        times[:, i] = np.where(facing, fanned, np.inf)
    times[:, 1:NO_FANS] /= MAX_TIME_SHARE
    return np.asarray(np.argmin(times, axis=1))


@public
def forward(
    volume: Volume | DeviceVolume,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2 | None = None,
    out: Float32Array | None = None,
    *,
    model: Model = "exact",
    rays: Rays = 1,
) -> Float32Array:
    """Compute line integrals of a volume.

    Exact: path length times value over voxels (Siddon 1985), along one ray a pixel or as the
    mean of several. Linear: of values between voxel centers, averaged over the pixel
    (docs/operator.md has which one when).

    Args:
        volume: attenuation [1/mm], as Volume(data, voxel_mm). Of a `DeviceVolume`, the
            images stay on the device.
        cone_vec: ConeVec or (n, 12) [mm], object frame; any orientation of the detector.
        shape: detector (rows, cols); default: the geometry's own.
        out: float32 (n, rows, cols), C order, filled and returned if given.
        model: "exact", voxels of one value each; "linear", samples of something smooth. On
            the processor.
        rays: along each side of a pixel, 1 to 16, or "auto", two to the shadow of a voxel
            (at least two a pixel); the model "linear" averages over the pixel by itself.

    Returns:
        float32 (n, rows, cols), dimensionless; numpy's, or on the device numba's array.

    Raises:
        GeometryError: volume, cone_vec, shape or out do not fit, a row gives its pixels
            no rays of their own, or `out`, a model or rays are given for a
            `DeviceVolume`.
        LimitError: an unknown model, or another number of rays.
        DeviceError: the device failed at a `DeviceVolume`; for other volumes the
            processor computes instead.

    Examples:
        A ray along y through 4 voxels of 0.5 mm and 0.02 / mm:

        >>> volume = Volume(np.full((3, 4, 3), 0.02, np.float32), 0.5)
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> round(float(forward(volume, view, (1, 1))[0, 0, 0]), 4)
        0.04
    """
    if model != "exact" or rays != 1:
        return _of_areas(volume, cone_vec, shape, out, model, rays)
    image = _single_view(volume, cone_vec, shape, out)
    if image is not None:
        return image
    geometry = as_cone_vec(cone_vec)
    shape = geometry.of_shape(shape)
    if isinstance(volume, DeviceVolume):
        if out is not None:
            raise GeometryError(
                "out is of the host; allowed: None for a volume on a device", {}
            )
        geometry = run_through(geometry, corners_of(volume))
        there = volume.layout
        lines = voxel_rays(geometry, volume.layout, shape)
        # Arrays on a device have no type of their own.
        images: Float32Array = gpu.demand(
            lambda: gpu.project_there(box_of(there), there.flat, lines, shape)
        )
        return images
    result = check_out(out, (len(geometry), *shape))
    volume = as_volume(volume)
    geometry = run_through(geometry, corners_of(volume))
    if not _on_device(volume, geometry, shape, result):
        _on_processor(volume, geometry, shape, result)
    return result


def _on_processor(
    volume: Volume, geometry: ConeVec, shape: Shape2, out: Float32Array, side: int = 1
) -> None:
    """Fill `out` (n, rows, cols) with line integrals of a panel of `shape`, or with means over
    its `side` x `side` rays a pixel, `side` times fewer along each side."""
    for some, order, fans in by_level_axis(volume, geometry, shape):
        layout = volume.in_order(order).layout
        if layout.empty:
            out[some] = 0.0
        else:
            views = voxel_rays(in_order(geometry[some], order), layout, shape)
            cpu.project(box_of(layout), views, out[some], fans=fans, side=side)


def check_sampling(model: Model, rays: Rays) -> None:
    """Check a model and its rays along each side of a pixel.

    Raises:
        LimitError: an unknown model, or rays that it does not have.
    """
    check_model(model)
    check_rays(rays)
    if model == "linear" and rays not in (1, "auto"):
        message = f"rays is {rays} with model 'linear'"
        raise LimitError.instead(
            message, rays, "1 or 'auto': it averages over the whole pixel"
        )


def _sampling(
    volume: Volume | DeviceVolume, geometry: ConeVec, model: Model, rays: Rays
) -> int:
    """Check model and rays, and return the rays along each side, 1 for the model "linear".

    Raises:
        LimitError: as of `check_sampling`.
        GeometryError: a volume on a device.
    """
    check_sampling(model, rays)
    if isinstance(volume, DeviceVolume):
        message = f"model {model!r} with rays {rays} of a volume on a device"
        raise GeometryError.instead(
            message,
            [model, str(rays)],
            "'exact' with 1 there; volume.to('cpu') for others",
        )
    return voxel_rays_a_side(volume, geometry, rays) if model == "exact" else 1


def _of_areas(
    volume: Volume | DeviceVolume,
    cone_vec: ConeVec | npt.ArrayLike,
    shape: Shape2 | None,
    out: Float32Array | None,
    model: Model,
    rays: Rays,
) -> Float32Array:
    """Compute means over pixels, as `forward` with a model or with several rays."""
    geometry = as_cone_vec(cone_vec)
    shape = geometry.of_shape(shape)
    side = _sampling(volume, geometry, model, rays)
    assert isinstance(volume, Volume | Grid)
    result = check_out(out, (len(geometry), *shape))
    volume = as_volume(volume)
    if model == "exact":
        if side == 1:
            return forward(volume, geometry, shape, result)
        fine = finer(run_through(geometry, corners_of(volume)), shape, side)
        if gpu.availability().present:
            for some in batches(len(geometry), shape, side, FORWARD_BYTES):
                averaged(forward(volume, fine[some]), side, result[some])
        else:
            _on_processor(volume, fine, fine.of_shape(None), result, side)
        return result
    geometry = run_through(geometry, corners_of(volume))
    for some, order in _by_steepness(volume, geometry, shape):
        layout = volume.in_order(order).layout
        if layout.empty:
            result[some] = 0.0
        else:
            views = voxel_rays(in_order(geometry[some], order), layout, shape)
            linear.project(box_of(layout), views, result[some])
    return result


def _by_steepness(
    volume: Volume, geometry: ConeVec, shape: Shape2
) -> Iterator[tuple[slice, Order]]:
    """Yield ranges of neighboring views with the order of axes in which the model "linear"
    projects them."""
    rays = geometry.rays(shape) / np.tile(volume.voxel_xyz, 4)
    axes = linear.level_axes(rays, shape)
    edges = [0, *(np.flatnonzero(np.diff(axes)) + 1).tolist(), len(axes)]
    for begin, end in pairwise(edges if len(axes) else []):
        yield slice(begin, end), ORDERS[axes[begin]]


def _back_of_areas(
    values: Float32Array, geometry: ConeVec, like: Volume, model: Model, rays: Rays
) -> Volume:
    """Apply the transpose of `_of_areas` to images (n, rows, cols)."""
    side = _sampling(like, geometry, model, rays)
    shape = (values.shape[1], values.shape[2])
    total = room_like(like)
    if model == "exact":
        for some in batches(len(geometry), shape, side):
            fine = finer(geometry[some], shape, side)
            total += back(divided(values[some], side), fine, like).data
        return replace(like, data=total)
    for some, order in _by_steepness(like, geometry, shape):
        turned = like.in_order(order)
        layout = blank_layout(turned)
        views = voxel_rays(in_order(geometry[some], order), layout, shape)
        linear.spread(box_of(layout), views, values[some])
        data = layout_data(layout)
        total += data.transpose([2 - order.index(axis) for axis in (2, 1, 0)])
    return replace(like, data=total)


def _single_view(
    volume: object, cone_vec: object, shape: Shape2 | None, out: Float32Array | None
) -> Float32Array | None:
    """Try to project a single view of a volume that has a copy on a CUDA device.

    Args:
        volume, cone_vec, shape, out: as those of `forward`.

    Returns:
        The image, (1, rows, cols), `out` if given; None for several views, a volume
        without a copy on the device or without voxels, a geometry that is no ConeVec, or
        a view that `single_view` refuses.

    Raises:
        GeometryError: shape or out does not fit.
    """
    if not isinstance(volume, Volume) or not isinstance(cone_vec, ConeVec):
        return None
    if len(cone_vec) != 1:
        return None
    layout = volume.layout
    there = layout.device_copy.there is not None and not layout.empty
    if not there or not gpu.availability().present:
        return None
    shape = cone_vec.of_shape(shape)
    result = check_out(out, (1, *shape))
    if single_view.project(volume, box_of(layout), cone_vec.rows[0], result[0]):
        return result
    return None


def _on_device(
    volume: Volume, geometry: ConeVec, shape: Shape2, out: Float32Array
) -> bool:
    """Try to fill `out` with line integrals on a CUDA device.

    Counts the views projected from this volume, which decides whether copying it is worth
    while.

    Args:
        volume: to project.
        geometry: n views.
        shape: the detector's (rows, cols).
        out: (n, rows, cols) filled.

    Returns:
        Whether it is filled; False without a device, where the processor is faster, or if
        the device failed.
    """
    if not gpu.availability().present or len(geometry) == 0 or volume.layout.empty:
        return False
    layout = volume.layout
    views = voxel_rays(geometry, layout, shape)
    box = box_of(layout)
    copy = layout.device_copy
    if copy.there is None:
        to_move = layout.flat.nbytes
    else:
        to_move = 0
    before = copy.views
    copy.views = copy.views + len(views)
    return gpu.usable(to_move, out, cpu.threads(), before) and gpu.attempt(
        lambda: gpu.project(box, copy.uploaded(), views, out)
    )


@public
def back(
    projections: npt.ArrayLike,
    cone_vec: ConeVec | npt.ArrayLike,
    like: Volume | Grid,
    out: Float32Array | None = None,
    *,
    deterministic: bool = False,
    model: Model = "exact",
    rays: Rays = 1,
) -> Volume:
    """Apply the exact adjoint of `forward`: <forward(x), y> = <x, back(y)>, of the same model
    and rays.

    The result's data is a (nz, ny, nx) view with z contiguous in memory, which `forward`
    reads without another copy; use np.ascontiguousarray where C order matters.

    Args:
        projections: (n, rows, cols); of the host, or on a CUDA device (of cupy,
            PyTorch or numba), where the result stays then.
        cone_vec: ConeVec or (n, 12) [mm], one row a projection.
        like: the grid, or a volume on it, whose values are not used.
        out: an array of `room_like(like)`, overwritten and taken for the result if given:
            new memory costs as much as half the work of one view.
        deterministic: on a CUDA device, where rays add to voxels as they come, sums whose
            bytes are equal at every run, for three times the memory; the processor's
            always are.
        model, rays: as of `forward`.

    Returns:
        Volume (of images on a device: `DeviceVolume`) on the grid of `like`; values in
        the unit of projections times mm.

    Raises:
        GeometryError: the number of projections is not that of the views, out does not
            fit or is given for images on a device, or a row gives its pixels no rays of
            their own.
        DeviceError: the device failed at images that are on it; for those of the host the
            processor computes instead.

    Examples:
        >>> volume = Volume(np.full((3, 4, 3), 0.02, np.float32), 0.5)
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> ones = np.ones((1, 1, 1), np.float32)
        >>> spread = back(ones, view, like=volume)
        >>> round(float(spread.data.sum()), 4)  # the ray's length in the volume [mm]
        2.0
    """
    geometry = as_cone_vec(cone_vec)
    values = check_projections(projections, len(geometry))
    shape = geometry.of_shape((values.shape[1], values.shape[2]))
    like = as_volume(like)
    geometry = run_through(geometry, corners_of(like))
    if model != "exact" or rays != 1:
        if gpu.is_there(values):
            raise GeometryError.instead(
                f"model {model!r} with rays {rays} of images on a device",
                [model, str(rays)],
                "'exact' with 1 there",
            )
        made = _back_of_areas(values, geometry, like, model, rays)
        if out is None:
            return made
        out[...] = made.data
        return replace(like, data=out)
    if gpu.is_there(values):
        if out is not None:
            raise GeometryError(
                "out is of the host; allowed: None for images on a device", {}
            )
        target = DeviceVolume.blank(like)
        there = target.layout
        lines = voxel_rays(geometry, target.layout, shape)
        gpu.demand(
            lambda: gpu.spread_there(
                box_of(there), there.flat, lines, values, deterministic=deterministic
            )
        )
        return target  # type: ignore[return-value]  # arrays on a device have no type of their own
    layout = blank_layout(like, out)
    if len(geometry):
        views = voxel_rays(geometry, layout, shape)
        box = box_of(layout)
        clean = out is None
        done = False
        need = layout.flat.nbytes * (3 if deterministic else 1)
        if gpu.usable(need, values, cpu.threads()):
            if out is not None:
                out.fill(0)
            done = gpu.attempt(
                lambda: gpu.spread(
                    box, views, values, clean=out is None, deterministic=deterministic
                )
            )
            clean = False  # where that failed, something may have been written
        if not done:
            _spread(like, layout, geometry, values, clean=clean)
    elif out is not None:
        out.fill(0)
    return replace(like, data=layout_data(layout) if out is None else out)


def _spread(
    like: Volume, layout: Layout, geometry: ConeVec, values: Float32Array, *, clean: bool
) -> None:
    """Apply `back` on the processor, adding to a layout.

    Views with levels along x or y are summed in a volume of that order, which is added
    last.

    Args:
        like: place and size of the voxels.
        layout: of `like`, changed in place.
        geometry: n views.
        values: (n, rows, cols) images.
        clean: the layout holds zeros; otherwise anything, and is cleared first.
    """
    from flexdt.twin.projection.kernels import layout_kernels

    if clean:
        layout_kernels.touch(layout.flat)
    rooms: dict[Order, Float32Array] = {}
    for some, order, fans in by_level_axis(
        like, geometry, (values.shape[1], values.shape[2])
    ):
        turned = like.in_order(order)
        target = layout
        if order != ORDERS[0]:
            if order not in rooms:
                rooms[order] = room_like(turned)
            target = blank_layout(turned, rooms[order])
        views = voxel_rays(in_order(geometry[some], order), target, values.shape[1:])
        held = clean or target is not layout
        cpu.spread(box_of(target), views, values[some], clean=held, fans=fans)
        clean = clean or target is layout
    if not clean:
        layout_data(layout).fill(0.0)
    for order, room in rooms.items():
        data = room.transpose([2 - order.index(axis) for axis in (2, 1, 0)])
        bring_over(data, layout.flat, layout.stride_x, layout.stride_y, adding=True)


def corners_of(volume: Volume | DeviceVolume) -> FloatArray:
    """Compute the corners of a volume's box, (8, 3) [mm]."""
    half = 0.5 * np.array(volume.shape[::-1]) * volume.voxel_xyz
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    return np.asarray(volume.center_mm + signs * half)


def box_of(layout: Layout) -> Box:
    """Convert a layout to the kernels' `Box`, sharing its voxels."""
    return Box(
        layout.flat,
        layout.spans,
        layout.base,
        layout.stride_x,
        layout.stride_y,
        *layout.counts,
        *layout.voxel_mm,
    )


def layout_data(layout: Layout) -> Float32Array:
    """View the voxels of a layout's box as (nz, ny, nx), without a copy; writes go to the
    layout."""
    nx, ny, nz = layout.counts
    size = layout.flat.itemsize
    return np.lib.stride_tricks.as_strided(
        layout.flat[layout.base :],
        (nz, ny, nx),
        (size, layout.stride_y * size, layout.stride_x * size),
    )


def check_projections(projections: npt.ArrayLike, n: int) -> Any:
    """Convert projections to C-ordered float32 (n, rows, cols); those on a device stay there.

    Args:
        projections: an array of any library.
        n: number of views.

    Raises GeometryError: they are not `n` images, or on a device not float32 in C order.
    """
    if gpu.is_there(projections):
        values = gpu.taken(projections)
    else:
        values = np.ascontiguousarray(projections, dtype=np.float32)
    if values.ndim != 3 or len(values) != n or 0 in values.shape[1:]:
        wanted = (n, "rows", "cols")
        why = ", one for each row of cone_vec"
        raise GeometryError.of_shape("projections", values.shape, wanted, why)
    return values


def require_line_integrals(projections: Any) -> None:
    """Raise GeometryError for unsigned integers, which are a detector's counts; anything
    else passes.
    """
    kind = getattr(projections, "dtype", None)
    if kind is not None and kind.kind == "u":
        message = f"projections are {kind}, as a detector's counts are"
        wanted = "line integrals, as `line_integrals()` of a data set gives them"
        raise GeometryError.instead(
            message, str(kind), f"{wanted}, or floating-point numbers"
        )


def require_finite(values: Any) -> None:
    """Raise GeometryError for projections in memory that are not finite."""
    if not gpu.is_there(values) and not _are_finite(values):
        message = "projections hold values that are not finite"
        raise GeometryError.instead(message, "NaN or infinity", "finite line integrals")


def voxel_rays(cone_vec: ConeVec, layout: Layout, shape: Shape2) -> FloatArray:
    """Convert `ConeVec.rays` to voxel units. The unit is the voxel's edge along each axis, the
    origin the low corner of the occupied box."""
    rays = cone_vec.rays(shape)
    rays[:, 0:3] -= np.array(layout.low_mm)
    return np.ascontiguousarray(rays / np.tile(np.array(layout.voxel_mm), 4))


def _are_finite(values: npt.NDArray[Any]) -> bool:
    """Return whether all numbers are finite; C-ordered float32 numbers of at least
    `MIN_PARALLEL_BYTES` are checked on all cores, others by their sum (which must not
    overflow)."""
    if (
        values.nbytes < MIN_PARALLEL_BYTES
        or values.dtype != np.float32
        or not values.flags.c_contiguous
    ):
        return math.isfinite(float(values.sum()))
    from flexdt.twin.projection.kernels import layout_kernels

    return int(layout_kernels.unfit_parts(values.reshape(-1).view(np.uint32))) == 0


def as_cone_vec(cone_vec: ConeVec | npt.ArrayLike) -> ConeVec:
    """Return a ConeVec of a ConeVec or (n, 12) [mm]; each pixel must have its own ray.

    Raises GeometryError: a row does not; it is named.
    """
    if isinstance(cone_vec, ConeVec):
        given = cone_vec
    else:
        given = ConeVec(as_numbers("cone_vec", cone_vec))
    return check_spread(given)


def check_out(out: Float32Array | None, shape: tuple[int, int, int]) -> Float32Array:
    """Return `out` if it fits, or a new array if it is None.

    The new array is not initialized.

    Raises:
        GeometryError: out has another shape or type, is not C-ordered, or cannot be
            written.
    """
    if out is None:
        return np.empty(shape, np.float32)
    if (
        out.shape != shape
        or out.dtype != np.float32
        or not out.flags.c_contiguous
        or not out.flags.writeable
    ):
        given = f"{out.dtype} {shape_words(out.shape)}"
        raise GeometryError.instead(
            f"out is {given}", given, f"writeable C-ordered float32 {shape_words(shape)}"
        )
    return out


DERIVATIVE_COST = 4.0
"""Time of a ray whose derivatives are computed, as a multiple of that of its integral."""


def geometry_gradient(
    volume: Volume, cone_vec: ConeVec | npt.ArrayLike, weights: npt.ArrayLike
) -> FloatArray:
    """Compute the derivative of sum(weights * forward(volume, cone_vec)) by each row's
    numbers.

    With `weights` the derivative of a loss with respect to the projections, the result is
    the derivative of the loss with respect to the geometry.

    Args:
        volume: attenuation [1/mm].
        cone_vec: ConeVec or (n, 12) [mm], object frame.
        weights: (n, rows, cols), dimensionless.

    Returns:
        float64 (n, 12) [1/mm]: with respect to source, detector center, u and v of each
            view.

    Raises:
        GeometryError: shapes that do not fit, or a row that gives its pixels no rays of
            their own.

    Examples:
        A pixel that moves to the side makes the way through a cube of 2 mm longer, by
        0.02 / mm * 2 mm * tan / sqrt(1 + tan^2) / 4 mm with tan = 1 / 4:

        >>> cube = Volume(np.full((4, 4, 4), 0.02, np.float32), 0.5)
        >>> view = ConeVec.from_vectors((0, -2, 0.1), (1, 2, 0.1), (1, 0, 0), (0, 0, -1))
        >>> ones = np.ones((1, 1, 1), np.float32)
        >>> geometry_gradient(cube, view, ones)[0, 3:5].round(6).tolist()
        [0.002425, -0.000606]
    """
    from flexdt.twin.projection.kernels import siddon_kernels

    geometry = as_cone_vec(cone_vec)
    values = check_projections(weights, len(geometry))
    n, rows, cols = values.shape
    geometry.of_shape((rows, cols))
    times = stretches(geometry, corners_of(volume))
    geometry = stretched(geometry, times)
    tiles = -(-cols // TILE_COLUMNS)
    parts = np.zeros((n * tiles, 12))
    layout = volume.layout
    if not layout.empty and n:
        views = voxel_rays(geometry, layout, (rows, cols))
        box = box_of(layout)
        job_ns = DERIVATIVE_COST * cpu.tile_ns(box, rows)
        for first, last in equal_portions(len(parts), job_ns, cpu.threads()):
            siddon_kernels.gather(box, views, values, TILE_COLUMNS, parts, first, last)
    return relaxed_gradient(parts.reshape(n, tiles, 12).sum(axis=1), times)


def geometry_change(
    volume: Volume,
    cone_vec: ConeVec | npt.ArrayLike,
    change: npt.ArrayLike,
    shape: Shape2 | None = None,
) -> Float32Array:
    """Compute the derivative of projections along a geometry change: a column of the
    Jacobian.

    To first order, forward(volume, rows + step * change) = forward(volume, rows) + step *
    result.

    Args:
        volume: attenuation [1/mm].
        cone_vec: ConeVec or (n, 12) [mm], object frame.
        change: (n, 12) or (12,): change of each row for a unit of the parameter [mm].
        shape: detector (rows, cols); by default the geometry's own.

    Returns:
        float32 (n, rows, cols), for each unit of the parameter.

    Raises:
        GeometryError: shapes that do not fit, or a row that gives its pixels no rays of
            their own.

    Example:
        >>> from flexdt.twin.geometry.cone_vec import ConeVec
        >>> view = ConeVec.from_vectors((0, -500, 0), (0, 500, 0), (1, 0, 0), (0, 0, -1))
        >>> volume = Volume(np.full((3, 4, 3), 0.02, np.float32), 0.5)
        >>> geometry_change(volume, view, np.ones((1, 12)), (1, 1)).shape
        (1, 1, 1)
    """
    from flexdt.twin.projection.kernels import siddon_kernels

    geometry = as_cone_vec(cone_vec)
    moved = np.asarray(change, dtype=np.float64)
    if moved.shape not in ((12,), (len(geometry), 12)):
        wanted = (len(geometry), 12)
        raise GeometryError.of_shape(
            "the geometry's change", moved.shape, wanted, " or 12"
        )
    shape = geometry.of_shape(shape)
    result = np.zeros((len(geometry), *shape), np.float32)
    times = stretches(geometry, corners_of(volume))
    geometry = stretched(geometry, times)
    layout = volume.layout
    if not layout.empty and len(geometry):
        views = voxel_rays(geometry, layout, shape)
        each = np.broadcast_to(moved, (len(geometry), 12))
        steps = np.ascontiguousarray(stretched_steps(each, times))
        box = box_of(layout)
        jobs = len(geometry) * -(-shape[1] // TILE_COLUMNS)
        job_ns = DERIVATIVE_COST * cpu.tile_ns(box, shape[0])
        for first, last in equal_portions(jobs, job_ns, cpu.threads()):
            siddon_kernels.follow(box, views, steps, TILE_COLUMNS, result, first, last)
    return result
