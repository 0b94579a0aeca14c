"""Rays of the middle plane that two views see from opposite sides: their line integrals agree."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.trajectory import Circle
from flexdt.twin.reconstruction.consistency.view_pairs import (
    FEWEST_PAIRS,
    ROUNDING,
    Condition,
)

WIDEST_GAP: Final = 2.5
"""Largest step between two views, over the usual one, between which images are
interpolated."""


@dataclass(frozen=True, eq=False)
class OpposedRays:
    """Pixels of a circular scan, and the views that see their rays from the other side.

    Attributes:
        centre: (x, y) of the rotation axis [mm].
        views: (m,) views.
        columns: (m,) columns of their pixels.
        around: (m, 4) views about the place where the opposite ray begins, in order of
            azimuth; it is between the middle two.
        shape: of the images.
        margin: columns at the ends of rows that are left out.
    """

    centre: FloatArray
    views: npt.NDArray[np.intp]
    columns: npt.NDArray[np.intp]
    around: npt.NDArray[np.intp]
    shape: tuple[int, ...]
    margin: float = 1.0

    @classmethod
    def of(
        cls, images: Float32Array, cone_vec: ConeVec, circle: Circle, blur: float = 0.0
    ) -> OpposedRays | None:
        """Find the opposed rays; None for a helix, and where there are hardly any.

        Args:
            images: (n, rows, cols) line integrals.
            cone_vec: n views.
            circle: on which they are.
            blur: standard deviation of their smoothing, which changes the ends of rows that an
                object crosses [pixels].
        """
        if circle.rise:
            return None
        count, _, wide = images.shape
        views = np.repeat(np.arange(count), wide)
        columns = np.tile(np.arange(wide), count)
        blank = np.zeros((len(views), 4), np.intp)
        margin = max(1.0, 3.0 * blur)
        made = cls(circle.centre, views, columns, blank, images.shape, margin)
        azimuth = made._azimuths(cone_vec)
        order = np.argsort(azimuth)
        ray, _ = made._rays(cone_vec)
        at = made._opposite(cone_vec, ray)
        place = np.searchsorted(azimuth[order], at)
        around = order[(place[:, None] + np.arange(-2, 2)) % count]
        steps = np.diff(np.append(azimuth[order], azimuth[order[0]] + 2.0 * np.pi))
        gap = _turn(azimuth[around[:, 2]] - azimuth[around[:, 1]]) % (2.0 * np.pi)
        near = gap < WIDEST_GAP * float(np.median(steps))
        chosen = views[near], columns[near], around[near]
        made = cls(circle.centre, *chosen, images.shape, margin)
        seen = made._sampled(images, cone_vec, cone_vec)[3]
        if seen.sum() < FEWEST_PAIRS:
            return None
        kept = made.views[seen], made.columns[seen], made.around[seen]
        return cls(circle.centre, *kept, images.shape, margin)

    def sides(
        self, images: Float32Array, first: ConeVec, second: ConeVec
    ) -> tuple[FloatArray, FloatArray]:
        """Interpolate rays' line integrals, and their opposites', (m,) each."""
        here, there, _, _ = self._sampled(images, first, second)
        return here, there

    def condition(
        self, images: Float32Array, cone_vec: ConeVec, noise: float
    ) -> Condition:
        """Interpolate line integrals, with the variance of their differences: by noise,
        and by the bends between columns and views, where interpolation is off.

        Args:
            images: (n, rows, cols).
            cone_vec: n views.
            noise: variance of a pixel.
        """
        here, there, variance, _ = self._sampled(images, cone_vec, cone_vec)
        scale = float(np.abs(here).mean())
        least = np.square(1e-4 * max(float(np.abs(here).max()), 1e-30))
        usual = 0.1 * float(np.median(variance))
        pairs = np.column_stack([self.views, self.around[:, 1]])
        return Condition(
            here, there, variance + 2.0 * noise + usual + least, pairs, scale
        )

    def _sampled(
        self, images: Float32Array, first: ConeVec, second: ConeVec
    ) -> tuple[FloatArray, FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """Interpolate rays and opposite rays; their squared errors of interpolation; and
        which of them the panels see.
        """
        ray, row = self._rays(first)
        place = self.columns - 0.5 * (self.shape[2] - 1)
        here, bend, seen = self._at(
            images, self.views, np.asarray(place, np.float64), row
        )
        at = self._opposite(first, ray)
        azimuth = self._azimuths(second)
        found, bends = [], []
        for k in self.around.T:
            turn = azimuth[k] - at
            cos, sin = np.cos(turn), np.sin(turn)
            back = -np.stack([cos * ray[0] - sin * ray[1], sin * ray[0] + cos * ray[1]])
            value, off, there = self._at(images, k, *self._pixel(second, k, back))
            found.append(value)
            bends.append(off)
            seen &= there
        step = _turn(azimuth[self.around[:, 2]] - azimuth[self.around[:, 1]])
        share = _turn(at - azimuth[self.around[:, 1]]) / np.where(step == 0.0, 1e-9, step)
        opposite = (1.0 - share) * found[1] + share * found[2]
        between = 0.5 * (found[0] - found[1] - found[2] + found[3])
        variance = np.square(between) + 0.5 * np.square(bend)
        variance += np.square((1.0 - share) * bends[1] + share * bends[2])
        return here, opposite, ROUNDING**2 * variance, seen

    def _azimuths(self, cone_vec: ConeVec) -> FloatArray:
        place = cone_vec.source[:, :2] - self.centre
        return np.asarray(np.arctan2(place[:, 1], place[:, 0]))

    def _rays(self, cone_vec: ConeVec) -> tuple[FloatArray, FloatArray]:
        """Return the pixels' horizontal rays (2, m), and their rows from the middle."""
        k = self.views
        place = self.columns - 0.5 * (self.shape[2] - 1)
        ray = (cone_vec.detector - cone_vec.source)[k] + place[:, None] * cone_vec.u[k]
        row = -ray[:, 2] / cone_vec.v[k, 2]
        return (ray + row[:, None] * cone_vec.v[k])[:, :2].T, row

    def _opposite(self, cone_vec: ConeVec, ray: FloatArray) -> FloatArray:
        """Compute the azimuth at which a ray leaves the circle of the sources, (m,)."""
        x, y = (cone_vec.source[self.views, :2] - self.centre).T
        far = -2.0 * (x * ray[0] + y * ray[1]) / np.square(ray).sum(axis=0)
        return np.asarray(np.arctan2(y + far * ray[1], x + far * ray[0]))

    @staticmethod
    def _pixel(
        cone_vec: ConeVec, k: npt.NDArray[np.intp], ray: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Find where horizontal rays (2, m) of views k fall, from the panel's middle."""
        panel, u, v = (
            (cone_vec.detector - cone_vec.source)[k],
            cone_vec.u[k],
            cone_vec.v[k],
        )

        def across(vectors: FloatArray) -> FloatArray:
            return np.asarray(ray[0] * vectors[:, 1] - ray[1] * vectors[:, 0])

        a, b, c = across(u), across(v), -across(panel)
        whole = a * v[:, 2] - b * u[:, 2]
        column = (c * v[:, 2] + b * panel[:, 2]) / whole
        return column, (-a * panel[:, 2] - c * u[:, 2]) / whole

    def _at(
        self,
        images: Float32Array,
        k: npt.NDArray[np.intp],
        column: FloatArray,
        row: FloatArray,
    ) -> tuple[FloatArray, FloatArray, npt.NDArray[np.bool_]]:
        """Interpolate images linearly; the bend between columns; and what they show."""
        _, rows, cols = self.shape
        x, y = column + 0.5 * (cols - 1), row + 0.5 * (rows - 1)
        last = cols - 1 - self.margin
        seen = (x >= self.margin) & (x <= last) & (y >= -1e-6) & (y <= rows - 1 + 1e-6)
        x, y = np.clip(x, 1.0, cols - 2.001), np.clip(y, 0.0, rows - 1.0)
        i, j = x.astype(np.intp), np.minimum(y.astype(np.intp), max(rows - 2, 0))
        below = np.minimum(j + 1, rows - 1)
        s, t = x - i, y - j

        def line(step: int) -> FloatArray:
            upper, lower = images[k, j, i + step], images[k, below, i + step]
            return np.asarray(upper + t * (lower - upper), np.float64)

        left, here, right, beyond = (line(step) for step in (-1, 0, 1, 2))
        bend = (1 - s) * (left - 2 * here + right) + s * (here - 2 * right + beyond)
        return here + s * (right - here), bend, seen


def _turn(angle: FloatArray) -> FloatArray:
    """Return angles within half a turn of 0 [rad]."""
    return np.asarray((angle + np.pi) % (2.0 * np.pi) - np.pi)
