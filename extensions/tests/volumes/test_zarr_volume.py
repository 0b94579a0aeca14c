"""Volumes as OME-NGFF: values and place come back, and another reader sees the same."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zarr
from numpy.testing import assert_allclose, assert_array_equal

import flexdt as fx
from flexdt.extending import volume_writer

DATA = np.random.default_rng(3).random((5, 6, 7)).astype(np.float32)
VOLUME = fx.Volume(DATA, 0.25, (1.5, -2.0, 3.0))
FIRST = [1.5 - 3 * 0.25, -2.0 - 2.5 * 0.25, 3.0 - 2 * 0.25]
"""Centre of voxel (0, 0, 0), x, y, z [mm]."""


def test_a_volume_comes_back(tmp_path: Path) -> None:
    file = tmp_path / "v.zarr"
    for _ in range(2):  # a volume that is there is replaced
        VOLUME.save(str(file))
    back = fx.Volume.load(file)
    assert_array_equal(back.data, DATA)
    assert_allclose(back.voxel_xyz, VOLUME.voxel_xyz)
    assert_allclose(back.center_mm, VOLUME.center_mm)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]


def test_zarr_states_the_place(tmp_path: Path) -> None:
    VOLUME.save(tmp_path / "v.zarr")
    group = zarr.open_group(tmp_path / "v.zarr", mode="r")
    about = group.attrs["ome"]
    assert about["version"] == "0.5"
    (scale,) = about["multiscales"]
    assert [a["name"] for a in scale["axes"]] == ["z", "y", "x"]
    kinds = [t["type"] for t in scale["datasets"][0]["coordinateTransformations"]]
    assert kinds == ["scale", "translation"]
    moved = scale["datasets"][0]["coordinateTransformations"][1]["translation"]
    assert_allclose(moved, FIRST[::-1])
    assert_array_equal(group[scale["datasets"][0]["path"]][:], DATA)


def test_slabs_one_after_the_other_are_the_whole(tmp_path: Path) -> None:
    file = tmp_path / "v.zarr"
    with volume_writer(file, fx.Grid(VOLUME.shape, 0.25, VOLUME.center_mm)) as write:
        for first in (0, 2, 4):
            write(DATA[first : first + 2])
    assert_array_equal(fx.Volume.load(file).data, DATA)


def test_a_writer_that_fails_leaves_nothing(tmp_path: Path) -> None:
    with (
        pytest.raises(RuntimeError),
        volume_writer(tmp_path / "v.zarr", fx.Grid((2, 2, 2), 1.0)),
    ):
        raise RuntimeError
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_no_volume_is_neither_read_nor_replaced(tmp_path: Path) -> None:
    kept = tmp_path / "v.zarr" / "letter.txt"
    kept.parent.mkdir()
    kept.write_text("dear reader")
    with pytest.raises(fx.TwinError, match="not a volume"):
        fx.Volume.load(kept.parent)
    with pytest.raises(OSError, match="not empty"):
        VOLUME.save(kept.parent)
    assert [p.name for p in tmp_path.rglob("*")] == ["v.zarr", "letter.txt"]
