"""Algorithm 2 of the thesis as printed, for comparison with our own fit.

It has reprojection residuals and pairwise distances (eqs. 5.9 to 5.11), central differences (5.15),
normal equations damped by lambda times the identity in mixed mm and rad (5.16), and acceptance,
stall and convergence rules of its own. What the text leaves open is chosen once, below, and
used in every run. Beads are predicted as points; the thesis detects them in rendered projections.
The printed text is not improved on: a rejected step counts towards stall and convergence, and
lambda = 0 stays 0.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.problem import Problem
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets

# What Algorithm 2 leaves unstated (our choice, the same in every run).
CONVERGENCE = 1e-8
"""eta_conv on the norm of a step, mm and rad mixed as in the thesis."""
STEP_MM, STEP_RAD = 1e-3, 1e-5
"""Of finite differences."""
MAX_ITERATIONS = 200
STALL_WINDOW = 5
"""S_w of Algorithm 2."""
STALL_THRESHOLD = 1e-8
"""eta_stall of Algorithm 2."""


class Stop(enum.Enum):
    """Why Algorithm 2 ended."""

    CONVERGED = "converged"
    STALLED = "stalled"
    LIMIT = "iteration limit"
    SINGULAR = "singular normal equations"


@dataclass(frozen=True, eq=False)
class Algorithm2:
    """The outcome of Algorithm 2.

    Attributes:
        x: column values, internal units.
        parameters: the geometry, in the reading of `Poses.cone_vec`.
        iterations: accepted and rejected ones.
        start_cost, cost: half the squared residuals, pairwise ones included.
        stop: why it ended.
        lam: damping at the end.
    """

    x: FloatArray
    parameters: Offsets
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


def algorithm_2(problem: Problem, lam: float = 1e-2) -> Algorithm2:
    """Run Algorithm 2.

    Args:
        problem: tracks with known identities and the free parameters (beads fixed).
        lam: initial damping; 0 is Gauss-Newton and stays 0.
    """
    pairs = _pairs(problem)
    steps = np.array(
        [STEP_RAD if n.split("@")[0] in _ANGLES else STEP_MM for n in problem.layout.names]
    )
    x = problem.start
    r = _residual(problem, pairs, x)
    cost = start_cost = _half_square(r)
    history: list[float] = []
    stop = Stop.LIMIT
    iterations = 0
    while iterations < MAX_ITERATIONS:
        iterations += 1
        jacobian = _differences(problem, pairs, x, steps)
        try:
            delta = np.linalg.solve(jacobian.T @ jacobian + lam * np.eye(len(x)), -jacobian.T @ r)
        except np.linalg.LinAlgError:
            stop = Stop.SINGULAR
            break
        trial = _residual(problem, pairs, x + delta)
        new = _half_square(trial)
        if new < cost:
            x, r, cost = x + delta, trial, new
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
    return Algorithm2(x, problem.parameters(x)[0], iterations, start_cost, cost, stop, lam)


_ANGLES = frozenset(
    {"alpha", "det_roll", "det_pitch", "det_yaw", "axis_tilt_x", "axis_tilt_z", "angle_scale"}
)


def _pairs(problem: Problem) -> npt.NDArray[np.intp]:
    """(frame, a, b) of every pair of beads seen together, (m, 3)."""
    out = []
    for frame, seen in enumerate(problem.seen):
        beads = np.flatnonzero(seen)
        out += [(frame, a, b) for i, a in enumerate(beads) for b in beads[i + 1 :]]
    return np.array(out, dtype=np.intp).reshape(-1, 3)


def _residual(problem: Problem, pairs: npt.NDArray[np.intp], x: FloatArray) -> FloatArray:
    """Eqs. 5.9, 5.10 and 5.11 stacked; inf where a bead is behind the source."""
    try:
        predicted = problem.residuals(x)[0] - problem.origin[:, None, :]
    except TwinError:
        return np.full(1, np.inf)
    direct = (predicted - problem.measured)[problem.seen].ravel()
    frame, a, b = pairs.T
    near = np.linalg.norm(predicted[frame, a] - predicted[frame, b], axis=1)
    real = np.linalg.norm(problem.measured[frame, a] - problem.measured[frame, b], axis=1)
    return np.concatenate([direct, near - real])


def _half_square(r: FloatArray) -> float:
    return float(0.5 * r @ r)


def _differences(
    problem: Problem, pairs: npt.NDArray[np.intp], x: FloatArray, steps: FloatArray
) -> FloatArray:
    """Central differences, eq. 5.15."""
    columns = []
    for j, step in enumerate(steps):
        e = np.zeros_like(x)
        e[j] = step
        ahead, behind = _residual(problem, pairs, x + e), _residual(problem, pairs, x - e)
        columns.append((ahead - behind) / (2.0 * step))
    return np.stack(columns, axis=1)
