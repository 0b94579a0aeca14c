"""The verdict on a fit: what its residuals show, in findings, and whether it may be used.

One table says what each finding does to the numbers (`POLICY`); a finding that is not in it is a
warning. What no group explains, or only errors of the spots themselves, counts as a residual.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from scipy.special import chdtri

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.frame_places import MOST_LEFT_OUT
from flexdt.twin.calibration.diagnose.table.explained import Explained, explained
from flexdt.twin.calibration.diagnose.table.followed import (
    frame_motions,
    sets_of_movers,
)
from flexdt.twin.calibration.diagnose.table.group import (
    NAMED_LOG_ODDS,
    OPEN_LOG_ODDS,
    Found,
    Known,
    Seen,
)
from flexdt.twin.calibration.diagnose.table.groups import (
    CAUSES,
    bead_places,
    bend,
    growth,
    moving,
    positions,
    rows,
    spots,
)
from flexdt.twin.calibration.diagnose.table.held_out import held_out
from flexdt.twin.calibration.diagnose.table.posterior import Posterior
from flexdt.twin.calibration.diagnose.table.reliability import hidden_causes
from flexdt.twin.calibration.fit.certificate import POSITION_SPREAD_PX, SPREAD_FREEDOM
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.findings import ERROR, WARNING, Finding, error, warning

MISFIT_CHANCE: Final = 0.01
"""Probability of positions that scatter so much, below which a fit is not to be used unless
its residuals are explained."""
UNPREDICTED_CHANCE: Final = 1e-3
"""Probability of a block of frames so far from its prediction, below which it is told."""
NOISE_SIGMAS: Final = 1.5
"""Stated sigmas up to which residuals are noise, however large."""
LEAST_BEADS: Final = 3
MOST_LOST: Final = 0.35
"""Part of the positions that may be left out."""


class Use(enum.Enum):
    """What a finding does to the numbers."""

    OFFER = "offered"
    WITHHOLD = "withheld"


POLICY: Final[Mapping[CalibrationCode, Use]] = {
    # The geometry is known beside these: their columns are in every sigma.
    CalibrationCode.PHANTOM_STRAINED: Use.OFFER,
    CalibrationCode.BEAD_TOLERANCE: Use.OFFER,
    CalibrationCode.EXPOSURE_ARC: Use.OFFER,
    CalibrationCode.ROWS_IN_TURN: Use.OFFER,
    CalibrationCode.PANEL_DISTORTED: Use.OFFER,
    CalibrationCode.BEAD_ERRORS: Use.OFFER,
    CalibrationCode.CAUSES_OPEN: Use.OFFER,
    # The geometry is that of the mean over the scan.
    CalibrationCode.DRIFT: Use.OFFER,
    CalibrationCode.VIBRATION: Use.OFFER,
    CalibrationCode.WOBBLE: Use.OFFER,
    CalibrationCode.ANGLES_WRONG: Use.OFFER,
    # What was told is wrong, and its correction changes what is asked.
    CalibrationCode.ANGLE_SCALE: Use.WITHHOLD,
    CalibrationCode.ANGLE_ENDPOINT: Use.WITHHOLD,
    CalibrationCode.ANGLE_STEP: Use.WITHHOLD,
    CalibrationCode.FRAME_NUMBERS: Use.WITHHOLD,
    # No phantom has a place of its own then.
    CalibrationCode.BEADS_MOVED: Use.WITHHOLD,
    CalibrationCode.MISFIT: Use.WITHHOLD,
}
"""Finding on the residuals -> what it does to the numbers."""
TOLD_TOGETHER: Final[Mapping[str, tuple[str, ...]]] = {
    rows.NAME: (bend.NAME,),
    bead_places.NAME: (bend.NAME,),
    growth.NAME: (moving.NAME,),
}
"""Cause -> causes of which its sentence holds, too."""
UNEXPLAINED_MOTION: Final = ("dO_x", "dO_y", "alpha")
"""Parameters that are advised to differ between frames where no cause explains a misfit."""


def judged(
    fit: FitResult,
    known: Known,
    *,
    sigmas_known: bool,
    misfit_px: float = 0.0,
) -> tuple[FitResult, list[Finding]]:
    """Explain the residuals of a fit, and judge it.

    Args:
        fit: to be judged; nothing is judged if it is not determined.
        known: statements on the phantom and the positions.
        sigmas_known: the positions' sigmas were measured, and are no more than compared.
        misfit_px: residual up to which the fit is used, whatever its positions scatter.

    Returns:
        The fit to be reported, with the groups that explain its residuals and with the
        posterior's sigmas, and with the motion if any is asked; and the findings.
    """
    if not fit.determined:
        return fit, []
    what = explained(fit, known)
    found = found_in(what, known)
    told = [finding for cause in CAUSES for finding in cause.told(found)]
    told += _open(found, told) or _unpredicted(what, told)
    hidden = hidden_causes(what.search, what.posterior.best, what.further, what.fit)
    fit = replace(what.fit, certificate=replace(what.fit.certificate, hidden=hidden))
    if known.asked:
        fit = replace(fit, motions=frame_motions(what, known.asked))
    lost = _lost_beads(fit, told)
    if _misfits(what, sigmas_known, misfit_px):
        told = [_misfit(fit)] if not any(_withheld(f) for f in told) else told
    return fit, [*lost, *map(_by_policy, told)]


def found_in(what: Explained, known: Known) -> Found:
    """Collect what a table has found, for sentences.

    Args:
        what: was found.
        known: with what it was made.
    """
    posterior = what.posterior
    certificate = what.fit.certificate
    px = certificate.rms_px / certificate.noise if certificate.noise > 0 else 1.0
    seen = [
        Seen(
            posterior.name(group),
            posterior.families[group[0]].cause,
            posterior.families[group[0]].places[group[1]],
            max(posterior.odds([group]), _told_odds(
                posterior, posterior.families[group[0]].cause)),
            weights,
            None
            if posterior.families[group[0]].courses is None
            else what.course(group),
            px * what.moves_px[group],
        )
        for group, weights in what.weights.items()
        if group not in what.held
    ]  # fmt: skip
    seen.sort(key=lambda s: -s.effect_px)
    there = {s.cause for s in seen}
    rivals = tuple(
        cause.words
        for cause in CAUSES
        if cause.name not in (positions.NAME, spots.NAME)
        and (cause.name in there or posterior.cause_odds(cause.name) > -OPEN_LOG_ODDS)
    )
    movers = sets_of_movers(what) if known.asked else {}
    return Found(what.fit, tuple(seen), rivals, what.strain, known, movers)


def _told_odds(posterior: Posterior, cause: str) -> float:
    """Return the logarithm of the odds that what a cause's sentence tells is there."""
    return posterior.cause_odds(cause, *TOLD_TOGETHER.get(cause, ()))


def _open(found: Found, told: list[Finding]) -> list[Finding]:
    """Tell causes together that are likely, but not beyond doubt; a strained phantom's
    rivals are in its own finding.
    """
    # Of a motion that is followed its own sentence says what is open.
    others = (spots.NAME, moving.NAME) if found.known.asked else (spots.NAME,)
    doubtful = [
        s for s in found.seen if s.odds <= NAMED_LOG_ODDS and s.cause not in others
    ]
    if not doubtful or any(f.code is CalibrationCode.PHANTOM_STRAINED for f in told):
        return []
    return [
        warning(
            CalibrationCode.CAUSES_OPEN,
            "the residuals have a cause that the images do not tell for certain: "
            f"{' or '.join(found.open)} (most likely {doubtful[0].name}); the intervals contain "
            "what they differ by",
        )
    ]


def _unpredicted(what: Explained, told: list[Finding]) -> list[Finding]:
    """Tell of a block of frames that the others do not predict, unless what withholds the
    numbers is told.
    """
    held = held_out(what.search, what.posterior.best)
    if held.chance > UNPREDICTED_CHANCE or any(_withheld(f) for f in told):
        return []
    return [
        warning(
            CalibrationCode.CAUSES_OPEN,
            f"frames {held.frames[0]} to {held.frames[1]} show the beads {held.off_px:.2g} px from "
            f"where all others predict them (chance {held.chance:.0e}): something that no cause "
            "describes; the intervals may be too narrow",
        )
    ]


def _withheld(finding: Finding) -> bool:
    code = finding.code
    assert isinstance(code, CalibrationCode)
    return POLICY.get(code, Use.OFFER) is Use.WITHHOLD


def _by_policy(finding: Finding) -> Finding:
    """Return a finding with the severity that its use of the numbers asks for."""
    return replace(finding, severity=ERROR if _withheld(finding) else WARNING)


def _misfits(what: Explained, sigmas_known: bool, misfit_px: float) -> bool:
    """Check whether residuals are larger than chance makes them, those that only errors of
    the spots themselves explain among them.
    """
    fit = what.fit
    spread = fit.certificate.rms_px
    limit = max(misfit_px, largest_residual(fit, MISFIT_CHANCE, sigmas_known))
    return bool(spread >= limit) or _share_left_out(fit) > MOST_LEFT_OUT


def largest_residual(fit: FitResult, chance: float, sigmas_known: bool = False) -> float:
    """Compute the rms residual [px] that a right fit exceeds with a probability `chance`.

    Positions scatter by their sigmas (ignored unless `sigmas_known`, measured) and, from
    image to image, by `POSITION_SPREAD_PX`.
    """
    usual = SPREAD_FREEDOM / float(chdtri(SPREAD_FREEDOM, 1.0 - chance))
    certificate = fit.certificate
    measured = sigmas_known and certificate.noise > 0.0
    if measured:
        stated = certificate.rms_px / certificate.noise
    else:
        stated = 0.0
    return math.hypot(POSITION_SPREAD_PX * math.sqrt(usual), NOISE_SIGMAS * stated)


def _misfit(fit: FitResult) -> Finding:
    return error(
        CalibrationCode.MISFIT,
        f"the fit leaves residuals of {fit.certificate.rms_px:.2f} px, and no cause that is "
        "looked for explains them: check that nothing is loose, or let frames differ, "
        f"--per-frame {','.join(UNEXPLAINED_MOTION)}",
        per_frame=UNEXPLAINED_MOTION,
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


def lost_beads(fit: FitResult) -> list[int]:
    """List the beads that are seen in three frames at least and that a fit left out of more
    than half of them.
    """
    seen = fit.problem.seen.sum(axis=0)
    used = fit.certificate.used.sum(axis=0)
    return np.flatnonzero((seen >= 3) & (used < 0.5 * seen)).tolist()


def _lost_beads(fit: FitResult, told: list[Finding]) -> list[Finding]:
    """List beads that were left out of more than half of their frames, unless it is told why.

    Returns:
        One finding: a warning, or an error if fewer than three beads remain. Without such
        beads: an error if over `MOST_LOST` of all positions were left out, else empty.
    """
    problem = fit.problem
    lost = lost_beads(fit)
    if lost and not any(f.code is CalibrationCode.BEADS_MOVED for f in told):
        text = f"bead {', '.join(map(str, lost))} is not where the phantom's model has it and was"
        enough = len(problem.model) - len(lost) >= LEAST_BEADS
        judged_ = warning if enough else error
        return [judged_(CalibrationCode.BEAD_DISPLACED, f"{text} left out")]
    share = 1.0 - fit.certificate.used.sum() / max(int(problem.seen.sum()), 1)
    if share > MOST_LOST:
        text = f"{100 * share:.0f} % of the positions had to be left out"
        return [error(CalibrationCode.TOO_MANY_OUTLIERS, text)]
    return []
