"""Gaussian blur of images that has exactly the requested variance, however narrow it is.

The kernel is the discrete Gaussian exp(-t) I_n(t): blurring twice is blurring once with the summed
variances, and a standard deviation of a tenth of a pixel is still exact.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array

FWHM = 2.3548200450309493
"""Full width at half maximum of a Gaussian of standard deviation 1."""
NARROWEST = 0.02
"""Standard deviation below which nothing is done [pixels]."""


def kernel(sigma_px: float) -> Float32Array:
    """Weights of the discrete Gaussian, (2 r + 1,), adding up to 1."""
    from scipy.special import ive

    t = sigma_px * sigma_px
    reach = max(1, int(np.ceil(4.0 * sigma_px + 1.0)))
    weights = ive(np.abs(np.arange(-reach, reach + 1)), t)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


def blurred(image: Float32Array, sigma_px: float) -> Float32Array:
    """`image` (rows, cols) blurred; edges go on as their last pixel."""
    if sigma_px < NARROWEST:
        return image
    import cv2

    weights = kernel(sigma_px)
    out = cv2.sepFilter2D(image, cv2.CV_32F, weights, weights, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float32)
