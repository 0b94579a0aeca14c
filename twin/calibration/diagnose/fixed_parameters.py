"""Checks whether parameters that are not estimated freely agree with the data.

A main parameter that is fixed at a wrong value shifts the others, and free bead positions can
hide that: the residuals look right and the answer is wrong. So it is compared with a fit in
which it is free. The others have priors, and are compared with those. The request itself is not
changed; the finding names the parameters that should be free.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri, fdtrc

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.certificate import Estimate, widened
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import edge_factor
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.told_lengths import PLACES, TOLD, TOLD_SOURCES, TRAVEL

HELD_SIGMAS: Final = 5.0
"""How far, in standard deviations, the data may have a fixed parameter from where it is
fixed."""
DOUBT_SIGMAS: Final = 2.3
"""Sigmas beyond which the intervals of free parameters contain the change by fixed ones."""
LOOSE_FACTOR: Final = 10.0
"""Factor on the priors in the fit with which they are compared."""
MAX_RIVAL_CHI2: Final = 9.0
"""Difference of chi2 below which two causes are both possible: three standard deviations."""
MIN_VARIANCE_DROP: Final = 0.5
"""Least share by which images must lower the variance of such a loose prior to count. (At
0.9 an SDD 13 mm off its prior of 1 mm, determined to 5 mm by images, was offered 12
sigmas off.)"""
MIN_GROWTH: Final = 3.0
"""Growth of a sigma from which values stated as exact are named, if they cannot be
checked, or if images narrow their usual prior by less."""
PLAUSIBLE_SHARE: Final = 0.12
"""Largest offset along the beam, as a share of SOD, that a mount may cause. A phantom that is
scaled together with its beads looks like the right one at another distance, so that this offset
is its only sign."""
NARROW_CHANCE: Final = 0.01
"""Probability of such a contradiction with right priors below which priors are widened."""


def held_distance(free: FitResult, held: Mapping[str, float]) -> dict[str, float]:
    """Compute the distance of the data, in sigmas, from the value of each fixed
    parameter.

    Sigmas are those of normal deviates as improbable as Student's with the fit's degrees
    of freedom.

    Args:
        free: the fit with those parameters free too.
        held: parameter -> value it is fixed at, edge units; those not determined are left
            out.

    Returns:
        Parameter -> sigmas, and under "" those of all together (a chi2 distance of many,
        as the normal deviate that is as improbable): correlated ones may contradict the
        data together where each by itself does not. Empty if the fit is not determined
        or determines none.
    """
    if not free.determined:
        return {}
    names = list(free.certificate.estimates)
    some = [
        n
        for n in held
        if n in names and math.isfinite(free.sigmas[n]) and free.sigmas[n] > 0
    ]
    if not some:
        return {}
    at = [names.index(n) for n in some]
    off = np.array([free.values[n] - held[n] for n in some])
    square = float(off @ np.linalg.solve(free.covariance[np.ix_(at, at)], off))
    freedom = free.certificate.dof
    alone = [abs(o) / free.sigmas[n] for n, o in zip(some, off.tolist(), strict=True)]
    scores = {
        n: _deviate_of(ratio, freedom) for n, ratio in zip(some, alone, strict=True)
    }
    return scores | {"": _deviate(_chance(square, len(some), freedom))}


def judge_held(free: FitResult, held: Mapping[str, float]) -> Finding | None:
    """Judge whether the data contradict fixed parameters (see `held_distance`) by more
    than `HELD_SIGMAS`.

    Args:
        free: the fit with those parameters free too.
        held: parameter -> value it is fixed at, edge units.

    Returns:
        An error that names each parameter that is off by itself, worst first, or the
        worst where only all together are; None without a contradiction.
    """
    scores = held_distance(free, held)
    if not scores or max(scores.values()) <= HELD_SIGMAS:
        return None
    single = sorted((n for n in scores if n), key=lambda n: -scores[n])
    named = [n for n in single if scores[n] > HELD_SIGMAS] or single[:1]
    listed = "; ".join(
        f"{n} is held at {held[n]:g} {e.unit}, the data say {e.value:.4g} +- "
        f"{e.sigma:.1g} {e.unit}"
        for n in named
        for e in (free.certificate.estimates[n],)
    )
    text = f"{listed}: free {', '.join(named)} too, or hold it where it is"
    return error(CalibrationCode.HELD_PARAMETER, text, free=named)


@dataclass(frozen=True)
class PriorsJudged:
    """The priors compared with the images.

    Attributes:
        finding: an error where they contradict them by more than HELD_SIGMAS, else None.
        factor: by how much the priors are too narrow as a whole; 1 unless chance would have the
            images contradict them as much only once in a hundred scans.
        causes: parameters of which one alone, away from its prior, would explain the
            images, best first; empty unless dropping its prior explains DOUBT_SIGMAS.
        lengths: a warning where told lengths are among them; else None.
    """

    finding: Finding | None
    factor: float
    causes: tuple[str, ...] = ()
    lengths: Finding | None = None


def loosened(
    priors: Mapping[str, float], factor: float = LOOSE_FACTOR
) -> dict[str, float]:
    """Widen priors by a factor."""
    return {name: width * factor for name, width in priors.items()}


def judge_exact(
    fit: FitResult, freed: FitResult, exact: Mapping[str, float]
) -> Finding | None:
    """Judge the dependence on values stated as exact that the images cannot check.

    All together are not judged: who calls ten values exact gets their small systematic
    parts, such as a blurred bead's, summed up.

    Args:
        fit: with those values.
        freed: the fit in which they have the usual priors instead.
        exact: parameter -> value, edge units.

    Returns:
        An error if the images contradict one of them by itself; a warning if sigmas grow
        more than `MIN_GROWTH` times with its usual prior, or the images narrow that prior
        by less; else None, also where one of the two fits is not determined.
    """
    if not (fit.determined and freed.determined):
        return None
    scores = held_distance(freed, exact)
    if max((score for name, score in scores.items() if name), default=0.0) > HELD_SIGMAS:
        return judge_held(freed, exact)
    after = freed.certificate.estimates
    growth = {
        n: after[n].sigma / e.sigma
        for n, e in fit.certificate.estimates.items()
        if n in after and e.sigma > 0 and after[n].sigma > MIN_GROWTH * e.sigma
    }
    causes = _unchecked(after, growth, exact)
    if not causes:
        return None
    worst = sorted(growth, key=lambda n: -growth[n])[:3] or list(causes)
    listed = ", ".join(
        f"{n} to {after[n].sigma:.2g} {after[n].unit} instead of {fit.sigmas.get(n, 0.0):.2g}"
        for n in worst
    )
    assumed = ", ".join(f"{n} = {exact[n]:g}" for n in causes)
    return warning(
        CalibrationCode.HELD_UNCHECKED,
        f"{assumed} is taken as exact, and the images cannot tell whether it is: with "
        f"the usual prior sigmas grow: {listed}; give prior 0 only to what was measured",
    )


def _unchecked(
    after: Mapping[str, Estimate], growth: Iterable[str], exact: Mapping[str, float]
) -> dict[str, None]:
    """List the values stated as exact that sigmas depend on, or whose usual priors the images
    hardly narrow.

    `after`: estimates with the usual priors; `growth`: parameters whose sigmas grow; `exact`:
    parameter -> value, edge units."""
    own = {n: after[n].prior or math.inf for n in exact if n in after}
    causes = dict.fromkeys(c for n in growth for c in after[n].priors if c in exact)
    return causes | dict.fromkeys(
        n for n, prior in own.items() if MIN_GROWTH * after[n].sigma > prior
    )


def judge_priors(loose: FitResult, exact: Container[str] = ()) -> PriorsJudged:
    """Compare priors with the images.

    In units of its loose prior an estimate of covariance C moves from the prior's center
    by K = 1 - C times the error of the parameter, and by noise of covariance C K.
    Directions whose variance the images lower by less than `MIN_VARIANCE_DROP` are left
    out.

    Args:
        loose: the fit with `loosened` priors. (In a fit with the priors themselves,
            strong ones that are wrong leave residuals with structure, which widens the
            sigmas until nothing is contradicted.)
        exact: parameters that the request states as exact; their priors in `loose` are
            the usual ones.

    Returns:
        Beyond `HELD_SIGMAS` an error and its likely causes; else a factor above 1 if the
        contradiction's chance is below `NARROW_CHANCE`. No finding and factor 1 without
        priors, or if the fit is not determined.
    """
    c = loose.certificate
    known = [
        (i, n, e) for i, (n, e) in enumerate(c.estimates.items()) if e.prior is not None
    ]
    if not loose.determined or not known or not np.isfinite(c.covariance).all():
        return PriorsJudged(None, 1.0)
    at, names, found = map(list, zip(*known, strict=True))
    width = np.array([e.prior for e in found])
    centres = zip(names, loose.problem.prior_mean[at].tolist(), strict=True)
    means = np.array([edge_factor(name) * mean for name, mean in centres])
    moved = (np.array([e.value for e in found]) - means) / width
    values, vectors = np.linalg.eigh(
        c.covariance[np.ix_(at, at)] / np.outer(width, width)
    )
    values = np.maximum(values, 1e-8)  # exact positions know some directions to rounding
    some = values < 1.0 - MIN_VARIANCE_DROP
    if not some.any():
        return PriorsJudged(None, 1.0)
    image_share = 1.0 - values[some]
    spread = image_share * (image_share / LOOSE_FACTOR**2 + values[some])
    square = float(np.sum((vectors.T @ moved)[some] ** 2 / spread))
    count = int(some.sum())
    chance = _chance(square, count, c.dof)
    sigmas = np.array([e.sigma for e in found])
    ratios = np.abs(moved) / np.sqrt(1.0 / LOOSE_FACTOR**2 + sigmas**2 / width**2)
    scores = np.array([_deviate_of(ratio, c.dof) for ratio in ratios.tolist()])
    gains, alone = _without_each(values, vectors, some, moved)
    likely = _likely(gains)
    believed = [
        _Believed(
            names[i],
            float(means[i]),
            float(width[i] / LOOSE_FACTOR),
            float(means[i] + alone[i][0] * width[i]),
            float(alone[i][1] * width[i]),
            found[i].unit,
        )
        # Something may be off all the same: the likeliest is named.
        for i in likely or [int(np.argsort(gains)[-1])]
    ]
    if max(float(scores.max()), _deviate(chance)) <= HELD_SIGMAS:
        factor = math.sqrt(square / count) if chance < NARROW_CHANCE else 1.0
        causes = tuple(names[i] for i in likely)
        lengths = _lengths_disagree(believed) if likely else None
        return PriorsJudged(None, factor, causes, lengths)
    causes = tuple(one.name for one in believed)
    return PriorsJudged(_priors_off(loose, believed, exact), 1.0, causes)


def _likely(gains: Sequence[float]) -> list[int]:
    """List the priors that may be wrong, the likeliest first, by how much the squared
    residuals fall without each; empty if without none they fall enough to doubt it.
    """
    order: list[int] = np.argsort(gains)[::-1].tolist()
    best = gains[order[0]]
    if best <= DOUBT_SIGMAS**2:
        return []
    return [i for i in order if gains[i] > max(best - MAX_RIVAL_CHI2, best / 2)]


@dataclass(frozen=True)
class _Believed:
    """One parameter, edge units: what is known of it, and what the images say alone."""

    name: str
    centre: float
    prior: float
    value: float
    sigma: float
    unit: str

    @property
    def is_told(self) -> bool:
        """It is a told length, not an offset."""
        return self.name.split("@")[0] in TOLD

    @property
    def possible(self) -> float:
        """A standard deviation by which it may be where the images say, to two digits."""
        return float(f"{max(abs(self.value - self.centre), self.prior):.2g}")

    @property
    def text(self) -> str:
        """The told length and what the images say of it, or the offset, in words."""
        if not self.is_told:
            return (
                f"{self.name} is {self.value:.4g} +- {self.sigma:.1g} {self.unit} (known as "
                f"{self.centre:g} +- {self.prior:g} {self.unit})"
            )
        source = TOLD_SOURCES[self.name.split("@")[0]]
        if self.unit == "1":
            value, sigma, unit = 100.0 * self.value, 100.0 * self.sigma, "%"
            known = f"{100.0 * self.prior:.2g} %"
        else:
            value, sigma, unit = self.value, self.sigma, self.unit
            known = f"{self.prior:.2g} {self.unit}"
        way = "more" if value > 0.0 else "less"
        return (
            f"{source} is {abs(value):.2g} +- {sigma:.1g} {unit} {way} than told (known to "
            f"{known})"
        )


def _alternatives(believed: Sequence[_Believed]) -> str:
    """Write what may be off instead of what; a way stands for the places along it."""
    ways = {one.name[-1] for one in believed if one.name in TRAVEL}
    believed = [
        one
        for one in believed
        if not (one.name.startswith(PLACES) and one.name.split("@")[0][-1] in ways)
    ]
    return "told lengths disagree: " + ", or ".join(one.text for one in believed)


def _options(told: Sequence[_Believed]) -> list[tuple[str, float]]:
    """List the told lengths of which one may have more room, with how much; a way stands for
    the places along it.
    """
    widths: dict[str, float] = {}
    for one in told:
        name = one.name.split("@")[0]
        widths[name] = max(one.possible, widths.get(name, 0.0))
    ways = {name[-1] for name in widths if name in TRAVEL}
    return [(n, w) for n, w in widths.items() if n not in PLACES or n[-1] not in ways]


def _settling(told: Sequence[_Believed]) -> str:
    """Write what settles which of several told lengths is off."""
    options = " or ".join(f"--prior {name}={width:g}" for name, width in _options(told))
    return f"measure one of them, and give the other more room: {options}"


def _lengths_disagree(believed: Sequence[_Believed]) -> Finding | None:
    """Make the warning that told lengths disagree; None where all others are likelier."""
    told = [one for one in believed if one.is_told]
    if not told:
        return None
    return warning(
        CalibrationCode.LENGTHS_DISAGREE,
        f"{_alternatives(believed)}; the intervals of lengths and of the magnification allow "
        "for each, the axis in the images does not change",
        _settling(told),
    )


def _priors_off(
    fit: FitResult, believed: Sequence[_Believed], exact: Container[str]
) -> Finding:
    """Make the error that images contradict priors, of which each of these may be wrong.

    Told lengths are witnesses of one millimeter: freed together they would say nothing.
    """
    told = [one for one in believed if one.is_told]
    if told:
        others = [one.name for one in believed if not one.is_told]
        return error(
            CalibrationCode.HELD_PARAMETER,
            f"{_alternatives(believed)}: one of them is not as told, and until it is known "
            "which, no length is",
            _settling(told),
            free=others,
            priors=_options(told),
        )
    texts = []
    for one in believed:
        known = "exactly" if one.name in exact else f"+- {one.prior:g} {one.unit}"
        texts.append(
            f"{one.name} is known as {one.centre:g} {known}, the images say "
            f"{one.value:.4g} +- {one.sigma:.1g} {one.unit}"
        )
    texts += [_other_pixels(fit, one.value) for one in believed if one.name == "dD_z"]
    # One of them alone would take up what is another's.
    names = [one.name for one in believed]
    text = f"{'; or '.join(texts)}: free {', '.join(names)} too, or give the prior it has"
    # Those of one scan are no option.
    offered = [name for name in names if "@" not in name]
    return error(CalibrationCode.HELD_PARAMETER, text, free=offered)


def _without_each(
    values: FloatArray,
    vectors: FloatArray,
    some: npt.NDArray[np.bool_],
    moved: FloatArray,
) -> tuple[list[float], list[tuple[float, float]]]:
    """Compute what the images, and all priors but one, say of that one; for each of p.

    All in units of the loose priors.

    Args:
        values, vectors: eigenvalues and vectors of the estimates' covariance, (p,), (p, p).
        some: (p,) which directions the images tell.
        moved: (p,) estimates less the priors' centers.

    Returns:
        How much the squared residuals fall without each prior, and value and standard
        deviation of each parameter then.
    """
    # The images alone are a quadratic of this curvature, and of the gradient y.
    weight = np.where(some, 1.0 / values - 1.0, 0.0)
    curvature = (vectors * weight) @ vectors.T
    gradient = np.where(some, 1.0 / values, 0.0)
    y = vectors @ (gradient * (vectors.T @ moved))
    everything = np.linalg.inv(curvature + LOOSE_FACTOR**2 * np.eye(len(moved)))
    gains = []
    alone = []
    for j in range(len(moved)):
        priors = np.full(len(moved), LOOSE_FACTOR**2)
        priors[j] = 1e-6 * LOOSE_FACTOR**2
        without = np.linalg.inv(curvature + np.diag(priors))
        gains.append(float(y @ (without - everything) @ y))
        alone.append((float((without @ y)[j]), float(np.sqrt(max(without[j, j], 0.0)))))
    return gains, alone


def _other_pixels(fit: FitResult, dD_z: float) -> str:
    """Describe in words the pixel width that would look like a panel `dD_z` further away.

    Args:
        fit: gives pixel width and SDD, medians over the frames.
        dD_z: [mm].
    """
    poses = fit.problem.poses
    pixel = float(np.median(np.linalg.norm(poses.u, axis=1)))
    sdd = float(np.median(poses.sdd))
    return (
        f"the pixels are {pixel * sdd / (sdd + dD_z):.4g} mm wide instead of {pixel:.4g} "
        "mm, which looks alike"
    )


def doubtful(
    fit: FitResult, judged: PriorsJudged, without: Callable[[str], FitResult]
) -> FitResult:
    """Widen the intervals by the change that each possible cause alone would make.

    Of wrong priors the narrower is believed, although it may be the wrong one. `without`
    makes the fit without the prior of a parameter; fits that are not determined are
    ignored.
    """
    for name in dict.fromkeys(cause.split("@")[0] for cause in judged.causes):
        other = without(name)
        if other.determined:
            off = {n: other.values.get(n, v) - v for n, v in fit.values.items()}
            fit = replace(fit, certificate=widened(fit.certificate, off))
    return fit


def narrow_priors_warning(judged: PriorsJudged) -> Finding:
    """Make the warning that all priors are widened by the factor of `judged`, with the
    causes that alone would explain it, if any.
    """
    if judged.causes:
        cause = f"; {' or '.join(judged.causes)} alone would explain it"
    else:
        cause = ""
    return warning(
        CalibrationCode.PRIORS_NARROW,
        f"the images have detector and axis {judged.factor:.1f} times as far "
        f"from where they are known to be as their priors say{cause}: all priors "
        "are widened by that factor",
    )


def _deviate(chance: float) -> float:
    """Return the normal deviate that is as improbable."""
    return float(np.sqrt(chdtri(1, max(chance, 1e-300))))


def _deviate_of(ratio: float, freedom: float) -> float:
    """Return the normal deviate about as improbable as a ratio in sigmas (Student).

    Source: Wallace, Annals of Mathematical Statistics 30 (1959) 1121.
    """
    share = (8.0 * freedom + 1.0) / (8.0 * freedom + 3.0)
    return share * math.sqrt(freedom * math.log1p(ratio**2 / freedom))


def _chance(square: float, count: int, freedom: float) -> float:
    """Return the probability of a larger sum of `count` squares in sigmas (Fisher)."""
    return float(fdtrc(count, freedom, max(square, 0.0) / count))


def judge_offsets(fit: FitResult) -> Finding | None:
    """Judge whether the fitted place is within the possible errors of mount and motors.

    Returns:
        An error if dO_z of some scan exceeds `PLAUSIBLE_SHARE` of the SOD; else None.
    """
    sod = float(np.median(fit.problem.poses.sod))
    for parameters in fit.group_parameters:
        if abs(parameters.dO_z) > PLAUSIBLE_SHARE * sod:
            return error(
                CalibrationCode.IMPLAUSIBLE_OFFSET,
                f"dO_z comes out as {parameters.dO_z:.1f} mm at SOD {sod:.0f} mm: a phantom of "
                "another scale, or wrong nominal distances",
            )
    return None
