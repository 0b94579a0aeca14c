"""Dead, stuck and flickering pixels are interpolated and counted; clean scans lose none."""

from __future__ import annotations

import warnings

import bias_bound
import clean_pixel_table
import numpy as np
import pytest

import flexdt as fx
from flexdt import DataSet
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.consistency.pixels import bad_pixels

SHAPE = (24, 64)
OPEN = 30_000.0
SCAN = ConeVec.circular(
    sod=200.0, sdd=400.0, angles=np.arange(90) * 4.0, shape=SHAPE, pixel=1.6
)


def counts_of(seed: int) -> np.ndarray:
    """Counts of a cylinder with two rods off the axis, with noise, (n, rows, cols)."""
    solids = [
        bias_bound.Solid(
            "cylinder", np.zeros(3), np.array([17.0, 17.0, 90.0]), 0.0, 0.03
        ),
        bias_bound.Solid(
            "cylinder", np.array([9.0, 4.0, 0.0]), np.array([2.0, 2.0, 90.0]), 0.0, 0.05
        ),
        bias_bound.Solid(
            "box", np.array([-7.0, 6.0, 0.0]), np.array([2.0, 3.0, 5.0]), 0.4, -0.03
        ),
    ]
    integrals = bias_bound.Scan("", SCAN, SHAPE, solids, 0.0, 0.0, 0).images()
    light = np.random.default_rng(seed).poisson(OPEN * np.exp(-integrals))
    return np.clip(light, 0, 65535).astype(np.uint16)


def spoilt(counts: np.ndarray, kind: str, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Counts with bad pixels, and which they are (rows, cols)."""
    rng = np.random.default_rng(seed)
    bad = np.zeros(SHAPE, bool)
    if kind == "column":
        bad[:, int(rng.integers(15, 50))] = True
    else:
        many = int(rng.integers(1, 51))
        bad.reshape(-1)[rng.choice(bad.size, many, replace=False)] = True
    made = counts.copy()
    if kind in ("dead", "column"):
        made[:, bad] = 0
    elif kind == "hot":
        made[:, bad] = 60_000
    else:
        off = rng.random((len(made), int(bad.sum()))) < 0.5
        made[:, bad] = np.where(off, made[:, bad] // 3, made[:, bad])
    return made, bad


def found_in(counts: np.ndarray) -> np.ndarray:
    """The bad pixels that are found in counts, (rows, cols)."""
    integrals = -np.log(np.maximum(counts, 0.5) / OPEN).astype(np.float32)

    def views(many: int) -> np.ndarray:
        return integrals[np.unique(np.linspace(0, len(integrals) - 1, many).astype(int))]

    found = bad_pixels(views, (SHAPE[1] - 1) / 2)
    return np.zeros(SHAPE, bool) if found is None else found.mask


def reconstructed(counts: np.ndarray, **options: bool) -> tuple[Volume, list[str]]:
    flat = np.full(SHAPE, OPEN)
    data = DataSet.from_arrays(counts, SCAN, flat=flat, dark=np.zeros(SHAPE))
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        volume = data.reconstruct(
            "fdk", voxel=0.8, shape=(12, 60, 60), errors=False, **options
        )
    return volume, [str(one.message) for one in said]


def body(volume: Volume) -> Float32Array:
    """The values of the cylinder, away from edges and rods."""
    x, y, _ = volume.centers()
    inside = np.hypot(x, y[:, None]) < 14.0
    for at, reach in (((9.0, 4.0), 4.0), ((-7.0, 6.0), 6.0)):
        inside &= np.hypot(x - at[0], y[:, None] - at[1]) > reach
    return np.asarray(volume.data[:, inside])


@pytest.mark.parametrize("kind", ["dead", "hot", "flickering", "column"])
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.daily(4)
def test_bad_pixels_leave_no_rings(kind: str, seed: int) -> None:
    counts = counts_of(seed)
    clean, said = reconstructed(counts)
    assert not any("do not respond" in one for one in said)
    made, bad = spoilt(counts, kind, seed)
    found, said = reconstructed(made)
    (told,) = (one for one in said if "do not respond as their neighbors" in one)
    assert int(told.split()[0]) == pytest.approx(int(bad.sum()), abs=1 + 0.1 * bad.sum())
    assert not any("starved" in one or "saturated" in one for one in said)
    assert body(found).std() <= 1.3 * body(clean).std()


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        *(("flickering", seed) for seed in (103, 109, 144, 171, 241)),
        *(("hot", seed) for seed in (145, 161, 193, 198)),
    ],
)
def test_all_bad_pixels_are_found_and_no_other(kind: str, seed: int) -> None:
    """Flicker before the axis, and groups of bad pixels above, below and beside each other
    that hide each other, at the panel's edges, too."""
    made, bad = spoilt(counts_of(seed), kind, seed)
    np.testing.assert_array_equal(found_in(made), bad)


@pytest.mark.parametrize("sigma", [0.0, 0.01])
@pytest.mark.parametrize("axis", [31.5, 30.9])
def test_a_thin_ring_about_the_axis_is_no_pair_of_bad_pixels(
    sigma: float, axis: float
) -> None:
    """Wires of a pixel, bent to rings: rays along them see much, always on the same two
    pixels, which are as far from the axis."""
    columns = abs(np.arange(64) - axis)
    views = np.random.default_rng(3).normal(0.0, sigma, (40, 30, 64)).astype(np.float32)
    for row, radius in ((6, 12.0), (11, 20.0), (17, 7.0), (25, 24.0)):
        inner, outer = (
            np.sqrt(np.maximum(r**2 - columns**2, 0.0)) for r in (radius - 1.0, radius)
        )
        views[:, row] += (0.2 * (outer - inner)).astype(np.float32)
    assert bad_pixels(lambda _: views, axis) is None
    views[:, 20, 44] += 0.5
    found = bad_pixels(lambda _: views, axis)
    assert found is not None
    assert np.argwhere(found.mask).tolist() == [[20, 44]]


@pytest.mark.parametrize("seed", [60, 67, 83, 85, 91, 105])
def test_the_only_pair_that_no_other_pixel_is_like_is_of_the_ring_beside(
    seed: int,
) -> None:
    """The limbs of one thin ring of five see more than anything else; a dead pixel elsewhere,
    which is beside nothing, is found."""
    images, _, axis = clean_pixel_table.drawn("rings", seed)
    assert bad_pixels(lambda _: images, axis) is None
    images[:, 24, 8] = 10.0
    found = bad_pixels(lambda _: images, axis)
    assert found is not None
    assert np.argwhere(found.mask).tolist() == [[24, 8]]


@pytest.mark.parametrize(
    ("sample", "shape", "views"),
    [
        ("chiral", (73, 91), 77),
        ("coplanar", (46, 57), 71),
        ("tall", (80, 100), 32),
        ("lego", (55, 68), 65),
    ],
)
def test_beads_and_walls_of_a_pixel_are_no_bad_pixels(
    sample: str, shape: tuple[int, int], views: int
) -> None:
    """Without noise, on panels so coarse that beads come and go like flicker; one bead is on
    the axis."""
    pixel = 0.1496 * 1536 / shape[0]
    scan = ConeVec.circular(sod=600.0, sdd=1059.0, angles=views, shape=shape, pixel=pixel)
    data = fx.simulate(
        sample, scan, noise=None, detector=fx.Detector.ideal(), progress=False
    )
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        data.reconstruct("fdk", voxel=pixel, errors=False, progress=False)
    assert not any("do not respond" in str(one.message) for one in said)


def test_rings_are_corrected_where_there_are_some_and_nowhere_else() -> None:
    """Pixels with gains apart by 1 %: `rings` is an argument as of the command."""
    counts = counts_of(5)
    clean = body(reconstructed(counts)[0]).std()
    gain = np.random.default_rng(1).normal(1.0, 0.01, SHAPE)
    ringed = np.clip(counts * gain, 0, 65535).astype(np.uint16)
    with_rings, without = (
        body(reconstructed(ringed, rings=on)[0]).std() for on in (False, True)
    )
    assert without**2 - clean**2 < 0.5 * (with_rings**2 - clean**2)
    assert body(reconstructed(counts, rings=True)[0]).std() < 1.02 * clean


def test_what_stands_still_on_the_axis_is_no_bad_pixel() -> None:
    """A rod of two columns about the axis, and a bead of a pixel on it, that no turn moves."""
    views = np.zeros((20, 30, 61), np.float32)
    views[:, 12:, 30:32] += 0.8
    views += np.random.default_rng(2).normal(0.0, 0.004, views.shape).astype(np.float32)
    assert bad_pixels(lambda _: views, 30.5) is None
    views[:, 4, 12] += 0.5
    found = bad_pixels(lambda _: views, 30.5)
    assert found is not None
    assert np.argwhere(found.mask).tolist() == [[4, 12]]


@pytest.mark.parametrize("columns", [[50, 51, 52], [49, 51, 53, 54, 55], [8, 9, 10, 12]])
def test_bad_pixels_that_hide_each_other_are_found(columns: list[int]) -> None:
    """Three in a row have two bad neighbours each."""
    counts = counts_of(3)
    counts[:, 9, columns] = 0
    told = next(one for one in reconstructed(counts)[1] if "do not respond" in one)
    assert len(columns) <= int(told.split()[0]) <= len(columns) + 1


@pytest.mark.parametrize("width", [1, 4, 12, 64])
def test_a_thin_layer_of_the_object_is_no_row_of_bad_pixels(width: int) -> None:
    """A leaf as thick as a row, which is as wide and turns about the axis."""
    rng = np.random.default_rng(8)
    views = rng.normal(0.0, 0.004, (20, 30, 61)).astype(np.float32)
    for view, turn in zip(views, np.linspace(0.0, 2.0 * np.pi, 20), strict=True):
        middle = 30.0 + 24.0 * np.sin(turn)
        first, last = (int(np.clip(middle + side * width / 2, 0, 61)) for side in (-1, 1))
        view[14, first : max(last, first + 1)] += 0.6
    assert bad_pixels(lambda _: views, 30.0) is None
