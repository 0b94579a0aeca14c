"""Pixels that do not respond as their neighbors do: dead, stuck, hot and flickering ones.

Suspects are pixels beyond their neighbors in the row, or in the column, by far more than
other pixels, in the root of the mean square over all but a few views. They are then
compared with good neighbors alone, in row and column, view by view. An object turns, so
that what it gives to a pixel it gives to others as well: to those between it and the axis
as often, and, what stands still about the axis, to the pixel as far from it on the other
side. A suspect is bad if it deviates in nearly all views and its counterpart does not, or
if it deviates so often, and changes so much, that a pixel like its neighbors does so with
a probability below `MAX_CHANCE`. A feature on the axis itself stands before one pixel:
there, only values that no object explains, or a complete column, are bad.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SCREENED_VIEWS: Final = 32
"""Largest number of views in which suspects are searched."""
JUDGED_VIEWS: Final = 96
"""Largest number of views in which they are judged: random flicker then hardly ever looks
like the few visits of a feature."""
NEIGHBOURS: Final = 2
"""Columns on either side that a pixel is compared with: each of two bad columns has
good ones."""
MAX_GROUP: Final = 5
"""Largest number of neighboring bad pixels in a row or column; longer groups are layers and
edges of the object, or complete columns."""
BAD_RESPONSE_RATIO: Final = 8.0
"""Response of a bad pixel over the usual one about it."""
MIN_BAD_RESPONSE: Final = 0.02
"""Least response of a bad pixel: smaller errors of line integrals do little harm."""
EDGE_SLOPE_FACTOR: Final = 3.0
"""Factor by which a slope may grow towards the panel's edges, whose pixels have one
side alone."""
MIN_EDGE_RESPONSE: Final = 0.3
"""Least response of a bad pixel at the panel's edges."""
WORST_RATIO: Final = 0.75
"""Least response of the worst pixels over the largest about them; a good pixel that bad
neighbors surround in one direction has half of theirs, who deviate in two."""
VIEWS_AN_OUTLIER: Final = 5
"""One of this many views is left out, that where a pixel is farthest beyond its
neighbors."""
BLOCK: Final = (8, 16)
"""Rows and columns over which the usual response is found."""
AXIS_PART: Final = 0.2
"""Distance from the axis within which an object may hardly move, over the panel's columns."""
MIN_COLUMN_SHARE: Final = 0.9
"""Least share of a bad column's rows that are beyond their neighbors."""
MIN_DEVIATION_RATIO: Final = 0.5
"""Distance beyond its neighbors, over its root mean square, from which a pixel deviates."""
MIN_LASTING_SHARE: Final = 0.75
"""Least share of the views in which a dead or hot pixel deviates; a bead at the turn
of its orbit does so in less than half of them."""
AXIS_BAND_PX: Final = 2.0
"""Distance from the axis within which a small feature of the object is always there [pixels]."""
AXIS_REACH_PX: Final = 2
"""Largest distance from the stated axis at which the center of symmetry may be [pixels]."""
EXPLAINED_ABOVE: Final = 0.5
"""Attenuation above all others that a feature at the axis may have, over their range."""
EXPLAINED_BELOW: Final = 0.1
"""Attenuation below all others that one may have, over their range."""
COMPARED_COLUMNS: Final = 4
"""Pixels on either side whose deviations are compared."""
MIN_SLOPE_RATIO: Final = 0.5
"""Least distance of a bad pixel beyond its neighbors, over their own range."""
MIN_ALIKE_RATIO: Final = 0.25
"""Least deviation of a suspect's counterpart across the axis, over its own: a peak between
two pixels has half of its height in each."""
MIN_CHANGES_SHARE: Final = 0.25
"""Least share of views at which a flickering pixel changes between deviating and not; a
feature of the object comes and goes twice a turn, random flicker has half."""
MAX_CHANCE: Final = 1e-4
"""Largest probability with which a pixel like its neighbors deviates as often as a
flickering one, and varies as much."""
MAX_PAIRS_CHANCE: Final = 0.05
"""Largest probability with which scattered bad pixels would make as many counterparts
across the axis as an object that stands still does."""
MAX_UNEXPLAINED_PAIRS_CHANCE: Final = 1e-3
"""The same of pixels whose values no other pixel has, as dead and hot ones."""
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
            f"{self.count} pixels do not respond as their neighbors do (dead, hot or "
            f"flickering{columns}): they are interpolated"
        )


Views = Callable[[int], Iterable[Float32Array]]
"""Gives line integrals (rows, cols) of at most so many views, spread evenly, in order."""


def bad_pixels(views: Views, axis_column: float) -> BadPixels | None:
    """Find pixels that do not respond as their neighbors: dead, hot or flickering.

    Not those that an object's feature may explain. `views` gives line integrals; called
    for `SCREENED_VIEWS`, again with the worst mended, as they make neighbors look bad,
    and for `JUDGED_VIEWS`. Returns None without bad pixels, or with more than
    `MAX_BAD_SHARE`: other images.
    """
    first, response = _outliers(views(SCREENED_VIEWS), axis_column)
    if not first.any():
        return None
    worst = first & (
        response > _largest_about(np.where(first, response, np.float32(0.0)))
    )
    mended = (_interpolated(view, worst) for view in views(SCREENED_VIEWS))
    second, _ = _outliers(mended, axis_column)
    suspects = worst | second
    if suspects.mean() > MAX_BAD_SHARE:
        return None
    mask = _Judged.of(views(JUDGED_VIEWS), suspects, axis_column).bad()
    if not mask.any():
        return None
    return BadPixels(mask)


def _outliers(
    views: Iterable[Float32Array], axis_column: float
) -> tuple[npt.NDArray[np.bool_], Float32Array]:
    """Find pixels far beyond their neighbors in the root mean square over the views.

    Neighbors are those in the row; a pixel within a group of two to five in its row, or
    at the panel's sides, is found by its column. Near the axis (`AXIS_PART` of the
    columns) the object's edges stay in a column: there, a pixel must stand out from its
    column as well, or be of at most `MAX_GROUP` that do so one above the other, or in a
    column that is bad in `MIN_COLUMN_SHARE` of its rows.

    Args:
        views: line integrals (rows, cols); those of at most 4 rows or columns are not
            judged.
        axis_column: column of the rotation axis.

    Returns:
        The outliers, and the excess of all pixels over their neighbors in the row plus
        that over those in the column, (rows, cols) each; (1, 1) of False and 0 without
        views or of too small ones.
    """
    from scipy.ndimage import binary_opening

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
        longer = binary_opening(mask[:, near], np.ones((MAX_GROUP + 1, 1), np.bool_))
        mask[:, near] &= whole | in_column[:, near] | ~longer
    return mask | cluster, response + down.root()


def _short_groups(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Keep marked pixels of short groups in a row: with another one within `NEIGHBOURS` columns,
    or as near to the panel's side, but not part of a run longer than `MAX_GROUP`.

    A thin layer of the object gives longer runs.
    `mask`: (rows, cols) bool.
    Returns (rows, cols) bool.
    """
    from scipy.ndimage import binary_opening, convolve1d

    window = np.ones(2 * NEIGHBOURS + 1, np.uint8)
    several = convolve1d(mask.astype(np.uint8), window, axis=1, mode="constant") >= 2
    several[:, :NEIGHBOURS] = True
    several[:, -NEIGHBOURS:] = True
    longer = binary_opening(mask, np.ones((1, MAX_GROUP + 1), np.bool_))
    return np.asarray(mask & several & ~longer)


@dataclass(frozen=True, eq=False)
class _Beside:
    """The nearest pixels in the row on either side of some pixels that are not suspects.

    Attributes:
        row: of each pixel.
        col: of each pixel.
        others: columns of its four neighbors, (4, pixels); the two of one side twice
            where the other has none.
        known: whether there are any within `MAX_GROUP` + `NEIGHBOURS` columns.
        one_sided: whether they are on one side alone.
    """

    row: npt.NDArray[np.intp]
    col: npt.NDArray[np.intp]
    others: npt.NDArray[np.intp]
    known: npt.NDArray[np.bool_]
    one_sided: npt.NDArray[np.bool_]

    @classmethod
    def of(
        cls,
        suspects: npt.NDArray[np.bool_],
        row: npt.NDArray[np.intp],
        col: npt.NDArray[np.intp],
    ) -> _Beside:
        """Find the neighbors.

        Args:
            suspects: (rows, cols), passed over.
            row: of each pixel.
            col: of each pixel.
        """
        steps = range(1, MAX_GROUP + NEIGHBOURS + 1)
        left, on_left = _nearest(~suspects, row, col, [-step for step in steps])
        right, on_right = _nearest(~suspects, row, col, list(steps))
        has_left = on_left.all(axis=0)
        has_right = on_right.all(axis=0)
        others = np.concatenate(
            [np.where(has_left, left, right), np.where(has_right, right, left)]
        )
        known = np.asarray(has_left | has_right)
        return cls(row, col, others, known, has_left != has_right)

    def residuals(self, view: Float32Array) -> Float32Array:
        """Subtract from the pixels' transmissions that of their neighbors, (pixels,); 0 where
        these are not known. Noise of a transmission does not grow with attenuation, as that of
        line integrals does. `view`: line integrals (rows, cols)."""
        usual = np.exp(-view[self.row, self.others].mean(axis=0))
        own = np.exp(-view[self.row, self.col])
        return np.where(self.known, own - usual, np.float32(0.0))

    def distances(
        self, view: Float32Array, slopes: float = MIN_SLOPE_RATIO
    ) -> Float32Array:
        """Compute how far pixels are above or below all but one of their neighbors, less how
        far these may differ as they do among themselves.

        On one side alone, the range is widened by `EDGE_SLOPE_FACTOR` times itself.
        `view`: (rows, cols); `slopes`: part of the neighbours' own range that is subtracted.
        Returns (pixels,); infinite where no neighbors are known."""
        own = view[self.row, self.col]
        least, low, high, most = np.sort(view[self.row, self.others], axis=0)
        span = np.where(self.one_sided, np.float32(EDGE_SLOPE_FACTOR), 0) * (high - low)
        beyond = np.maximum(low - span - own, own - high - span)
        clear = np.maximum(beyond, 0) - np.float32(slopes) * (most - least)
        return np.where(self.known, clear, np.float32(np.inf))


def _nearest(
    allowed: npt.NDArray[np.bool_],
    row: npt.NDArray[np.intp],
    col: npt.NDArray[np.intp],
    steps: list[int],
    wanted: int = NEIGHBOURS,
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.bool_]]:
    """Find the first allowed pixels among those some steps away in the row.

    Args:
        allowed: (rows, cols).
        row: of each pixel.
        col: of each pixel.
        steps: columns away, in the order in which they are tried.
        wanted: number of pixels.

    Returns their columns, 0 where there are fewer, and whether there are, (wanted, pixels) each.
    """
    width = allowed.shape[1]
    found = np.zeros((wanted, len(row)), np.intp)
    count = np.zeros(len(row), np.intp)
    for step in steps:
        at = col + step
        inside = (at >= 0) & (at < width) & (count < wanted)
        take = np.flatnonzero(inside)
        take = take[allowed[row[take], at[take]]]
        found[count[take], take] = at[take]
        count[take] += 1
    return found, np.arange(wanted)[:, None] < count


@dataclass(frozen=True, eq=False)
class _Judged:
    """Suspects and the pixels that they are compared with, over the views.

    All images are (rows, cols), 0 where nothing is compared.

    Attributes:
        suspects: which pixels are.
        axis_column: where the axis falls.
        views: number of views.
        often: number of views in which a pixel deviates from row and column, or from that
            of the two in which it has neighbors.
        changes: number of views at which it changes between deviating and not.
        variance: of its transmission less that of its neighbors, from differences between
            successive views: what an object's edges change, they change slowly.
        mean_distance: distance of its mean over the views beyond its neighbours'.
        mean_peak: the larger one of the distances in row and column, with no regard to
            slopes.
        unexplained: whether its mean over the views is farther beyond all values elsewhere
            than a feature of the object may be.
    """

    suspects: npt.NDArray[np.bool_]
    axis_column: float
    views: int
    often: FloatArray
    changes: FloatArray
    variance: FloatArray
    mean_distance: FloatArray
    mean_peak: FloatArray
    unexplained: FloatArray

    @classmethod
    def of(
        cls,
        views: Iterable[Float32Array],
        suspects: npt.NDArray[np.bool_],
        axis_column: float,
    ) -> _Judged:
        """Compare suspects with good pixels in each view.

        Values elsewhere are those of no suspect, `AXIS_BAND_PX` and more from the axis;
        `EXPLAINED_ABOVE` or `EXPLAINED_BELOW` their range, with 0 in it, may be added.

        Args:
            views: line integrals (rows, cols), at least one.
            suspects: (rows, cols), one at least.
            axis_column: where the axis falls.
        """
        columns = np.arange(suspects.shape[1])
        elsewhere = ~suspects & (abs(columns - axis_column) >= AXIS_BAND_PX)
        area = _compared_area(suspects, axis_column)
        row, col = np.nonzero(area)
        in_row = _Beside.of(suspects, row, col)
        in_column = _Beside.of(suspects.T, col, row)
        distances = []
        residuals = []
        lows = []
        highs = []
        total = np.zeros(suspects.shape, np.float64)
        for view in views:
            along = in_row.distances(view)
            distances.append(np.minimum(along, in_column.distances(view.T)))
            beside = in_row.residuals(view)
            residuals.append(np.where(in_row.known, beside, in_column.residuals(view.T)))
            lows.append(float(view[elsewhere].min(initial=0.0)))
            highs.append(float(view[elsewhere].max(initial=0.0)))
            total += view
        mean = np.asarray(total / len(lows), np.float32)
        span = max(highs) - min(lows)
        beyond = mean > max(highs) + EXPLAINED_ABOVE * span
        beyond |= mean < min(lows) - EXPLAINED_BELOW * span
        ways = (in_row.distances(mean), in_column.distances(mean.T))
        peaks = (in_row.distances(mean, 0.0), in_column.distances(mean.T, 0.0))
        peak = np.maximum(*(np.where(np.isfinite(one), one, 0.0) for one in peaks))
        deviates = _deviates(np.array(distances))

        def image(values: npt.NDArray[np.generic]) -> FloatArray:
            """Place values of the area's pixels in an image."""
            made = np.zeros(area.shape)
            made[area] = values
            return made

        return cls(
            suspects=suspects,
            axis_column=axis_column,
            views=len(distances),
            often=image(deviates.sum(axis=0)),
            changes=image((deviates[1:] != deviates[:-1]).sum(axis=0)),
            variance=image(0.5 * np.square(np.diff(residuals, axis=0)).mean(axis=0)),
            mean_distance=image(np.minimum(*ways)),
            mean_peak=image(peak),
            unexplained=image(beyond[area]),
        )

    def bad(self) -> npt.NDArray[np.bool_]:
        """Find the suspects that no feature of the object explains, (rows, cols)."""
        mask = self._lasting()
        while True:
            more = self._flickering(mask) & ~mask
            if not more.any():
                return mask
            mask |= more

    def _at_axis(self) -> npt.NDArray[np.bool_]:
        """Find columns before the axis, (cols,), where small features stand still."""
        columns = np.arange(self.suspects.shape[1])
        return np.asarray(abs(columns - self.axis_column) < AXIS_BAND_PX)

    def _lasting(self) -> npt.NDArray[np.bool_]:
        """Find suspects that deviate in `MIN_LASTING_SHARE` of the views and are no
        feature that stands still, (rows, cols).

        The mean over a turn of what an object gives is alike on both sides of the axis. A
        suspect whose counterpart is alike (`MIN_ALIKE_RATIO`) is of the object where
        there are more such pairs than bad pixels scattered over the panel would make. At
        the axis, a suspect is bad in a bad column, or if it is unexplained.

        Unexplained pixels are counted apart (`_standing`).
        """
        lasting = self.suspects & (self.often >= MIN_LASTING_SHARE * self.views)
        at_axis = self._at_axis()
        strange = self.unexplained > 0.0
        defect = _bad_columns(self.suspects) | strange
        alike = self._standing(lasting & strange & ~at_axis, self.suspects & ~strange)
        row, col = np.nonzero(lasting & ~strange & ~at_axis)
        paired = self._has_counterpart(row, col)
        if self._chance_of_pairs(len(row), int(paired.sum())) < MAX_PAIRS_CHANCE:
            alike[row, col] = paired
        return np.asarray(lasting & np.where(at_axis, defect, ~alike))

    def _standing(
        self, strange: npt.NDArray[np.bool_], others: npt.NDArray[np.bool_]
    ) -> npt.NDArray[np.bool_]:
        """Find pixels with unexplained values that are of an object which stands still,
        (rows, cols).

        What no other pixel has, as the limb of a thin ring, goes on beside it, and hardly
        any bad pixels are beside those of an object by chance: pairs there are counted
        first. Where all pairs together are of an object, the rest are as well, if they
        are more than so many bad pixels would make (`MAX_PAIRS_CHANCE`).

        Args:
            strange: these pixels.
            others: suspects that are not.
        """
        alike = np.zeros_like(strange)
        row, col = np.nonzero(strange)
        paired = self._has_counterpart(row, col)
        place = _about(others)
        near = paired & place[row, col]
        share = float(place.mean())
        chance = self._chance_of_pairs(len(row), int(near.sum()), share)
        found = near & (chance < MAX_UNEXPLAINED_PAIRS_CHANCE)
        rest = paired & ~found
        together = self._chance_of_pairs(len(row), int(paired.sum()))
        alone = self._chance_of_pairs(int((~found).sum()), int(rest.sum()))
        if together < MAX_UNEXPLAINED_PAIRS_CHANCE and alone < MAX_PAIRS_CHANCE:
            found = paired
        alike[row, col] = found
        return alike

    def _has_counterpart(
        self, row: npt.NDArray[np.intp], col: npt.NDArray[np.intp]
    ) -> npt.NDArray[np.bool_]:
        """Find whether a pixel within `AXIS_REACH_PX` of that across the axis deviates
        alike in the mean over the views, (pixels,).

        Args:
            row: of each pixel.
            col: of each pixel.
        """
        width = self.suspects.shape[1]
        least = MIN_ALIKE_RATIO * self.mean_distance[row, col]
        across = np.rint(2.0 * self.axis_column - col).astype(np.intp)
        alike = np.zeros(len(row), np.bool_)
        for step in range(-AXIS_REACH_PX, AXIS_REACH_PX + 1):
            at = across + step
            inside = (at >= 0) & (at < width)
            peak = self.mean_peak[row, np.clip(at, 0, width - 1)]
            alike |= inside & (peak > least)
        return alike

    def _chance_of_pairs(self, many: int, paired: int, share: float = 1.0) -> float:
        """Compute the probability that `paired` of `many` scattered pixels are pairs
        (Poisson).

        They are in a `share` of the panel's pixels.
        """
        from scipy.special import gammainc

        reached = 2 * AXIS_REACH_PX + 1
        expected = 0.5 * share * many * many * reached / self.suspects.size
        least = (paired + 1) // 2
        return float(gammainc(least, expected)) if least else 1.0

    def _flickering(self, bad: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Find suspects that deviate and cease often, and more so than their neighbors,
        (rows, cols).

        If a pixel deviates as often as each of `COMPARED_COLUMNS` others, one of so many
        deviations and one more is its own (binomial); if it varies as they do, the ratio
        of variances is Fisher's F. Both must be less probable than `MAX_CHANCE`.

        Args:
            bad: pixels known to be bad, with which none is compared.
        """
        from scipy.special import betainc, fdtri

        changes = self.changes >= MIN_CHANGES_SHARE * (self.views - 1)
        row, col = np.nonzero(self.suspects & changes)
        own = self.often[row, col]
        others = COMPARED_COLUMNS * self._usual(self.often, bad, row, col)
        rare = 1.0 / (COMPARED_COLUMNS + 1)
        chance = np.where(own > 0, betainc(np.maximum(own, 1), others + 1.0, rare), 1.0)
        # A variance from n differences is as sure as one from 2 n / 3 values.
        freedom = max(2.0 * (self.views - 1) / 3.0, 1.0)
        # Both numbers of degrees are the same, so the upper quantile is one over the lower.
        noise = 1.0 / fdtri(freedom, freedom, MAX_CHANCE)
        usual = self._usual(self.variance, bad, row, col)
        found = (chance < MAX_CHANCE) & (self.variance[row, col] > noise * usual)
        mask = np.zeros_like(self.suspects)
        mask[row[found], col[found]] = True
        return mask

    def _usual(
        self,
        values: FloatArray,
        bad: npt.NDArray[np.bool_],
        row: npt.NDArray[np.intp],
        col: npt.NDArray[np.intp],
    ) -> FloatArray:
        """Compute the usual value beside pixels: the second smallest of the nearest
        `COMPARED_COLUMNS` that are not bad, on the side where it is larger.

        A feature that turns before a pixel is seen on one side of it. Away from the axis
        that pixel's counterpart across it is a third side.

        Args:
            values: (rows, cols).
            bad: (rows, cols), passed over.
            row: of each pixel.
            col: of each pixel.
        """

        def second(middle: npt.NDArray[np.intp], steps: list[int]) -> FloatArray:
            """Find the second smallest value of those some steps away from columns."""
            at, known = _nearest(~bad, row, middle, steps, COMPARED_COLUMNS)
            nearby = np.where(known, values[row, at], 0.0)
            return np.asarray(np.sort(nearby, axis=0)[1])

        outwards = range(1, 2 * COMPARED_COLUMNS + 1)
        right = second(col, list(outwards))
        left = second(col, [-step for step in outwards])
        across = np.rint(2.0 * self.axis_column - col).astype(np.intp)
        about = sorted(range(-COMPARED_COLUMNS, COMPARED_COLUMNS + 1), key=abs)
        there = np.where(self._at_axis()[col], 0.0, second(across, about))
        return np.maximum(np.maximum(left, right), there)


def _compared_area(
    suspects: npt.NDArray[np.bool_], axis_column: float
) -> npt.NDArray[np.bool_]:
    """Find suspects, twice `COMPARED_COLUMNS` on either side, and the same about their
    counterparts across the axis, (rows, cols).

    Args:
        suspects: (rows, cols).
        axis_column: where the axis falls.
    """
    width = suspects.shape[1]
    area = suspects.copy()
    row, col = np.nonzero(suspects)
    across = np.rint(2.0 * axis_column - col).astype(np.intp)
    for step in range(-2 * COMPARED_COLUMNS, 2 * COMPARED_COLUMNS + 1):
        for middle in (col, across):
            at = middle + step
            inside = (at >= 0) & (at < width)
            area[row[inside], at[inside]] = True
    return area


def _deviates(distances: Float32Array | FloatArray) -> npt.NDArray[np.bool_]:
    """Find where distances are like a pixel's root mean square or larger: above
    `MIN_DEVIATION_RATIO` of it and twice `MIN_BAD_RESPONSE`. `distances`: (views, pixels).
    Returns (views, pixels) bool."""
    usual = np.sqrt(np.mean(np.square(distances), axis=0))
    least = np.maximum(MIN_DEVIATION_RATIO * usual, 2.0 * MIN_BAD_RESPONSE)
    return np.asarray(distances > least)


def _bad_columns(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    return np.asarray(mask.mean(axis=0) > 0.5)


def _about(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """Find the pixels that touch marked ones, also at a corner, and these, (rows, cols)."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(mask, np.ones((3, 3), np.bool_)))


def _largest_about(response: Float32Array) -> Float32Array:
    """Compute `WORST_RATIO` of the largest response among a pixel and `NEIGHBOURS` on each
    side in the row.
    """
    from scipy.ndimage import maximum_filter

    size = (1, 2 * NEIGHBOURS + 1)
    largest = maximum_filter(response, size, mode="nearest")
    return np.asarray(WORST_RATIO * largest, np.float32)


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
    """List a pixel's neighbors in its row from left to right, without it, each (rows, cols)."""
    cols = view.shape[1]
    wide = np.pad(view, ((0, 0), (NEIGHBOURS, NEIGHBOURS)), "reflect")
    return [wide[:, k : k + cols] for k in range(2 * NEIGHBOURS + 1) if k != NEIGHBOURS]


def _beyond_neighbours(view: Float32Array) -> Float32Array:
    """Compute the distance of pixels above or below all but one of their four neighbors
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
