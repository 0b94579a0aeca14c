"""Causes of what a fit leaves: residuals, positions left out, drifts.

Possible explanations of the residuals are tried one by one and the one that fits is reported;
the data are not changed. Checks that need no fit are in `diagnose.data`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode, listed
from flexdt.twin.calibration.diagnose.causes import (
    LEAST_BEADS,
    Found,
    Known,
    Refit,
    explained_by_causes,
    lost_beads,
)
from flexdt.twin.calibration.diagnose.frame_places import MOST_LEFT_OUT
from flexdt.twin.calibration.diagnose.named_causes import named_causes
from flexdt.twin.calibration.diagnose.named_motion import (
    ALIKE_MOTION,
    alternatives,
    moving,
)
from flexdt.twin.calibration.diagnose.residual_limit import largest_residual
from flexdt.twin.calibration.diagnose.slipped import Verdict, with_loose_beads
from flexdt.twin.calibration.diagnose.wobble import wobble
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import (
    MotionFit,
)
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.findings import Finding, Findings, error, warning

OF_RESIDUALS = frozenset(
    (
        CalibrationCode.DRIFT,
        CalibrationCode.VIBRATION,
        CalibrationCode.BEAD_ERRORS,
        CalibrationCode.BEAD_DISPLACED,
        CalibrationCode.TOO_MANY_OUTLIERS,
        CalibrationCode.BEAD_TOLERANCE,
    )
)
"""Codes of findings about residuals: they hold for that fit alone."""
MISFIT_CHANCE: Final = 0.01
"""Probability of positions that scatter so much, below which a fit is not to be used unless
its residuals are explained."""
MOST_USED = 0.9
"""Share of the positions below which a fit is good only because it left the others out."""
BEAD_ERROR_SIGMAS = 1.0
"""Errors that repeat with the turn, in standard deviations of a position, up to which they
widen the intervals alone and are no finding."""
PLAUSIBLE_SHARE = 0.12
"""Largest offset along the beam, as a share of SOD, that a mount may cause. A phantom that is
scaled together with its beads looks like the right one at another distance, so that this offset
is its only sign."""
OF_MOTION: Final = frozenset(
    (
        CalibrationCode.DRIFT,
        CalibrationCode.VIBRATION,
        CalibrationCode.ANGLES_WRONG,
    )
)
"""Codes of findings on motion that may be followed from frame to frame."""
UNEXPLAINED_MOTION: Final = ("dO_x", "dO_y", "alpha")
"""Parameters that are advised to differ between frames where no cause explains a misfit."""


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


def explain_residuals(
    fit: FitResult,
    *,
    known: Known,
    refit: Refit,
    sigmas_known: bool,
    misfit_px: float = 0.0,
) -> tuple[FitResult, list[Finding]]:
    """Judge the residuals of the final fit; name the causes that would explain them.

    If the residuals exceed the limit, or too many positions were left out, a factor on
    the angles is tried; then, beyond the limit or where `MOST_LEFT_OUT` of a scan were
    left out, what moves (`_moving_beside`); else, beyond the limit, the error "misfit" is
    given. Beside these only lost beads are reported. Beads that move against each other
    (`beads_moved`) are the only finding, and widen the sigmas where they are open.

    Args:
        fit: to be judged; nothing is judged if it is not determined.
        known: statements on the phantom and the positions.
        refit: fits again with more parameters free.
        sigmas_known: the positions' sigmas were measured, and are no more than compared.
        misfit_px: residual up to which the fit is used, whatever its positions scatter.

    Returns:
        The fit to be reported (with the causes that explain the residuals) and the
        findings; only the factor's error, with the original fit, if that explains them.
    """
    if not fit.determined:
        return fit, []
    plain = fit
    fit, causes = explained_by_causes(fit, known, refit)
    named = named_causes(fit, causes)
    certificate = fit.certificate
    out = [*_lost_beads(fit), *_drifts(fit), *named]
    limit = max(misfit_px, largest_residual(fit, MISFIT_CHANCE, sigmas_known))
    bad = certificate.rms_px >= limit
    if bad or plain.certificate.used.sum() < MOST_USED * plain.problem.seen.sum():
        turned = _angle_scale(plain, refit)
        if turned is not None:
            return plain, [turned]
    crowd = max(map(_share_left_out, (plain, fit))) > MOST_LEFT_OUT
    if not bad and not crowd:
        fit, loose = with_loose_beads(plain, fit, known)
        if loose is not None:
            return fit, [loose.finding(fit.problem.group)]
        return fit, out
    # What else the residuals show has no meaning where no cause explains them.
    explained = _moving_beside(plain, fit, named, causes, refit)
    if explained:
        # Most of a scan was left out because of it, and with that its beads. A bead whose
        # place is only open beside the motion is elsewhere if the fit without that says so.
        still = fit if causes.applied else plain
        return fit, [*([] if crowd else _lost_beads(still)), *explained]
    fit, loose = with_loose_beads(plain, fit, known)
    if loose is not None and _explains(loose, plain, limit):
        return fit, [loose.finding(fit.problem.group)]
    if not bad:
        return fit, out
    misfit = error(
        CalibrationCode.MISFIT,
        f"the fit leaves residuals of {certificate.rms_px:.2f} px, and no cause that is "
        "looked for explains them: check that nothing is loose, or let frames differ, "
        f"--per-frame {','.join(UNEXPLAINED_MOTION)}",
        per_frame=UNEXPLAINED_MOTION,
    )
    return fit, [*_lost_beads(fit), misfit]


def _explains(loose: Verdict, fit: FitResult, limit: float) -> bool:
    """Check whether beads that move explain the residuals of a fit: they leave less than a
    limit [px].
    """
    certificate = fit.certificate
    return loose.rest * certificate.rms_px < limit * certificate.noise


def _moving_beside(
    plain: FitResult,
    fit: FitResult,
    named: Sequence[Finding],
    causes: Found,
    refit: Refit,
) -> list[Finding]:
    """Name a motion, or a wobble of the axis, that explains the residuals: by itself, else
    beside the causes of the residuals, else beside a factor on the angles.

    Args:
        plain: without causes.
        fit: with those of `causes`.
        named: its findings.
        causes: of the residuals, and those that are likely where something moves.
        refit: fits again with more parameters free.

    Returns:
        An error, and the findings on what stands beside it; empty if nothing explains the
        residuals.
    """
    beside: list[tuple[FitResult, list[Finding]]] = [(plain, [])]
    if causes.applied:
        beside.append((fit, list(named)))
    if causes.beside_motion is not None:
        other, which = causes.beside_motion
        beside.append((other, named_causes(other, which)))
    for base, others in beside:
        found = moving(base, partial(_refit_moving, base, refit)) or wobble(base)
        if found is not None:
            return [found, *Findings(others).without(CalibrationCode.CAUSES_OPEN)]
    # A motion takes up such a factor, but a lean does not.
    return listed(wobble(refit(extra=("angle_scale",))))


def _refit_moving(fit: FitResult, refit: Refit, motion: MotionFit) -> FitResult:
    """Fit again with a motion, and the causes of a fit."""
    return refit(
        motion=motion,
        panel=fit.problem.panel,
        strain=fit.strain_prior,
        arc=fit.problem.layout.arc_column >= 0,
        rows=fit.problem.layout.rows_column >= 0,
        bead_tolerance_mm=fit.bead_prior_mm or None,
    )


def _share_left_out(fit: FitResult) -> float:
    """Compute the largest share of frames or positions that a fit left out of a scan; a
    frame counts if most of its positions were left out.
    """
    group = fit.problem.group
    seen = fit.problem.seen.sum(axis=1)
    used = fit.certificate.used.sum(axis=1)
    frames = np.bincount(group, (used < 0.5 * seen) & (seen >= 2)) / np.bincount(group)
    kept = np.bincount(group, used) / np.maximum(np.bincount(group, seen), 1.0)
    return float(max(frames.max(), 1.0 - kept.min()))


def _drifts(fit: FitResult) -> list[Finding]:
    """List warnings: the strongest drift or jump of a parameter, then errors that the
    beads of a frame share (vibration), then those that a bead repeats in each turn, if
    they exceed the noise of a position (`BEAD_ERROR_SIGMAS`); empty without any.
    """
    certificate = fit.certificate
    out = []
    for drift in certificate.drifts[:1]:
        estimate = certificate.estimates.get(drift.column)
        if estimate is None:
            unit = ""
        else:
            unit = estimate.unit
        if drift.step_at is None:
            how = "during the scan"
        else:
            how = f"near frame {drift.step_at}"
        if fit.problem.group.max() > 0:
            how += f" of scan {drift.scan + 1}"
        out.append(
            warning(
                CalibrationCode.DRIFT,
                f"{drift.column} changes by {drift.size:+.3g} {unit} {how} ({drift.score:.0f} "
                f"sigma){_looks_alike(drift.column)}; its interval contains the change, and "
                f"--per-frame {','.join(MOVING)} would follow it",
                per_frame=MOVING,
            )
        )
    for there, code, what in (
        (
            certificate.shared,
            CalibrationCode.VIBRATION,
            "the beads of a frame err together (vibration or angle jitter)",
        ),
        (
            certificate.turning > BEAD_ERROR_SIGMAS,
            CalibrationCode.BEAD_ERRORS,
            f"single beads err by about {certificate.turning * certificate.rms_px:.2g} px, "
            "smoothly as the object turns (bead positions, background, distortion)",
        ),
    ):
        if there:
            out.append(warning(code, f"{what}: the intervals allow for it"))
    return out


def _looks_alike(column: str) -> str:
    """Return words on another motion that looks like a change of a parameter (of one
    scan: NAME@NUMBER), in brackets after a blank; "" without one.
    """
    return alternatives(ALIKE_MOTION.get(column.split("@")[0], ()))


def _lost_beads(fit: FitResult) -> list[Finding]:
    """List beads seen in at least three frames and left out of more than half of them.

    Returns:
        One finding: a warning, or an error if fewer than three beads remain. Without such
        beads: an error if over 35 % of all positions were left out, else empty.
    """
    problem = fit.problem
    used = fit.certificate.used
    lost = lost_beads(fit)
    if lost:
        text = f"bead {', '.join(map(str, lost))} is not where the phantom's model has it and was"
        if len(problem.model) - len(lost) >= LEAST_BEADS:
            judged = warning
        else:
            judged = error
        return [judged(CalibrationCode.BEAD_DISPLACED, f"{text} left out")]
    share = 1.0 - used.sum() / max(int(problem.seen.sum()), 1)
    text = f"{100 * share:.0f} % of the positions had to be left out"
    if share > 0.35:
        return [error(CalibrationCode.TOO_MANY_OUTLIERS, text)]
    return []


def _explained(better: FitResult, fit: FitResult) -> bool:
    """Check whether `better` explains the residuals of `fit`: they are halved and may be
    chance, it is determined, and uses at least `MOST_USED` as many positions.
    """
    rms = better.certificate.rms_px
    return (
        better.determined
        and rms < 0.5 * fit.certificate.rms_px
        and rms < largest_residual(better, MISFIT_CHANCE)
        and better.certificate.used.sum() >= MOST_USED * fit.certificate.used.sum()
    )


def _angle_scale(fit: FitResult, refit: Refit) -> Finding | None:
    """Fit a factor on the angles, and judge whether it explains the residuals.

    Args:
        fit: without the factor.
        refit: fits again with further parameters, `extra`.

    Returns:
        An error that names the factor, as an endpoint error if it is n / (n - 1) or (n -
        1) / n; None if the factor is estimated already, explains nothing or is within 5
        sigma of 1.
    """
    if "angle_scale" in fit.certificate.estimates:
        return None
    better = refit(extra=("angle_scale",))
    if not _explained(better, fit):
        return None
    estimate = better.certificate.estimates["angle_scale"]
    n = len(fit.problem.poses)
    if abs(estimate.value - 1.0) < 5.0 * estimate.sigma:
        return None
    known = ""
    for factor, text in ((n / (n - 1), f"360 / {n - 1}"), ((n - 1) / n, f"360 / {n}")):
        if abs(estimate.value / factor - 1.0) < 0.1 / n:
            known = f": the steps are {text} (endpoint error)"
    return error(
        CalibrationCode.ANGLE_ENDPOINT if known else CalibrationCode.ANGLE_SCALE,
        f"the frame angles are off by a factor {estimate.value:.5f}{known}; correct "
        "them, or free angle_scale",
        free=("angle_scale",),
    )
