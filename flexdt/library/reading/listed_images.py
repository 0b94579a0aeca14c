"""Data sets of image files that are named one by one, and of geometry without images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, Final

from flexdt.library.data_set import DataSet
from flexdt.runtime.files.dataset_folder import Folder, Frame, read_image
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec

NO_DARK: Final = "no dark image"


def by_numbers(name: str) -> list[tuple[int, str]]:
    """Order of names in which 10 comes after 9."""
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts]


def listed(
    content: Folder,
    geometry: ConeVec,
    names: Sequence[str],
    darks: Sequence[str],
    flats: Sequence[str],
    name: str = "",
    shapes: Sequence[tuple[int, int]] = (),
    reasons: Sequence[str] = (),
    warnings: Sequence[str] = (),
    **known: Any,
) -> DataSet:
    """The data set of images named one by one.

    Args:
        content: where they are.
        geometry: one view for each projection.
        names, darks, flats: of the images.
        name: of the data set; default: the folder's.
        shapes: (rows, cols) of each projection; default: all as the first that is there.
        reasons: why it is not complete.
        warnings: what is doubtful.
        known: further members of `DataSet`.

    Raises:
        DatasetError: none is there, or the geometry has another number of views or another shape.
    """
    if not shapes:
        there = [n for n in names if n in content.names]
        if not there:
            raise DatasetMissingError(
                f"{content.path}: no projections ({', '.join(names[:1]) or 'none is listed'} ...)",
                {"path": str(content.path), "missing": list(names[:100])},
            )
        if len(names) != len(geometry):
            said = f"{content.path}: {len(names)} projections and {len(geometry)} views"
            raise DatasetFormatError.instead(said, len(geometry), len(names))
        rows, cols = read_image(content.path / there[0]).shape
        geometry = geometry.with_shape(geometry.of_shape((rows, cols)))
        shapes = [(rows, cols)] * len(names)
    reasons = [reason for reason in (*reasons, content.lost((*darks, *flats, *names))) if reason]
    return DataSet(
        name or content.path.name,
        content.frames(names, shapes),
        shapes[0],
        geometry,
        folder=content.path,
        darks=content.paths(darks),
        flats=content.paths(flats),
        complete=not reasons,
        reason="; ".join(reasons),
        warnings=(*warnings, *([] if darks else [f"{NO_DARK} (di000000.tif): zero is taken"])),
        **known,
    )


def markers_alone(geometry: ConeVec, name: str) -> DataSet:
    """A data set without images: geometry for markers.

    Raises:
        TwinError: the geometry does not state the detector's size.
    """
    if geometry.shape is None:
        raise TwinError(
            f"{name}: the geometry does not state the detector's rows and columns; write one that "
            "does with flexdt import, or give the frames too"
        )
    shape = (geometry.shape[1], geometry.shape[2])
    frames = tuple(Frame(i, f"view {i}", None, False, shape) for i in range(len(geometry)))
    return DataSet(name, frames, shape, geometry.with_shape(shape))
