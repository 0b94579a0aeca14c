"""Findings on a fit: codes that are about its residuals or a motion, and implausible offsets."""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.findings import Finding, error

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
PLAUSIBLE_SHARE = 0.12
"""Largest offset along the beam, as a share of SOD, that a mount may cause. A phantom that is
scaled together with its beads looks like the right one at another distance, so that this offset
is its only sign."""
OF_MOTION: Final = frozenset(
    (
        CalibrationCode.DRIFT,
        CalibrationCode.VIBRATION,
        CalibrationCode.ANGLES_WRONG,
        CalibrationCode.WOBBLE,
    )
)
"""Codes of findings on what is elsewhere from frame to frame."""


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
