"""FDK of helices: exact path lengths of long random objects, and shares judged by
projection."""

from __future__ import annotations

import re

import numpy as np
import pytest

import flexdt as fx
from flexdt.library.reconstruction.reconstruct import VolumeRequest, reconstruct_dataset
from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid, project_scene
from flexdt.twin.projection.analytic_solids import Ellipsoid, Scene, Solid
from flexdt.twin.reconstruction import fdk, fdk_parts, field_of_view
from flexdt.twin.reconstruction.acquisition.coverage import Sharing
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of

SOD, SDD, PITCH, SHAPE, MU = 300.0, 600.0, 2.0, (40, 64), 0.02
FIELD = SOD * np.sin(np.arctan2((SHAPE[1] - 1) * PITCH / 2, SDD))
STEEPEST = (SHAPE[0] - 1) * PITCH * (SOD - FIELD) / SDD


def helix(part: float, views: int = 180, turns: float = 4.0, **more: object) -> ConeVec:
    """So much of the steepest rise."""
    angles = np.linspace(0.0, 360.0 * turns, int(views * turns), endpoint=False)
    return ConeVec.helical(
        sod=SOD,
        sdd=SDD,
        angles=angles,
        rise=part * STEEPEST,
        pixel=PITCH,
        shape=SHAPE,
        **more,
    )  # type: ignore[arg-type]


def column(rng: np.random.Generator) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Centre, half axes, attenuation that it adds: a long column with five things in it."""
    half = 0.8 * FIELD * rng.uniform(0.7, 1.0, 2)
    parts = [(np.zeros(3), np.array([*half, 1e5]), MU)]
    for _ in range(5):
        axes = FIELD * rng.uniform(0.15, 0.35, 3)
        place = rng.uniform(-1.0, 1.0, 3) * (*(0.5 * half), 0.5 * STEEPEST)
        parts.append((place, axes, MU * float(rng.uniform(-0.8, 1.5))))
    return parts


def errors(parts: list[tuple[np.ndarray, np.ndarray, float]], scan: ConeVec, z: float):
    """Of a layer, where it is even for two voxels around, relative to MU."""
    solids = [
        Solid(Ellipsoid(tuple(p.tolist()), tuple(a.tolist())), str(k), mu)
        for k, (p, a, mu) in enumerate(parts)
    ]
    images = project_scene(Scene(tuple(solids)), scan, SHAPE)
    grid = Grid((1, 61, 61), 2.0 * FIELD / 61, (0.0, 0.0, z))
    at = (np.arange(61) - 30) * grid.voxel_mm
    y, x = np.meshgrid(at, at, indexing="ij")
    truth, even = np.zeros(x.shape), np.hypot(x, y) < 0.9 * FIELD
    for place, axes, mu in parts:
        where = np.stack(np.broadcast_arrays(x, y, z), -1) - place
        truth += mu * (((where / axes) ** 2).sum(-1) <= 1.0)
        grown, shrunk = (
            axes + 2.5 * grid.voxel_mm,
            np.maximum(axes - 2.5 * grid.voxel_mm, 1e-3),
        )
        even &= (((where / grown) ** 2).sum(-1) > 1) | (
            ((where / shrunk) ** 2).sum(-1) < 1
        )
    return ((fdk(images, scan, grid.blank(), errors=False).data[0] - truth) / MU)[even]


@pytest.mark.slow
def test_long_objects_come_back_from_any_helix() -> None:
    """Up and down, clockwise or not, panels aside and tilted, beside a circle round the
    layer."""
    rng = np.random.default_rng(7)
    for case in range(6):
        parts, z = column(rng), float(rng.uniform(-0.4, 0.4)) * STEEPEST
        part = float(rng.uniform(0.3, 0.95)) * rng.choice([-1.0, 1.0])
        more: dict[str, object] = {}
        if case % 3 == 1:
            more = {"offset": (0.2 * SHAPE[1] * PITCH, 0.1)}
        elif case % 3 == 2:
            more = {"tilts": (1.0, -0.5, 2.0)}
        scan = helix(part, **more)
        if case >= 3:  # the same turns the other way
            scan = ConeVec(
                scan.rows * np.tile([-1.0, 1.0, 1.0], 4) * np.repeat([1, 1, -1, 1], 3)
            )
        if case % 2:  # listed in any order
            scan = scan[rng.permutation(len(scan))]
        circle = ConeVec.circular(
            sod=SOD, sdd=SDD, angles=180, pixel=PITCH, shape=SHAPE, height=z, **more
        )  # type: ignore[arg-type]
        wrong, usual = errors(parts, scan, z), errors(parts, circle, z)
        assert abs(wrong.mean()) < 0.004, (case, part)
        assert wrong.std() < 1.4 * usual.std() + 0.002, (case, part)


@pytest.mark.parametrize("seed", range(3))
def test_a_helix_with_a_gap_is_refused_and_a_slow_drift_with_one_is_a_circle(
    seed: int,
) -> None:
    """A gap of a helix was bridged without a word, and 0.2 mm of drift made a circle a
    helix."""
    rng = np.random.default_rng(seed)
    scan = helix(0.5)
    first, width = rng.uniform(0.2, 0.6) * len(scan), rng.uniform(0.08, 0.4) * 180
    left = np.abs(np.arange(len(scan)) - first) > width / 2
    with pytest.raises(GeometryError, match="no gap of angles"):
        circle_of(scan[rng.permutation(np.flatnonzero(left))])
    turn = ConeVec.circular(
        sod=SOD, sdd=SDD, angles=180, pixel=PITCH, shape=SHAPE, height=0.0
    )  # type: ignore[arg-type]
    for rise in (0.5e-3, 3e-3):
        rows = turn.rows.copy()
        rows[:, 2::3][:, :2] += np.linspace(0.0, rise * SOD, 180)[:, None]
        there = np.delete(np.arange(180), np.arange(60, 60 + int(rng.integers(15, 50))))
        parts = column(rng)
        seen, whole = (
            errors(parts, ConeVec(rows[some]), 0.0) for some in (there, slice(None))
        )
        assert abs(seen.mean()) < abs(whole.mean()) + 0.002
        assert seen.std() < 1.3 * whole.std() + 0.002


def test_shares_of_a_point_add_up_to_one() -> None:
    """All views that see a point from one side, by projecting it; most counts in the middle."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        turns, views = float(rng.uniform(1.5, 5.0)), int(rng.integers(40, 90))
        part = float(rng.uniform(0.1, 1.0))
        scan = helix(float(rng.choice([-1, 1])) * part, views, turns)
        like = Grid((8, 40, 40), 2.0 * FIELD / 40)
        sharing = Sharing.of(circle_of(scan), scan, SHAPE, like.blank())
        table = sharing.table(slice(0, len(scan)), (0, SHAPE[0]))
        angle, away = rng.uniform(0, 2 * np.pi), FIELD * rng.uniform(0.0, 1.0)
        start, low = int(rng.integers(views)), float(rng.choice(scan.source[:, 2]))
        point = np.array([[away * np.cos(angle), away * np.sin(angle), low]])
        same = np.arange(start, len(scan), views)
        row = scan[same].project_points(point, SHAPE)[:, 0, 1]
        seen = (row >= 0) & (row <= SHAPE[0] - 1)
        if not seen.any():
            continue
        normal = scan.normal * np.sign(scan.source_detector_distance)[:, None]
        depth = ((point - scan.source) * normal).sum(axis=1)
        first, many = sharing.columns().T
        shares = []
        for view, r in zip(same[seen], row[seen], strict=True):
            at = (depth[view] - first[view]) * many[view]
            (i, s), (j, t) = divmod(at, 1.0), divmod(r, 1.0)
            four = np.pad(table[view], ((0, 1), (0, 1)), "edge")[
                int(i) : int(i) + 2, int(j) : int(j) + 2
            ]
            shares.append(float(np.array([1 - s, s]) @ four @ np.array([1 - t, t])))
        # Where turns hardly overlap on the panel, the share goes from 1 to 0 within a few rows.
        assert sum(shares) == pytest.approx(1.0, abs=0.008 if part < 0.7 else 0.03)
        assert min(shares) >= 0.0
        ends = np.minimum(same, len(scan) - 1 - same)[seen] > views / 8
        if ends.all():
            nearest = np.argmin(np.abs(row[seen] - (SHAPE[0] - 1) / 2))
            assert shares[nearest] == max(shares)


def test_slabs_are_the_whole() -> None:
    scan = helix(0.4, 40, 3.0)
    images = (
        np.random.default_rng(1).normal(1.0, 0.1, (len(scan), *SHAPE)).astype(np.float32)
    )
    grid = Grid((48, 20, 24), 1.0)
    whole = fdk_parts(lambda: [images], scan, SHAPE, grid).data
    slabs = [
        fdk_parts(lambda: [images], scan, SHAPE, grid.slab(k, k + 16)).data
        for k in (0, 16, 32)
    ]
    assert np.abs(np.concatenate(slabs) - whole).max() < 1e-5 * np.abs(whole).max()


def test_too_steep_a_helix_is_refused_with_what_is_allowed() -> None:
    images = np.zeros((160, *SHAPE), np.float32)
    wide, slim = Grid((4, 90, 90), 1.0).blank(), Grid((4, 9, 9), 1.0).blank()
    with pytest.raises(GeometryError, match=r"rises by .* mm a turn; FDK needs") as error:
        fdk(images, helix(1.3, 40), wide)
    (most,) = map(float, re.findall(r"at most ([0-9.]+) mm", str(error.value)))
    assert most == pytest.approx(STEEPEST, rel=1e-3)
    assert error.value.data["allowed"] == pytest.approx(STEEPEST)  # type: ignore[index]
    fdk(images, helix(0.9999, 40), wide)
    with pytest.warns(UserWarning, match="is not known"):  # the whole field cannot be had
        fdk(images, helix(1.08, 40), slim)  # which moves less on the panel
    with pytest.raises(GeometryError, match="rises by"):
        fdk(images, helix(1.3, 40), slim)
    uneven = helix(0.5, 40).rows.copy()
    uneven[:, [2, 5]] += 6.0 * np.sin(np.linspace(0.0, 9.0, 160))[:, None]
    with pytest.raises(GeometryError, match="or a helix that rises steadily"):
        fdk(images, ConeVec(uneven), wide)
    half = helix(0.9, 160, 1.0)[:100]
    with pytest.raises(GeometryError, match="a turn or more"):
        fdk(images[:100], ConeVec(half.rows * np.tile([1, 1, 4], 4)), wide)


@pytest.mark.parametrize("part", [0.3, 0.6, 0.95])
def test_layers_that_some_sides_do_not_see_are_nan_and_the_others_right(
    part: float,
) -> None:
    """Of the whole field of view: at its ends up to 86 % was missing without a word."""
    scan = helix(part, 90, 2.5)
    solid = Solid(Ellipsoid((2.0, -3.0, 0.0), (0.6 * FIELD, 0.5 * FIELD, 1e5)), "a", MU)
    whole = field_of_view(scan, SHAPE)
    with pytest.warns(UserWarning, match="layers of the grid lie outside"):
        volume = fdk(project_scene(Scene((solid,)), scan, SHAPE), scan, whole)
    x, y, _ = volume.centers()
    inside = np.hypot((x - 2.0) / 0.6, (y[:, None] + 3.0) / 0.5) < 0.8 * FIELD
    layers = volume.data[:, inside].mean(axis=1) / MU
    seen = np.isfinite(layers)
    assert 0.2 < seen.mean() < 1.0
    np.testing.assert_allclose(layers[seen], 1.0, atol=0.01)


def test_an_object_wider_than_the_panel_is_said() -> None:
    scan = helix(0.5, 40)
    body = Scene(
        (Solid(Ellipsoid((0.0, 0.0, 0.0), (2 * FIELD, 2 * FIELD, 1e5)), "a", MU),)
    )
    with pytest.warns(UserWarning, match="beyond the panel's sides"):
        fdk(project_scene(body, scan, SHAPE), scan, Grid((1, 8, 8), 4.0).blank())


def test_a_grid_of_any_size_is_refused_before_anything_is_allocated(tmp_path) -> None:
    scan = helix(0.5, 12, 1.0)
    data = fx.simulate(fx.Volume(np.full((8, 8, 8), 0.01, np.float32), 2.0), scan)
    for shape in ((10**6, 10**6, 10**6), (1, 10**7, 10**7)):
        with pytest.raises(LimitError, match="GiB"):
            reconstruct_dataset(
                data, tmp_path / "v.tif", VolumeRequest(shape=shape, voxel_mm=1.0)
            )
        with pytest.raises(LimitError, match="GiB"):
            data.reconstruct("fdk", voxel=1.0, shape=shape)
    assert not list(tmp_path.iterdir())
