"""Which image is which: duplicates, gaps, previews, lost and blank files at the readers' doors."""

import re

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.geometry.cone_vec import ConeVec

VIEWS, SHAPE = 9, (6, 8)


def scan(views=VIEWS):
    return ConeVec.circular(sod=100, sdd=200, angles=views, pixel=1)


def written(folder, names):
    """Images whose pixels are their place in the list, from 1."""
    for i, name in enumerate(names):
        tifffile.imwrite(folder / name, np.full(SHAPE, i + 1, np.uint16))
    tifffile.imwrite(folder / "io.tif", np.full(SHAPE, 100, np.uint16))


def saved(folder):
    counts = np.full((VIEWS, *SHAPE), 50) + np.arange(VIEWS)[:, None, None]
    data = fx.DataSet.from_arrays(
        counts, scan(), flat=np.full(SHAPE, 100), dark=np.ones(SHAPE)
    )
    data.save(folder)


def test_numbers_of_every_kind_are_read_in_order(tmp_path):
    names = [f"p_{x}.tif" for x in (-20, -10, -0.5, 0, 0.25, 0.5, 9, 10, 100)]
    written(tmp_path, names)
    data = fx.read_tiffs(tmp_path, scan())
    assert [int(data.counts(i)[0, 0]) for i in range(VIEWS)] == [*range(1, VIEWS + 1)]


@pytest.mark.parametrize(
    "twin", ["scan_000003.tiff", "scan_3.tif", "SCAN_0003.TIF", "io_0.tif"]
)
@pytest.mark.parametrize("texts", [True, False])
def test_two_files_of_one_number_are_refused(tmp_path, twin, texts):
    folder = tmp_path / "scan"
    saved(folder)
    (folder / twin).write_bytes((folder / "scan_000001.tif").read_bytes())
    with pytest.raises(DatasetError, match=re.escape(twin)):
        fx.open(folder, ignore_document=texts)


def test_two_files_of_one_number_are_refused_among_anybodys(tmp_path):
    written(tmp_path, [f"scan_{i}.tif" for i in range(VIEWS)])
    (tmp_path / "scan_03.tif").write_bytes((tmp_path / "scan_1.tif").read_bytes())
    with pytest.raises(DatasetError, match=r"scan_03.tif and scan_3.tif have one number"):
        fx.read_tiffs(tmp_path, scan(VIEWS + 1))


def test_an_image_of_another_name_is_left_out_or_said(tmp_path):
    written(tmp_path, [f"X_{40 * i:03d}.tif" for i in range(VIEWS)])
    (tmp_path / "X_180deg.tif").write_bytes((tmp_path / "X_000.tif").read_bytes())
    data = fx.read_tiffs(tmp_path, scan())
    assert [int(data.counts(i)[0, 0]) for i in range(VIEWS)] == [*range(1, VIEWS + 1)]
    assert any("X_180deg.tif is named otherwise" in doubt for doubt in data.warnings)
    (tmp_path / "X_320.tif").unlink()
    data = fx.read_tiffs(tmp_path, scan())
    assert any("X_180deg.tif is named otherwise" in doubt for doubt in data.warnings)


def test_a_gap_in_the_numbers_is_said(tmp_path):
    written(tmp_path, [f"scan_{i}.tif" for i in range(VIEWS + 1) if i != 4])
    data = fx.read_tiffs(tmp_path, scan())
    assert any(
        "1 image is missing between scan_3.tif and scan_5.tif" in d for d in data.warnings
    )


@pytest.mark.parametrize("blank", [1, 3, VIEWS])
@pytest.mark.parametrize("texts", [True, False])
def test_frames_without_anything_recorded_are_missing(tmp_path, blank, texts):
    folder = tmp_path / "scan"
    saved(folder)
    for i in range(VIEWS - blank, VIEWS):
        tifffile.imwrite(folder / f"scan_{i:06d}.tif", np.zeros(SHAPE, np.uint16))
    data = fx.open(folder, ignore_document=texts)
    assert not data.complete
    assert "nothing was recorded" in data.reason
    assert data.present == tuple(range(VIEWS - blank))


def test_a_dark_frame_that_is_not_blank_is_kept(tmp_path):
    folder = tmp_path / "scan"
    saved(folder)
    almost = np.zeros(SHAPE, np.uint16)
    almost[0, 0] = 1
    tifffile.imwrite(folder / f"scan_{VIEWS - 1:06d}.tif", almost)
    assert fx.open(folder).complete
