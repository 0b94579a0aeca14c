"""The TIFF reader: every uint16 image that tifffile can read, and a typed error for the
rest."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from flexdt.runtime.files.dataset_folder import read_image, tiff_bytes
from flexdt.twin.dataset.dataset_errors import (
    DatasetError,
    DatasetFormatError,
    DatasetMissingError,
)

IMAGE = np.arange(7 * 11, dtype=np.uint16).reshape(7, 11) * 701 % 65521


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("rows", [None, 2, 7])
def test_plain_images_of_either_byte_order_and_any_strips(
    tmp_path: Path, order: str, rows: int | None
) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, IMAGE, byteorder=order, rowsperstrip=rows)
    found = read_image(path)
    assert found.dtype == np.uint16
    assert np.array_equal(found, IMAGE)


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "zlib"},
        {"tile": (16, 16)},
        {"bigtiff": True},
    ],
)
def test_other_forms_of_the_same_image(
    tmp_path: Path, options: dict[str, object]
) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, IMAGE, **options)
    assert np.array_equal(read_image(path), IMAGE)


def test_other_pixels_other_counts_of_images_and_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    for other, why in (
        (IMAGE.astype(np.float32), "float32 numbers; allowed: uint16"),
        (np.stack([IMAGE, IMAGE]), "holds 2 images; allowed: one"),
    ):
        tifffile.imwrite(path, other, photometric="minisblack")
        with pytest.raises(DatasetError, match=why):
            read_image(path)
    tifffile.imwrite(path, IMAGE)
    whole = path.read_bytes()
    for end in range(0, len(whole), 9):
        path.write_bytes(whole[:end])
        try:
            found = read_image(path)
        except DatasetError:
            continue
        assert np.array_equal(found, IMAGE)
    with pytest.raises(DatasetMissingError):
        read_image(tmp_path / "missing.tif")


def test_pixels_begin_at_byte_8_where_the_scanners_readers_look_for_them(
    tmp_path: Path,
) -> None:
    rng = np.random.default_rng(8)
    for rows, cols in ((1, 1), (5, 7), (760, 956)):
        image = rng.integers(0, 65536, (rows, cols), dtype=np.uint16)
        raw = tiff_bytes(image)
        blind = np.frombuffer(raw, "<u2", rows * cols, 8).reshape(rows, cols)
        np.testing.assert_array_equal(blind, image)
        path = tmp_path / f"{rows}.tif"
        path.write_bytes(raw)
        np.testing.assert_array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), image)
        np.testing.assert_array_equal(read_image(path), image)
        with tifffile.TiffFile(path) as file:
            assert file.pages[0].software == "flexdt"
            assert file.pages[0].is_contiguous
        path.write_bytes(raw[:-5])
        with pytest.raises(DatasetFormatError):
            read_image(path)
