"""Scans of public reports about other programs, each with three neighbours.

A ball off the axis, whose line integrals are closed forms, comes back where it is and with its
attenuation; what no program can reconstruct is refused or said. Rows whose inputs are files,
numbers in names and values stand in tests/dataset and tests/twin/plausibility.
"""

from __future__ import annotations

import gc
import tracemalloc
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from contradictions import chords

import flexdt as fx
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk, sirt

SHAPE = (28, 40)
CENTRE = np.array([3.0, -2.0, 1.0])
RADIUS = 5.0
MU = 0.03
GRID = Grid((21, 33, 33), 0.6)
GOLDEN_DEG = 137.50776
RNG = np.random.default_rng(44)

circle = partial(fx.ConeVec.circular, sod=200.0, sdd=400.0, shape=SHAPE, pixel=1.2)


def integrals(scan: fx.ConeVec) -> Any:
    return (MU * chords(scan, CENTRE, RADIUS)).astype(np.float32)


def found(scan: fx.ConeVec, grid: Any = GRID) -> fx.Volume:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return fdk(integrals(scan), scan, grid, errors=False)


def ball(volume: fx.Volume) -> tuple[float, np.ndarray[Any, Any]]:
    """Mean of the inner ball over the truth, and the ball's centre of mass [mm]."""
    x, y, z = np.meshgrid(*volume.centers(), indexing="ij")
    values = np.nan_to_num(volume.data.transpose(2, 1, 0))
    away = np.sqrt((x - CENTRE[0]) ** 2 + (y - CENTRE[1]) ** 2 + (z - CENTRE[2]) ** 2)
    about = away < RADIUS + 1.5
    weights = np.where(about, np.maximum(values, 0.0), 0.0)
    at = np.array([(weights * axis).sum() for axis in (x, y, z)]) / weights.sum()
    return float(values[away < 0.6 * RADIUS].mean()) / MU, at


def even(views: int) -> np.ndarray[Any, Any]:
    return np.arange(views) * 360.0 / views


RIGHT: dict[str, list[Callable[[], fx.ConeVec]]] = {
    "RTK#762: short scan of a nearly parallel beam": [
        partial(circle, sod=3000.0, sdd=3300.0, pixel=0.66, angles=np.linspace(0, span, 90))
        for span in (190.0, 200.0, 215.0, 240.0)
    ],
    "RTK#870: few views of a short scan": [
        partial(circle, angles=np.linspace(0.0, 225.0, views)) for views in (25, 31, 50, 70)
    ],
    "TIGRE#743: a sparse circle is full": [
        partial(circle, angles=even(views) + jitter * RNG.uniform(-1.0, 1.0, views))
        for views, jitter in ((24, 0.0), (45, 0.0), (45, 2.0), (31, 1.0))
    ],
    "TIGRE#778: small offsets in a short scan": [
        partial(circle, angles=np.linspace(0.0, 230.0, 80), offset=(offset, 0.0))
        for offset in (0.1, -0.1, 3.0, -3.0)
    ],
    "TIGRE#754: angles twice, parts of turns": [
        partial(circle, angles=np.concatenate([even(60), even(60)])),
        partial(circle, angles=np.linspace(0.0, 270.0, 80)),
        partial(circle, angles=np.linspace(0.0, 400.0, 110)),
        partial(circle, angles=np.arange(80) * GOLDEN_DEG),
    ],
    "LEAP#197: the source at the height of the first row": [
        partial(circle, angles=even(70), height=height, offset=(0.0, offset))
        for height, offset in ((8.0, 16.0), (-8.0, -16.0), (4.0, 8.0), (0.0, 4.0))
    ],
    "LEAP#97: half fans that begin anywhere": [
        partial(circle, angles=begin + even(90), offset=(16.0 * side, 0.0))
        for begin, side in ((0.0, 1.0), (37.0, -1.0), (90.0, 1.0), (200.0, -1.0))
    ],
    "TIGRE#58: panels tilted about their own centre": [
        partial(circle, angles=even(70), tilts=tilts)
        for tilts in ((3.0, 0.0, 0.0), (0.0, 4.0, 0.0), (0.0, 0.0, -5.0), (2.0, -2.0, 2.0))
    ],
    "LEAP#196: helices of either sense": [
        partial(
            fx.ConeVec.helical,
            sod=200.0, sdd=400.0, shape=SHAPE, pixel=1.2,
            angles=sense * np.linspace(-720.0, 720.0, 240), rise=rise,
        )
        for sense, rise in ((1.0, 6.0), (1.0, -6.0), (-1.0, 6.0), (1.0, 3.0))
    ],
}  # fmt: skip
CASES = [(name, k) for name, kinds in RIGHT.items() for k in range(len(kinds))]


@pytest.mark.parametrize(("report", "neighbour"), CASES)
def test_the_ball_comes_back_where_it_is(report: str, neighbour: int) -> None:
    mean, at = ball(found(RIGHT[report][neighbour]()))
    assert mean == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(at, CENTRE, atol=0.1)


@pytest.mark.parametrize("span", [140.0, 170.0, 175.0, 179.0])
def test_too_short_a_scan_is_refused(span: float) -> None:  # RTK#762
    scan = circle(sod=3000.0, sdd=3300.0, pixel=0.66, angles=np.linspace(0, span, 90))
    with pytest.raises(fx.TwinError, match="FDK needs"):
        found(scan)


@pytest.mark.parametrize(
    ("offset", "side"), [(30.0, 1), (-30.0, -1), (40.0, 1), (22.0, -1)]
)
def test_a_panel_aside_in_a_short_scan_is_said(
    offset: float, side: int
) -> None:  # RTK#393
    scan = circle(angles=np.linspace(0.0, 220.0, 80), offset=(offset, 0.0))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            volume = fdk(integrals(scan), scan, GRID)
        except fx.TwinError:
            return
    mean, _ = ball(volume)
    assert caught or abs(mean - 1.0) < 0.01


SWEEP = np.deg2rad(np.linspace(-60.0, 60.0, 41))
LEVEL = np.zeros(len(SWEEP))
SOURCES = {
    "arc": (200.0 * np.sin(SWEEP), -200.0 * np.cos(SWEEP), LEVEL),
    "line": (140.0 * np.sin(SWEEP), LEVEL - 200.0, LEVEL),
    "rising": (LEVEL, LEVEL - 200.0, 60.0 * np.sin(SWEEP)),
    "circle": (80.0 * np.cos(3.0 * SWEEP), LEVEL - 200.0, 80.0 * np.sin(3.0 * SWEEP)),
}


@pytest.mark.parametrize("path", SOURCES)
def test_a_panel_that_stands_still_shifts_nothing(path: str) -> None:
    """TIGRE#679, #99: the ball is where it is across the beam, and what is unseen is told."""
    sources = np.stack(SOURCES[path], axis=1)
    scan = fx.ConeVec.from_vectors(
        sources, (0, 80, 0), (1.6, 0, 0), (0, 0, -1.6), (60, 150)
    )
    grid = Grid((15, 15, 15), 1.2, (3.0, -2.0, 1.0))
    with pytest.warns(UserWarning, match="edges along those are blurred"):
        volume = sirt(integrals(scan), scan, grid, iterations=12)
    x, y, z = np.meshgrid(*volume.centers(), indexing="ij")
    values = volume.data.transpose(2, 1, 0)
    weights = np.where(values > 0.3 * values.max(), values, 0.0)
    at = np.array([(weights * axis).sum() for axis in (x, y, z)]) / weights.sum()
    np.testing.assert_allclose(at[[0, 2]], CENTRE[[0, 2]], atol=0.15)
    np.testing.assert_allclose(at[1], CENTRE[1], atol=0.6)  # along the beam


@pytest.mark.parametrize("views", [20, 60, 200])
@pytest.mark.parametrize("form", ["sphere", "saddle", "about x", "two circles"])
def test_trajectories_that_leave_nothing_out_are_told_nothing(
    form: str, views: int
) -> None:
    turn = np.linspace(0.0, 2.0 * np.pi, views, endpoint=False)
    level = 0.0 * turn
    beams = {
        "sphere": RNG.normal(size=(views, 3)),
        "saddle": np.stack([np.cos(turn), np.sin(turn), 0.4 * np.cos(2.0 * turn)], axis=1),
        "about x": np.stack([level, np.cos(turn), np.sin(turn)], axis=1),
        "two circles": np.stack([np.sin(turn), np.cos(turn) * (turn < 3.1), np.cos(turn) *
                                 (turn >= 3.1)], axis=1),
    }[form]  # fmt: skip
    beams /= np.linalg.norm(beams, axis=1, keepdims=True)
    u = np.cross(beams, RNG.normal(size=3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    scan = fx.ConeVec.from_vectors(
        -100 * beams, 100 * beams, u, np.cross(beams, u), (9, 9)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sirt(
            np.zeros((views, 9, 9), np.float32), scan, Grid((3, 3, 3), 0.5), iterations=1
        )


@pytest.mark.parametrize(
    "voxel", [(0.6, 0.6, 0.6), (0.4, 0.6, 1.0), (1.0, 0.5, 0.5), (0.5, 1.0, 0.7)]
)
def test_oblong_voxels(
    voxel: tuple[float, float, float],
) -> None:  # astra#382, mbirjax#188
    shape = tuple(int(19.8 / edge) for edge in reversed(voxel))
    like = fx.Volume(np.zeros(shape, np.float32), voxel)
    mean, at = ball(found(circle(angles=even(70)), like))
    assert mean == pytest.approx(1.0, abs=0.01)
    np.testing.assert_allclose(at, CENTRE, atol=0.15)


@pytest.mark.parametrize("shape", [(20, 30), (21, 31), (20, 31), (21, 30)])
@pytest.mark.parametrize("layers", [10, 11])
def test_no_half_pixel_is_lost(shape: tuple[int, int], layers: int) -> None:
    """TIGRE#208, ODL#1567, CIL#703: odd and even sizes of panel and grid."""
    scan = circle(angles=even(48), shape=shape)
    images = (MU * chords(scan, np.zeros(3), RADIUS)).astype(np.float32)
    data = np.nan_to_num(
        fdk(images, scan, Grid((layers, 20, 20), 0.6), errors=False).data
    )
    for axis in range(3):
        np.testing.assert_allclose(data, np.flip(data, axis), atol=0.02 * MU)


SMALL = circle(angles=8)
WORK: dict[str, Callable[[Any], Any]] = {
    "forward": lambda images: fx.forward(fx.Volume(np.ones((6, 8, 8)), 1.0), SMALL),
    "back": lambda images: fx.back(images, SMALL, Grid((6, 8, 8), 1.0)),
    "fdk": lambda images: fdk(images, SMALL, Grid((6, 8, 8), 1.0), errors=False),
    "sirt": lambda images: sirt(images, SMALL, Grid((6, 8, 8), 1.0), iterations=1),
    "data set": lambda images: fx.DataSet.from_arrays(images, SMALL).line_integrals(),
}
ROUNDS = 12
MAX_KEPT_BYTES = 3000
"""Of a round; images of one are 35 840 bytes, the volume of one 1536."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("work", WORK)
def test_rounds_of_the_same_work_keep_no_memory(work: str) -> None:  # tomosipo#17
    images = integrals(SMALL)
    for _ in range(3):
        WORK[work](images)
    gc.collect()
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(ROUNDS):
            WORK[work](images)
        gc.collect()
        kept = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert kept < ROUNDS * MAX_KEPT_BYTES


@pytest.mark.parametrize("edge", [0.05, 0.1, 0.3, 1.0])
def test_voxels_smaller_than_a_pixel_project_exactly(edge: float) -> None:  # LEAP#70
    count = round(4.0 / edge)
    cube = fx.Volume(np.full((count, count, count), MU, np.float32), edge)
    scan = circle(angles=[0.0, 90.0], shape=(1, 1), pixel=3.0)
    np.testing.assert_allclose(fx.project(cube, scan), MU * count * edge, rtol=1e-6)


@pytest.mark.parametrize("door", ["fdk", "sirt", "simulate", "from_arrays"])
@pytest.mark.parametrize("span", [np.pi, 2.0 * np.pi])
def test_radians_for_degrees_are_said(door: str, span: float) -> None:  # algotom#12
    scan = circle(angles=np.linspace(0.0, span, 90, endpoint=False))
    images = integrals(scan)
    sphere = {
        "kind": "sphere",
        "center": CENTRE.tolist(),
        "radius": RADIUS,
        "material": "pmma",
    }
    doors: dict[str, Callable[[], Any]] = {
        "fdk": lambda: fdk(images, scan, GRID, errors=False),
        "sirt": lambda: sirt(images, scan, Grid((3, 9, 9), 2.0), iterations=1),
        "simulate": lambda: fx.simulate(sphere, scan),
        "from_arrays": lambda: fx.DataSet.from_arrays(images, scan),
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        said = []
        try:
            made = doors[door]()
            said = list(getattr(made, "warnings", []))
        except fx.TwinError as error:
            said = [str(error)]
    assert any("radians" in one for one in [*said, *(str(w.message) for w in caught)])


@pytest.mark.parametrize("bad", ["zero", "below the dark image", "dead", "saturated"])
def test_counts_without_a_logarithm_give_finite_integrals(bad: str) -> None:
    """mantid#953, sarepy#8, tomopy#152: pixels without signal have their neighbours' value."""
    scan = circle(angles=even(40))
    truth = integrals(scan)
    counts = np.rint(100 + 20_000 * np.exp(-truth)).astype(np.uint16)
    flat = np.full(SHAPE, 20_100, np.uint16)
    value = {"zero": 0, "below the dark image": 40, "dead": 100, "saturated": 65_535}[bad]
    counts[:, 9, 13] = value
    if bad == "dead":
        flat[9, 13] = 100
    data = fx.DataSet.from_arrays(
        counts, scan, dark=np.full(SHAPE, 100, np.uint16), flat=flat
    )
    found_ = data.line_integrals()
    assert np.isfinite(found_).all()
    if bad == "dead":
        assert np.abs(found_[:, 9, 13] - truth[:, 9, 13]).mean() < 0.01
