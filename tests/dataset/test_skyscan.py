"""SkyScan's .log with its TIFFs: images in closed form fit the geometry that is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from turned_balls import PITCH, SDD, SHAPE, SOD, VIEWS, integrals, worst

import flexdt as fx
from flexdt.twin.dataset.dataset_errors import DatasetError

STEP = 360.0 / VIEWS
WHITE = 58_000.0
USUAL: dict[str, Any] = {
    "Filename Prefix": "bone_", "Number of Files": VIEWS, "Number of Rows": SHAPE[0],
    "Number of Columns": SHAPE[1], "Object to Source (mm)": SOD,
    "Camera to Source (mm)": SDD, "Image Pixel Size (um)": 1000.0 * PITCH * SOD / SDD,
    "Rotation Step (deg)": STEP, "Use 360 Rotation": "YES", "Rotation Direction": "CC",
    "Image Format": "TIFF", "Depth (bits)": 16, "Reference Intensity": WHITE,
    "Optical Axis (line)": (SHAPE[0] - 1) / 2, "Random Movement": "OFF (30)",
    "Image Rotation": "0.0000", "Scanning Trajectory": "ROUND",
}  # fmt: skip


def written(
    folder: Path, said: dict[str, Any], lines: Any, white: float = WHITE, more: str = ""
) -> Path:
    """A scan as SkyScan's software leaves it: sections System and Acquisition."""
    for i, image in enumerate(lines):
        counts = np.rint(white * np.exp(-image)).astype(np.uint16)
        tifffile.imwrite(folder / f"bone_{i:08d}.tif", counts)
    tifffile.imwrite(folder / "bone__spr.tif", np.zeros((4, 4), np.uint16))
    text = "[System]\nScanner=SkyScan1275\nCamera X/Y Ratio=1.0000\n[Acquisition]\n"
    kept = {k: v for k, v in (USUAL | said).items() if v is not None}
    text += "".join(f"{key}= {value}\r\n" for key, value in kept.items())
    path = folder / "bone_.log"
    path.write_text(f"{text}{more}")
    return path


ANGLES = STEP * np.arange(VIEWS)


def test_bitmaps_of_8_bits_are_read(tmp_path: Path) -> None:
    said = {"Image Format": "BMP", "Depth (bits)": 8, "Reference Intensity": None}
    path = written(tmp_path, said, integrals(ANGLES))
    for i, image in enumerate(integrals(ANGLES)):
        counts = np.rint(255.0 * np.exp(-image)).astype(np.uint8)
        Image.fromarray(counts).save(tmp_path / f"bone_{i:08d}.bmp")
    data = fx.open(path)
    assert data.frames[0].file.endswith(".bmp")
    assert worst(data) < 0.02  # half a count of 255
    assert any("the open beam is 255" in one for one in data.warnings)
    path.write_text(path.read_text().replace("BMP", "PCX"))
    with pytest.raises(DatasetError, match="Image Format is pcx; allowed: TIFF or BMP"):
        fx.open(path)


@pytest.mark.parametrize(
    ("said", "lines"),
    [
        ({}, integrals(ANGLES)),
        ({"Rotation Direction": "CW"}, integrals(-ANGLES)),
        ({"Optical Axis (line)": 12}, integrals(ANGLES, row=SHAPE[0] - 1 - 12.0)),
        ({"Scanning Start Angle": 25.0}, integrals(ANGLES + 25.0)),
        ({"Number of Files": None, "Number Of Files": VIEWS}, integrals(ANGLES)),
        ({"Image Pixel Size (um)": None, "Camera Pixel Size (um)": 500.0 * PITCH,
          "Camera binning": "2x2"}, integrals(ANGLES)),
        ({"Rotation Step (deg)": "15,0", "Use 360 Rotation": "NO"},
         integrals(15.0 * np.arange(VIEWS))),
    ],
)  # fmt: skip
def test_images_fit_the_geometry(
    said: dict[str, Any], lines: Any, tmp_path: Path
) -> None:
    data = fx.open(written(tmp_path, said, lines))
    assert worst(data) < 2e-3
    (told,) = data.warnings
    assert "sense of rotation is assumed" in told
    # The preview is no projection by SkyScan's names


def test_a_csv_has_the_shift_of_each_view(tmp_path: Path) -> None:
    shifts = np.random.default_rng(3).uniform(-6.0, 6.0, (VIEWS, 2))
    lines = np.concatenate([
        integrals([angle], column=(SHAPE[1] - 1) / 2 - right / 2,
                  row=(SHAPE[0] - 1) / 2 + up / 2)
        for angle, (right, up) in zip(ANGLES, shifts, strict=True)
    ])  # fmt: skip
    path = written(
        tmp_path, {"Camera binning": "2x2", "Random Movement": "ON (6)"}, lines
    )
    rows = "".join(f"{i},{x},{y}\n" for i, (x, y) in enumerate(shifts.tolist()))
    (tmp_path / "bone__TS.csv").write_text("head\n" * 5 + rows)
    data = fx.open(path)
    assert worst(data) < 2e-3
    assert not any("Random" in one for one in data.warnings)
    (tmp_path / "bone__TS.csv").write_text("head\n" * 5 + rows[:9])
    told = fx.open(path).warnings
    assert any("for 12 views: it is not used" in one for one in told)


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"Reference Intensity": None}, "no Reference Intensity; the open beam is 65535"),
        ({"Random Movement": "ON (30)"}, "Random Movement ON (30), which is not applied"),
        ({"Image Rotation": "0.35"}, "Image Rotation 0.35, which is not applied"),
        ({"Use 360 Rotation": "NO"}, "12 views of 30 deg are 360 deg, which is taken"),
        ({"Camera Pixel Size (um)": 700.0}, "Camera Pixel Size (um) says 0.7 mm, Image"),
        ({"unknown_thing": "3 x"}, "1 field not known to flexdt, ignored: unknown_thing = 3 x"),
        ({"Number of connected scans": 2}, "this file is one of them"),
    ],
)  # fmt: skip
def test_what_is_not_honoured_is_told(
    said: dict[str, Any], words: str, tmp_path: Path
) -> None:
    told = fx.open(written(tmp_path, said, integrals(ANGLES))).warnings
    assert any(words in one for one in told), told


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"Scanning Trajectory": "SPIRAL"}, "is SPIRAL; allowed: .*give geometry="),
        ({"Object to Source (mm)": 900.0}, "Object to Source .mm. is 900 mm"),
        ({"Number of Rows": 99}, "says 48 x 99 pixels"),
        ({"Rotation Step (deg)": "x"}, r"Rotation Step \(deg\) is x; allowed: a number"),
        ({"Rotation Step (deg)": None}, r"Rotation Step \(deg\) is missing"),
        ({"Rotation Direction": "UP"}, "Direction is UP; allowed: CC"),
        ({"Reference Intensity": 0}, "Reference Intensity is 0"),
    ],
)
def test_the_impossible_is_refused(
    said: dict[str, Any], words: str, tmp_path: Path
) -> None:
    path = written(tmp_path, said, integrals(ANGLES))
    with pytest.raises(DatasetError, match=words):
        fx.open(path)


def test_other_logs_are_not_taken_for_scans(tmp_path: Path) -> None:
    (tmp_path / "server.log").write_text("12:00 started\n")
    with pytest.raises(DatasetError, match="is a file; allowed"):
        fx.open(tmp_path / "server.log")
    (tmp_path / "scan").mkdir()
    path = written(tmp_path / "scan", {}, integrals(ANGLES))
    (tmp_path / "scan" / "other.log").write_text("noise\n")
    assert len(fx.open(path.parent)) == VIEWS
