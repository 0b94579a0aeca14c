"""The quick TIFF reader: the same pixels as the general decoder, or None."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import tifffile

from flexdt.clients.quick_tiff import read_plain

IMAGE = np.arange(7 * 11, dtype=np.uint16).reshape(7, 11) * 701 % 65521


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("rows", [None, 2, 7])
def test_plain_images_of_either_byte_order_and_any_strips(
    tmp_path: Path, order: str, rows: int | None
) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, IMAGE, byteorder=order, rowsperstrip=rows)
    found = read_plain(path)
    assert found is not None
    assert found.dtype == np.uint16
    assert np.array_equal(found, tifffile.imread(path))


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "zlib"},
        {"tile": (16, 16)},
        {"photometric": "miniswhite"},
        {"bigtiff": True},
    ],
)
def test_anything_else_is_left_to_the_general_decoder(
    tmp_path: Path, options: dict[str, object]
) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, IMAGE, **options)
    assert read_plain(path) is None


def test_other_pixels_other_counts_of_images_and_broken_files(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, IMAGE.astype(np.float32))
    assert read_plain(path) is None
    tifffile.imwrite(path, np.stack([IMAGE, IMAGE]), photometric="minisblack")
    assert read_plain(path) is None
    tifffile.imwrite(path, IMAGE)
    whole = path.read_bytes()
    for end in range(0, len(whole), 9):
        path.write_bytes(whole[:end])
        found = read_plain(path)
        assert found is None or np.array_equal(found, IMAGE)
    assert read_plain(tmp_path / "missing.tif") is None
