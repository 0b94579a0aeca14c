"""Volumes as OME-NGFF: values and place come back, and another reader sees the same."""

from __future__ import annotations

import json
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


def test_voxels_of_three_edges(tmp_path: Path) -> None:
    """OME-NGFF: a voxel's centre is its index times scale plus translation, at each level."""
    values = np.random.default_rng(3).normal(size=(6, 5, 140)).astype(np.float32)
    edges, centre = np.array([0.5, 0.25, 1.5]), np.array([6.2, -6.4, 11.0])
    file = tmp_path / "oblong.zarr"
    fx.Volume(values, tuple(edges), tuple(centre)).save(file)
    back = fx.Volume.load(file)
    np.testing.assert_array_equal(back.data, values)
    np.testing.assert_allclose(back.voxel_mm, edges)
    np.testing.assert_allclose(back.center_mm, centre)
    (scales,) = json.loads((file / "zarr.json").read_text())["attributes"]["ome"][
        "multiscales"
    ]
    low = (centre - (np.array([140, 5, 6]) - 1) / 2 * edges)[::-1]
    for level, said in enumerate(scales["datasets"]):
        scale, place = said["coordinateTransformations"]
        np.testing.assert_allclose(scale["scale"], edges[::-1] * 2**level)
        corner = np.array(place["translation"]) - np.array(scale["scale"]) / 2
        np.testing.assert_allclose(corner, low - edges[::-1] / 2)
