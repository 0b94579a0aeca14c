"""Read Nikon's .xtekct and its TIFFs.

As CIL's NikonDataReader 25.0 reads it (Apache-2.0;
https://github.com/TomographicImaging/CIL): images are seen from behind the panel, column
0 at the right as seen from the source; the stage turns clockwise by `AngularStep` a view;
images are counts under an open beam of `WhiteLevel`; the axis is `ObjectOffsetX` to the
left of the line from the source to the panel's middle.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_set import Arrays
from flexdt.library.reading.foreign_parsing import head_text
from flexdt.library.reading.listed_images import NO_DARK, listed
from flexdt.runtime.files.dataset_folder import Folder, list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z
from flexdt.twin.plausibility import PlausibilityCode, settled
from flexdt.twin.plausibility.image_order import ordered
from flexdt.twin.plausibility.scan_geometry import distance_findings

LINE: Final = re.compile(r"^[ \t]*(\w+)[ \t]*=[ \t]*(.*?)\s*$", re.MULTILINE)
PROJECTION: Final = re.compile(r"(.*?)(\d+)(\.tiff?)", re.IGNORECASE)
MOST_VIEWS: Final = 1_000_000
DECIMAL_COMMA: Final = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")
"""A number as programs of some countries write it."""


def read_nikon(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Nikon's; its images stay in their files.

    They are in `InputFolderName`, beside the file by default. The axis is placed and
    leant as the file's object offset, roll and tilt, or else CentreOfRotation, state. The
    white level of the file serves as flat image, the dark one is zero; detector offsets
    are not applied and become warnings.

    Args:
        path: the .xtekct file.
        geometry: one view for each projection, in place of the file's; the file must
            state its numbers all the same, but impossible distances are no error then.

    Raises:
        DatasetError: the file lacks a number or states two, has impossible distances, no
            open beam or not 1 to `MOST_VIEWS` projections; or images are missing or of
            another shape than it states.
    """
    said = _stated(head_text(path))
    views = _count(path, said, "Projections")
    sod, sdd = (_number(path, said, key) for key in ("SrcToObject", "SrcToDetector"))
    across, down = (_number(path, said, f"DetectorPixelSize{axis}") for axis in "XY")
    impossible = distance_findings(
        sod, sdd, (across, down), ("SrcToObject", "SrcToDetector")
    )
    if geometry is None:
        settled(impossible, DatasetFormatError, str(path))
    size = [_count(path, said, f"DetectorPixels{axis}") for axis in "YX"]
    if not 0 < views <= MOST_VIEWS:
        raise DatasetFormatError.instead(
            f"{path}: Projections is {views}", views, f"1 to {MOST_VIEWS}"
        )
    top, bottom = (
        _number(path, said, f"CentreOfRotation{end}", 0.0) for end in ("Top", "Bottom")
    )
    aside = _number(path, said, "ObjectOffsetX", 0.5 * (top + bottom) * sod / sdd)
    lean = -np.rad2deg(np.arctan2(top - bottom, size[0] * down))
    tilts = (
        _number(path, said, "ObjectRoll", lean),
        -_number(path, said, "ObjectTilt", 0.0),
    )
    turn = np.deg2rad(
        _number(path, said, "InitialAngle", 0.0)
        + _number(path, said, "AngularStep") * np.arange(views)
    )
    place = np.array(
        [[aside, -sod, 0.0], [aside, sdd - sod, 0.0], [-across, 0, 0], [0, 0, -down]]
    )
    rows = (place @ _axis(*np.deg2rad(tilts)))[None] @ rotation_z(-turn)
    folder = list_folder(path.parent / said.get("InputFolderName", "").replace("\\", "/"))
    if geometry is None:
        cone = ConeVec(rows.reshape(views, 12))
    else:
        cone = geometry
    names, told = _images(folder, len(cone))
    data = listed(folder, cone, names, (), (), said.get("Name", ""))
    if list(data.shape) != size:
        raise DatasetFormatError(
            f"{path} says {size[1]} x {size[0]} pixels, {names[0]} has "
            f"{data.shape[1]} x {data.shape[0]}",
            {"asked": size, "allowed": list(data.shape)},
        )
    level = _number(path, said, "WhiteLevel")
    if level <= 0.0:
        raise DatasetFormatError.instead(
            f"{path}: WhiteLevel is {level:g}", level, "counts of the open beam, above 0"
        )
    white = np.full((1, *data.shape), level, np.float32)
    doubts = told + [
        f"{path.name} states {key} {said[key]}, which is not applied"
        for key in ("DetectorOffsetX", "DetectorOffsetY")
        if _number(path, said, key, 0.0)
    ]
    arrays = Arrays(None, np.zeros_like(white), white)
    more = [doubt for doubt in data.warnings if not doubt.startswith(NO_DARK)]
    return replace(data, arrays=arrays, warnings=(*more, *doubts))


def _images(folder: Folder, views: int) -> tuple[list[str], list[str]]:
    """List the names of the projections by their numbers, missing ones included.

    Names of another form are left out with a doubt.

    Args:
        folder: of the images.
        views: that the file states.

    Returns:
        The names, and doubts about them.

    Raises:
        DatasetFormatError: two have one number.
    """
    images = [name for name in folder.names if name.lower().endswith((".tif", ".tiff"))]
    found = ordered(images)
    told = settled(
        found.findings.without(PlausibilityCode.GAP),
        DatasetFormatError,
        str(folder.path),
    )
    if found.others:
        told.append(
            f"{', '.join(found.others)} are no projections by their names: left out"
        )
    names = [name for name in found.names if name not in found.others]
    return _completed(names, views), told


def _completed(names: list[str], views: int) -> list[str]:
    """Complete fewer names than views by names like that of the lowest number, from 1, 0
    or that number on: the first start from which the numbers that are there are in the
    range.

    Without such a start, or where a name does not end in a number of its own, the names
    are returned as they are.

    Args:
        names: of the images that are there.
        views: that the file states.
    """
    parts = [PROJECTION.fullmatch(name) for name in names]
    numbers = {int(part[2]): part for part in parts if part is not None}
    if len(numbers) < len(names) or len(names) >= views or not names:
        return names
    first = min(numbers)
    last = max(numbers)
    start = next((at for at in (1, 0, first) if at <= first and last < at + views), None)
    if start is None:
        return names
    before, digits, after = numbers[first].groups()
    width = len(digits) if digits.startswith("0") else 1
    return [f"{before}{n:0{width}d}{after}" for n in range(start, start + views)]


def _stated(text: str) -> dict[str, str]:
    """Return keys and values of the file; a key with several values has all, separated by
    "and", which is no number.
    """
    values: dict[str, dict[str, None]] = {}
    for key, value in LINE.findall(text):
        values.setdefault(key, {})[value] = None
    return {key: " and ".join(several) for key, several in values.items()}


def _count(path: Path, said: Mapping[str, str], key: str) -> int:
    """Return a whole number of the file; arguments as for `_number`.

    Raises:
        DatasetFormatError: the value is no whole number.
    """
    value = _number(path, said, key)
    if not value.is_integer():
        raise DatasetFormatError.instead(
            f"{path}: {key} is {value:g}", value, "a whole number"
        )
    return int(value)


def _number(
    path: Path, said: Mapping[str, str], key: str, default: float | None = None
) -> float:
    """Return a number of the file, with a decimal point or comma.

    Args:
        path: for the message.
        said: keys and values of the file.
        key: of the number.
        default: where the key is missing or its value is empty; None makes that an error.

    Raises:
        DatasetFormatError: the value is no finite number.
    """
    text = said.get(key, "")
    try:
        if not text and default is not None:
            return default
        value = float(
            text.replace(",", ".", 1) if DECIMAL_COMMA.fullmatch(text) else text
        )
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DatasetFormatError(
            f"{path}: {key} is {text[:60] or 'missing'}; allowed: a number",
            {"missing": key},
        )
    return value


def _axis(roll: float, tilt: float) -> FloatArray:
    """Compute the matrix (3, 3) that takes row vectors into the frame whose z is the
    axis.

    Args:
        roll: turn about y [rad], applied second.
        tilt: turn about x [rad], applied first.
    """
    c = np.cos([roll, tilt])
    s = np.sin([roll, tilt])
    rolled = np.array([[c[0], 0.0, s[0]], [0.0, 1.0, 0.0], [-s[0], 0.0, c[0]]])
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, c[1], -s[1]], [0.0, s[1], c[1]]])
    return np.asarray(tilted @ rolled)
