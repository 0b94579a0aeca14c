"""What rival identifications leave open: the angle of a symmetric phantom, and its place.

The beads of a symmetric phantom can be told apart in several ways. All of them have the same
axis and the same magnification; they differ in how the phantom stands on the stage. A
parameter in which they differ has the mean square of that difference in its variance, and has no
value where that is beyond what the request allows.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.certificate import Estimate
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import from_printed_reading
from flexdt.twin.calibration.identify import Identification
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.findings import Finding, warning
from flexdt.twin.geometry.offsets import UNITS, Offsets

MOST_LISTED: Final = 36
"""Start angles that a sentence lists."""
LEAST_SIGMAS: Final = 0.1
"""Difference of rivals, in standard deviations, from which it counts."""


def judge_rivals(found: Identification, name: str, model_name: str) -> Finding | None:
    """Warn that a phantom looks alike in several ways on the stage; None if it does not, or
    if its rivals do not share the axis.

    Args:
        found: of a scan.
        name: of the scan.
        model_name: of the phantom.
    """
    if not found.one_axis or not found.rivals:
        return None
    if found.free_turn:
        how = "at any start angle: its beads are on a line parallel to the axis"
        angle = 0.0
    else:
        angles = found.start_angles
        listed = ", ".join(f"{a:.1f}" for a in angles[:MOST_LISTED])
        how = f"at {len(angles)} start angles, {listed} deg"
        angle = found.parameters.to_edge()["alpha"]
    return warning(
        CalibrationCode.AMBIGUOUS,
        f"{name}: {model_name!r} looks the same {how}: axis, tilts and magnification are the "
        "same for all of them; how the phantom stands is not told, and a volume may be turned so "
        "about its axis",
        ""
        if found.free_turn
        else "to tell it, state one of the angles, for example "
        f"--start alpha={angle:.1f} --prior alpha=5",
        figure=angle,
    )


def asked_of(state: Calibration, request: CalibrationRequest) -> CalibrationRequest:
    """Return the request without the start angle where the phantom looks alike at all of them:
    any value of it does.

    `state`: with the identifications; `request`: of the calibration.
    """
    if not any(found.free_turn for found in state.identifications):
        return request
    free = tuple(name for name in request.free if name != "alpha")
    scans = tuple(name for name in request.per_scan if name != "alpha")
    return replace(request, free=free or request.free, per_scan=scans)


def with_rivals(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> FitResult:
    """Return a fit whose estimates allow for the rivals of the identifications.

    Args:
        state: with the identifications.
        request: gives the bound beyond which a parameter has no value.
        fit: the last one, of the identified beads.
    """
    estimates = dict(fit.certificate.estimates)
    for name, estimate in estimates.items():
        base, _, scan = name.partition("@")
        if base not in UNITS:
            continue
        groups = [int(scan)] if scan.isdigit() else range(len(state.identifications))
        spread = max(
            (_spread(state.identifications[g], base, fit) for g in groups), default=0.0
        )
        if spread > LEAST_SIGMAS * estimate.sigma:
            estimates[name] = _widened(estimate, spread, request.bound)
    if not any(found.rivals for found in state.identifications):
        return fit
    return replace(fit, certificate=replace(fit.certificate, estimates=estimates))


def _spread(found: Identification, name: str, fit: FitResult) -> float:
    """Compute the root mean square difference of a parameter between rivals and the
    identification [mm, deg, 1].
    """
    if not found.rivals:
        return 0.0
    here = _printed(found.parameters, fit)[name]
    off = np.array([_printed(r, fit)[name] - here for r in found.rivals])
    if name == "alpha":
        off = (off + 180.0) % 360.0 - 180.0
    odds = np.array(found.odds)
    return math.sqrt(float(odds @ off**2) / (1.0 + float(odds.sum())))


def _printed(offsets: Offsets, fit: FitResult) -> dict[str, float]:
    """Return offsets as the fit states them [mm, deg, 1]."""
    return from_printed_reading(offsets, fit.reading).to_edge()


def _widened(estimate: Estimate, spread: float, bound: float) -> Estimate:
    """Return an estimate with a spread in its variance; without a sigma beyond a bound."""
    sigma = math.hypot(estimate.sigma, spread)
    if sigma > bound:
        return replace(estimate, sigma=math.inf, low=-math.inf, high=math.inf)
    factor = sigma / estimate.sigma if estimate.sigma > 0 else 1.0
    half = factor * (estimate.high - estimate.value)
    return replace(
        estimate, sigma=sigma, low=estimate.value - half, high=estimate.value + half
    )
