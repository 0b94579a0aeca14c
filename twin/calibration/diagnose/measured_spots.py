"""Checks of the second measurement: sizes of spots, the body, and what the camera keeps of
earlier frames."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexdt.twin.calibration.bead_model import spot_radii
from flexdt.twin.calibration.camera_lag import Lag
from flexdt.twin.calibration.detect.missing_light import MissingLight
from flexdt.twin.calibration.detect.refine import Refined
from flexdt.twin.calibration.detect.smear import Smear
from flexdt.twin.calibration.diagnose import CalibrationCode, listed
from flexdt.twin.calibration.diagnose.fixed_parameters import HELD_SIGMAS
from flexdt.twin.calibration.diagnose.usual_factors import OF_RADII, usual_reason
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.frame_source import FrameSpots
from flexdt.twin.calibration.identify import Identification
from flexdt.twin.calibration.outcome import Calibration
from flexdt.twin.calibration.request import CalibrationRequest
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray

OTHER_BEADS = 1.0 / 6.0
"""Deviation of the first radii from which beads are others."""
BLURRED_FIRST = 0.4
"""The same before blur is measured: blurred spots are wider."""
SIZE_TOLERANCE = 0.008
"""Standard deviation of the beads' radii from the stated ones, as a share (assumed: that of
molded balls; balls of bearings have a tenth of it)."""
MAX_BODY_LOG = 0.5
"""Logarithm of the body's seen over its described attenuation from which it is reported:
beam hardening alone stays below."""
MAX_BODY_MM = 0.3
"""Shift of the body from its description from which it is reported [mm]."""


def judge_first_sizes(
    state: Calibration, request: CalibrationRequest, fit: FitResult
) -> list[Finding]:
    """Judge the sizes of spots in the first measurement against those the fit predicts.

    `BLURRED_FIRST` is allowed where a second measurement follows, as blur makes spots
    wider, else `OTHER_BEADS`. Returns a finding a scan at most.
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
    """Judge the bead sizes of each scan by its second measurement.

    Without one, and spots not smeared, the first counts (`OTHER_BEADS`). Returns a
    finding a scan at most.
    """
    out = []
    for g, scan in enumerate(state.scans):
        if np.isfinite(state.measured[g].size):
            out += listed(judge_size(state.measured[g]))
        elif not state.measured[g].smear.told:
            radii = spot_radii(state.model, scan.poses.cone_vec(fit.group_parameters[g]))
            first = state.identifications[g], state.looks[g], radii
            out += listed(judge_first_size(*first, OTHER_BEADS))
    return out


def judge_first_size(
    found: Identification, looks: Sequence[FrameSpots], radii: FloatArray, allowed: float
) -> Finding | None:
    """Judge sizes by the median ratio of measured to expected radii (n, k) [px].

    Complete, identified spots count. Returns an error; None within `allowed` (a share,
    for blur), or without a spot.
    """
    ratios = [
        look.detections.radii_px[j] / radii[f, b]
        for f, look in enumerate(looks)
        for b, j in enumerate(found.index[f].tolist())
        if j >= 0 and look.detections.whole[j]
    ]
    if ratios:
        ratio = float(np.median(ratios))
    else:
        ratio = 1.0
    if abs(ratio - 1.0) < allowed:
        return None
    return _other_size(ratio)


def judge_size(measured: Refined) -> Finding | None:
    """Judge the beads' size in the images (nan: unknown) against the stated one.

    Only it tells a phantom of another scale at another distance. Returns an error beyond
    `HELD_SIGMAS` of size and tolerance; a warning where only the size's sigma allows it.
    """
    off = abs(math.log(measured.size))
    known = HELD_SIGMAS * math.hypot(measured.size_sigma, SIZE_TOLERANCE)
    if not off > HELD_SIGMAS * SIZE_TOLERANCE:
        return None
    if off > known:
        return _other_size(measured.size)
    return warning(
        CalibrationCode.BLURRED,
        f"the images are blurred by {measured.blur_px:.1f} px: the beads' size is known to "
        f"{100 * known:.0f} % only, and with it the phantom's scale",
    )


def _other_size(ratio: float) -> Finding:
    """Make the error that the shadows have another size than predicted, in per cent.

    Args:
        ratio: measured over predicted size.
    """
    reason = usual_reason(ratio, OF_RADII)
    if reason:
        why = f"{reason}, or they are other beads"
    else:
        why = "beads of another size, or a phantom of another scale"
    return error(
        CalibrationCode.BEAD_SIZE,
        f"the shadows are {100 * abs(ratio - 1):.0f} % "
        f"{'larger' if ratio > 1 else 'smaller'} than those that the phantom's "
        f"beads cast at the fitted geometry: {why}",
    )


def judge_body(measured: Sequence[Refined]) -> Finding | None:
    """Judge whether the phantom's body has its described place and attenuation.

    Args:
        measured: second measurements; those without an estimate of the body are left out.

    Returns:
        None if so; else one warning: some scan does not show the body at all, or the
        first scan that differs (beyond `MAX_BODY_LOG` or `MAX_BODY_MM`) and how.
    """
    bodies = [m.body for m in measured if np.isfinite(m.body.factor)]
    if any(body.factor == 0.0 for body in bodies):
        return warning(
            CalibrationCode.BODY_ELSEWHERE,
            "the images do not show the phantom's body where it is described, so it was not "
            "subtracted: another body, or one that is turned or shifted against the beads; "
            "edges of the real one may pull shadows, which the intervals contain as far as "
            "the residuals show it",
        )
    for body in bodies:
        x, y, z = body.shift_mm
        if abs(math.log(body.factor)) > MAX_BODY_LOG or math.hypot(x, y, z) > MAX_BODY_MM:
            return warning(
                CalibrationCode.BODY_DIFFERS,
                f"the phantom's body attenuates {body.factor:.2f} times what is described and "
                f"stands {x:+.2f}, {y:+.2f}, {z:+.2f} mm from there; it was subtracted so",
            )
    return None


def judge_lag(lag: Lag) -> Finding:
    """Make the warning that the camera shows part of the frame before (detector lag),
    with the part [%], whatever its size.
    """
    return warning(
        CalibrationCode.LAG,
        f"the camera still shows {100 * lag.part:.2g} % of the frame before: "
        "it was taken out of what was measured here; a volume is blurred by it along "
        "the turn, but with the correction reconstruct takes it out, of scans with as "
        "long exposures and pauses",
    )


def judge_missing_light(light: MissingLight) -> Finding:
    """Make the finding that light is missing in all images, with the part [%], whatever its
    size: an error where some spots have no light left, since how much is missing there, and
    with it their places, are not known.
    """
    said = (
        f"light is missing in all images, {100 * light.part:.2g} % of the open beam at least, "
        "as the light behind the beads shows: the dark image is too bright, or the detector "
        "is not linear; "
    )
    code = CalibrationCode.DARK_TOO_BRIGHT
    if light.dark > 0.0:
        lost = f"{100 * light.dark:.0f} % of the spots have no light left"
        return error(code, f"{said}{lost}: take new dark images")
    done = (
        "it was given back in what was measured here, but in a volume thick parts are too"
    )
    return warning(code, f"{said}{done} dense: take new dark images")


def beside_missing_light(finding: Finding) -> Finding:
    """Return a finding beside light that is missing: what remains of it shifts spots towards
    where the body is thinner, which looks like a phantom of another shape.

    Args:
        finding: of any code; others than `phantom_strained` are returned as they are.
    """
    if finding.code is not CalibrationCode.PHANTOM_STRAINED:
        return finding
    return warning(
        CalibrationCode.CAUSES_OPEN,
        "the residuals have a cause that the images do not tell for certain: what remains of "
        f"the light that is missing, or else {finding.text}",
    )


def judge_smear(smear: Smear, step_rad: float) -> Finding | None:
    """Warn that the object turns in an exposure, if that is beyond doubt.

    `step_rad`: of the stage, from frame to frame.
    """
    if not smear.named:
        return None
    share = smear.share
    return exposure_arc(
        share * math.degrees(step_rad), share, "shadows were measured as smeared by it"
    )


def exposure_arc(arc_deg: float, share: float, done: str) -> Finding:
    """Make the warning that the object turns during an exposure.

    `arc_deg`: that it turns [deg]; `share`: of a step; `done`: how the calibration took it into
    account.
    """
    return warning(
        CalibrationCode.EXPOSURE_ARC,
        f"the object turns while a frame is exposed, by {arc_deg:.2g} deg, {share:.2f} of a "
        f"step: {done}; volumes are blurred along the turn, and angles are those of the "
        "middle of each exposure",
    )


def shadows_drawn_out(name: str, share: float, step_rad: float, found: float) -> Finding:
    """Make the error that exposures draw shadows out so much that beads are not recognized.

    `name`: of the scan; `share`: of a step that an exposure lasts; `step_rad`: of the stage,
    from frame to frame; `found`: share of the beads in view with a round shadow.
    """
    return error(
        CalibrationCode.EXPOSURE_ARC,
        f"{name}: the object turns while a frame is exposed, by about "
        f"{share * math.degrees(step_rad):.2g} deg, {share:.1f} of a step: shadows are drawn "
        f"out along the turn, and {100 * found:.0f} % of the beads in view have a round one; "
        "stop the stage for each frame, or turn more slowly, with more frames",
    )
