"""Motion during a scan: parameters that differ from frame to frame, found from bead tracks.

A parameter that moves is its value in the fit plus a deviation in each frame, whose mean
over the scan is zero. Deviations are normal, smaller where they bend more, by a width and
a smoothness that maximise the restricted likelihood of the tracks (REML; Patterson and
Thompson, Biometrika 58 (1971) 545). So a screw, a drift and a wobble come out smooth,
jitter comes out frame by frame, and motion that the tracks do not show stays zero. The
slope at either end is free: deviations assumed level there make a drift, which is not,
look like a motion that turns once with the table.

The estimate is linear in small deviations. The caller puts them into the poses, fits
again, and estimates the remainder, until they stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import linalg

from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.evidence import Table
from flexdt.twin.calibration.fit.fit import LEAST_NOISE, FitResult
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factor, layout
from flexdt.twin.calibration.fit.residual_structure import cross
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import Motion, require_movable
from flexdt.twin.geometry.offsets import NAMES

WIDTHS: Final = tuple(10.0 ** (0.5 * k) for k in range(-2, 9))
"""Trial widths, in units of the sigma from one frame."""
WAVES: Final = (1.0, 4.0, 16.0, 64.0, math.inf)
"""Trial smoothness: half waves in a scan above which amplitudes fall; inf: no fall."""
COLUMNS: Final = 512
"""Number of covariance columns processed at a time."""
MAX_LIKELIHOOD_LOSS: Final = 2.0
"""Loss of log likelihood up to which width and smoothness are not rejected."""
ONE_PERIOD: Final = 2
"""Half waves of the cosine with one period a scan."""
MOST_PASSES: Final = 6
BESIDE_BEAM: Final = 0.01
"""Standard deviation of the slope of a motion along the beam against it: 6 mm in 600;
assumed."""
MIN_EVIDENCE: Final = 6.0
"""Gain in log likelihood from which a parameter counts as moving: white noise has it in less
than one of a thousand fits (55 pairs of width and smoothness are tried)."""
_Answer = tuple[FloatArray, FloatArray, FloatArray, float]
"""Deviations (n, p) with sigmas, the covariance that they add to the fit's columns, and
the factor by which they take up its degrees of freedom."""
_Choice = tuple[tuple[float, float] | None, ...]
"""Width and smoothness of each parameter; None: it does not move."""


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Motion that bead tracks show.

    Attributes:
        motions: of each scan (group of frames).
        covariance: (p, p) covariance that the unknown motion adds to the fit's
            parameters, edge units.
        choice: width and smoothness of each parameter's deviations; None: it does not move.
    """

    motions: tuple[Motion, ...]
    covariance: FloatArray
    choice: _Choice

    def near(self, other: MotionFit) -> bool:
        """Check whether the deviations differ by less than a hundredth of a sigma."""
        return all(a.near(b) for a, b in zip(self.motions, other.motions, strict=True))


def estimate_motion(
    fit: FitResult,
    names: Sequence[str],
    known: MotionFit | None = None,
    *,
    search: bool = True,
) -> MotionFit:
    """Estimate the motion in the tracks of a fit, by a linear mixed model about it.

    Frames whose positions were mostly left out of the fit count entirely: that is motion.

    Args:
        fit: parameters that are the same in all frames, with poses that hold the motion
            `known`.
        names: parameters that may move, of `geometry.motion.MOVABLE`.
        known: motion that the fit's poses hold; None: no motion.
        search: for the most likely width and smoothness; else those of `known` are taken.

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
    x = fit.solution.x
    group = problem.group
    sizes = np.bincount(group)
    if sizes.min() < 3:
        raise TwinError(
            f"motion in a scan of {sizes.min()} frames; allowed: 3 or more",
            {"asked": int(sizes.min()), "allowed": 3},
        )
    use = _used(problem, fit)
    keep = np.repeat(use.ravel(), 2)
    frame = np.repeat(np.arange(len(group)), 2 * problem.seen.shape[1])[keep]
    noise = max(
        LEAST_NOISE, fit.certificate.noise
    )  # in this order also where that is nan
    residual = problem.whitened(x).ravel()[keep]
    rows = problem.jacobian(x, use)[keep]
    motion = np.stack(
        [derivative(problem, fit, name, use)[keep] for name in names], axis=1
    )
    if known is not None:
        held = np.concatenate([m.values for m in known.motions])
        residual = residual + np.einsum("mp,mp->m", motion, held[frame])
    indices = [NAMES.index(name) for name in names]
    model = _Mixed(
        rows,
        residual,
        motion,
        frame,
        sizes.tolist(),
        problem.layout.colmap[:, indices][group],
        problem.prior_weight(noise),
        problem.prior_mean - x,
    )
    try:
        if search or known is None:
            choice, evidence = _most_likely(model)
        else:
            choice = known.choice
            evidence = list(known.motions[0].evidence)
        values, sigma, added, inflation = model.solved(choice)
    except np.linalg.LinAlgError:
        raise TwinError(
            f"the tracks tell too little to find how {', '.join(names)} move; allowed: fewer "
            "parameters, or more frames and beads"
        ) from None
    motions = tuple(
        Motion(tuple(names), values[group == g], sigma[group == g], tuple(evidence))
        for g in range(len(sizes))
    )
    count = problem.layout.parameter_count
    factor = np.array([edge_factor(column) for column in problem.layout.names[:count]])
    more = added[:count, :count] * np.outer(factor, factor)
    if fit.identifiable:
        unit_covariance = fit.certificate.spectrum.unit_covariance[:count, :count]
        more = more + (inflation - 1.0) * noise**2 * unit_covariance
    return MotionFit(motions, more, choice)


def follow_motion(
    fit: FitResult,
    names: Sequence[str],
    refit: Callable[[MotionFit], FitResult],
    known: MotionFit | None = None,
) -> tuple[FitResult, MotionFit]:
    """Estimate motion and the other parameters by turns until the motion stays
    (`MotionFit.near`), `MOST_PASSES` at most.

    Args:
        fit: to poses that hold the motion `known`.
        names: parameters that may move.
        refit: the fit to poses that hold another motion.
        known: None: no motion.

    Returns:
        The last fit, and the motion its poses hold. `aware` gives the fit's sigmas with
        it.

    Raises:
        TwinError: as `estimate_motion`.
    """
    for _ in range(MOST_PASSES):
        found = estimate_motion(fit, names, known)
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
        A wider fit; `fit` itself if it is not identifiable.
    """
    if not fit.identifiable:
        return fit
    names = held.motions[0].names
    more = estimate_motion(fit, names, held, search=False).covariance
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
        along[frame] * derivative(problem, fit, name, use) for name in ("dO_x", "dO_y")
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
    factor = np.array([edge_factor(name) for name in problem.layout.names[:count]])
    return np.asarray(
        (vectors * np.maximum(values, 0.0)) @ vectors.T * np.outer(factor, factor)
    )


def _used(problem: FitProblem, fit: FitResult) -> npt.NDArray[np.bool_]:
    """Mark the used positions, and all seen ones of a frame whose positions were mostly
    left out, (n, k).

    Single beads left out are outliers, all of them together are motion.
    """
    use = fit.solution.use.copy()
    lost = (problem.seen & ~use).sum(axis=1) > 0.5 * problem.seen.sum(axis=1)
    use[lost] = problem.seen[lost]
    return use


def derivative(
    problem: FitProblem, fit: FitResult, name: str, use: npt.NDArray[np.bool_]
) -> FloatArray:
    """Compute the whitened change of the positions with one frame's parameter, free or
    not; beads and other parameters stay.

    Args:
        problem: of the fit.
        fit: gives the column values.
        name: of the parameter.
        use: (n, k) positions that count; others have 0.

    Returns:
        (2 n k,), an internal unit.
    """
    params, beads = problem.spread(fit.solution.x)
    groups = len(params)
    alone = layout((name,), groups, (name,), len(beads), False)
    still = replace(problem, base=params, layout=alone, panel=None, curvature=None)
    moved = replace(still, model=replace(problem.model, beads=beads))
    return np.asarray(moved.jacobian(moved.start, use).sum(axis=1))


class _Mixed:
    """Linear mixed model: the fit's g columns, and p parameters' deviations in n frames.

    The prior precision of a parameter's deviations is (1 + D'D / l^2) / v, with D the second
    differences of frames: it has five diagonals, so everything is solved in bands. Its
    directions are nearly cosines of the frame's number.

    Attributes:
        plain: (g, g) normal equations of the fit's columns, scaled, with their priors.
        push: (g,) right-hand side of the same.
        pairs, mixed, pull: (n, p, p), (n, g, p), (n, p): sums over each frame's rows of two
            derivatives, of one and a column, of one and the residual.
        scale: (g,) length of the fit's columns.
        total: sum of squares of the residuals, priors included.
        freedom: number of rows and priors less g.
        sizes: frames of each scan.
        column: (n, p) column of the fit to which a deviation belongs; -1: to no column.
    """

    def __init__(
        self,
        rows: FloatArray,
        residual: FloatArray,
        motion: FloatArray,
        frame: npt.NDArray[np.intp],
        sizes: Sequence[int],
        column: npt.NDArray[np.int64],
        weight: FloatArray,
        off: FloatArray,
    ) -> None:
        """Sum up the normal equations, with columns scaled to unit length; the rows are
        not kept.

        Args:
            rows: (m, g) derivatives by the fit's columns.
            residual: (m,).
            motion: (m, p) derivatives by the parameters of each row's frame.
            frame: (m,) of each row.
            sizes: frames of each scan.
            column: (n, p), see the class.
            weight: (g,) of the priors; 0 without.
            off: (g,) distance of their means.
        """
        n = sum(sizes)
        p = motion.shape[1]
        g = rows.shape[1]
        self.sizes = sizes
        self.column = column
        self.scale = np.sqrt(np.einsum("mg,mg->g", rows, rows) + weight)
        self.scale[self.scale == 0.0] = 1.0
        rows = rows / self.scale
        weight = weight / self.scale**2
        off = off * self.scale
        self.pairs = np.zeros((n, p, p))
        self.mixed = np.zeros((n, g, p))
        self.pull = np.zeros((n, p))
        np.add.at(self.pairs, frame, motion[:, :, None] * motion[:, None, :])
        np.add.at(self.mixed, frame, rows[:, :, None] * motion[:, None, :])
        np.add.at(self.pull, frame, motion * residual[:, None])
        self.plain = cross(rows, rows) + np.diag(weight + 1e-10)
        self.push = np.einsum("mg,m->g", rows, residual) + weight * off
        self.total = float(np.sum(residual**2) + np.sum(weight * off**2))
        self.freedom = max(len(residual) + int((weight > 0).sum()) - g, 1)

    def spectrum(self, i: int, pick: tuple[float, float]) -> list[FloatArray]:
        """Compute the variance of the amplitude of each scan's cosines, for deviations
        that are level at the ends.

        Args:
            i: number of the parameter.
            pick: width, in sigmas from one frame, and smoothness of its motion.

        Returns:
            For each scan (frames,), by the number of half waves, falling; the mean from
            one half wave on is the squared width.
        """
        width, waves = pick
        one_frame = 1.0 / max(float(self.pairs[:, i, i].mean()), 1e-300)
        out = []
        for size in self.sizes:
            bends = (2.0 * np.sin(0.5 * math.pi * np.arange(size) / size)) ** 2
            shares = 1.0 / (1.0 + (bends / _stiffness(size, waves)) ** 2)
            out.append(width**2 * one_frame * shares * (size - 1) / shares[1:].sum())
        return out

    def _diagonals(self, i: int, pick: tuple[float, float]) -> FloatArray:
        """Compute the prior precision of a parameter's deviations, a banded matrix: (1 +
        D'D / stiffness^2) / variance of each scan.

        Args:
            i: number of the parameter.
            pick: width and smoothness of its motion.

        Returns:
            (3, n) the main diagonal and the two below it, for n frames; scans are not
            connected.
        """
        parts = []
        for size, variance in zip(self.sizes, self.spectrum(i, pick), strict=True):
            inner = np.ones(size - 2)  # frames with a second difference [1, -2, 1]
            diagonal = np.convolve(inner, [1.0, 4.0, 1.0])
            beside = np.r_[np.convolve(inner, [-2.0, -2.0]), 0.0]
            squared = np.stack([diagonal, beside, np.r_[inner, 0.0, 0.0]])
            squared /= _stiffness(size, pick[1]) ** 2
            squared[0] += 1.0
            parts.append(squared / variance[0])
        return np.concatenate(parts, axis=1)

    def _factor(self, moving: Sequence[int], choice: _Choice) -> FloatArray:
        """Factorise the deviations' normal equations, frame by frame (banded Cholesky);
        raises LinAlgError if they are not positive definite.

        Args:
            moving: numbers of the p moving parameters.
            choice: width and smoothness of each parameter; those of moving ones are not
                None.

        Returns:
            (2 p + 1, n p) lower Cholesky factor as `scipy.linalg.cho_solve_banded` takes
            it.
        """
        n = len(self.pull)
        p = len(moving)
        band = np.zeros((2 * p + 1, n, p))
        for a, i in enumerate(moving):
            for b in range(a + 1):
                band[a - b, :, b] = self.pairs[:, i, moving[b]]
            pick = choice[i]
            assert pick is not None
            band[[0, p, 2 * p], :, a] += self._diagonals(i, pick)
        return np.asarray(
            linalg.cholesky_banded(
                band.reshape(2 * p + 1, n * p), lower=True, check_finite=False
            )
        )

    def _eliminated(self, choice: _Choice) -> _Eliminated:
        """Eliminate the deviations of a choice from the normal equations (Schur
        complement).

        Args:
            choice: width and smoothness of each parameter; None for one that does not
                move.

        Returns:
            The reduced equations, and the factors with which deviations follow from their
            solution; the equations as they are, with empty factors, if nothing moves.
        """
        moving = [i for i, pick in enumerate(choice) if pick is not None]
        if not moving:
            empty = np.zeros((0, len(self.scale)))
            return _Eliminated(
                (), np.zeros((1, 0)), empty, empty, self.plain, self.push, 0.0
            )
        band = self._factor(moving, choice)
        across = self.mixed[:, :, moving].transpose(0, 2, 1).reshape(-1, len(self.scale))
        pull = self.pull[:, moving].ravel()
        both = linalg.cho_solve_banded((band, True), np.column_stack([across, pull]))
        inner = both[:, :-1]
        alone = both[:, -1]
        return _Eliminated(
            tuple(moving),
            band,
            across,
            inner,
            self.plain - cross(across, inner),
            self.push - np.einsum("ng,n->g", across, alone),
            float(np.sum(pull * alone)),
        )

    def likelihood(self, choice: _Choice) -> float:
        """Compute the logarithm of the restricted likelihood of a choice of motions, up
        to a constant; the noise is eliminated.

        Args:
            choice: width and smoothness of each parameter; None: it does not move.

        Raises:
            LinAlgError: the equations are singular.
        """
        part = self._eliminated(choice)
        lower = linalg.cholesky(part.left, lower=True, check_finite=False)
        found = linalg.solve_triangular(lower, part.push, lower=True)
        rest = max(self.total - part.explained - float(np.sum(found**2)), LEAST_NOISE**2)
        volume = 2.0 * (np.log(np.diag(lower)).sum() + np.log(part.band[0]).sum())
        for i, pick in enumerate(choice):
            if pick is not None:
                alone = linalg.cholesky_banded(self._diagonals(i, pick), lower=True)
                volume -= 2.0 * float(np.log(alone[0]).sum())
        return float(-0.5 * (volume + self.freedom * math.log(rest)))

    def solved(self, choice: _Choice) -> _Answer:
        """Solve for the deviations of a choice.

        Args:
            choice: width and smoothness of each parameter; None: it does not move.

        Returns:
            See `_Answer`. Deviations (n, parameters) are from their mean, with their
            sigmas, internal units; parameters that do not move have deviations 0 and
            sigmas nan. The covariance (g, g) is the one added to the fit's columns, and
            the last is a factor of 1 or more.
        """
        part = self._eliminated(choice)
        inverse = linalg.inv(part.left)
        fixed = inverse @ part.push
        n = len(self.pull)
        p = len(part.moving)
        rest = max(self.total - part.explained - float(fixed @ part.push), 0.0)
        noise2 = rest / self.freedom
        values = np.zeros((n, len(choice)))
        sigma = np.full((n, len(choice)), np.nan)
        taken = 0.0
        fixed_covariance = inverse
        if p:
            pull = self.pull[:, part.moving].ravel()
            found = linalg.cho_solve_banded((part.band, True), pull) - part.inner @ fixed
            square = np.einsum(
                "ng,gh,nh->n", part.inner, inverse, part.inner, optimize=True
            )
            for begin in range(0, n * p, COLUMNS):
                unit = np.eye(n * p, min(COLUMNS, n * p - begin), -begin)
                columns = linalg.cho_solve_banded((part.band, True), unit)
                at = np.arange(unit.shape[1])
                square[begin + at] += columns[begin + at, at]
            # Deviations are from their mean, which is the parameter's own value.
            place = np.arange(n * p)
            own = self.column[:, part.moving]
            labels = (own - own.min() + 1) * p + np.arange(p)
            kinds, first, mean_of = np.unique(
                labels.ravel(), return_index=True, return_inverse=True
            )
            size = np.bincount(mean_of).astype(np.float64)
            each = np.zeros((n * p, len(kinds)))
            each[place, mean_of] = 1.0 / size[mean_of]
            with_mean = linalg.cho_solve_banded((part.band, True), each)
            with_fixed = -inverse @ (part.inner.T @ each)
            with_mean -= part.inner @ with_fixed
            of_means = np.einsum("nc,nd->cd", each, with_mean)
            values[:, part.moving] = (found - (found @ each)[mean_of]).reshape(n, p)
            centred = (
                square - 2.0 * with_mean[place, mean_of] + np.diag(of_means)[mean_of]
            )
            # The fit's columns are then those values and the means together.
            into = np.zeros((len(self.scale), len(kinds)))
            for kind, into_column in enumerate(own.ravel()[first].tolist()):
                if into_column >= 0:
                    into[into_column, kind] = self.scale[into_column]
            both = with_fixed @ into.T
            fixed_covariance = inverse + both + both.T + into @ of_means @ into.T
            # What the data add to each deviation's prior is what they take of the freedom.
            information = np.einsum("nii->ni", self.pairs)[:, part.moving].ravel()
            taken = float(np.sum(np.minimum(information * square, 1.0)))
            sigma[:, part.moving] = np.sqrt(noise2 * np.maximum(centred, 0.0)).reshape(
                n, p
            )
        added = noise2 * (fixed_covariance - linalg.inv(self.plain))
        added = added / np.outer(self.scale, self.scale)
        return values, sigma, added, self.freedom / max(self.freedom - taken, 1.0)


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """Normal equations of the fit's columns once the deviations are eliminated: `left`
    (g, g) and `push` (g,), with the banded factor, the eliminated parameters, and the sum
    of squares explained.
    """

    moving: tuple[int, ...]
    band: FloatArray
    across: FloatArray
    inner: FloatArray
    left: FloatArray
    push: FloatArray
    explained: float


def _stiffness(size: int, waves: float) -> float:
    """Compute the eigenvalue of the second differences at which amplitudes fall.

    Args:
        size: frames of the scan.
        waves: half waves in the scan; inf for as many as frames or more.
    """
    if waves < size:
        return (2.0 * math.sin(0.5 * math.pi * waves / size)) ** 2
    return math.inf


def _most_likely(model: _Mixed) -> tuple[_Choice, list[float]]:
    """Choose width and smoothness of each parameter, by turns, and the evidence that it
    moves at all.

    Each climbs on the grid of WIDTHS and WAVES from two starts; parameters of less than
    `MIN_EVIDENCE` are dropped, the least first. One scan hardly determines a width: among
    the values that it does not reject (`MAX_LIKELIHOOD_LOSS`) and that are no narrower,
    the choice leaves most room to motions that turn once with the table, which other
    parameters do too.

    Args:
        model: of all parameters.

    Returns:
        Width and smoothness of each parameter, None if it does not move; and the gain in
        log likelihood of each.
    """
    p = model.pairs.shape[1]
    middle = (WIDTHS[3], WAVES[2])
    starts = ((3, 1), (3, len(WAVES) - 1))
    choice: list[tuple[float, float] | None] = [middle] * p
    known: dict[_Choice, float] = {}

    def likelihood(i: int, pick: tuple[float, float] | None) -> float:
        """Compute the log likelihood with parameter `i` at `pick` and the others as chosen;
        cached.
        """
        whole = (*choice[:i], pick, *choice[i + 1 :])
        if whole not in known:
            known[whole] = model.likelihood(whole)
        return known[whole]

    def climbed(i: int, at: tuple[int, int]) -> tuple[int, int]:
        """Find the best place (width, smoothness, as indices) of the grid for parameter
        `i` that is reached uphill from `at`, by steps to the eight neighbours.
        """
        while True:
            around = [
                (w, t)
                for w, t in product(
                    range(at[0] - 1, at[0] + 2), range(at[1] - 1, at[1] + 2)
                )
                if 0 <= w < len(WIDTHS) and 0 <= t < len(WAVES)
            ]
            best = max(
                around, key=lambda one: likelihood(i, (WIDTHS[one[0]], WAVES[one[1]]))
            )
            if best == at:
                return at
            at = best

    for _ in range(2 if p > 1 else 1):
        for i in range(p):
            tops = [climbed(i, start) for start in starts]
            picks = [(WIDTHS[w], WAVES[t]) for w, t in tops]
            choice[i] = max((likelihood(i, pick), pick) for pick in picks)[1]
    evidence = [0.0] * p
    while True:
        moving = [i for i in range(p) if choice[i] is not None]
        for i in moving:
            evidence[i] = likelihood(i, choice[i]) - likelihood(i, None)
        least = min(moving, key=lambda i: evidence[i], default=-1)
        if least < 0 or evidence[least] >= MIN_EVIDENCE:
            break
        choice[least] = None
    for i, best in enumerate(choice):
        if best is None:
            continue
        top = likelihood(i, best)
        fair = [
            pick
            for pick in product(WIDTHS, WAVES)
            if pick[0] >= best[0] and likelihood(i, pick) >= top - MAX_LIKELIHOOD_LOSS
        ]
        choice[i] = max((model.spectrum(i, pick)[0][ONE_PERIOD], pick) for pick in fair)[
            1
        ]
    return tuple(choice), evidence
