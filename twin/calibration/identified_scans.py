"""Identification of the beads' spots in every scan, and findings where it fails."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import Final

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose import OF_MOTION, CalibrationCode, listed
from flexdt.twin.calibration.diagnose.data import (
    GOOD_RMS_PX,
    GOOD_SHARE,
    WIDE_GATE_PX,
    convincing,
    explain_identification,
)
from flexdt.twin.calibration.diagnose.frame_numbers import FrameNumbers, frame_numbers
from flexdt.twin.calibration.diagnose.measured_spots import shadows_drawn_out
from flexdt.twin.calibration.fit.priors import known
from flexdt.twin.calibration.fit.problem import usual_step
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, Scan, nothing
from flexdt.twin.calibration.identify import Identification, Search, attempt, identified
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.recognise.recognised import Recognised, doubtful, recognise
from flexdt.twin.calibration.recognise.rivals import judge_rivals
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.calibration.second_measurement import seen_arc
from flexdt.twin.findings import Finding, Findings, error
from flexdt.twin.geometry.offsets import Offsets

MAX_BEAD_SHARE: Final = 0.6
"""Largest part of a frame's spots that are beads for it to be tried at another frame's
angle."""
NEAR_PX: Final = 3.0
"""Typical distance of spots from beads above which an assignment says nothing about
frames [px]."""
CLEAR_PX: Final = 0.6
"""The same up to which an entire scan determines the geometry better than its parts [px]."""
LEAST_TYPICAL_PX: Final = 0.3
"""Least value of that distance: a part of a scan determines the geometry less well [px]."""
TURN_SIGMAS: Final = 5.0
"""Standard deviations of its prior by which alpha may be from its start in the search."""
LEAST_TURN_DEG: Final = 3.0
"""Least of that; start angles so near each other are one to the search."""


def identify_scans(state: Calibration, request: CalibrationRequest) -> Calibration:
    """Identify the bead of each spot, scan by scan until one fails.

    A scan whose spots are identified already is taken as it is. Frames with wrong numbers
    are marked as repeated, so that they are left out, and the scan identified again; if
    their number forbids using the scan, the search ends. Where frames may move, a failed
    one is tried with a wide gate.

    Args:
        state: scans with their spots.
        request: gives the start, and whether frames may move.

    Returns:
        The state with findings and the identifications up to the first scan that failed.
    """
    out: list[Identification] = []
    findings: list[Finding] = []
    looks = list(state.looks)
    for i, scan in enumerate(state.scans):
        detections = _spots(scan, looks[i])
        if scan.index is not None:
            out.append(identified(scan.index, detections, request.start))
            continue
        first = out[0].parameters.alpha if out else None
        search = Search(turn=_stated_turn(scan, request), near=first)
        seek = partial(attempt, model=state.model, poses=scan.poses, start=request.start)
        found = seek(detections, search=search)
        told = Recognised(state.model)
        if doubtful(found, scan.poses):
            told = recognise(
                found, detections, state.model, scan.poses, scan.name, request.start
            )
        if told.decided:
            leans = told.model is not state.model
            findings += listed(told.finding)
            if told.found is None:
                break
            if leans and out:
                findings.append(_stands_otherwise(scan.name))
                break
            state = replace(state, model=told.model)
            out.append(told.found)
            continue
        numbers = None
        if not told.right_angles or (found is not None and _agreeing(found)):
            numbers = _numbers(found, detections, state.model, scan, request.start)
        if numbers is not None and (odd := numbers.judged(scan.name)) is not None:
            findings.append(odd)
            if odd.forbids:
                break
            looks[i] = _without(looks[i], numbers.again.tolist())
            detections = _spots(scan, looks[i])
            found = seek(detections, search=search)
        finding = explain_identification(
            found, detections, state.model, scan.poses, scan.name, request.start,
            right_angles=told.right_angles, mistakes=told.mistakes,
        )  # fmt: skip
        if (
            found is not None
            and finding is not None
            and finding.code is CalibrationCode.WRONG_PHANTOM
        ):
            finding = _by_exposure(finding, found, state.model, scan, request)
        if finding is not None and finding.code in OF_MOTION:
            # It moves, so its spots may be far from where one geometry has them.
            wide = replace(search, gate_px=WIDE_GATE_PX)
            found = seek(detections, search=wide) or found
            finding = None
        findings += listed(finding)
        if found is None:
            break
        if finding is None or not finding.forbids:
            findings += listed(judge_rivals(found, scan.name, state.model.name))
        out.append(found)
    found_so_far = replace(state, identifications=tuple(out), looks=tuple(looks))
    # In other scans of the same phantom the spots of a displaced bead are no others.
    return found_so_far.with_findings(*Findings(findings).reduced())


def _stands_otherwise(name: str) -> Finding:
    """Make the error that the phantom leans in one scan and not in those before."""
    return error(
        CalibrationCode.WRONG_PHANTOM,
        f"{name}: the phantom leans otherwise than in the scans before; calibrate this one alone",
    )


def _by_exposure(
    finding: Finding,
    found: Identification,
    model: BeadModel,
    scan: Scan,
    request: CalibrationRequest,
) -> Finding | None:
    """Return the finding, or that shadows are drawn out by an exposure's arc if they are.

    None if a second measurement will follow the arc.
    """
    drawn_out = _of_exposure(found, model, scan)
    if drawn_out is None:
        return finding
    return None if request.second_look and _agreeing(found) else drawn_out


def _of_exposure(found: Identification, model: BeadModel, scan: Scan) -> Finding | None:
    """Make the error that an exposure's arc draws shadows out; None if it does not."""
    arc = seen_arc(scan, model, found.parameters)
    if arc is None:
        return None
    return shadows_drawn_out(
        scan.name, arc.share, usual_step(scan.poses.angle), found.found
    )


def _agreeing(found: Identification) -> bool:
    """Check whether the spots that there are fit the phantom in one way, however few beads
    have one.
    """
    if not found.one_axis:
        return False
    return found.explained >= GOOD_SHARE and found.rms_px < GOOD_RMS_PX


def _stated_turn(scan: Scan, request: CalibrationRequest) -> float:
    """Return how far alpha may be from the request's start [rad], `TURN_SIGMAS` of its
    prior but no less than `LEAST_TURN_DEG`; inf: it has no prior.
    """
    priors = known(request.free, request.priors, [scan.priors])
    if "alpha" not in priors:
        return math.inf
    return math.radians(max(TURN_SIGMAS * priors["alpha"], LEAST_TURN_DEG))


def _spots(scan: Scan, looks: Sequence[FrameSpots]) -> list[Detections]:
    """Return the spots of each frame; empty for frames that repeat another."""
    unseen = nothing(scan.frames.shape)
    return [
        unseen if look.state is FrameState.REPEATED else look.detections for look in looks
    ]


def _without(
    looks: Sequence[FrameSpots], frames: Sequence[int]
) -> tuple[FrameSpots, ...]:
    """Mark some frames (by number, from 0) as REPEATED, so that their spots are not used;
    other numbers are ignored.
    """
    again = frozenset(frames)
    return tuple(
        replace(look, state=FrameState.REPEATED) if i in again else look
        for i, look in enumerate(looks)
    )


def _numbers(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    scan: Scan,
    start: Offsets,
) -> FrameNumbers | None:
    """Find the angle that each frame shows, if some frames do not agree with the others.

    Nothing is searched where the identification explains more than `MAX_BEAD_SHARE` of
    the spots of every frame of two or more. Tried are a clear identification
    (`CLEAR_PX`), both halves and the middle of the scan, then any identification, until
    one below `NEAR_PX` gives numbers. Lost and repeated frames are claimed only if the
    scan fits the phantom with its frames numbered anew: a stage that rests, or spots of
    another phantom, fit some angle in each frame by chance.

    Args:
        found: identification of the scan, or None.
        detections: spots of each frame.
        model: the beads.
        scan: its poses and name.
        start: offsets that are known before.

    Returns:
        None if all agree, or no angles fit.
    """
    counts = np.array([len(d) for d in detections])
    if found is not None:
        seen = (found.index >= 0).sum(axis=1)
        if not ((counts >= 2) & (seen <= MAX_BEAD_SHARE * counts)).any():
            return None
    n = len(counts)
    parts = [slice(0, n // 2), slice(n // 2, n), slice(n // 4, n - n // 4)]
    halves = (
        attempt(detections[part], model, scan.poses[part], start=start) for part in parts
    )
    if found is None or found.typical_px > CLEAR_PX:
        first = []
    else:
        first = [found]
    for base in chain(first, halves, [found]):
        if base is None or not base.typical_px < NEAR_PX:
            continue
        spread = max(base.typical_px, LEAST_TYPICAL_PX)
        numbers = frame_numbers(
            detections, model.beads, scan.poses, base.parameters, spread
        )
        if numbers is None:
            continue
        if not numbers.renumbered or _fits_anew(numbers, detections, model, scan, start):
            return numbers
    return None


def _fits_anew(
    numbers: FrameNumbers,
    detections: Sequence[Detections],
    model: BeadModel,
    scan: Scan,
    start: Offsets,
) -> bool:
    """Check whether the spots of a scan fit the phantom at the poses that its frames show."""
    found = attempt(detections, model, numbers.shown(scan.poses), start=start)
    return found is not None and convincing(found)
