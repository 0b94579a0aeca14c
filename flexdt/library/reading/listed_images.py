"""Data sets of image files that are named one by one, and of geometry without images."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final, overload

import numpy as np
import numpy.typing as npt

from flexdt.library.data_set import DataSet
from flexdt.library.datasets.image_doubts import (
    FLAT_IMAGE,
    RADIOGRAPHS,
    SATURATED,
    first_look,
)
from flexdt.library.datasets.image_set import Arrays, Counts, CountsReader
from flexdt.library.datasets.image_sources import Reference
from flexdt.library.datasets.scan_inputs import NO_DARK, NO_FLAT
from flexdt.runtime.files.dataset_folder import Folder, Frame, blank_images, read_image
from flexdt.runtime.files.image_files import image_head, is_image_name
from flexdt.twin.dataset.dataset_errors import DatasetFormatError, DatasetMissingError
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.plausibility import Operation, examine, settled
from flexdt.twin.plausibility.image_order import ordered, other_name

FLAT_NAME: Final = re.compile(r"flat|white|bright|open|blank|gain|^io", re.IGNORECASE)
"""Words in the names of flat images."""


def without_flat(name: str, names: Sequence[str]) -> str:
    """Write the warning that a scan lacks flat images, with the first file that looks like one.

    Args:
        name: of the scan.
        names: of all files beside it, sorted.
    """
    some = [n for n in names if FLAT_NAME.search(n) and is_image_name(n)]
    guess = f"; {some[0]} looks like one" if some else ""
    return (
        f"{name}: {NO_FLAT} (io* unless said){guess}; counts become line integrals by one, "
        "or by the count of the open beam"
    )


def in_order(
    content: Folder, names: Sequence[str], views: int
) -> tuple[list[str], list[str]]:
    """Sort images by the numbers in their names; return doubts about them as sentences.

    Names of another form stay, with a doubt; they are left out where the others are as
    many as the views. A repeated name counts once; gaps are doubts.

    Raises:
        DatasetFormatError: two have one number.
    """
    found = ordered(names)
    kept = [*found.names]
    told = settled(found.findings, DatasetFormatError, str(content.path))
    if found.others:
        doubt = other_name(found.others, kept)
        without = [name for name in kept if name not in found.others]
        if len(without) == views:
            doubt = replace(doubt, remedy=f"left out: there are {views} views")
            kept = without
        told += settled([doubt], where=str(content.path))
    return kept, told


def doubts_of(content: Folder, geometry: ConeVec, shape: tuple[int, int]) -> list[str]:
    """List doubts about a geometry for images of a shape, as sentences.

    Raises DatasetFormatError: no scanner has it.
    """
    found = examine(Operation.OPEN, geometry, shape)
    if found:
        return settled(found, DatasetFormatError, str(content.path))
    return []


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
    full_scale: int | None = None,
    references: tuple[Reference, Reference] | None = None,
    **known: Any,
) -> DataSet:
    """Make the data set of images named one by one.

    Images that are missing or zero everywhere become missing frames and make it
    incomplete. Doubts about the geometry, saturated images (unless a warning names them
    already) and a lack of dark images become warnings.

    Args:
        content: where they are.
        geometry: one view for each projection.
        names, darks, flats: of the images.
        name: of the data set; default: the folder's.
        shapes: (rows, cols) of each projection; default: all as the first that is there,
            which the geometry must then fit.
        reasons: why it is not complete.
        warnings: doubts about it.
        full_scale: largest count of the panel, to find saturated images; None: unknown.
        references: dark and flat images in place of `darks` and `flats`, wherever they are.
        known: further members of `DataSet`.

    Raises:
        DatasetError: no scanner has the geometry; or, without `shapes`, no image is
            there, or the geometry has another number of views or another shape.
    """
    if not shapes:
        there = [n for n in names if n in content.names]
        if not there:
            raise DatasetMissingError(
                f"{content.path}: no projections "
                f"({', '.join(names[:1]) or 'none is listed'} ...)",
                {"path": str(content.path), "missing": list(names[:100])},
            )
        if len(names) != len(geometry):
            said = f"{content.path}: {len(names)} projections and {len(geometry)} views"
            raise DatasetFormatError.instead(said, len(geometry), len(names))
        shape = image_head(content.path / there[0]).shape
        geometry = geometry.with_shape(geometry.of_shape(shape))
        shapes = [shape] * len(names)
    warnings = [*warnings, *doubts_of(content, geometry, shapes[0])]
    lost = content.lost((*darks, *flats, *names))
    blank = blank_images(content, names)
    reasons = [reason for reason in (*reasons, lost, nothing_in(blank)) if reason]
    content = replace(content, names=content.names.difference(blank))
    frames = content.frames(names, shapes)
    dark, flat = references or (
        Reference(content.paths(darks)),
        Reference(content.paths(flats)),
    )
    held = Arrays(
        None, dark.of_shape(shapes[0], "dark"), flat.of_shape(shapes[0], "flat")
    )
    if held.darks is not None or held.flats is not None:
        known["arrays"] = held
    if not any(SATURATED in told for told in warnings):
        warnings = [*warnings, *_first_look(frames, flat.files, full_scale)]
    return DataSet(
        name or content.path.name,
        frames,
        shapes[0],
        geometry,
        folder=content.path,
        darks=dark.files,
        flats=flat.files,
        complete=not reasons,
        reason="; ".join(reasons),
        warnings=(
            *warnings,
            *([f"{NO_DARK} (di000000.tif): zero is taken"] if not dark else []),
        ),
        full_scale=full_scale,
        **known,
    )


class PlacedCounts:
    """Counts of images in files of several, read when they are needed; an array of (n, rows,
    cols) as far as indexing.

    Args:
        places: file and index in it of each image.
        shape: (rows, cols) of each.
    """

    def __init__(
        self, places: Sequence[tuple[Path, int]], shape: tuple[int, int]
    ) -> None:
        """Take the places; nothing is read."""
        self._places = tuple(places)
        self._shape = shape

    @overload
    def __getitem__(self, index: int) -> Counts: ...
    @overload
    def __getitem__(self, index: npt.NDArray[np.int64]) -> CountsReader: ...
    def __getitem__(self, index: int | npt.NDArray[np.int64]) -> Counts | CountsReader:
        """Read an image, or select some."""
        if isinstance(index, int | np.integer):
            path, image = self._places[index]
            return read_image(path, self._shape, image)
        return PlacedCounts([self._places[i] for i in index], self._shape)


def of_places(
    places: Sequence[tuple[Path, int]],
    shape: tuple[int, int],
    geometry: ConeVec,
    name: str,
    warnings: Sequence[str],
    *,
    dark_told: bool,
) -> DataSet:
    """Make the data set of images in files of several, which are read when they are needed.

    Images at the end that are zero everywhere make it incomplete.

    Args:
        places: file and index in it of each projection.
        shape: (rows, cols) of each.
        geometry: one view for each.
        name: of the data set.
        warnings: doubts about it.
        dark_told: whether a lack of dark images is told.

    Raises:
        DatasetError: no scanner has the geometry, or it is of another shape.
    """
    cone = geometry.with_shape(geometry.of_shape(shape))
    doubts = settled(examine(Operation.OPEN, cone, shape), DatasetFormatError, name)
    counts = PlacedCounts(places, shape)
    last = len(places)
    while last and not counts[last - 1].any():
        last -= 1
    frames = tuple(
        Frame(i, f"scan_{i:06d}.tif", None, i < last, shape) for i in range(len(places))
    )
    blank = [frame.file for frame in frames if not frame.present]
    return DataSet(
        name,
        frames,
        shape,
        cone,
        arrays=Arrays(counts),
        complete=not blank,
        reason=nothing_in(blank),
        warnings=(
            *([f"{NO_DARK}: zero is taken"] if dark_told else []),
            *doubts,
            *warnings,
        ),
    )


def in_memory(
    images: npt.NDArray[Any],
    geometry: ConeVec,
    dark: Reference | None,
    flat: Reference | None,
    name: str,
) -> DataSet:
    """Make a data set of images in memory (n, rows, cols), which are no counts of uint16 or
    came in one piece; see `DataSet.from_arrays`.
    """
    shape = images.shape[1], images.shape[2]
    before = None if dark is None else dark.read(shape, "dark")
    opened = None if flat is None else flat.read(shape, "flat")
    if before is None and opened is not None and images.dtype.kind == "f":
        before = np.zeros((1, *shape))  # of intensities that are no counts
    return DataSet.from_arrays(images, geometry, dark=before, flat=opened, name=name)


def _first_look(
    frames: Sequence[Frame], flats: Sequence[Path], full_scale: int | None
) -> list[str]:
    """Check whether the first flat image or a projection is saturated at `full_scale`.

    The projection is the middle one of those that are there.

    Returns:
        Warnings; [] without images or doubts.
    """
    if full_scale is None:
        return []
    taken = [frame for frame in frames if frame.present]
    middle = taken[len(taken) // 2].path if taken else None
    kinds = {FLAT_IMAGE: next(iter(flats), None), RADIOGRAPHS: middle}
    return first_look(
        {what: path for what, path in kinds.items() if path is not None}, full_scale
    )


def nothing_in(blank: Sequence[str]) -> str:
    """Explain that blank (all zero) images make a scan incomplete, naming the first and
    last; "" without blank images.
    """
    if not blank:
        return ""
    more = f" to {blank[-1]}" if len(blank) > 1 else ""
    if more:
        many = f"{len(blank)} projections, {blank[0]}{more}, are"
    else:
        many = f"{blank[0]} is"
    return f"{many} zero everywhere: nothing was recorded"


def markers_alone(geometry: ConeVec, name: str) -> DataSet:
    """Make a data set without images: geometry for markers.

    Each view has a frame, named "view 0" and so on, that is marked as missing.

    Raises:
        TwinError: the geometry does not state the detector's rows and columns.
    """
    if geometry.shape is None:
        raise TwinError(
            f"{name}: the geometry does not state the detector's rows and columns; "
            "write one that does with flexdt import, or give the frames too"
        )
    shape = (geometry.shape[1], geometry.shape[2])
    frames = tuple(
        Frame(i, f"view {i}", None, False, shape) for i in range(len(geometry))
    )
    return DataSet(name, frames, shape, geometry.with_shape(shape))
