"""How the noise of line integrals grows with their value, from images themselves."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.white_noise import MEDIAN_OF_SQUARES

BINS: Final = 24
"""Bins between the least and the largest value."""
BEYOND: Final = 3.0
"""Line integrals by which the table goes beyond the known ones."""
TABLE: Final = 1024
"""Entries of the table in which variances are looked up: they are constant within one."""
MOST_SQUARES: Final = 200_000
"""Squares that are looked at, at most: the median of a bin is then known to some per cent."""
LEAST_SQUARES: Final = 64
"""Fewest squares of a bin: their median is then known to a quarter."""


@dataclass(frozen=True, eq=False)
class NoiseByValue:
    """The variance of a pixel's noise as a function of its value, whatever the camera.

    Photons, electronics and a correction of beam hardening give a pixel a noise that follows
    from the light that reaches it, thus from its value.

    Attributes:
        values: (k,) growing, one at least.
        log_variances: (k,), natural logarithms.
    """

    values: FloatArray
    log_variances: FloatArray

    @classmethod
    def of(cls, images: Float32Array) -> NoiseByValue:
        """Measure it in single views: from mixed second differences of neighboring rows and
        columns. Blur makes these too small, by a factor that all values share.

        `images`: (n, rows, cols), two rows and columns at least.
        """
        square = np.square(np.diff(np.diff(images, axis=1), axis=2)).ravel() / 4.0
        value = 0.25 * (
            images[:, 1:, 1:]
            + images[:, :-1, 1:]
            + images[:, 1:, :-1]
            + images[:, :-1, :-1]
        )
        return cls.fitted(square, value.ravel())

    @classmethod
    def fitted(
        cls, square: npt.NDArray[np.floating], value: npt.NDArray[np.floating]
    ) -> NoiseByValue:
        """Fit it to squares of differences that are noise but for few edges, which do not change
        a median, by bins of the value. Of squares that are 0 it is 1 for all values.

        `square`, `value`: (m,) each, of the variance of one pixel, and its value.
        """
        each = -(-len(square) // MOST_SQUARES)
        square, value = square[::each], value[::each]
        edges = np.linspace(float(value.min()), float(value.max()), BINS + 1)
        # Of few bits, as such are sorted by their digits.
        which = np.digitize(value, edges[1:-1]).astype(np.uint8)
        order = np.argsort(which, kind="stable")
        bounds = np.searchsorted(which[order], np.arange(BINS + 1))
        found = [
            (0.5 * (edges[k] + edges[k + 1]), np.median(square[order[first:last]]))
            for k, (first, last) in enumerate(itertools.pairwise(bounds))
            if last - first >= LEAST_SQUARES
        ]
        known = [(at, typical) for at, typical in found if typical > 0.0]
        if not known:
            return cls(np.zeros(1), np.zeros(1))
        values, typical = np.array(known).T
        # Less light never has less noise: a bin with more than a darker one holds edges.
        least = np.minimum.accumulate(typical[::-1])[::-1]
        return cls(values, np.log(least / MEDIAN_OF_SQUARES))

    def __call__(self, images: npt.NDArray[np.floating]) -> Float32Array:
        """Return the variance of each pixel, like `images`. Beyond the known values it grows
        by exp(1) a unit, as that of photons does."""
        first, last = self.values[0] - BEYOND, self.values[-1] + BEYOND
        places = np.linspace(first, last, TABLE)
        beyond = places - np.clip(places, self.values[0], self.values[-1])
        logs = np.interp(places, self.values, self.log_variances)
        table = np.exp(logs + beyond)
        step = (last - first) / (TABLE - 1)
        at = np.clip((images - np.float32(first)) / np.float32(step), 0, TABLE - 1)
        out: Float32Array = table.astype(np.float32)[at.astype(np.int16)]
        return out
