"""Pixels that do not respond as their neighbours do: dead, stuck, hot and flickering ones.

An object turns, so that what it gives to a pixel beyond its neighbours in the row it
gives in few views. A pixel that is beyond them by far more than other pixels, in the root
of the mean square over all but a few views, is a bad one; so is a column of such pixels.
Near the rotation axis an object hardly moves: there a pixel must also be beyond its
neighbours in the column, or the complete column is bad. Elsewhere a pixel beyond its
neighbours in the column is bad, too, such as three in a row that hide each other, unless it
belongs to a layer of the object.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

NEIGHBOURS: Final = 2
"""Columns on either side that a pixel is compared with: each of two bad columns has
good ones."""
BAD_RESPONSE_RATIO: Final = 8.0
"""Response of a bad pixel over the usual one about it."""
MIN_BAD_RESPONSE: Final = 0.02
"""Least response of a bad pixel: smaller errors of line integrals do little harm."""
EDGE_SLOPE_FACTOR: Final = 3.0
"""Factor by which a slope may grow towards the panel's edges, whose pixels have one
side alone."""
MIN_EDGE_RESPONSE: Final = 0.3
"""Least response of a bad pixel at the panel's edges."""
VIEWS_AN_OUTLIER: Final = 5
"""One of this many views is left out, that where a pixel is farthest beyond its
neighbours."""
BLOCK: Final = (8, 16)
"""Rows and columns over which the usual response is found."""
AXIS_PART: Final = 0.2
"""Distance from the axis within which an object may hardly move, over the panel's columns."""
MIN_COLUMN_SHARE: Final = 0.9
"""Least share of a bad column's rows that are beyond their neighbours."""
MIN_DEVIATION_RATIO: Final = 0.5
"""Distance beyond its neighbours, over its root mean square, from which a pixel deviates."""
MIN_LASTING_SHARE: Final = 0.75
"""Least share of the views in which a dead or hot pixel deviates; a bead at the turn
of its orbit does so in less than half of them."""
AXIS_BAND_PX: Final = 2.0
"""Distance from the axis within which a small feature of the object is always there [pixels]."""
EXPLAINED_ABOVE: Final = 0.5
"""Attenuation above all others that a feature at the axis may have, over their range."""
EXPLAINED_BELOW: Final = 0.1
"""Attenuation below all others that one may have, over their range."""
MIN_CHANGES_RATIO: Final = 3.0
"""Least changes of a flickering pixel over the median of those about."""
COMPARED_COLUMNS: Final = 4
"""Columns on either side whose changes are compared."""
MIN_SLOPE_RATIO: Final = 0.5
"""Least distance of a lasting bad pixel beyond its neighbours, over their own range."""
MIN_CHANGES_SHARE: Final = 0.25
"""Least share of views at which a flickering pixel changes between deviating and not;
an object's feature comes and goes once."""
MIN_AXIS_CHANGES_SHARE: Final = 0.375
"""The same before the axis, where a bead stays longer; random flicker has half."""
MAX_BAD_SHARE: Final = 0.05
"""Largest share of bad pixels; above it none is bad: the images are of another kind."""


@dataclass(frozen=True, eq=False)
class BadPixels:
    """Pixels whose values are unusable.

    Attributes:
        mask: (rows, cols).
    """

    mask: npt.NDArray[np.bool_]

    @property
    def count(self) -> int:
        """Number of bad pixels."""
        return int(self.mask.sum())

    @property
    def columns(self) -> int:
        """Number of columns that are bad over more than half of their rows."""
        return int(_bad_columns(self.mask).sum())

    def __str__(self) -> str:
        """Describe as one sentence how many pixels are interpolated, with the whole
        columns among them, if any.
        """
        if self.columns:
            columns = f", {self.columns} whole columns among them"
        else:
            columns = ""
        return (
            f"{self.count} pixels do not respond as their neighbours do (dead, hot or "
            f"flickering{columns}): they are interpolated"
        )


def bad_pixels(
    views: Callable[[], Iterable[Float32Array]], axis_column: float
) -> BadPixels | None:
    """Find pixels that do not respond as their neighbours do: dead, hot or flickering.

    Pixels at the axis that a feature of the object may explain are left out.

    Args:
        views: gives line integrals of some views of a scan, (rows, cols) each; called
            once, and where there may be bad ones for each of two or three further passes:
            the worst make their neighbours look bad as well.
        axis_column: where the axis falls.

    Returns:
        None if no pixel is bad, or more than `MAX_BAD_SHARE` are: such images are of
        another kind.
    """
    first, response = _outliers(views(), axis_column)
    if not first.any():
        return None
    worst = first & (
        response >= _largest_about(np.where(first, response, np.float32(0.0)))
    )
    second, _ = _outliers((_interpolated(view, worst) for view in views()), axis_column)
    columns = np.arange(first.shape[1])
    at_axis = np.broadcast_to(abs(columns - axis_column) < AXIS_BAND_PX, first.shape)
    lasting, flickering = _lasting_and_flickering(views(), worst | second, at_axis)
    if (lasting & at_axis).any():
        lasting &= ~at_axis | _no_feature(views(), lasting, at_axis)
    mask = lasting | flickering
    if not mask.any():
        return None
    if mask.mean() <= MAX_BAD_SHARE:
        return BadPixels(mask)
    return None


def _outliers(
    views: Iterable[Float32Array], axis_column: float
) -> tuple[npt.NDArray[np.bool_], Float32Array]:
    """Find pixels far beyond their neighbours in the root mean square over the views.

    Neighbours are those in the row; a pixel within a group of two to five in its row is
    found by its column. Near the axis (`AXIS_PART` of the columns) a pixel must stand out
    from both, or be in a column that is bad in `MIN_COLUMN_SHARE` of its rows, as rings
    of the object end there.

    Args:
        views: line integrals (rows, cols); those of at most 4 rows or columns are not
            judged.
        axis_column: column of the rotation axis.

    Returns:
        The outliers, and the excess of all pixels over their neighbours, (rows, cols)
        each; (1, 1) of False and 0 without views or of too small ones.
    """
    along = _Usual()
    down = _Usual()
    near = slice(0, 0)
    for view in views:
        if min(view.shape) <= 2 * NEIGHBOURS:
            break
        reach = AXIS_PART * view.shape[1]
        first = int(np.clip(np.ceil(axis_column - reach), 0, view.shape[1]))
        near = slice(first, int(np.clip(np.floor(axis_column + reach) + 1, first, None)))
        along.add(np.square(_beyond_neighbours(view)))
        down.add(np.square(_beyond_neighbours(view.T).T))
    if not along.count:
        return np.zeros((1, 1), np.bool_), np.zeros((1, 1), np.float32)
    response = along.root()
    mask = _outlying(response)
    in_column = _outlying(down.root().T).T
    cluster = _short_groups(in_column)
    cluster[:, near] = False
    if mask[:, near].size:
        whole = mask[:, near].mean(axis=0) > MIN_COLUMN_SHARE
        mask[:, near] &= whole | in_column[:, near]
    response = np.where(cluster, np.maximum(response, down.root()), response)
    return mask | cluster, response


def _short_groups(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Keep marked pixels of short groups in a row: with another one within `NEIGHBOURS`
    columns, but not part of a run longer than 5.

    A thin layer of the object gives longer runs.

    Args:
        mask: (rows, cols) bool.

    Returns:
        (rows, cols) bool.
    """
    from scipy.ndimage import binary_opening, convolve1d

    window = np.ones(2 * NEIGHBOURS + 1, np.uint8)
    several = convolve1d(mask.astype(np.uint8), window, axis=1, mode="constant") >= 2
    longer = binary_opening(mask, np.ones((1, 2 * NEIGHBOURS + 2), np.bool_))
    return np.asarray(mask & several & ~longer)


def _lasting_and_flickering(
    views: Iterable[Float32Array],
    mask: npt.NDArray[np.bool_],
    at_axis: npt.NDArray[np.bool_],
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """Find pixels that deviate in nearly all views, and those that do now and then.

    A flickering pixel deviates from its row and from its column at once; one of a bad
    column from the row alone, and one beside other bad ones in its row from the column
    alone. Edges and thin walls of the object deviate from one of the two. Its beads
    deviate from both, and visit the pixels about as often: a pixel flickers if it does so
    more often than they do (`_flickers`). The top of a round body at the axis is always
    there, but less beyond its neighbours than they are apart.

    Args:
        views: line integrals (rows, cols).
        mask: pixels that are beyond their neighbours; only these are returned.
        at_axis: pixels before the axis, where a feature of the object comes and goes
            slowly.

    Returns:
        Lasting ones (deviating in `MIN_LASTING_SHARE` of the views) and flickering ones,
        each (rows, cols).
    """
    from scipy.ndimage import binary_dilation

    area = binary_dilation(mask, np.ones((1, 2 * COMPARED_COLUMNS + 1), np.bool_))
    along = []
    clear_along = []
    clear_down = []
    for view in views:
        beyond = _beyond_neighbours(view)
        along.append(beyond[area])
        clear_along.append((beyond - _slopes(view))[area])
        clear_down.append((_beyond_neighbours(view.T) - _slopes(view.T)).T[area])
    in_row = np.array(along)
    clear_in_row = np.array(clear_along)
    clear_in_column = np.array(clear_down)
    in_bad_column = np.broadcast_to(_bad_columns(mask), mask.shape)
    share = np.where(at_axis, MIN_AXIS_CHANGES_SHARE, MIN_CHANGES_SHARE)
    flickers = _flickers(np.minimum(clear_in_row, clear_in_column), area, share)
    flickers |= in_bad_column & _flickers(in_row, area, share)
    flickers |= _short_groups(mask) & _flickers(clear_in_column, area, share)
    lasts = np.zeros_like(mask)
    clear = np.maximum(clear_in_row, clear_in_column)
    lasts[area] = _deviates(clear).mean(axis=0) >= MIN_LASTING_SHARE
    return mask & lasts, mask & flickers


def _no_feature(
    views: Iterable[Float32Array],
    mask: npt.NDArray[np.bool_],
    at_axis: npt.NDArray[np.bool_],
) -> npt.NDArray[np.bool_]:
    """Find pixels that no feature of the object explains.

    A bead on the axis stands before one pixel in all views, as a defect does. Columns
    that are bad over more than half of their rows are defects, and so are means over the
    views that exceed the range of values elsewhere, with 0 in it, by `EXPLAINED_ABOVE`,
    or fall below it by `EXPLAINED_BELOW`, of that range.

    Args:
        views: line integrals (rows, cols), at least one.
        mask: pixels that seem bad, left out of the range.
        at_axis: pixels before the axis, left out of the range that the object gives.

    Returns:
        (rows, cols) bool of the whole panel, also beside `mask` and away from the axis.
    """
    elsewhere = ~mask & ~at_axis
    lows = []
    highs = []
    total = np.zeros(mask.shape, np.float64)
    for view in views:
        lows.append(float(view[elsewhere].min(initial=0.0)))
        highs.append(float(view[elsewhere].max(initial=0.0)))
        total += view
    span = max(highs) - min(lows)
    mean = total / len(lows)
    beyond = mean > max(highs) + EXPLAINED_ABOVE * span
    beyond |= mean < min(lows) - EXPLAINED_BELOW * span
    return np.asarray(_bad_columns(mask) | beyond)


def _deviates(distances: Float32Array | FloatArray) -> npt.NDArray[np.bool_]:
    """Find where distances are like a pixel's root mean square or larger: above
    `MIN_DEVIATION_RATIO` of it and twice `MIN_BAD_RESPONSE`.

    Args:
        distances: (views, pixels).

    Returns:
        (views, pixels) bool.
    """
    usual = np.sqrt(np.mean(np.square(distances), axis=0))
    least = np.maximum(MIN_DEVIATION_RATIO * usual, 2.0 * MIN_BAD_RESPONSE)
    return np.asarray(distances > least)


def _flickers(
    distances: Float32Array | FloatArray,
    area: npt.NDArray[np.bool_],
    least_share: npt.NDArray[np.float64],
) -> npt.NDArray[np.bool_]:
    """Find pixels that deviate and cease often, and `MIN_CHANGES_RATIO` times as often as
    the median of `COMPARED_COLUMNS` columns on either side, (rows, cols).

    Args:
        distances: beyond the neighbours, (views, pixels of the area).
        area: the pixels, (rows, cols); others have no changes.
        least_share: changes of a flickering pixel over the views, (rows, cols).
    """
    from scipy.ndimage import median_filter

    deviates = _deviates(distances)
    changes = np.zeros(area.shape, np.float32)
    changes[area] = (deviates[1:] != deviates[:-1]).sum(axis=0)
    about = np.ones((1, 2 * COMPARED_COLUMNS + 1), np.bool_)
    about[0, COMPARED_COLUMNS] = False
    usual = median_filter(changes, footprint=about, mode="reflect")
    least = np.maximum(least_share * len(distances), MIN_CHANGES_RATIO * usual)
    return np.asarray(changes >= least)


def _bad_columns(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Find columns that are bad over more than half of their rows, (cols,)."""
    return np.asarray(mask.mean(axis=0) > 0.5)


def _largest_about(response: Float32Array) -> Float32Array:
    """Compute half of the largest response among a pixel and `NEIGHBOURS` on each side in
    the row.
    """
    from scipy.ndimage import maximum_filter

    size = (1, 2 * NEIGHBOURS + 1)
    return np.asarray(0.5 * maximum_filter(response, size, mode="nearest"), np.float32)


def _interpolated(view: Float32Array, mask: npt.NDArray[np.bool_]) -> Float32Array:
    """Interpolate the masked pixels of an image along their rows, (rows, cols), in a
    copy; rows masked as a whole stay.
    """
    made = view.copy()
    columns = np.arange(view.shape[1])
    for row in np.flatnonzero(mask.any(axis=1) & ~mask.all(axis=1)):
        bad = mask[row]
        made[row, bad] = np.interp(columns[bad], columns[~bad], view[row, ~bad])
    return made


class _Usual:
    """Root mean square of images as they come, without the largest squares."""

    def __init__(self) -> None:
        self.count = 0
        self._total: Float32Array | None = None
        self._largest: list[Float32Array] = []

    def add(self, square: Float32Array) -> None:
        """Add one image of squares (rows, cols) to the sum, and keep the largest values
        of each pixel apart: one more image of them for every `VIEWS_AN_OUTLIER` added.
        """
        self.count += 1
        if self._total is None:
            self._total = square.copy()
        else:
            self._total = self._total + square
        if self.count % VIEWS_AN_OUTLIER == 0:
            self._largest.append(np.zeros_like(square))
        rest = square
        for largest in self._largest:
            smaller = np.minimum(largest, rest)
            np.maximum(largest, rest, out=largest)
            rest = smaller

    def root(self) -> Float32Array:
        """Compute the root mean square of the images without each pixel's largest values,
        one of `VIEWS_AN_OUTLIER`, (rows, cols). Needs an image.
        """
        assert self._total is not None  # as there was an image
        rest = self._total - sum(self._largest, np.float32(0.0))
        mean = rest / np.float32(self.count - len(self._largest))
        return np.asarray(np.sqrt(np.maximum(mean, np.float32(0.0))), np.float32)


def _outlying(response: Float32Array) -> npt.NDArray[np.bool_]:
    """Find pixels whose response is far above the usual one, (rows, cols) of bool.

    Usual is the largest median of the blocks (`BLOCK`) of and around the pixel; the limit
    is `BAD_RESPONSE_RATIO` times that, and at least `MIN_BAD_RESPONSE`, in the outermost
    `NEIGHBOURS` columns `MIN_EDGE_RESPONSE`.

    Args:
        response: (rows, cols).
    """
    from scipy.ndimage import maximum_filter

    (rows, cols) = response.shape
    (tall, wide) = BLOCK
    padded = np.pad(response, ((0, -rows % tall), (0, -cols % wide)), "reflect")
    down = padded.shape[0] // tall
    across = padded.shape[1] // wide
    blocks = padded.reshape(down, tall, across, wide).transpose(0, 2, 1, 3)
    usual = maximum_filter(
        np.median(blocks.reshape(down, across, -1), axis=2), 3, mode="nearest"
    )
    usual = usual.repeat(tall, axis=0)[:rows].repeat(wide, axis=1)[:, :cols]
    least = np.full(cols, MIN_BAD_RESPONSE)
    least[:NEIGHBOURS] = least[-NEIGHBOURS:] = MIN_EDGE_RESPONSE
    return np.asarray(response > np.maximum(BAD_RESPONSE_RATIO * usual, least))


def _neighbours(view: Float32Array) -> list[Float32Array]:
    """List a pixel's neighbours in its row from left to right, without it, each (rows, cols)."""
    cols = view.shape[1]
    wide = np.pad(view, ((0, 0), (NEIGHBOURS, NEIGHBOURS)), "reflect")
    return [wide[:, k : k + cols] for k in range(2 * NEIGHBOURS + 1) if k != NEIGHBOURS]


def _slopes(view: Float32Array) -> Float32Array:
    """Compute how far a pixel may be beyond its neighbours in the row, as these differ among
    themselves, (rows, cols).
    """
    others = _neighbours(view)
    return np.float32(MIN_SLOPE_RATIO) * np.asarray(np.ptp(others, axis=0), np.float32)


def _beyond_neighbours(view: Float32Array) -> Float32Array:
    """Compute the distance of pixels above or below all but one of their four neighbours
    in the row, one of which may be bad as well.

    0 for pixels within them. In the outermost columns the range is widened on both sides
    by `EDGE_SLOPE_FACTOR` times itself, as a slope goes on.

    Args:
        view: (rows, cols).

    Returns:
        (rows, cols), not negative.
    """
    first, second, third, fourth = _neighbours(view)
    one = np.maximum(np.minimum(first, second), np.minimum(third, fourth))
    other = np.minimum(np.maximum(first, second), np.maximum(third, fourth))
    low = np.minimum(one, other)
    high = np.maximum(one, other)
    for ends in (slice(NEIGHBOURS), slice(-NEIGHBOURS, None)):
        span = EDGE_SLOPE_FACTOR * (
            high[:, ends] - low[:, ends]
        )  # a slope goes on beyond them
        low[:, ends] -= span
        high[:, ends] += span
    np.subtract(low, view, out=low)
    np.subtract(view, high, out=high)
    np.maximum(low, high, out=low)
    return np.maximum(low, np.float32(0.0), out=low)
