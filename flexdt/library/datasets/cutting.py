"""Cut a data set: some of its views, a part of its panel, coarser pixels; images are cut when
they are read."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final, overload

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import (
    Arrays,
    Counts,
    CountsReader,
    Images,
    ImageSet,
)
from flexdt.runtime.files.dataset_folder import read_values
from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.geometry.cone_vec import ConeVec

SLICE: Final = re.compile(r"\s*(-?\d*)\s*(?::\s*(-?\d*)\s*(?::\s*(-?\d*)\s*)?)?")
CROP_FORM: Final = (
    'ROW:ROW,COLUMN:COLUMN, counted from 0 without the end, as "100:900,50:1000"'
)
VIEWS_FORM: Final = 'FIRST:END:STEP, as "::2", or indices, as "0,5,9"'


@dataclass(frozen=True)
class Part:
    """The part of an image that is kept.

    Attributes:
        rows, cols: (first, end) of the full image.
        binning: pixels a side whose mean is one; what does not fill one is cut off at the
            bottom and the right.
    """

    rows: tuple[int, int]
    cols: tuple[int, int]
    binning: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of a cut image."""
        high, wide = (end - first for first, end in (self.rows, self.cols))
        return high // self.binning, wide // self.binning

    def of(self, images: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Cut images (..., rows, cols); means are float32."""
        kept = images[..., slice(*self.rows), slice(*self.cols)]
        return binned_mean(kept, self.binning)

    def of_counts(self, counts: npt.NDArray[Any]) -> Counts:
        """Cut counts; means are rounded."""
        cut = self.of(counts)
        if cut.dtype == np.uint16:
            return np.ascontiguousarray(cut)
        return np.asarray(np.rint(cut), dtype=np.uint16)

    def of_geometry(self, geometry: ConeVec, shape: tuple[int, int]) -> ConeVec:
        """Return the geometry of the cut images of a panel of (rows, cols)."""
        rows, cols = shape
        down = (sum(self.rows) - 1) / 2 - (rows - 1) / 2
        right = (sum(self.cols) - 1) / 2 - (cols - 1) / 2
        centre = geometry.detector + right * geometry.u + down * geometry.v
        high, wide = (end - first for first, end in (self.rows, self.cols))
        kept = ConeVec.from_vectors(
            geometry.source, centre, geometry.u, geometry.v, (high, wide)
        )
        return kept.binned(self.binning) if self.binning > 1 else kept


class CutCounts:
    """Counts of a data set, cut when they are read; an array of (n, rows, cols) as far as
    indexing.

    Args:
        read: the counts of a view of the full data set.
        views: index there of each view.
        part: of the images.
    """

    def __init__(
        self, read: Callable[[int], Counts], views: npt.NDArray[np.int64], part: Part
    ) -> None:
        """Take what is read, and what is kept of it."""
        self._read = read
        self._views = views
        self._part = part

    @overload
    def __getitem__(self, index: int) -> Counts: ...
    @overload
    def __getitem__(self, index: npt.NDArray[np.int64]) -> CountsReader: ...
    def __getitem__(self, index: int | npt.NDArray[np.int64]) -> Counts | CountsReader:
        """Read a view, or select some."""
        if isinstance(index, int | np.integer):
            return self._part.of_counts(self._read(int(self._views[index])))
        return CutCounts(self._read, self._views[index], self._part)


def cut(
    data: Images,
    crop: str | tuple[slice, slice] | None,
    binning: int | None,
    views: str | slice | Sequence[int] | None,
) -> Images:
    """Return a part of a data set; itself where nothing is said.

    A correction in force becomes a part of the geometry, since it counts pixels of the whole
    panel.

    Args:
        data: the data set.
        crop: rows and columns to keep; None: all.
        binning: pixels a side whose mean is one; None: 1.
        views: to keep; None: all.

    Raises:
        DatasetFormatError: words of another form, nothing would be left, or the correction in
            force undoes a distortion or lag of the whole panel.
    """
    if views is not None:
        data = data[_views(views, len(data))]
    if crop is None and binning in (None, 1):
        return data
    part = _part(crop, binning or 1, data.shape)
    if data.panel is not None:
        raise DatasetFormatError(
            f"{data.where}: the correction in force undoes a distortion or lag of the whole "
            "panel; crop and binning are allowed without it"
        )
    whole = [frame.file for frame in data.frames if frame.shape != data.shape]
    if whole:
        raise DatasetFormatError(
            f"{data.where}: {whole[0]} has another shape than the first image; crop and binning "
            "are allowed where all are alike"
        )
    frames = tuple(replace(frame, shape=part.shape) for frame in data.frames)
    return replace(
        data,
        frames=frames,
        shape=part.shape,
        cone_vec=part.of_geometry(data.geometry, data.shape),
        nominal=None,
        correction=None,
        document=None,
        arrays=_cut_arrays(data, part),
        darks=(),
        flats=(),
        interpolated=None
        if data.interpolated is None
        else part.of(data.interpolated) > 0,
        truth=None,
    )


def _cut_arrays(data: ImageSet, part: Part) -> Arrays:
    """Return the images of a data set cut: those in memory now, those in files when they are
    read."""
    held = data.arrays or Arrays(None)
    counts: Counts | CountsReader
    if isinstance(held.counts, np.ndarray):
        counts = part.of_counts(held.counts)
    else:
        counts = CutCounts(data.counts, np.arange(len(data)), part)
    kinds = ((held.darks, data.darks), (held.flats, data.flats))
    darks, flats = (
        part.of(np.stack([read_values(path, data.shape) for path in files]))
        if images is None and files
        else None
        if images is None
        else part.of(images)
        for images, files in kinds
    )
    integrals = None if held.integrals is None else part.of(held.integrals)
    return Arrays(counts, darks, flats, integrals)


def _part(
    crop: str | tuple[slice, slice] | None, binning: int, shape: tuple[int, int]
) -> Part:
    """Return the part of an image of (rows, cols) that is said.

    Raises:
        DatasetFormatError: words of another form, or nothing would be left.
    """
    both: Sequence[slice] = (slice(None), slice(None))
    if isinstance(crop, str):
        words = crop.split(",")
        both = [_slice(word, "crop", crop, CROP_FORM) for word in words]
        if len(both) != 2:
            raise DatasetFormatError.instead(f"crop is {crop!r}", crop, CROP_FORM)
    elif crop is not None:
        both = crop
    if len(both) != 2 or not all(isinstance(one, slice) for one in both):
        raise DatasetFormatError.instead(f"crop is {crop!r}", str(crop), CROP_FORM)
    spans = []
    for one, size in zip(both, shape, strict=True):
        if any(
            end is not None and not -size <= end <= size for end in (one.start, one.stop)
        ):
            raise DatasetFormatError.instead(
                f"crop is {crop!r} of images of {shape[0]} rows and {shape[1]} columns",
                str(crop),
                "within them",
            )
        first, end, step = one.indices(size)
        if step != 1:
            raise DatasetFormatError.instead(f"crop is {crop!r}", str(crop), CROP_FORM)
        spans.append((first, end))
    most = min(end - first for first, end in spans)
    if most < 1:
        raise DatasetFormatError(
            f"crop is {crop!r}: nothing is left of {shape[0]} rows and {shape[1]} columns",
            {"asked": str(crop), "allowed": list(shape)},
        )
    if isinstance(binning, bool) or binning not in range(1, most + 1):
        raise DatasetFormatError.instead(
            f"binning is {binning!r}", binning, f"a whole number from 1 to {most}"
        )
    return Part(spans[0], spans[1], int(binning))


def _slice(word: str, what: str, said: str, form: str) -> slice:
    """Return the slice of FIRST:END:STEP.

    Raises:
        DatasetFormatError: another form.
    """
    found = SLICE.fullmatch(word)
    parts = word.split(":")
    if found is None or len(parts) < 2 or any(p.strip() == "-" for p in parts):
        raise DatasetFormatError.instead(f"{what} is {said!r}", said, form)
    numbers = [int(part) if part.strip() else None for part in parts]
    if len(numbers) == 3 and numbers[2] == 0:
        raise DatasetFormatError.instead(f"{what} is {said!r}", said, form)
    return slice(*numbers)


def _views(said: str | slice | Sequence[int], many: int) -> npt.NDArray[np.int64]:
    """Return the indices of the views that are said, of so many.

    Raises:
        DatasetFormatError: another form, a view that there is not, or none.
    """
    chosen: npt.NDArray[Any]
    if isinstance(said, str) and ":" in said:
        chosen = np.arange(many)[_slice(said, "views", said, VIEWS_FORM)]
    elif isinstance(said, slice):
        chosen = np.arange(many)[said]
    else:
        words = said.split(",") if isinstance(said, str) else said
        try:
            chosen = np.array([int(str(word)) for word in words], dtype=np.int64)
        except ValueError:
            raise DatasetFormatError.instead(
                f"views are {said!r}"[:120], str(said)[:100], VIEWS_FORM
            ) from None
        bad = chosen[(chosen < -many) | (chosen >= many)]
        if len(bad):
            raise DatasetFormatError.instead(
                f"views: there is no view {bad[0]}", int(bad[0]), f"0 to {many - 1}"
            )
    if not len(chosen):
        raise DatasetFormatError.instead(
            f"views are {said!r}: none of {many}"[:120], str(said)[:100], VIEWS_FORM
        )
    return np.asarray(np.arange(many)[chosen], dtype=np.int64)
