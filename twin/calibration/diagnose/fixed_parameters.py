"""Checks whether what is not estimated freely is where the data have it.

A main parameter that is fixed at a wrong value shifts the others, and free bead positions can hide
that: the residuals look right and the answer is wrong. So it is compared with a fit in which it is
free. The others have priors, and are compared with those. The request itself is not changed; the
finding names the parameters that should be free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import stats

from flexdt.twin.calibration.diagnose.data import Finding, error, warning
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.geometry.offsets import to_edge

HELD_SIGMAS: Final = 5.0
"""How far, in standard deviations, the data may have a fixed parameter from where it is fixed."""
DOUBT_SIGMAS: Final = 2.3
"""Beyond this the intervals of what is free contain what the fixed ones would change."""
LOOSE: Final = 10.0
"""Priors are compared with a fit in which they are so many times as wide."""
MOST_TOLD: Final = 0.9
"""Images that lower the variance of such a loose prior by a smaller share say nothing about it."""
NARROW: Final = 0.01
"""Priors are widened where right ones would be contradicted as much less often than that."""


def held_distance(free: FitResult, held: Mapping[str, float]) -> dict[str, float]:
    """How far, in sigmas, the data have each fixed parameter from where it is fixed.

    Args:
        free: the fit with those parameters free as well.
        held: parameter -> value it is fixed at, edge units; those not determined are left out.

    Returns:
        Parameter -> sigmas, and under "" those of all together (a chi2 distance of many, as the
        normal deviate that is as improbable): correlated ones may contradict the data together
        where each by itself does not.
    """
    if not free.identifiable:
        return {}
    names = list(free.certificate.estimates)
    some = [n for n in held if n in names and math.isfinite(free.sigmas[n]) and free.sigmas[n] > 0]
    if not some:
        return {}
    at = [names.index(n) for n in some]
    off = np.array([free.values[n] - held[n] for n in some])
    square = float(off @ np.linalg.solve(free.covariance[np.ix_(at, at)], off))
    together = _deviate(float(stats.chi2.sf(square, len(some))))
    return {n: abs(o) / free.sigmas[n] for n, o in zip(some, off.tolist(), strict=True)} | {
        "": together
    }


def judge_held(free: FitResult, held: Mapping[str, float]) -> Finding | None:
    """An error if the data contradict what is fixed (see `held_distance`), else None.

    It names each parameter that is off by itself, or the worst where only all together are.
    """
    scores = held_distance(free, held)
    if not scores or max(scores.values()) <= HELD_SIGMAS:
        return None
    single = sorted((n for n in scores if n), key=lambda n: -scores[n])
    named = [n for n in single if scores[n] > HELD_SIGMAS] or single[:1]
    listed = "; ".join(
        f"{n} is held at {held[n]:g} {e.unit}, the data say {e.value:.4g} +- {e.sigma:.1g} {e.unit}"
        for n in named
        for e in (free.certificate.estimates[n],)
    )
    return error("held_parameter", f"{listed}: free {', '.join(named)} too, or hold it where it is")


@dataclass(frozen=True)
class PriorsJudged:
    """What the images say of the priors.

    Attributes:
        finding: an error where they contradict them by more than HELD_SIGMAS, else None.
        factor: by how much the priors are too narrow as a whole; 1 unless chance would have the
            images contradict them as much only once in a hundred scans.
    """

    finding: Finding | None
    factor: float


def loosened(priors: Mapping[str, float], factor: float = LOOSE) -> dict[str, float]:
    """Priors `factor` times as wide."""
    return {name: width * factor for name, width in priors.items()}


def judge_priors(loose: FitResult) -> PriorsJudged:
    """Compare priors with the images.

    Args:
        loose: the fit with `loosened` priors. (In a fit with the priors themselves, strong ones
            that are wrong leave residuals with structure, which widens the sigmas until nothing is
            contradicted.)

    In units of its loose prior an estimate of covariance C moves from the prior's centre by
    K = 1 - C times what the parameter is off, and by noise of covariance C K. Directions of which
    the images say less than about three times the prior are left out.
    """
    c = loose.certificate
    known = [(i, n, e) for i, (n, e) in enumerate(c.estimates.items()) if e.prior is not None]
    if not loose.identifiable or not known:
        return PriorsJudged(None, 1.0)
    at = [i for i, *_ in known]
    width = np.array([e.prior for *_, e in known])
    means = np.array(
        [
            to_edge(name.split("@")[0], mean)
            for (_, name, _), mean in zip(known, loose.problem.prior_mean[at].tolist(), strict=True)
        ]
    )
    moved = (np.array([e.value for *_, e in known]) - means) / width
    values, vectors = np.linalg.eigh(c.covariance[np.ix_(at, at)] / np.outer(width, width))
    some = values < 1.0 - MOST_TOLD
    if not some.any():
        return PriorsJudged(None, 1.0)
    kept = 1.0 - values[some]
    spread = kept * (kept / LOOSE**2 + values[some])
    square = float(np.sum((vectors.T @ moved)[some] ** 2 / spread))
    count = int(some.sum())
    chance = float(stats.chi2.sf(square, count))
    scores = np.abs(moved) / np.sqrt(
        1.0 / LOOSE**2 + np.array([e.sigma for *_, e in known]) ** 2 / width**2
    )
    if max(float(scores.max()), _deviate(chance)) <= HELD_SIGMAS:
        return PriorsJudged(None, math.sqrt(square / count) if chance < NARROW else 1.0)
    order = [int(i) for i in np.argsort(-scores)]
    named = [i for i in order if scores[i] > HELD_SIGMAS] or order[:1]
    texts = [
        f"{n} is known as {means[i]:g} +- {width[i] / LOOSE:g} {e.unit}, the images say "
        f"{e.value:.4g} +- {e.sigma:.1g} {e.unit}"
        for i, (_, n, e) in ((i, known[i]) for i in named)
    ]
    which = ", ".join(known[i][1] for i in named)
    text = f"{'; '.join(texts)}: free {which} too, or give the prior it has"
    return PriorsJudged(error("held_parameter", text), 1.0)


def narrow_priors(factor: float) -> Finding:
    """What is said where the priors are widened by `factor`."""
    return warning(
        "priors_narrow",
        f"the images have detector and axis {factor:.1f} times as far from where they are known to "
        "be as their priors say: all priors are widened by that factor",
    )


def _deviate(chance: float) -> float:
    """The normal deviate that is as improbable."""
    return float(np.sqrt(stats.chi2.isf(max(chance, 1e-300), 1)))
