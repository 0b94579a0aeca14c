"""Read Nikon's .xtekct and the TIFFs beside it.

As CIL's NikonDataReader 25.0 reads it (Apache-2.0; https://github.com/TomographicImaging/CIL):
images are seen from behind the panel, column 0 at the right as seen from the source; the stage
turns clockwise by `AngularStep` a view; images are counts under an open beam of `WhiteLevel`; the
axis stands `ObjectOffsetX` to the left of the line from the source to the panel's middle.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_set import Arrays
from flexdt.library.reading.listed_images import by_numbers, listed
from flexdt.runtime.files.dataset_folder import list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z


def read_nikon(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Nikon's.

    Args:
        path: the .xtekct file.
        geometry: one view for each projection, in place of the file's.

    Raises:
        DatasetError: the file lacks what is needed, or images are missing or of another shape.
    """
    said = dict(re.findall(r"^(\w+)=(.*?)\s*$", path.read_text("utf-8", "replace"), re.MULTILINE))
    views = int(_number(path, said, "Projections"))
    sod, sdd = (_number(path, said, key) for key in ("SrcToObject", "SrcToDetector"))
    across, down = (_number(path, said, f"DetectorPixelSize{axis}") for axis in "XY")
    size = [int(_number(path, said, f"DetectorPixels{axis}")) for axis in "YX"]
    top, bottom = (_number(path, said, f"CentreOfRotation{end}", 0.0) for end in ("Top", "Bottom"))
    aside = _number(path, said, "ObjectOffsetX", 0.5 * (top + bottom) * sod / sdd)
    lean = -np.rad2deg(np.arctan2(top - bottom, size[0] * down))
    tilts = _number(path, said, "ObjectRoll", lean), -_number(path, said, "ObjectTilt", 0.0)
    turn = np.deg2rad(
        _number(path, said, "InitialAngle", 0.0)
        + _number(path, said, "AngularStep") * np.arange(views)
    )
    place = np.array([[aside, -sod, 0.0], [aside, sdd - sod, 0.0], [-across, 0, 0], [0, 0, -down]])
    rows = (place @ _axis(*np.deg2rad(tilts)))[None] @ rotation_z(-turn)
    folder = list_folder(path.parent / said.get("InputFolderName", "").replace("\\", "/"))
    names = sorted((n for n in folder.names if n.lower().endswith((".tif", ".tiff"))),
                   key=by_numbers)  # fmt: skip
    cone = ConeVec(rows.reshape(views, 12)) if geometry is None else geometry
    data = listed(folder, cone, names, (), (), said.get("Name", ""))
    if list(data.shape) != size:
        raise DatasetFormatError(
            f"{path} says {size[1]} x {size[0]} pixels, {names[0]} has "
            f"{data.shape[1]} x {data.shape[0]}", {"asked": size, "allowed": list(data.shape)},
        )  # fmt: skip
    white = np.full((1, *data.shape), _number(path, said, "WhiteLevel"), np.float32)
    doubts = [
        f"{path.name} states {key} {said[key]}, which is not applied"
        for key in ("DetectorOffsetX", "DetectorOffsetY") if float(said.get(key, 0.0) or 0.0)
    ]  # fmt: skip
    arrays = Arrays(None, np.zeros_like(white), white)
    return replace(data, arrays=arrays, warnings=tuple(doubts))


def _number(path: Path, said: Mapping[str, str], key: str, default: float | None = None) -> float:
    text = said.get(key, "")
    try:
        if not text and default is not None:
            return default
        return float(text)
    except ValueError:
        raise DatasetFormatError(
            f"{path}: {key} is {text or 'missing'}; allowed: a number", {"missing": key}
        ) from None


def _axis(roll: float, tilt: float) -> FloatArray:
    """Takes rows of vectors into the frame whose z is the axis: rolled about y, tilted about x."""
    c, s = np.cos([roll, tilt]), np.sin([roll, tilt])
    rolled = np.array([[c[0], 0.0, s[0]], [0.0, 1.0, 0.0], [-s[0], 0.0, c[0]]])
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, c[1], -s[1]], [0.0, s[1], c[1]]])
    return np.asarray(tilted @ rolled)
