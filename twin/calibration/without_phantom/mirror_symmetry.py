"""Mirror symmetry of the mean projection: axis column, roll and yaw.

The mean over a full turn is the projection of a body of revolution, which any plane through the
axis divides into mirror images. The plane of source and axis maps rays to rays, so the mean is
the same at a pixel and at its mirror image, at any cone angle and in the overlap of truncated
scans. The map is a homography of the panel.

The estimate is the root of Z' W r: r is the mean minus its mirror image, Z the slopes of
a smoother copy, freed of what a flat field that is wrong by a polynomial of third degree
would add. Noise in Z is also in r, which would shorten the steps and the sigma: the
contribution to Z' W r of white noise with the variance seen in the mean (photons and flat
field) is subtracted. Edges along rows or columns, so sharp that sampling puts them into
steps, count less, and their steps are in the sigma: a flat end of an object, seen without
blur, would be taken for an axis that is upright.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter

from flexdt.twin.calibration.without_phantom.turn import MEDIAN_OF_CHI_SQUARE, Turn
from flexdt.twin.geometry.conventions import FloatArray

View = Callable[[FloatArray], FloatArray]
"""Parameters to one view's source, panel centre, u and v about a point of the axis, (12,)."""

LEVELS: Final = (64, 128, 256)
"""Columns over the smoothing's sigma, coarse to fine."""
BLOCKS: Final = 16
"""Number of blocks of rows, and of columns, whose scatter is compared with the noise's."""
NEAR_PX: Final = 2.0
"""Edges along rows and columns are looked for in neighbourhoods of this width [px]."""
MIN_EDGE_SIGMAS: Final = 3.0
"""Standard deviations of the noise from which edges count."""
ROUNDS: Final = 15
REACH: Final = 0.12
"""Largest distance of the axis from its nominal column, as a share of the columns."""
MIN_OVERLAP: Final = 0.125
"""Least share of the columns with a mirror image."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """The plane of symmetry.

    Attributes:
        values: of the parameters.
        covariance: of them, with the priors.
        images: sigmas without the priors, (k,).
        asymmetry: the part that is neither symmetric nor noise, relative to the structure
            of the mean.
        converged: whether the root was found.
    """

    values: FloatArray
    covariance: FloatArray
    images: FloatArray
    asymmetry: float
    converged: bool


def mirror_map(view: FloatArray) -> FloatArray:
    """Compute the homography that takes a pixel to its mirror image in the plane through source
    and axis.

    `view`: source, panel centre, u, v in a frame with the axis along z through its origin,
    (12,). Returns (3, 3), of (column, row, 1) from the panel's centre."""
    source, detector, u, v = view.reshape(4, 3)
    rays = np.column_stack([u, v, detector - source])
    normal = np.array([source[1], -source[0], 0.0]) / math.hypot(source[0], source[1])
    flip = np.eye(3) - 2.0 * np.outer(normal, normal)
    return np.asarray(np.linalg.solve(rays, flip @ rays))


def border_room(cols: int) -> float:
    """Return the distance from a tile's border where pixels do not count [px]."""
    return _room(max(cols / LEVELS[-1], 1.0))


def _room(sigma: float) -> float:
    """Return that distance for a smoothing by `sigma` [px]."""
    return 1.0 + 2.5 * sigma


def first_column(mean: FloatArray, nominal: float) -> tuple[float, float]:
    """Find the column, to half a pixel, about which the mean is most symmetric, within
    `REACH` of the nominal one.

    Compared are bands of rows, smoothed; columns with less than `MIN_OVERLAP` of the
    panel mirrored are not tried.

    Args:
        mean: (rows, cols).
        nominal: the column to search about.

    Returns:
        The column, and the ratio of the squares of the next best column's asymmetry to
        its own: inf without another, 0 if the best is at the end of the search.
    """
    cols = mean.shape[1]
    bands = np.stack([b.mean(axis=0) for b in np.array_split(mean, min(12, len(mean)))])
    bands = gaussian_filter(bands, (0, cols / LEVELS[0] / 2))
    twice = np.arange(
        round(2 * (nominal - REACH * cols)), round(2 * (nominal + REACH * cols)) + 1
    )
    cost = np.full(len(twice), np.inf)
    for i, k in enumerate(twice):
        a = np.arange(max(0, k - cols + 1), min(cols, k + 1))
        if len(a) < MIN_OVERLAP * cols:
            continue
        left = bands[:, a]
        right = bands[:, k - a]
        spread = np.square(left - left.mean(axis=1, keepdims=True)).sum()
        cost[i] = np.square(left - right).sum() / max(spread, 1e-30)
    best, ratio = best_dip(cost, cols / LEVELS[0])
    return twice[best] / 2, ratio


def best_dip(cost: FloatArray, apart: float) -> tuple[int, float]:
    """Find the least cost (inf: not tried), and the next minimum's over it.

    Minima are more than `apart` trials away. The ratio is inf without another, 0 if the
    least cost is at an end or next to one that was not tried.
    """
    best = int(cost.argmin())
    inner, made = cost[1:-1], np.isfinite(cost)
    low = (inner <= cost[:-2]) & (inner <= cost[2:])
    dips = np.flatnonzero(low & made[:-2] & made[2:]) + 1
    if best not in dips:
        return best, 0.0
    others = cost[dips[np.abs(dips - best) > apart]]
    return best, float(others.min() / max(cost[best], 1e-30)) if len(others) else math.inf


def find_symmetry(
    turn: Turn,
    view: View,
    start: FloatArray,
    scales: FloatArray,
    priors: FloatArray,
    border: int | None = None,
    held_px: float | None = None,
) -> Symmetry:
    """Estimate the plane of symmetry from coarse to fine smoothings (LEVELS).

    Each starts at the last; without a border the search ends where one does not converge.
    `scales`: change of each parameter (k,) that moves the image's ends by about a pixel;
    `priors`: sigmas, inf for none; `border`: first column beyond a gap, whose width [px]
    is the last parameter unless `held_px`. Returns the converged level that determines
    the first two parameters best; else the coarsest.
    """
    found = []
    values = start
    for level in LEVELS:
        smoothing = max(turn.mean.shape[1] / level, 1.0)
        one = _Level(turn, view, scales, start, priors, smoothing, border, held_px)
        found.append(one.solve(values))
        if not found[-1].converged and border is None:
            break
        values = found[-1].values
    good = [f for f in found if f.converged]
    if good:
        return min(good, key=lambda f: f.images[0] * f.images[1])
    return found[0]


class _Level:
    """One smoothing of the mean, sampled twice a sigma."""

    def __init__(
        self,
        turn: Turn,
        view: View,
        scales: FloatArray,
        mean: FloatArray,
        priors: FloatArray,
        sigma: float,
        border: int | None,
        held_px: float | None,
    ) -> None:
        """Smooth the mean image by `sigma` and choose the places that are compared, two a
        sigma each way and two sigmas from the edges.

        Args:
            turn: mean image with its doubts and noise.
            view: of parameters.
            scales: (p,) steps of the parameters.
            mean: (p,) means of the priors.
            priors: (p,) standard deviations.
            sigma: smoothing [px].
            border: first column beyond a gap in the panel; None without.
            held_px: width of that gap if it is fixed.
        """
        self.view = view
        self.scales = scales
        self.sigma = sigma
        self.border = border
        self.held_px = held_px
        self.start = mean
        self.priors = priors
        rows, cols = self.shape = turn.mean.shape
        images = [
            gaussian_filter(i, sigma, mode="nearest") for i in (turn.mean, *turn.doubts)
        ]
        self.soft = [spline_filter(i) for i in images]
        self.softer = spline_filter(gaussian_filter(images[0], sigma, mode="nearest"))
        self.relative = turn.noise
        self.pixel = _noise(turn.mean)
        self.white = gaussian_filter(self.pixel, 2.0 * sigma, mode="nearest")
        noise = gaussian_filter(self.pixel, NEAR_PX, mode="nearest")
        steps = (_steps(turn.mean, noise), _steps(turn.mean.T, noise.T).T)
        self.steps = [gaussian_filter(i, sigma, mode="nearest") for i in steps]
        self.margin = 2.0 * sigma
        stride = max(1, round(sigma / 2))
        c, r = (
            np.arange(math.ceil(self.margin), math.floor(n - 1 - self.margin) + 1, stride)
            for n in (cols, rows)
        )
        self.at = np.stack([a.ravel() for a in np.meshgrid(c, r)]).astype(np.float64)

    def solve(self, start: FloatArray) -> Symmetry:
        """Find the root of the estimating equation, with the priors as observations.

        Stops after `ROUNDS`, at a step well below the uncertainty (converged), at values
        that are not finite, or if the slopes are singular; steps move the image by at
        most four sigmas of the smoothing.

        Args:
            start: of the parameters, (k,); not changed.

        Returns:
            The last estimate; not converged, perhaps with infinite covariance, if the
            pixels with a mirror image are too few.
        """
        values = start.copy()
        k = len(start)
        found = Symmetry(
            values, np.full((k, k), np.inf), np.full(k, np.inf), math.inf, False
        )
        for _ in range(ROUNDS):
            pairs = self._pairs(values)
            if pairs is None:
                return found
            slope = np.empty((k, k))
            for i in range(k):
                e = np.zeros(k)
                e[i] = self.scales[i] * (0.5 + self.sigma / 4)
                slope[:, i] = (pairs.score(values + e) - pairs.score(values - e)) / (
                    2 * e[i]
                )
            if not np.linalg.cond(slope * np.outer(self.scales, self.scales)) < 1e12:
                return found
            inverse = np.asarray(np.linalg.inv(slope), dtype=np.float64)
            raw = pairs.covariance(inverse)
            aim = values - inverse @ pairs.score(values)
            # A prior is an observation more.
            known = np.diag(1.0 / np.square(self.priors))
            gain = np.linalg.solve(np.eye(k) + raw @ known, raw @ known)
            step = aim + gain @ (self.start - aim) - values
            covariance = raw - gain @ raw
            longest = float(np.abs(step / self.scales).max())
            values = values + step * min(1.0, 4.0 * self.sigma / max(longest, 1e-30))
            sigmas = np.sqrt(np.abs(np.diag(covariance)))
            if self.border is None:
                near = 0.02
            else:
                near = 0.1
            done = bool((np.abs(step) <= near * sigmas + 1e-5 * self.scales).all())
            found = Symmetry(
                values, covariance, np.sqrt(np.diag(raw)), pairs.asymmetry(), done
            )
            if done or not np.isfinite(values).all():
                break
        return found

    def _mirrored(self, values: FloatArray, at: FloatArray) -> FloatArray:
        """Compute mirror images of pixels, across a gap between two panel tiles if there
        is one: fixed, or the last parameter.

        Args:
            values: parameters.
            at: (2, k) columns and rows.

        Returns:
            (2, k) columns and rows, perhaps off the panel; images in the gap are at its
            border.
        """
        middle = (np.array(self.shape[::-1]) - 1)[:, None] / 2
        begins = math.inf
        gap = 0.0
        if self.border is not None:
            begins = self.border - 0.5
            if self.held_px is not None:
                gap = self.held_px
            else:
                values, gap = values[:-1], float(values[-1])
        c, r, w = mirror_map(self.view(values)) @ np.vstack(
            [
                at[0] + gap * (at[0] > begins) - middle[0],
                at[1] - middle[1],
                np.ones(at.shape[1]),
            ]
        )
        image = np.stack([c / w, r / w]) + middle
        far = image[0] - begins
        image[0] -= np.where(far > gap, gap, np.maximum(far, 0.0))
        return np.asarray(image)

    def _pairs(self, here: FloatArray) -> _MirrorPairs | None:
        """Collect the pixels with a mirror image well on the panel, each pair once, away
        from a tile's border.

        Args:
            here: parameters.

        Returns:
            None for fewer than 100 pairs or `MIN_OVERLAP` / 4 of the places.
        """
        image = self._mirrored(here, self.at)
        room = 4.0 * self.sigma + self.margin
        inside = (image[0] > room) & (image[0] < self.shape[1] - 1 - room)
        inside &= (image[1] > self.margin) & (image[1] < self.shape[0] - 1 - self.margin)
        inside &= self.at[0] < image[0]
        for column in (self.at[0], image[0]) if self.border is not None else ():
            inside &= np.abs(column - self.border + 0.5) > _room(self.sigma)
        if inside.sum() < max(100.0, MIN_OVERLAP / 4 * self.at.shape[1]):
            return None
        return _MirrorPairs(self, here, self.at[:, inside])


class _MirrorPairs:
    """Pixels and their mirror images, with slopes and weights taken at `here`."""

    def __init__(self, level: _Level, here: FloatArray, at: FloatArray) -> None:
        """Mirror places and read both ends, their weights and slopes.

        Weights are less where noise, or steps between rows or columns, are larger; odd
        polynomials, errors of the flat field, are taken out of the slopes.

        Args:
            level: smoothed images.
            here: (p,) parameters of the geometry.
            at: (2, m) column and row of the places [px].
        """
        self.level = level
        self.here = here
        self.at = at
        image = self.image = level._mirrored(here, at)
        variance = sum(
            map_coordinates(level.relative, p[::-1], order=1) for p in (at, image)
        )
        self.own = [read_spline(soft, at) for soft in level.soft]
        self.white = [map_coordinates(level.white, p[::-1], order=1) for p in (at, image)]
        self.steps = [map_coordinates(i, at[::-1], order=1) for i in level.steps]
        noise = sum(self.white) / (4.0 * math.pi * level.sigma**2)
        doubt = 1.0 + np.square(self.steps).sum(axis=0) / np.maximum(noise, 1e-30)
        w = self.w = 1.0 / np.asarray(variance * doubt)
        self.odd = self._polynomials(at) - self._polynomials(image)
        self.to_odd = np.linalg.pinv((self.odd.T * w) @ self.odd) @ (self.odd.T * w)
        self.ends = []
        slopes = np.empty((at.shape[1], len(here)))
        for i, e in enumerate(np.diag(0.25 * level.scales * (1.0 + level.sigma))):
            ends = [level._mirrored(here + s * e, at) for s in (1, -1)]
            self.ends.append((ends, 2.0 * e[i]))
            low, high = (read_spline(level.softer, end) for end in ends)
            slopes[:, i] = (high - low) / (2.0 * e[i])
        self.slopes = slopes - self.odd @ (self.to_odd @ slopes)

    def _polynomials(self, at: FloatArray) -> FloatArray:
        """Evaluate errors of a flat field up to third degree that are odd about some
        column, (k, 4)."""
        x, y = (a / n - 0.5 for a, n in zip(at, self.level.shape[::-1], strict=True))
        return np.column_stack([x, x * y, x**3, x * y * y])

    def _residual(self, values: FloatArray, which: int = 0) -> FloatArray:
        image = self.level._mirrored(values, self.at)
        return np.asarray(self.own[which] - read_spline(self.level.soft[which], image))

    def score(self, values: FloatArray) -> FloatArray:
        """Evaluate the estimating equation at some parameters: the weighted difference of
        mirrored pairs along its slopes, less what noise adds.

        Weights and slopes stay those of `here`.

        Args:
            values: (p,) parameters.

        Returns:
            (p,), 0 at the solution.
        """
        image = self.level._mirrored(values, self.at)
        rest = self.own[0] - read_spline(self.level.soft[0], image)
        both = 3.0 * self.level.sigma**2  # of the two smoothings
        power = self.w * self.white[1] / (2.0 * math.pi * both)
        noise = []
        for ends, width in self.ends:
            low, high = (
                np.exp(np.square(image - e).sum(axis=0) / (-2 * both)) for e in ends
            )
            noise.append(float(power @ (low - high)) / width)
        return np.asarray((self.slopes.T * self.w) @ rest - np.array(noise))

    def _rest(self, which: int = 0) -> FloatArray:
        rest = self._residual(self.here, which)
        return np.asarray(rest - self.odd @ (self.to_odd @ rest))

    def _power(self) -> tuple[float, float]:
        """Compute weighted mean squares of the residual (without odd polynomials), and of
        noise alone, above 0.
        """
        white = (self.white[0] + self.white[1]) / (4.0 * math.pi * self.level.sigma**2)
        rest = float(np.average(np.square(self._rest()), weights=self.w))
        return rest, max(float(np.average(white, weights=self.w)), 1e-30)

    def _copies_power(self) -> float:
        """Compute the weighted mean square of the scan's own copies' mirrored pairs.

        It has the asymmetry of few views, noise and flicker, no other.
        """
        total = 0.0
        for copy in range(1, len(self.own)):
            squares = np.square(self._rest(copy))
            total += float(np.average(squares, weights=self.w))
        return total

    def asymmetry(self) -> float:
        """Compute the root mean square by which mirrored pairs differ, beyond noise and
        beyond those of the scan's own copies, over that of the image about its mean; 0 if
        either explains it.
        """
        rest, noise = self._power()
        noise = max(noise, self._copies_power())
        own = self.own[0] - np.average(self.own[0], weights=self.w)
        structure = max(float(np.average(own * own, weights=self.w)), 1e-30)
        return math.sqrt(max(rest - noise, 0.0) / structure)

    def covariance(self, inverse: FloatArray) -> FloatArray:
        """Compute the covariance of the parameters from noise and doubts.

        The noise is widened where blocks of rows or columns scatter more or residuals are
        larger. Errors of sampling at edges (the diagonal alone), and of systematic doubts
        of the mean, are added; half of the first doubt, for the lack of views.

        Args:
            inverse: (k, k) of the slopes of the equation.

        Returns:
            (k, k).
        """
        z = self.slopes * self.w[:, None]
        images = np.stack([self._spread(column) for column in z.T])
        noise = np.einsum("irc,jrc,rc->ij", images, images, self.level.pixel)
        parts = z * self._rest()[:, None]
        rest, white = self._power()
        wider = np.full(len(noise), max(1.0, rest / white))
        weight = self.w * np.square(
            self.slopes / np.linalg.norm(self.slopes * np.sqrt(self.w)[:, None], axis=0)
        ).sum(axis=1)
        covariance = inverse @ noise @ inverse.T
        stepped = np.zeros(len(noise))
        for place, steps in zip((self.at[1], self.at[0]), self.steps, strict=True):
            order = np.argsort(place, kind="stable")
            share = np.cumsum(weight[order]) / weight.sum()
            block = np.minimum(share * BLOCKS, BLOCKS - 1).astype(np.intp)
            sums = np.stack(
                [np.bincount(block, p[order], BLOCKS) for p in parts.T], axis=1
            )
            sums -= sums.mean(axis=0)
            free = BLOCKS - 1 - len(noise)
            scatter = inverse @ (sums.T @ sums) @ inverse.T * (BLOCKS / free)
            wider = np.maximum(wider, np.diag(scatter) / np.diag(covariance))
            # An edge may be off in the same way all along: what it does adds up.
            off = np.abs(inverse @ z.T) * steps
            edge = (place / (6.0 * math.hypot(self.level.sigma, NEAR_PX))).astype(np.intp)
            stepped += [np.square(np.bincount(edge, o)).sum() for o in off]
        covariance = covariance * np.sqrt(np.outer(wider, wider)) + np.diag(stepped)
        for i in range(1, len(self.own)):
            shift = inverse @ (z.T @ self._residual(self.here, i))
            shift /= (
                2.0 if i == 1 else 1.0
            )  # lack of views: half of what half of them lack
            covariance = covariance + np.outer(shift, shift)
        return np.asarray(covariance)

    def _spread(self, column: FloatArray) -> FloatArray:
        """Compute the image whose product with the mean is column' r (smoothing and
        reading, linear, adjoint).

        Args:
            column: (m,) of the pairs.

        Returns:
            (rows, cols).
        """
        rows, cols = self.level.shape
        out = np.zeros(rows * cols)
        for at, sign in ((self.at, 1.0), (self.image, -1.0)):
            low = np.floor(at).astype(np.intp)
            part = at - low
            for right, down in np.ndindex(2, 2):
                share = np.abs(1 - right - part[0]) * np.abs(1 - down - part[1])
                place = np.minimum(low[1] + down, rows - 1) * cols
                place += np.minimum(low[0] + right, cols - 1)
                out += np.bincount(place, sign * share * column, rows * cols)
        return np.asarray(
            gaussian_filter(out.reshape(rows, cols), self.level.sigma, mode="nearest")
        )


def sharpness(mean: FloatArray) -> float:
    """Measure how sharp edges along the rows are, times the root of their share in the changes
    from row to row. `mean`: line integrals, (rows, cols). Returns 1 for pixels that are points,
    0.4 for square ones without blur, 0 without edges above the noise."""
    noise = np.full(mean.shape, np.median(_noise(mean)) / MEDIAN_OF_CHI_SQUARE)
    edges, left = _edges(mean, noise)
    change = np.square(gaussian_filter(np.diff(mean, axis=0, append=mean[-1:]), NEAR_PX))
    return left * math.sqrt(change[edges > 0.0].sum() / max(float(change.sum()), 1e-30))


def _noise(mean: FloatArray) -> FloatArray:
    """Compute squares of second differences along rows, whose mean is the noise's
    variance: photons, flat field and rings, little of the object."""
    change = np.diff(np.pad(mean, ((0, 0), (1, 1)), mode="reflect"), 2, axis=1)
    return np.asarray(np.square(change) / 6)


def _steps(mean: FloatArray, noise: FloatArray) -> FloatArray:
    """Estimate sigmas of sampling errors at edges along rows, (rows, cols)."""
    # Pixels that are points know an edge to half a row. Without blur it has all frequencies
    # alike: the attenuation at half the sampling's, relative to a quarter, gives its own.
    edges, left = _edges(mean, noise)
    return np.asarray(edges * left**2 / math.sqrt(6.0))


def _edges(mean: FloatArray, noise: FloatArray) -> tuple[FloatArray, float]:
    """Measure edges along the rows at a quarter of the sampling's frequency.

    Args:
        mean: (rows, cols) mean image.
        noise: its variance, (rows, cols); edges below `MIN_EDGE_SIGMAS` count as 0.

    Returns edges (rows, cols), and the strength at half the sampling's frequency over that at a
    quarter, at most 1; 0 without edges.
    """
    change = np.diff(mean, axis=0, append=mean[-1:])

    def at(turn: float) -> FloatArray:
        wave = np.exp(1j * turn * np.arange(len(mean)))[:, None]
        return np.asarray(np.abs(gaussian_filter(change * wave, NEAR_PX, mode="nearest")))

    half = at(np.pi)
    quarter = at(np.pi / 2)
    seen = np.square(quarter) > MIN_EDGE_SIGMAS**2 * noise / (2.0 * math.pi * NEAR_PX**2)
    left = min(1.0, half[seen].sum() / max(quarter[seen].sum(), 1e-30))
    return np.where(seen, quarter, 0.0), left


def read_spline(coefficients: FloatArray, at: FloatArray) -> FloatArray:
    """Read an image at places (column, row) (2, k), by the coefficients of its cubic spline."""
    return np.asarray(
        map_coordinates(coefficients, at[::-1], order=3, prefilter=False, mode="nearest")
    )
