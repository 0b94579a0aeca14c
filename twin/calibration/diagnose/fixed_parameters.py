"""Checks whether each fixed parameter has the value that the data ask for.

A parameter that is fixed at a wrong value shifts the others, and free bead positions can hide that:
the residuals look right and the answer is wrong. So each fixed parameter is freed in turn. The
request itself is not changed; the finding names the parameters that should be free.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy import stats

from flexdt.twin.calibration.diagnose.data import Finding, Severity, error
from flexdt.twin.calibration.fit.fit import FitResult

HELD_SIGMAS: Final = 5.0
"""How far, in standard deviations, the data may have a fixed parameter from where it is fixed."""
DOUBT_SIGMAS: Final = 2.3
"""Beyond this the intervals of what is free contain what the fixed ones would change."""
OTHERS: Final = (
    "dD_x", "dD_y", "dD_z", "det_roll", "det_pitch", "det_yaw", "axis_tilt_x", "axis_tilt_z",
)  # fmt: skip
"""Beyond the thesis's six, what one scan can tell at least roughly. (A source offset looks like an
offset of stage and detector; angle_scale is looked for among the angles.)"""


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


def as_good(fit: FitResult, best: FitResult) -> bool:
    """Whether a fit explains the data as well as the best: within HELD_SIGMAS of its chi2."""
    mine, least = fit.certificate, best.certificate
    worse = mine.rms_px**2 * mine.used.sum() - least.rms_px**2 * least.used.sum()
    return bool(2.0 * worse <= HELD_SIGMAS**2 * least.rms_px**2)


def tolerated(finding: Finding) -> Finding:
    """The same as a warning: freeing it hardly moves what was asked for."""
    return replace(
        finding,
        severity=Severity.WARNING,
        text=finding.text + "; the intervals contain what that would change",
    )
