"""Rays that two views see from opposite ends: the axis of half turns and of scans of few rows.

The line through the sources of two views is a ray of both, whatever the object: where it
falls on both panels, both must have the same value. Of a full turn every ray of the fan
is one of these, of half a turn and the fan those of its first and last views. Away from
the plane in which the source turns rays differ from their opposites by the little that
they lean, so rows near it count too.

The estimate is the root of Z' W r: r is the difference of the two, Z its slopes, freed of
the error of a flat field that is wrong by a polynomial. Noise is in Z too; the product of
an image of noise alone is subtracted from Z' W Z, which would promise too much. Sums over
all rays of a view, of a sector of views and of a few columns show the scatter of Z' W r:
noise, rings, jitter, sampling. Both ends of a ray also differ by structures that repeat
along a wire (it hardens the beam, and is wider from one end than from the other): the
part of r that is no noise is assumed to be in phase with Z within a patch of some columns
and a sector of views, which is its largest possible effect.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter, spline_filter1d

from flexdt.twin.calibration.without_phantom.mirror_symmetry import (
    LEVELS,
    REACH,
    Symmetry,
    best_dip,
    read_spline,
)
from flexdt.twin.calibration.without_phantom.plane_pairs import noise_like, spread
from flexdt.twin.calibration.without_phantom.turn import DARKEST, MEDIAN_OF_CHI_SQUARE
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

MOST_PAIRS: Final = 30_000
"""Pairs of views that are used, evenly chosen of more; for the first search a tenth of them."""
FEWEST_PAIRS: Final = 50
ROUNDS: Final = 15
MAX_LIFT_PX: Final = 0.25
"""Largest difference of a leaning ray and its opposite at the edge of the field of view,
for rows outside the source's plane to count [px]."""
EDGE_ROWS: Final = 2
"""Rows around each view's that a cubic spline needs."""
PATCH = 6.0
SECTORS = 24
"""Sigmas of the smoothing that a patch of like differences is wide, in columns of both ends,
and sectors of the views that are as many patches."""
MIN_SIGNAL_RATIO: Final = 0.5
"""Least ratio to noise of the images behind the slopes."""
ROUNDING: Final = float(np.finfo(np.float32).eps) / math.sqrt(12.0)
"""Noise of a line integral whose intensity, about 1, is a float32."""


class OppositeRays:
    """Pairs of views, and the rays that both see.

    Args:
        frames: line integrals (n, rows, cols) of rows around the source's plane.
        top: the row of the panel that is their first.
        shape: (rows, cols) of the panel.
        views: parameters to all views about the axis, (n, 12).
        start: of the parameters, (k,); the first moves the image sideways.
        scales: change of each parameter that moves the image's ends by about a pixel, (k,).
        priors: sigma of each parameter about its start, inf for none, (k,).
        random: for the image of noise.

    Raises:
        NotIdentifiableError: hardly two views see a line from both ends.
    """

    def __init__(
        self,
        frames: Float32Array,
        top: int,
        shape: tuple[int, int],
        views: Callable[[FloatArray], FloatArray],
        start: FloatArray,
        scales: FloatArray,
        priors: FloatArray,
        random: np.random.Generator,
    ) -> None:
        """List the pairs of views that may see a line from both ends, at most
        `MOST_PAIRS`, and draw an image of noise.

        Args:
            frames: (n, rows, cols) line integrals of a band of rows.
            top: first row of the band.
            shape: (rows, cols) of the whole images.
            views: cone_vec rows (n, 12) of parameters.
            start: (p,) parameters to start from.
            scales: (p,) their steps.
            priors: (p,) their standard deviations.
            random: for images of noise.

        Raises:
            NotIdentifiableError: fewer than `FEWEST_PAIRS` see a line from both ends at
                the start; the message names a turn that would do.
        """
        rounding = random.standard_normal(frames.shape, dtype=np.float32)
        self.frames = frames + np.float32(ROUNDING) * rounding
        self.top = top
        self.shape = shape
        self.views = views
        self.start = start
        self.scales = scales
        self.known = np.diag(1.0 / np.square(priors))
        self.noise = noise_like(self.frames.transpose(0, 2, 1), random).transpose(0, 2, 1)
        rows = views(start)
        depth = np.linalg.norm(rows[0, 3:6] - rows[0, :3])
        fan = math.atan((0.5 + REACH) * shape[1] * np.linalg.norm(rows[0, 6:9]) / depth)
        azimuth = np.arctan2(rows[:, 1], rows[:, 0])
        behind = np.abs((azimuth - azimuth[:, None]) % (2 * np.pi) - np.pi) < 2 * fan
        pairs = np.argwhere(np.triu(behind, 1))
        self.pairs = pairs[:: -(-len(pairs) // MOST_PAIRS) or 1]
        half = MAX_LIFT_PX / math.tan(fan)
        self.lifts = np.unique([-half, 0.0, half] if len(frames[0]) > 1 else [0.0])
        if (count := int(self._places(start, self.pairs)[1].sum())) < FEWEST_PAIRS:
            around = np.sort(azimuth % (2 * np.pi))
            gap = float(np.diff(around, append=around[0] + 2 * np.pi).max())
            raise NotIdentifiableError(
                f"{count} pairs of views see a line from both ends (at least "
                f"{FEWEST_PAIRS}): the "
                f"views span {360 - math.degrees(gap):.4g} deg; half a turn and the fan, "
                f"{180 + math.degrees(2 * fan / (1 + 2 * REACH)):.4g} deg in small steps, or a "
                "full turn tell it"
            )

    def first(self) -> tuple[FloatArray, float]:
        """Find the start parameters with the axis column about which opposite rays agree
        best; columns within `REACH` of the start are tried.

        Returns:
            The parameters, and the ratio of the next best column's disagreement to its
            own; see `best_dip`.
        """
        cols = self.shape[1]
        level = _Level(self, cols / LEVELS[0])
        some = self.pairs[:: -(-len(self.pairs) // (MOST_PAIRS // 10))]
        half = int(2 * REACH * cols / level.sigma)
        step = level.sigma / 2 * np.eye(len(self.start))[0] * self.scales[0]
        tried = [self.start + k * step for k in range(-half, half + 1)]
        best, ratio = best_dip(np.array([level.disagreement(t, some) for t in tried]), 2)
        return tried[best], ratio

    def find(self, values: FloatArray) -> Symmetry:
        """Estimate the parameters (k,) from coarse to fine, each from the last converged.

        Returns the level with the least sigma of the first among the converged; else the
        first, not converged.
        """
        found = []
        for part in LEVELS:
            found.append(_Level(self, max(self.shape[1] / part, 1.0)).solve(values))
            if found[-1].converged:
                values = found[-1].values
        return min(found, key=lambda one: one.images[0] if one.converged else math.inf)

    def _places(
        self, values: FloatArray, pairs: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Locate the other's source in each view of pairs.

        Args:
            values: parameters, (k,).
            pairs: of views, (q, 2).

        Returns:
            Columns and rows (side, column and row, q) [px], and whether the columns are
            on both panels (q,); rows are not checked.
        """
        rows = self.views(values)
        out = np.empty((2, 2, len(pairs)))
        middle = (np.array(self.shape[::-1]) - 1) / 2
        for side in (0, 1):
            v = rows[pairs[:, side]]
            other = rows[pairs[:, 1 - side]]
            normal = np.cross(v[:, 6:9], v[:, 9:12])
            panel = v[:, 3:6] - v[:, :3]
            ray = other[:, :3] - v[:, :3]
            ray *= ((panel * normal).sum(axis=1) / (ray * normal).sum(axis=1))[:, None]
            for i, axis in enumerate((v[:, 6:9], v[:, 9:12])):
                out[side, i] = ((ray - panel) * axis).sum(axis=1) / np.square(axis).sum(
                    axis=1
                )
            out[side] += middle[:, None]
        inside = (out[:, 0] >= 0) & (out[:, 0] <= self.shape[1] - 1)
        return out, np.asarray(inside.all(axis=0))


class _Level:
    """One smoothing of the frames."""

    def __init__(self, rays: OppositeRays, sigma: float) -> None:
        self.rays = rays
        self.sigma = sigma
        self.images, self.alone = (self._soft(i) for i in (rays.frames, rays.noise))

    def _soft(self, images: Float32Array) -> FloatArray:
        """Compute spline coefficients of all images, smoothed by the level's sigma along rows
        and columns, stacked below each other with `EDGE_ROWS` mirrored rows on either side.

        `images`: (n, rows, cols).
        Returns (n (rows + 2 EDGE_ROWS), cols) float32."""
        soft = gaussian_filter(images, (0, self.sigma, self.sigma))
        for axis in (1, 2):
            soft = spline_filter1d(soft, axis=axis, output=np.float32)
        soft = np.pad(soft, ((0, 0), (EDGE_ROWS, EDGE_ROWS), (0, 0)), "reflect")
        return soft.reshape(-1, soft.shape[2])

    def read(
        self, image: FloatArray, places: FloatArray, pairs: npt.NDArray[np.intp]
    ) -> FloatArray:
        """Read values of both views of pairs (q, 2) by cubic splines, (2, q, lifts).

        Rows off the band take its edge; `lifts` are rows higher. `image`: coefficients,
        views one above the other; `places`: (side, column and row, q) [px].
        """
        rows = self.rays.frames.shape[1]
        row = places[:, 1, :, None] + self.rays.lifts - self.rays.top
        row = (
            np.clip(row, 0, rows - 1)
            + EDGE_ROWS
            + pairs.T[:, :, None] * (rows + 2 * EDGE_ROWS)
        )
        column = np.broadcast_to(places[:, 0, :, None], row.shape)
        return read_spline(image, np.stack([column, row]))

    def disagreement(self, values: FloatArray, pairs: npt.NDArray[np.intp]) -> float:
        """Compute the mean square of the differences of both ends over the variance of the
        values; infinite for fewer than half of `FEWEST_PAIRS` rays.

        `values`: parameters, (k,). `pairs`: of views, (q, 2); those off the panel do not count.
        """
        places, inside = self.rays._places(values, pairs)
        if inside.sum() < FEWEST_PAIRS // 2:
            return math.inf
        both = self.read(self.images, places[:, :, inside], pairs[inside])
        return float(np.square(both[0] - both[1]).mean() / max(both.var(), 1e-30))

    def solve(self, start: FloatArray) -> Symmetry:
        """Find the root of the estimating equation, with the priors as observations.

        Stops after `ROUNDS`, at a step of the first parameter well below its sigma
        (converged), with fewer than `FEWEST_PAIRS` pairs, too little signal
        (`MIN_SIGNAL_RATIO`), or values that are not finite.

        Args:
            start: of the parameters, (k,); not changed.

        Returns:
            The last estimate; not converged, with infinite covariance if no step was
            made.
        """
        rays = self.rays
        values = start.copy()
        k = len(start)
        found = Symmetry(
            values, np.full((k, k), np.inf), np.full(k, np.inf), math.inf, False
        )
        for _ in range(ROUNDS):
            inside = rays._places(values, rays.pairs)[1]
            if inside.sum() < FEWEST_PAIRS:
                break
            pairs = rays.pairs[inside]
            rest, slopes, noise, noisy, w = self._equations(values, pairs)
            alone = (noisy * w) @ noisy.T
            information = (slopes * w) @ slopes.T - alone
            if not information[0, 0] > MIN_SIGNAL_RATIO * alone[0, 0]:
                break
            score = (slopes * w) @ rest
            scatter = self._scatter(slopes * w, rest, pairs, values)
            kappa = scatter[0, 0] / information[0, 0]
            inverse = np.linalg.inv(information + kappa * rays.known)
            step = -inverse @ (score + kappa * rays.known @ (values - rays.start))
            covariance = inverse @ (scatter + kappa**2 * rays.known) @ inverse
            mismatch = self._mismatch(
                slopes[0], np.square(rest) - np.square(noise), w, pairs, values
            )
            covariance[0, 0] += (mismatch * inverse[0, 0]) ** 2
            longest = float(np.abs(step / rays.scales).max())
            values = values + step * min(1.0, 4.0 * self.sigma / max(longest, 1e-30))
            sigmas = np.sqrt(np.abs(np.diag(covariance)))
            # Noise comes to more by chance, of few views the most.
            chance = 1.0 + 3.0 * math.sqrt(2.0 / len(rays.frames))
            power = float((w * (np.square(rest) - chance * np.square(noise))).sum())
            done = bool((np.abs(step) <= 0.05 * sigmas + 1e-5 * rays.scales)[0])
            asymmetry = math.sqrt(max(power, 0.0) / self.structure)
            found = Symmetry(values, covariance, sigmas, asymmetry, done)
            if done or not np.isfinite(values).all():
                break
        return found

    def _equations(
        self, values: FloatArray, pairs: npt.NDArray[np.intp]
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Compute differences and slopes of pairs, and those of noise, weighted by photon
        counts.

        Odd polynomials across the panel are taken out. Sets `structure`, the weighted
        squares of the values about their mean.

        Args:
            values: parameters, (k,).
            pairs: of views, (q, 2).

        Returns:
            Differences (m,) and their slopes (k, m), both of noise alone, and weights
            (m,).
        """
        places = self.rays._places(values, pairs)[0]
        both = self.read(self.images, places, pairs).reshape(2, -1)
        w = 1.0 / np.exp(np.minimum(both, DARKEST)).sum(axis=0)
        x = (places[:, 0] / self.rays.shape[1] - 0.5)[:, :, None] + 0.0 * self.rays.lifts
        odd = np.stack([(x[0] ** i - x[1] ** i).ravel() for i in (1, 3)])
        to_odd = np.linalg.pinv((odd * w) @ odd.T) @ (odd * w)

        def freed(lines: FloatArray) -> FloatArray:
            return np.asarray(lines - (lines @ to_odd.T) @ odd)

        def difference(image: FloatArray, where: FloatArray) -> FloatArray:
            return np.asarray(-np.diff(self.read(image, where, pairs), axis=0).ravel())

        slopes = np.empty((2, len(values), both.shape[1]))
        for i, e in enumerate(np.diag(0.25 * self.rays.scales * (1.0 + self.sigma))):
            ends = [self.rays._places(values + s * e, pairs)[0] for s in (1, -1)]
            for which, image in enumerate((self.images, self.alone)):
                low, high = (difference(image, end) for end in ends)
                slopes[which, i] = (low - high) / (2.0 * e[i])
        self.structure = max(
            float((w * np.square(both - np.average(both))).sum()) / 2, 1e-30
        )
        rest = freed(both[0] - both[1])
        noise = freed(difference(self.alone, places))
        return rest, freed(slopes[0]), noise, freed(slopes[1]), w

    def _mismatch(
        self,
        slope: FloatArray,
        excess: FloatArray,
        w: FloatArray,
        pairs: npt.NDArray[np.intp],
        values: FloatArray,
    ) -> float:
        """Bound the sum of slopes times differences that are no noise.

        In phase within a patch (Cauchy-Schwarz), at random between them; a patch is
        `PATCH` sigmas of both columns' distance by a sector.
        `excess`: squares of differences less noise's, (m,); noise alone gives as many
        negative.
        """
        column = self.rays._places(values, pairs)[0][:, 0]
        near = ((column[0] - column[1]) / (PATCH * self.sigma)).astype(np.intp)
        sector = pairs[:, 0] * SECTORS // len(self.rays.frames)
        patch = (near - near.min()) * SECTORS + sector
        power, own = (
            np.bincount(patch, (w * one).reshape(len(pairs), -1).sum(axis=1))
            for one in (excess, np.square(slope))
        )
        return math.sqrt(max(float((own * power).sum()), 0.0))

    def _scatter(
        self,
        slopes: FloatArray,
        rest: FloatArray,
        pairs: npt.NDArray[np.intp],
        values: FloatArray,
    ) -> FloatArray:
        """Compute the covariance of sums over all rays of slopes times differences: from
        the scatter of pairs, widened where distances or frames scatter more, and the
        noise of the flat field, which all frames share.

        Args:
            slopes: weighted, (k, m).
            rest: differences, (m,).
            pairs: of views, (q, 2).
            values: parameters, (k,).

        Returns:
            (k, k).
        """
        rays = self.rays
        of_pairs = (len(slopes), len(pairs), -1)
        columns = rays._places(values, pairs)[0][:, 0]
        sums = (slopes * rest).reshape(of_pairs).sum(axis=2)
        own = sums - sums.mean(axis=1, keepdims=True)
        near = (np.abs(columns[0] - columns[1]) / (6.0 * self.sigma)).astype(np.intp)
        wide = np.square([np.bincount(near, part) for part in own]).sum(axis=1)
        wide = np.maximum(wide, np.square(spread(sums, pairs, len(rays.frames))))
        covariance = own @ own.T
        wider = np.sqrt(np.maximum(wide / np.maximum(np.diag(covariance), 1e-300), 1.0))
        change = np.square(np.diff(rays.frames.mean(axis=0), 2, axis=1)) / 6
        power = float(np.median(change)) / MEDIAN_OF_CHI_SQUARE
        power /= max(1.0, 2.0 * math.sqrt(math.pi) * self.sigma * (len(change) > 1))
        ends = columns.round().astype(np.intp)
        size = rays.shape[1]
        of_columns = [
            np.bincount(ends[0], part, size) - np.bincount(ends[1], part, size)
            for part in slopes.reshape(of_pairs).sum(axis=2)
        ]
        rings = gaussian_filter(np.stack(of_columns), (0, self.sigma))
        return np.asarray(covariance * np.outer(wider, wider) + power * (rings @ rings.T))
