"""Motion during the scans: found, put into their poses, and judged by the last fit."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.named_motion import MOTION_WORDS, open_motions
from flexdt.twin.calibration.fit.evidence import OPEN_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import (
    MotionFit,
    estimate_motion,
    follow_motion,
)
from flexdt.twin.calibration.fits_of_scans import refit_scans
from flexdt.twin.calibration.fixed_check import explain
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest, stated_priors
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import Finding, error, warning

MOST_TURNS: Final = 3
"""Times that motion and the causes of residuals are estimated beside each other."""


def fit_with_motion(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> tuple[Calibration, FitResult]:
    """Put the motion of the scans into their poses, and fit to them; see `follow_motion`.

    An earlier motion is taken out of the poses first.

    Args:
        state: the scans and their measurements.
        request: the free parameters, and those that may move.
        fit: the last one.

    Returns:
        The state with the motion in its poses, and the fit.
    """
    still = [s.poses for s in state.scans]
    if state.motions:
        still = [m.applied(p, -1.0) for p, m in zip(still, state.motions, strict=True)]

    def moved(motion: MotionFit) -> Calibration:
        """Return a copy of the state with an estimated motion, applied to the poses that
        the scans had without motion.
        """
        scans = tuple(
            replace(s, poses=m.applied(p))
            for s, p, m in zip(state.scans, still, motion.motions, strict=True)
        )
        return replace(state, scans=scans, motion=motion)

    stated = stated_priors(state.scans, request, state.model)
    fit, found = follow_motion(
        fit,
        request.per_frame,
        lambda motion: refit_scans(
            moved(motion), request, fit, bead_tolerance_mm=fit.bead_prior_mm or None
        ),
        state.motion,
        [name for name, width in stated.items() if width == 0],
    )
    return moved(found), fit


def explained_with_motion(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> tuple[Calibration, FitResult, list[Finding]]:
    """Explain the residuals of a fit; where something moves beside their causes, estimate
    motion and causes by turns until the motion stays, `MOST_TURNS` at most.

    Args:
        state: the scans, perhaps with a motion in their poses.
        request: the free parameters, and those that may move.
        fit: without causes.

    Returns:
        The state with the motion beside the causes, the fit with both, and the findings.
    """
    better, explained = explain(state, request, fit)
    for _ in range(MOST_TURNS):
        before = state.motion
        if before is None or _alike(better, fit):
            break
        try:
            state, _ = fit_with_motion(state, request, better)
        except TwinError:  # Beside these causes the tracks tell too little of it.
            break
        fit = refit_scans(state, request, fit)
        better, explained = explain(state, request, fit)
        if state.motion is not None and state.motion.near(before):
            break
    return state, better, explained


def _alike(one: FitResult, other: FitResult) -> bool:
    """Check whether two fits have the same causes of residuals."""
    same = one.problem.layout.names == other.problem.layout.names
    return same and one.strain_prior == other.strain_prior


def settle_motion(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> tuple[Calibration, list[Finding]]:
    """Widen the sigmas of the motion by the change that the last fit would make to it.

    Args:
        state: with a motion, which is required.
        request: the parameters that may move.
        fit: the last one.

    Returns:
        The state with wider sigmas but the same motion, and findings: warnings if something
        else moves than was asked for, if the tracks leave open what moves, and if it
        changes by more than a sigma; an error if the fit is determined but an asked
        parameter with a unit is determined worse than `request.bound`.
    """
    held = state.motion
    assert held is not None
    again = estimate_motion(fit, request.per_frame, held, search=False)
    off = [b.values - a.values for a, b in zip(held.motions, again.motions, strict=True)]
    motions = tuple(
        replace(a, sigma=np.hypot(b.sigma, d))
        for a, b, d in zip(held.motions, again.motions, off, strict=True)
    )
    worst = max(
        float(np.nan_to_num(np.abs(d) / np.maximum(b.sigma, 1e-300)).max(initial=0.0))
        for b, d in zip(again.motions, off, strict=True)
    )
    out = _what_moves(held)
    if worst > 1.0:
        out.append(
            warning(
                CalibrationCode.MOTION_UNSETTLED,
                f"the motion differs by up to {worst:.1f} sigma from what the last fit "
                "would make of it; its sigmas contain that",
            )
        )
    wide = [
        f"{n} to {e.sigma:.2g} {e.unit}"
        for n, e in fit.certificate.estimates.items()
        if fit.determined and e.asked and e.unit != "1" and e.sigma > request.bound
    ]
    if wide:
        out.append(
            error(
                CalibrationCode.MOTION_HIDES,
                f"as {', '.join(request.per_frame)} may differ from frame to frame, "
                f"{', '.join(wide)} is all that can be said; allowed: {request.bound:g}",
            )
        )
    return replace(state, motion=replace(held, motions=motions)), out


def _what_moves(held: MotionFit) -> list[Finding]:
    """Make warnings that something else moves than was asked for, and that it is open what
    moves.

    Args:
        held: the motion.
    """
    out = []
    others = [n for n in held.moving if n not in held.asked]
    if others:
        words = " and ".join(MOTION_WORDS[n] for n in others)
        asked = ", ".join(held.asked)
        how = "instead of" if set(held.moving).isdisjoint(held.asked) else "beside"
        out.append(
            warning(
                CalibrationCode.OTHER_MOTION,
                f"{words} ({', '.join(others)}) {how} {asked}: that explains the images far "
                "better, and was followed",
            )
        )
    alike = open_motions(held, math.exp(OPEN_LOG_ODDS))
    if alike:
        out.append(
            warning(
                CalibrationCode.MOTION_OPEN,
                f"the images do not tell for certain what moves, {', '.join(held.moving)} or "
                f"otherwise: {' or '.join(alike)}; the intervals contain what they differ by",
            )
        )
    return out
