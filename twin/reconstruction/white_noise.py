"""White noise of images, measured in themselves."""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array

MEDIAN_OF_SQUARES: Final = 0.4549
"""Median of the squares of standard normal deviates."""


def noise_of(images: Float32Array) -> float:
    """Estimate the variance of white noise in images.

    The smaller of two estimates: from mixed second differences of neighbouring rows and
    columns (of columns alone with one row), and from second differences of neighbouring
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
    beside = float(np.median(np.square(mixed), axis=0).mean()) / terms
    between = (
        float(np.median(np.square(np.diff(images, n=2, axis=0)), axis=0).mean()) / 6.0
    )
    return min(beside, between) / MEDIAN_OF_SQUARES
