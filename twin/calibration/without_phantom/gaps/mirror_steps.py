"""A gap between two tiles, by the mirror symmetry of the mean over a full turn.

The mean is the same at a pixel and at its mirror image in the plane through source and
axis, whatever turns (`mirror_symmetry.py`). A gap displaces what lies beyond it, on one
side of the axis: mirrored pairs nearer to the axis are displaced by one amount, those
further off by another, which differs by the gap's width. Unlike opposite rays, the mean
contains walls about the axis, all rows, and what is nearer to the axis than all that turns.

The displacement by distance from the axis is compared with a common one and a yaw, with
and without a step. The likelihood is that of differences of unknown scale: whatever makes
the mean unsymmetric otherwise (rings, a flat field, something that stands still) is in both,
and makes a step count for less. Steps of sampled edges are nobody's, and evidence counts as
far as it is the same with and without an odd error of the flat field. Only places with slopes
above the noise count, theirs or those of a smoother copy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.interpolate import CubicSpline
from scipy.ndimage import (
    gaussian_filter,
    map_coordinates,
    maximum_filter1d,
    spline_filter,
)
from scipy.special import log_softmax, logsumexp, softmax

from flexdt.twin.calibration.repeated_frames import REPORTED_ODDS
from flexdt.twin.calibration.without_phantom.circular_scan import CircularScan
from flexdt.twin.calibration.without_phantom.conjugate_rays import SMOOTHING
from flexdt.twin.calibration.without_phantom.mirror_symmetry import (
    MIN_EDGE_SIGMAS,
    mirror_map,
    read_spline,
)
from flexdt.twin.calibration.without_phantom.turn import MEDIAN_OF_CHI_SQUARE
from flexdt.twin.geometry.conventions import FloatArray

WIDTHS_PX: Final = np.arange(0.25, 3.01, 0.25)
"""Widths of gaps that are tried [px]."""
WIDTH_SPREAD_PX: Final = 1.0
"""Standard deviation of the widths of gaps before the images [px]; assumed."""
LOG_PRIOR: Final = log_softmax(-0.5 * np.square(WIDTHS_PX / WIDTH_SPREAD_PX))[:, None]
"""Logarithm of the probabilities of the widths of gaps before the images, (w, 1)."""
MARGIN: Final = 3.0
"""Distance of places from the panel's edges, in sigmas of the smoothing."""
DISPLACEMENTS_PX: Final = np.arange(-4.0, 4.01, 0.125)
FINE_PX: Final = np.arange(-4.0, 4.001, 0.05)
"""Displacements of mirrored pairs that are read, and those between them that are tried."""
YAWS_PX: Final = np.arange(-1.0, 1.01, 0.1)
"""Displacements of the outermost pairs by a yaw that are tried: beyond the usual, so that no
yaw passes for a gap [px]."""
COARSER: Final = (4.0, 4.0, 1.0, 1.0)
"""Factors on the smoothing in each step towards the column and the roll of the mean."""
LEAST_ACROSS_PX: Final = 0.7
LONG: Final = 2.5
"""Least smoothing across the columns [px], and the usual one over it, at the finest: across a
gap it mixes what is on both of its sides, along the rows nothing."""
PAIR_PX: Final = 0.05
"""Standard deviation by which mirrored places are displaced otherwise: the step of the
displacements that are tried, samples that are interpolated [px]."""
NOBODYS_PX: Final = (-0.15, 0.0, 0.15)
"""Steps that right pairs have: sampled edges, and hardening, displace pairs by as much [px]."""
OUTLYING_SIGMAS: Final = 3.0
"""Differences, in standard deviations, from which a place counts less in them."""
LEAST_PLACES: Final = 4
"""Distances from the axis, and rows, that are needed at least."""
BANDS: Final = 4
"""Bands of rows that are judged each by itself: a gap is in all of them."""
FOOLED_CHANCE: Final = 0.002
"""Probability that the object passes for a gap at a column, in single frames by what turns and
in a band of rows of the mean by what stands still: 2 of 30 drawn scans of natural objects have
such a column among 40 in their frames."""
DEAD_SIGMAS: Final = 3.0
"""Distance from a dead column up to which places do not count, in sigmas of the smoothing."""


class MirrorSteps(NamedTuple):
    """Log likelihood ratios of gaps to none, by the mean over a turn.

    Attributes:
        found: by width and first column beyond the gap, (w, cols), each band of rows as far
            as `FOOLED_CHANCE` lets it count; 0 where the mirrored part of the panel does not
            contain the border, or has no slopes.
        free: the same if nothing but a gap makes a mean unsymmetric: where the gap is, if there
            is one, and how wide.
    """

    found: FloatArray
    free: FloatArray

    def told(self, column: int, about: float) -> bool:
        """Check whether the mean shows a gap about a column, by odds of `REPORTED_ODDS`."""
        return _best_about(self.found, column, about) > math.log(REPORTED_ODDS)

    def width(self, column: int, about: float) -> tuple[float, float]:
        """Give the width of a gap about a column, and its standard deviation [px]."""
        first = max(column - math.floor(about), 0)
        near = self.free[:, first : column + math.floor(about) + 1]
        best = near[:, int(over_widths(near).argmax())]
        share = softmax(best + LOG_PRIOR[:, 0])
        width = float(share @ WIDTHS_PX)
        step = float(WIDTHS_PX[1] - WIDTHS_PX[0])
        variance = float(share @ np.square(WIDTHS_PX - width)) + step**2 / 12.0
        return width, math.sqrt(variance)

    def denied(self, column: int, about: float) -> bool:
        """Check whether the mean has odds of `REPORTED_ODDS` against a gap about a column."""
        return _best_about(self.free, column, about) < -math.log(REPORTED_ODDS)


def _best_about(found: FloatArray, column: int, about: float) -> float:
    """Find the largest log likelihood ratio of a gap of any width about a column."""
    first = max(column - math.floor(about), 0)
    near = found[:, first : column + math.floor(about) + 1]
    return float(over_widths(near).max())


def trusted(found: FloatArray) -> FloatArray:
    """Return log likelihood ratios as far as `FOOLED_CHANCE` lets them count."""
    return found - np.logaddexp(0.0, found + math.log(FOOLED_CHANCE))


def over_widths(found: FloatArray) -> FloatArray:
    """Average likelihood ratios over WIDTHS_PX, (w, c) to (c,), in logarithms."""
    return np.asarray(logsumexp(found + LOG_PRIOR, axis=0))


def mirror_steps(
    mean: FloatArray,
    noise: FloatArray,
    scan: CircularScan,
    values: FloatArray,
    dead: npt.NDArray[np.bool_],
) -> MirrorSteps:
    """Compute log likelihood ratios of a gap of each width at each column to none.

    Args:
        mean: line integrals, the mean over a full turn, (rows, cols).
        noise: relative variance of its pixels, (rows, cols).
        scan: the scan.
        values: parameters of the plane in the order of `circular_scan.FREE`, (k,), two at
            least; the column to a pixel or two.
        dead: whether a column is, (cols,).
    """
    found, free = np.zeros((2, len(WIDTHS_PX), mean.shape[1]))
    pairs = _pairs(mean, noise, scan, values, dead)
    if pairs is None:
        return MirrorSteps(found, free)
    beside = np.arange(mean.shape[1]) - 0.5 - pairs.axis
    for side in (-1, 1):
        there = np.sign(beside) == side
        border = np.abs(beside[there])
        squares = pairs.squares(side)
        for band, cells in enumerate(pairs.cells.tolist()):
            ratio = [_ratios(pairs.radius, one[band], border) for one in squares]
            both = cells / 2.0 * np.log(ratio)
            # The odd error was fitted without a gap: it may hide one, or pass for another.
            own = np.maximum(both.min(axis=0), 0.0) + np.minimum(both.max(axis=0), 0.0)
            free[:, there] += own
            found[:, there] += trusted(own)
    return MirrorSteps(found, free)


@dataclass(frozen=True, eq=False)
class MirrorPairs:
    """Places right of the axis, and their mirror images, in the smoothed mean.

    Attributes:
        axis: its column in the middle row.
        radius: distances of the places from it, (r,) [px].
        spline: coefficients of the mean.
        at, image: places and their mirror images, rows after each other, (2, m).
        flat: odd error of the flat field, (m,).
        weight: of each pair, 0 without slopes, (m,).
        largest: bound of weighted squares of differences.
        cells: the number of independent places with slopes in each band, (BANDS,).
    """

    axis: float
    radius: FloatArray
    spline: FloatArray
    at: FloatArray
    image: FloatArray
    flat: FloatArray
    weight: FloatArray
    largest: float
    cells: FloatArray

    def squares(self, side: int) -> FloatArray:
        """Sum up the squares of the pairs' differences, the end on one side fixed and the other
        one displaced outwards.

        Args:
            side: of the fixed end: 1 right of the axis, -1 left of it.

        Returns:
            With the flat field's odd error and without, by band of rows, displacement
            (FINE_PX) and distance of the fixed end from the axis, (2, BANDS, d, r).
        """
        fixed, other = (self.at, self.image) if side > 0 else (self.image, self.at)
        here = read_spline(self.spline, fixed)
        aims = (here - side * self.flat, here)
        coarse = np.empty((len(DISPLACEMENTS_PX), 2, BANDS, len(self.radius)))
        for i, moved in enumerate(DISPLACEMENTS_PX.tolist()):
            seen = read_spline(self.spline, other - np.array([[side * moved], [0.0]]))
            for one, aim in zip(coarse[i], aims, strict=True):
                whole = self.weight * np.square(seen - aim)
                # Bounded: dead columns, or a strip that stands still, are few places.
                whole = whole / (1.0 + whole / self.largest)
                one[:] = _of_bands(whole, len(self.radius))
        fine = CubicSpline(DISPLACEMENTS_PX, coarse)(FINE_PX)
        return np.asarray(np.maximum(fine, 0.0).transpose(1, 2, 0, 3))


def _pairs(
    mean: FloatArray,
    noise: FloatArray,
    scan: CircularScan,
    values: FloatArray,
    dead: npt.NDArray[np.bool_],
) -> MirrorPairs | None:
    """Pair places with their mirror images, about the column and at the roll of the mean.

    Args:
        mean, noise, scan, values, dead: see `mirror_steps`.

    Returns:
        The pairs; None for too few, or without slopes.
    """
    rows, cols = mean.shape
    finest = max(1.0, cols / SMOOTHING)
    middle = (np.array([cols, rows]) - 1.0)[:, None] / 2.0
    values = values.copy()
    soft = 0.0
    for coarser in COARSER:
        if soft != coarser * finest:
            soft = coarser * finest
            across = soft if coarser > 1.0 else max(soft / LONG, LEAST_ACROSS_PX)
            # As much noise is left as by `soft` both ways.
            along = soft**2 / across
            softened = gaussian_filter(mean, (along, across), mode="nearest")
            spline = spline_filter(softened)
            reach = math.ceil(DEAD_SIGMAS * across)
            near_dead = maximum_filter1d(dead, 2 * reach + 1)
            apart = max(1.0, across / 2.0)
            down = np.arange(soft, rows - 1 - soft, max(2.0, along))
        axis = scan.column(values)
        edge = min(cols - 1 - axis, axis) - MARGIN * across + float(DISPLACEMENTS_PX[0])
        radius = np.arange(0.5, edge, apart)
        if min(len(radius), len(down)) < LEAST_PLACES:
            return None
        below = np.repeat(down, len(radius)) - middle[1]
        beside = np.tile(radius, len(down))
        at = np.stack([axis + values[1] * below + beside, below + middle[1]])
        c, r, w = mirror_map(scan.view(values)) @ np.vstack(
            [at - middle, np.ones(at.shape[1])]
        )
        image = np.stack([c / w, r / w]) + middle
        rest = read_spline(spline, at) - read_spline(spline, image)
        weight = 1.0 / sum(
            map_coordinates(noise, p[::-1], order=1, mode="nearest") for p in (at, image)
        )
        for end in (at, image):
            column = np.rint(end[0].clip(0.0, cols - 1.0)).astype(np.intp)
            weight = np.where(near_dead[column], 0.0, weight)
        slope = (_slope(spline, at) - _slope(spline, image)) / 2.0
        x, y = beside / cols, below / rows
        odd = np.stack([x, x * y, x**3, x * y * y], axis=1)
        # A yaw is fitted beside the flat field, which would contain it.
        bent = slope * np.square(beside / radius[-1])
        # To coarse smoothing, a round body a little aside looks like an odd error.
        odd = odd * (coarser <= 1.0)
        table = np.column_stack([slope, slope * below, bent, odd])
        fitted, scale = _robust(table, rest, weight)
        values[0] -= fitted[0] / 2.0 / scan.slopes(values, scan.scales[: len(values)])[0]
        values[1] -= fitted[1] / 2.0
    steep = _is_steep(slope, weight, scale, across)
    # What is round about the axis has gentle slopes there, in many places.
    further = COARSER[0] * finest
    gentle = spline_filter(gaussian_filter(mean, further, mode="nearest"))
    slope_there = (_slope(gentle, at) - _slope(gentle, image)) / 2.0
    left = scale * (finest / further) ** 2
    steep |= _is_steep(slope_there, weight, left, further)
    if not steep.any():
        return None
    weight = weight / (1.0 + weight * np.square(PAIR_PX * slope) / scale)
    area = apart * float(down[1] - down[0]) / (4.0 * math.pi * finest**2)
    return MirrorPairs(
        axis,
        radius,
        spline,
        at,
        image,
        odd @ fitted[3:],
        np.where(steep, weight, 0.0),
        OUTLYING_SIGMAS**2 * scale,
        area * _of_bands(steep.astype(np.float64), len(radius)).sum(axis=1),
    )


def _of_bands(values: FloatArray, radii: int) -> FloatArray:
    """Sum up values (m,) of places over each band of rows, (BANDS, radii)."""
    table = values.reshape(-1, radii)
    first = np.arange(BANDS) * len(table) // BANDS
    return np.asarray(np.add.reduceat(table, first, axis=0))


def _is_steep(
    slope: FloatArray, weight: FloatArray, scale: float, across: float
) -> npt.NDArray[np.bool_]:
    """Mark slopes above those of smoothed noise, sigma / sqrt(8 `across`^2)."""
    least = MIN_EDGE_SIGMAS**2 * scale / (8.0 * across**2)
    return np.asarray(np.square(slope) * weight > least)


def _slope(spline: FloatArray, at: FloatArray) -> FloatArray:
    """Read the slope along the rows at places (2, k), (k,)."""
    half = np.array([[0.5], [0.0]])
    return np.asarray(read_spline(spline, at + half) - read_spline(spline, at - half))


def _robust(
    table: FloatArray, rest: FloatArray, weight: FloatArray
) -> tuple[FloatArray, float]:
    """Fit a table's columns to differences; outlying ones count less in a second fit.

    Args:
        table: (m, p).
        rest: differences, (m,).
        weight: (m,).

    Returns:
        The coefficients (p,), and the variance of weighted differences about the fit.
    """
    fitted: FloatArray = np.zeros(table.shape[1])
    own: FloatArray = weight
    scale = 0.0
    for _ in range(2):
        root = np.sqrt(own)
        fitted = np.asarray(
            np.linalg.lstsq(table * root[:, None], rest * root, rcond=None)[0]
        )
        left = weight * np.square(rest - table @ fitted)
        scale = max(float(np.median(left)) / MEDIAN_OF_CHI_SQUARE, 1e-300)
        own = weight / (1.0 + left / (OUTLYING_SIGMAS**2 * scale))
    return fitted, scale


def _ratios(radius: FloatArray, squares: FloatArray, border: FloatArray) -> FloatArray:
    """Compare the least sums of squares without a step (or one of NOBODYS_PX) and with one,
    over all common displacements and yaws.

    Args:
        radius: distances from the axis, (r,) [px].
        squares: sums at FINE_PX, (d, r).
        border: distances of borders from the axis, (c,) [px].

    Returns:
        The sum without a step over that with one, (w, c); at most 1 where no place is
        beyond the border.
    """
    step = float(FINE_PX[1] - FINE_PX[0])
    bent = np.square(radius / radius[-1])
    place = np.searchsorted(radius, border)
    usual = np.full(len(radius) + 1, math.inf)
    gaps = np.full((len(WIDTHS_PX), len(radius) + 1), math.inf)
    for yaw in YAWS_PX.tolist():
        by_yaw = np.rint(yaw * bent / step).astype(np.intp)
        places = np.arange(len(FINE_PX))[:, None] + by_yaw
        moved = np.take_along_axis(squares, places.clip(0, len(FINE_PX) - 1), axis=0)
        inside = np.pad(np.cumsum(moved, axis=1), ((0, 0), (1, 0)))
        beyond = inside[:, -1:] - inside
        for width in NOBODYS_PX:
            usual = np.minimum(usual, _least(inside, beyond, round(width / step)))
        for i, width in enumerate(WIDTHS_PX.tolist()):
            gaps[i] = np.minimum(gaps[i], _least(inside, beyond, round(width / step)))
    least = np.finfo(np.float64).tiny
    ratio = np.maximum(usual, least) / np.maximum(gaps, least)
    return np.asarray(ratio[:, place])


def _least(inside: FloatArray, beyond: FloatArray, step: int) -> FloatArray:
    """Find the least sums of squares over common displacements, with a step, (c,).

    Sums are (d, c), nearer than each border and beyond.
    """
    low, high = max(-step, 0), max(step, 0)
    count = len(inside) - low - high
    whole = inside[low : low + count] + beyond[high : high + count]
    return np.asarray(whole.min(axis=0))
