"""How views are walked: the choice, and that it changes nothing but the time."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, back, forward, room_like
from flexdt.twin.projection import operators as walks

SHAPE = (41, 37)


def above(elevation, azimuth, shape, pitch, sod=600.0, sdd=1059.0):
    """A source raised by `elevation` about x, then turned about z by `azimuth` [deg]."""
    e, a = math.radians(elevation), math.radians(azimuth)
    d = np.array([0.0, math.cos(e), -math.sin(e)])
    u = np.array([1.0, 0.0, 0.0])
    v = np.cross(d, u) if np.cross(d, u)[2] < 0 else -np.cross(d, u)
    turn = np.array(
        [[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]]
    )
    rows = np.concatenate(
        [turn @ x for x in (-sod * d, (sdd - sod) * d, u * pitch, v * pitch)]
    )
    return ConeVec(rows[None], shape)


def chosen(geometry, counts=(256, 256, 256), voxel=0.1):
    volume = Volume(np.broadcast_to(np.float32(1), counts), voxel)
    return [
        (order[2], fans)
        for some, order, fans in walks.by_level_axis(
            volume, geometry, geometry.detector_shape
        )
        for _ in range(some.start, some.stop)
    ]


BINNED = (760, 956)


@pytest.mark.parametrize("walk", [None], indirect=True)
def test_ordinary_scans_are_walked_along_z() -> None:
    turns = ConeVec.circular(sod=600, sdd=1059, angles=90, shape=BINNED, pixel=0.1496)
    tilted = ConeVec.circular(
        sod=300, sdd=900, angles=90, shape=BINNED, pixel=0.1496, tilts=(0.4, 0.7, 0.3)
    )
    for geometry in (turns, tilted):
        assert set(chosen(geometry)) == {(2, True)}


@pytest.mark.parametrize("walk", [None], indirect=True)
@pytest.mark.parametrize(
    ("azimuth", "axis"), [(0, 0), (5, 0), (85, 1), (90, 1), (180, 0)]
)
@pytest.mark.parametrize("elevation", [30, 50, 70])
def test_a_source_above_is_walked_along_the_axis_across_its_rays(
    elevation, azimuth, axis
) -> None:
    assert chosen(above(elevation, azimuth, BINNED, 0.1496)) == [(axis, True)]


@pytest.mark.parametrize("walk", [None], indirect=True)
def test_few_rays_are_walked_one_by_one_and_a_single_row_as_one_fan() -> None:
    assert chosen(above(20, 30, (3, 3), 1.0)) == [(2, False)]
    line = above(0, 0, (1, 1912), 0.0748), above(0, 90, (1, 1912), 0.0748)
    assert [chosen(each, (512, 512, 512)) for each in line] == [[(0, True)], [(1, True)]]


@pytest.mark.parametrize("walk", [None], indirect=True)
@pytest.mark.parametrize("seed", range(6))
def test_views_walked_in_any_way_in_one_call_equal_each_other(
    seed, monkeypatch, circle
) -> None:
    """Off-centre volumes of unequal voxels, views of all kinds, into new and into used
    memory."""
    draw = np.random.default_rng(seed)
    data = draw.random(draw.integers(5, 40, 3), dtype=np.float32)
    if seed % 2:
        data = np.asfortranarray(data)
    volume = Volume(
        data, tuple(draw.uniform(0.05, 0.3, 3)), tuple(draw.uniform(-1, 1, 3))
    )
    geometry = ConeVec.concatenate([
        ConeVec(circle(4, 20.0, 40.0, 0.3, start=draw.uniform(), roll=draw.normal()).rows, SHAPE),
        *(above(draw.uniform(-90, 90), draw.uniform(0, 360), SHAPE, 0.3, 20, 40) for _ in range(6)),
    ])  # fmt: skip

    def walk(ways):
        monkeypatch.setattr(
            walks, "level_axes", lambda rays, *_: np.array(ways)[: len(rays)]
        )

    walk([0] * 10)
    plain = forward(volume, geometry)
    y = draw.random(plain.shape, dtype=np.float32)
    spread = back(y, geometry, volume).data
    for _ in range(3):
        walk(draw.integers(0, 4, 10))
        assert np.abs(forward(volume, geometry) - plain).max() < 5e-6 * plain.max()
        room = room_like(volume)
        room += draw.normal()
        for again in (
            back(y, geometry, volume).data,
            back(y, geometry, volume, room).data,
        ):
            assert np.abs(again - spread).max() < 5e-6 * spread.max()
    assert forward(volume, geometry[:0]).shape == (0, *SHAPE)
    assert not back(y[:0], geometry[:0], volume, room).data.any()
