"""The profile of beads in a beam of several energies, estimated from the images.

Metal hardens the beam: a ball's rim takes more of the light than its line integral, scaled to
the middle's, says. A centroid in few pixels depends on that profile, because the error by the
pixel grid is that of the rim. The light behind a ball is a sum of exponentials with weights that
are not negative, as of a spectrum, and such a sum is linear in its weights also after pixels and
blur have averaged it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

ATTENUATIONS = (0.25, 0.5, 0.75, 0.9, 1.0, 1.1, 1.3, 1.7, 2.5, 4.0, 8.0, 16.0)
"""Attenuations of the terms, in units of the one seen through a bead's middle."""
LEAST_LIGHT = 0.02
"""Share of the light below which a pixel counts as if it had that much."""
TABLE_STEPS = 512
"""Steps of the tabulated line integrals."""
LEAST_GAIN = 1e-12
"""Slope of the misfit, over the largest one, below which a weight stays zero."""


@dataclass(frozen=True, eq=False)
class Hardening:
    """Line integrals seen behind beads, as a function of those of one energy.

    Attributes:
        given: (m,) line integrals of one energy, increasing from 0.
        seen: (m,) line integrals in the images.
    """

    given: FloatArray
    seen: FloatArray

    def __call__(self, line_integrals: Float32Array) -> Float32Array:
        """Return the seen line integrals of one-energy ones; beyond the table by its last
        slope.
        """
        out = np.zeros_like(line_integrals)
        behind = line_integrals > 0
        values = line_integrals[behind]
        end = self.given[-1]
        slope = (self.seen[-1] - self.seen[-2]) / (end - self.given[-2])
        beyond = np.maximum(values - end, 0.0) * slope
        out[behind] = np.interp(values, self.given, self.seen) + beyond
        return out


@dataclass(frozen=True, eq=False)
class Profiles:
    """The light behind alike beads in m pixels.

    Attributes:
        terms: (m, terms) light that each term leaves, less the open beam's.
        light: (m,) light in the images over that beside the beads.
        most: largest line integral to tabulate.
    """

    terms: FloatArray
    light: FloatArray
    most: float

    def fitted(self) -> Hardening | None:
        """Estimate the hardening by least squares with weights that are not negative; None where
        no term explains the light.
        """
        weight = 1.0 / np.sqrt(np.maximum(self.light, LEAST_LIGHT))
        heavy = self.terms * weight[:, None]
        taken = weight * (self.light - 1.0)
        shares = non_negative(heavy.T @ heavy, heavy.T @ taken)
        if not shares.any():
            return None
        given = np.linspace(0.0, self.most, TABLE_STEPS)
        left = np.expm1(-given[:, None] * np.array(ATTENUATIONS)) @ shares
        return Hardening(given, -np.log(np.maximum(1.0 + left, 1e-6)))


def non_negative(normal: FloatArray, right: FloatArray) -> FloatArray:
    """Solve normal equations with solutions that are not negative.

    By active sets (Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23).

    Args:
        normal: (n, n) normal matrix.
        right: (n,) right-hand side.

    Returns:
        (n,) the solution.
    """
    count = len(right)
    out = np.zeros(count)
    free = np.zeros(count, dtype=np.bool_)
    least = LEAST_GAIN * float(np.abs(right).max(initial=0.0))
    ridge = 1e-10 * float(np.trace(normal)) * np.eye(count)
    for _ in range(3 * count):
        gain = np.where(free, -np.inf, right - normal @ out)
        best = int(gain.argmax())
        if not gain[best] > least:
            break
        free[best] = True
        while free.any():
            trial = np.zeros(count)
            inside = np.ix_(free, free)
            trial[free] = np.linalg.solve((normal + ridge)[inside], right[free])
            if (trial[free] > 0).all():
                out = trial
                break
            low = free & (trial <= 0)
            steps = out[low] / np.maximum(out[low] - trial[low], 1e-30)
            out = out + float(steps.min()) * (trial - out)
            free &= out > 1e-15
            out[~free] = 0.0
    return out
