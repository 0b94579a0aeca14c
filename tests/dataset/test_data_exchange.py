"""Data Exchange: images in closed form fit the geometry that is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from turned_balls import PITCH, SDD, SHAPE, SOD, VIEWS, integrals, worst

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

h5py = pytest.importorskip("h5py")
ANGLES = np.arange(VIEWS) * 360.0 / VIEWS
OPEN = 40_000.0
INSTRUMENT = "measurement/instrument"


def written(
    path: Path, members: dict[str, Any], lines: Any = None, flat: float = OPEN
) -> Path:
    """A file of images with two flat and dark ones; a member of None is left out."""
    lines = integrals(ANGLES) if lines is None else lines
    usual = {
        "implements": b"exchange:measurement",
        "exchange/data": (OPEN * np.exp(-lines) + 50).round().astype(np.uint16),
        "exchange/data_white": np.full((2, *SHAPE), flat + 50, np.uint16),
        "exchange/data_dark": np.full((2, *SHAPE), 50, np.uint16),
        "exchange/theta": (ANGLES, "deg"),
        f"{INSTRUMENT}/detector/pixel_size_x": (1000 * PITCH, "um"),
        f"{INSTRUMENT}/detector/pixel_size_y": (PITCH, "mm"),
    }
    with h5py.File(path, "w") as file:
        for place, value in (usual | members).items():
            if value is None:
                continue
            held, unit = value if isinstance(value, tuple) else (value, "")
            file[place] = held
            if unit:
                file[place].attrs["units"] = unit
    return path


def opened(path: Path) -> fx.DataSet:
    return fx.open(path, distances=(SOD, SDD))


@pytest.mark.parametrize(
    ("members", "lines"),
    [
        ({}, integrals(ANGLES)),
        ({"exchange/theta": (np.radians(ANGLES / 2), "rad")}, integrals(ANGLES / 2)),
        ({"exchange/theta": None, "process/acquisition/rotation/rotation_start": 7.0,
          "process/acquisition/rotation/rotation_step": 30.0}, integrals(ANGLES + 7.0)),
        ({f"{INSTRUMENT}/detector/pixel_size_x": None,
          f"{INSTRUMENT}/detector/x_pixel_size": (PITCH, "mm")}, integrals(ANGLES)),
    ],
)  # fmt: skip
def test_images_fit_the_geometry(members: Any, lines: Any, tmp_path: Path) -> None:
    for name in ("scan.h5", "scan.hdf5", "scan.hdf"):
        data = opened(written(tmp_path / name, members, lines))
        assert worst(data) < 2e-3
        assert len(data.warnings) == 1
    assert data.provenance.unknown == ()


def test_flat_images_of_another_exposure_are_scaled(tmp_path: Path) -> None:
    said = {
        f"{INSTRUMENT}/detector/exposure_time": (0.1, "s"),
        "process/acquisition/flat_fields/flat_exposure_time": (0.05, "s"),
        "process/acquisition/flat_fields/different_flat_exposure": b"Different",
    }
    data = opened(written(tmp_path / "scan.h5", said, flat=OPEN / 2))
    assert worst(data) < 2e-3
    assert any("multiplied by 2" in one for one in data.warnings)
    said["process/acquisition/flat_fields/different_flat_exposure"] = b"Same"
    told = opened(written(tmp_path / "same.h5", said)).warnings
    assert any("0.05 s, exposure_time 0.1 s" in one for one in told)


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"unknown_thing": 4}, "1 field not known to flexdt, ignored: unknown_thing = 4"),
        ({"process/acquisition/rotation/rotation_step": 20.0}, "220 deg by rotation_step"),
        ({"exchange/theta": ANGLES[:5], "process/acquisition/rotation/rotation_step": 30.0},
         "theta has 5 angles for 12 images"),
        ({f"{INSTRUMENT}/detector/x_pixel_size": (1.0, "mm")}, "x_pixel_size says 1 mm"),
        ({"exchange/center": 20.0}, "exchange/center 20, which is not applied"),
        ({"exchange/data_white": None}, "no exchange/data_white"),
    ],
)  # fmt: skip
def test_what_is_not_honoured_is_told(members: Any, words: str, tmp_path: Path) -> None:
    told = opened(written(tmp_path / "scan.h5", members)).warnings
    assert any(words in one for one in told), told


@pytest.mark.parametrize(
    ("members", "words"),
    [
        ({"exchange/theta": None}, "has no theta; give angles=DEGREES"),
        ({"exchange/theta": ANGLES[:5]}, "5 angles for 12 images"),
        ({f"{INSTRUMENT}/detector/pixel_size_x": (1.0, "ell")}, "is in 'ell'"),
        ({"exchange/data": np.zeros((3, 4))}, r"of shape 3 x 4"),
    ],
)
def test_the_impossible_is_refused(members: Any, words: str, tmp_path: Path) -> None:
    path = written(tmp_path / "scan.h5", members)
    with pytest.raises(DatasetError, match=words):
        opened(path)


def test_distances_are_asked_for_or_read(tmp_path: Path) -> None:
    path = written(tmp_path / "scan.h5", {})
    with pytest.raises(DatasetError, match=r"give distances=\(SOD_MM, SDD_MM\)"):
        fx.open(path)
    members = {f"{INSTRUMENT}/source/distance": (SOD / 1000, "m"),
               f"{INSTRUMENT}/detector/distance": ((SDD - SOD) / 10, "cm")}  # fmt: skip
    assert worst(fx.open(written(tmp_path / "far.h5", members))) < 2e-3
