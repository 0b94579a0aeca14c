"""Agreement of pairs of views on integrals over planes through both their sources.

The integrals are those of `plane_kernels.py`. Errors are only assumed to be independent
between frames, distances between views, and heights far apart: the uncertainty of a sum
of squares follows from the scatter of its parts. `source_row.py` and `frame_shifts.py`
derive the row of the plane in which the source turns, and shifts of single frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.ndimage import gaussian_filter

from flexdt.twin.calibration.without_phantom.plane_kernels import sum_planes
from flexdt.twin.calibration.without_phantom.turn import DARKEST, MEDIAN_OF_CHI_SQUARE
from flexdt.twin.dataset.normalise import binned_mean
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

Views = Callable[[FloatArray], ConeVec]
"""The panel's height [px], and doubtful parameters, to all views; the axis at the origin."""

PAIR_DISTANCES: Final = (0.2, 0.3, 0.38, 0.43, 0.455, 0.47, 0.48)
"""Distances of the two views of a pair, in turns."""
MIN_CLEARANCE: Final = 1.05
"""Least distance of the line through two sources from the axis, relative to the object's
radius."""
MAX_AIR_SHARE: Final = 0.005
"""Largest share of the mean's largest value that counts as air (assumed)."""
AIR_SIGMAS: Final = 7.0
"""Standard deviations of the mean's noise above which it is no air."""
LEVELS: Final = ((1, 0), (2, 0), (4, 0), (1, 8), (2, 8), (4, 8), (2, 20), (4, 20))
"""Bins of planes, and degrees between pairs, whose differences are added before they are
squared."""
ROWS_PER_BIN: Final = 2
"""Rows to a bin."""
FEWEST_BINS: Final = 4
"""Least number of complete bins of a pair that counts."""
FEWEST_PAIRS: Final = 0.25
"""Share of the pairs that count, at least (assumed)."""
SECTORS: Final = 18
"""Number of sectors of the turn whose sums are compared."""
BLOCKS: Final = 12
"""Number of blocks of heights whose sums are compared."""


class PlanePairs:
    """Pairs of views, and the planes that both see as far as the object reaches.

    Args:
        frames: line integrals (n, rows, cols), sorted by angle, binned by `factor`.
        mean: over the turn, not binned.
        factor: of the binning.
        views: to the geometry of the frames as they were before.
        start: the arguments of `views` about which others are tried.

    Raises:
        NotIdentifiableError: no two views have sources whose connection is clear of the object.
    """

    def __init__(
        self,
        frames: Float32Array,
        mean: FloatArray,
        factor: int,
        views: Views,
        start: FloatArray,
    ) -> None:
        """List pairs of views whose sources' connection is clear of the object, and the
        bins of planes through it.

        Args:
            frames: (n, rows, cols) line integrals, binned, sorted by angle.
            mean: image over the turn, not binned.
            factor: of the binning.
            views: geometry of parameters.
            start: (p,) parameters to start from.

        Raises:
            NotIdentifiableError: the object reaches so far that fewer than n pairs are
                clear of it, it reaches beyond the panel in the planes of more than 1 -
                `FEWEST_PAIRS` of them, or there is nothing but air.
        """
        self.shape = mean.shape
        self.factor = factor
        self.views = views
        self.start = start
        n, rows, cols = frames.shape
        self.sums = np.zeros((n, cols, rows + 1), dtype=np.float32)
        np.cumsum(frames.transpose(0, 2, 1), axis=2, out=self.sums[:, :, 1:])
        here = self.rows(start)
        radius, border = _support(frames, binned_mean(mean, factor), here[0])
        table = np.array(
            [(i, (i + round(part * n)) % n) for part in PAIR_DISTANCES for i in range(n)]
        )
        kind = np.repeat(np.arange(len(PAIR_DISTANCES)), n)
        sources = here[:, :2]
        along = sources[table[:, 1]] - sources[table[:, 0]]
        along /= np.linalg.norm(along, axis=1)[:, None]
        inwards = np.column_stack([-along[:, 1], along[:, 0]])
        away = -(inwards * sources[table[:, 0]]).sum(axis=1)
        clear = np.abs(away) > MIN_CLEARANCE * radius
        if clear.sum() < n:
            raise NotIdentifiableError(
                f"the object reaches {radius:.4g} mm from the axis, the source is "
                f"{np.hypot(*sources[0]):.4g} mm away: hardly two views have sources whose "
                "connection is clear of it"
            )
        self.pairs = table[clear]
        kind = kind[clear]
        self.away = np.abs(away[clear])
        self.inwards = inwards[clear] * np.sign(away[clear])[:, None]
        # First pair of each distance, and every pair's place behind it.
        self.starts = np.flatnonzero(np.diff(kind, prepend=-1))
        self.sizes = np.diff(self.starts, append=len(kind))
        self.place = np.arange(len(kind)) - np.repeat(self.starts, self.sizes)
        at = np.arange(0, rows + 1, ROWS_PER_BIN) - rows / 2
        to = here[0, 3:6] - here[0, :3] + at[:, None] * here[0, 9:12]
        flat = here[0, :2]
        self.heights = np.sort(-to[:, 2] / (to[:, :2] @ flat) * (flat @ flat))
        self.columns = _columns(here, cols, radius)
        self.valid = self._valid(here, border)
        whole = float((self.valid.sum(axis=1) >= FEWEST_BINS).mean())
        if whole < FEWEST_PAIRS:
            raise NotIdentifiableError(
                f"the object reaches beyond the panel: {100 * whole:.0f} % of pairs "
                "of views have planes through both sources that they see whole (at "
                f"least {100 * FEWEST_PAIRS:.0f} %)"
            )
        # First pair of each group of a level, and its bins that are valid in all of its pairs.
        self.groups = []
        for bins, degrees in LEVELS:
            near = max(1, round(degrees / 360 * n))
            first = np.flatnonzero(self.place % near == 0)
            unseen = np.add.reduceat(_widened(~self.valid, bins), first, axis=0)
            self.groups.append((first, unseen == 0))
        ends = [self.rows(start + s * np.eye(len(start))[0])[0] for s in (1, -1)]
        magnified = np.hypot(*(here[0, 3:5] - flat)) / np.hypot(*flat)
        # What a row sees at the axis rises so far with the panel's height [mm/px].
        self.rise = float(ends[0][5] - ends[1][5]) / 2 / float(magnified)

    def rows(self, at: FloatArray) -> FloatArray:
        """Return the views of the binned frames, (n, 12)."""
        return np.ascontiguousarray(self.views(at).binned(self.factor, self.shape).rows)

    def integrals(
        self,
        at: FloatArray,
        rows: FloatArray | None = None,
        sums: Float32Array | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Compute integrals of both views of each pair over bins of planes.

        Args:
            at: arguments of `views`; the planes rise with the panel's height.
            rows: views to use instead, (n, 12).
            sums: of other images, laid out as `self.sums`.

        Returns:
            Integrals (q, 2, k), and those of 1, the mean of both views, (q, k).
        """
        edges = (self.heights + self.rise * (at[0] - self.start[0])) / self.away[:, None]
        found, ones = np.zeros((2, len(self.pairs), 2, edges.shape[1] - 1))
        if rows is None:
            given = self.rows(at)
        else:
            given = np.ascontiguousarray(rows)
        images = self.sums if sums is None else sums
        sum_planes(
            images, given, self.pairs, self.inwards, edges, self.columns, found, ones
        )
        return found, ones.mean(axis=1)

    def costs(self, at: FloatArray, sums: Float32Array | None = None) -> FloatArray:
        """Compute sums of squared differences between both views, without offsets common
        to all bins (air that is not 0) or to all pairs as far apart (the flat image's
        noise); bins that are not valid do not count.

        Each coarser level adds up neighboring bins and pairs before it squares, and gives
        each pair the mean of its group. A group counts only its bins that are valid in all
        of its pairs, and is 0 with fewer than `FEWEST_BINS` of them.

        Args:
            at: arguments of `views`.
            sums: of other images, laid out as `self.sums`.

        Returns:
            For each of `LEVELS`, of each pair and then of each distance and block of
            heights, (levels, q + distances * BLOCKS).
        """
        found, ones = self.integrals(at, sums=sums)
        rest = self._own(found[:, 0] - found[:, 1])
        pairs = np.zeros((len(LEVELS), len(rest)))
        blocks = np.zeros((len(LEVELS), len(self.starts), BLOCKS))
        wide = {bins: (_widened(rest, bins), _widened(ones, bins)) for bins, _ in LEVELS}
        for i, (bins, _) in enumerate(LEVELS):
            first, seen = self.groups[i]
            size = np.diff(first, append=len(rest))
            k = seen.shape[1]
            r, c = (np.add.reduceat(a, first, axis=0) for a in wide[bins])
            square = np.square(without(c, r * seen, seen))
            pairs[i] = np.repeat(square.sum(axis=1) / size, size)
            of_kind = np.add.reduceat(square, np.searchsorted(first, self.starts), axis=0)
            blocks[i] = np.add.reduceat(of_kind, np.arange(BLOCKS) * k // BLOCKS, axis=1)
        return np.hstack([pairs, blocks.reshape(len(LEVELS), -1)])

    def _own(self, rest: FloatArray) -> FloatArray:
        """Subtract from pairs' differences (q, k) the mean over all pairs as far apart.

        So what stays on the panel is lost; planes of a body of revolution agree at any
        height.
        """
        total = np.add.reduceat(rest * self.valid, self.starts, axis=0)
        count = np.add.reduceat(self.valid, self.starts, axis=0, dtype=np.intp)
        return rest - np.repeat(total / np.maximum(count, 1), self.sizes, axis=0)

    def scales(self, costs: FloatArray) -> FloatArray:
        """Compute 1 / usual cost of pairs as far apart as each one, laid out as `costs`;
        0 where that cost is 0.

        Args:
            costs: of `costs`.
        """
        pairs = costs[:, : len(self.pairs)]
        usual = np.add.reduceat(pairs, self.starts, axis=1) / self.sizes
        scale = np.where(usual > 0, 1.0 / np.maximum(usual, 1e-300), 0.0)
        return np.hstack(
            [np.repeat(scale, self.sizes, axis=1), np.repeat(scale, BLOCKS, axis=1)]
        )

    def total(self, parts: FloatArray) -> FloatArray:
        """Sum parts, laid out as `costs`, over the pairs."""
        return np.asarray(parts[..., : len(self.pairs)].sum(axis=-1))

    def blocks(self, parts: FloatArray) -> FloatArray:
        """Return the part of `costs` after the pairs, (..., distances, BLOCKS)."""
        return parts[..., len(self.pairs) :].reshape(*parts.shape[:-1], -1, BLOCKS)

    def spread(self, parts: FloatArray, blocks: bool = False) -> FloatArray:
        """Estimate standard deviations of `total`; the widest of the estimates counts.

        Args:
            parts: (..., q + distances * BLOCKS).
            blocks: whether sums over heights and over distances count too, not only those
                over frames and sectors.

        Returns:
            (...).
        """
        worst = np.square(
            spread(parts[..., : len(self.pairs)], self.pairs, len(self.sums))
        )
        if blocks:
            for axis in (-2, -1):
                squares = np.square(self.blocks(parts).sum(axis=axis))
                total = squares.sum(axis=-1)
                # Where one or two blocks have it all, their scatter is hardly known.
                count = total**2 / np.maximum(np.square(squares).sum(axis=-1), 1e-300)
                worst = np.maximum(worst, total * count / np.maximum(count - 1.0, 0.25))
        return np.asarray(np.sqrt(worst))

    def noise(self, random: np.random.Generator) -> Float32Array:
        """Draw images of noise like the frames', summed down columns as `sums`."""
        out = np.zeros_like(self.sums)
        np.cumsum(
            noise_like(np.diff(self.sums, axis=2), random), axis=2, out=out[:, :, 1:]
        )
        return out

    def _valid(
        self, here: FloatArray, border: tuple[FloatArray, FloatArray, FloatArray]
    ) -> npt.NDArray[np.bool_]:
        """Mark bins of planes that leave the panel of neither view within the object,
        with two bins to spare.

        Args:
            here: (n, 12) views.
            border: places at the object's upper end, lower end and sides, see `_support`;
                empty where the object ends on the panel.

        Returns:
            (q, k) bool.
        """
        edges = self.heights
        step = float(np.diff(self.heights).mean())
        valid = np.ones((len(self.pairs), len(edges) - 1), dtype=bool)
        upper, lower, sides = border
        upwards = -float(np.sign(here[0, 11]))
        for v in (here[self.pairs[:, 0]], here[self.pairs[:, 1]]):

            def heights(at: FloatArray, v: FloatArray = v) -> FloatArray:
                """Compute dz over the distance inwards, times `away`, of rays from each source
                to points on its panel. `at`: (k, 2) columns and rows from the panel's center;
                `v`: (q, 12) views. Returns (q, k) [mm]."""
                to = v[:, None, 3:6] - v[:, None, :3] + at[:, :1] * v[:, None, 6:9]
                to = to + at[:, 1:] * v[:, None, 9:12]
                inward = (to[..., :2] * self.inwards[:, None]).sum(axis=2)
                return np.asarray(to[..., 2] / inward * self.away[:, None])

            for places, up in ((upper, upwards), (lower, -upwards)):
                if len(places):
                    limit = (up * heights(places)).min(axis=1) - 2 * step
                    valid &= up * (edges[1:] if up > 0 else edges[:-1]) < limit[:, None]
            if len(sides):
                k = np.floor((heights(sides) - edges[0]) / step).astype(np.intp)
                q = np.broadcast_to(np.arange(len(k))[:, None], k.shape)
                for by in range(-2, 3):
                    inside = (k + by >= 0) & (k + by < valid.shape[1])
                    valid[q[inside], (k + by)[inside]] = False
        return valid


def _widened(of_bins: FloatArray | npt.NDArray[np.bool_], bins: int) -> FloatArray:
    """Sum up values of bins, (q, k), over so many neighbors each."""
    k = of_bins.shape[1] // bins
    return np.asarray(of_bins[:, : k * bins].reshape(len(of_bins), k, bins).sum(axis=2))


def noise_like(images: Float32Array, random: np.random.Generator) -> Float32Array:
    """Draw noise as large as that of line integrals (n, cols, rows).

    Its variance grows as exp(g), as of counted photons, up to `DARKEST`; its size is the
    median of second differences along the columns, so mostly of air.
    """
    power = np.exp(np.minimum(images, DARKEST))
    change = np.square(np.diff(images, 2, axis=1)) / 6
    size = math.sqrt(float(np.median(change / power[:, 1:-1])) / MEDIAN_OF_CHI_SQUARE)
    white = random.standard_normal(images.shape, dtype=np.float32)
    return np.asarray(size * np.sqrt(power) * white)


def spread(parts: FloatArray, pairs: npt.NDArray[np.intp], n: int) -> FloatArray:
    """Estimate standard deviations of sums over pairs of frames.

    Pairs that share a frame, or one of `SECTORS` sectors, are not independent: of squares of the
    sums over all that do, those that count pairs twice are taken away. The largest of three
    counts: independent pairs, frames, sectors.

    `parts`: (..., q) terms of the sums; `pairs`: (q, 2) frames of each term; `n`: number of
    frames.
    Returns (...) standard deviations.
    """
    own = parts - parts.mean(axis=-1, keepdims=True)
    worst = np.square(own).sum(axis=-1)
    for count in (SECTORS, n):
        low, high = np.sort(pairs * count // n, axis=1).T
        both = np.zeros((*own.shape[:-1], count, count))
        np.add.at(both, (..., low, high), own)  # type: ignore[arg-type]
        touched = both.sum(axis=-1) + both.sum(axis=-2)
        touched -= np.diagonal(both, axis1=-2, axis2=-1)
        twice = np.square(np.triu(both, 1)).sum(axis=(-1, -2))
        worst = np.maximum(worst, np.square(touched).sum(axis=-1) - twice)
    return np.asarray(np.sqrt(worst))


def without(
    part: FloatArray, whole: FloatArray, used: npt.NDArray[np.bool_] | None = None
) -> FloatArray:
    """Subtract from `whole`, where it is used, its part along `part`.

    `part`: (..., k). `whole`: (..., k). `used`: (..., k); None: all.
    Returns (..., k); 0 where not used, and for all with fewer than `FEWEST_BINS` used.
    """
    if used is not None:
        used = used & (used.sum(axis=-1) >= FEWEST_BINS)[..., None]
        part = part * used
        whole = whole * used
    share = (whole * part).sum(axis=-1) / np.maximum((part * part).sum(axis=-1), 1e-300)
    return np.asarray(whole - share[..., None] * part)


def _columns(here: FloatArray, cols: int, radius: float) -> npt.NDArray[np.intp]:
    """Determine the columns that the object can reach in each view.

    Args:
        here: (n, 12) cone_vec rows.
        cols: number of columns.
        radius: of the object about the axis [mm].

    Returns (n, 2) first column, and the one after the last; (0, cols) if it reaches none.
    """
    i = np.arange(cols) - (cols - 1) / 2
    x, y = (
        here[:, 3 + a, None] - here[:, a, None] + i * here[:, 6 + a, None] for a in (0, 1)
    )
    passing = np.abs(here[:, 0, None] * y - here[:, 1, None] * x) / np.hypot(x, y)
    reached = passing <= radius
    return np.stack(
        [reached.argmax(axis=1), cols - reached[:, ::-1].argmax(axis=1)], axis=1
    )


def _support(
    frames: Float32Array, mean: FloatArray, view: FloatArray
) -> tuple[float, tuple[FloatArray, FloatArray, FloatArray]]:
    """Measure the extent of the object, from the mean and from the frames' largest
    values: what is thin and far from the axis hardly shows in the mean.

    A pixel shows no air if it exceeds the rim's level by `MAX_AIR_SHARE` of the range or
    `AIR_SIGMAS` of noise.

    Args:
        frames: line integrals (n, rows, cols).
        mean: (rows, cols).
        view: (12,) of the first frame.

    Returns:
        Its radius about the axis [mm], and places (column, row) about the panel's center
        at its upper end, its lower end and its sides where the image shows no air at the
        panel's edge.

    Raises:
        NotIdentifiableError: the images show nothing but air.
    """
    rows, cols = mean.shape
    full = np.zeros((rows, cols), dtype=bool)
    # What is thin and far from the axis hardly shows in the mean.
    for images in (mean[None], frames):
        soft = gaussian_filter(images, (0.0, 2.0, 2.0), mode="nearest").max(axis=0)
        rim = np.concatenate([soft[0], soft[-1], soft[:, 0], soft[:, -1]])
        air = float(np.percentile(rim, 25))
        change = np.square(np.diff(images, 2, axis=2)) / 6
        white = float(np.median(change)) / MEDIAN_OF_CHI_SQUARE / (16 * math.pi)
        full |= soft > air + max(
            MAX_AIR_SHARE * (float(soft.max()) - air), AIR_SIGMAS * math.sqrt(white)
        )
    seen = np.flatnonzero(full.any(axis=0))
    if len(seen) == 0:
        raise NotIdentifiableError("the mean shows nothing but air")
    i = np.array([seen[0] - 0.5, seen[-1] + 0.5]) - (cols - 1) / 2
    x, y = (view[3 + a] - view[a] + i * view[6 + a] for a in (0, 1))
    radius = float((np.abs(view[0] * y - view[1] * x) / np.hypot(x, y)).max())

    def ends(line: npt.NDArray[np.bool_], beside: float, turned: int) -> FloatArray:
        """Of the pixels of an edge: places along it, and `beside`; (column, row) or turned."""
        at = np.flatnonzero(line) - (len(line) - 1) / 2
        at = np.concatenate([at - 0.5, at + 0.5])
        return np.roll(np.column_stack([at, np.full(len(at), beside)]), turned, axis=1)

    upper = ends(full[0], -rows / 2, 0)
    lower = ends(full[-1], rows / 2, 0)
    sides = np.vstack([ends(full[:, 0], -cols / 2, 1), ends(full[:, -1], cols / 2, 1)])
    return radius, (upper, lower, sides)
