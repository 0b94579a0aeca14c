"""Blur of images and of their noise: the scintillator's light, the focal spot.

The blur has the requested variance, however narrow it is. From 0.7 pixels on its kernel
is a Gaussian at the pixels' centers, whose modulation is a Gaussian's up to the Nyquist
frequency. Samples of a narrower one would lose variance: there it is the discrete
Gaussian exp(-t) I_n(t), whose modulation is exp(-2 t sin^2(pi f)) and so more than a
Gaussian's at high frequencies.

Noise of the X-rays is blurred as light is that spreads before pixels collect it: its
spectrum is that of light and aperture together, folded back at the Nyquist frequency.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import numpy as np

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

FWHM = 2.3548200450309493
"""Full width at half maximum of a Gaussian of standard deviation 1."""
MIN_SAMPLED_SIGMA_PX = 0.7
"""Standard deviation from which samples of a Gaussian have its variance [pixels]."""
MIN_SIGMA_PX = 0.02
"""Standard deviation below which an image is not blurred [pixels]."""
MAX_SIGMA_PX = 1000.0
"""Largest standard deviation of a blur [pixels]."""
MIN_FREQUENCIES = 512
FOLDED_SPECTRA = 20
"""Samples of a noise spectrum at least, and spectra on either side that are folded into it."""


def kernel(sigma_px: float) -> Float32Array:
    """Compute the weights of a Gaussian blur by `sigma_px` > 0, float32 (2 r + 1,),
    adding up to 1: samples of the Gaussian, below `MIN_SAMPLED_SIGMA_PX` the discrete
    Gaussian (Bessel functions). r is 4 sigma + 1, rounded up."""
    t = sigma_px * sigma_px
    reach = max(1, int(np.ceil(4.0 * sigma_px + 1.0)))
    n = np.arange(-reach, reach + 1)
    if sigma_px >= MIN_SAMPLED_SIGMA_PX:
        weights = np.exp(n * n / (-2.0 * t))
    else:
        from scipy.special import ive  # half of what this module would cost

        weights = ive(np.abs(n), t)
    return np.asarray(weights / weights.sum(), dtype=np.float32)


@lru_cache(maxsize=16)
def noise_kernel(sigma_px: float) -> Float32Array:
    """Compute the weights (2 r + 1,) that shape white noise as light does that spreads
    with `sigma_px` before pixels collect it; see `noise_spectrum`. r is 4 sigma + 3,
    rounded up; the last 16 are kept."""
    reach = int(np.ceil(4.0 * sigma_px + 3.0))
    frequency = np.fft.fftfreq(max(MIN_FREQUENCIES, 4 * reach)).astype(np.float64)
    modulation = np.sqrt(noise_spectrum(frequency, sigma_px))
    weights = np.fft.ifft(modulation).real
    return np.asarray(weights[np.arange(-reach, reach + 1)], dtype=np.float32)


def noise_spectrum(frequency: FloatArray, sigma_px: float) -> FloatArray:
    """Compute a flat image's noise power by frequency [cycles a pixel], 1 at none.

    Light's and aperture's modulation squared, frequencies folded back.
    """
    f = frequency[..., None] + np.arange(-FOLDED_SPECTRA, FOLDED_SPECTRA + 1)
    return np.asarray(
        (np.sinc(f) ** 2 * np.exp(-((2.0 * np.pi * f * sigma_px) ** 2))).sum(axis=-1)
    )


def blurred(
    image: Float32Array,
    sigma_px: float,
    across_px: float | None = None,
    *,
    weights: Callable[[float], Float32Array] = kernel,
) -> Float32Array:
    """Blur an image (rows, cols) along its rows and, by default alike, across them; edges
    continue as their last pixel.

    Below `MIN_SIGMA_PX` both ways the image itself is returned.

    Args:
        image: float32 (rows, cols).
        sigma_px: standard deviation along the rows [pixels].
        across_px: across them [pixels]; None: the same.
        weights: makes the kernel of a standard deviation; default: a Gaussian.

    Returns float32 (rows, cols).
    Raises LimitError: a blur wider than `MAX_SIGMA_PX`.
    """
    if across_px is None:
        across = sigma_px
    else:
        across = across_px
    if not (widest := max(sigma_px, across)) <= MAX_SIGMA_PX:
        message = f"a blur of {widest:.3g} pixels (standard deviation)"
        cure = "a smaller focal spot, less power, less magnification or larger pixels"
        raise LimitError.instead(message, widest, f"{MAX_SIGMA_PX:g}, by {cure}")
    if widest < MIN_SIGMA_PX:
        return image
    import cv2

    u = weights(sigma_px)
    v = weights(across)
    out = cv2.sepFilter2D(image, cv2.CV_32F, u, v, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(out, dtype=np.float32)


def spot_blur_px(view: FloatArray, spot_mm: float, towards_mm: float = 0.0) -> float:
    """Compute the focal spot's blur (standard deviation) at the axis [pixels along u].

    For a point `towards_mm` nearer to the source; points at the source or behind it count
    as at 1e-3 of the axis's distance. `view`: cone_vec row (12,) [mm]; `spot_mm`: full
    width at half maximum.
    """
    source = view[0:3]
    centre = view[3:6]
    u = view[6:9]
    v = view[9:12]
    normal = np.cross(u, v)
    to_axis = float(-source @ normal)
    to_panel = float((centre - source) @ normal)
    near = to_axis - towards_mm * float(np.linalg.norm(normal))
    magnification = to_panel / (max(near, 1e-3 * to_axis) or 1e-300)
    return max(0.0, magnification - 1.0) * spot_mm / FWHM / float(np.linalg.norm(u))
