"""YXLON's ScanParameter.xml with its TIFFs: images in closed form fit the geometry."""

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
UNIT = 0.5
USUAL: dict[str, Any] = {
    "PixelSize/Width": PITCH, "PixelSize/Height": PITCH, "ProjectionSize/Width": SHAPE[1],
    "ProjectionSize/Height": SHAPE[0], "ProjectionBitdepth": 16,
    "ScanTrajectory/PixelPitch": UNIT, "ScanTrajectory/Fdd": SDD / UNIT,
    "ScanTrajectory/Fod": SOD / UNIT, "ScanTrajectory/YoCenter": 0,
    "ScanTrajectory/NumberOfProjections": VIEWS, "ScanTrajectory/StartAngle": 0,
    "ScanTrajectory/Rotation": 360, "DetectorOrientation": "Original",
}  # fmt: skip
HEAD = '<ScanParameter xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n<{0}>\n'


def written(
    folder: Path, said: dict[str, Any], lines: Any, kind: str = "CircleTrajectory"
) -> Path:
    (folder / "Projections").mkdir()
    for i, image in enumerate(lines):
        counts = np.rint(65535.0 * np.exp(-image)).astype(np.uint16)
        tifffile.imwrite(folder / "Projections" / f"p{i:04d}.tif", counts)
    groups: dict[str, str] = {}
    for name, value in (USUAL | said).items():
        group, _, key = name.rpartition("/")
        if value is not None:
            text = f"<{key}>{value}</{key}>\n" if group else str(value)
            groups[group or name] = groups.get(group or name, "") + text
    inner = ""
    for name, text in groups.items():
        mark = f' xsi:type="{kind}"' if name == "ScanTrajectory" else ""
        inner += f"<{name}{mark}>{text}</{name}>\n"
    name = "ConeBeamScanParameter"
    path = folder / "ScanParameter.xml"
    path.write_text(f"{HEAD.format(name)}{inner}</{name}>\n</ScanParameter>\n")
    return path


@pytest.mark.parametrize(
    ("said", "lines"),
    [
        ({}, integrals(-ANGLES)),
        ({"ScanTrajectory/Rotation": 180, "ScanTrajectory/StartAngle": 20},
         integrals(20.0 - ANGLES / 2)),
    ],
)  # fmt: skip
def test_images_fit_the_geometry(
    said: dict[str, Any], lines: Any, tmp_path: Path
) -> None:
    path = written(tmp_path, said, lines)
    for place in (path, tmp_path):
        data = fx.open(place)
        assert worst(data) < 2e-3
        assert data.warnings == ()


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({"ScanTrajectory/YoCenter": 3.5}, "YoCenter 3.5, which is not applied"),
        ({"DejustmentParameter/DetectorTiltA": 0.1}, "DetectorTiltA 0.1, which is not"),
        ({"DetectorFlipDirections": "Horizontal"}, "Horizontal, which is not applied"),
        (
            {"ScanTrajectory/unknown_thing": 3},
            "ignored: ScanTrajectory/unknown_thing = 3",
        ),
    ],
)
def test_what_is_not_honoured_is_told(
    said: dict[str, Any], words: str, tmp_path: Path
) -> None:
    told = fx.open(written(tmp_path, said, integrals(ANGLES))).warnings
    assert any(words in one for one in told), told


def test_the_impossible_is_refused(tmp_path: Path) -> None:
    (tmp_path / "helix").mkdir()
    path = written(tmp_path / "helix", {}, integrals(ANGLES), "HelixTrajectory")
    with pytest.raises(DatasetError, match="@type is HelixTrajectory; allowed: circle"):
        fx.open(path)
    (tmp_path / "flat").mkdir()
    path = written(tmp_path / "flat", {"ScanTrajectory/Fod": 0}, integrals(ANGLES))
    with pytest.raises(DatasetError, match="Fod is 0 mm"):
        fx.open(path)
