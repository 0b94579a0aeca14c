"""Image quality before a scan: count and noise of a ray's pixel, dose on the axis.

Exact sums over the spectrum for a few rays, where whole images have effective energies.
The noise is that of one saved image; structure that a flat image corrects is no noise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.attenuation.scattering import ELECTRON_KEV, cross_sections
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.physics.chain import Chain, mAs, weights_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.physics.panel_noise import pixel_variance
from flexdt.twin.physics.readout import expected_counts
from flexdt.twin.physics.tube import tube_spectrum

AIR: Final = Substance(
    "air",
    (("N", 0.755268), ("O", 0.231781), ("Ar", 0.012827), ("C", 0.000124)),
    1.20479e-3,
)
"""Dry air near sea level, composition and density of NIST's tables."""
GRAY_PER_KEV_PER_G: Final = 1.602176634e-13
"""Dose of 1 keV in 1 g [Gy]."""


@dataclass(frozen=True)
class PixelValue:
    """A pixel of one saved image.

    Attributes:
        signal: mean counts above the dark level.
        noise: their standard deviation [counts].
    """

    signal: float
    noise: float


def pixel_reading(
    chain: Chain,
    camera: CameraSettings,
    exposure: ExposureSettings,
    flux: float,
    paths_mm: Sequence[float] = (),
    detail: tuple[Substance, float] | None = None,
) -> PixelValue:
    """Forecast the count of a pixel behind materials and its noise, in surroundings like
    it.

    Without scatter and focal-spot blur.

    Args:
        flux: the pixel's share of the charge at 1 m, see `chain.flux_map` [cm2].
        paths_mm: path through each of the chain's substances [mm]; nothing if left out.
        detail: one more substance and the path through it [mm].

    Returns:
        Counts above dark and their standard deviation.

    Raises:
        LimitError: the tables have no spectrum for the voltage.
    """
    if paths_mm:
        layers = list(zip(chain.substances, paths_mm, strict=True))
    else:
        layers = []
    if detail is not None:
        layers.append(detail)
    signal, noise = weights_of(chain, exposure.kV)
    depth = np.zeros_like(signal)
    for substance, path in layers:
        depth += substance.attenuation() * path
    through = np.exp(-depth)
    scale = mAs(exposure) * flux
    panel = chain.panel
    variance = pixel_variance(
        panel, camera, exposure.averages, float(noise @ through) * scale
    )
    return PixelValue(
        expected_counts(panel, camera, float(signal @ through) * scale),
        math.sqrt(variance),
    )


def contrast_to_noise(background: PixelValue, detail: PixelValue) -> float:
    """Compute a pixel's difference over the background's noise."""
    return abs(background.signal - detail.signal) / background.noise


def air_kerma_mGy(chain: Chain, exposure: ExposureSettings, distance_mm: float) -> float:
    """Compute the air kerma of one image at a distance from the source [mGy].

    Energy that photons give to electrons of air: all of it in photoelectric absorption,
    the mean share (Klein and Nishina) in Compton scattering; with bremsstrahlung, below
    0.1 %.
    """
    spectrum = tube_spectrum(exposure.kV, chain.tube)
    fluence = (
        spectrum.fluence * mAs(exposure) * exposure.averages * (1000.0 / distance_mm) ** 2
    )
    released = float(fluence @ (spectrum.energy_keV * mass_energy_transfer(AIR)))
    return 1e3 * released * GRAY_PER_KEV_PER_G


@lru_cache
def mass_energy_transfer(substance: Substance) -> FloatArray:
    """Compute the mass energy-transfer coefficient at the tables' energies, (e,) [cm2/g].

    Photoelectric absorption in full, and the electron's mean share of incoherent
    scattering. Without fluorescence that escapes, so for light elements only. Kept for
    each substance."""
    parts = cross_sections((substance,))
    scattered = parts.coherent[0] + parts.incoherent[0]
    per_mm = np.maximum(parts.total[0] - scattered, 0.0)
    per_mm = per_mm + parts.incoherent[0] * compton_share(parts.energy_keV)
    return np.asarray(10.0 * per_mm / substance.density_g_cm3)


def compton_share(energy_keV: npt.ArrayLike) -> FloatArray:
    """Compute the mean part of a photon's energy, 0 to 1, that a free electron takes in
    Compton scattering (Klein and Nishina), (e,)."""
    cosine, weight = np.polynomial.legendre.leggauss(64)
    alpha = (
        np.atleast_1d(np.asarray(energy_keV, dtype=np.float64))[:, None] / ELECTRON_KEV
    )
    left = 1.0 / (1.0 + alpha * (1.0 - cosine))
    section = left**2 * (left + 1.0 / left - (1.0 - cosine**2)) * weight
    return np.asarray((section * (1.0 - left)).sum(axis=1) / section.sum(axis=1))
