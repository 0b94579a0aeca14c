"""Read Bruker SkyScan's .log and its images; from public files and readers, no images seen.

As TIGRE's BrukerDataLoader has it: columns run to the right as seen from the source, the optical
axis is a row counted from the lowest, the shifts of a .csv move the panel to the right and up. The
sense of rotation `CC` is TIGRE's; a wrong one mirrors the volume, which images cannot tell.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.reading.foreign_parsing import begin_of, head_text
from flexdt.library.reading.text_formats.skyscan_table import SKYSCAN
from flexdt.library.reading.text_formats.text_scans import (
    TIFFS,
    assume_sense,
    compared,
    ini_values,
    require_turn,
    stated_size,
    stated_views,
    under_a_level,
)
from flexdt.runtime.files.dataset_folder import Folder, list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger, as_number
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

OWN_SECTIONS: Final = ("", "System", "User", "Acquisition")
"""Sections whose keys are named without them."""
HALF_A_TURN: Final = (180.0, 270.0)
"""Spans of a scan that is not a full turn: half of one and a fan [deg]."""
SHIFT_HEAD_LINES: Final = 5


def is_skyscan(path: Path) -> bool:
    """Return whether a text begins as SkyScan's: sections System and Acquisition."""
    begin = begin_of(path)
    return "[Acquisition]" in begin or "[System]" in begin


def read_skyscan(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of SkyScan's; its TIFFs stay in their files.

    Args:
        path: the .log file.
        geometry: one view for each projection, in place of the file's.

    Raises:
        DatasetError: the file lacks a number or has impossible distances, another
            trajectory than a circle, or images are missing or of another shape.
    """
    said = Ledger(SKYSCAN, str(path))
    for section, key, value in ini_values(head_text(path)):
        name = key if section in OWN_SECTIONS else f"{section}/{key}"
        said.state(name, value)
    views = stated_views(said, "Number of Files")
    size = stated_size(said, "Number of Rows", "Number of Columns")
    folder = list_folder(path.parent)
    cone = _geometry(said, path, folder, views, size, geometry)
    return under_a_level(
        said,
        folder,
        cone,
        _open_beam(said),
        size=size,
        name=path.stem,
        voltage="Source Voltage (kV)",
        beam="Reference Intensity",
        prefix=said.text("Filename Prefix", path.stem),
        endings=_endings(said),
        corrected=True,
    )


def _endings(said: Ledger) -> tuple[str, ...]:
    """Take the endings of the images by their format, TIFF by default.

    Raises:
        DatasetFormatError: another format than TIFF and BMP.
    """
    form = said.text("Image Format", "TIFF").strip().lower()
    if form not in ("tiff", "tif", "bmp"):
        problem = f"{said.path}: Image Format is {form[:20]}"
        raise DatasetFormatError.instead(problem, form, "TIFF or BMP")
    return (".bmp",) if form == "bmp" else TIFFS


def _open_beam(said: Ledger) -> float:
    """Take the counts of the open beam: Reference Intensity, or else the largest count."""
    bits = said.whole("Depth (bits)", 16)
    stated = said.stated("Reference Intensity")
    if stated:
        said.use("Depth (bits)", "counts; Reference Intensity is the open beam")
        return said.number("Reference Intensity")
    top = float(2**bits - 1)
    said.warnings.append(f"{said.file}: no Reference Intensity; the open beam is {top:g}")
    return top


def _geometry(
    said: Ledger,
    path: Path,
    folder: Folder,
    views: int,
    size: tuple[int, int],
    given: ConeVec | None,
) -> ConeVec:
    """Take the geometry of the file and its shifts, or compare a given one with it.

    Raises:
        DatasetFormatError: a number is missing, or distances are such as no scanner has.
    """
    sod, sdd = (said.number(f"{one} to Source (mm)") for one in ("Object", "Camera"))
    pitch = _pitch(said, sod, sdd, size[1])
    impossible = distance_findings(
        sod,
        sdd,
        pitch,
        ("Object to Source (mm)", "Camera to Source (mm)"),
        "Image Pixel Size (um) at the panel",
    )
    if given is None:
        settled(impossible, DatasetFormatError, str(path))
    angles = _angles(said, views)
    line = said.number("Optical Axis (line)", (size[0] - 1) / 2)
    shifts = _shifts(said, path, folder, views)
    if given is not None:
        compared(said, given, pitch, angles)
        return given
    require_turn(said, "Rotation Step (deg)", angles)
    cone = ConeVec.circular(sod=sod, sdd=sdd, angles=angles, pixel=pitch, shape=size)
    rows = np.array(cone.rows)
    source, detector, u, v = np.split(rows, 4, axis=1)
    row = size[0] - 1 - line
    detector = detector + ((size[0] - 1) / 2 - row) * v
    detector = detector + shifts[:, :1] * u - shifts[:, 1:] * v
    return ConeVec(np.concatenate([source, detector, u, v], axis=1))


def _pitch(said: Ledger, sod: float, sdd: float, columns: int) -> float:
    """Take the pitch of the panel's pixels [mm].

    It follows from the pixel at the axis; the camera's, which differs where distances are
    calibrated, is told where it moves the panel's edge by half a pixel.
    """
    pixel = said.stated("Image Pixel Size (um)")
    camera = said.stated("Camera Pixel Size (um)")
    by_image = None
    by_camera = None
    if pixel or not camera:
        by_image = said.number("Image Pixel Size (um)") / 1000.0 * sdd / max(sod, 1e-9)
    if camera:
        joined = re.match(r"\s*(\d+)", said.text("Camera binning", "1x1"))
        factor = int(joined[1]) if joined else 1
        by_camera = factor * said.number("Camera Pixel Size (um)") / 1000.0
    pitch = said.agree(
        "pixel of the panel",
        [("Image Pixel Size (um)", by_image), ("Camera Pixel Size (um)", by_camera)],
        (by_image or by_camera or 0.0) / max(columns, 1),
        "mm",
    )
    return pitch or 0.0


def _angles(said: Ledger, views: int) -> FloatArray:
    """Take the stage angles of the views (n,) [deg]; a span that is not the stated one is
    told.
    """
    step = said.number("Rotation Step (deg)")
    start = said.number("Scanning Start Angle", 0.0)
    words = said.text("Rotation Direction", "CC").strip().upper()
    if words not in ("CC", "CCW", "CW"):
        problem = f"{said.path}: Rotation Direction is {words[:20]}"
        raise DatasetFormatError.instead(problem, words, "CC, CCW or CW")
    if said.stated("Use 360 Rotation"):
        whole = said.switch("Use 360 Rotation")
        span = abs(step) * views
        least, most = (360.0 - 2 * abs(step), 400.0) if whole else HALF_A_TURN
        if not least - abs(step) <= span <= most:
            turn = "YES" if whole else "NO"
            said.set_aside(
                "Use 360 Rotation",
                f"Use 360 Rotation says {turn}, {views} views of {step:g} deg are "
                f"{span:g} deg, which is taken",
            )
    assume_sense(
        said, "of Rotation Direction as TIGRE reads it; no file of the maker's seen"
    )
    sense = -1.0 if words == "CW" else 1.0
    return sense * (start + step * np.arange(views, dtype=np.float64))


def _shifts(
    said: Ledger, path: Path, folder: Folder, views: int
) -> npt.NDArray[np.float64]:
    """Read the shifts of the views to the right and up (n, 2) [pixels] of the .csv beside
    the file: five lines of a head, then number, right and up in unbinned pixels.

    Zeros without such a file; one of another number of lines is told.
    """
    still = np.zeros((views, 2))
    found = sorted(n for n in folder.names if n.lower().endswith(".csv"))
    own = [name for name in found if name.lower().startswith(path.stem.lower())]
    chosen = own or found
    if len(chosen) != 1:
        for name in chosen:
            said.state("*.csv/shifts", "one of several", name)
            said.set_place_aside(name, f"{name} is one of several .csv: none is used")
        return still
    lines = head_text(path.parent / chosen[0]).splitlines()[SHIFT_HEAD_LINES:]
    rows = [
        [as_number(cell) for cell in line.split(",")] for line in lines if line.strip()
    ]
    right = [row for row in rows if len(row) >= 3 and np.isfinite(row[:3]).all()]
    said.state("*.csv/shifts", f"{len(right)} shifts", chosen[0])
    if len(right) != views:
        many = f"{chosen[0]} has {len(right)} shifts for {views} views: it is not used"
        said.set_place_aside(chosen[0], many)
        return still
    said.use_place(chosen[0], "the panel's place")
    said.ignore("Random Movement", f"{chosen[0]} has the shifts")
    joined = re.match(r"\s*(\d+)", said.stated("Camera binning") or "1")
    return np.array(right)[:, 1:3] / (int(joined[1]) if joined else 1)
