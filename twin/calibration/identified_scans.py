"""Which spot is which bead in every scan, and what is wrong where that cannot be told."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from flexdt.twin.calibration.diagnose import Finding, listed
from flexdt.twin.calibration.diagnose.data import WIDE_GATE_PX, explain_identification
from flexdt.twin.calibration.diagnose.fitted import OF_MOTION
from flexdt.twin.calibration.frame_source import FrameState, nothing
from flexdt.twin.calibration.identify import Identification, Search, attempt, identified
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest


def identify_scans(state: Calibration, request: CalibrationRequest) -> Calibration:
    """Find which spot is which bead, scan by scan until one tells nothing."""
    out: list[Identification] = []
    findings: list[Finding] = []
    for scan, some in zip(state.scans, state.looks, strict=True):
        unseen = nothing(scan.frames.shape)
        detections = [
            unseen if look.state is FrameState.REPEATED else look.detections for look in some
        ]
        if scan.index is not None:
            out.append(identified(scan.index, detections, request.start))
            continue
        seek = partial(attempt, detections, state.model, scan.poses, start=request.start)
        found = seek()
        told = explain_identification(found, detections, state.model, scan.poses, scan.name)
        if request.per_frame and told is not None and told.code in OF_MOTION:
            # It may move, so its spots may be far from where one geometry has them.
            found = seek(search=Search(gate_px=WIDE_GATE_PX)) or found
            told = None
        findings += listed(told)
        if found is None:
            break
        out.append(found)
    return replace(state, identifications=tuple(out)).with_findings(*findings)
