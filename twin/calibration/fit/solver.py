"""Robust least squares on a `FitProblem`: Levenberg-Marquardt, Huber, then trimming, then refit.

The Huber stage finds the solution in spite of outliers; positions further than `trim` robust
standard deviations are then left out and the rest is fitted by plain least squares, so that the
covariance is that of least squares on clean data.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray

RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a 2-vector with independent unit normal parts."""
LEAST_PIVOT = 1e-15
"""Of the scaled normal equations: what is less is rounding."""


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
    problem: FitProblem,
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
    use = problem.seen
    first = value
    value, iterations, huber, converged = _levenberg(problem, value, use, how, prior_noise)
    for _ in range(4):
        norms = problem.residuals(value)[1]
        limit = how.trim * _spread(norms[use], len(value), how.floor_px)
        keep = problem.seen & (norms <= limit)
        settled = np.array_equal(keep, use) and (norms[use] <= huber).all()
        if settled or keep.sum() * 2 < len(value):
            break
        use = keep
        plain = replace(how, huber=math.inf)
        value, more, huber, converged = _levenberg(problem, value, use, plain, prior_noise)
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
    p: FitProblem, x: FloatArray, use: npt.NDArray[np.bool_], how: Solver, prior_noise: float
) -> tuple[FloatArray, int, float, bool]:
    """Levenberg-Marquardt with Marquardt's diagonal from `x`.

    The first step is tried almost undamped; damping appears only when a step fails. The Huber
    threshold follows the residuals: `how.huber` times their robust spread. Stops when a step is
    predicted to change the residuals' rms by less than the tolerance plus a millionth of it.

    Returns:
        (values, iterations, Huber threshold, converged).
    """
    weight = p.prior_weight(prior_noise)
    rows = max(1, 2 * int(np.count_nonzero(use)))
    huber = math.inf

    def at(x: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Cost, norms and normal equations, priors included."""
        cost, _, norms, _, hess, grad = p.evaluate(x, use, 1, huber)
        off = x - p.prior_mean
        hess.flat[:: len(x) + 1] += weight
        return cost + 0.5 * float(weight @ off**2), norms, hess, grad + weight * off

    def threshold(norms: FloatArray) -> float:
        spread = float(np.median(norms[use])) / RAYLEIGH_MEDIAN if use.any() else 0.0
        return how.huber * max(how.floor_px, spread)

    robust = math.isfinite(how.huber)
    if robust:
        huber = threshold(p.evaluate(x, use, 0)[2])
    cost, norms, hess, grad = at(x)
    if not cost < math.inf:
        return x, 0, huber, False
    damping, iterations, converged, small = 1e-9, 0, len(x) == 0, False
    while iterations < how.max_iterations and not converged:
        iterations += 1
        accepted = False
        for _ in range(40):
            step = _step(hess, grad, damping)
            if step is None:
                damping = max(damping * 10.0, 1e-12)
                continue
            damped = damping * float(np.diag(hess) @ step**2)
            change = -float(step @ grad) - damped  # step' H step
            least = how.tolerance + 1e-6 * math.sqrt(2.0 * cost / rows)
            small = math.sqrt(abs(change) / rows) < least
            there = x + step
            trial = at(there)
            accepted = trial[0] < cost or (small and trial[0] <= cost * (1.0 + 1e-9) + 1e-24)
            if accepted or small:
                break
            damping = max(damping * 10.0, 1e-4)
        converged = small
        if not accepted:
            break
        gain, promised = cost - trial[0], 0.5 * change + damped
        if gain > 0.5 * promised:
            damping = max(damping * 0.02, 1e-14)
        elif gain < 0.1 * promised:
            damping = max(damping * 4.0, 1e-6)
        x = there
        cost, norms, hess, grad = trial
        if robust and not converged:
            fresh = threshold(norms)
            if abs(fresh - huber) > 0.02 * huber:
                changed = (norms > min(fresh, huber)).any()
                huber = fresh
                if changed:
                    cost, norms, hess, grad = at(x)
    return x, iterations, huber, converged


def _step(hess: FloatArray, grad: FloatArray, damping: float) -> FloatArray | None:
    """The solution of the column-scaled, damped normal equations, of which `hess` is the upper
    triangle; None where they are not positive definite."""
    diagonal = np.diag(hess)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = hess * np.outer(scale, scale)
    scaled.flat[:: len(grad) + 1] += damping
    factor, solved, failed = lapack.dposv(scaled, grad * scale)
    if failed or (np.diag(factor) ** 2 <= LEAST_PIVOT).any():
        return None
    return np.asarray(-scale * solved)


def cost_at(problem: FitProblem, x: FloatArray, use: npt.NDArray[np.bool_]) -> float:
    """Half the sum of squared whitened residuals; inf where a bead would be behind the source."""
    try:
        norms = problem.residuals(x)[1]
    except TwinError:
        return math.inf
    return float(0.5 * np.sum(norms[use] ** 2))
