"""Scans whose geometry is a text beside image files, under an open beam of one level."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_set import Arrays
from flexdt.library.datasets.scan_inputs import NO_DARK
from flexdt.library.reading.listed_images import listed
from flexdt.runtime.files.dataset_folder import Folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import ANGLES, GEOMETRY, Ledger, as_number
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.plausibility import PlausibilityCode, settled
from flexdt.twin.plausibility.image_order import ordered
from flexdt.twin.plausibility.stated_figures import angle_findings, pixel_findings

SECTION: Final = re.compile(r"\[([^\]=]*)\]")
PROJECTION: Final = re.compile(r"(.*?)(\d+)(\.\w+)")
"""Beginning, number and ending of an image's name."""
TIFFS: Final = (".tif", ".tiff")
NEVER_FULL: Final = 1 << 17
"""Largest count of images that the maker has divided by the open beam, which lies at the top of
the counts: no count of uint16 says that the panel was saturated."""
MOST_VIEWS: Final = 1_000_000
COMMENT: Final = ("#", ";")
"""Beginnings of lines without a value."""


def ini_values(text: str) -> list[tuple[str, str, str]]:
    """Return section, key and value of every line of a text with sections, as programs of
    Windows write it. A line that is neither is a key without value.
    """
    section = ""
    values = []
    for line in map(str.strip, text.splitlines()):
        head = SECTION.fullmatch(line)
        if head:
            section = head[1].strip()
        elif line and not line.startswith(COMMENT):
            key, _, value = line.partition("=")
            values.append((section, key.strip(), value.strip()))
    return values


def projections_in(
    folder: Folder, views: int, endings: Sequence[str], prefix: str
) -> tuple[list[str], list[str]]:
    """List the names of the projections by their numbers, missing ones included.

    Names of another form are left out with a doubt.

    Args:
        folder: of the images.
        views: that the text states.
        endings: of images, in lower case.
        prefix: of their names, where some have it.

    Returns:
        The names, and doubts about them.

    Raises:
        DatasetFormatError: two have one number.
    """
    images = [name for name in folder.names if name.lower().endswith(tuple(endings))]
    if prefix:
        begun = [name for name in images if name.lower().startswith(prefix.lower())]
        numbered = [n for n in begun if re.fullmatch(r"[_~-]?\d+\.\w+", n[len(prefix) :])]
        images = numbered or begun or images
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
        views: that the text states.
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


def compared(
    said: Ledger,
    given: ConeVec,
    pitch: float,
    angles_deg: np.ndarray,
) -> None:
    """Set a file's figures aside for a given geometry, and tell where they differ.

    `pitch`: of columns [mm]; `angles_deg`: of views.
    """
    said.give((GEOMETRY, ANGLES), "geometry=")
    for found in (
        angle_findings(given, np.deg2rad(angles_deg)),
        pixel_findings(given, pitch),
    ):
        said.warnings += settled(found, DatasetFormatError, said.file)


def stated_views(said: Ledger, field: str) -> int:
    """Take the number of images that a field states.

    Raises:
        DatasetFormatError: not 1 to `MOST_VIEWS`.
    """
    views = said.whole(field)
    if not 0 < views <= MOST_VIEWS:
        problem = f"{said.path}: {field} is {views}"
        raise DatasetFormatError.instead(problem, views, f"1 to {MOST_VIEWS}")
    return views


def stated_size(said: Ledger, rows: str, columns: str) -> tuple[int, int]:
    """Take the numbers of rows and of columns that two fields state.

    Raises:
        DatasetFormatError: one is no whole number above 0.
    """
    return said.whole(rows, least=1), said.whole(columns, least=1)


def require_turn(said: Ledger, field: str, angles: FloatArray) -> None:
    """Require that the views turn.

    `said`: what the file states; `field`: from which the turn follows; `angles`: of the views.
    Raises DatasetFormatError: all of several views are at one angle.
    """
    if len(angles) > 1 and not np.ptp(angles):
        problem = (
            f"{said.path}: {field} is {said.stated(field)}, and all views at one angle"
        )
        allowed = "a turn from view to view, or geometry="
        raise DatasetFormatError.instead(problem, said.stated(field), allowed)


def assume_sense(said: Ledger, why: str) -> None:
    """Tell that the sense of rotation is assumed.

    `said`: what the file states; `why`: what it is taken from.
    """
    said.warnings.append(
        f"{said.file}: the sense of rotation is assumed ({why}); the wrong one mirrors the"
        " volume, which images cannot tell: compare a part whose handedness you know"
    )


def under_a_level(
    said: Ledger,
    folder: Folder,
    cone: ConeVec,
    level: float,
    *,
    size: tuple[int, int],
    name: str,
    voltage: str,
    beam: str,
    prefix: str = "",
    endings: Sequence[str] = TIFFS,
    corrected: bool = False,
) -> DataSet:
    """Make the data set of a folder's images under an open beam of one level, without dark
    images.

    Args:
        said: what the text states; it is finished here.
        folder: of the images.
        cone: one view for each of them.
        level: counts of the open beam.
        size: rows and columns that the text states.
        name: of the data set.
        voltage: name of the field of the tube's voltage [kV].
        beam: name of the field of the level.
        prefix: of the images' names, where some have it.
        endings: of images, in lower case.
        corrected: the maker has divided the images by the open beam.

    Raises:
        DatasetError: images are missing or of another shape than the text states, or the
            open beam is not above 0.
    """
    names, told = projections_in(folder, len(cone), endings, prefix)
    top = NEVER_FULL if corrected else None
    data = listed(folder, cone, names, (), (), name, full_scale=top)
    if data.shape != size:
        raise DatasetFormatError(
            f"{said.path} says {size[1]} x {size[0]} pixels, {names[0]} has "
            f"{data.shape[1]} x {data.shape[0]}",
            {"asked": list(size), "allowed": list(data.shape)},
        )
    if level <= 0.0:
        raise DatasetFormatError.instead(
            f"{said.path}: {beam} is {level:g}", level, "counts of the open beam, above 0"
        )
    white = np.full((1, *data.shape), level, np.float32)
    settings = stated_voltage(said, voltage)
    values = said.finish()
    own = [doubt for doubt in data.warnings if not doubt.startswith(NO_DARK)]
    return replace(
        data,
        arrays=Arrays(None, np.zeros_like(white), white),
        warnings=(*own, *told, *said.warnings),
        provenance=values,
        settings=settings,
    )


def stated_voltage(said: Ledger, name: str) -> ScanSettings | None:
    """Take the tube's voltage [kV] from a field; None if it is no number above 0."""
    value = as_number(said.stated(name) or "")
    if not 0.0 < value < math.inf:
        return None
    said.use(name)
    return ScanSettings(kV=value)


def folder_name(path: Path) -> str:
    """Return the name of the folder of a file, for a data set without a name."""
    return path.resolve().parent.name
