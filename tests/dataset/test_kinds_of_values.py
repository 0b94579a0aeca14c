"""Line integrals, counts and transmission at the doors of data sets; flats that disagree."""

import warnings

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.library.datasets.image_doubts import image_doubts
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Grid

SHAPE = (24, 32)
SCAN = ConeVec.circular(sod=100, sdd=200, angles=60, shape=SHAPE, pixel=1)
BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}


@pytest.fixture(scope="module")
def integrals():
    unit = fx.project(BALL, SCAN)
    return unit / unit.max()


@pytest.mark.parametrize("largest", [0.5, 5.0, 15.0, 60.0])
def test_line_integrals_come_back_whatever_they_are(integrals, largest):
    given = largest * integrals
    data = fx.DataSet.from_arrays(given, SCAN)
    np.testing.assert_array_equal(data.line_integrals(), given)
    np.testing.assert_array_equal(data[3:9].line_integrals(), given[3:9])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        volume = data.reconstruct("fdk", voxel=0.5, errors=False)
    middle = volume.data[tuple(n // 2 for n in volume.data.shape)]
    assert middle == pytest.approx(largest / 10.0, rel=0.05)
    assert not image_doubts(data, needed=True)


def test_what_counts_cannot_hold_is_said(integrals):
    said = fx.DataSet.from_arrays(15 * integrals, SCAN).warnings
    assert any("kept in line_integrals()" in doubt for doubt in said)


@pytest.mark.parametrize("kind", [np.float32, np.float64])
@pytest.mark.parametrize("beam", [200.0, 4000.0, 60000.0])
def test_counts_without_a_flat_image_are_no_line_integrals(integrals, kind, beam):
    with pytest.raises(DatasetError, match="flat"):
        fx.DataSet.from_arrays((beam * np.exp(-integrals)).astype(kind), SCAN)


def test_transmission_is_said(integrals, tmp_path):
    transmission = np.exp(-integrals).astype(np.float32)
    data = fx.DataSet.from_arrays(transmission, SCAN)
    assert any("transmission" in doubt for doubt in data.warnings)
    for i, image in enumerate(transmission):
        tifffile.imwrite(tmp_path / f"p{i}.tif", image)
    assert any(
        "transmission" in doubt for doubt in fx.read_tiffs(tmp_path, SCAN).warnings
    )


def test_whole_line_integrals_are_said(integrals):
    data = fx.DataSet.from_arrays((9 * integrals).astype(np.int64), SCAN)
    assert any("fractions are cut off" in doubt for doubt in data.warnings)


def exposed(integrals, flats, beam=1.0, seed=0, noise=True):
    rng = np.random.default_rng(seed)
    level = np.broadcast_to(beam, len(integrals))[:, None, None]
    expected = 100 + 20_000 * level * np.exp(-integrals)
    flat = 100 + 20_000 * np.asarray(flats, dtype=float)[:, None, None] * np.ones(SHAPE)
    draw = rng.poisson if noise else np.rint
    dark = np.full(SHAPE, 100)
    return fx.DataSet.from_arrays(draw(expected), SCAN, dark=dark, flat=draw(flat))


@pytest.mark.parametrize("flats", [(1, 1.05), (1, 1.5), (1, 1, 1, 0.9), (0.7, 1.1)])
def test_flats_that_disagree_are_said(integrals, flats):  # ToMoBAR#58
    assert any(
        "flat images differ" in doubt for doubt in image_doubts(exposed(integrals, flats))
    )


@pytest.mark.parametrize(
    "beam", [1.1, 1.5, np.linspace(1.0, 0.8, 60), np.linspace(0.9, 1.1, 60)], ids=str
)
def test_a_beam_that_is_not_the_flats_is_said(integrals, beam):
    doubts = image_doubts(exposed(integrals, (1,), beam))
    assert any("open beam beside the object" in doubt for doubt in doubts)


@pytest.mark.parametrize("seed", range(8))
def test_right_flats_are_told_nothing(integrals, seed):
    assert not image_doubts(exposed(integrals, (1,) * (1 + seed % 4), seed=seed))


@pytest.mark.parametrize("radius", [18.0, 30.0, 60.0])
@pytest.mark.parametrize("mu", [0.001, 0.01, 0.1])
def test_objects_wider_than_the_panel_are_no_other_beam(radius, mu):
    wide = Grid((24, 60, 60), 2.0 * radius / 60)
    _, y, x = (c for c in np.meshgrid(*wide.blank().centers()[::-1], indexing="ij"))
    body = fx.Volume((mu * (np.hypot(x, y) < radius)).astype(np.float32), wide.voxel_mm)
    doubts = image_doubts(exposed(fx.project(body, SCAN), (1,)))
    assert not any("open beam" in doubt for doubt in doubts)


def test_images_that_hold_nothing_are_said(integrals):
    counts = np.rint(1000 * np.exp(-integrals)).astype(np.uint16)
    counts[50:] = 0
    data = fx.DataSet.from_arrays(counts, SCAN, flat=np.full(SHAPE, 1000))
    assert not data.complete
    assert "10 of 60 images are zero" in data.reason
