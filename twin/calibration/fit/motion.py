"""Motion during a scan: parameters that differ from frame to frame, found from bead tracks.

A parameter that moves is its value in the fit plus a deviation in each frame, whose mean over the
scan is zero. Deviations are sums of cosines of the frame's number with normal amplitudes, smaller
at higher frequencies, by a width and a smoothness that maximise the restricted likelihood of the
tracks (REML; Patterson and Thompson, Biometrika 58 (1971) 545). So a screw, a drift and a wobble
come out smooth, jitter comes out frame by frame, and what the tracks do not show stays zero.

The estimate is linear in small deviations. The caller puts them into the poses, fits again, and
estimates what remains, until they stay.
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

from flexdt.twin.calibration.fit.certificate import spread_of_residuals
from flexdt.twin.calibration.fit.fit import LEAST_NOISE, FitResult
from flexdt.twin.calibration.fit.problem import Problem, edge_factor, layout
from flexdt.twin.calibration.fit.residual_structure import cross
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import Motion, require_movable

WIDTHS: Final = tuple(10.0 ** (0.5 * k) for k in range(-2, 9))
"""Widths that are tried, in units of what one frame can tell."""
TURNS: Final = (1.0, 4.0, 16.0, 64.0, math.inf)
"""Smoothness that is tried: half waves in a scan above which amplitudes fall; inf: none does."""
COLUMNS: Final = 512
"""Columns of the covariance worked on at a time."""
DOUBT: Final = 2.0
"""Width and smoothness are not rejected that lose no more log likelihood."""
ONCE: Final = 2
"""Half waves of the cosine that goes once through a scan."""
MOST_PASSES: Final = 6
EVIDENCE: Final = 6.0
"""Gain in log likelihood from which a parameter counts as moving: white noise has it in less than
one of a thousand fits (55 pairs of width and smoothness are tried)."""


@dataclass(frozen=True, eq=False)
class MotionFit:
    """Motion that the residuals of a fit show, in addition to what its poses hold already.

    Attributes:
        motions: of each scan (group of frames).
        covariance: (p, p) what not knowing the motion adds to the covariance of the fit's
            parameters, edge units.
        inflation: by how much the motion's freedom raises the variance of the noise.
    """

    motions: tuple[Motion, ...]
    covariance: FloatArray
    inflation: float


def estimate_motion(
    fit: FitResult, names: Sequence[str], known: Sequence[Motion] | None = None
) -> MotionFit:
    """Find the motion in the residuals of a fit.

    Args:
        fit: parameters that are the same in all frames, with poses that hold the motion `known`.
        names: parameters that may move, of `geometry.motion.MOVABLE`.
        known: motion of each scan that the fit's poses hold; None: none.

    Returns:
        The whole motion of each scan, `known` included.

    Raises:
        UnknownNameError: a name that cannot move.
        TwinError: fewer than three frames in a scan.
    """
    require_movable(names)
    problem, x = fit.problem, fit.solution.x
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
    noise = max(spread_of_residuals(problem, x, fit.solution.use, 1.0)[0], LEAST_NOISE)
    residual = problem.whitened(x).ravel()[keep]
    rows = problem.jacobian(x, use)[keep]
    motion = np.stack([_derivative(problem, fit, name, use)[keep] for name in names], axis=1)
    held = np.zeros((len(group), len(names)))
    if known is not None:
        held = np.concatenate([m.values for m in known])
        residual = residual + np.einsum("mp,mp->m", motion, held[frame])
    model = _Mixed.of(
        rows, residual, motion, frame, sizes.tolist(), problem.prior_weight(noise),
        problem.prior_mean - x,
    )  # fmt: skip
    chosen, evidence = _most_likely(model)
    answer = model.solved(chosen)
    motions = []
    for g in range(len(sizes)):
        members = group == g
        motions.append(
            Motion(tuple(names), answer.values[members], answer.sigma[members], tuple(evidence))
        )
    columns = problem.layout.names[: problem.layout.parameter_count]
    factor = np.array([edge_factor(column) for column in columns])
    added = answer.added[: len(factor), : len(factor)] * np.outer(factor, factor)
    return MotionFit(tuple(motions), added, answer.inflation)


def follow_motion(
    fit: FitResult,
    names: Sequence[str],
    refit: Callable[[tuple[Motion, ...]], FitResult],
    known: tuple[Motion, ...] | None = None,
) -> tuple[FitResult, tuple[Motion, ...]]:
    """Estimate motion and the other parameters by turns until the motion stays.

    Args:
        fit: to poses that hold the motion `known`; None: none.
        names: parameters that may move.
        refit: the fit to poses that hold other motions, one for each scan.

    Returns:
        The last fit, and the motions its poses hold. `estimate_motion` of both says what not
        knowing the motion adds to the covariance.
    """
    for _ in range(MOST_PASSES):
        found = estimate_motion(fit, names, known).motions
        fit = refit(found)
        if known is not None and all(a.near(b) for a, b in zip(found, known, strict=True)):
            return fit, found
        known = found
    return fit, found


def _used(problem: Problem, fit: FitResult) -> npt.NDArray[np.bool_]:
    """The positions the fit used, and all of a frame whose positions it mostly left out: single
    beads are outliers, all of them together are motion."""
    use = fit.solution.use.copy()
    lost = (problem.seen & ~use).sum(axis=1) > 0.5 * problem.seen.sum(axis=1)
    use[lost] = problem.seen[lost]
    return use


def _derivative(
    problem: Problem, fit: FitResult, name: str, use: npt.NDArray[np.bool_]
) -> FloatArray:
    """(2 n k,) whitened change of the positions with one frame's parameter, free or not."""
    params, beads = problem.spread(fit.solution.x)
    groups = len(params)
    alone = layout((name,), groups, (name,), len(beads), False)
    moved = replace(problem, base=params, layout=alone, model=replace(problem.model, beads=beads))
    return np.asarray(moved.jacobian(moved.start, use).sum(axis=1))


@dataclass(frozen=True, eq=False)
class _Answer:
    """Deviations (n, p) with sigmas, and what they do to the other parameters (see `MotionFit`)."""

    values: FloatArray
    sigma: FloatArray
    added: FloatArray
    inflation: float


_Choice = tuple[tuple[float, float] | None, ...]
"""Width and smoothness of each parameter; None: it does not move."""


@dataclass(frozen=True, eq=False)
class _Mixed:
    """Linear mixed model: the fit's g columns, and p parameters' deviations in n frames.

    The prior precision of a parameter's deviations is (1 + L^2 / l^2) / v, with L the second
    differences of frames (no slope at either end), whose eigenvectors are the cosines: L^2 has
    five diagonals, so everything is solved in bands.

    Attributes:
        plain: (g, g) normal equations of the fit's columns, scaled, with their priors.
        push: (g,) right-hand side of the same.
        pairs, mixed, pull: (n, p, p), (n, g, p), (n, p): sums over each frame's rows of two
            derivatives, of one and a column, of one and the residual.
        scale: (g,) length of the fit's columns.
        total: sum of squares of the residuals, priors included.
        freedom: number of rows and priors less g.
        sizes: frames of each scan.
    """

    plain: FloatArray
    push: FloatArray
    pairs: FloatArray
    mixed: FloatArray
    pull: FloatArray
    scale: FloatArray
    total: float
    freedom: int
    sizes: tuple[int, ...]

    @classmethod
    def of(
        cls,
        rows: FloatArray,
        residual: FloatArray,
        motion: FloatArray,
        frame: npt.NDArray[np.intp],
        sizes: Sequence[int],
        weight: FloatArray,
        off: FloatArray,
    ) -> _Mixed:
        """From rows (m, g), residuals (m,), derivatives (m, p) by each row's frame's parameters,
        and priors of weight (g,) whose means lie (g,) off."""
        n, p = sum(sizes), motion.shape[1]
        scale = np.sqrt(np.einsum("mg,mg->g", rows, rows) + weight)
        scale[scale == 0.0] = 1.0
        rows, weight, off = rows / scale, weight / scale**2, off * scale
        pairs, mixed, pull = np.zeros((n, p, p)), np.zeros((n, rows.shape[1], p)), np.zeros((n, p))
        np.add.at(pairs, frame, motion[:, :, None] * motion[:, None, :])
        np.add.at(mixed, frame, rows[:, :, None] * motion[:, None, :])
        np.add.at(pull, frame, motion * residual[:, None])
        return cls(
            plain=cross(rows, rows) + np.diag(weight + 1e-10),
            push=np.einsum("mg,m->g", rows, residual) + weight * off,
            pairs=pairs,
            mixed=mixed,
            pull=pull,
            scale=scale,
            total=float(np.sum(residual**2) + np.sum(weight * off**2)),
            freedom=max(len(residual) + int((weight > 0).sum()) - rows.shape[1], 1),
            sizes=tuple(int(size) for size in sizes),
        )

    def spectrum(self, i: int, pick: tuple[float, float]) -> list[FloatArray]:
        """Variance of the amplitude of each scan's cosines, from none to the most half waves."""
        width, turns = pick
        one_frame = 1.0 / max(float(self.pairs[:, i, i].mean()), 1e-300)
        out = []
        for size in self.sizes:
            waves = (2.0 * np.sin(0.5 * math.pi * np.arange(size) / size)) ** 2
            shares = 1.0 / (1.0 + (waves / _stiffness(size, turns)) ** 2)
            out.append(width**2 * one_frame * shares * (size - 1) / shares[1:].sum())
        return out

    def _diagonals(self, i: int, pick: tuple[float, float]) -> FloatArray:
        """The three lower diagonals (3, n) of the prior precision of a parameter's deviations."""
        parts = []
        for size, variance in zip(self.sizes, self.spectrum(i, pick), strict=True):
            twice = np.full(size, 2.0)
            twice[[0, -1]] = 1.0
            # Of L^2, with -1 beside the diagonal of L: products of neighbouring rows.
            diagonal = twice**2 + np.r_[1.0, np.full(size - 2, 2.0), 1.0]
            beside = np.r_[-(twice[:-1] + twice[1:]), 0.0]
            after = np.r_[np.ones(size - 2), 0.0, 0.0]
            squared = np.stack([diagonal, beside, after]) / _stiffness(size, pick[1]) ** 2
            squared[0] += 1.0
            parts.append(squared / variance[0])
        return np.concatenate(parts, axis=1)

    def _factor(self, moving: Sequence[int], choice: _Choice) -> FloatArray:
        """Banded Cholesky factor of the deviations' normal equations, frame by frame."""
        n, p = len(self.pull), len(moving)
        band = np.zeros((2 * p + 1, n, p))
        for a, i in enumerate(moving):
            for b in range(a + 1):
                band[a - b, :, b] = self.pairs[:, i, moving[b]]
            pick = choice[i]
            assert pick is not None
            band[[0, p, 2 * p], :, a] += self._diagonals(i, pick)
        return np.asarray(
            linalg.cholesky_banded(band.reshape(2 * p + 1, n * p), lower=True, check_finite=False)
        )

    def _eliminated(self, choice: _Choice) -> _Eliminated:
        moving = [i for i, pick in enumerate(choice) if pick is not None]
        if not moving:
            empty = np.zeros((0, len(self.scale)))
            return _Eliminated((), np.zeros((1, 0)), empty, empty, self.plain, self.push, 0.0)
        band = self._factor(moving, choice)
        across = self.mixed[:, :, moving].transpose(0, 2, 1).reshape(-1, len(self.scale))
        pull = self.pull[:, moving].ravel()
        both = linalg.cho_solve_banded((band, True), np.column_stack([across, pull]))
        inner, alone = both[:, :-1], both[:, -1]
        return _Eliminated(
            tuple(moving), band, across, inner,
            self.plain - cross(across, inner),
            self.push - np.einsum("ng,n->g", across, alone),
            float(np.sum(pull * alone)),
        )  # fmt: skip

    def likelihood(self, choice: _Choice) -> float:
        """Logarithm of the restricted likelihood, but for a constant."""
        part = self._eliminated(choice)
        lower = linalg.cholesky(part.left, lower=True, check_finite=False)
        found = linalg.solve_triangular(lower, part.push, lower=True)
        rest = max(self.total - part.explained - float(np.sum(found**2)), LEAST_NOISE**2)
        volume = 2.0 * (np.log(np.diag(lower)).sum() + np.log(part.band[0]).sum())
        volume += sum(
            float(np.log(variance).sum())
            for i, pick in enumerate(choice)
            if pick is not None
            for variance in self.spectrum(i, pick)
        )
        return float(-0.5 * (volume + self.freedom * math.log(rest)))

    def solved(self, choice: _Choice) -> _Answer:
        """The deviations of a choice."""
        part = self._eliminated(choice)
        inverse = linalg.inv(part.left)
        fixed = inverse @ part.push
        n, p = len(self.pull), len(part.moving)
        rest = max(self.total - part.explained - float(fixed @ part.push), 0.0)
        noise2 = rest / self.freedom
        values, sigma = np.zeros((n, len(choice))), np.full((n, len(choice)), np.nan)
        taken = 0.0
        if p:
            pull = self.pull[:, part.moving].ravel()
            found = linalg.cho_solve_banded((part.band, True), pull) - part.inner @ fixed
            square = np.einsum("ng,gh,nh->n", part.inner, inverse, part.inner, optimize=True)
            for first in range(0, n * p, COLUMNS):
                unit = np.eye(n * p, min(COLUMNS, n * p - first), -first)
                columns = linalg.cho_solve_banded((part.band, True), unit)
                at = np.arange(unit.shape[1])
                square[first + at] += columns[first + at, at]
            # The mean over a scan is the parameter's own value: it is taken away.
            place = np.arange(n * p)
            scan = np.repeat(np.arange(len(self.sizes)), self.sizes)
            column = (scan[:, None] * p + np.arange(p)).ravel()
            size = np.array(self.sizes)[column // p]
            each = np.zeros((n * p, len(self.sizes) * p))
            each[place, column] = 1.0
            with_mean = linalg.cho_solve_banded((part.band, True), each)
            with_mean += part.inner @ (inverse @ (part.inner.T @ each))
            values[:, part.moving] = (found - (found @ each)[column] / size).reshape(n, p)
            centred = square - 2.0 * with_mean[place, column] / size
            centred += np.einsum("nc,nc->c", each, with_mean)[column] / size**2
            # What the data add to each deviation's prior is what they take of the freedom.
            told = np.einsum("nii->ni", self.pairs)[:, part.moving].ravel()
            taken = float(np.sum(np.minimum(told * square, 1.0)))
            sigma[:, part.moving] = np.sqrt(noise2 * np.maximum(centred, 0.0)).reshape(n, p)
        added = noise2 * (inverse - linalg.inv(self.plain)) / np.outer(self.scale, self.scale)
        return _Answer(values, sigma, added, self.freedom / max(self.freedom - taken, 1.0))


@dataclass(frozen=True, eq=False)
class _Eliminated:
    """Normal equations of the fit's columns once the deviations are eliminated: `left` (g, g) and
    `push` (g,), with the banded factor, what was eliminated, and the sum of squares explained."""

    moving: tuple[int, ...]
    band: FloatArray
    across: FloatArray
    inner: FloatArray
    left: FloatArray
    push: FloatArray
    explained: float


def _stiffness(size: int, turns: float) -> float:
    """Eigenvalue of the second differences at which amplitudes fall."""
    return (2.0 * math.sin(0.5 * math.pi * turns / size)) ** 2 if turns < size else math.inf


def _most_likely(model: _Mixed) -> tuple[_Choice, list[float]]:
    """Width and smoothness of each parameter, by turns, and the evidence that it moves at all.

    One scan says little of a width: of what it does not reject the choice is the one that leaves
    most room to what turns once with the table, which other parameters do as well.
    """
    p = model.pairs.shape[1]
    choice: list[tuple[float, float] | None] = [(WIDTHS[3], TURNS[2])] * p
    known: dict[_Choice, float] = {}

    def likelihood(i: int, pick: tuple[float, float] | None) -> float:
        whole = (*choice[:i], pick, *choice[i + 1 :])
        if whole not in known:
            known[whole] = model.likelihood(whole)
        return known[whole]

    def climbed(i: int, at: tuple[int, int]) -> tuple[int, int]:
        """The best place of the grid that is reached uphill."""
        while True:
            around = [
                (w, t)
                for w, t in product(range(at[0] - 1, at[0] + 2), range(at[1] - 1, at[1] + 2))
                if 0 <= w < len(WIDTHS) and 0 <= t < len(TURNS)
            ]
            best = max(around, key=lambda one: likelihood(i, (WIDTHS[one[0]], TURNS[one[1]])))
            if best == at:
                return at
            at = best

    for _ in range(2 if p > 1 else 1):
        for i in range(p):
            tops = [climbed(i, start) for start in ((3, 1), (3, len(TURNS) - 1))]
            picks = [(WIDTHS[w], TURNS[t]) for w, t in tops]
            choice[i] = max((likelihood(i, pick), pick) for pick in picks)[1]
    evidence = [0.0] * p
    while True:
        moving = [i for i in range(p) if choice[i] is not None]
        for i in moving:
            evidence[i] = likelihood(i, choice[i]) - likelihood(i, None)
        least = min(moving, key=lambda i: evidence[i], default=-1)
        if least < 0 or evidence[least] >= EVIDENCE:
            break
        choice[least] = None
    for i, best in enumerate(choice):
        if best is None:
            continue
        top = likelihood(i, best)
        fair = [
            pick
            for pick in product(WIDTHS, TURNS)
            if pick[0] >= best[0] and likelihood(i, pick) >= top - DOUBT
        ]
        choice[i] = max((model.spectrum(i, pick)[0][ONCE], pick) for pick in fair)[1]
    return tuple(choice), evidence
