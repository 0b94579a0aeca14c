"""Check whether the parameters that a calibration does not estimate agree with the data."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from flexdt.twin.calibration.diagnose import (
    OF_RESIDUALS,
    CalibrationCode,
    listed,
)
from flexdt.twin.calibration.diagnose.fixed_parameters import (
    DOUBT_SIGMAS,
    doubtful,
    held_distance,
    judge_exact,
    judge_held,
    judge_priors,
    loosened,
    narrow_priors_warning,
)
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.groups.told import DISTANCE, pitch_beside
from flexdt.twin.calibration.diagnose.table.verdict import judged
from flexdt.twin.calibration.fit.certificate import widened
from flexdt.twin.calibration.fit.fit import FitResult, Solver
from flexdt.twin.calibration.fit.priors import ASSUMED, FIXED, gives_room, known
from flexdt.twin.calibration.fit.problem import (
    SIX,
    from_printed_reading,
    to_printed_reading,
)
from flexdt.twin.calibration.fit.residual_structure import larger
from flexdt.twin.calibration.fits_of_scans import (
    MEASURED,
    fit_with_loose_priors,
    positions_weighed,
    refit_scans,
)
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import (
    ANYWHERE,
    CalibrationRequest,
    priors_of,
    stated_priors,
    strain_prior,
    with_free,
)
from flexdt.twin.findings import Finding, Findings
from flexdt.twin.geometry.offsets import NAMES
from flexdt.twin.geometry.told_lengths import TOLD
from flexdt.twin.machine.stated_causes import TOLD_RIVALS, limits_of

OF_FRAME = ("dO_y", "alpha", "tau_x", "tau_z")
"""Gauge parameters when bead positions are free: they only choose the frame of the object."""


def explain(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> tuple[FitResult, list[Finding]]:
    """Explain the residuals of a fit, and fit with beads or panel free where they are the
    cause.

    See `verdict.judged`; this gives it the scans' strains, tolerance, floor of sigmas and
    arc.

    Args:
        state: the scans and their measurements.
        request: the free parameters.
        fit: to explain.

    Returns:
        The fit to be reported, and its findings.
    """
    weighed = positions_weighed(state)
    scanners = known((), None, (scan.priors for scan in state.scans))
    stated = Known(
        strain_prior(state.model, request),
        request.bead_tolerance_mm,
        (MEASURED if weighed else Solver()).floor_px,
        _stated_arc(state),
        _arc_left(state),
        max((m.sampling_px for m in state.measured), default=0.0),
        _limits(state, request),
        frozenset(
            name
            for name, width in stated_priors(state.scans, request, state.model).items()
            if width == 0
        ),
        request.per_frame,
        pitch_beside(fit, scanners[DISTANCE]),
    )
    return judged(fit, stated, sigmas_known=weighed, misfit_px=request.misfit_px)


def without_groups(state: Calibration, fit: FitResult) -> Calibration:
    """Return the state with what moves, and what else is no column of a fit, taken out of its
    positions, and without the positions of single beads that are elsewhere: fits to it compare
    priors with images.

    Args:
        state: the scans and their measurements.
        fit: with the groups that explain its residuals.
    """
    problem = fit.problem
    tracks = problem.pixels
    if problem.layout.bead_column >= 0 and not fit.bead_prior_mm:
        places = fit.solution.x[problem.layout.bead_columns].reshape(-1, 3)
        tracks[:, (places != problem.model.beads).any(axis=1)] = np.nan
    ends = np.cumsum([0, *(len(scan.poses) for scan in state.scans)]).tolist()
    parts = [slice(*ends[i : i + 2]) for i in range(len(state.scans))]
    scans = tuple(
        replace(scan, poses=problem.poses[own])
        for scan, own in zip(state.scans, parts, strict=True)
    )
    if state.measured:
        measured = [
            replace(one, tracks=tracks[own])
            for one, own in zip(state.measured, parts, strict=True)
        ]
        return replace(state, scans=scans, measured=tuple(measured))
    found = [
        replace(one, tracks=tracks[own])
        for one, own in zip(state.identifications, parts, strict=True)
    ]
    return replace(state, scans=scans, identifications=tuple(found))


def _limits(state: Calibration, request: CalibrationRequest) -> dict[str, float]:
    """Return the largest standard deviation of causes, 0: excluded. Where the request frees a
    told length, or gives it room, it says which may be off, and no other is a rival.
    """
    limits = limits_of([scan.priors for scan in state.scans], request.priors)
    roomy = any(gives_room(name, width) for name, width in request.priors.items())
    if roomy or any(name in TOLD for name in request.free):
        limits[TOLD_RIVALS] = 0.0
    return limits


def _stated_arc(state: Calibration) -> float | None:
    """Return the part of a step that an exposure lasts, if it is equal in all scans. Returns
    None if the scans differ, or do not state it."""
    arcs = {scan.arc for scan in state.scans}
    return arcs.pop() if len(arcs) == 1 else None


def _arc_left(state: Calibration) -> float | None:
    """Return the standard deviation of the squared share of a step that the spots' smear
    leaves in their positions, the largest of all scans; None where it is not measured."""
    left = [measured.smear.left for measured in state.measured]
    return max(left) if left and math.isfinite(max(left)) else None


def check_fixed(
    state: Calibration,
    asked: CalibrationRequest,
    free: CalibrationRequest,
    free_fit: FitResult,
    explained: list[Finding],
) -> tuple[FitResult, list[Finding]]:
    """Fit the requested parameters, if the fixed ones agree with the data.

    Where the data contradict a fixed parameter, the findings say so and nothing more is
    checked. Then the priors of other offsets are compared with the images: where they
    contradict, findings say so; where they are a little too narrow, they are widened and
    the fit repeated. Intervals are widened where fixed values are doubtful; parameters
    stated as exact are judged.

    Args:
        state: the scans and their measurements.
        asked: the user's request.
        free: the same with all six main parameters free, where the data separate them;
            else fixed ones are freed one by one.
        free_fit: its fit.
        explained: findings on its residuals.

    Returns:
        The fit with those parameters fixed that are to be, and the findings that replace
        `explained`.
    """
    whole = state
    state = without_groups(whole, free_fit)
    fixed = _fixed_values(state, asked)
    fit = free_fit
    if set(free.free) - set(asked.free):
        fit = _fit_with_fixed(state, asked, free_fit)
    contradicted = _contradicted(state, asked, fit, fixed, (free_fit, explained))
    if contradicted is not None:
        return fit, contradicted
    usual, exact = _with_usual_priors(state, asked)
    loose_fit = fit_with_loose_priors(state, usual, fit)
    verdict = judge_priors(loose_fit, exact)
    errors = {f.code for f in explained if f.forbids}
    if verdict.finding is not None and errors <= OF_RESIDUALS | {CalibrationCode.MISFIT}:
        left = _left_by_priors(state, usual, loose_fit, explained)
        return fit, [*left, verdict.finding]
    found = listed(verdict.lengths)
    if verdict.factor > 1.0:
        found.append(narrow_priors_warning(verdict))
        given = {**asked.priors, **priors_of(state.scans, asked, state.model)}
        asked = replace(asked, priors=loosened(given, verdict.factor))
    before = fit
    if verdict.factor > 1.0 or fit is not free_fit:
        fit, explained = explain(whole, asked, _fit_with_fixed(whole, asked, fit))
    if verdict.factor > 1.0:
        fit = _with_stated_priors(fit, before)
    fit = _doubted(fit, free_fit, fixed)
    if exact:
        found += listed(_exact_judged(whole, state, usual, fit, exact))
    if Findings(explained).errors.without(CalibrationCode.MISFIT):
        # What spoils the fit moves it as a scanner elsewhere would.
        return fit, [*explained, *(f for f in found if f.forbids)]

    def without(name: str) -> FitResult:
        """Fit with one parameter's prior so wide that the images alone determine it,
        without a bound."""
        alone = replace(asked, priors={**asked.priors, name: ANYWHERE}, bound=math.inf)
        return refit_scans(state, alone, fit)

    return doubtful(fit, verdict, without), [*explained, *found]


def _exact_judged(
    whole: Calibration,
    state: Calibration,
    usual: CalibrationRequest,
    fit: FitResult,
    exact: Mapping[str, float],
) -> Finding | None:
    """Judge the `exact` parameters (edge units) by a fit with their usual priors.

    An error must stand on the `whole` data with all causes, too; `state` is without what
    moves.
    """
    judged = judge_exact(fit, refit_scans(state, usual, fit), exact)
    if judged is not None and judged.forbids:
        freed = explain(whole, usual, refit_scans(whole, usual, fit))[0]
        return judge_exact(fit, freed, exact)
    return judged


def _centre(asked: CalibrationRequest) -> dict[str, float]:
    """Return the centers of a request's priors, in edge units; told lengths have 0."""
    return from_printed_reading(asked.start, asked.reading).to_edge()


def _fixed_values(state: Calibration, asked: CalibrationRequest) -> dict[str, float]:
    """Return the fixed main parameters with their values."""
    centre = _centre(asked)
    known = priors_of(state.scans, asked, state.model)
    return {n: centre[n] for n in SIX if n not in asked.free and n not in known}


def _contradicted(
    state: Calibration,
    asked: CalibrationRequest,
    fit: FitResult,
    fixed: Mapping[str, float],
    free: tuple[FitResult, list[Finding]],
) -> list[Finding] | None:
    """Judge whether the data contradict parameters that are `fixed` (edge units).

    The `free` fit is judged if it has all of them; else one fit each, with it free.
    Returns findings on its residuals and the first contradiction; None without.
    """
    trials = [free]
    if not set(fixed) <= set(free[0].values):
        trials = []
        for name in fixed:
            single = with_free(asked, (name,))
            trials.append(explain(state, single, refit_scans(state, single, fit)))
    for freed, found in trials:
        off = judge_held(freed, fixed)
        if off is not None:
            return [*found, off]
    return None


def _with_usual_priors(
    state: Calibration, asked: CalibrationRequest
) -> tuple[CalibrationRequest, dict[str, float]]:
    """Give the parameters stated as exact (prior 0) their usual priors; not those that only
    choose the object's frame when beads are anywhere.

    `state`: the scans, which may state priors, too; `asked`: the caller's request.
    Returns the request with those priors, and the values that were exact, edge units; empty if
    there are none.
    """
    stated = stated_priors(state.scans, asked, state.model)
    defined = OF_FRAME if (asked.bead_tolerance_mm or 0.0) >= ANYWHERE else ()
    usual = {**FIXED, **ASSUMED}
    widths = {n: w for n, w in usual.items() if stated.get(n) == 0 and n not in defined}
    centre = _centre(asked)
    request = replace(asked, priors={**asked.priors, **widths})
    return request, {n: centre.get(n, 0.0) for n in widths}


def _left_by_priors(
    state: Calibration,
    usual: CalibrationRequest,
    loose_fit: FitResult,
    explained: Sequence[Finding],
) -> list[Finding]:
    """Return the findings on residuals that remain with wider priors, where priors are
    off.

    Left out are "misfit", and the pitch, which a wide prior of the distance hides.
    `explained`: findings with the priors; those on beads' tolerance stay if the loose fit
    frees beads.
    """
    priors = loosened({**usual.priors, **priors_of(state.scans, usual, state.model)})
    left = explain(state, replace(usual, priors=priors), loose_fit)[1]
    moved = Findings()
    if loose_fit.bead_prior_mm:
        moved = Findings(explained).of(CalibrationCode.BEAD_TOLERANCE)
    others = Findings(left).without(CalibrationCode.MISFIT, CalibrationCode.PIXEL_PITCH)
    return [*others, *moved]


def _doubted(
    fit: FitResult, free_fit: FitResult, fixed: Mapping[str, float]
) -> FitResult:
    """Widen the intervals by the change between both fits, if `fixed` is doubted.

    That is by more than `DOUBT_SIGMAS` of fixed values (edge units) in the free fit.
    """
    if max(held_distance(free_fit, fixed).values(), default=0.0) <= DOUBT_SIGMAS:
        return fit
    doubt = {n: free_fit.values.get(n, v) - v for n, v in fit.values.items()}
    return replace(fit, certificate=widened(fit.certificate, doubt))


def _with_stated_priors(fit: FitResult, stated: FitResult) -> FitResult:
    """Widen the intervals of a fit to widened priors so that they hold where the stated ones are
    right, too: another cause may move the images as a scanner elsewhere does.

    `fit`: with the widened priors. `stated`: with the stated ones, of the same parameters; else
    nothing changes.
    """
    if list(fit.values) != list(stated.values):
        return fit
    own = fit.certificate.covariance
    off = np.array([stated.values[n] - v for n, v in fit.values.items()])
    both = larger(own, stated.certificate.covariance + np.outer(off, off))
    return replace(fit, certificate=widened(fit.certificate, both - own))


def _fit_with_fixed(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> FitResult:
    """Fit from the geometry of another fit, with the parameters that are neither free nor
    have a prior in `request` at its start's values.

    Args:
        state: the scans and their measurements.
        request: free and fixed parameters.
        fit: gives the start of the others, and distortion, strain and arc.
    """
    fixed = from_printed_reading(request.start, request.reading)
    known = {*request.free, *priors_of(state.scans, request, state.model)}
    values = {n: getattr(fixed, n) for n in NAMES if n not in known}
    start = []
    for offsets in fit.group_parameters:
        put_back = replace(from_printed_reading(offsets, request.reading), **values)
        start.append(to_printed_reading(put_back, request.reading))
    return refit_scans(state, request, fit, start=start)
