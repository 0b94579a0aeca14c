"""Look at dark and flat images once, when a data set is opened: what is told is part of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import Images, ImageSet
from flexdt.runtime.files.image_files import read_rows
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.findings import Findings
from flexdt.twin.plausibility import settled
from flexdt.twin.plausibility.reference_images import (
    beam_findings,
    below_dark_findings,
    dark_findings,
    flat_findings,
    open_beam,
)

ROWS: Final = 16
"""Rows of each image that are looked at, evenly spaced."""
VIEWS: Final = 3
"""Projections that are looked at: the first, the middle and the last."""
MOST_IMAGES: Final = 32
"""Dark and flat images of a kind that are looked at, evenly spaced."""
Some = npt.NDArray[Any]


def looked_at(data: Images) -> Images:
    """Return the data set with what its dark and flat images contradict; itself if looked
    at.

    Each is compared with others of its kind, and three projections with their means.
    Unreadable images are left out.
    """
    if data.references is not None:
        return data
    found = _findings(data)
    told = settled(found)
    new = tuple(one for one in told if not any(one in known for known in data.warnings))
    return replace(data, references=found, warnings=(*data.warnings, *new))


def _findings(data: ImageSet) -> Findings:
    """Compare the reference images of a data set with each other and with projections."""
    held = data.arrays
    if held is not None and held.integrals is not None:
        return Findings()  # they were given, not exposed
    rows = _rows(data.shape[0])
    darks = _some(None if held is None else held.darks, data.darks, data.shape, rows)
    flats = _some(None if held is None else held.flats, data.flats, data.shape, rows)
    if not len(flats) and not len(darks):
        return Findings()
    dark = darks.mean(axis=0) if len(darks) else np.zeros((len(rows), data.shape[1]))
    opened = (flats.mean(axis=0) if len(flats) else dark) - dark
    views = _views(data, rows)
    found = [*flat_findings(flats, dark), *dark_findings(darks, opened)]
    if not found and len(darks):
        found = [*below_dark_findings(views, dark)]
    if not found and len(flats) and len(views):
        beam = np.where(opened > 1.0, opened, np.nan)
        found = [*beam_findings([open_beam(view, dark, beam) for view in views])]
    return Findings(found)


def _rows(many: int) -> npt.NDArray[np.intp]:
    """Return the rows that are looked at, of so many."""
    return np.unique(np.linspace(0, many - 1, min(ROWS, many)).astype(np.intp))


def _chosen(many: int, most: int) -> npt.NDArray[np.intp]:
    """Return evenly spaced indices of at most `most` images, the first and the last too."""
    return np.unique(np.linspace(0, many - 1, min(most, many)).astype(np.intp))


def _some(
    images: Some | None,
    files: Sequence[Path],
    shape: tuple[int, int],
    rows: npt.NDArray[np.intp],
) -> Some:
    """Return rows of reference images, those in memory or those of files, (k, rows, cols)."""
    if images is not None:
        return images[_chosen(len(images), MOST_IMAGES)][:, rows]
    read = []
    for i in _chosen(len(files), MOST_IMAGES) if files else ():
        try:
            read.append(read_rows(files[i], shape, rows))
        except (OSError, DatasetError):
            continue
    return np.stack(read) if read else np.zeros((0, len(rows), shape[1]))


def _views(data: ImageSet, rows: npt.NDArray[np.intp]) -> Some:
    """Return rows of a few projections, (k, rows, cols); those of other shapes are left out."""
    there = [i for i in data.present if data.frames[i].shape == data.shape]
    read = []
    for i in np.array(there, dtype=np.intp)[_chosen(len(there), VIEWS)] if there else ():
        path = data.frames[i].path
        try:
            if path is not None and (data.arrays is None or data.arrays.counts is None):
                read.append(read_rows(path, data.shape, rows))
            else:
                read.append(data.counts(int(i))[rows])
        except (OSError, DatasetError):
            continue
    return np.stack(read) if read else np.zeros((0, len(rows), data.shape[1]))


def order_doubts(data: ImageSet) -> list[str]:
    """Doubt the order of the indices of images in memory that have as many rows as views.

    A sample in the field of view absorbs much the same in all views and not in all rows: sums
    that change more from image to image than from row to row are those of [row, view, column].
    Nothing is told of other shapes, where the geometry decides.
    """
    many, rows, held = len(data), data.shape[0], data.arrays
    if (
        many != rows
        or many < 4
        or held is None
        or not isinstance(held.counts, np.ndarray)
    ):
        return []
    step = max(1, many // 64)
    some = held.counts[::step, ::step, :: max(1, data.shape[1] // 64)].astype(np.float64)
    signal = some if held.integrals is not None else np.log(np.maximum(some, 1.0))
    of_images, of_rows = (
        float(signal.mean(axis=axes).std()) for axes in ((1, 2), (0, 2))
    )
    noise = float(signal.std()) / np.sqrt(signal[0].size)
    if max(of_images, of_rows) <= 6.0 * noise or of_images <= of_rows:
        return []
    return [
        f"{data.name}: as many rows as views, and images that change more from one to the next "
        "than their rows: is their order [row, view, column]? allowed: [view, row, column], "
        "images.transpose(1, 0, 2)"
    ]
