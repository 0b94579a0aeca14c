"""The adjoint's order of work: who writes at the same time never meets, memory may be
reused."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, cpu, forward, room_like
from flexdt.twin.projection.cpu import exchanged, lying
from flexdt.twin.projection.fan_plan import plan_fans, plan_turns
from flexdt.twin.projection.kernels import fan_kernels
from flexdt.twin.projection.operators import box_of, voxel_rays
from flexdt.twin.projection.volume import blank_layout

pytestmark = pytest.mark.usefixtures("on_processor")

SHAPE = (9, 170)
GRID = Volume(np.zeros((6, 90, 110), np.float32), (0.1, 0.12, 0.1))
GEOMETRIES = {
    "level": ((3, 60.0, 90.0, 0.14), {}),
    "tilted": ((3, 60.0, 90.0, 0.14), {"roll": 0.05, "pitch_tilt": 0.04, "yaw": 0.1}),
    "on its side": ((3, 60.0, 90.0, 0.14), {"roll": np.pi / 2}),
    "on its side, tilted": (
        (3, 60.0, 90.0, 0.14),
        {"roll": 1.5, "pitch_tilt": 0.04, "yaw": 0.1},
    ),
    "fine pixels": ((2, 60.0, 90.0, 0.05), {"roll": 0.01}),
    "close": ((2, 9.0, 30.0, 0.4), {"roll": 0.01}),
    "very close": ((2, 5.6, 30.0, 0.6), {}),
}


def shape_of(name: str) -> tuple[int, int]:
    """Detectors as wide as the volume, whichever side is up."""
    return SHAPE[::-1] if "side" in name else SHAPE


def planned(geometry: ConeVec, shape: tuple[int, int], workers: int):
    layout = blank_layout(GRID)
    box, views = box_of(layout), voxel_rays(geometry, layout, shape)
    if lying(views, shape).all():
        views, shape = exchanged(views), shape[::-1]
    counts = (box.nx, box.ny, box.nz)
    plan = plan_fans(views, counts, shape)
    return box, views, shape, plan, plan_turns(plan, views, counts, shape, workers)


@pytest.mark.parametrize("name", GEOMETRIES)
@pytest.mark.parametrize("workers", [1, 2, 16])
def test_every_job_is_done_once_and_units_at_work_share_no_voxel_column(
    name, workers, circle
) -> None:
    args, options = GEOMETRIES[name]
    box, views, shape, plan, turns = planned(
        circle(*args, **options), shape_of(name), workers
    )
    jobs = [job for a, b in turns.units.tolist() for job in range(a, b)]
    assert sorted(jobs) == list(range(len(plan.jobs)))
    units = [unit for a, b in turns.turns.tolist() for unit in range(a, b)]
    assert units == list(range(len(turns.units)))
    slices = cpu.z_slices(box.nz, 1)
    shadows = cpu.box_shadows(box, views, (0, box.nz), shape)[None]
    values = np.ones((len(views), *shape), np.float32)
    for a, b in turns.turns.tolist():
        written = np.zeros(2 * box.nx * box.ny, np.int64)
        for unit in range(a, b):
            # A column must be marked before it may be written: the marks are what is touched.
            marks = np.zeros((1, 2 * box.nx * box.ny), np.int32)
            fan_kernels.spread_fans(
                box, plan.fans(views), np.array([[0, 1]]), turns.units[unit : unit + 1], slices,
                shadows, marks, 1, values,
            )  # fmt: skip
            written += marks[0]
        assert written.max() <= 1
        assert written.any()


def test_wide_views_are_shared_out_by_units_and_narrow_ones_by_height(circle) -> None:
    for name in ("level", "tilted", "on its side", "on its side, tilted", "very close"):
        several = name != "very close"
        args, options = GEOMETRIES[name]
        *_, turns = planned(circle(*args, **options), shape_of(name), 2)
        assert (len(turns.units) > len(turns.turns)) is several
        assert turns.slices == (1 if several else 2)
    args, options = GEOMETRIES["level"]
    assert planned(circle(*args, **options), SHAPE, 16)[-1].slices > 1


END_ON = ConeVec.from_vectors((0, 0, -10), (0, 0, 10), (0.1, 0, 0), (0, 0.1, 0))
"""Rays that travel alone."""
INSIDE = ConeVec.from_vectors(
    (0.2, -0.3, 0.1), (0, 9, 0), (0.1, 0, 0.01), (0.02, 0, -0.1)
)
"""The source inside the volume: fans whose rays go one by one."""


@pytest.mark.parametrize("name", [*GEOMETRIES, "end on", "inside"])
def test_back_into_old_memory_gives_the_same(name, circle) -> None:
    if name in GEOMETRIES:
        args, options = GEOMETRIES[name]
        geometry = circle(*args, **options)
    else:
        geometry = {"end on": END_ON, "inside": INSIDE}[name]
    shape = shape_of(name)
    y = np.random.default_rng(1).random((len(geometry), *shape), dtype=np.float32)
    new = back(y, geometry, GRID).data
    assert new.any()
    out = room_like(GRID)
    out[...] = np.nan
    again = back(y, geometry, GRID, out)
    assert np.shares_memory(again.data, out)
    np.testing.assert_array_equal(again.data, new)
    back(np.zeros((0, *shape)), ConeVec(np.zeros((0, 12))), GRID, out)
    assert not out.any()


@pytest.mark.skipif(
    numba.get_num_threads() < 2, reason="one core: there is no other number"
)
def test_the_number_of_threads_does_not_matter(circle) -> None:
    before = numba.get_num_threads()
    volume = Volume(
        np.random.default_rng(2).random(GRID.shape, dtype=np.float32), GRID.voxel_mm
    )
    for name in ("level", "tilted"):
        args, options = GEOMETRIES[name]
        geometry = circle(*args, **options)
        y = np.random.default_rng(1).random((len(geometry), *SHAPE), dtype=np.float32)
        results = []
        for count in range(1, before + 1):
            numba.set_num_threads(count)
            try:
                results.append(back(y, geometry, GRID).data)
            finally:
                numba.set_num_threads(before)
        for other in results[1:]:
            assert np.abs(other - results[0]).max() < 1e-6 * results[0].max()
        left = np.vdot(forward(volume, geometry, SHAPE).astype(np.float64), y)
        right = np.vdot(results[-1].astype(np.float64), volume.data)
        assert abs(left - right) < 1e-7 * left


def test_room_of_another_kind_is_refused(circle) -> None:
    y, geometry = np.ones((1, *SHAPE), np.float32), circle(1, 60.0, 90.0, 0.14)
    room = room_like(GRID)
    frozen = room.view()
    frozen.setflags(write=False)
    for bad in (
        np.zeros(GRID.shape, np.float32),
        room[:-1],
        room[:, ::-1],
        room[:, :, ::2],
        frozen,
    ):
        with pytest.raises(GeometryError, match="room_like"):
            back(y, geometry, GRID, bad)
