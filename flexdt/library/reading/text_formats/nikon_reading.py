"""Read Nikon's .xtekct and its TIFFs.

As CIL's NikonDataReader 25.0 reads it (Apache-2.0;
https://github.com/TomographicImaging/CIL): images are seen from behind the panel, column
0 at the right as seen from the source; the stage turns clockwise by `AngularStep` a view;
images are counts under an open beam of `WhiteLevel`; the axis is `ObjectOffsetX` to the
left of the line from the source to the panel's middle.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.reading.foreign_parsing import head_text
from flexdt.library.reading.text_formats.nikon_angles import chosen_angles
from flexdt.library.reading.text_formats.nikon_table import NIKON
from flexdt.library.reading.text_formats.text_scans import (
    compared,
    folder_name,
    ini_values,
    require_turn,
    stated_size,
    stated_views,
    under_a_level,
)
from flexdt.runtime.files.dataset_folder import Folder, list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.dataset.provenance import Provenance
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_z
from flexdt.twin.length_units import MORE_UNITS_MM, UNITS_MM, length_mm
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

SAME_AXIS_PX: Final = 0.01
"""Difference of two places of the axis that no images tell [pixels]."""


def read_nikon(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Nikon's (.xtekct); its images stay in `InputFolderName`.

    The axis is placed as the object's offset, roll and tilt, or CentreOfRotation, state.
    The white level serves as flat image, the dark one is zero. Measured angles
    (`_ctdata.txt`, `.ang`) come before `AngularStep`.

    `geometry`: in place of the file's, which must state its numbers all the same.

    Raises:
        DatasetError: the file lacks a number, states two or impossible distances, no open
            beam or not 1 to a million projections; or images are missing or of another
            shape.
    """
    said = Ledger(NIKON, str(path))
    values = ini_values(head_text(path))
    said.state_all((key, value) for _, key, value in values)
    views = stated_views(said, "Projections")
    size = stated_size(said, "DetectorPixelsY", "DetectorPixelsX")
    beside = list_folder(path.parent)
    cone, more = _geometry(said, path, beside, views, size, geometry)
    place = said.text("InputFolderName", ".").replace("\\", "/")
    at = path.parent / place
    folder = beside if at == path.parent else list_folder(at)
    data = under_a_level(
        said,
        folder,
        cone,
        said.number("WhiteLevel"),
        size=size,
        name=said.text("Name", folder_name(path)),
        voltage="XraykV",
        beam="WhiteLevel",
    )
    return replace(data, provenance=data.provenance.and_also(more))


def _geometry(
    said: Ledger,
    path: Path,
    beside: Folder,
    views: int,
    size: tuple[int, int],
    given: ConeVec | None,
) -> tuple[ConeVec, Provenance]:
    """Take the geometry of the file and the lists of angles beside it.

    Args:
        said: what the file states.
        path: of the file.
        beside: its folder.
        views: that it states.
        size: rows and columns that it states.
        given: geometry in its place, or None.

    Returns:
        The geometry, and what became of the values of the lists of angles.

    Raises:
        DatasetFormatError: a number is missing or distances are such as no scanner has.
    """
    unit = _unit(said, path)
    sod, sdd = (unit * said.number(key) for key in ("SrcToObject", "SrcToDetector"))
    across, down = (unit * said.number(f"DetectorPixelSize{axis}") for axis in "XY")
    impossible = distance_findings(
        sod, sdd, (across, down), ("SrcToObject", "SrcToDetector"), "DetectorPixelSize"
    )
    if given is None:
        settled(impossible, DatasetFormatError, str(path))
    aside, roll = _axis_place(said, unit, sod, sdd, across, size[0] * down)
    tilts = np.deg2rad((roll, -said.number("ObjectTilt", 0.0)))
    start = said.number("InitialAngle", 0.0)
    planned = start + said.number("AngularStep") * np.arange(views, dtype=np.float64)
    angles, values = chosen_angles(said, path, beside, planned)
    if given is not None:
        compared(said, given, across, angles)
        return given, values
    require_turn(said, "AngularStep", angles)
    place = np.array(
        [[aside, -sod, 0.0], [aside, sdd - sod, 0.0], [-across, 0, 0], [0, 0, -down]]
    )
    rows = (place @ _axis(*tilts))[None] @ rotation_z(-np.deg2rad(angles))
    return ConeVec(rows.reshape(views, 12)), values


def _unit(said: Ledger, path: Path) -> float:
    """Return the length of the unit that the file states [mm]; 1 without one.

    Raises:
        DatasetFormatError: the unit is unknown.
    """
    name = said.text("Units", "mm")
    size = length_mm(name)
    if size is None:
        known = ", ".join((*UNITS_MM, *MORE_UNITS_MM))
        raise DatasetFormatError.instead(f"{path}: Units is {name[:40]}", name, known)
    return size


def _axis_place(
    said: Ledger, unit: float, sod: float, sdd: float, pitch: float, height: float
) -> tuple[float, float]:
    """Choose between the places and leans of the axis that the file states.

    Statements that differ by less than `SAME_AXIS_PX` pixels at the panel are the same.

    Args:
        said: what the file states.
        unit: of its lengths [mm].
        sod, sdd: source to axis and to panel [mm].
        pitch: of columns [mm].
        height: of the panel [mm].

    Returns:
        How far the axis stands to the left of the central ray [mm], and its lean [deg].
    """
    top, bottom, middle = (
        _if_stated(said, f"CentreOfRotation{end}", unit * sod / max(sdd, 1e-9))
        for end in ("Top", "Bottom", "")
    )
    same_mm = SAME_AXIS_PX * pitch * sod / max(sdd, 1e-9)
    mean = None
    lean = None
    if top is not None or bottom is not None:
        ends = (top or 0.0, bottom or 0.0)
        mean = 0.5 * sum(ends)
        at_panel = (ends[0] - ends[1]) * sdd / max(sod, 1e-9)
        lean = -float(np.rad2deg(np.arctan2(at_panel, height)))
    aside = said.agree(
        "the axis",
        [
            ("ObjectOffsetX", _if_stated(said, "ObjectOffsetX", unit)),
            ("CentreOfRotationTop", mean),
            ("CentreOfRotation", middle),
        ],
        same_mm,
        "mm at the axis",
    )
    if mean is not None and aside == mean:
        said.use("CentreOfRotationBottom")
    roll = said.agree(
        "the axis's lean",
        [
            ("ObjectRoll", _if_stated(said, "ObjectRoll", 1.0)),
            ("CentreOfRotationBottom", lean),
        ],
        float(np.rad2deg(2.0 * SAME_AXIS_PX * pitch / max(height, 1e-9))),
        "deg",
    )
    return aside or 0.0, roll or 0.0


def _if_stated(said: Ledger, key: str, scale: float) -> float | None:
    """Take a number and scale it; None where it is missing or empty."""
    if not (said.stated(key) or "").strip():
        return None
    return scale * said.number(key)


def _axis(roll: float, tilt: float) -> FloatArray:
    """Compute the matrix (3, 3) that takes row vectors into the frame whose z is the axis.

    `roll`: turn about y [rad], applied second; `tilt`: turn about x [rad], applied first.
    """
    c = np.cos([roll, tilt])
    s = np.sin([roll, tilt])
    rolled = np.array([[c[0], 0.0, s[0]], [0.0, 1.0, 0.0], [-s[0], 0.0, c[0]]])
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, c[1], -s[1]], [0.0, s[1], c[1]]])
    return np.asarray(tilted @ rolled)
