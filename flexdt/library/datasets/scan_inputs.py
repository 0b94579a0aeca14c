"""Carry out what a user says of a scan's images and geometry, the same everywhere."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.library.datasets.cutting import cut
from flexdt.library.datasets.exchange import load_stated
from flexdt.library.datasets.image_set import Arrays, Images
from flexdt.library.datasets.image_sources import Reference, angles_deg, reference
from flexdt.library.datasets.scan_options import Said, ScanOptions
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.provenance import Part
from flexdt.twin.exchange.geometry import ScanGeometry
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import rotation_z
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.scan_geometry import azimuths
from flexdt.twin.plausibility.stated_figures import angle_findings
from flexdt.twin.signatures import Numbers

NO_DARK: Final = "no dark image"
NO_FLAT: Final = "no flat image"
"""Beginnings of what a data set without such images is told, which later ones settle."""
Geometry = ScanGeometry | ConeVec | Numbers | str | PathLike[str]


def geometry_said(
    geometry: Geometry,
    options: ScanOptions,
    shape: tuple[int, int] | None = None,
    folder: Path | None = None,
) -> ScanGeometry:
    """Return the geometry that a user means, at the angles that are said, with what became
    of the values of its file.

    Args:
        geometry: a value, its rows (n, 12), or a file that `ConeVec.load` reads.
        options: of which `angles` counts.
        shape: (rows, cols) of the images, where the file does not state them.
        folder: in which a file of angles is looked up first.

    Raises:
        TwinError: no such file, no geometry, or another number of angles than views.
    """
    if isinstance(geometry, ScanGeometry):
        stated = geometry
    elif isinstance(geometry, ConeVec):
        stated = ScanGeometry(geometry, geometry.detector_shape)
    elif isinstance(geometry, str | PathLike):
        stated = _loaded(Path(geometry), shape)
    else:
        stated = ScanGeometry(ConeVec(np.asarray(geometry)))
    cone = stated.cone_vec.with_shape(stated.shape)
    values = stated.provenance
    if options.get("angles") is not None:
        values = values.replaced((Part.ANGLES,), "angles=")
    turned = at_angles(cone, options, folder)
    return replace(stated, cone_vec=turned, provenance=values, files=(), real=None)


def with_statements(data: Images, stated: ScanGeometry) -> Images:
    """Return the data set with what the file of its geometry states and tells."""
    return replace(
        data,
        provenance=data.provenance.and_also(stated.provenance),
        warnings=(*data.warnings, *stated.notes),
    )


def _loaded(path: Path, shape: tuple[int, int] | None) -> ScanGeometry:
    """Load a geometry's file; one that states its own shape is not given another."""
    if not path.is_file():
        raise DatasetFormatError(
            f"geometry is {str(path)!r}: there is no such file", {"missing": [str(path)]}
        )
    return load_stated(path, shape=shape)


def at_angles(cone: ConeVec, options: ScanOptions, folder: Path | None = None) -> ConeVec:
    """Turn the views of a geometry to the angles that are said; itself without any.

    Args:
        cone: one view for each angle, or one view for all.
        options: of which `angles` counts.
        folder: in which a file of angles is looked up first.

    Raises:
        DatasetFormatError: another number of angles than views, or none that can be read.
        GeometryError: a panel on its side, of which no angle is known.
    """
    said = options.get("angles")
    if said is None:
        return cone
    angles = np.radians(angles_deg(said, folder))
    if len(cone) not in (1, len(angles)):
        raise DatasetFormatError(
            f"{len(angles)} angles and {len(cone)} views; allowed: as many of both, or one view",
            {"asked": len(angles), "allowed": len(cone)},
        )
    turn = rotation_z(angles - Poses.from_cone_vec(cone).angle)
    parts = cone.source, cone.detector, cone.u, cone.v
    turned = [
        np.einsum("nij,nj->ni", turn, np.broadcast_to(p, (len(angles), 3))) for p in parts
    ]
    return ConeVec(np.concatenate(turned, axis=1), cone.detector_shape)


def references_said(
    options: ScanOptions, folder: Path | None = None
) -> tuple[Reference | None, Reference | None]:
    """Find the dark and the flat images that are said; None for those of which nothing is.

    Raises:
        DatasetError: they cannot be found or read, or flat images and an open beam are said.
    """
    dark, flat, opened = (
        options.get("dark"),
        options.get("flat"),
        options.get("open_beam"),
    )
    if flat is not None and opened is not None:
        raise DatasetFormatError(
            "flat images and an open beam are two statements of one thing; allowed: one of them"
        )
    name, bright = ("flat", flat) if opened is None else ("open beam", opened)
    return (
        None if dark is None else reference("dark", dark, folder),
        None if bright is None else reference(name, bright, folder),
    )


def with_references(data: Images, options: ScanOptions) -> Images:
    """Return the data set with the dark and flat images that are said in place of its own.

    Raises:
        DatasetError: they do not fit the projections, or the data set holds line integrals.
    """
    dark, flat = references_said(options, data.folder)
    if dark is None and flat is None:
        return data
    held = data.arrays or Arrays(None)
    if held.integrals is not None:
        raise DatasetFormatError(
            f"{data.where} holds line integrals, of which dark and flat images change nothing; "
            "allowed: none of them"
        )
    settled = [
        done for done, said in ((NO_DARK, dark), (NO_FLAT, flat)) if said is not None
    ]
    kept = tuple(w for w in data.warnings if not any(done in w for done in settled))
    values = data.provenance
    for part, name in (
        (Part.DARK, "dark"),
        (Part.BEAM, "flat"),
        (Part.BEAM, "open_beam"),
    ):
        if options.get(name) is not None:
            values = values.replaced((part,), f"{name}=")
    # The document lists the scan's own reference images.
    return replace(
        placed(data, dark, flat),
        warnings=kept,
        document=None,
        provenance=values,
        references=None,
    )


def placed(data: Images, dark: Reference | None, flat: Reference | None) -> Images:
    """Return the data set with these dark and flat images; None keeps its own.

    Raises:
        DatasetFormatError: they have another shape than the projections.
    """
    held = data.arrays or Arrays(None)
    if dark is not None:
        held = replace(held, darks=dark.of_shape(data.shape, "dark"))
    if flat is not None:
        held = replace(held, flats=flat.of_shape(data.shape, "flat"))
    empty = held.counts is None and held.darks is None and held.flats is None
    return replace(
        data,
        arrays=None if empty else held,
        darks=data.darks if dark is None else dark.files,
        flats=data.flats if flat is None else flat.files,
    )


def with_options(data: Images, options: ScanOptions) -> Images:
    """Return the data set with all that is said of it, in this order: angles, dark and flat
    images, views, crop and binning.

    Raises:
        DatasetError: something that does not fit the data set; names it.
        GeometryError: angles for a panel on its side.
    """
    if options.get("angles") is not None:
        turned = at_angles(data.geometry, options, data.folder)
        if len(turned) != len(data):
            raise DatasetFormatError.instead(
                f"{len(turned)} angles for {len(data)} projections",
                len(turned),
                len(data),
            )
        found = angle_findings(turned, azimuths(data.cone_vec))
        doubts = settled(found, DatasetFormatError, data.where)
        data = replace(
            data,
            cone_vec=turned,
            nominal=None,
            correction=None,
            document=None,
            warnings=(*data.warnings, *doubts),
            provenance=data.provenance.replaced((Part.ANGLES,), "angles="),
        )
    data = with_references(data, options)
    return cut(data, options.get("crop"), options.get("binning"), options.get("views"))


__all__ = [
    "Geometry",
    "Said",
    "ScanOptions",
    "at_angles",
    "geometry_said",
    "references_said",
    "with_options",
    "with_references",
    "with_statements",
]
