"""Pixels of a data set that do not respond as their neighbors do, interpolated."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import Counts, ImageSet
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.reconstruction.acquisition.rectify import on_its_side
from flexdt.twin.reconstruction.consistency.pixels import (
    SCREENED_VIEWS,
    BadPixels,
    bad_pixels,
)

MIN_VIEWS: Final = 12
"""Smallest number of views in which bad pixels are separable from a turning object."""
MAX_KEPT_BYTES: Final = 128 << 20
"""Largest line integrals kept between the passes over them [bytes]; larger ones are
recomputed."""
MIN_TURN_SHARE: Final = 0.2
"""Spread of the sources over their distance from the axis, at least, of a scan that turns."""


def without_bad_pixels(
    dataset: ImageSet, cone_vec: ConeVec, counts: Callable[[int], Counts]
) -> tuple[ImageSet, list[str]]:
    """Mark the pixels that do not respond as their neighbors, to be interpolated.

    Returns also one warning about them, or [].
    """
    pixels = _bad_pixels(dataset, cone_vec, counts)
    if pixels is None:
        return dataset, []
    return replace(dataset, interpolated=pixels.mask), [str(pixels)]


def _bad_pixels(
    dataset: ImageSet, cone_vec: ConeVec, counts: Callable[[int], Counts]
) -> BadPixels | None:
    """Find pixels that do not respond as their neighbors do.

    Views are read evenly spread; they are kept in memory for the next pass as far as they
    need at most `MAX_KEPT_BYTES`. For a panel on its side rows and columns are exchanged
    meanwhile.

    Args:
        dataset: with its flat image.
        cone_vec: of all views.
        counts: reads an image by its number.

    Returns:
        The pixels; None with fewer than `MIN_VIEWS` views, no open beam, a source that
        moves by less than `MIN_TURN_SHARE` of its distance, an axis that is projected
        nowhere, or no bad pixels.
    """
    present = np.array(dataset.present)
    if len(present) < MIN_VIEWS or not (dataset.flat > dataset.dark).any():
        return None
    views = cone_vec[_some(present, SCREENED_VIEWS)]
    spread = np.ptp(views.source[:, :2], axis=0).max()
    if spread < MIN_TURN_SHARE * np.linalg.norm(views.source, axis=1).max():
        return None
    lies = on_its_side(views)
    middle = views.project_points(np.zeros((1, 3)), dataset.shape)[:, 0, 1 if lies else 0]
    axis_column = float(np.median(middle))
    if not np.isfinite(axis_column):
        return None

    held: dict[int, Float32Array] = {}
    most = MAX_KEPT_BYTES // (4 * math.prod(dataset.shape))

    def images(many: int) -> Iterator[Float32Array]:
        """Yield line integrals of so many views, rows along the axis; kept for the next
        pass as far as they fit the memory.
        """
        for index in _some(present, many).tolist():
            if index in held:
                yield held[index]
                continue
            made = dataset.normalisation(counts(index))
            image = made.T if lies else made
            if len(held) < most:
                held[index] = image
            yield image

    pixels = bad_pixels(images, axis_column)
    if pixels is not None and lies:
        return BadPixels(pixels.mask.T)
    return pixels


def _some(present: npt.NDArray[np.intp], many: int) -> npt.NDArray[np.intp]:
    """Choose so many of the present frames, or all if there are fewer, spread evenly. `present`:
    indices of frames; `many`: at least 1."""
    chosen = np.unique(np.linspace(0, len(present) - 1, many).astype(np.intp))
    return np.asarray(present[chosen])
