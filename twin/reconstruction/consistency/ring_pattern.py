"""Errors of single pixels in all views, from which FDK makes rings, separated from object
and noise.

In each view a pixel is compared with its neighbors in the row. The constant part of the
medians of groups of views is the pixel's error, or an object that hardly moves about the
rotation axis. In a full turn columns at equal distances on both sides of the axis see the
same rays, so that an object's part is alike on both sides, and mostly alike in
neighboring rows; pixels' errors are not. The distance of the groups is the noise. An
error is subtracted as far as it stands out from both (Wiener's filter, by block): of a
panel without errors nothing is. Equal errors of two columns as far from the axis are
taken for the object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array

NEIGHBOURHOOD_COLS: Final = 9
"""Columns over which a pixel is compared with its neighbors."""
GROUP_VIEWS: Final = 6
"""Views in a group, whose median is computed first."""
MAX_GROUPS: Final = 48
"""Largest number of groups; beyond it, neighboring groups are averaged in pairs."""
MIN_GROUPS: Final = 6
"""Least number of groups from whose distances noise is estimated."""
COLUMN_ROWS: Final = 15
"""Rows over which a column's error is averaged."""
BLOCK_PX: Final = 9
"""Rows and columns over which variances are computed."""
AXIS_REACH_PX: Final = 2
"""Largest distance from the stated axis at which the center of symmetry is searched
[px]."""
MEDIAN_VARIANCE: Final = 1.571
"""Variance of a median over that of the mean of as many normal deviates."""
SIGMA_OF_MEDIAN: Final = 1.4826
"""Standard deviation of normal deviates over the median of their absolute deviations."""
MIN_EXCESS_SIGMAS: Final = 4.0
"""Least excess of a variance over that of noise, in its standard deviations."""


def ring_errors(
    views: Iterable[Float32Array],
    axis_column: float | None = None,
    width: int = NEIGHBOURHOOD_COLS,
) -> Float32Array:
    """Find each pixel's constant error, to be subtracted from all views, (rows, cols).

    Pixels and complete columns (means over `COLUMN_ROWS` rows) are judged separately;
    what the rows beside, or the other side of the axis, share is the object's.
    `axis_column` is None if the sides do not see the same rays: columns then stay.
    `width`: columns of the neighborhood. Returns 0 where nothing stands out, or groups of
    views are too few. Raises LimitError: no views.
    """
    groups = _group_medians(views, width)
    if len(groups) < MIN_GROUPS:
        return np.zeros_like(groups[0])
    columns = np.stack([_column_means(group) for group in groups])
    pixels = _Pattern.of(np.subtract(groups, columns))
    if axis_column is None:
        return pixels.errors([_rows_beside])
    across = partial(_other_side, axis_column=axis_column)
    found = pixels.errors([across, _rows_beside])
    seen_twice = _columns_seen_twice(found.shape[1], axis_column)
    return found + _Pattern.of(columns).errors([across]) * seen_twice


def _group_medians(views: Iterable[Float32Array], width: int) -> list[Float32Array]:
    """Compute medians of pixels' excess over neighbors in groups of `GROUP_VIEWS` views.

    Groups are joined in pairs when there are `MAX_GROUPS`, so that memory is bounded;
    later groups then have twice as many views. A last incomplete group is dropped unless
    it is the only one.

    Args:
        views: line integrals (rows, cols).
        width: columns of the neighborhood.

    Returns:
        Medians (rows, cols), at least one.

    Raises:
        LimitError: there are no views.
    """
    size = 2 * max(1, width // 2) + 1
    medians: list[Float32Array] = []
    group: list[Float32Array] = []
    joined = 1
    waiting: list[Float32Array] = []
    for view in views:
        group.append(_beyond_neighbours(view, size))
        if len(group) < GROUP_VIEWS:
            continue
        waiting.append(np.median(group, axis=0))
        group = []
        if len(waiting) < joined:
            continue
        medians.append(np.mean(waiting, axis=0))
        waiting = []
        if len(medians) == MAX_GROUPS:
            pairs = zip(medians[::2], medians[1::2], strict=True)
            medians = [
                np.asarray(0.5 * (one + other), np.float32) for one, other in pairs
            ]
            joined *= 2
    if medians:
        return medians
    if not group:
        raise LimitError("no views to find rings in", {"asked": 0, "allowed": "> 0"})
    return [np.median(group, axis=0)]


def _beyond_neighbours(view: Float32Array, size: int) -> Float32Array:
    """Subtract from pixels the mean of the others of `size` columns about them, (rows,
    cols).
    """
    from scipy.ndimage import uniform_filter1d

    mean = uniform_filter1d(view, size, axis=1, mode="nearest")
    return np.asarray((view - mean) * np.float32(size / (size - 1)), np.float32)


def _column_means(image: Float32Array) -> Float32Array:
    """Average `COLUMN_ROWS` rows about each pixel in its column, (rows, cols)."""
    from scipy.ndimage import uniform_filter1d

    mean = uniform_filter1d(image, min(COLUMN_ROWS, len(image)), axis=0, mode="nearest")
    return np.asarray(mean, np.float32)


@dataclass(frozen=True, eq=False)
class _Pattern:
    """The part of images that is equal in all views.

    Attributes:
        values: (rows, cols).
        noise: its variance, (rows, cols).
    """

    values: Float32Array
    noise: Float32Array

    @classmethod
    def of(cls, groups: Float32Array) -> _Pattern:
        """Compute the pattern common to groups of views: their median, with its variance from
        their spread, averaged over blocks of `BLOCK_PX`.

        `groups`: (k, rows, cols)."""
        middle = np.median(groups, axis=0)
        apart = SIGMA_OF_MEDIAN * np.median(np.abs(groups - middle), axis=0)
        noise = MEDIAN_VARIANCE / len(groups) * np.square(apart)
        return cls(middle, _block_mean(np.asarray(noise, np.float32)))

    def errors(
        self, ways: Sequence[Callable[[Float32Array], Float32Array]]
    ) -> Float32Array:
        """Compute the pixels' share of the pattern, (rows, cols).

        The part that correlates with other pixels, in blocks of `BLOCK_PX`, is the
        object's and removed, one function after the other. The rest is shrunk by the
        variance of noise, to 0 where it does not exceed that by `MIN_EXCESS_SIGMAS`.

        Args:
            ways: functions from values (rows, cols) to those of other pixels, to which an
                object adds the same.
        """
        left = self.values
        power = _block_mean(np.square(left))
        least = (1.0 + MIN_EXCESS_SIGMAS * np.sqrt(2.0) / BLOCK_PX) * self.noise
        of_pixels = power
        for alike in ways:
            other = alike(left)
            shared = np.maximum(_block_mean(left * other), np.float32(0.0))
            other_power = np.maximum(
                _block_mean(np.square(other)), np.finfo(np.float32).tiny
            )
            of_pixels = of_pixels - np.maximum(shared, shared**2 / other_power)
            left = np.subtract(left, shared / other_power * other, dtype=np.float32)
        power = np.maximum(_block_mean(np.square(left)), np.finfo(np.float32).tiny)
        gain = np.where(of_pixels > least, of_pixels - self.noise, np.float32(0.0))
        return np.asarray(np.minimum(gain / power, 1.0) * left, np.float32)


def _rows_beside(values: Float32Array) -> Float32Array:
    """Average the pixels above and below, (rows, cols)."""
    padded = np.pad(values, ((1, 1), (0, 0)), "reflect" if len(values) > 1 else "edge")
    return np.asarray(0.5 * (padded[:-2] + padded[2:]), np.float32)


def _columns_seen_twice(cols: int, axis_column: float) -> npt.NDArray[np.bool_]:
    """Find columns with a counterpart as far from the axis on the other side, (cols,)."""
    across = 2.0 * axis_column - np.arange(cols)
    return (across > -0.5) & (across < cols - 0.5)


def _other_side(values: Float32Array, axis_column: float) -> Float32Array:
    """Return values (rows, cols) of the columns across the axis, 0 off the panel.

    The center of symmetry is the one within `AXIS_REACH_PX` of the stated axis at which
    both sides correlate best.
    """
    stated = round(2.0 * axis_column)
    reach = range(stated - 2 * AXIS_REACH_PX, stated + 2 * AXIS_REACH_PX + 1)
    mirrored = [_mirrored(values, total) for total in reach]
    likeness = [float((values * other).sum()) for other in mirrored]
    return mirrored[int(np.argmax(likeness))]


def _mirrored(values: Float32Array, total: int) -> Float32Array:
    """Return a copy of values with column c in the place of column `total` - c, 0 where
    there is none.
    """
    out = np.zeros_like(values)
    columns = np.arange(values.shape[1])
    there = (total - columns >= 0) & (total - columns < values.shape[1])
    out[:, there] = values[:, total - columns[there]]
    return out


def _block_mean(values: Float32Array) -> Float32Array:
    from scipy.ndimage import uniform_filter

    return np.asarray(uniform_filter(values, BLOCK_PX, mode="nearest"), np.float32)
