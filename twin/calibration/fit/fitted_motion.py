"""Motion during a scan: parameters that differ from frame to frame, found from bead tracks.

A parameter that moves is its value in the fit plus a deviation in each frame, whose mean
over the scan is zero. Deviations jump, drift evenly, or are normal and smaller where they
bend more, by a width and a smoothness that maximise the restricted likelihood of the tracks
(REML; Patterson and Thompson, Biometrika 58 (1971) 545). So a screw, a drift and a wobble
come out smooth, jitter comes out frame by frame, and motion that the tracks do not show
stays zero. The slope at either end is free: deviations assumed level there make a drift,
which is not, look like a motion that turns once with the table.

Object, source and panel that move the same way look alike, and what moves is taken up in
part by anything else that may: whichever is asked for, all are candidates. The most likely
moves; what the others would make of the fit is averaged into its sigmas.

The estimate is linear in small deviations. The caller puts them into the poses, fits
again, and estimates the remainder, until they stay.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.evidence import Table
from flexdt.twin.calibration.fit.fit import LEAST_NOISE, FitResult
from flexdt.twin.calibration.fit.motion_model import (
    Answer,
    MotionChoice,
    MotionModel,
)
from flexdt.twin.calibration.fit.motion_search import Likely, most_likely, moves
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors, layout
from flexdt.twin.calibration.fit.residual_structure import with_lost_frames
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import MOVABLE, Motion, require_movable
from flexdt.twin.geometry.offsets import NAMES

MOST_PASSES: Final = 6
SEARCHES: Final = 2
"""Passes that search for what moves; later ones keep what was found."""
BESIDE_BEAM: Final = 0.01
"""Standard deviation of the slope of a motion along the beam against it: 6 mm in 600;
assumed."""


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Motion that bead tracks show.

    Attributes:
        asked: parameters that were asked for; others move where the tracks show it.
        motions: of each scan (group of frames): the asked parameters, and others that
            move.
        covariance: (p, p) covariance that the unknown motion adds to the fit's
            parameters, edge units.
        likely: the priors of the deviations of all candidates, and their rivals.
    """

    asked: tuple[str, ...]
    motions: tuple[Motion, ...]
    covariance: FloatArray
    likely: Likely

    @property
    def moving(self) -> tuple[str, ...]:
        """The parameters that move."""
        return self._of(self.likely.choice)

    def alike(self, least: float) -> tuple[tuple[str, ...], ...]:
        """List other sets of parameters that may move instead, the most probable first.

        Args:
            least: probability of a set in units of that of the one that moves.
        """
        sums: dict[tuple[str, ...], float] = {}
        for choice, weight in self.likely.rivals:
            names = self._of(choice)
            sums[names] = sums.get(names, 0.0) + weight
        sums.pop(self.moving, None)
        ranked = sorted(sums, key=lambda names: -sums[names])
        return tuple(names for names in ranked if sums[names] >= least)

    def _of(self, choice: MotionChoice) -> tuple[str, ...]:
        """Return the names of the parameters that a choice moves."""
        names = candidates(self.asked)
        return tuple(names[i] for i in sorted(moves(choice)))

    def near(self, other: MotionFit) -> bool:
        """Check whether the same parameters move, and by less than a hundredth of a sigma
        otherwise.
        """
        if self.motions[0].names != other.motions[0].names:
            return False
        return all(a.near(b) for a, b in zip(self.motions, other.motions, strict=True))


def candidates(asked: Sequence[str]) -> tuple[str, ...]:
    """Return the asked parameters, then all others that may move."""
    return tuple(dict.fromkeys((*asked, *MOVABLE)))


def estimate_motion(
    fit: FitResult,
    names: Sequence[str],
    known: MotionFit | None = None,
    *,
    search: bool = True,
    exact: Collection[str] = (),
) -> MotionFit:
    """Estimate the motion in the tracks of a fit, by a linear mixed model about it.

    Frames whose positions were mostly left out of the fit count entirely: that is motion.

    Args:
        fit: parameters that are the same in all frames, with poses that hold the motion
            `known`.
        names: parameters that may move, of `geometry.motion.MOVABLE`; so may the others.
        known: motion that the fit's poses hold, found with the same names; None: no motion.
        search: for what moves, and how; else that of `known` is taken.
        exact: parameters that are stated to be exactly known: they move only where the
            tracks contradict that.

    Returns:
        The total motion of each scan, `known` included. A parameter that the scans share
        has deviations from its mean over all of their frames; one that does not move has
        deviations 0 and sigmas nan.

    Raises:
        UnknownNameError: a name that cannot move.
        TwinError: fewer than three frames in a scan, or tracks without information.
    """
    require_movable(names)
    problem = fit.problem
    group = problem.group
    sizes = np.bincount(group)
    if sizes.min() < 3:
        raise TwinError(
            f"motion in a scan of {sizes.min()} frames; allowed: 3 or more",
            {"asked": int(sizes.min()), "allowed": 3},
        )
    everything = candidates(names)
    model = _model(fit, everything, known)
    try:
        if search or known is None:
            start = None if known is None else known.likely.choice
            held = [i for i, n in enumerate(everything) if n in exact and n not in names]
            likely = most_likely(model, len(names), start, held)
        else:
            likely = known.likely
        best = model.solved(likely.choice)
        others = [(model.solved(choice), w) for choice, w in likely.rivals]
    except np.linalg.LinAlgError:
        raise TwinError(
            f"the tracks tell too little to find how {', '.join(names)} move; allowed: fewer "
            "parameters, or more frames and beads"
        ) from None
    sigma, added = _averaged(best, others)
    shown = [i for i, n in enumerate(everything) if n in names or likely.choice[i]]
    motions = tuple(
        Motion(
            tuple(everything[i] for i in shown),
            best.values[group == g][:, shown],
            sigma[group == g][:, shown],
            tuple(likely.gains[i] for i in shown),
        )
        for g in range(len(sizes))
    )
    count = problem.layout.parameter_count
    factor = edge_factors(problem.layout.names[:count])
    more = added[:count, :count] * np.outer(factor, factor)
    if fit.determined:
        noise = max(LEAST_NOISE, fit.certificate.noise)
        unit_covariance = fit.certificate.spectrum.unit_covariance[:count, :count]
        more = more + (best.inflation - 1.0) * noise**2 * unit_covariance
    return MotionFit(tuple(names), motions, more, likely)


def _model(fit: FitResult, names: Sequence[str], known: MotionFit | None) -> MotionModel:
    """Make the linear model of the motion in a fit's tracks.

    Args:
        fit: with poses that hold the motion `known`.
        names: parameters that may move.
        known: its deviations are put back into the residuals; None: no motion.
    """
    problem = fit.problem
    x = fit.solution.x
    group = problem.group
    use = counted(problem, fit)
    keep = np.repeat(use.ravel(), 2)
    frame = np.repeat(np.arange(len(group)), 2 * problem.seen.shape[1])[keep]
    noise = max(
        LEAST_NOISE, fit.certificate.noise
    )  # in this order also where that is nan
    residual = problem.whitened(x).ravel()[keep]
    motion = np.stack(
        [derivative(problem, fit.solution.x, name, use)[keep] for name in names], axis=1
    )
    if known is not None:
        moved = known.motions[0].names
        held = np.concatenate([m.values for m in known.motions])
        own = motion[:, [names.index(name) for name in moved]]
        residual = residual + np.einsum("mp,mp->m", own, held[frame])
    indices = [NAMES.index(name) for name in names]
    return MotionModel(
        problem.jacobian(x, use)[keep],
        residual,
        motion,
        frame,
        np.bincount(group).tolist(),
        problem.layout.colmap[:, indices][group],
        problem.prior_weight(noise),
        problem.prior_mean - x,
    )


def _averaged(
    best: Answer, others: Sequence[tuple[Answer, float]]
) -> tuple[FloatArray, FloatArray]:
    """Average over choices, about the most likely one: their variances, and the squares of
    their differences from it.

    Args:
        best: of the most likely choice, of weight 1.
        others: the answers of its rivals, with their weights.

    Returns:
        (n, p) sigmas of the deviations, nan where the best choice does not move, and (g, g)
        the covariance that is added to the fit's columns.
    """
    total = 1.0 + sum(weight for _, weight in others)
    square = best.sigma**2 / total
    added = best.added / total
    for answer, weight in others:
        off = answer.values - best.values
        square = square + weight / total * (np.nan_to_num(answer.sigma) ** 2 + off**2)
        change = answer.columns - best.columns
        added = added + weight / total * (answer.added + np.outer(change, change))
    return np.sqrt(square), added


def follow_motion(
    fit: FitResult,
    names: Sequence[str],
    refit: Callable[[MotionFit], FitResult],
    known: MotionFit | None = None,
    exact: Collection[str] = (),
) -> tuple[FitResult, MotionFit]:
    """Estimate motion and the other parameters by turns until the motion stays
    (`MotionFit.near`), `MOST_PASSES` at most, of which `SEARCHES` search for what moves.

    Args:
        fit: to poses that hold the motion `known`.
        names: parameters that may move.
        refit: the fit to poses that hold another motion.
        known: None: no motion.
        exact: see `estimate_motion`.

    Returns:
        The last fit, and the motion its poses hold. `aware` gives the fit's sigmas with
        it.

    Raises:
        TwinError: as `estimate_motion`.
    """
    for turn in range(MOST_PASSES):
        found = estimate_motion(fit, names, known, search=turn < SEARCHES, exact=exact)
        fit = refit(found)
        if known is not None and found.near(known):
            break
        known = found
    return fit, found


def aware(fit: FitResult, held: MotionFit) -> FitResult:
    """Add the uncertainty of the motion that is in the poses to the sigmas of a fit, also
    that of its direction along the beam.

    Args:
        fit: to the poses with the motion.
        held: the motion.

    Returns:
        A wider fit with its motions; as wide as before if it is not determined.
    """
    fit = replace(fit, motions=held.motions)
    if not fit.determined:
        return fit
    more = estimate_motion(fit, held.asked, held, search=False).covariance
    more = more + _along_the_beam(fit, held)
    return replace(fit, certificate=widened(fit.certificate, more))


def _along_the_beam(fit: FitResult, held: MotionFit) -> FloatArray:
    """Compute the covariance that a motion along the beam adds by its direction.

    A phantom that grows moves, as seen, away from its mount. The slopes of the direction
    are two more columns with a prior (`BESIDE_BEAM`); the changes that they make are
    taken as errors.

    Args:
        fit: to the poses with the motion.
        held: the motion in them.

    Returns:
        (p, p), edge units; zeros if dO_z does not move or the columns are not separable.
    """
    problem = fit.problem
    x = fit.solution.x
    count = problem.layout.parameter_count
    names = held.motions[0].names
    if "dO_z" not in names:
        return np.zeros((count, count))
    along = np.concatenate([m.values[:, names.index("dO_z")] for m in held.motions])
    use = fit.solution.use
    keep = np.repeat(use.ravel(), 2)
    frame = np.repeat(np.arange(len(along)), 2 * problem.seen.shape[1])
    aside = [
        along[frame] * derivative(problem, fit.solution.x, name, use)
        for name in ("dO_x", "dO_y")
    ]
    rows = np.column_stack([problem.jacobian(x, use), *aside])[keep]
    size = len(x)
    table = Table(rows, problem.whitened(x).ravel()[keep], LEAST_NOISE)
    widths = np.append(problem.prior_sigma, [BESIDE_BEAM] * 2)
    means = np.append(problem.prior_mean - x, [0.0, 0.0])
    exact, free = (
        table.judged(range(n), widths[:n], fit.certificate.noise, means[:n])
        for n in (size, size + 2)
    )
    if exact is None or free is None:
        return np.zeros((count, count))
    off = free.mean[:count] - exact.mean[:count]
    more = free.covariance(count) - exact.covariance(count) + np.outer(off, off)
    values, vectors = np.linalg.eigh(more)
    factor = edge_factors(problem.layout.names[:count])
    return np.asarray(
        (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(factor, factor)
    )


def counted(problem: FitProblem, fit: FitResult) -> npt.NDArray[np.bool_]:
    """Mark the used positions, and all seen ones of a frame whose positions were mostly
    left out, (n, k).
    """
    return with_lost_frames(problem.seen, fit.solution.use)


def derivative(
    problem: FitProblem, x: FloatArray, name: str, use: npt.NDArray[np.bool_]
) -> FloatArray:
    """Compute the whitened change of the positions with one frame's parameter, free or
    not; beads and other parameters stay.

    Args:
        problem: of the fit.
        x: column values.
        name: of the parameter.
        use: (n, k) positions that count; others have 0.

    Returns:
        (2 n k,), an internal unit.
    """
    params, beads = problem.spread(x)
    groups = len(params)
    alone = layout((name,), groups, (name,), len(beads), False)
    still = replace(problem, base=params, layout=alone, panel=None, turning=None)
    moved = replace(still, model=replace(problem.model, beads=beads))
    return np.asarray(moved.jacobian(moved.start, use).sum(axis=1))
