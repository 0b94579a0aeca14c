"""Counts to line integrals: -log((p - d) / (f - d)), finite for every pixel.

A pixel that the beam does not reach in the flat (f - d below one count) is dead: it is
interpolated between the nearest live ones of its row. A pixel without signal in the projection
counts as half a count, the largest attenuation the data support. Nothing is smoothed, bright
pixels are not clipped, and beam hardening is not corrected.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.geometry.conventions import Float32Array

MIN_FLAT: Final = 1.0
"""Least counts above dark of a live pixel of the flat."""
MIN_COUNTS: Final = 0.5
"""Counts above dark that are assumed for a pixel without signal."""
NO_LIGHT: Final = (
    "the flat field is nowhere brighter than the dark image: was the tube off?"
)
LEAST_LIGHT: Final = 1e-6
"""Open beam above which a pixel of images on another scale is live, as a share of the
brightest."""


@dataclass(frozen=True, eq=False)
class LineIntegrals:
    """Converts counts of one data set to line integrals.

    Attributes:
        dark: mean dark image, (rows, cols) [counts].
        log_open: log of the open beam f - d, (rows, cols); 0 where dead.
        dead: mask of dead pixels, and of those that are interpolated as they are.
        before, after: flat indices of the live pixels between which each of these is
            interpolated.
        weight: of the latter.
    """

    dark: Float32Array
    log_open: Float32Array
    dead: npt.NDArray[np.bool_]
    before: npt.NDArray[np.intp]
    after: npt.NDArray[np.intp]
    weight: Float32Array

    @classmethod
    def of(cls, dark: Float32Array, flat: Float32Array) -> LineIntegrals:
        """Prepare the conversion from mean dark and flat images (rows, cols) [counts].

        Pixels whose flat is not at least `MIN_FLAT` above the dark are dead, NaN too.

        Raises DatasetFormatError: no pixel of the flat is brighter than the dark image.
        """
        opened = np.asarray(flat, dtype=np.float32) - np.asarray(dark, dtype=np.float32)
        dead = ~(opened >= MIN_FLAT)
        if dead.all():
            raise DatasetFormatError(NO_LIGHT)
        log_open = np.log(np.where(dead, np.float32(1.0), opened))
        return cls(np.asarray(dark, dtype=np.float32), log_open, dead, *_neighbours(dead))

    def interpolating(self, mask: npt.NDArray[np.bool_]) -> LineIntegrals:
        """Return a conversion that interpolates the pixels of a mask as well.

        It is this one if no pixel would be left.
        """
        dead = self.dead | mask
        if dead.all():
            return self
        return LineIntegrals(self.dark, self.log_open, dead, *_neighbours(dead))

    def __call__(self, counts: npt.NDArray[np.generic]) -> Float32Array:
        """Convert counts (rows, cols) to finite line integrals, float32.

        Counts less the dark are taken as at least `MIN_COUNTS`. Dead pixels are
        interpolated in their row, or get the nearest live pixel's value.
        """
        out: Float32Array = np.subtract(counts, self.dark, dtype=np.float32)
        np.maximum(out, np.float32(MIN_COUNTS), out=out)
        np.log(out, out=out)
        np.subtract(self.log_open, out, out=out)
        _interpolate(out, self.dead, self.before, self.after, self.weight)
        return out


def of_intensities(
    images: npt.NDArray[Any], dark: npt.NDArray[Any] | float, flat: npt.NDArray[Any]
) -> Float32Array:
    """Convert images that are not whole counts to line integrals (n, rows, cols).

    Such are averaged or scaled, or transmissions with a flat image of ones; noise may
    bring them below the dark image. Light counts as at least float32's smallest normal
    number. Pixels whose open beam is not above `LEAST_LIGHT` of the brightest, NaN too,
    are interpolated in their row.

    Raises:
        DatasetFormatError: no pixel of the flat is brighter than the dark image.
    """
    opened = np.asarray(flat - dark, dtype=np.float64)
    dead = ~(opened > LEAST_LIGHT * max(float(np.nanmax(flat, initial=0.0)), 0.0))
    if dead.all():
        raise DatasetFormatError(NO_LIGHT)
    opened[dead] = 1.0
    light = (np.asarray(images, dtype=np.float32) - dark) / opened
    least = np.finfo(np.float32).tiny
    out = np.asarray(-np.log(np.maximum(light, least)), dtype=np.float32)
    _interpolate(out, dead, *_neighbours(dead))
    return out


def _interpolate(
    out: Float32Array,
    dead: npt.NDArray[np.bool_],
    before: npt.NDArray[np.intp],
    after: npt.NDArray[np.intp],
    weight: Float32Array,
) -> None:
    """Replace the dead pixels of images (..., rows, cols), in place, by those of
    `_neighbours`; nothing without any.
    """
    if len(before):
        pixels = out.reshape(*out.shape[:-2], -1)
        out[..., dead] = (1.0 - weight) * pixels[..., before] + weight * pixels[
            ..., after
        ]


def _neighbours(
    dead: npt.NDArray[np.bool_],
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.intp], Float32Array]:
    """Find the live pixels between which each dead one is interpolated: before and after
    it in its row.

    A pixel without a live one on both sides gets the nearest of the whole image twice,
    with weight 0.

    Args:
        dead: (rows, cols), True for dead pixels; at least one is live.

    Returns:
        Flat indices of both, and the weight of the latter, (d,) each, in row order; empty
        without dead pixels.
    """
    if not dead.any():
        none = np.empty(0, dtype=np.intp)
        return none, none, np.empty(0, dtype=np.float32)
    from scipy.ndimage import distance_transform_edt

    cols = dead.shape[1]
    column = np.broadcast_to(np.arange(cols), dead.shape)
    before = np.maximum.accumulate(np.where(dead, -1, column), axis=1)[dead]
    after = np.minimum.accumulate(np.where(dead, cols, column)[:, ::-1], axis=1)[:, ::-1][
        dead
    ]
    row, here = np.nonzero(dead)
    _, (near_row, near_column) = distance_transform_edt(dead, return_indices=True)
    nearest = (near_row * cols + near_column)[dead]
    between = (before >= 0) & (after < cols)
    weight = np.where(between, (here - before) / (after - before), 0.0)
    first = np.where(between, row * cols + before, nearest)
    second = np.where(between, row * cols + after, nearest)
    return first.astype(np.intp), second.astype(np.intp), weight.astype(np.float32)


def binned_mean(
    images: npt.NDArray[Any], factor: int | tuple[int, int]
) -> npt.NDArray[Any]:
    """Average over blocks of pixels; surplus rows at the bottom and columns at the right
    are cut off.

    Sums are in float32.

    Args:
        images: (..., rows, cols).
        factor: pixels along each edge of a block, or its rows and columns.

    Returns:
        float32 (..., rows, cols), coarse; `images` itself for a factor of 1.
    """
    if isinstance(factor, int):
        down, across = (factor, factor)
    else:
        down, across = factor
    if down == across == 1:
        return images
    rows, cols = images.shape[-2] // down, images.shape[-1] // across
    cut = images[..., : rows * down, : cols * across]
    # Rows first, along which numbers lie side by side: a fifth of the time.
    lines = cut.reshape(*images.shape[:-2], rows, down, cols * across)
    lines = lines.sum(axis=-2, dtype=np.float32)
    blocks = lines.reshape(*images.shape[:-2], rows, cols, across)
    sums: Float32Array = blocks.sum(axis=-1, dtype=np.float32)
    return sums / np.float32(down * across)
