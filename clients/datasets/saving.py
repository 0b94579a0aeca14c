"""Data sets to folders and to other programs' containers: what the methods of `DataSet` call."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flexdt.clients.datasets.data_set import Counts, DataSet
from flexdt.clients.datasets.folder import read_image
from flexdt.server.files.atomic import AtomicFolder
from flexdt.server.files.image_files import tiff_bytes
from flexdt.twin.dataset.dataset_errors import DatasetExistsError
from flexdt.twin.dataset.file_names import DOCUMENT, GEOMETRY, SCAN_SETTINGS, SCRIPT, XRE_SETTINGS
from flexdt.twin.dataset.flexdt_json import CorrectionEntry
from flexdt.twin.errors import TwinError
from flexdt.twin.exchange import ScanGeometry, geometry_text
from flexdt.twin.exchange.number_tables import VECTOR_NAMES
from flexdt.twin.outward import File


def save_data_set(data: DataSet, folder: File) -> None:
    """See `DataSet.save`."""
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()):
        raise DatasetExistsError(
            f"{path} is not empty; allowed: a new or an empty folder", {"path": str(path)}
        )
    with AtomicFolder(path, sync=False) as out:
        for name, image in references(data):
            out.put(name, tiff_bytes(image))
        for i in data.present:
            out.put(data.frames[i].file, tiff_bytes(data.counts(i)))
        for name in (SCAN_SETTINGS, XRE_SETTINGS, SCRIPT):
            if data.folder is not None and (data.folder / name).is_file():
                out.put(name, (data.folder / name).read_bytes())
        out.put(*_geometry(data))


def _geometry(data: DataSet) -> tuple[str, bytes]:
    """The file that says the geometry: the document as it was, or the geometry by itself."""
    files = tuple(frame.file for frame in data.frames)
    document = data.document
    if document is None or document.files("projection") != files:
        geometry = ScanGeometry(data.geometry, data.shape, name=data.name, files=files)
        return GEOMETRY, geometry_text(geometry).encode()
    c = data.correction
    entry = None
    if c is not None:
        parameters = c.parameters.to_edge()
        entry = CorrectionEntry(name=c.name, date=c.date, note=c.note, parameters=parameters)
    return DOCUMENT, document.model_copy(update={"correction": entry}).to_json().encode()


def references(data: DataSet) -> list[tuple[str, Counts]]:
    """Dark and flat images with their names; means that are no whole numbers are rounded."""
    if data.arrays is None:
        return [(path.name, read_image(path)) for path in (*data.darks, *data.flats)]
    kinds = (("di", data.arrays.darks), ("io", data.arrays.flats))
    return [
        (f"{kind}{i:06d}.tif", np.rint(image).astype(np.uint16))
        for kind, images in kinds
        for i, image in enumerate(() if images is None else images)
    ]


def to_xarray(data: DataSet) -> Any:
    """See `DataSet.to_xarray`."""
    try:
        import xarray
    except ImportError:
        raise missing("to_xarray", "xarray") from None
    rows = data.geometry.rows
    return xarray.DataArray(
        data.line_integrals(),
        dims=("view", "row", "column"),
        name="line_integrals",
        coords={
            "angle": ("view", data.angles_deg, {"units": "deg"}),
            **{n: ("view", c, {"units": "mm"}) for n, c in zip(VECTOR_NAMES, rows.T, strict=True)},
            "file": ("view", [frame.file for frame in data.frames]),
        },
        attrs={"title": data.name, "units": "1"},
    )


def missing(what: str, package: str, extra: str = "io") -> TwinError:
    """The error for a package that is not installed."""
    return TwinError(
        f"{what} needs {package}, which is not installed: pip install 'flexdt[{extra}]'",
        {"missing": package},
    )
