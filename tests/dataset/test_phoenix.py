"""Waygate's .pca with its TIFFs: images in closed form fit the geometry that is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from turned_balls import PITCH, SDD, SHAPE, SOD, VIEWS, integrals, worst

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

ANGLES = 360.0 / VIEWS * np.arange(VIEWS)
USUAL: dict[str, Any] = {
    "Geometry/FDD": SDD, "Geometry/FOD": SOD, "Geometry/Magnification": SDD / SOD,
    "Geometry/VoxelSizeX": PITCH * SOD / SDD, "Geometry/VoxelSizeY": PITCH * SOD / SDD,
    "Geometry/cx": (SHAPE[1] - 1) / 2, "Geometry/cy": (SHAPE[0] - 1) / 2,
    "CT/NumberImages": VIEWS, "CT/RotationSector": 360.0, "CT/FreeRayFactor": 1.0,
    "CalibValue/NumberImages": 18, "Image/DimX": SHAPE[1], "Image/DimY": SHAPE[0],
    "Image/FreeRay": 30000, "Detector/PixelsizeX": PITCH, "Trajectory/Active": 0,
}  # fmt: skip


def written(folder: Path, said: dict[str, Any], lines: Any, white: float = 3e4) -> Path:
    for i, image in enumerate(lines):
        counts = np.rint(white * np.exp(-image)).astype(np.uint16)
        tifffile.imwrite(folder / f"part_{i + 1:04d}.tif", counts)
    text, at = "[General]\nVersion=2.8\n", ""
    for name, value in (USUAL | said).items():
        section, key = name.split("/")
        if value is not None:
            text += (f"[{section}]\n" if section != at else "") + f"{key}={value}\n"
            at = section
    path = folder / "part.pca"
    path.write_text(text)
    return path


@pytest.mark.parametrize(
    ("said", "lines", "white"),
    [
        ({}, integrals(ANGLES), 3e4),
        ({"Geometry/cx": 30.0, "Geometry/cy": 12.0},
         integrals(ANGLES, column=30.0, row=12.0), 3e4),
        ({"CT/RotationSector": 180.0}, integrals(ANGLES / 2), 3e4),
        ({"CT/FreeRayFactor": 1.1}, integrals(ANGLES), 3.3e4),
        ({"Geometry/VoxelSizeX": None, "Geometry/VoxelSizeY": None,
          "Detector/PixelsizeY": PITCH}, integrals(ANGLES), 3e4),
    ],
)  # fmt: skip
def test_images_fit_the_geometry(
    said: dict[str, Any], lines: Any, white: float, tmp_path: Path
) -> None:
    data = fx.open(written(tmp_path, said, lines, white))
    assert worst(data) < 2e-3
    (told,) = data.warnings
    assert "sense of rotation is assumed" in told


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"Geometry/CalibValue": -1.097}, "CalibValue -1.097, which is not applied"),
        ({"Geometry/Magnification": 3.0}, "Geometry/Magnification says 3, Geometry/FDD"),
        ({"Detector/PixelsizeX": 0.2}, "Detector/PixelsizeX says 0.2 mm"),
        ({"Image/MirrorX": 1}, "Image/MirrorX 1, which is not applied"),
        ({"CT/unknown_thing": 3}, "ignored: CT/unknown_thing = 3"),
    ],
)
def test_what_is_not_honoured_is_told(
    said: dict[str, Any], words: str, tmp_path: Path
) -> None:
    told = fx.open(written(tmp_path, said, integrals(ANGLES))).warnings
    assert any(words in one for one in told), told


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"Trajectory/Active": 1}, "Trajectory/Active is 1; allowed: .*give geometry="),
        ({"Geometry/FOD": 0.0}, "FOD is 0 mm"),
        ({"Image/FreeRay": None}, "Image/FreeRay is missing"),
        ({"Geometry/FDD": "far"}, "Geometry/FDD is far; allowed: a number"),
    ],
)
def test_the_impossible_is_refused(
    said: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = written(tmp_path, said, integrals(ANGLES))
    with pytest.raises(DatasetError, match=words):
        fx.open(path)
