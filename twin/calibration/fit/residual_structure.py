"""Residuals of a fit with their derivatives, and how far they are correlated from frame to
frame."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.geometry.conventions import FloatArray


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute a.T @ b of two tall matrices, (m, i) and (m, j), in one thread.

    These products are too small for BLAS threads, which cost more than the work and spin where
    the cores are busy."""
    return np.asarray(np.einsum("mi,mj->ij", a, b))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a fit of p columns at its m used coordinates, and its covariance.

    Attributes:
        problem: for the columns and groups.
        jacobian: whitened rows (m, p), edge units.
        values: (m,) whitened, measured minus predicted.
        keep: (2 n k,) which of all rows are used.
        unit_covariance: (p, p) (J'J)^-1 in edge units.
        noise: standard deviation of the values.
    """

    problem: FitProblem
    jacobian: FloatArray
    values: FloatArray
    keep: npt.NDArray[np.bool_]
    unit_covariance: FloatArray
    noise: float

    @property
    def frame(self) -> npt.NDArray[np.intp]:
        """(m,) frame of each row."""
        return np.asarray(np.flatnonzero(self.keep) // (2 * self.problem.seen.shape[1]))


def larger(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute the smallest covariance of a's shape that is at least as wide as both in every
    direction.

    `a`: (p, p), positive diagonal; `b`: (p, p).
    """
    # Of exact positions `a` is the priors' alone and of lower rank.
    low = np.linalg.cholesky(a + 1e-12 * np.diag(np.diag(a)))
    inverse = np.linalg.inv(low)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    wide: FloatArray = low @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ low.T
    return wide


def correlation_length(
    residual: FloatArray, use: npt.NDArray[np.bool_], group: npt.NDArray[np.int64]
) -> float:
    """Estimate the correlation length of residuals along the frames.

    It is 1 + 2 sum(rho) over the lags until the correlation first falls below noise (2
    sigma), half of the frames at most: the number of frames that count as one. It stays 1
    unless lag one is significant (4 sigma), so that white residuals keep the nominal
    covariance, and for fewer than 8 frames or 24 used coordinates.

    Args:
        residual: (n, k, 2) px.
        use: (n, k).
        group: (n,) frames of different groups are not neighbors.

    Returns:
        1 or more [frames].
    """
    n = len(residual)
    clean = np.where(use[:, :, None], residual, 0.0)
    power = float(np.sum(clean**2))
    count = 2 * int(use.sum())
    if n < 8 or count < 24 or power <= 0.0:
        return 1.0
    power /= count

    def rho(lag: int) -> tuple[float, int]:
        """Compute the correlation of residuals `lag` frames apart in the same scan, as a
        share of the variance, and the number of values it is from; (0, 0) where no two
        frames have that distance.
        """
        together = use[:-lag] & use[lag:] & (group[:-lag] == group[lag:])[:, None]
        pairs = 2 * int(together.sum())
        if pairs == 0:
            return 0.0, 0
        value = float(np.sum(clean[:-lag] * clean[lag:] * together[:, :, None]))
        return value / pairs / power, pairs

    first, pairs = rho(1)
    if pairs == 0 or first * math.sqrt(pairs) < 4.0:
        return 1.0
    length = 1.0 + 2.0 * first
    for lag in range(2, n // 2):
        value, pairs = rho(lag)
        if pairs == 0 or value * math.sqrt(pairs) < 2.0:
            break
        length += 2.0 * value
    return length
