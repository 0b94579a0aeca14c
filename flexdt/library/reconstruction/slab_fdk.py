"""FDK slab by slab from images that are prepared once: a slab takes the rows in its shadow.

Prepared images are those of upright panels, so that a slab's shadow is some rows of them, one
piece of a file.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from flexdt.library.reconstruction.kept_images import KeptImages
from flexdt.library.reconstruction.memory_plan import PART_IMAGES
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid, Volume
from flexdt.twin.reconstruction import Truncation, fdk_parts
from flexdt.twin.reconstruction.acquisition.rectify import (
    FINER,
    is_upright,
    leans,
    on_its_side,
    rectified,
    rows_needed,
    swapped,
    upright,
    window,
)
from flexdt.twin.reconstruction.acquisition.trajectory import circle_of, narrow_overlap

MARGIN_ROWS: Final = 6
"""Rows around the shadow that a slab takes too, so that a panel of many rows never seems
to have few (`fdk_plan.FEW_ROWS`)."""
VOXEL_WORK = 1.0
FILTERED_PIXEL_WORK = 25.0
READ_PIXEL_WORK = 12.0
"""Work of FDK a voxel and view, a pixel that is filtered and one that is read and prepared, in
units of the first (measured by full_size.py --costs of 52ade1c)."""


@dataclass(frozen=True, eq=False)
class StandingImages:
    """The images of a scan on upright panels.

    Attributes:
        recorded: geometry of the images as recorded, rows along the panel's rows.
        turned: whether rows and columns of the images as recorded change places.
        cone_vec: of the standing images.
        shape: of these, (rows, cols).
        rises: whether the scan is a helix, whose views take whole images.
        truncation: estimate of the object beyond the panel's edges.
    """

    recorded: ConeVec
    turned: bool
    cone_vec: ConeVec
    shape: tuple[int, int]
    rises: bool
    truncation: Truncation | None

    @classmethod
    def of(
        cls, cone_vec: ConeVec, shape: tuple[int, int], truncation: Truncation | None
    ) -> StandingImages:
        """Make the upright images of a scan.

        A panel on its side is turned. The columns of a leaning panel are resampled
        `FINER`, unless the overlap of an offset panel is narrow: then FDK stands the
        images up itself.

        Args:
            cone_vec: of all views.
            shape: of the images as recorded, (rows, cols).
            truncation: estimate of the object beyond the panel's edges.

        Raises:
            GeometryError: neither a circle nor a helix, or a flat panel.
        """
        circle = circle_of(cone_vec)
        turned = on_its_side(cone_vec)
        if turned:
            cone_vec = swapped(cone_vec)
            shape = (shape[1], shape[0])
        rises = bool(circle.rise)
        rows, cols = shape
        if leans(cone_vec):
            wide = round(FINER * cols)
        else:
            wide = cols
        if is_upright(cone_vec):
            level = cone_vec
        else:
            level = upright(cone_vec, wide / cols)
        if wide != cols and narrow_overlap(circle, level, wide):
            # FDK moves the axis between columns as it stands these up: resampled once, not
            # twice.
            return cls(cone_vec, turned, cone_vec, shape, rises, truncation)
        return cls(cone_vec, turned, level, (rows, wide), rises, truncation)

    def stood(self, image: Float32Array, number: int) -> Float32Array:
        """Return the image of a view as an upright panel would have recorded it;
        unchanged, or only turned, where the panel is upright.

        Args:
            image: (rows, cols) as recorded.
            number: of the view.
        """
        if self.turned:
            image = image.T
        if self.cone_vec is self.recorded:
            return image
        view = slice(number, number + 1)
        panels = self.recorded[view], self.cone_vec[view]
        stood: Float32Array = rectified(image[None], *panels, self.shape[1])[0]
        return stood

    def rows(self, like: Volume) -> slice:
        """Return the rows with a slab's shadow in some view, with a margin of `MARGIN_ROWS` on
        either side; all rows if the scan rises or the panel is not upright.

        `like`: grid of the slab; its values are not used."""
        if self.rises or not is_upright(self.cone_vec):
            return slice(0, self.shape[0])
        first, last = rows_needed(self.cone_vec, self.shape, like)
        return slice(max(first - MARGIN_ROWS, 0), min(last + MARGIN_ROWS, self.shape[0]))

    def part(self, rows: slice) -> tuple[ConeVec, tuple[int, int], Truncation | None]:
        """Return geometry, (rows, cols) and truncation (None if there is none) of a range
        of detector rows, of the upright images.

        All columns are taken, and rows count from the first of the range. For all rows
        they are this object's own.
        """
        shape = rows.stop - rows.start, self.shape[1]
        if shape == self.shape:
            return self.cone_vec, self.shape, self.truncation
        cone_vec = window(
            self.cone_vec, self.shape, (rows.start, rows.stop), (0, shape[1])
        )
        truncation = self.truncation
        if truncation is not None:
            truncation = replace(truncation, rows=truncation.rows - rows.start)
        return cone_vec, shape, truncation


def fdk_slabs(
    view: Callable[[int], Float32Array],
    kept_images: KeptImages,
    images: StandingImages,
    grid: Grid,
    slabs: Sequence[tuple[int, int]],
    filter_window: str,
    tell: Callable[[int, float], None],
    *,
    errors: bool = False,
) -> Iterator[Volume]:
    """Reconstruct slab after slab.

    Each image is read, stood up and kept once, at the first slab.

    Args:
        view: gives the corrected image of a view as recorded.
        kept_images: keeps prepared images.
        images: geometry of the upright images.
        grid: of the entire volume.
        slabs: layers (first, last) of each.
        filter_window: of the ramp filter.
        tell: called with the slab's number and the part of it done, 0 to 1.
        errors: give each its `sigma` (circles).
    """

    def prepare(number: int) -> Float32Array:
        return images.stood(view(number), number)

    for k, (first, last) in enumerate(slabs):
        like = grid.slab(first, last).blank()
        rows = images.rows(like)
        cone_vec, shape, truncation = images.part(rows)

        def parts(rows: slice = rows) -> Iterator[Float32Array]:
            for some in _parts(len(images.cone_vec)):
                yield np.stack(
                    [kept_images.prepared(number, prepare, rows) for number in some]
                )

        def told(part: float, k: int = k) -> None:
            tell(k, part)

        yield fdk_parts(
            parts, cone_vec, shape, like, filter_window, told, truncation, errors=errors
        )


def _parts(count: int) -> list[range]:
    limits = [*range(0, count, PART_IMAGES), count]
    return [range(first, last) for first, last in pairwise(limits)]


class Work:
    """Progress of a reconstruction, in images; an image is complete when it is in every slab.

    Args:
        images: of the scan.
        reading: work of reading and preparing them all.
        slabs: work of each slab.
        tell: called with the work done and the total, in images.
    """

    def __init__(
        self,
        images: int,
        reading: float,
        slabs: Sequence[float],
        tell: Callable[[float, float], None],
    ) -> None:
        """Count the work of reading images and of adding slabs.

        `tell` gets the share done, and all, in images.
        """
        self._images = images
        self._reading = reading
        self._slabs = slabs
        self._tell = tell
        self._read = 0
        self._done = [0.0] * len(slabs)

    @classmethod
    def of(
        cls,
        images: StandingImages,
        grid: Grid,
        slabs: Sequence[tuple[int, int]],
        tell: Callable[[float, float], None],
    ) -> Work:
        """Estimate the work of slabs of a grid: reading, filtering and backprojecting.

        Args:
            images: upright.
            grid: of the entire volume.
            slabs: layers (first, last) of each.
            tell: called with the work done and the total.
        """
        count = len(images.cone_vec)
        (rows, cols) = images.shape
        work = []
        for first, last in slabs:
            slab = grid.slab(first, last)
            seen = images.rows(slab.blank())
            pixels = (seen.stop - seen.start) * cols
            work.append(
                count * (VOXEL_WORK * slab.bytes / 4 + FILTERED_PIXEL_WORK * pixels)
            )
        return cls(count, READ_PIXEL_WORK * count * rows * cols, work, tell)

    def read(self) -> None:
        """Count an image as read."""
        self._read += 1
        self._say()

    def slab(self, number: int, part: float) -> None:
        """Set a slab's share done, 0 to 1."""
        self._done[number] = part
        self._say()

    def _say(self) -> None:
        """Report the work done, reading and all slabs, as a number of images out of all."""
        done = self._reading * (self._read / self._images)
        done += sum(
            work * part for work, part in zip(self._slabs, self._done, strict=True)
        )
        whole = self._reading + sum(self._slabs)
        self._tell(self._images * (done / whole), self._images)
