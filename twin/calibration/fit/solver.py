"""Robust least squares on a `Problem`: Levenberg-Marquardt, Huber, then trimming, then refit.

The Huber stage finds the solution in spite of outliers; positions further than `trim` robust
standard deviations are then left out and the rest is fitted by plain least squares, so that the
covariance is that of least squares on clean data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit import fit_kernels as kernels
from flexdt.twin.calibration.fit.problem import Problem
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray

RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a 2-vector with independent unit normal parts."""


@dataclass(frozen=True)
class Solver:
    """How to solve.

    Attributes:
        huber: threshold of the Huber loss in robust standard deviations; inf switches it off.
        trim: positions beyond this many robust standard deviations are left out; inf: none.
        floor_px: the robust spread is taken to be at least this [whitened units], so that exact
            data have no outliers.
        max_iterations: of each Levenberg-Marquardt run.
        tolerance: stop when the residuals' rms would change by less [whitened units].
    """

    huber: float = 3.0
    trim: float = 5.0
    floor_px: float = 1e-3
    max_iterations: int = 60
    tolerance: float = 1e-9


LEAST_SQUARES = Solver(huber=math.inf, trim=math.inf)
"""No robustness at all."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Column values and how they were reached.

    Attributes:
        x: column values, internal units.
        use: (n, k) positions that counted at the end.
        iterations: Levenberg-Marquardt iterations, all stages.
        start_cost, cost: half the sum of squared whitened residuals of `use`, at start and end.
        converged: the last stage met its tolerance.
    """

    x: FloatArray
    use: npt.NDArray[np.bool_]
    iterations: int
    start_cost: float
    cost: float
    converged: bool


def solve(
    problem: Problem,
    solver: Solver | None = None,
    *,
    x: FloatArray | None = None,
    prior_noise: float = 1.0,
) -> Solution:
    """Minimise the robust reprojection error.

    Args:
        problem: what to fit.
        solver: how; the default is robust.
        x: start of the columns; None is the problem's own.
        prior_noise: spread of the whitened residuals, with which the problem's priors are weighed.
    """
    how = Solver() if solver is None else solver
    value = np.array(problem.start if x is None else x, dtype=np.float64)
    mean, weight = problem.prior_mean, problem.prior_weight(prior_noise)
    use = problem.seen
    first = value.copy()
    iterations, huber, converged = _levenberg(problem, value, use, how, mean, weight)
    for _ in range(4):
        norms = problem.residuals(value)[1]
        limit = how.trim * _spread(norms[use], len(value), how.floor_px)
        keep = problem.seen & (norms <= limit)
        settled = np.array_equal(keep, use) and (norms[use] <= huber).all()
        if settled or keep.sum() * 2 < len(value):
            break
        use = keep
        plain = replace(how, huber=math.inf)
        more, huber, converged = _levenberg(problem, value, use, plain, mean, weight)
        iterations += more
        if math.isinf(how.trim):
            break
    return Solution(
        x=value,
        use=use,
        iterations=iterations,
        start_cost=cost_at(problem, first, use),
        cost=cost_at(problem, value, use),
        converged=converged,
    )


def _spread(norms: FloatArray, columns: int, floor: float) -> float:
    """Robust standard deviation of whitened residuals, generous where few are left to judge by:
    a fit swallows part of the noise, and a median of few is unreliable."""
    dof = 2 * len(norms) - columns
    if dof <= 0:
        return math.inf
    generous = math.sqrt(2 * len(norms) / dof) * (1.0 + 8.0 / dof)
    return max(floor, generous * float(np.median(norms)) / RAYLEIGH_MEDIAN)


def _levenberg(
    p: Problem,
    x: FloatArray,
    use: npt.NDArray[np.bool_],
    how: Solver,
    mean: FloatArray,
    weight: FloatArray,
) -> tuple[int, float, bool]:
    floor = how.floor_px * how.huber if math.isfinite(how.huber) else 0.0
    iterations, huber, converged = kernels.levenberg(
        p.data, use, how.huber, floor, mean, weight, x, how.max_iterations, how.tolerance
    )
    return int(iterations), float(huber), bool(converged)


def cost_at(problem: Problem, x: FloatArray, use: npt.NDArray[np.bool_]) -> float:
    """Half the sum of squared whitened residuals; inf where a bead would be behind the source."""
    try:
        norms = problem.residuals(x)[1]
    except TwinError:
        return math.inf
    return float(0.5 * np.sum(norms[use] ** 2))
