"""What a fit and its sigmas become where beads may move."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from flexdt.twin.calibration.diagnose.causes import LEAST_BEADS, Known
from flexdt.twin.calibration.diagnose.causes.candidates import clipped, usual_noise
from flexdt.twin.calibration.diagnose.slipped.piece import LEAST_SIDE
from flexdt.twin.calibration.diagnose.slipped.trial import Trial, Verdict
from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.evidence import LOG_CHANCE
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors, layout
from flexdt.twin.calibration.fit.residual_structure import larger
from flexdt.twin.geometry.conventions import FloatArray

SEEN_CHANCE: Final = 0.01
"""Probability that chance makes a right scan worth a closer look."""
LEAST_FRAMES: Final = 8
"""Number of frames of a scan in which beads are told to move."""


def with_loose_beads(
    plain: FitResult, fit: FitResult, known: Known
) -> tuple[FitResult, Verdict | None]:
    """Judge whether beads move against each other, and widen the sigmas of a fit where that
    is open.

    Args:
        plain: fit without causes of the residuals.
        fit: the same with them.
        known: statements on the phantom and the positions.

    Returns:
        The fit, wider where the residuals speak for beads that move but do not prove it, and
        the verdict if it is beyond doubt; `fit` and None for fewer than `LEAST_FRAMES`
        frames or `LEAST_BEADS` beads, and where no bead steps more than chance makes it.
    """
    n, k = plain.problem.seen.shape
    if n < LEAST_FRAMES or k < LEAST_BEADS or not _steps(fit, known.floor):
        return fit, None
    trial = Trial(plain, fit, known)
    best: Verdict | None = None
    for pieces in trial.found():
        verdict = trial.judged(pieces)
        if best is None or verdict.odds > best.odds:
            best = verdict
        if best.named and len(best.pieces) == 1:
            # Several may be the parts of a course that follows no rule.
            return fit, best
    if best is not None and best.named:
        return fit, best
    if best is None or best.odds < LOG_CHANCE:
        return fit, None
    return _widened(plain, fit, best), None


def _widened(plain: FitResult, fit: FitResult, verdict: Verdict) -> FitResult:
    """Widen the sigmas of a fit to those that it has where beads move, too; not of one
    that is not determined.
    """
    if not fit.determined:
        return fit
    count = plain.problem.layout.parameter_count
    factor = edge_factors(plain.problem.layout.names[:count])
    change = fit.solution.x[:count] - plain.solution.x[:count]
    off = (verdict.moved.mean[:count] - change) * factor
    own = fit.certificate.covariance
    other = verdict.moved.covariance(count) * np.outer(factor, factor)
    both = larger(own, other + np.outer(off, off))
    return replace(fit, certificate=widened(fit.certificate, both - own))


def _steps(fit: FitResult, floor: float) -> bool:
    """Check whether a bead's place before or after some frame differs from what the fit has,
    by more than chance makes it in `SEEN_CHANCE` of scans.

    Args:
        fit: whose residuals are looked at.
        floor: least standard deviation of whitened residuals.
    """
    problem = fit.problem
    n, k = problem.seen.shape
    residual = problem.whitened(fit.solution.x)
    lengths = np.linalg.norm(residual, axis=2)
    noise = usual_noise(lengths[problem.seen], floor)
    if not noise > 0.0:
        return False
    share = clipped(lengths, noise)[..., None]
    own = _own_columns(problem, fit.solution.x).reshape(n, k, 2, k, 3)
    slope = np.einsum("nbcbx->nbcx", own) * share[..., None]
    push = np.einsum("nbcx,nbc->nbx", slope, residual * share)
    gram = np.einsum("nbcx,nbcy->nbxy", slope, slope)
    most = 0.0
    for way in (1, -1):  # It may be the fit's place before, or after.
        sums = np.cumsum(push[::way], axis=0)[LEAST_SIDE - 1 : n - LEAST_SIDE]
        squares = np.cumsum(gram[::way], axis=0)[LEAST_SIDE - 1 : n - LEAST_SIDE]
        power = np.trace(squares, axis1=2, axis2=3)[..., None, None]
        squares = squares + (1e-9 * power + 1e-300) * np.eye(3)
        steps = np.linalg.solve(squares, sums[..., None])[..., 0]
        most = max(most, float(np.einsum("nbx,nbx->nb", sums, steps).max(initial=0.0)))
    return most > noise**2 * float(chdtri(3, SEEN_CHANCE / (2 * n * k)))


def _own_columns(problem: FitProblem, x: FloatArray) -> FloatArray:
    """Compute whitened rows of the beads' coordinates, (2 n k, 3 k) [1/mm]."""
    params, beads = problem.spread(x)
    alone = layout((), len(params), (), len(beads), True)
    model = replace(problem.model, beads=beads)
    free = replace(
        problem, base=params, layout=alone, model=model, panel=None, turning=None
    )
    return free.jacobian(free.start, problem.seen)
