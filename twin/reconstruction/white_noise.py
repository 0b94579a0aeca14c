"""White noise of images, measured in themselves."""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array

MEDIAN_OF_SQUARES: Final = 0.4549
"""Median of the squares of standard normal deviates."""


def noise_of(images: Float32Array) -> float:
    """Estimate the variance of white noise in images.

    The smaller of two estimates: from mixed second differences of neighboring rows and
    columns (of columns alone with one row), and from second differences of neighboring
    views, whichever show less of the object.

    Args:
        images: (n, rows, cols).
    """
    if images.shape[1] > 1:
        mixed = np.diff(np.diff(images, axis=2), axis=1)
        terms = 4.0
    else:
        mixed = np.diff(images, n=2, axis=2)
        terms = 6.0
    beside = _mean_of_medians(np.square(mixed)) / terms
    between = _mean_of_medians(np.square(np.diff(images, n=2, axis=0))) / 6.0
    return min(beside, between) / MEDIAN_OF_SQUARES


def _mean_of_medians(values: Float32Array) -> float:
    """Average the medians over the first axis; NaN without values.

    Sorting takes a tenth of the time of `np.median`.
    """
    ordered = np.sort(values, axis=0)
    count = len(ordered)
    if not ordered.size:
        return np.nan
    middle = 0.5 * (ordered[(count - 1) // 2] + ordered[count // 2])
    return float(middle.mean())
