"""Read YXLON's ScanParameter.xml and its TIFFs; from documentation, no file seen.

As TIGRE's YXLONDataLoader has it: angles fall from StartAngle, in its sense, which is ours of a
stage that turns anticlockwise; columns run to the right as seen from the source.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.reading.foreign_parsing import begin_of, xml_values
from flexdt.library.reading.text_formats.text_scans import (
    compared,
    require_turn,
    stated_size,
    stated_views,
    under_a_level,
)
from flexdt.library.reading.text_formats.yxlon_table import YXLON
from flexdt.runtime.files.dataset_folder import list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings

PARAMETERS: Final = "ConeBeamScanParameter"
FOLDERS: Final = ("Projections", "Projektionen")
"""Names of the folder of the images, beside the file."""


def is_yxlon(path: Path) -> bool:
    """Return whether a file has YXLON's element of a cone beam."""
    return PARAMETERS in begin_of(path)


def read_yxlon(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of YXLON's; its TIFFs stay in their files.

    Args:
        path: ScanParameter.xml.
        geometry: one view for each projection, in place of the file's.

    Raises:
        DatasetError: no such XML, a number is missing, impossible distances or another
            trajectory, or images are missing or of another shape.
    """
    said = Ledger(YXLON, str(path))
    said.state_all(xml_values(path, PARAMETERS))
    views = stated_views(said, "ScanTrajectory/NumberOfProjections")
    size = stated_size(said, "ProjectionSize/Height", "ProjectionSize/Width")
    cone = _geometry(said, path, views, geometry)
    there = [path.parent / name for name in FOLDERS if (path.parent / name).is_dir()]
    return under_a_level(
        said,
        list_folder(there[0] if there else path.parent),
        cone,
        2.0 ** said.whole("ProjectionBitdepth", 16) - 1.0,
        size=size,
        name=path.parent.name,
        voltage="Voltage",
        beam="ProjectionBitdepth",
        corrected=True,
    )


def _geometry(said: Ledger, path: Path, views: int, given: ConeVec | None) -> ConeVec:
    """Take the geometry of the file, or compare a given one with it.

    Raises:
        DatasetFormatError: a number is missing, or distances are such as no scanner has.
    """
    unit = said.number("ScanTrajectory/PixelPitch", 1.0)
    sdd, sod = (unit * said.number(f"ScanTrajectory/{name}") for name in ("Fdd", "Fod"))
    pixel = [said.number(f"PixelSize/{name}") for name in ("Width", "Height")]
    impossible = distance_findings(sod, sdd, pixel, ("Fod", "Fdd"), "PixelSize")
    if given is None:
        settled(impossible, DatasetFormatError, str(path))
    start = said.number("ScanTrajectory/StartAngle", 0.0)
    span = said.number("ScanTrajectory/Rotation", 360.0)
    angles = start - span / views * np.arange(views, dtype=np.float64)
    if given is not None:
        compared(said, given, pixel[0], angles)
        return given
    require_turn(said, "ScanTrajectory/Rotation", angles)
    return ConeVec.circular(sod=sod, sdd=sdd, angles=angles, pixel=pixel)
