"""Planes through the sources of two views: both see the same integral of the object there.

In a plane through two sources, at the distance y from the line that joins them, each of the two
fans of rays gives the integral of f / y over the plane, if the object is all on one side of that
line and both panels see all of it (fan-beam moment of order zero, Clackdoyle and Desbat, Med. Phys.
40 (2013) 091903; Lesaint et al., IEEE Trans. Radiat. Plasma Med. Sci. 2 (2018) 10). That holds of
any object and needs no volume.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.trajectory import Circle

PLANES: Final = 7
"""Planes through a pair of sources."""
PARTS: Final = (0.5, 1.0)
"""Distances of the two views, over the largest that is possible."""
LEAST_ANGLE: Final = 0.43
"""Least angle between rays through the object and the line of the sources [rad]: weights
grow without limit towards it (assumed)."""
SHADOW_SHARE: Final = 0.02
"""Share of the largest line integrals above which a pixel is in the object's shadow."""
FEWEST_PAIRS: Final = 8
"""Fewest pairs of a scan that say anything."""
ROUNDING: Final = 0.29
"""Standard deviation of a rounded number, in steps: how far linear interpolation may be off
at a jump between two samples."""
NEIGHBOURS: Final = 5
"""Neighbouring pairs over which the error of sampling is averaged."""


@dataclass(frozen=True, eq=False)
class Condition:
    """Pairs of numbers that agree where images and geometry are right.

    Attributes:
        first, second: (m,) the numbers.
        variance: (m,) of their difference by noise and sampling.
        views: (m, 2) from which they are.
        scale: size of such numbers, by which differences become relative.
    """

    first: FloatArray
    second: FloatArray
    variance: FloatArray
    views: npt.NDArray[np.intp]
    scale: float


@dataclass(frozen=True, eq=False)
class ViewPairs:
    """Pairs of views of a scan, and planes through their sources.

    Attributes:
        centre: (x, y) of the rotation axis [mm].
        pairs: (p, 2) views.
        slopes: (q,) angles of the planes against the line from the sources to the axis [rad].
        edges: (n, 2) first and last column of each view's shadow.
        seen: (p, q) planes in which both panels see all of the shadow.
        margin: rows at the ends of columns that are left out.
    """

    centre: FloatArray
    pairs: npt.NDArray[np.intp]
    slopes: FloatArray
    edges: npt.NDArray[np.intp]
    seen: npt.NDArray[np.bool_]
    margin: float = 0.0

    @classmethod
    def of(
        cls, images: Float32Array, cone_vec: ConeVec, circle: Circle, blur: float = 0.0
    ) -> ViewPairs | None:
        """Choose the pairs and planes.

        Args:
            images: (n, rows, cols) line integrals.
            cone_vec: n views.
            circle: on which they are.
            blur: standard deviation of their smoothing along columns, which changes the
                ends of those that an object crosses [pixels].

        Returns:
            None where fewer than `FEWEST_PAIRS` pairs see the object.
        """
        rows = images.shape[1]
        edges = _shadow_edges(images)
        half = _half_angle(cone_vec, circle.centre, edges, images.shape[2])
        whole = (edges[:, 0] > 0) & (edges[:, 1] < images.shape[2] - 1)
        pairs = _pairs(cone_vec, circle, 0.5 * np.pi - LEAST_ANGLE - half)
        pairs = pairs[whole[pairs].all(axis=1)]
        if len(pairs) < FEWEST_PAIRS:
            return None
        away = np.linalg.norm(cone_vec.detector - cone_vec.source, axis=1).mean()
        ends = np.abs(images[:, [0, -1]]).mean() > SHADOW_SHARE * np.abs(images).mean()
        margin = min(3.0 * blur, 0.3 * rows) if ends else 0.0
        tall = (0.5 * (rows - 1) - margin) * np.linalg.norm(cone_vec.v, axis=1).mean()
        slopes = np.zeros(1)
        if rows > 2:
            slopes = np.arctan(0.95 * tall / away * np.linspace(-1.0, 1.0, PLANES))
        blank = np.ones((len(pairs), len(slopes)), bool)
        made = cls(circle.centre, pairs, slopes, edges, blank, margin)
        seen = np.logical_and(
            *(made._lines(cone_vec, cone_vec, side, images.shape)[3] for side in (0, 1))
        )
        if seen.any(axis=1).sum() < FEWEST_PAIRS:
            return None
        return cls(circle.centre, pairs, slopes, edges, seen, margin)

    @property
    def views(self) -> npt.NDArray[np.intp]:
        """Views of each number, (m, 2)."""
        return np.repeat(self.pairs, self.seen.sum(axis=1), axis=0)

    def sides(
        self, images: Float32Array, first: ConeVec, second: ConeVec
    ) -> tuple[FloatArray, FloatArray]:
        """Integrate the planes in the first and in the second view of each pair.

        `images`: (n, rows, cols); `first`: n views, as the first of a pair; `second`: the same
        as the second of a pair.
        Returns (m,) each, of the planes that both see.
        """
        found = []
        for side in (0, 1):
            rows, weights, _, _ = self._lines(first, second, side, images.shape)
            low, share = _split(rows, images.shape[1])
            values = _interpolated(images, self.pairs[:, side], low, share)
            found.append((values * weights).sum(axis=-1)[self.seen])
        return found[0], found[1]

    def condition(
        self,
        images: Float32Array,
        cone_vec: ConeVec,
        noise: float,
        sampled: Float32Array | None = None,
    ) -> Condition:
        """Integrate the planes, with the variance of the two integrals' difference.

        Besides noise it is measured in the images: by the difference of even and odd columns,
        which has the error of sampling, and by the bend between rows, where linear
        interpolation is off.

        Args:
            images: (n, rows, cols).
            cone_vec: n views.
            sampled: the images before they were smoothed along rows, which leaves the error of
                sampling in a row's sum, and hides it from even and odd columns.
            noise: variance of a line's sum for weights whose squares sum to 1.
        """
        variance = np.zeros(self.seen.shape)
        numbers = []
        for side in (0, 1):
            rows, weights, _, _ = self._lines(cone_vec, cone_vec, side, images.shape)
            low, share = _split(rows, images.shape[1])
            views = self.pairs[:, side]
            terms = _interpolated(images, views, low, share) * weights
            numbers.append(terms.sum(axis=-1)[self.seen])
            signs = 1.0 - 2.0 * (np.arange(images.shape[2]) % 2)
            if sampled is not None:
                terms = _interpolated(sampled, views, low, share) * weights
            apart = _about(np.square((terms * signs).sum(axis=-1)))
            # Even and odd columns differ by their noise, too.
            variance += np.maximum(apart, noise * np.square(weights).sum(axis=-1))
            if images.shape[1] > 2:
                bend = (_bend(images, views, low, share) * weights).sum(axis=-1)
                variance += np.square(ROUNDING * bend)
        scale = float(np.abs(numbers[0]).mean())
        least = np.square(np.finfo(np.float32).eps * 100.0 * max(scale, 1e-30))
        found = variance[self.seen] + least
        return Condition(numbers[0], numbers[1], found, self.views, scale)

    def _lines(
        self, first: ConeVec, second: ConeVec, side: int, shape: tuple[int, ...]
    ) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """Find where the planes cross the panels of one view of each pair.

        Args:
            first, second: see `sides`.
            side: 0 for the first view of a pair, 1 for the second.
            shape: of the images.

        Returns:
            Row at each column (p, q, cols); weights of the pixels there, 0 beyond the
            panel; the rays' slopes towards the line of the sources; and whether the panel
            sees all of the shadow, (p, q).
        """
        one, other = self.pairs.T
        here, there = first.source[one], second.source[other]
        along = _unit(there - here)
        middle = 0.5 * (here + there)
        axis = np.column_stack([np.tile(self.centre, (len(one), 1)), middle[:, 2]])
        ahead = axis - middle
        ahead = _unit(ahead - (ahead * along).sum(axis=1)[:, None] * along)
        up = np.cross(along, ahead)
        up *= np.sign(up[:, 2:])
        cos, sin = (
            part[None, :, None] for part in (np.cos(self.slopes), np.sin(self.slopes))
        )
        towards = cos * ahead[:, None] + sin * up[:, None]
        normal = cos * up[:, None] - sin * ahead[:, None]
        views, k = ((first, one), (second, other))[side]
        panel, u, v = (views.detector - views.source)[k], views.u[k], views.v[k]

        def dot(direction: FloatArray, vectors: FloatArray) -> FloatArray:
            return np.asarray(np.einsum("pqk,pk->pq", direction, vectors))

        _, height, width = shape
        place = np.arange(width) - 0.5 * (width - 1)
        fall = dot(normal, v)
        start, slope = -dot(normal, panel) / fall, -dot(normal, u) / fall
        parts = []
        for direction in (towards, np.broadcast_to(along[:, None], towards.shape)):
            down = dot(direction, v)
            parts.append(
                (dot(direction, panel) + start * down, dot(direction, u) + slope * down)
            )
        (e0, e1), (b0, b1) = parts
        rows = start[..., None] + slope[..., None] * place + 0.5 * (height - 1)
        away = np.maximum(e0[..., None] + e1[..., None] * place, 1e-9)
        beside = b0[..., None] + b1[..., None] * place
        flat = np.abs(beside) > away / np.tan(0.5 * LEAST_ANGLE)
        weights = np.abs(b1 * e0 - b0 * e1)[..., None] / (away * np.hypot(away, beside))
        margin = self.margin - 1e-6 * height
        there_are = (rows >= margin) & (rows <= height - 1 - margin) & ~flat
        columns = np.arange(width)
        low, high = self.edges[k].T[:, :, None]
        shadow = ((columns >= low) & (columns <= high))[:, None, :]
        seen = (there_are | ~shadow).all(axis=-1)
        return rows, weights * there_are, beside / away, seen


def _shadow_edges(images: Float32Array) -> npt.NDArray[np.intp]:
    """Find the first and last column of each view's shadow, (n, 2)."""
    columns = images.shape[2]
    most = images.max(axis=1)
    if images.shape[1] > 2:  # not of a single bad pixel
        most = np.sort(images, axis=1)[:, -2]
    there = most > SHADOW_SHARE * float(np.percentile(most, 99.0))
    number = np.arange(columns)
    first = np.where(there, number, columns - 1).min(axis=1)
    last = np.where(there, number, 0).max(axis=1)
    return np.stack([first, np.maximum(last, first)], axis=1)


def _half_angle(
    cone_vec: ConeVec, centre: FloatArray, edges: npt.NDArray[np.intp], columns: int
) -> float:
    """Compute the largest angle between a shadow's edge and the axis, in nearly all views
    [rad]."""
    ahead = centre - cone_vec.source[:, :2]
    found = []
    for column in edges.T:
        ray = cone_vec.detector - cone_vec.source
        ray = ray + (column - 0.5 * (columns - 1))[:, None] * cone_vec.u
        cross = ahead[:, 0] * ray[:, 1] - ahead[:, 1] * ray[:, 0]
        found.append(np.abs(np.arctan2(cross, (ahead * ray[:, :2]).sum(axis=1))))
    return float(np.percentile(np.max(found, axis=0), 98.0))


def _pairs(cone_vec: ConeVec, circle: Circle, most: float) -> npt.NDArray[np.intp]:
    """Pair each view with those at `PARTS` of twice an angle [rad] along the circle.

    Of a helix the partner is within half a turn.
    """
    place = cone_vec.source[:, :2] - circle.centre
    azimuth = np.arctan2(place[:, 1], place[:, 0])
    count = len(azimuth)
    number = np.arange(count)
    found = [np.zeros((0, 2), np.intp)]
    for part in PARTS if most > 0.0 else ():
        apart = 2.0 * part * most
        off = azimuth[None, :] - azimuth[:, None] - apart
        off = np.abs((off + np.pi) % (2.0 * np.pi) - np.pi)
        if circle.rise:
            turn = count * 2.0 * np.pi / max(float(np.ptp(circle.angle)), 1e-9)
            off = off + 10.0 * (np.abs(number[None, :] - number[:, None]) > 0.5 * turn)
        partner = off.argmin(axis=1)
        near = off[number, partner] < 0.1 * apart
        found.append(np.column_stack([number, partner])[near])
    return np.concatenate(found)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _split(rows: FloatArray, count: int) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Return the row above each place, and the share of the one below."""
    at = np.clip(rows, 0.0, count - 1.0)
    low = np.minimum(at.astype(np.intp), max(count - 2, 0))
    return low, at - low


def _interpolated(
    images: Float32Array,
    views: npt.NDArray[np.intp],
    low: npt.NDArray[np.intp],
    share: FloatArray,
) -> FloatArray:
    """Interpolate images between rows, (p, q, cols)."""
    view = views[:, None, None]
    column = np.arange(images.shape[2])
    below = np.minimum(low + 1, images.shape[1] - 1)
    upper, lower = images[view, low, column], images[view, below, column]
    return np.asarray(upper + share * (lower - upper), np.float64)


def sampling_error(images: Float32Array, noise: float) -> FloatArray:
    """Compute standard deviations (n, rows, cols) of pixels that stand for what lies
    between.

    A jump bends two pixels, one of them off by `ROUNDING`. `noise`: a pixel's variance,
    whose second differences are no bends.
    """
    squares = np.zeros(images.shape)
    squares[:, :, 1:-1] += np.square(np.diff(images, n=2, axis=2)) - 6.0 * noise
    if images.shape[1] > 2:
        squares[:, 1:-1] += np.square(np.diff(images, n=2, axis=1)) - 6.0 * noise
    return ROUNDING * np.sqrt(np.maximum(0.5 * squares, 0.0))


def _bend(
    images: Float32Array,
    views: npt.NDArray[np.intp],
    low: npt.NDArray[np.intp],
    share: FloatArray,
) -> FloatArray:
    """Interpolate the second differences between rows, (p, q, cols)."""
    bends = np.zeros_like(images)
    bends[:, 1:-1] = images[:, 2:] - 2.0 * images[:, 1:-1] + images[:, :-2]
    return _interpolated(bends, views, low, share)


def _about(values: FloatArray) -> FloatArray:
    """Average over `NEIGHBOURS` neighboring pairs."""
    from scipy.ndimage import uniform_filter1d

    return np.asarray(uniform_filter1d(values, NEIGHBOURS, axis=0, mode="nearest"))
