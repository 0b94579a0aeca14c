"""Images that are no counts of a camera: floats and negatives, from arrays and from files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import tifffile

import flexdt as fx
from flexdt.phantoms import load_phantom
from flexdt.twin.dataset.dataset_errors import DatasetFormatError

SHAPE = (6, 7)
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=4, shape=SHAPE, pixel=1)
DARK, FLAT = 90.0, 9000.0


def integrals(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    return rng.uniform(0.0, 4.0, (4, *SHAPE))


def seen(data: fx.DataSet) -> npt.NDArray[np.float64]:
    return np.array([np.asarray(image, dtype=float) for image in data])


@pytest.mark.parametrize("scale", [1.0, 1e-4, 40.0])
@pytest.mark.parametrize("subtracted", [False, True])
def test_floats_with_a_flat_image_are_line_integrals(
    scale: float, subtracted: bool
) -> None:
    truth = integrals(np.random.default_rng([1, int(scale), subtracted]))
    below = DARK if subtracted else 0.0
    images = (DARK - below + (FLAT - DARK) * np.exp(-truth)) * scale
    ends = [np.full(SHAPE, (level - below) * scale) for level in (DARK, FLAT)]
    data = fx.DataSet.from_arrays(images, SCAN, dark=ends[0], flat=ends[1])
    assert np.abs(seen(data) - truth).max() < 1e-3


@pytest.mark.parametrize("kind", [np.int16, np.int64, np.float32, np.uint32])
def test_arrays_and_files_say_the_same(tmp_path: Path, kind: type) -> None:
    """Noise takes what is behind a thick part below 0 once the dark image is subtracted."""
    rng = np.random.default_rng(2)
    images = 20_000 * np.exp(-integrals(rng)) + rng.normal(0, 3, (4, *SHAPE))
    images[0, 0, 0] = -4.0 if kind is not np.uint32 else 70_000.0
    values = (
        np.rint(images).astype(kind) if kind is not np.float32 else images.astype(kind)
    )
    flat = np.full(SHAPE, 20_000, dtype=np.float32)
    data = fx.DataSet.from_arrays(values, SCAN, flat=flat)
    for i, image in enumerate(values):
        tifffile.imwrite(tmp_path / f"p{i}.tif", image.astype(np.float32))
    tifffile.imwrite(tmp_path / "io.tif", flat)
    assert np.array_equal(seen(data), seen(fx.read_tiffs(tmp_path, SCAN)))
    expected = -np.log(np.maximum(images[1:], 1.0) / 20_000)
    assert np.abs(seen(data)[1:] - expected).max() < 0.05


def test_counts_stay_counts() -> None:
    values = np.arange(4 * 42).reshape(4, *SHAPE)
    for kind in (np.int64, np.float32, np.uint16):
        data = fx.DataSet.from_arrays(
            values.astype(kind), SCAN, flat=np.full(SHAPE, 1000)
        )
        assert np.array_equal(data.counts(), values)
        assert data.counts().dtype == np.uint16


def test_negative_whole_numbers_without_a_flat_image_are_refused() -> None:
    with pytest.raises(
        DatasetFormatError, match="from -1 to 40; allowed: whole numbers from 0"
    ):
        fx.DataSet.from_arrays(np.arange(-1, 41).reshape(1, *SHAPE), SCAN[:1])
    with pytest.raises(DatasetFormatError, match="not finite"):
        fx.DataSet.from_arrays(np.full((4, *SHAPE), np.nan), SCAN, flat=np.ones(SHAPE))


def test_line_integrals_that_are_not_finite_are_counted_and_the_first_is_named() -> None:
    values = np.ones((4, *SHAPE))
    values[2, 1, 3:5] = np.nan, np.inf
    with pytest.raises(
        DatasetFormatError,
        match=f"^2 of {values.size} line integrals .* at image 2, row 1, column 3; allowed",
    ):
        fx.DataSet.from_arrays(values, SCAN)


def test_transmissions_taken_for_line_integrals_are_named() -> None:
    shape, phantom = (190, 239), load_phantom("normal-4")
    scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=6, shape=shape, pixel=0.6)
    data = fx.simulate(phantom, scan, noise=1)
    light = np.exp(-seen(data))
    wrong = fx.DataSet.from_arrays(light.astype(np.float32), scan).calibrate(phantom)
    (told,) = [p["text"] for p in wrong.document["problems"] if p["code"] == "no_beads"]
    assert "but 6 of 6 show such spots taken as transmissions" in told
    right = fx.DataSet.from_arrays(light, scan, flat=np.ones(shape)).calibrate(phantom)
    assert right.calibration.identifiable, right.document["problems"]
    empty = fx.DataSet.from_arrays(np.ones_like(light), scan).calibrate(phantom)
    (told,) = [p["text"] for p in empty.document["problems"] if p["code"] == "no_beads"]
    assert "transmissions" not in told
