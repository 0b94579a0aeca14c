"""Rays that a full turn shows from both ends: the axis column, and steps at tile borders.

A ray of the source's plane that one view shows at an angle g to the ray through the axis
is shown from its other end by the view half a turn and 2 g further, at the mirror image
of its column. Both integrals are the same for any object, so both ends of all rays are
equally far from the axis. Their difference in pixels, at each distance, follows from
slopes of the images; the slope of one end is the instrument of the other, so that noise
in slopes shortens nothing. Structures that a column shows in all views (rings, a wrong
flat field, a wall about the axis) are left out.

A wrong axis column moves all distances alike. A gap between two tiles moves those beyond
it by its width and no others, whatever passes there: it is an identity of the panel.
Other differences between distances (beam hardening at walls, a yaw, few views) are no
step; their size is the threshold of a step.

Uncertainties follow from leaving out sectors of the turn, those of steps from leaving out
rows too: a gap is in all rows, a leaning structure is not.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter1d, spline_filter
from scipy.special import ndtr, stdtrit

from flexdt.twin.calibration.without_phantom.circular_scan import CircularScan
from flexdt.twin.calibration.without_phantom.mirror_symmetry import mirror_map
from flexdt.twin.calibration.without_phantom.turn import Turn
from flexdt.twin.geometry.conventions import FloatArray

SECTORS: Final = 24
"""Number of sectors of the turn that are left out in turn."""
SMOOTHING: Final = 128.0
"""Columns over the smoothing's sigma, which is one column at least."""
MAX_VIEWS_RATIO: Final = 4.0
"""Columns times the step between views [rad] over the smoothing's sigma, at most."""
EDGE_VIEWS: Final = 8
"""Views repeated at both ends for the splines over the angle."""
COARSE: Final = 4.0
"""Factor on the smoothing where the fine one shows no column: a column that is 2 px off
sets slopes 4 px apart, more than the width of a fine edge."""
ROUNDS = 4
NEAR = 0.05
"""Steps towards the axis column at most, and part of a sigma that is none."""
PER_SIGMA: Final = 3.0
"""Distances from the axis that are read in a sigma of the smoothing, at least a column
apart."""
MAX_BINS: Final = 24
"""Largest number of bins of distances from the axis."""
MIN_BIN_SIGMAS: Final = 2.0
"""Least width of a bin, in sigmas of the smoothing."""
YAW_PX: Final = 0.1
"""By so much a yaw may move the ends of the panel against its middle, beyond that in force
[px]."""
LEAST_BINS: Final = 8
"""One bin of so many may be left out: where a wall turns back, more is wrong than elsewhere."""
MIN_BINS: Final = 4
"""Least number of informative bins."""
MOST_MOVED: Final = 0.1
"""Part of the innermost bin that a step may move, at most: without a bin inside, it is a
shift."""
BEYOND = 3
BESIDE = 2
"""Whole bins beyond a step, at least, and beside it that are not left out."""
MAX_WIDTH_PX: Final = 5.0
"""Largest width of a gap [px]."""
MIN_CORRELATION: Final = 0.3
"""Least correlation of the slopes of both ends of rays: noise alone has none."""
CHANCE: Final = 1e-4
"""Probability of a step in a scan without one."""


class Step(NamedTuple):
    """A step of the distance between both ends of rays.

    Attributes:
        radius: distance from the axis beyond which rays are moved [px].
        width: of their shift [px]; positive: right of the axis, everything beyond appears
            nearer.
        sigma: standard deviation of the width [px].
        least: width above which it is no chance [px].
    """

    radius: float
    width: float
    sigma: float
    least: float

    @property
    def significant(self) -> bool:
        """Whether it is no chance."""
        return abs(self.width) > self.least


NO_STEP: Final = Step(0.0, 0.0, math.inf, math.inf)


@dataclass(frozen=True, eq=False)
class Profile:
    """Distances between both ends of rays, by their distance from the axis.

    Attributes:
        radii: where steps are looked for, (r,) [px].
        basis: shares in bins of a common shift, of a yaw and of a step at radii, (r, m, 3).
        shift: distance between the ends, of each bin, (m,) [px].
        sigma: standard deviation of the shift by sectors of the turn, (m,) [px].
        certain: number of radii, the first ones, at which a step is told from a wall that
            turns back.
    """

    radii: FloatArray
    basis: FloatArray
    shift: FloatArray
    sigma: FloatArray
    certain: int

    @classmethod
    def of(
        cls,
        radius: FloatArray,
        weight: FloatArray,
        place: npt.NDArray[np.intp],
        shift: FloatArray,
        sigma: FloatArray,
        soft: float,
    ) -> Profile:
        """Make a profile of (k,) columns' radii [px], and of bins' shifts (m,) [px].

        It is certain of steps but for the last `BEYOND` bins.
        """
        at = radius[place < place.max()]
        # With one bin beyond, a wall that turns back there looks like a step.
        certain = int((place <= place.max() - BEYOND).sum())
        return cls(at, _basis(radius, weight, place, at, soft), shift, sigma, certain)

    def best(self) -> Step:
        """Find the most significant step, by its width over `least`; it need not be
        significant.

        One bin after the other, up to one of `LEAST_BINS`, is left out where it fits
        worst; `least` contains the effect of that choice. A step must be narrower than
        `MAX_WIDTH_PX`, more than `BESIDE` bins from those left out, and have a bin
        inside. Its sigma contains the choice among radii.

        Returns:
            NO_STEP if none is so.
        """
        sigma = self.sigma
        found = [NO_STEP]
        border = np.abs(self.basis[:, :, 2] - 0.5).argmin(axis=1)
        for _ in range(1 + len(self.shift) // LEAST_BINS):
            chi_square = np.square(self._fit(sigma)[2]).sum(axis=1)[: self.certain]
            widened = self._widened(sigma, int(chi_square.argmin()))
            steps, rest = self._steps(widened)
            left_out = np.flatnonzero(np.isinf(sigma))
            clear = (np.abs(border[:, None] - left_out) > BESIDE).all(axis=1)
            narrow = clear & self._has_inside
            narrow[self.certain :] = False
            narrow &= np.array([abs(one.width) < MAX_WIDTH_PX for one in steps])
            if not narrow.any():
                break
            ratio = np.where(narrow, [abs(one.width) / one.least for one in steps], 0.0)
            best = steps[int(ratio.argmax())]
            unsure = _spread(np.array([one.width for one in steps]), rest, narrow)
            found.append(best._replace(sigma=math.hypot(best.sigma, unsure)))
            sigma = sigma.copy()
            sigma[int(np.abs(rest[int(ratio.argmax())]).argmax())] = math.inf
        return max(found, key=lambda one: abs(one.width) / one.least)

    def at(self, radius: float) -> Step:
        """Estimate the step near a radius [px] from the axis.

        Sigma and least are inf unless the innermost bin is inside it.
        """
        place = self._place(radius, self.certain)
        step = self.at_certain(radius)
        if self._has_inside[place]:
            return step
        return step._replace(sigma=math.inf, least=math.inf)

    def at_certain(self, radius: float) -> Step:
        """Estimate as `at`, always with finite sigma."""
        return self._at(self._place(radius, self.certain))

    def at_rim(self, radius: float) -> Step:
        """Estimate the step near a radius [px], also with one bin beyond."""
        return self._at(self._place(radius, len(self.radii)))

    @property
    def last(self) -> float:
        """Largest radius at which a step is certain [px]."""
        return float(self.radii[self.certain - 1])

    def _place(self, radius: float, count: int) -> int:
        """Find the radius next to one among the first `count`."""
        return int(np.abs(self.radii[:count] - radius).argmin())

    def _at(self, place: int) -> Step:
        """Estimate the step at one of the radii."""
        return self._steps(self._widened(self.sigma, place))[0][place]

    @property
    def _has_inside(self) -> npt.NDArray[np.bool_]:
        """Whether the innermost bin is inside a step at each radius, (r,)."""
        return np.asarray(self.basis[:, 0, 2] < MOST_MOVED)

    def _fit(self, sigma: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Fit shift, yaw and step of each radius by weighted least squares, the yaw with a prior
        of `YAW_PX`.

        `sigma`: (m,) of the bins [px]; inf for one that does not count.
        Returns values (r, 3), their covariances (r, 3, 3), and residuals in sigmas, (r, m).
        """
        scaled = self.basis / sigma[:, None]
        aim = self.shift / sigma
        across = scaled.transpose(0, 2, 1)
        inverse = np.linalg.inv(across @ scaled + np.diag([1e-9, 1.0, 1e-9]))
        values = (inverse @ (across @ aim)[:, :, None])[:, :, 0]
        rest = aim - (scaled @ values[:, :, None])[:, :, 0]
        return values, np.asarray(inverse, dtype=np.float64), rest

    def _steps(self, sigma: FloatArray) -> tuple[list[Step], FloatArray]:
        """Estimate the step at each radius; `least` of each is the step that occurs by
        chance (`CHANCE`), in view of the number of radii and of bins left out.

        Args:
            sigma: (m,) standard deviations of the values; inf for one that does not
                count.

        Returns:
            The steps (r of them), and the fits' residuals in sigmas, (r, m).
        """
        values, inverse, rest = self._fit(sigma)
        count = len(sigma)
        dropped = int(np.isinf(sigma).sum())
        chances = 2.0 * count * math.comb(count, dropped)
        times = -float(stdtrit(max(count - dropped - 2, 1), CHANCE / chances))
        own = np.sqrt(inverse[:, 2, 2])
        table = zip(self.radii.tolist(), values[:, 2].tolist(), own.tolist(), strict=True)
        return [
            Step(radius, width, one, one * times) for radius, width, one in table
        ], rest

    def _widened(self, sigma: FloatArray, place: int) -> FloatArray:
        """Widen the standard deviations of bins until the residuals of a step at a radius
        are usual, all by one common amount added in quadrature.

        Args:
            sigma: (m,) of the bins [px].
            place: index of the radius.

        Returns:
            (m,); `sigma` itself if the residuals are usual already.
        """
        only = Profile(self.radii[[place]], self.basis[[place]], self.shift, sigma, 1)
        free = int(np.isfinite(sigma).sum()) - 2

        def explained(more: float) -> bool:
            return bool(np.square(only._fit(np.hypot(sigma, more))[2]).sum() <= free)

        if explained(0.0):
            return sigma
        low = 0.0
        high = float(np.abs(self.shift).max()) + 1.0
        for _ in range(20):
            middle = (low + high) / 2
            low, high = (low, middle) if explained(middle) else (middle, high)
        return np.hypot(sigma, high)


def _spread(widths: FloatArray, rest: FloatArray, usable: npt.NDArray[np.bool_]) -> float:
    """Compute the standard deviation of widths (r,) [px] over radii, by their likelihood.

    `rest`: residuals of each in sigmas, (r, m); `usable`: radii that count, one at least.
    """
    chi_square = np.square(rest).sum(axis=1)
    less = np.minimum(chi_square[usable].min() - chi_square, 0.0)
    likely = usable * np.exp(less / 2.0)
    mean = np.average(widths, weights=likely)
    return float(np.sqrt(np.average(np.square(widths - mean), weights=likely)))


def _basis(
    radius: FloatArray,
    weight: FloatArray,
    place: npt.NDArray[np.intp],
    at: FloatArray,
    soft: float,
) -> FloatArray:
    """Compute each bin's shares of a common shift, a yaw and steps at radii, (r, m, 3).

    Shares are means weighted by columns' information; the yaw is `YAW_PX` at the last,
    growing as the square. `place`: the columns' bins; `at`: radii (r,) [px]; `soft`:
    smoothing's sigma [px].
    """
    one_of = (place == np.arange(place.max() + 1)[:, None]) * weight
    one_of /= one_of.sum(axis=1, keepdims=True)
    bent = YAW_PX * (one_of @ np.square(radius / radius[-1]))
    beyond = ndtr((radius - at[:, None]) / soft) @ one_of.T
    return np.stack(
        [np.ones_like(beyond), np.broadcast_to(bent, beyond.shape), beyond], axis=2
    )


class ConjugateRays:
    """Both ends of the rays of a full turn near the plane of the source.

    Args:
        scan: the scan on one circle.
        band: means over groups of rows near the source's plane, (n, groups, cols), at even
            steps.
        rows: middle row of each group, (groups,).
        step: between views [rad].
    """

    def __init__(
        self,
        scan: CircularScan,
        band: FloatArray,
        rows: FloatArray,
        step: float,
        coarser: float = 1.0,
    ) -> None:
        """Smooth the images along their rows and prepare splines over views and columns.

        The smoothing is `cols / SMOOTHING`, one column and the step between views at
        least, all times `coarser`.

        Args:
            scan: a full turn.
            band: (views, groups, cols) means of groups of rows, at even steps.
            rows: (groups,) the groups' middle rows [px].
            step: angle between views [rad].
            coarser: factor on the smoothing.
        """
        self.scan = scan
        self.band = band
        self.rows = rows
        self.step = step
        self.views = len(band)
        self.cols = band.shape[2]
        self.smoothing = coarser * max(
            1.0, self.cols / SMOOTHING, step * self.cols / MAX_VIEWS_RATIO
        )
        soft = gaussian_filter1d(band, self.smoothing, axis=2, mode="nearest")
        self.splines = [
            spline_filter(np.pad(one, ((0, 0), (EDGE_VIEWS, EDGE_VIEWS)), mode="wrap"))
            for one in soft.transpose(1, 2, 0)
        ]
        self.sector = np.arange(self.views) * SECTORS // self.views

    @classmethod
    def of(cls, scan: CircularScan, turn: Turn) -> ConjugateRays:
        """Take the rows near the source's plane from the frames of a turn, interpolated
        at even angles if they are uneven.
        """
        azimuth = scan.azimuth(turn.band_frames)
        band, step = _evenly(np.asarray(turn.band, dtype=np.float64), azimuth)
        return cls(scan, band, np.array(turn.band_rows), step)

    def closed(self, column: int, width: float) -> ConjugateRays:
        """Return rays with a gap between panel tiles closed: columns from `column` on
        move back by its `width` [px], those in it repeat its edge. The rays themselves
        stay.
        """
        there = np.arange(self.cols, dtype=np.float64)
        at = there - np.clip(there - (column - 0.5), 0.0, width)
        low = np.minimum(np.floor(at).astype(np.intp), self.cols - 2)
        part = at - low
        band = (1.0 - part) * self.band[:, :, low] + part * self.band[:, :, low + 1]
        return ConjugateRays(self.scan, band, self.rows, self.step)

    @property
    def row(self) -> float:
        """Row that the column belongs to: the middle of those that are read."""
        return float(self.rows.mean())

    def column(self, values: FloatArray) -> tuple[FloatArray, float]:
        """Move the plane's first parameter until both ends of rays agree, in `ROUNDS`
        steps.

        From coarser smoothing (`COARSE`) where the fine shows no agreement. Returns
        parameters (k,), and the column's standard deviation [px]; inf if too little turns
        (`MIN_CORRELATION`).
        """
        fine, sigma = self._agreement(values)
        if math.isfinite(sigma):
            return fine, sigma
        coarse = ConjugateRays(self.scan, self.band, self.rows, self.step, COARSE)
        begun, sigma = coarse._agreement(values)
        if not math.isfinite(sigma):
            return fine, sigma
        return self._agreement(begun)

    def _agreement(self, values: FloatArray) -> tuple[FloatArray, float]:
        """Find the column at which both ends agree, from near it; see `column`."""
        values = values.copy()
        slope = self.scan.slopes(values, self.scan.scales[: len(values)])[0]
        for _ in range(ROUNDS):
            _, moved, information, power = self._sums(values)
            if not information.sum() > MIN_CORRELATION * power.sum():
                return values, math.inf
            shift, sigma = _left_out(moved.sum(axis=(1, 2)), information.sum(axis=(1, 2)))
            values[0] -= shift / 2.0 / slope
            if abs(shift) < NEAR * sigma:
                break
        return values, sigma / 2.0

    def profile(self, values: FloatArray) -> Profile | None:
        """Read the distance between both ends of rays at each distance from the axis, in
        bins.

        Bins of less correlation than `MIN_CORRELATION` are left out. The sigma of each is
        the larger of those by sectors and by groups of rows.

        Args:
            values: parameters in the order of `circular_scan.FREE`, (k,).

        Returns:
            The profile; None if fewer than `MIN_BINS` bins are left.
        """
        radius, moved, information, power = self._sums(values)
        if len(radius) == 0:
            return None
        weight = information.sum(axis=(0, 1))
        place = (
            radius / max(MIN_BIN_SIGMAS * self.smoothing, radius[-1] / MAX_BINS)
        ).astype(np.intp)
        count = int(place[-1]) + 1
        of_bin = (place[:, None] == np.arange(count)).astype(np.float64)
        moved = moved @ of_bin
        information = information @ of_bin
        good = np.bincount(place, weight) > MIN_CORRELATION * np.bincount(place, power)
        shift, sigma = np.ones((2, count))
        for i in np.flatnonzero(good).tolist():
            ways = [
                _left_out(*(t[..., i].sum(axis=a) for t in (moved, information)))
                for a in (1, 0)
            ]
            shift[i] = ways[0][0]
            sigma[i] = max(way[1] for way in ways)
        good &= np.isfinite(sigma)
        if good.sum() < MIN_BINS:
            return None
        in_good_bin = good[place]
        renumbered = np.cumsum(good) - 1
        radius = radius[in_good_bin]
        weight = weight[in_good_bin].clip(1e-30)
        place = renumbered[place[in_good_bin]]
        return Profile.of(radius, weight, place, shift[good], sigma[good], self.smoothing)

    def _sums(
        self, values: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Sum up differences and slopes of both ends of rays, without their means over
        the turn.

        Args:
            values: parameters in the order of `circular_scan.FREE`.

        Returns:
            Distances from the axis (k,), as far as both sides of the panel reach, perhaps
            none; sums over each sector, group of rows and distance of differences times
            slopes and of slopes of one end times those of the other, (SECTORS, groups, k)
            each; the power of slopes (k,).
        """
        axis = self.scan.column(values, self.row)
        apart_px = max(1.0, self.smoothing / PER_SIGMA)
        radius = np.arange(
            0.5, min(self.cols - 1 - axis, axis) - 3.0 * self.smoothing, apart_px
        )
        apart, own, other = np.zeros((3, self.views, len(self.rows), len(radius)))
        little = 0.25 + 0.25 * self.smoothing
        columns = axis + radius
        for i in range(len(self.rows)):
            here, there = self._both(i, values, columns)
            low, high = (self._both(i, values, columns + e) for e in (-little, little))
            apart[:, i] = here - there
            ends = zip(low, high, strict=True)
            own[:, i], other[:, i] = ((b - a) / (2.0 * little) for a, b in ends)
        for table in (apart, own, other):
            table -= table.mean(axis=0)
        moved, information = np.zeros((2, SECTORS, len(self.rows), len(radius)))
        np.add.at(moved, self.sector, apart * (own + other) / 2.0)
        np.add.at(information, self.sector, own * other)
        power = (np.square(own) + np.square(other)).sum(axis=(0, 1)) / 2.0
        return radius, moved, information, power

    def _both(
        self, group: int, values: FloatArray, columns: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Read rays to columns of a group of rows from both ends in all n views,
        interpolated between views and columns.

        Args:
            group: number of the group of rows.
            values: parameters in the order of `circular_scan.FREE`.
            columns: (k,) [px].

        Returns:
            Line integrals read forwards and from the opposite side, (n, k) each.
        """
        view = self.scan.view(values)
        middle = (np.array(self.scan.shape[::-1]) - 1) / 2
        at = np.vstack(
            [
                columns - middle[0],
                np.full(len(columns), self.rows[group] - middle[1]),
                np.ones(len(columns)),
            ]
        )
        mirrored = mirror_map(view) @ at
        opposite = mirrored[0] / mirrored[2] + middle[0]
        source, detector, u, v = view.reshape(4, 3)
        ray = (detector - source)[:2, None] + u[:2, None] * at[0] + v[:2, None] * at[1]
        inwards = -source[:2]
        angle = np.arctan2(inwards[0] * ray[1] - inwards[1] * ray[0], inwards @ ray)
        turned = (math.pi + 2.0 * angle) / self.step
        here = self._read(group, np.zeros(len(columns)), columns)
        return here, self._read(group, turned, opposite)

    def _read(self, group: int, ahead: FloatArray, columns: FloatArray) -> FloatArray:
        """Interpolate one group of rows between views (cyclic) and columns by cubic splines.

        In all views the same columns are read, so the splines are summed over columns once.

        `group`: number of the group. `ahead`: (k,) views by which each column is read later than
        in the view itself. `columns`: (k,) of the panel [px]; those off it take its edge.
        Returns (n, k) line integrals.
        """
        splines = self.splines[group]
        last = len(splines) - 1
        low, weights = _taps(columns)
        read = sum(
            weight[:, None] * splines[np.clip(low + i - 1, 0, last)]
            for i, weight in enumerate(weights)
        )
        low, weights = _taps(ahead % self.views)
        at = (low[:, None] + np.arange(self.views)) % self.views + EDGE_VIEWS - 1
        at += np.arange(len(columns))[:, None] * splines.shape[1]
        flat = np.ravel(read)
        return np.asarray(
            sum(weight[:, None] * flat[at + i] for i, weight in enumerate(weights))
        ).T


def _taps(places: FloatArray) -> tuple[npt.NDArray[np.intp], tuple[FloatArray, ...]]:
    """Return the second of the four coefficients of a cubic spline at places (k,), and the weights
    of all.
    """
    low = np.floor(places).astype(np.intp)
    t = places - low
    u = 1.0 - t
    inner = (4.0 - 6.0 * t**2 + 3.0 * t**3) / 6.0, (4.0 - 6.0 * u**2 + 3.0 * u**3) / 6.0
    return low, (u**3 / 6.0, *inner, t**3 / 6.0)


def _left_out(moved: FloatArray, told: FloatArray) -> tuple[float, float]:
    """Compute a ratio of sums, and its sigma from leaving out each term (jackknife), 1e-6 at
    least.

    `moved`: (n,) terms of the numerator, by sector or row; `told`: (n,) terms of the
    denominator.
    Returns ratio and sigma; 0 and inf where the denominator, or it without one term, is not
    positive."""
    count = len(told)
    rest = told.sum() - told
    if not (told.sum() > 0.0 and rest.min() > 0.0):
        return 0.0, math.inf
    without = (moved.sum() - moved) / rest
    scatter = np.square(without - without.mean()).sum() * (count - 1) / count
    return float(moved.sum() / told.sum()), float(np.sqrt(scatter)) + 1e-6


def _evenly(band: FloatArray, azimuth: FloatArray) -> tuple[FloatArray, float]:
    """Sort views by their azimuth, and interpolate them linearly at even steps over a
    turn.

    Steps that differ by less than 2 % are taken as even: those views are only sorted.

    Args:
        band: (n, groups, cols).
        azimuth: (n,) [rad].

    Returns:
        The views, perhaps of another number, and the step [rad].
    """
    around = azimuth % (2 * math.pi)
    order = np.argsort(around, kind="stable")
    around = around[order]
    band = band[order]
    gaps = np.diff(around, append=around[0] + 2 * math.pi)
    usual = float(np.median(gaps[gaps > 1e-6]))
    if np.abs(gaps / usual - 1.0).max() < 0.02:
        return band, 2 * math.pi / len(band)
    views = round(2 * math.pi / usual)
    at = around[0] + np.arange(views) * 2 * math.pi / views
    after = np.searchsorted(around, at + 1e-9) % len(around)
    before = after - 1
    wide = np.maximum((around[after] - around[before]) % (2 * math.pi), 1e-12)
    part = (((at - around[before]) % (2 * math.pi)) / wide).clip(0.0, 1.0)[:, None, None]
    return (1.0 - part) * band[before] + part * band[after], 2 * math.pi / views
