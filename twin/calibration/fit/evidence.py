"""Evidence of linear models of the residuals, and averages over them.

A model gives each column of a table a normal prior; columns of no prior are flat. Its
evidence is the likelihood of the residuals with all columns integrated out, at the
standard deviation of the residuals that makes them most likely (MacKay, Neural
Computation 4 (1992) 415).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from flexdt.twin.calibration.fit.residual_structure import cross
from flexdt.twin.geometry.conventions import FloatArray

NAMED_LOG_ODDS = math.log(1e4)
"""Logarithm of the odds from which a cause is named."""
OPEN_LOG_ODDS = math.log(100.0)
"""Logarithm of the odds against a cause up to which it is left open."""
LOG_CHANCE = math.log(0.1)
"""Logarithm of the probability that a scan has a cause, before it is seen; assumed."""
PASSES = 3
"""Steps of the search for the residuals' standard deviation."""
LEAST_SHARE = 1e-12
"""Least share of the residuals' squares; below it is rounding."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A model with its evidence.

    Attributes:
        columns: (c,) of the table that it has.
        mean: (c,) estimates.
        factor: (c, c) upper Cholesky factor of the scaled precision.
        scale: (c,) of the columns.
        noise: standard deviation of the residuals.
        evidence: logarithm of the likelihood, but for a constant that all models share.
    """

    columns: npt.NDArray[np.intp]
    mean: FloatArray
    factor: FloatArray
    scale: FloatArray
    noise: float
    evidence: float

    def covariance(self, count: int) -> FloatArray:
        """Compute the covariance of the first `count` columns, (count, count)."""
        part = np.eye(len(self.columns))[:, :count] * self.scale[:count]
        solved, _ = lapack.dpotrs(self.factor, part)
        return np.asarray(solved[:count] * self.scale[:count, None])


class Table:
    """Rows of residuals and of all columns that a model may have.

    Attributes:
        gram: (q, q) products of the columns.
    """

    def __init__(
        self, rows: FloatArray, values: FloatArray, floor: float, alike: float = 1.0
    ) -> None:
        """Sum up the normal equations of rows; the rows are not kept.

        Args:
            rows: (m, q).
            values: (m,) residuals that the columns are to explain.
            floor: least standard deviation of the values.
            alike: number of correlated rows that count as one, 1 or more.
        """
        self._count = len(values) / alike
        self.gram = cross(rows, rows) / alike
        self._push = np.einsum("mq,m->q", rows, values) / alike
        self._total = float(values @ values) / alike
        self._floor = floor

    def judged(
        self, columns: Sequence[int], widths: FloatArray, noise: float, means: FloatArray
    ) -> Judged | None:
        """Judge a model: fit its columns with their priors, and compute its evidence.

        The residuals' standard deviation is estimated along, in at most `PASSES` rounds,
        never below the floor.

        Args:
            columns: that it has.
            widths: (c,) standard deviations of their priors, above 0; inf without one.
            noise: start of the search for the standard deviation of the residuals.
            means: (c,) of the priors; any value without one.

        Returns:
            The model; None if its columns are not separable.
        """
        at = np.asarray(columns, dtype=np.intp)
        gram = self.gram[np.ix_(at, at)]
        flat = np.isinf(widths)
        precision = np.where(flat, 0.0, 1.0 / widths**2)
        # Deviations from the means have priors about zero.
        there = np.where(flat, 0.0, means)
        moved = gram @ there
        push = self._push[at] - moved
        total = self._total - float(there @ (2.0 * self._push[at] - moved))
        total = max(total, LEAST_SHARE * self._total)
        power = np.diag(gram)
        flats = int(flat.sum())
        freedom = max(self._count - flats, 1.0)
        variance = max(noise, self._floor) ** 2
        out = None
        for _ in range(PASSES):
            inside = power / variance + precision
            scale = 1.0 / np.sqrt(np.where(inside > 0.0, inside, 1.0))
            whole = gram / variance
            whole.flat[:: len(at) + 1] += precision
            whole *= np.outer(scale, scale)
            factor, found, failed = lapack.dposv(whole, push * scale / variance)
            if failed:
                return None
            found = found * scale
            left = max(total - float(push @ found), LEAST_SHARE * total)
            volume = 2.0 * float(np.log(np.diag(factor) / scale).sum())
            volume -= float(np.log(precision[~flat]).sum())
            out = Judged(
                at,
                found + there,
                factor,
                scale,
                math.sqrt(variance),
                -0.5 * (freedom_log(self._count, variance) + left / variance + volume),
            )
            fresh = max(left / freedom, self._floor**2)
            if abs(math.log(fresh / variance)) < 0.02:
                break
            variance = fresh
        return out


def freedom_log(count: float, variance: float) -> float:
    """Return the part of the evidence from the spread of `count` values."""
    return count * math.log(variance)
