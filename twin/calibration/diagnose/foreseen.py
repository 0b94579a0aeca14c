"""Certificates that scans of a plan will state, before there is one.

What a calibration states depends on the noise: a cause that the noise looks like stays open
and is stated, so does a drift. Scans of the plan are drawn (noise, strain of the phantom and
offsets within their priors), to first order, and go through the search for causes and the
tests of residuals that a calibration's go through.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes import (
    SHAPES,
    Candidates,
    Known,
    left_open,
    motions_alone,
)
from flexdt.twin.calibration.fit.certificate import widened_by_structure
from flexdt.twin.calibration.fit.fit import image_slopes
from flexdt.twin.calibration.fit.forecast import Stated
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors
from flexdt.twin.calibration.fit.residual_structure import Residuals, cross
from flexdt.twin.geometry.conventions import FloatArray

DRAWS: Final = 39
"""Number of scans that are drawn."""
SEED: Final = 39
FLOOR: Final = 0.3
"""Least standard deviation of whitened residuals, as of a second measurement."""


def foreseen(problem: FitProblem, known: Known) -> Stated:
    """Draw what scans of a plan state; the same in every call.

    The fit is linearised where a scanner and a phantom are (small offsets turn the image of
    the axis by more than it is known), what causes and residuals add at the plan.

    Args:
        problem: planned, with its positions as predicted at the start; their whitened errors
            have spread 1.
        known: statements on the phantom and the positions.

    Returns:
        `DRAWS` scans.
    """
    rng = np.random.default_rng(SEED)
    candidates = Candidates(problem, problem.start, known, ())
    spread = candidates.drawn
    count = candidates.count
    factor = edge_factors(problem.layout.names)
    unit = np.outer(factor[:count], factor[:count])
    precision = np.diag(1.0 / (problem.prior_sigma * factor) ** 2)
    keep = np.repeat(problem.seen.ravel(), 2)

    def rows_at(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute the rows of the fit (m, c) at column values, and their products (c, c),
        edge units.
        """
        rows = np.asarray(problem.jacobian(x)[keep] / factor)
        return rows, cross(rows, rows)

    shape = [
        c for cause in candidates.causes if cause.name in SHAPES for c in cause.columns
    ]
    strain = range(len(problem.layout.names))[problem.layout.strain_columns]
    own_columns = [*range(count), *strain]
    table_columns = [*range(count), *shape[: len(strain)]]
    rows, told = rows_at(problem.start)
    slopes = image_slopes(problem, problem.start, 0)[1]
    covariances = []
    images = []
    for _ in range(DRAWS):
        drawn = spread * rng.normal(size=len(spread))
        values = candidates.rows @ drawn + rng.normal(size=len(rows))
        scan = candidates.of_values(values, FLOOR)
        own, more = left_open(scan, motions_alone(scan, scan.best()))[:2]
        inverse = np.asarray(np.linalg.inv(told + own.noise**2 * precision))
        residuals: FloatArray = values - rows @ (inverse @ (rows.T @ values))
        left = Residuals(problem, rows, residuals, keep, inverse, own.noise)
        whole = widened_by_structure(left, own.covariance(count) * unit) + more
        more = whole - own.noise**2 * inverse[:count, :count]
        there = problem.start
        there[own_columns] += drawn[table_columns]
        here = np.linalg.inv(rows_at(there)[1] / own.noise**2 + precision)[:count, :count]
        turned = image_slopes(problem, there, 0)[1]
        covariances.append(here + more)
        images.append(
            np.einsum("qi,ij,qj->q", turned, here, turned)
            + np.einsum("qi,ij,qj->q", slopes, more, slopes)
        )
    return Stated(np.array(covariances), np.array(images))
