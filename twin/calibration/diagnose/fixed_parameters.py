"""Checks whether what is not estimated freely is where the data have it.

A main parameter that is fixed at a wrong value shifts the others, and free bead positions can hide
that: the residuals look right and the answer is wrong. So it is compared with a fit in which it is
free. The others have priors, and are compared with those. The request itself is not changed; the
finding names the parameters that should be free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np
from scipy import stats

from flexdt.twin.calibration.diagnose.data import Finding, error
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.geometry.offsets import to_edge

HELD_SIGMAS: Final = 5.0
"""How far, in standard deviations, the data may have a fixed parameter from where it is fixed."""
DOUBT_SIGMAS: Final = 2.3
"""Beyond this the intervals of what is free contain what the fixed ones would change."""
LEAST_TOLD: Final = 0.01
"""Images that lower the variance of a prior by less say nothing about it."""


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
    together = float(np.sqrt(stats.chi2.isf(max(stats.chi2.sf(square, len(some)), 1e-300), 1)))
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


def judge_priors(fit: FitResult) -> Finding | None:
    """An error if the images contradict a prior by more than HELD_SIGMAS, else None.

    An estimate with a prior of variance P that comes out with variance C has moved from the prior's
    centre by an amount of variance P - C. What the images alone say follows from both.
    """
    off = []
    for (name, e), centre in zip(
        fit.certificate.estimates.items(), fit.problem.prior_mean.tolist(), strict=False
    ):
        base = name.split("@")[0]
        if e.prior is None or not e.sigma**2 < (1.0 - LEAST_TOLD) * e.prior**2:
            continue
        mean = to_edge(base, centre)
        told = e.prior**2 - e.sigma**2
        score = abs(e.value - mean) / math.sqrt(told)
        if score > HELD_SIGMAS:
            images = mean + (e.value - mean) * e.prior**2 / told
            sigma = e.sigma * e.prior / math.sqrt(told)
            off.append((score, f"{name} is known as {mean:g} +- {e.prior:g} {e.unit}, the images "
                        f"say {images:.4g} +- {sigma:.1g} {e.unit}", name))  # fmt: skip
    if not off:
        return None
    off.sort(reverse=True)
    named = ", ".join(name for *_, name in off)
    listed = "; ".join(text for _, text, _ in off)
    return error("held_parameter", f"{listed}: free {named} too, or give the prior it has")
