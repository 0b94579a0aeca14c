"""A data set written as a folder that `flexdt.open` reads."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.datasets.image_set import ImageSet, references
from flexdt.runtime.files.dataset_folder import tiff_bytes
from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.dataset_errors import DatasetExistsError
from flexdt.twin.dataset.file_names import (
    DOCUMENT,
    GEOMETRY,
    SCAN_SETTINGS,
    SCRIPT,
    UNFINISHED,
    XRE_SETTINGS,
)
from flexdt.twin.dataset.flexdt_json import CorrectionEntry
from flexdt.twin.dataset.rebuild import MATCH_MM
from flexdt.twin.dataset.scan_settings import ScanSettings
from flexdt.twin.dataset.scan_settings_text import format_scan_settings
from flexdt.twin.dataset.stated_geometry import figures_of, poses_of
from flexdt.twin.dataset.xre import format_settings
from flexdt.twin.errors import GeometryError
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.exchange.number_tables import geometry_text
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.signatures import File

REFERENCES: Final = ("di", "io")
"""Beginnings of the names of dark and flat images."""


def save_data_set(data: ImageSet, folder: File, resume: bool = False) -> None:
    """Write a data set into a folder; see `DataSet.save`.

    A note of unfinished saving (`UNFINISHED`) is written first and removed last.
    Projections that are in the folder already are not written again; missing ones are
    left out. The scanner's texts and the script are copied; a data set in memory gets
    texts where `stated_settings` has some.

    Args:
        data: the data set.
        folder: new or empty.
        resume: continue an interrupted saving.

    Raises:
        DatasetExistsError: the folder has other files, or an unfinished saving of another
            data set or without `resume`.
    """
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    there = {entry.name for entry in path.iterdir()}
    content = _content_of(data)
    _require_room_for(path, there, content, resume)
    with Directory(path, sync=False) as out:
        out.put(UNFINISHED, json.dumps(content, indent=1).encode())
        for name, image in references(data):
            out.put(name, tiff_bytes(image))
        for i in data.present:
            if data.frames[i].file not in there:  # a file appears only when it is whole
                out.put(data.frames[i].file, tiff_bytes(data.counts(i)))
        for name in (SCAN_SETTINGS, XRE_SETTINGS, SCRIPT):
            if data.folder is not None and (data.folder / name).is_file():
                out.put(name, (data.folder / name).read_bytes())
        if data.folder is None:
            stated = stated_settings(data)
        else:
            stated = None
        if stated is not None:
            out.put(SCAN_SETTINGS, format_scan_settings(stated).encode())
            out.put(XRE_SETTINGS, format_settings(stated).encode())
        out.put(*_geometry(data))
        out.unlink(UNFINISHED)


def _content_of(data: ImageSet) -> dict[str, object]:
    """Return the content that a folder will hold, to identify the data set: the keys
    name, projections (present), shape and digest (SHA-256 of the geometry and the first
    present projection).
    """
    digest = hashlib.sha256(np.ascontiguousarray(data.geometry.rows).tobytes())
    if data.present:
        digest.update(np.ascontiguousarray(data.counts(data.present[0])).tobytes())
    return {
        "name": data.name,
        "projections": len(data.present),
        "shape": list(data.shape),
        "digest": digest.hexdigest(),
    }


def _require_room_for(
    path: Path, there: Collection[str], content: Mapping[str, object], resume: bool
) -> None:
    """Check that a folder is empty, or that saving the same data set was interrupted in it.

    Args:
        path: the folder.
        there: names in it.
        content: of `_content_of`.
        resume: continue an interrupted saving.

    Raises:
        DatasetExistsError: names the content of the folder, and the allowed cases.
    """
    if not there:
        return
    if UNFINISHED not in there:
        message = f"{path} is not empty; allowed: a new or an empty folder"
        raise DatasetExistsError(message, {"path": str(path)})
    if not resume:
        message = f"{unfinished(path)}; allowed: resume=True, or an empty folder"
        raise DatasetExistsError(message, {"path": str(path)})
    if _read_note(path) != content:
        message = (
            f"{unfinished(path)}, which is another data set than {content['name']!r}"
        )
        raise DatasetExistsError(
            f"{message}; allowed: an empty folder", {"path": str(path)}
        )


def unfinished(path: Path) -> str:
    """Describe a folder in which saving was interrupted.

    Numbers that are missing in its note are "?".
    `path`: of a folder with the file `UNFINISHED`.
    """
    noted = _read_note(path)
    tiffs = [entry for entry in path.iterdir() if entry.suffix.lower().startswith(".tif")]
    images = sum(1 for entry in tiffs if not entry.name.startswith(REFERENCES))
    whole = noted.get("projections", "?")
    return f"{path} is half-saved: {images} of {whole} projections of {noted.get('name', '?')!r}"


def _read_note(path: Path) -> Mapping[str, object]:
    """Read the note about the planned content of an unfinished folder; {} where it is
    missing or damaged.
    """
    try:
        noted = json.loads((path / UNFINISHED).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return noted if isinstance(noted, dict) else {}


def stated_settings(data: ImageSet) -> ScanSettings | None:
    """Return the settings that the scanner's texts of a data set in memory would state.

    Tube and camera figures are None where the data set does not know them.

    Returns:
        None where they cannot express its geometry within `MATCH_MM`: they have one
        circle in the plane of the sample's reference point, with equal steps and an
        upright panel of square pixels.
    """
    geometry = data.geometry
    shape = data.shape
    try:
        poses = Poses.from_cone_vec(geometry)
    except GeometryError:
        return None
    even = np.linspace(poses.angle[0], poses.angle[-1], len(poses.angle))
    figures = figures_of(poses[:1], shape)
    stated_rows = poses_of(figures, shape, even).cone_vec().rows
    # The pitches are small: at the panel's edge they count by half its pixels.
    weights = np.repeat([1.0, 1.0, shape[1] / 2.0, shape[0] / 2.0], 3)
    if np.abs((stated_rows - geometry.rows) * weights).max() > MATCH_MM:
        return None
    exposure, camera = (
        getattr(data.truth, name, None) for name in ("exposure", "camera")
    )
    before = [name[:2] for name, _ in references(data)]
    start, last = np.degrees(even[[0, -1]]).tolist()
    return ScanSettings(
        scan_id=data.name,
        **figures.stated,
        sample_name=data.name,
        software="flexdt",
        kV=stated_voltage(data),
        power_W=None if exposure is None else exposure.power_W,
        exposure_ms=None if camera is None else camera.exposure_ms,
        averages=None if camera is None else float(camera.averages),
        scan_type="step scan",
        projections=len(data),
        start_angle_deg=start,
        last_angle_deg=last,
        pre_flats=before.count("io"),
        post_flats=0,
        darks=before.count("di"),
    )


def stated_voltage(data: ImageSet) -> float | None:
    """Return the tube's voltage [kV], of the simulated exposure or of the files; None where
    it is unknown."""
    beam = getattr(data.truth, "exposure", None) or data.settings
    return None if beam is None or not beam.kV else float(beam.kV)


def _geometry(data: ImageSet) -> tuple[str, bytes]:
    """Return name and bytes of the geometry's file: the document, with the present
    correction, if it still describes frames and poses (within 1e-6 mm), or else the
    geometry with the warnings as notes.
    """
    files = tuple(frame.file for frame in data.frames)
    document = data.document
    moved = data.nominal is not None and not np.allclose(
        data.nominal.cone_vec().rows, data.cone_vec.rows, rtol=0.0, atol=1e-6
    )
    if document is None or moved or document.files("projection") != files:
        geometry = ScanGeometry(
            data.geometry,
            data.shape,
            name=data.name,
            files=files,
            notes=data.warnings,
            full_scale=data.full_scale,
            provenance=data.provenance,
            kV=stated_voltage(data),
        )
        return GEOMETRY, geometry_text(geometry).encode()
    entry = CorrectionEntry.of(data.correction)
    return DOCUMENT, document.model_copy(update={"correction": entry}).to_json().encode()
