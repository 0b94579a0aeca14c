"""Cases nobody tuned for: each against the double-precision reference, and forward against
back."""

from __future__ import annotations

import numba
import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, forward, room_like
from flexdt.twin.projection import cpu as sides
from flexdt.twin.projection.cpu import exchanged, lying, runs
from flexdt.twin.projection.fan_plan import plan_fans
from flexdt.twin.projection.operators import voxel_rays

WORST = 5e-6
SHAPE = (41, 37)


def random(shape, seed=0):
    return np.random.default_rng(seed).random(shape, dtype=np.float32)


# name: data shape, voxel, centre, circle arguments (n, sod, sdd, pitch, ...)
CASES = {
    "60 degree cone": ((30, 40, 36), 0.1, (0, 0, 0), (3, 4.5, 9.0, 0.25), {"start": 0.1}),
    "60 degree cone, tilted": (
        (30, 40, 36),
        0.1,
        (0, 0, 0),
        (3, 4.5, 9.0, 0.25),
        {"start": 0.1, "roll": 0.1, "pitch_tilt": 0.2, "yaw": -0.2},
    ),
    "45 degree tilts": (
        (30, 40, 36),
        0.1,
        (0, 0, 0),
        (3, 20.0, 40.0, 0.3),
        {"roll": 0.785, "pitch_tilt": 0.785, "yaw": 0.785},
    ),
    "rolled a quarter turn": (
        (30, 40, 36),
        0.1,
        (0, 0, 0),
        (2, 20.0, 40.0, 0.3),
        {"roll": 1.5708},
    ),
    "1 mm from the volume": (
        (20, 24, 22),
        0.5,
        (0, 0, 0),
        (3, 8.2, 40.0, 3.0),
        {"start": 0.05},
    ),
    "1 mm from the volume, tilted": (
        (20, 24, 22),
        0.5,
        (0, 0, 0),
        (3, 8.2, 40.0, 3.0),
        {"start": 0.05, "roll": 0.02},
    ),
    "flat in z": (
        (1, 50, 60),
        0.1,
        (0, 0, 0.013),
        (3, 20.0, 40.0, 0.3),
        {"roll": 0.01, "height": 9.0},
    ),
    # Lines through 500 voxels of which a ray meets 20: digits must not drown in the rest.
    "flat and large": (
        (2, 500, 500),
        0.1,
        (0, 0, 0.013),
        (1, 300.0, 500.0, 2.0),
        {"roll": 0.01, "height": 30.0, "start": 0.2},
    ),
    "flat in x": ((50, 60, 1), 0.1, (0.013, 0, 0), (5, 20.0, 40.0, 0.3), {"roll": 0.01}),
    "long in z": (
        (300, 3, 4),
        0.1,
        (0, 0, 0),
        (2, 20.0, 40.0, 0.3),
        {"roll": 0.02, "start": 0.3},
    ),
    "long in y": (
        (4, 200, 3),
        0.1,
        (0, 0, 0),
        (3, 20.0, 40.0, 0.1),
        {"roll": 0.02, "start": 0.01},
    ),
    "pixels finer than voxels": (
        (20, 20, 20),
        0.4,
        (0, 0, 0),
        (2, 20.0, 40.0, 0.05),
        {"roll": 0.01, "pitch_tilt": 0.02, "start": 0.2},
    ),
    "pixels coarser than voxels": (
        (60, 50, 40),
        0.05,
        (0, 0, 0),
        (2, 20.0, 40.0, 0.4),
        {"roll": 0.01, "pitch_tilt": 0.02, "start": 0.2},
    ),
    "voxels 1 : 5 : 0.3": (
        (60, 12, 40),
        (0.1, 0.5, 0.03),
        (0.1, 0, -0.2),
        (3, 20.0, 40.0, 0.2),
        {"roll": 0.03, "start": 0.2},
    ),
    "nearly along an axis": (
        (20, 40, 36),
        0.1,
        (0.013, 0.02, 0),
        (4, 400.0, 800.0, 0.2),
        {"roll": 0.007, "start": 1e-5},
    ),
    "source far above": (
        (20, 30, 30),
        0.1,
        (0.013, 0.02, 0),
        (2, 20.0, 40.0, 0.3),
        {"height": 15.0},
    ),
}


def build(name, circle):
    shape, voxel, center, args, options = CASES[name]
    return Volume(random(shape), voxel, center), circle(*args, **options)


@pytest.mark.daily(11)
@pytest.mark.parametrize("walk", [0, 1, 2, 3], indirect=True)
@pytest.mark.parametrize("name", CASES)
def test_hard_cases_are_exact_forward_and_back(name, siddon, circle) -> None:
    volume, geometry = build(name, circle)
    got = forward(volume, geometry, SHAPE)
    pixels = [(r, c) for r in range(0, SHAPE[0], 3) for c in range(r % 2, SHAPE[1], 2)]
    exact = siddon(
        volume.data, volume.voxel_xyz, volume.center_mm, geometry, SHAPE, pixels
    )
    chosen = got[:, [r for r, _ in pixels], [c for _, c in pixels]]
    assert (exact > 0).sum() > 20
    assert np.abs(chosen - exact).max() < WORST * exact.max()
    y = random(got.shape, 1)
    left = np.vdot(got.astype(np.float64), y)
    right = np.vdot(back(y, geometry, volume).data.astype(np.float64), volume.data)
    assert abs(left - right) < 1e-5 * left


OTHER_TILTS = [
    {},
    {"pitch_tilt": 0.012, "yaw": 0.005},
    {"pitch_tilt": 0.4, "yaw": -0.3, "height": 2},
]


@pytest.mark.parametrize("tilt", OTHER_TILTS)
@pytest.mark.parametrize("degrees", [60, 89.9, 90, 135, 180, 270])
def test_rolled_detectors_are_exact_forward_and_back(
    degrees, tilt, siddon, circle
) -> None:
    volume = Volume(random((31, 23, 18)), (0.1, 0.17, 0.06), (0.12, -0.07, 0.31))
    geometry = circle(3, 20.0, 40.0, 0.23, start=0.3, roll=np.radians(degrees), **tilt)
    got = forward(volume, geometry, SHAPE)
    pixels = [(r, c) for r in range(0, SHAPE[0], 3) for c in range(r % 2, SHAPE[1], 2)]
    exact = siddon(
        volume.data, volume.voxel_xyz, volume.center_mm, geometry, SHAPE, pixels
    )
    chosen = got[:, [r for r, _ in pixels], [c for _, c in pixels]]
    assert np.abs(chosen - exact).max() < 3e-6 * exact.max()
    y = random(got.shape, 1)
    left = np.vdot(got.astype(np.float64), y)
    right = np.vdot(back(y, geometry, volume).data.astype(np.float64), volume.data)
    assert abs(left - right) < 1e-6 * left


@pytest.mark.parametrize("tilt", OTHER_TILTS)
def test_rays_travel_in_fans_whatever_the_roll(tilt, circle) -> None:
    volume = Volume(random((31, 23, 18)), 0.1)
    for degrees in np.arange(0, 360.1, 7.5):
        geometry = circle(
            3, 60.0, 100.0, 0.23, start=0.3, roll=np.radians(degrees), **tilt
        )
        views = voxel_rays(geometry, volume.layout, SHAPE)
        for some, turned in runs(views, SHAPE):
            plan = (
                plan_fans(exchanged(views[some]), volume.layout.counts, SHAPE[::-1])
                if turned
                else plan_fans(views[some], volume.layout.counts, SHAPE)
            )
            assert plan.alone.tolist() == [], degrees
            # On its side, columns are taken for rows.
            if abs(abs(np.sin(np.radians(degrees))) - np.sqrt(0.5)) > 0.15:
                assert turned == (abs(np.sin(np.radians(degrees))) > np.sqrt(0.5)), (
                    degrees
                )


@pytest.mark.usefixtures("on_processor")
def test_views_on_either_side_in_one_call_equal_single_calls(circle, monkeypatch) -> None:
    volume = Volume(random((31, 23, 18)), 0.1)
    parts = [
        circle(2, 20.0, 40.0, 0.23, start=0.3, roll=np.radians(degrees)).rows
        for degrees in (0, 90, 20, 100, 80)
    ]
    geometry = ConeVec(np.concatenate(parts))
    monkeypatch.setattr(
        sides, "MAX_TRANSPOSED_BYTES", 3 * 4 * SHAPE[0] * SHAPE[1]
    )  # three images at a time
    found = list(runs(voxel_rays(geometry, volume.layout, SHAPE), SHAPE))
    assert [(some.start, some.stop, turned) for some, turned in found] == [
        (0, 2, False), (2, 4, True), (4, 6, False), (6, 9, True), (9, 10, True),
    ]  # fmt: skip
    images = forward(volume, geometry, SHAPE)
    for i in range(len(geometry)):
        assert np.array_equal(images[i], forward(volume, geometry[i], SHAPE)[0])
    y = random(images.shape, 1)
    out = room_like(volume)
    out[...] = np.nan
    together = back(y, geometry, volume, out).data
    one_by_one = sum(
        back(y[i : i + 1], geometry[i], volume).data.astype(np.float64)
        for i in range(len(y))
    )
    np.testing.assert_allclose(together, one_by_one, rtol=0, atol=2e-6 * one_by_one.max())


def test_a_level_detector_on_its_side_gives_the_turned_image(circle) -> None:
    # Exactly level: every row is a fan, and the image is that of the upright detector, turned.
    volume = Volume(random((31, 23, 18)), 0.1)
    upright = circle(3, 20.0, 40.0, 0.23, start=0.3)
    on_side = ConeVec.from_vectors(
        upright.source, upright.detector, upright.v, -upright.u
    )
    views = voxel_rays(on_side, volume.layout, SHAPE)
    assert lying(views, SHAPE).all()
    plan = plan_fans(exchanged(views), volume.layout.counts, SHAPE[::-1])
    assert not plan.lines[:, 1].any()
    image = forward(volume, on_side, SHAPE)
    again = forward(volume, upright, SHAPE[::-1])
    # First in rounding only: pixels are counted from another corner.
    assert np.allclose(
        image, again[:, :, ::-1].transpose(0, 2, 1), atol=1e-6 * again.max()
    )


@pytest.mark.parametrize("source", [(0.02, -0.5, 0.1), (0.3, 0.2, -0.4)])
def test_source_inside_the_volume(source, siddon) -> None:
    volume = Volume(random((20, 22, 24)), 0.1)
    geometry = ConeVec.from_vectors(source, (0, 9, 0), (0.3, 0, 0.01), (0.02, 0, -0.3))
    got = forward(volume, geometry, SHAPE)
    pixels = [(r, c) for r in range(0, 41, 4) for c in range(0, 37, 3)]
    exact = siddon(volume.data, (0.1,) * 3, (0, 0, 0), geometry, SHAPE, pixels)
    assert (
        np.abs(got[0, [p[0] for p in pixels], [p[1] for p in pixels]] - exact).max()
        < 1e-5
    )


def test_z_seen_end_on_travels_alone_and_is_exact(siddon) -> None:
    volume = Volume(random((20, 22, 24)), 0.1)
    geometry = ConeVec.from_vectors(
        (0.03, 0.02, 9), (0, 0, -9), (0.2, 0.01, 0), (0, 0.2, 0.01)
    )
    plan = plan_fans(
        voxel_rays(geometry, volume.layout, SHAPE), volume.layout.counts, SHAPE
    )
    assert plan.alone.tolist() == [0]
    assert len(plan.jobs) == 0
    got = forward(volume, geometry, SHAPE)
    pixels = [(r, c) for r in range(0, 41, 4) for c in range(0, 37, 3)]
    exact = siddon(volume.data, (0.1,) * 3, (0, 0, 0), geometry, SHAPE, pixels)
    assert (
        np.abs(got[0, [p[0] for p in pixels], [p[1] for p in pixels]] - exact).max()
        < 1e-5
    )


@pytest.mark.parametrize(
    "name",
    ["60 degree cone, tilted", "45 degree tilts", "long in y", "rolled a quarter turn"],
)
def test_fans_cover_every_pixel_once(name, circle) -> None:
    volume, geometry = build(name, circle)
    views, shape = voxel_rays(geometry, volume.layout, SHAPE), SHAPE
    if lying(views, shape).all():
        views, shape = exchanged(views), SHAPE[::-1]
    plan = plan_fans(views, volume.layout.counts, shape)
    covered = np.zeros((len(geometry), *shape), int)
    for view, first, last in plan.jobs:
        for line in range(first, last):
            for r, row in enumerate(covered[view]):
                a, b = (int(np.ceil(plan.lines[i] @ [1, r])) for i in (line, line + 1))
                row[max(a, 0) : max(b, 0)] += 1
    covered[plan.alone] += 1
    assert (covered == 1).all()


@pytest.mark.usefixtures("on_processor")
def test_a_thousand_views_in_one_call_equal_single_calls(circle) -> None:
    volume = Volume(random((9, 10, 11)), 0.1)
    geometry = circle(1000, 20.0, 40.0, 0.2, roll=0.01, start=0.001)
    many = forward(volume, geometry, (8, 9))
    for i in (0, 1, 250, 333, 999):
        assert np.array_equal(many[i], forward(volume, geometry[i], (8, 9))[0])


@pytest.mark.skipif(
    numba.get_num_threads() < 2, reason="one core: there is no other number"
)
@pytest.mark.usefixtures("on_processor")
def test_result_does_not_depend_on_the_number_of_threads(circle) -> None:
    volume, geometry = build("60 degree cone, tilted", circle)
    before = numba.get_num_threads()
    many = forward(volume, geometry, SHAPE)
    try:
        numba.set_num_threads(1)
        assert np.array_equal(many, forward(volume, geometry, SHAPE))
    finally:
        numba.set_num_threads(before)


def test_a_ray_in_voxel_planes_takes_a_neighbour(circle) -> None:
    # Even counts, odd detector, source on the axis: the central ray lies in three voxel planes.
    data = np.zeros((2, 4, 2), np.float32)
    data[0, :, 0], data[0, :, 1], data[1, :, 0], data[1, :, 1] = 1, 2, 4, 8
    exactly = forward(Volume(data, 1.0), circle(1, 50.0, 100.0, 0.5), (3, 3))[0, 1, 1]
    assert min(abs(exactly - 4 * a) for a in (1, 2, 4, 8)) < 1e-4
    # Turned, rounding lets it change sides on the way, but no more than that.
    for start in (np.pi / 2, np.pi, 3 * np.pi / 2):
        value = forward(
            Volume(data, 1.0), circle(1, 50.0, 100.0, 0.5, start=start), (3, 3)
        )
        assert 4 * 1 - 1e-4 < value[0, 1, 1] < 4 * 8 + 1e-4


AXES = {"x, y, z": (0, 1, 2), "y, z, x": (1, 2, 0), "z, x, y": (2, 0, 1)}


@pytest.mark.daily(12)
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("axes", AXES)
def test_a_sheet_of_rays_in_a_voxel_plane_stays_between_its_neighbours(
    axes, seed
) -> None:
    """The detector is turned about its normal; where rays lie in a plane between voxels,
    rounding decides the side, slab by slab at worst: never less than the lesser
    neighbours all the way.
    """
    draw = np.random.default_rng(seed)
    order = list(AXES[axes])
    n = 2 * int(draw.integers(20, 130))
    voxel = float(draw.choice([0.1, 0.25, 1.0]))
    data = draw.random((n, 24, n), dtype=np.float32)
    roll = np.radians(draw.choice([0, 45, -45, 90, 135, 30]))
    u, v = (
        np.array([np.cos(roll), 0, np.sin(roll)]),
        np.array([np.sin(roll), 0, -np.cos(roll)]),
    )
    size = n * voxel
    # The sheet lies in the plane x = 0 between the two middle voxels.
    rows = np.array([[0, -3 * size, 0], [0, 3 * size, 0], u * size / 24, v * size / 24])
    rows = rows[:, order].reshape(1, 12)
    shape = (64, 64) if roll else (64, 65)
    r, c = np.indices(shape)
    across = (c - (shape[1] - 1) / 2) * u[0] + (r - (shape[0] - 1) / 2) * v[0]
    sheet = np.abs(across) < 1e-9

    def turned(values):  # [z, y, x] of an object that is turned with the geometry
        return Volume(values.transpose([2 - order[2], 2 - order[1], 2 - order[0]]), voxel)

    middle = slice(n // 2 - 1, n // 2 + 1)
    low, high = data.copy(), data.copy()
    low[:, :, middle] = data[:, :, middle].min(axis=2, keepdims=True)
    high[:, :, middle] = data[:, :, middle].max(axis=2, keepdims=True)
    got, least, most = (forward(turned(a), rows, shape)[0] for a in (data, low, high))
    slack = WORST * most.max()
    assert (got[sheet] >= least[sheet] - slack).all()
    assert (got[sheet] <= most[sheet] + slack).all()
    y = np.where(sheet, draw.random(shape, dtype=np.float32), np.float32(0))[None]
    spread = back(y, rows, turned(data)).data
    assert spread.min() >= -WORST * spread.max()
    once = float(np.vdot(spread.astype(np.float64), turned(data).data))
    assert once == pytest.approx(float(np.vdot(y[0].astype(np.float64), got)), rel=1e-5)


def test_views_with_and_without_fans_in_one_call(siddon) -> None:
    volume = Volume(random((12, 13, 14)), 0.1, (0.013, 0.017, 0.011))
    level = ConeVec.from_vectors((0.2, -9, 0.1), (0, 9, 0), (0.2, 0, 0), (0, 0, -0.2))
    end_on = ConeVec.from_vectors((0, 0, 9), (0, 0, -9), (0.2, 0, 0), (0, 0.2, 0))
    geometry = ConeVec.concatenate([end_on, level, end_on])
    exact = siddon(volume.data, (0.1,) * 3, volume.center_mm, geometry, (7, 8))
    assert np.abs(forward(volume, geometry, (7, 8)) - exact).max() < WORST * exact.max()


@pytest.mark.parametrize("tilt", [{}, {"roll": 0.02, "pitch_tilt": 0.03}])
def test_empty_columns_and_gaps_inside_the_box(tilt, siddon, circle) -> None:
    data = random((30, 24, 22))
    occupied = np.random.default_rng(5)
    for y, x in np.ndindex(24, 22):
        a, b = np.sort(occupied.integers(-15, 45, 2)).clip(0, 30)
        data[:a, y, x] = data[b:, y, x] = 0
    volume = Volume(data, 0.1, (0.013, 0.017, 0.011))
    spans = volume.layout.spans.reshape(-1, 2)
    assert (spans[:, 0] == spans[:, 1]).mean() > 0.1
    geometry = circle(4, 20.0, 40.0, 0.2, start=0.3, **tilt)
    pixels = [(r, c) for r in range(0, 41, 3) for c in range(r % 2, 37, 2)]
    exact = siddon(data, volume.voxel_xyz, volume.center_mm, geometry, SHAPE, pixels)
    got = forward(volume, geometry, SHAPE)[
        :, [r for r, _ in pixels], [c for _, c in pixels]
    ]
    assert np.abs(got - exact).max() < WORST * exact.max()
