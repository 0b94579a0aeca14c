"""Algorithm 2 of the thesis as printed, for comparison with our own fit.

It has reprojection residuals and pairwise distances (eqs. 5.9 to 5.11), central
differences (5.15), normal equations damped by lambda times the identity in mixed mm and
rad (5.16), and acceptance, stall and convergence rules of its own. Values that the text
leaves open, eta_conv, the steps of the differences, the unit of angles and the limit, are
those of its author's public code (data/author.toml). Beads are predicted as points; the
thesis detects them in rendered projections. The printed text is not improved on: a
rejected step counts towards stall and convergence, and lambda = 0 stays 0.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import edge_factors
from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets

CONVERGENCE = 1e-6
"""Limit of convergence, eta_conv, on the norm of a step, mm and degrees mixed."""
STEP = 0.1
SMALL_STEP = 0.01
"""Steps of finite differences: positions [mm]; tau [mm] and angles [deg]."""
MAX_ITERATIONS = 200
STALL_WINDOW = 5
"""Window of the stall rule, S_w of Algorithm 2 [iterations]."""
STALL_THRESHOLD = 1e-8
"""Limit of the stall rule, eta_stall of Algorithm 2."""


class Stop(enum.Enum):
    """Why Algorithm 2 ended."""

    CONVERGED = "converged"
    STALLED = "stalled"
    LIMIT = "iteration limit"
    SINGULAR = "singular normal equations"


@dataclass(frozen=True, eq=False)
class Iterated:
    """Where the iteration ended.

    Attributes:
        x: parameters, mm and degrees.
        iterations: accepted and rejected ones.
        start_cost, cost: half the squared residuals, pairwise ones included.
        stop: why it ended.
        lam: damping at the end.
    """

    x: FloatArray
    iterations: int
    start_cost: float
    cost: float
    stop: Stop
    lam: float

    @property
    def cost_reduction_pct(self) -> float:
        """100 (c0 - c) / c0; nan if the start was perfect."""
        if not self.start_cost > 0:
            return math.nan
        return 100.0 * (self.start_cost - self.cost) / self.start_cost


@dataclass(frozen=True, eq=False)
class Algorithm2(Iterated):
    """The outcome of Algorithm 2; `parameters` is the geometry, in `Poses.cone_vec`'s
    reading."""

    parameters: Offsets


def algorithm_2(problem: FitProblem, lam: float = 1e-2) -> Algorithm2:
    """Run Algorithm 2 of the thesis on bead tracks, from the problem's start.

    Residuals are those of coordinates and of pair distances; impossible geometries have
    infinite ones.

    Args:
        problem: tracks with known identities and the free parameters (beads fixed).
        lam: initial damping; 0 is Gauss-Newton and stays 0.

    Returns:
        The outcome of `iterate` in mm and deg, and the geometry at the end.
    """
    pairs = bead_pairs(problem.seen)
    unit = edge_factors(problem.layout.names)
    small = [
        unit[i] != 1.0 or n.startswith("tau") for i, n in enumerate(problem.layout.names)
    ]

    def residual(x: FloatArray) -> FloatArray:
        """Compute the stacked residuals at scaled values `x`; one infinite value where
        the geometry is impossible.
        """
        try:
            predicted = problem.predictions(x / unit)[0] - problem.origin[:, None, :]
        except TwinError:
            return np.full(1, np.inf)
        return stacked(predicted, problem.measured, problem.seen, pairs)

    end = iterate(residual, problem.start * unit, np.where(small, SMALL_STEP, STEP), lam)
    return Algorithm2(**vars(end), parameters=problem.parameters(end.x / unit)[0])


def iterate(
    residual: Callable[[FloatArray], FloatArray],
    x: FloatArray,
    steps: FloatArray,
    lam: float,
) -> Iterated:
    """Run the damped least-squares iteration of Algorithm 2 on any residuals.

    It stops after `MAX_ITERATIONS`, when the lengths of STALL_WINDOW steps differ by less
    than STALL_THRESHOLD (stalled), when a step is shorter than CONVERGENCE, or when the
    equations are singular. Damping falls to a third (not below 1e-6) after a better step,
    and grows five times (up to 1e6) after a worse one, which is not taken, but whose
    length counts all the same.

    Args:
        residual: parameters (p,) [mm, deg] to residuals (m,) [px]; inf where there are
            none.
        x: the start.
        steps: of central differences, (p,).
        lam: initial damping; 0 stays 0.
    """
    r = residual(x)
    cost = start_cost = _half_square(r)
    history: list[float] = []
    stop = Stop.LIMIT
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        jacobian = np.stack(
            [
                (residual(x + e) - residual(x - e)) / (2.0 * e.sum())
                for e in np.diag(steps)
            ],
            axis=1,
        )
        try:
            delta = np.linalg.solve(
                jacobian.T @ jacobian + lam * np.eye(len(x)), -jacobian.T @ r
            )
        except np.linalg.LinAlgError:
            stop = Stop.SINGULAR
            break
        trial = residual(x + delta)
        new = _half_square(trial)
        if new < cost:
            x = x + delta
            r = trial
            cost = new
            lam = max(lam / 3.0, 1e-6) if lam > 0 else 0.0
        else:
            lam = min(5.0 * lam, 1e6)
        history.append(float(np.linalg.norm(delta)))
        recent = history[-STALL_WINDOW:]
        if len(recent) == STALL_WINDOW and max(recent) - min(recent) < STALL_THRESHOLD:
            stop = Stop.STALLED
            break
        if history[-1] < CONVERGENCE:
            stop = Stop.CONVERGED
            break
    return Iterated(x, iterations, start_cost, cost, stop, lam)


def bead_pairs(seen: npt.NDArray[np.bool_]) -> npt.NDArray[np.intp]:
    """List (frame, a, b) of every pair of beads seen together, (m, 3), from (frames,
    beads)."""
    a, b = np.triu_indices(seen.shape[1], 1)
    frame, pair = np.nonzero(seen[:, a] & seen[:, b])
    return np.stack([frame, a[pair], b[pair]], axis=1)


def stacked(
    predicted: FloatArray,
    measured: FloatArray,
    seen: npt.NDArray[np.bool_],
    pairs: npt.NDArray[np.intp],
) -> FloatArray:
    """Compute the residuals of eqs. 5.9, 5.10 and 5.11, one after the other.

    Args:
        predicted: (frames, beads, 2) [px].
        measured: (frames, beads, 2) [px].
        seen: (frames, beads).
        pairs: (m, 3) frame and two beads, of `bead_pairs`.

    Returns:
        Predicted less measured: coordinates of seen beads, then distances of pairs [px].
    """
    frame, a, b = pairs.T
    near = np.linalg.norm(predicted[frame, a] - predicted[frame, b], axis=1)
    real = np.linalg.norm(measured[frame, a] - measured[frame, b], axis=1)
    return np.concatenate([(predicted - measured)[seen].ravel(), near - real])


def _half_square(r: FloatArray) -> float:
    return float(0.5 * r @ r)
