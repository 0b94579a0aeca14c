"""How large the residuals of a fit may be."""

from __future__ import annotations

import math

from scipy.special import chdtri

from flexdt.twin.calibration.fit.certificate import POSITION_SPREAD_PX, SPREAD_FREEDOM
from flexdt.twin.calibration.fit.fit import FitResult

NOISE_SIGMAS = 1.5
"""Stated sigmas up to which residuals are noise, however large."""


def largest_residual(fit: FitResult, chance: float, sigmas_known: bool = False) -> float:
    """Compute the root mean square residual that a right fit exceeds by chance.

    Positions scatter by their stated sigmas and, from image to image, by
    `certificate.POSITION_SPREAD_PX` with SPREAD_FREEDOM degrees of freedom.

    Args:
        fit: whose residuals are judged.
        chance: probability of more.
        sigmas_known: the positions' sigmas were measured, and are no more than compared;
            else the stated ones are ignored.

    Returns:
        [px].
    """
    usual = SPREAD_FREEDOM / float(chdtri(SPREAD_FREEDOM, 1.0 - chance))
    certificate = fit.certificate
    measured = sigmas_known and certificate.noise > 0.0
    if measured:
        stated = certificate.rms_px / certificate.noise
    else:
        stated = 0.0
    return math.hypot(POSITION_SPREAD_PX * math.sqrt(usual), NOISE_SIGMAS * stated)
