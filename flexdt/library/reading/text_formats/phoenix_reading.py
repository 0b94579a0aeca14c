"""Read Waygate's (phoenix's) .pca and its TIFFs; from public files, no images seen.

Columns are taken to run to the right as seen from the source, rows from the top, and the stage to
turn clockwise seen from above: the files do not say, and a wrong sense mirrors the volume.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexdt.library.data_set import DataSet
from flexdt.library.reading.foreign_parsing import head_text
from flexdt.library.reading.text_formats.phoenix_table import PHOENIX
from flexdt.library.reading.text_formats.text_scans import (
    assume_sense,
    compared,
    ini_values,
    require_turn,
    stated_size,
    stated_views,
    under_a_level,
)
from flexdt.runtime.files.dataset_folder import list_folder
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.format_table import Ledger
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import distance_findings


def read_phoenix(path: Path, geometry: ConeVec | None) -> DataSet:
    """Read a scan of Waygate's; its TIFFs stay in their files.

    Args:
        path: the .pca file.
        geometry: one view for each projection, in place of the file's.

    Raises:
        DatasetError: the file lacks a number or has impossible distances or another
            trajectory, or images are missing or of another shape.
    """
    said = Ledger(PHOENIX, str(path))
    said.state_all((f"{s}/{key}", value) for s, key, value in ini_values(head_text(path)))
    views = stated_views(said, "CT/NumberImages")
    size = stated_size(said, "Image/DimY", "Image/DimX")
    cone = _geometry(said, path, views, size, geometry)
    return under_a_level(
        said,
        list_folder(path.parent),
        cone,
        said.number("Image/FreeRay") * said.number("CT/FreeRayFactor", 1.0),
        size=size,
        name=path.stem,
        voltage="Xray/Voltage",
        beam="Image/FreeRay",
        prefix=path.stem,
    )


def _geometry(
    said: Ledger, path: Path, views: int, size: tuple[int, int], given: ConeVec | None
) -> ConeVec:
    """Take the geometry of the file, or compare a given one with it.

    Raises:
        DatasetFormatError: a number is missing, or distances are such as no scanner has.
    """
    sdd, sod = (said.number(f"Geometry/{name}") for name in ("FDD", "FOD"))
    ratio = sdd / sod if sod else 0.0
    said.agree(
        "magnification",
        [
            ("Geometry/FDD", ratio),
            ("Geometry/Magnification", _if_stated(said, "Geometry/Magnification")),
        ],
        ratio / max(size),
    )
    said.use("Geometry/FDD")
    pitches = []
    for axis, count in zip("XY", size[::-1], strict=True):
        voxel = _if_stated(said, f"Geometry/VoxelSize{axis}")
        pixel = _if_stated(said, f"Detector/Pixelsize{axis}")
        at_panel = None if voxel is None else voxel * ratio
        pitch = said.agree(
            f"pixel of the panel along {axis}",
            [
                (f"Geometry/VoxelSize{axis}", at_panel),
                (f"Detector/Pixelsize{axis}", pixel),
            ],
            (at_panel or pixel or 0.0) / count,
            "mm",
        )
        if pitch is None:
            pitch = said.number(f"Geometry/VoxelSize{axis}")
        pitches.append(pitch)
    impossible = distance_findings(
        sod, sdd, pitches, ("FOD", "FDD"), "VoxelSize at the panel"
    )
    if given is None:
        settled(impossible, DatasetFormatError, str(path))
    span = said.number("CT/RotationSector", 360.0)
    angles = span / views * np.arange(views, dtype=np.float64)
    if given is None:
        require_turn(said, "CT/RotationSector", angles)
        assume_sense(said, "clockwise seen from above; the file does not say")
    middle = ((size[0] - 1) / 2, (size[1] - 1) / 2)
    column, row = (
        said.number("Geometry/cx", middle[1]),
        said.number("Geometry/cy", middle[0]),
    )
    if given is not None:
        compared(said, given, pitches[0], angles)
        return given
    offset = ((middle[1] - column) * pitches[0], (middle[0] - row) * pitches[1])
    return ConeVec.circular(sod=sod, sdd=sdd, angles=angles, pixel=pitches, offset=offset)


def _if_stated(said: Ledger, name: str) -> float | None:
    """Take a number; None where it is missing or empty."""
    if not (said.stated(name) or "").strip():
        return None
    return said.number(name)
