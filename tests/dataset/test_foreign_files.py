"""Nikon's and NeXus's files, written here with a forward model of our own."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
import tifffile
from four_balls import COLS, PIXEL, ROWS, SDD, SOD, VIEWS, WHITE, found, images

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError


def xtekct(
    folder: Path,
    *,
    aside: float,
    start: float,
    sense: float = 1.0,
    roll: float = 0.0,
    said: Mapping[str, object] | None = None,
) -> Path:
    """A folder as Nikon's software leaves it: images as seen from behind the panel."""
    folder.mkdir(exist_ok=True)
    for view, image in enumerate(images(aside, start, sense, roll)):
        counts = np.rint(WHITE * image[:, ::-1]).astype(np.uint16)
        tifffile.imwrite(folder / f"part_{view + 1:04d}.tif", counts)
    lines = {
        "Name": "part", "Projections": VIEWS, "WhiteLevel": WHITE, "DetectorPixelsX": COLS,
        "DetectorPixelsY": ROWS, "DetectorPixelSizeX": PIXEL, "DetectorPixelSizeY": PIXEL,
        "SrcToObject": SOD, "SrcToDetector": SDD, "InitialAngle": np.rad2deg(start),
        "AngularStep": 360.0 / VIEWS, "ObjectOffsetX": aside, "ObjectRoll": np.rad2deg(roll),
        "InputFolderName": "", **(said or {}),
    }  # fmt: skip
    text = "[XTekCT]\r\n" + "".join(f"{key}={value}\r\n" for key, value in lines.items())
    path = folder / "part.xtekct"
    path.write_text(text)
    return path


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.daily(1)
def test_nikon_scans_come_back_as_they_are(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    path = xtekct(
        tmp_path, aside=float(rng.uniform(-1.5, 1.5)), start=float(rng.uniform(0.0, 6.0)),
        roll=float(rng.choice([0.0, 0.05])),
    )  # fmt: skip
    data = fx.open(path)
    assert (len(data), data.shape, data.name) == (VIEWS, (ROWS, COLS), "part")
    volume = data.reconstruct("fdk", voxel=0.2, shape=(40, 60, 60))
    np.testing.assert_allclose(found(volume), 1.0, atol=0.04)
    half = data[::2]  # slices read the same files
    np.testing.assert_array_equal(half.counts(3), data.counts(6))


@pytest.mark.filterwarnings("ignore:no accuracy is claimed")  # rightly
@pytest.mark.parametrize("wrong", ["sense", "ObjectOffsetX", "ObjectRoll", "mirrored"])
@pytest.mark.daily(1)
def test_the_phantom_would_show_a_wrong_convention(wrong: str, tmp_path: Path) -> None:
    """What the reader must not do is seen by the test above."""
    other = {"ObjectOffsetX": -1.0, "ObjectRoll": -0.12 * 180 / np.pi}
    path = xtekct(
        tmp_path, aside=1.0, start=0.3, roll=0.12, sense=-1.0 if wrong == "sense" else 1.0,
        said={wrong: other[wrong]} if wrong in other else None,
    )  # fmt: skip
    if wrong == "mirrored":
        for file in tmp_path.glob("*.tif"):
            tifffile.imwrite(file, tifffile.imread(file)[:, ::-1])
    volume = fx.open(path).reconstruct("fdk", voxel=0.2, shape=(40, 60, 60))
    assert np.abs(found(volume) - 1.0).max() > 0.1


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        ({"SrcToObject": ""}, "SrcToObject is missing"),
        ({"AngularStep": "two"}, "AngularStep is two; allowed: a number"),
        ({"Projections": 7}, "180 projections and 7 views"),
        ({"DetectorPixelsX": 99}, "says 99 x 60 pixels, part_0001.tif has 72 x 60"),
        ({"InputFolderName": "elsewhere"}, "elsewhere"),
    ],
)
def test_what_a_nikon_file_lacks_is_named(
    said: dict[str, object], sentence: str, tmp_path: Path
) -> None:
    path = xtekct(tmp_path, aside=0.0, start=0.0, said=said)
    with pytest.raises((DatasetError, fx.TwinError), match=sentence):
        fx.open(path)


def test_an_offset_of_the_detector_is_not_passed_over_in_silence(tmp_path: Path) -> None:
    path = xtekct(tmp_path, aside=0.0, start=0.0, said={"DetectorOffsetX": 3.0})
    assert "DetectorOffsetX 3.0, which is not applied" in fx.open(path).warnings[0]


def test_another_geometry_takes_the_place_of_nikons(tmp_path: Path) -> None:
    path = xtekct(tmp_path, aside=0.0, start=0.0)
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=VIEWS, pixel=1.0)
    np.testing.assert_array_equal(fx.open(path, geometry=scan).geometry.rows, scan.rows)


def test_nxtomo_comes_back(tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    scan = fx.ConeVec.circular(
        sod=SOD, sdd=SDD, angles=24, shape=(ROWS, COLS), pixel=PIXEL
    )
    data = fx.simulate("lego", scan, noise=1)
    data.to_nxtomo(tmp_path / "scan.nx")
    again = fx.open(tmp_path / "scan.nx")
    assert again.geometry == data.geometry
    np.testing.assert_array_equal(again.counts(), data.counts())
    np.testing.assert_allclose(again.line_integrals(), data.line_integrals(), atol=1e-3)


def test_nxtomo_of_others_asks_for_the_geometry(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    frames = np.full((7, 4, 6), 500, np.uint16)
    frames[0], frames[1] = 10, 1000
    with h5py.File(tmp_path / "k11.h5", "w") as file:
        file["entry1/tomo_entry/instrument/detector/data"] = frames
        file["entry1/tomo_entry/instrument/detector/image_key"] = [2, 1, 0, 0, 0, 3, 0]
    with pytest.raises(DatasetError, match=r"give geometry=fx\.ConeVec\.circular"):
        fx.open(tmp_path / "k11.h5")
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=4, pixel=1.0)
    data = fx.open(tmp_path / "k11.h5", geometry=scan)
    assert (len(data), data.dark.max(), data.flat.min()) == (4, 10.0, 1000.0)
    assert "1 images are marked as invalid" in data.warnings[-1]
    np.testing.assert_allclose(data.line_integrals(), -np.log(490.0 / 990.0), rtol=1e-5)


@pytest.mark.parametrize("name", ["scan.h5", "scan.xyz"])
def test_other_files_are_told_what_is_read(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"\x89 nothing")
    with pytest.raises(DatasetError, match=r"read_tiffs|no HDF5 file"):
        fx.open(tmp_path / name)
