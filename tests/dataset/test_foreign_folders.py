"""Folders and images of other programs: read, or the way to read them is said."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

VIEWS, SHAPE = 3, (6, 8)
SCAN = fx.ConeVec.circular(sod=100, sdd=200, angles=VIEWS, pixel=0.2)


def images(kind: str) -> np.ndarray[Any, Any]:
    rng = np.random.default_rng(7)
    return rng.integers(20, 120, (VIEWS, *SHAPE)).astype(kind)


@pytest.mark.parametrize("kind", ["u1", "u2", "i2"])
def test_counts_of_these_kinds_are_read(tmp_path: Path, kind: str) -> None:
    for i, image in enumerate(images(kind)):
        tifffile.imwrite(tmp_path / f"p{i}.tif", image)
    tifffile.imwrite(tmp_path / "io0.tif", np.full(SHAPE, 120, kind))
    data = fx.read_tiffs(tmp_path, SCAN)
    np.testing.assert_array_equal(data.counts(), images(kind).astype(np.uint16))
    assert data.counts().dtype == np.uint16


@pytest.mark.parametrize("packing", ["none", "deflate", "LZW", "PackBits"])
def test_counts_below_zero_are_refused(tmp_path: Path, packing: str) -> None:
    """Whatever their compression; with a flat image they are intensities less the dark ones."""
    low = images("i2")
    low[0, 2, 3] = -5
    number = {"none": 1, "LZW": 5, "deflate": 8, "PackBits": 32773}[packing]
    for i, image in enumerate(low):
        file = tmp_path / f"p{i}.tif"
        cv2.imwrite(str(file), image, [cv2.IMWRITE_TIFF_COMPRESSION, number])
    with pytest.raises(
        DatasetError,
        match=r"counts of int16 from -5 to 119; allowed: whole numbers from 0",
    ):
        fx.read_tiffs(tmp_path, SCAN)
    data = fx.read_tiffs(tmp_path, SCAN, flat=120)
    np.testing.assert_allclose(
        data.line_integrals()[1:], np.log(120 / low[1:]), rtol=1e-5
    )


@pytest.mark.parametrize("door", ["file", "folder"])
def test_several_images_in_one_file_are_read(tmp_path: Path, door: str) -> None:
    file = tmp_path / "all.tif"
    tifffile.imwrite(file, images("u2"), photometric="minisblack")
    data = fx.read_tiffs(file if door == "file" else tmp_path, SCAN)
    np.testing.assert_array_equal(data.counts(), images("u2"))
    np.testing.assert_array_equal(data[1:].counts(0), images("u2")[1])
    assert len(fx.open(file, geometry=SCAN, views="::2")) == 2


def test_a_folder_with_one_scan_of_another_program_is_opened(tmp_path: Path) -> None:
    """As the file itself; with two of them the folder says how each is opened."""
    said = {
        "Name": "bolt", "Projections": VIEWS, "SrcToObject": 100, "SrcToDetector": 200,
        "DetectorPixelsX": SHAPE[1], "DetectorPixelsY": SHAPE[0], "DetectorPixelSizeX": 0.2,
        "DetectorPixelSizeY": 0.2, "AngularStep": 120, "WhiteLevel": 60000,
    }  # fmt: skip
    text = "[XTekCT]\n" + "".join(f"{key}={value}\n" for key, value in said.items())
    (tmp_path / "bolt.xtekct").write_text(text)
    for i, image in enumerate(images("u2")):
        tifffile.imwrite(tmp_path / f"bolt_{i + 1:04d}.tif", image)
    data = fx.open(tmp_path)
    np.testing.assert_array_equal(data.counts(), images("u2"))
    np.testing.assert_array_equal(
        data.geometry.rows, fx.open(tmp_path / "bolt.xtekct").geometry.rows
    )
    (tmp_path / "other.xtekct").write_text(text)
    with pytest.raises(
        DatasetError, match=r"it holds a scan of Nikon: fx\.open\('.*bolt\.xtekct'\)"
    ):
        fx.open(tmp_path)
    for file in tmp_path.glob("*.xtekct"):
        file.unlink()
    with pytest.raises(
        DatasetError,
        match=r"but 3 other TIFFs, which fx\.read_tiffs\(FOLDER, geometry\) reads",
    ):
        fx.open(tmp_path)
