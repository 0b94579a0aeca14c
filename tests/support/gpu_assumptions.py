"""What the text at the head of `gpu_kernels` and of `gpu` claims, one function for each claim.

Runs in numba's simulator, with warps that vote: `python tests/support/gpu_assumptions.py`
prints for each claim what was found wrong, or null.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

os.environ["NUMBA_ENABLE_CUDASIM"] = "1"

import numpy as np
from exact_rays import ray_ends
from numba import cuda

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, gpu
from flexdt.twin.projection.kernels import gpu_kernels as kernels
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.projection.volume import blank_layout
from tests.studies.gpu_geometries import drawn_case, drawn_view, measure
from tests.support.device_simulator import as_on_a_device

CROSSING = Fraction(1, 100_000)
"""Slabs by which a crossing may be off."""
Draw = np.random.Generator
CLAIMS: list[Callable[[Draw], None]] = []


def claim(check: Callable[[Draw], None]) -> Callable[[Draw], None]:
    """Register a claim by its function."""
    CLAIMS.append(check)
    return check


def lines(draw: Draw, count: int) -> Any:
    """Start at slab 0, slope, slabs and voxels across of drawn lines that meet their box."""
    for _ in range(count):
        slabs, across = (int(n) for n in draw.integers(2, gpu.MAX_SIDE_VOXELS, 2))
        slope = float(draw.choice([1.0, draw.uniform(0, 1), 10 ** draw.uniform(-7, 0)]))
        slab = draw.uniform(0, slabs)
        yield draw.uniform(0, across) - slab * slope, slope, slabs, across


@claim
def no_rounding_adds_up_in_fixed_point(draw: Draw) -> None:
    """A line in fixed point stays within 2^-44 plus 2^-45 a slab of the exact one, and 63
    bits hold it.
    """
    for start, slope, slabs, across in lines(draw, 300):
        position, rate, *_ = kernels.fixed_line.fn(start, slope, across)
        for k in (0, 1, slabs // 2, slabs):
            found = Fraction(int(position) + k * int(rate), 2**kernels.FIXED_BITS)
            off = abs(found - Fraction(start) - k * Fraction(slope))
            assert off <= Fraction(1, 2**44) + k * Fraction(1, 2**45), (
                start,
                slope,
                k,
                float(off),
            )
        assert abs(int(position)) + gpu.MAX_SIDE_VOXELS * int(rate) < 2**63


@claim
def a_slope_rounds_to_6e_11_voxels_after_2000_slabs(draw: Draw) -> None:
    for slope in draw.uniform(0, 1, 300):
        _, rate, *_ = kernels.fixed_line.fn(0.0, float(slope), 10)
        assert (
            2000 * abs(Fraction(int(rate), 2**kernels.FIXED_BITS) - Fraction(slope))
            < 6e-11
        )


@claim
def a_crossing_is_off_by_1e_5_slabs_whatever_the_slope(draw: Draw) -> None:
    """The row and the share before a crossing are those of exact fractions, within
    CROSSING.

    Crossings within CROSSING of a slab's end are not judged: they may fall on either
    side.
    """
    crossed = 0
    for start, slope, slabs, across in lines(draw, 70):
        position, rate, slope_32, steps, *_ = kernels.fixed_line.fn(start, slope, across)
        if rate == 0:
            continue
        begin = int(draw.integers(0, slabs)) & -kernels.ANCHOR_SLABS
        plane, distance = kernels.anchor.fn(position, rate, begin)
        for k in range(kernels.ANCHOR_SLABS):
            t = np.float32(k + 1)
            bits, share = kernels.crossing.fn(t, slope_32, distance, steps)
            before, after = (
                Fraction(start) + (begin + j) * Fraction(slope) for j in (k, k + 1)
            )
            behind = (after - math.floor(after)) / Fraction(slope)
            ahead = (math.floor(after) + 1 - after) / Fraction(slope)
            if min(behind, ahead) <= CROSSING:
                continue  # at the slab's end, either side
            assert kernels.narrow(bits + plane) == math.floor(after), (
                start,
                slope,
                begin + k,
            )
            if math.floor(before) != math.floor(after):
                crossed += 1
            assert abs(Fraction(float(share)) - min(behind, 1)) <= CROSSING, (
                start,
                slope,
                k,
            )
    assert crossed > 100, crossed


@claim
def a_ray_enters_and_leaves_within_the_margin(draw: Draw) -> None:
    """Where a ray enters and leaves the box is off by less than half of MARGIN."""
    for start, slope, slabs, across in lines(draw, 700):
        found = kernels.fixed_line.fn(start, slope, across)
        if found[1] == 0:
            continue
        exact = [
            -Fraction(start) / Fraction(slope),
            (across - Fraction(start)) / Fraction(slope),
        ]
        for place, wanted in zip(found[4:], exact, strict=True):
            if 0 <= wanted <= slabs:
                off = abs(Fraction(float(place)) - wanted)
                assert off < Fraction(float(kernels.MARGIN_SLABS)) / 2, (
                    start,
                    slope,
                    float(off),
                )


@claim
def floor_is_in_the_lowest_bits_of_a_sum_that_is_rounded_down(draw: Draw) -> None:
    """The lowest bits of a number added to MAGIC are its floor, within 2^22 of zero."""
    edge = 2**22 - 1
    for n in (-edge, -1, 0, 1, edge, *draw.integers(-edge, edge, 100).tolist()):
        # Between 2^23 and 2^24 single precision holds the integers and nothing between.
        moved = np.float32(float(kernels.MAGIC) + n)
        assert float(moved) == float(kernels.MAGIC) + n
        assert float(np.nextafter(moved, np.float32(np.inf))) == float(moved) + 1
        assert int(moved.view(np.int32)) == kernels.MAGIC_BITS + n
        y = np.float32(n + draw.uniform(0, 1) * (abs(n) < 2**20))
        assert kernels.floor_bits(y) == (
            math.floor(y),
            kernels.MAGIC_BITS + math.floor(y),
        )


@claim
def all_lanes_of_a_warp_get_its_least_and_its_most(draw: Draw) -> None:
    """`least` and `most` give every lane of a warp the warp's extremes."""

    @cuda.jit
    def vote(values, found):
        x, y = cuda.threadIdx.x, cuda.threadIdx.y
        found[0, y, x] = kernels.least(values[y, x])
        found[1, y, x] = kernels.most(values[y, x])

    values = draw.integers(-(2**30), 2**30, (4, 32)).astype(np.int64)
    found = np.zeros((2, 4, 32), np.int64)
    vote[(1, 1), (32, 4)](values, found)
    assert (found[0] == values.min(axis=1, keepdims=True)).all()
    assert (found[1] == values.max(axis=1, keepdims=True)).all()


def drawn_views(draw: Draw) -> Any:
    """Draw views with the box they see, 15 of each kind.

    Yields:
        The box, the rays in voxels, and the detector's rows and columns.
    """
    for kind in (
        "diagonal",
        "level",
        "rolled",
        "turned",
        "pixels inside",
        "source inside",
        "steep",
    ):
        for _ in range(15):
            counts = draw.integers(1, 30, 3)
            volume = Volume(
                np.ones(counts[::-1], np.float32), tuple(draw.uniform(0.3, 1, 3))
            )
            layout, shape = blank_layout(volume), tuple(draw.integers(1, 12, 2).tolist())
            radius = float(np.linalg.norm(counts * volume.voxel_xyz)) / 2
            row = drawn_view(draw, kind, radius, shape)
            yield box_of(layout), voxel_rays(ConeVec(row[None]), layout, shape), shape


@claim
def rays_by_slabs_rise_one_voxel_a_slab_and_cross_the_whole_box(draw: Draw) -> None:
    """Views that `by_slabs` takes have rays that rise at most a voxel a slab and end
    outside the box.
    """
    taken = 0
    for box, rays, shape in drawn_views(draw):
        if not gpu.by_slabs(box, rays, shape)[0]:
            continue
        taken += 1
        source, first, u, v = rays[0].reshape(4, 3)
        c, r = np.meshgrid(np.arange(shape[1]), np.arange(shape[0]))
        way = first + c[..., None] * u + r[..., None] * v
        faster = np.abs(way[..., :2]).max(axis=2)
        assert (np.abs(way[..., 2]) <= faster).all()
        counts = np.array([box.nx, box.ny, box.nz])
        with np.errstate(divide="ignore"):
            ends = np.sort(np.stack([-source / way, (counts - source) / way]), axis=0)
        enter, leave = ends[0].max(axis=2), ends[1].min(axis=2)
        meets = enter < leave
        assert (enter[meets] > 0).all()
        assert (leave[meets] < 1).all()
    assert taken > 25, taken


@claim
def lanes_of_both_axes_keep_to_their_own_slabs(draw: Draw) -> None:
    """A warp whose rays go along both axes projects as exactly as others, in four drawn
    cases.
    """
    mixed = 0
    while mixed < 4:
        case = drawn_case(draw, "diagonal", 9)
        counts, rows = case.counts, case.rows[:1].copy()
        counts[:2] = draw.permutation([3, 9])
        # One warp: a column of few pixels, from one corner of the detector to the other.
        shape = (int(draw.integers(8, 33)), 1)
        rows[0, 9:12] *= case.shape[0] / shape[0]
        data, values = (
            draw.random(some, dtype=np.float32) for some in (counts[::-1], (1, *shape))
        )
        case = replace(case, rows=rows, shape=shape, data=data, values=values)
        start, end = ray_ends(rows, shape)
        way = np.abs((end - start) / case.voxel_mm)
        if 0 < (way[:, 1] > way[:, 0]).sum() < len(way):
            seen = measure(case, twice=False)
            mixed += seen.by_slabs
            assert not seen.wrong, seen


@claim
def lanes_beyond_the_detector_write_nothing(draw: Draw) -> None:
    """Numbers behind the images stay as they were, and all pixels are written."""
    volume = Volume(draw.random((3, 4, 5), dtype=np.float32), 1.0)
    layout, shape = volume.layout, (5, 3)
    view = ConeVec.from_vectors((0.1, -50, 0.2), (0, 50, 0), (1.1, 0, 0), (0, 0, -1.2))
    rays = voxel_rays(view, layout, shape)
    assert gpu.by_slabs(box_of(layout), rays, shape).all()
    room = gpu.upload(np.full(15 + 200, 7, np.float32))
    gpu.launcher(
        box_of(layout), gpu.upload(layout.flat), rays, room, shape, transposed=False
    )()
    images = room.copy_to_host()
    assert (images[15:] == 7).all()
    assert (images[:15] != 7).all()


@claim
def a_ray_in_a_plane_belongs_above_or_below_where_it_moves_down(draw: Draw) -> None:
    """A ray in the plane between two layers counts in the upper one unless it moves down."""
    volume = Volume(np.array([[[1]], [[2]]], np.float32), 1.0)
    for rise, wanted in ((0.0, 2.0), (1e-17, 2.0), (-1e-17, 1.0)):
        # One row: its pixel is at the detector's centre, the source's height or nearly.
        view = ConeVec.from_vectors((0, -50, 0), (0, 50, rise), (1, 0, 0), (0, 0, -1))
        rays = voxel_rays(view, volume.layout, (1, 1))
        rays[:, 5] = rise
        out = np.zeros((1, 1, 1), np.float32)
        box = box_of(volume.layout)
        assert gpu.by_slabs(box, rays, (1, 1)).all()
        gpu.project(box, gpu.upload(volume.layout.flat), rays, out)
        assert abs(out[0, 0, 0] - wanted) < 1e-5, (rise, out)


@claim
def integers_of_a_deterministic_sum_stay_below_2_to_the_62(draw: Draw) -> None:
    """`whole_factor` is a power of two that brings the largest sum between 2^60 and 2^62."""
    box = box_of(Volume(np.ones((2, 2, 2), np.float32), (0.3, 2.0, 0.7)).layout)
    for size in (1, 7, 4000):
        values = (10 ** draw.uniform(-20, 20) * draw.uniform(-1, 1, size)).astype(
            np.float32
        )
        factor = gpu.whole_factor(box, values)
        assert math.frexp(factor)[0] == 0.5
        most = float(np.abs(values).max()) * math.hypot(0.3, 2.0, 0.7) * size
        assert 2.0**60 < factor * most <= 2.0**62


def main() -> None:
    """Check every claim and print a JSON object: what is wrong by its name, null where it
    holds.
    """
    as_on_a_device()
    found: dict[str, str | None] = {}
    for number, check in enumerate(CLAIMS):
        try:
            check(np.random.default_rng([20261127, number]))
            found[check.__name__] = None
        except Exception as error:
            found[check.__name__] = f"{type(error).__name__}: {error}"
    json.dump(found, sys.stdout)


if __name__ == "__main__":
    main()
