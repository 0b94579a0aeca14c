"""Whether the sizes of the spots are those of the phantom's beads."""

from __future__ import annotations

import numpy as np

from flexdt.twin.calibration.bead_model import spot_radii
from flexdt.twin.calibration.diagnose import listed
from flexdt.twin.calibration.diagnose.measured_spots import judge_first_size, judge_size
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.findings import Finding

OTHER_BEADS = 1.0 / 6.0
"""Deviation of the first radii from which beads are others."""
BLURRED_FIRST = 0.4
"""The same before blur is measured: blurred spots are wider."""


def judge_first_sizes(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> list[Finding]:
    """Judge the sizes of spots in the first measurement against those predicted by the
    fit.

    Args:
        state: scans, identified, with their spots.
        request: whether a second measurement follows; then a deviation of `BLURRED_FIRST`
            is allowed now, as blur makes spots wider, else `OTHER_BEADS`.
        fit: gives the geometry of each scan.

    Returns:
        At most one finding for each scan; empty if all fit.
    """
    out = []
    if request.second_look:
        allowed = BLURRED_FIRST
    else:
        allowed = OTHER_BEADS
    sized = zip(state.scans, state.identifications, state.looks, strict=True)
    for g, (scan, found, looks) in enumerate(sized):
        radii = spot_radii(state.model, scan.poses.cone_vec(fit.group_parameters[g]))
        out += listed(judge_first_size(found, looks, radii, allowed))
    return out


def judge_sizes(state: Calibration, fit: FitResult) -> list[Finding]:
    """Judge in each scan the bead sizes of the second measurement, or of the first (with
    `OTHER_BEADS`) where the second measured no size and the spots are not smeared.

    Args:
        state: scans, spots, identifications and the second measurements.
        fit: of the geometry, which predicts the spots' radii.

    Returns:
        Findings on sizes that do not fit, at most one a scan; empty if all fit.
    """
    out = []
    for g, scan in enumerate(state.scans):
        radii = spot_radii(state.model, scan.poses.cone_vec(fit.group_parameters[g]))
        if np.isfinite(state.measured[g].size):
            out += listed(judge_size(state.measured[g], float(np.median(radii))))
        elif not state.measured[g].smear.told:
            first = state.identifications[g], state.looks[g], radii
            out += listed(judge_first_size(*first, OTHER_BEADS))
    return out
