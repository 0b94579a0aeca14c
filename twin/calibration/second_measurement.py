"""The second measurement: in windows where the fit expects the beads, then fitted again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.camera_lag import lag_of, without_lag
from flexdt.twin.calibration.detect.bead_contrast import seen_contrasts
from flexdt.twin.calibration.detect.drawn_out import DrawnOut, drawn_out
from flexdt.twin.calibration.detect.missing_light import missing_light, with_light
from flexdt.twin.calibration.detect.refine import FEW_WINDOWS, measure_beads
from flexdt.twin.calibration.detect.smear import UNMEASURED
from flexdt.twin.calibration.detect.windows import (
    Turning,
    Windows,
    mended,
    plan_windows,
    ways,
)
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.data import GOOD_SHARE
from flexdt.twin.calibration.diagnose.measured_spots import shadows_drawn_out
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import usual_step
from flexdt.twin.calibration.fits_of_scans import fit_scans
from flexdt.twin.calibration.frame_source import FrameState, Scan
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.findings import Finding, error
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.projection.analytic_solids import Scene

CLOSE_PX = 0.02
"""A measurement is repeated if the fit moved a prediction by more."""
FAR_PX = 0.5
"""The same for a draft."""
MOST_ROUNDS = 4
MOST_STEPS_EXPOSED = 2.0
"""Longest exposure that is looked for where few beads look round, in steps of the stage."""
LEAST_CONFIRMED = 0.25
"""Least share of the first measurement's spots that the second must find."""


def measure_again(
    state: Calibration, request: CalibrationRequest, fit: FitResult, solids: Scene | None
) -> tuple[Calibration, FitResult, int]:
    """Measure in windows and fit again until predictions move by less than `CLOSE_PX`.

    There are `MOST_ROUNDS` at most. With few frames (`FEW_WINDOWS`) the first fit is
    rough: a draft comes first, repeated while predictions move by more than `FAR_PX`. If
    a measurement loses the spots of a scan, state and fit are those before the first
    round, with a finding.

    Args:
        state: the scans, identified.
        solids: the phantom's, to subtract its body; None without.

    Returns:
        The state, the fit, and the iterations of all fits.
    """
    first = (state, fit)
    iterations = 0
    windows = sum(len(s.frames) for s in state.scans) * len(state.model)
    draft = windows <= FEW_WINDOWS
    for _ in range(MOST_ROUNDS):
        measured, plans = _measured(state, fit, solids, draft)
        if lost := _judge_confirmation(measured):
            return first[0].with_findings(*lost), first[1], iterations
        settled = not draft and _arcs_told(state) == _arcs_told(measured)
        state = measured
        fit = fit_scans(state, request, fit.group_parameters)
        iterations += fit.iterations
        moved = _moved_px(state, fit, plans)
        if moved < CLOSE_PX and settled:
            break
        draft = draft and moved > FAR_PX
    return state, fit, iterations


def _measured(
    state: Calibration, fit: FitResult, solids: Scene | None, draft: bool
) -> tuple[Calibration, list[Windows]]:
    """Measure the beads of every scan at their fitted places; lag and missing light are
    estimated in the first round only and undone in each, if seen, and blur and size only in
    drafts and in a first round.

    Where few beads have a round shadow, the arc that draws them out is taken from `seen_arc`
    to begin with; an error says so if the spots do not tell it.

    Windows of frames that are not usable become NaN. Dead pixels are filled, see `mended`.

    Args:
        state: the scans, identified.
        fit: gives the geometry of each scan.
        solids: the phantom's, or None.
        draft: see `measure_beads`.

    Returns:
        The state with measurements, lags and missing light, and the windows of each scan.
    """
    measured = []
    lags = []
    missing = []
    plans = []
    failed = []
    model = replace(state.model, beads=fit.beads)
    for g, scan in enumerate(state.scans):
        cone = scan.poses.cone_vec(fit.group_parameters[g])
        turning = turning_of(scan, fit.group_parameters[g])
        smear = state.measured[g].smear if state.measured else UNMEASURED
        round_share = state.identifications[g].found
        few = round_share < GOOD_SHARE
        if few and not state.measured:
            arc = seen_arc(scan, model, fit.group_parameters[g])
            smear = UNMEASURED if arc is None else arc.smear
        plan = plan_windows(model, cone, scan.frames.shape)
        if smear.told and turning is not None:
            way = np.linalg.norm(ways(plan, model, turning), axis=2)
            plan = plan_windows(model, cone, scan.frames.shape, smear.share * way)
        spots = [look.detections for look in state.looks[g]]
        contrast = seen_contrasts(model, spots, state.identifications[g].index)
        images = scan.frames.windows(plan)
        usable = np.array([look.state is FrameState.USABLE for look in state.looks[g]])
        known = None
        if state.measured:
            lag = state.lags[g]
            if not draft:
                known = state.measured[g].as_fitted
        else:
            lag = lag_of(images, scan.frames, plan, usable)
        if lag.seen:
            images = without_lag(scan.frames, plan, lag)
        images[~usable] = np.nan
        images = mended(images, plan)
        if state.missing_light:
            light = state.missing_light[g]
        else:
            light = missing_light(images, plan, usable)
        if light.seen:
            images = with_light(images, light.part)
        measured.append(
            measure_beads(
                images,
                plan,
                cone,
                model,
                contrast,
                solids,
                draft=draft,
                known=known,
                turning=turning,
                smear=smear,
            )
        )
        if few and smear.told and not measured[-1].smear.told:
            step = usual_step(scan.poses.angle)
            failed.append(shadows_drawn_out(scan.name, smear.share, step, round_share))
        lags.append(lag)
        missing.append(light)
        plans.append(plan)
    found = replace(
        state,
        measured=tuple(measured),
        lags=tuple(lags),
        missing_light=tuple(missing),
    )
    return found.with_findings(*failed), plans


def seen_arc(scan: Scan, model: BeadModel, parameters: Offsets) -> DrawnOut | None:
    """Estimate the arc of an exposure that draws shadows out; None if none is certain.

    Args:
        scan: gives the poses and images.
        model: the beads.
        parameters: offsets that say where they are.
    """
    turning = turning_of(scan, parameters)
    if turning is None:
        return None
    cone = turning(0.0)
    plan = plan_windows(model, cone, scan.frames.shape)
    way = np.linalg.norm(ways(plan, model, turning), axis=2)
    plan = plan_windows(model, cone, scan.frames.shape, MOST_STEPS_EXPOSED * way)
    arc = drawn_out(scan.frames.windows(plan), plan, model, turning)
    return arc if arc.certain else None


def turning_of(scan: Scan, parameters: Offsets) -> Turning | None:
    """Make the function from a part of a step to the geometry of all frames so much
    later.

    None if the stage rests in exposures, as stated, or never turns.
    """
    angles = scan.poses.angle
    step = usual_step(angles)
    if scan.arc == 0.0 or not step > 0.0:
        return None
    return lambda part: replace(scan.poses, angle=angles + part * step).cone_vec(
        parameters
    )


def _arcs_told(state: Calibration) -> list[bool]:
    """Tell of each scan whether its spots were measured as smeared by an exposure's arc."""
    return [m.smear.told for m in state.measured] or [False] * len(state.scans)


def _judge_confirmation(state: Calibration) -> list[Finding]:
    """Judge whether the second measurement of every scan finds the spots of the first.

    Returns:
        An error for each scan where less than `LEAST_CONFIRMED` of them, or none, are
        confirmed; empty if all are well.
    """
    out = []
    scans = zip(state.scans, state.identifications, state.measured, strict=True)
    for scan, first, second in scans:
        before = first.index >= 0
        confirmed = int((before & np.isfinite(second.tracks[..., 0])).sum())
        if confirmed >= LEAST_CONFIRMED * before.sum() and confirmed:
            continue
        out.append(
            error(
                CalibrationCode.SPOTS_UNCONFIRMED,
                f"{scan.name}: {confirmed} of {int(before.sum())} spots are, "
                "where the first fit expects them, shadows of balls of the phantom's "
                "size; are the images saturated or clipped, and are phantom, geometry "
                "and pixel size right?",
            )
        )
    return out


def _moved_px(state: Calibration, fit: FitResult, plans: Sequence[Windows]) -> float:
    """Compute the largest distance that a fit moved a bead from where its window was planned,
    over beads with more than half of their spot in view.

    `state`: the scans; `fit`: the new geometry; `plans`: windows of each scan.
    Returns [px]; 0 without such beads.
    """
    worst = 0.0
    for g, (scan, plan) in enumerate(zip(state.scans, plans, strict=True)):
        cone = scan.poses.cone_vec(fit.group_parameters[g])
        now = cone.project_points(fit.beads, scan.frames.shape)
        shift = np.linalg.norm(now - plan.predicted, axis=2)[plan.share > 0.5]
        worst = max(worst, float(shift.max()) if shift.size else 0.0)
    return worst
