"""Jitter of few frames: a parameter that differs at random from frame to frame.

What shakes moves all beads of a frame together, and a fit takes up the mean of few frames.
How much it shakes is only known from as many residuals as there are frames, less what the
fit takes up; so the variance of the jitter is averaged over its likelihood with the fit's
columns and the noise integrated out (restricted likelihood; Patterson and Thompson,
Biometrika 58 (1971) 545), and over the parameters that may shake. Likely variances spread
widely where few frames tell them, which makes the errors' distribution long in the tails, as
Student's is: the variance that is stated has errors beyond `TAIL_SIGMAS` as rarely as a
normal distribution does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from scipy.special import ndtr

from flexdt.twin.calibration.fit.evidence import LOG_CHANCE, NAMED_LOG_ODDS
from flexdt.twin.calibration.fit.residual_structure import MOVING, Drift, Residuals, cross
from flexdt.twin.geometry.conventions import FloatArray

SHAKING: Final = (*MOVING, "dO_y")
"""Parameters that may shake. A source or a panel that shakes looks like the object."""
TAIL_SIGMAS: Final = 4.0
"""Standard deviations beyond which errors are as rare as those of a normal distribution."""
SIZES: Final = 2.0 ** np.arange(-2.0, 11.0, 0.5)
"""Standard deviations of a jitter in those of a frame's noise; equally likely in advance."""
LEAST_TOLD: Final = 1e-3
"""Part of what the best told frame tells that another tells to count."""
FEWEST_TOLD: Final = 3
"""Deviates of a parameter that residuals must tell: the errors that fewer leave, Student's of
one or two degrees of freedom, have no variance."""
ROUNDING: Final = 1e-9
"""Part of what frames would tell alone that the fit leaves, below which it is rounding."""
LEAST_SHARE: Final = 1e-12
"""Least part of the residuals' squares that is left; below it is rounding."""
HALVINGS: Final = 20
"""Steps of the search for a variance, to some millionths."""


@dataclass(frozen=True, eq=False)
class Jitter:
    """What shakes from frame to frame, averaged over all that may.

    Attributes:
        log_odds: logarithm of the odds that anything shakes.
        covariance: (p, p) of the fit's columns from the jitter, times the probability that
            it is there.
        noise: root mean square of the residuals' standard deviation, without the jitter.
        drifts: what shakes drifts, too, and the covariance is that beside the drift.
    """

    log_odds: float
    covariance: FloatArray
    noise: float
    drifts: bool = False

    @property
    def clear(self) -> bool:
        """Whether it is as likely as causes are that are named."""
        return self.log_odds > NAMED_LOG_ODDS


@dataclass(frozen=True, eq=False)
class _Likely:
    """Parameters that shake together by a width of each of SIZES.

    Attributes:
        rows: (m, q) changes of the residuals with each parameter.
        gain: (p, f) change of the fit's columns with each parameter in each frame.
        log_weight: (w,) logarithms of the likelihoods, against those of no jitter.
        ratio: (w,) variances of the jitter over the noise's.
        noise2: (w,) variances of the noise.
    """

    rows: FloatArray
    gain: FloatArray
    log_weight: FloatArray
    ratio: FloatArray
    noise2: FloatArray

    @property
    def evidence(self) -> float:
        """Logarithm of the mean of the likelihoods."""
        return _log_mean(self.log_weight)

    @property
    def best(self) -> float:
        """The most likely variance over the noise's."""
        return float(self.ratio[np.argmax(self.log_weight)])

    def averaged(self) -> tuple[float, float]:
        """Compute the jitter's variance, as stated, and the noise's, averaged over widths."""
        weight = np.exp(self.log_weight - self.log_weight.max())
        weight /= weight.sum()
        jitter = _tail_variance(self.ratio * self.noise2, weight)
        return jitter, float(weight @ self.noise2)


def frame_jitter(
    left: Residuals, everything: Residuals, drift: Drift | None
) -> Jitter | None:
    """Estimate what shakes from frame to frame, and the covariance that it adds.

    Of few frames any scatter has a slope: a drift is one if it is more likely, with or
    without jitter beside it, than jitter alone.

    Args:
        left: residuals with their derivatives, covariance and noise.
        everything: with those of frames that were left out of the fit: that is jitter, too.
        drift: the most significant one; None: no significant one.

    Returns:
        The jitter; None without noise, or if nothing that may shake was fitted.
    """
    fitted = [n.split("@")[0] for n in left.problem.layout.names]
    names = [n for n in SHAKING if n in fitted]
    if left.noise <= 0.0 or not names:
        return None
    alone = _shaking(everything, left, names)
    if drift is None or alone is None:
        return alone
    change = _changed_by(everything, drift)
    found = _likelihoods(everything, change[:, None])
    beside = _shaking(_with_column(everything, change), left, names)
    if found is None or beside is None:
        return alone
    frames = int((left.problem.group == drift.scan).sum())
    odds = LOG_CHANCE - math.log(len(MOVING) * frames) + _log_mean(found[0])
    odds += float(np.logaddexp(0.0, beside.log_odds) - np.logaddexp(0.0, alone.log_odds))
    return replace(beside, drifts=True) if odds > 0.0 else alone


def _shaking(shown: Residuals, fitted: Residuals, names: Sequence[str]) -> Jitter | None:
    """Average over what may shake. Where parameters clearly do, others are sought in what
    they leave.

    Args:
        shown: residuals.
        fitted: the residuals of the fit, whose columns the jitter changes.
        names: of parameters that may shake.

    Returns:
        The jitter; None if the residuals tell nothing of it.
    """
    covariance = np.zeros_like(fitted.unit_covariance)
    noise2 = fitted.noise**2
    odds = []
    while names:
        likely = _all_likely(shown, fitted, names)
        if not likely:
            break
        total = float(np.logaddexp.reduce([chance for _, chance, _ in likely]))
        probability = 1.0 / (1.0 + math.exp(-total))
        noise2 *= 1.0 - probability
        for _, chance, model in likely:
            share = probability * math.exp(chance - total)
            variance, own2 = model.averaged()
            covariance += share * variance * model.gain @ model.gain.T
            noise2 += share * own2
        odds.append(total)
        if total < NAMED_LOG_ODDS:
            break
        shaking, _, best = max(likely, key=lambda one: one[1])
        names = [n for n in names if n not in shaking]
        shown = _without(shown, best)
    if not odds:
        return None
    return Jitter(odds[0], covariance, math.sqrt(noise2))


def _changed_by(shown: Residuals, drift: Drift) -> FloatArray:
    """Compute the change of residuals by a drift of a unit, or by a jump, (m,)."""
    problem = shown.problem
    inside = problem.group == drift.scan
    place = np.cumsum(inside) - 1
    if drift.step_at is None:
        shape = np.asarray(place / max(int(place[-1]), 1) - 0.5)
    else:
        shape = np.where(place >= drift.step_at, 0.5, -0.5)
    column = shown.jacobian[:, problem.layout.names.index(drift.column)]
    return np.asarray(column * np.where(inside, shape, 0.0)[shown.frame])


def _with_column(shown: Residuals, rows: FloatArray) -> Residuals:
    """Return residuals of a fit with one more column, of any height.

    Args:
        shown: residuals.
        rows: (m,) derivatives by the column.
    """
    jacobian = np.column_stack([shown.jacobian, rows])
    precision = np.zeros(2 * [jacobian.shape[1]])
    precision[:-1, :-1] = np.linalg.inv(shown.unit_covariance)
    precision[-1] = precision[:, -1] = rows @ jacobian
    return replace(
        shown, jacobian=jacobian, unit_covariance=np.asarray(np.linalg.inv(precision))
    )


def _log_mean(logarithms: FloatArray) -> float:
    """Compute the logarithm of the mean of numbers from their logarithms, (w,)."""
    return float(np.logaddexp.reduce(logarithms) - math.log(len(logarithms)))


def _all_likely(
    shown: Residuals, fitted: Residuals, names: Sequence[str]
) -> list[tuple[tuple[str, ...], float, _Likely]]:
    """Compute the likelihoods of each parameter's jitter, of pairs and of all at once.

    Args:
        shown: residuals, of which what shakes otherwise is taken out.
        fitted: the residuals of the fit, whose columns the jitter changes.
        names: of parameters that may shake.

    Returns:
        Parameters that shake together, the logarithm of their odds against no jitter, and
        the likelihoods; without those of which the residuals tell nothing.
    """
    numbers = sorted({1, 2, len(names)} & set(range(1, len(names) + 1)))
    out = []
    for number in numbers:
        sets = list(combinations(names, number))
        chance = LOG_CHANCE - math.log(len(numbers) * len(sets))
        for some in sets:
            model = _shaken(shown, fitted, some)
            if model is not None:
                out.append((some, chance + model.evidence, model))
    return out


def _shaken(shown: Residuals, fitted: Residuals, some: Sequence[str]) -> _Likely | None:
    """Compute the likelihood of the widths by which parameters shake together, as large as
    each other in what the residuals tell of them; arguments as `_all_likely`.

    Returns:
        The likelihoods; None if the residuals tell fewer than `FEWEST_TOLD` deviates of each.
    """
    frame = shown.frame
    frames = np.arange(len(shown.problem.group))
    within = frame[:, None] == frames
    fitted_within = fitted.frame[:, None] == frames
    names = [n.split("@")[0] for n in shown.problem.layout.names]
    columns = [[i for i, n in enumerate(names) if n == name] for name in some]
    rows = np.stack([shown.jacobian[:, own].sum(axis=1) for own in columns], axis=1)
    size = np.sqrt(np.einsum("mq,mq->q", rows, rows))
    if not (size > 0.0).all():
        return None
    rows /= size
    each = np.concatenate([rows[:, [q]] * within for q in range(len(some))], axis=1)
    found = _likelihoods(shown, each, FEWEST_TOLD * len(some))
    if found is None:
        return None
    original = [fitted.jacobian[:, own].sum(axis=1) for own in columns]
    gain = [
        fitted.unit_covariance @ cross(fitted.jacobian, (r / s)[:, None] * fitted_within)
        for r, s in zip(original, size, strict=True)
    ]
    return _Likely(rows, np.concatenate(gain, axis=1), *found)


def _likelihoods(
    shown: Residuals, each: FloatArray, fewest: int = 1
) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Compute the likelihood of the widths of normal deviates in the residuals.

    Args:
        shown: residuals.
        each: (m, f) changes of the residuals with each deviate.
        fewest: deviates that the residuals must tell.

    Returns:
        (w,) each: logarithms of the likelihoods against those without deviates, the
        variances of the deviates over the noise's, and the variances of the noise; None if
        the residuals tell fewer deviates.
    """
    unit = shown.unit_covariance
    absorbed = cross(shown.jacobian, each)
    whole = cross(each, each)
    values, vectors = np.linalg.eigh(whole - absorbed.T @ unit @ absorbed)
    told = values > max(LEAST_TOLD * float(values[-1]), ROUNDING * float(np.trace(whole)))
    if told.sum() < fewest:
        return None
    values = values[told]
    residual = shown.values
    taken = unit @ np.einsum("mp,m->p", shown.jacobian, residual)
    clean = residual - shown.jacobian @ taken
    push = np.einsum("mf,m->f", each, clean)
    explained = (vectors[:, told].T @ push) ** 2 / values
    inside = float(np.sum(unit * cross(shown.jacobian, shown.jacobian)))
    freedom = len(residual) - inside
    total = max(float(clean @ clean), float(explained.sum()))
    ratio = SIZES**2 / float(np.median(values))
    more = ratio[:, None] * values
    square = total - (explained * more / (1.0 + more)).sum(axis=1)
    square = np.maximum(square, LEAST_SHARE * total)
    log_weight = -0.5 * np.log1p(more).sum(axis=1)
    log_weight -= 0.5 * freedom * np.log(square / total)
    return log_weight, ratio, square / freedom


def joined(left: Residuals, lost: Residuals) -> Residuals:
    """Join residuals of other positions; the covariance is that of a fit to both."""
    precision = np.linalg.inv(left.unit_covariance) + cross(lost.jacobian, lost.jacobian)
    order = np.argsort(np.concatenate([f.nonzero()[0] for f in (left.keep, lost.keep)]))
    return replace(
        left,
        jacobian=np.concatenate([left.jacobian, lost.jacobian])[order],
        values=np.concatenate([left.values, lost.values])[order],
        keep=left.keep | lost.keep,
        unit_covariance=np.asarray(np.linalg.inv(precision)),
    )


def _without(shown: Residuals, likely: _Likely) -> Residuals:
    """Weigh residuals so that what shakes by its most likely width is white noise.

    Args:
        shown: residuals.
        likely: what shakes.

    Returns:
        The residuals and their derivatives, weighed frame by frame by the inverse root of
        their covariance, with the covariance of the fit that belongs to them.
    """
    jacobian = shown.jacobian.copy()
    values = shown.values.copy()
    for frame in np.unique(shown.frame):
        own = shown.frame == frame
        square, axes = np.linalg.eigh(likely.best * likely.rows[own] @ likely.rows[own].T)
        weight = (axes / np.sqrt(1.0 + np.maximum(square, 0.0))) @ axes.T
        jacobian[own] = weight @ jacobian[own]
        values[own] = weight @ values[own]
    precision = np.linalg.inv(shown.unit_covariance)
    precision += cross(jacobian, jacobian) - cross(shown.jacobian, shown.jacobian)
    unit_covariance = np.linalg.inv(precision)
    return replace(
        shown, jacobian=jacobian, values=values, unit_covariance=unit_covariance
    )


def _tail_variance(variances: FloatArray, weight: FloatArray) -> float:
    """Compute the variance of the normal distribution that has as many errors beyond
    `TAIL_SIGMAS` as a mean of normal distributions; no less than the mean variance.

    Args:
        variances: (w,) of the distributions, above 0.
        weight: (w,) of them; their sum is 1.
    """
    asked = float(ndtr(-TAIL_SIGMAS))
    low = float(weight @ variances)
    high = float(variances.max())
    if float(weight @ ndtr(-TAIL_SIGMAS * np.sqrt(low / variances))) <= asked:
        return low
    for _ in range(HALVINGS):
        middle = math.sqrt(low * high)
        beyond = float(weight @ ndtr(-TAIL_SIGMAS * np.sqrt(middle / variances)))
        if beyond > asked:
            low = middle
        else:
            high = middle
    return high
