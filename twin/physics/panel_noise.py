"""The noise of a saved image, term by term: one model for images that are drawn
and for forecasts.

Each of `NOISE` has a function that draws it, and its variance. `readout.read_out` draws
all of them, `pixel_variance` adds their variances up. A term that is added to `NOISE` is
thus in images and in forecasts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.physics.blur import MIN_SIGMA_PX, blurred, noise_kernel
from flexdt.twin.physics.detector import Detector
from flexdt.twin.physics.exposure import MIN_GAUSSIAN_PHOTONS

ROUNDING_COUNTS2: Final = 1.0 / 12.0
"""Variance of rounding to whole counts [counts^2]."""


@dataclass(frozen=True, eq=False)
class Exposed:
    """Content of the panel before an image is read out.

    Attributes:
        mean_e: float32 (rows, cols), electrons of one read-out.
        variance_e: float32 (rows, cols), contribution of X-rays to their variance in one
            read-out.
        averages: read-outs that are averaged into the image.
        panel: the detector.
        camera: its mode.
    """

    mean_e: Float32Array
    variance_e: Float32Array
    averages: int
    panel: Detector
    camera: CameraSettings


@dataclass(frozen=True)
class NoiseTerm:
    """One source of noise.

    Attributes:
        name: of the source.
        spreads: whether the scintillator's light spreads it over neighbors; otherwise it
            is white.
        draw: makes the noise of a saved image before it spreads, float32 (rows, cols)
            [electrons].
        variance_e2: gives a pixel's variance in one read-out before it spreads
            [electrons^2], from panel, camera mode and the variance that X-rays have
            [electrons^2]; averaging divides it by the number of read-outs.
    """

    name: str
    spreads: bool
    draw: Callable[[Exposed, np.random.Generator], Float32Array]
    variance_e2: Callable[[Detector, CameraSettings, float], float]


def draw_quanta(exposed: Exposed, rng: np.random.Generator) -> Float32Array:
    """Draw the deviation of the charge from its mean, of variance / averages, float32
    (rows, cols) [electrons].

    Gaussian; below `MIN_GAUSSIAN_PHOTONS` quanta whole ones (Poisson), of the size that
    gives the variance.
    """
    mean = exposed.mean_e
    variance = exposed.variance_e
    averages = exposed.averages
    out = rng.standard_normal(mean.shape, dtype=np.float32)
    out *= np.sqrt(variance * np.float32(1.0 / averages))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        quanta = mean * mean * np.float32(averages) / variance
    few = np.flatnonzero((quanta < MIN_GAUSSIAN_PHOTONS).ravel() & (quanta > 0.0).ravel())
    if len(few):
        each = mean.ravel()[few] / quanta.ravel()[few]
        out.ravel()[few] = (rng.poisson(quanta.ravel()[few]) - quanta.ravel()[few]) * each
    return np.asarray(out)


def draw_electronics(exposed: Exposed, rng: np.random.Generator) -> Float32Array:
    """Draw the read noise of an exposed panel, divided by the root of the averages,
    (rows, cols) [electrons]."""
    sigma = exposed.panel.read_noise(exposed.camera)
    shape = exposed.mean_e.shape
    return np.float32(sigma / np.sqrt(exposed.averages)) * rng.standard_normal(
        shape, dtype=np.float32
    )


def quantum_variance(panel: Detector, camera: CameraSettings, xrays_e2: float) -> float:
    """Return the variance of the X-rays [electrons^2]."""
    return xrays_e2


def electronic_variance(
    panel: Detector, camera: CameraSettings, xrays_e2: float
) -> float:
    """Return the variance of the read noise [electrons^2]."""
    return panel.read_noise(camera) ** 2


NOISE: tuple[NoiseTerm, ...] = (
    NoiseTerm("quanta", True, draw_quanta, quantum_variance),
    NoiseTerm("electronics", False, draw_electronics, electronic_variance),
)
"""Every source of noise. Random numbers are drawn in this order, for those
that spread first."""


def drawn(
    exposed: Exposed, rng: np.random.Generator, *, spreads: bool
) -> Iterator[Float32Array]:
    """Draw the noise of each term of `NOISE` that spreads with light, or does not.

    Spreading terms are blurred by the panel. Yields electrons of a saved image, (rows,
    cols).
    """
    for term in NOISE:
        if term.spreads != spreads:
            continue
        noise = term.draw(exposed, rng)
        if spreads:
            blur = exposed.panel.blur_px(exposed.camera)
            noise = blurred(noise, *blur, weights=noise_kernel)
        yield noise


def pixel_variance(
    panel: Detector, camera: CameraSettings, averages: int, xrays_e2: float
) -> float:
    """Add up the variance of a saved image's pixel in surroundings like it [counts^2].

    Rounding is included. `averages`: read-outs in the image; `xrays_e2`: X-rays' variance
    in one, before light spreads [electrons^2].
    """
    kept_share = _kept_by_blur(panel.blur_px(camera))
    electrons = 0.0
    for term in NOISE:
        term_e2 = term.variance_e2(panel, camera, xrays_e2)
        electrons += term_e2 * kept_share if term.spreads else term_e2
    return electrons / averages / panel.gain(camera) ** 2 + ROUNDING_COUNTS2


def _kept_by_blur(sigmas_px: tuple[float, float]) -> float:
    """Compute the part of white noise that remains in a pixel where light spreads.

    1 if both sigmas are below `MIN_SIGMA_PX`.
    """
    if max(sigmas_px) < MIN_SIGMA_PX:
        return 1.0
    return math.prod(
        float((noise_kernel(s).astype(np.float64) ** 2).sum()) for s in sigmas_px
    )
