"""Checks of the data after a fit: bead sizes, positions, frame angles, bead displacements,
drifts.

Possible explanations of the residuals are tried one by one and the one that fits is reported;
the data are not changed. Checks that need no fit are in `diagnose.data`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from flexdt.twin.calibration.camera_lag import Lag
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.detect.refine import Refined
from flexdt.twin.calibration.diagnose import Finding, error, listed, warning
from flexdt.twin.calibration.diagnose.causes import (
    LEAST_BEADS,
    NAMED_LOG_ODDS,
    Found,
    Known,
    Refit,
    explained_by_causes,
    lost_beads,
)
from flexdt.twin.calibration.diagnose.frame_numbers import frame_numbers
from flexdt.twin.calibration.diagnose.named_causes import named_causes
from flexdt.twin.calibration.diagnose.wobble import wobble
from flexdt.twin.calibration.fit.certificate import POSITION_SPREAD_PX, SPREAD_FREEDOM
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import (
    MotionFit,
    counted,
    derivative,
    follow_motion,
)
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, nothing
from flexdt.twin.calibration.identify import Identification
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

OF_RESIDUALS = frozenset(
    (
        "drift",
        "vibration",
        "bead_errors",
        "bead_displaced",
        "too_many_outliers",
        "bead_tolerance",
    )
)
"""Codes of findings about residuals: they hold for that fit alone."""
MISFIT_CHANCE: Final = 0.01
"""Probability of positions that scatter so much, below which a fit is not to be used unless
its residuals are explained."""
EXPLAINED_CHANCE: Final = 0.001
"""The same of what may remain of a motion that is named."""
BLOCK_SHARE = 0.7
"""Part of the frames of a block, from the first or to the last of a scan, that do not fit."""
MOST_USED = 0.9
"""Share of the positions below which a fit is good only because it left the others out."""
MOST_LEFT_OUT: Final = 0.3
"""Largest part of a scan, frames or positions, that may be left out: a fit to less is a fit to
another scan."""
BEAD_ERROR_SIGMAS = 1.0
"""Errors that repeat with the turn, in standard deviations of a position, up to which they
widen the intervals alone and are no finding."""
NOISE_SIGMAS = 1.5
"""Stated sigmas up to which residuals are noise, however large."""
MAX_SIZE_ERROR = 0.04
"""Deviation of the spots' radii from the expected ones that indicates a wrong scale."""
BLUR_TOLERANCE = 0.6
"""Further deviation allowed, in units of the squared blur over radius (measured)."""
MAX_BODY_LOG = 0.5
"""Logarithm of the body's seen over its described attenuation from which it is reported:
beam hardening alone stays below."""
MAX_BODY_MM = 0.3
"""Shift of the body from its description from which it is reported [mm]."""
PLAUSIBLE_SHARE = 0.12
"""Largest offset along the beam, as a share of SOD, that a mount may cause. A phantom that is
scaled together with its beads looks like the right one at another distance, so that this offset
is its only sign."""
MOTION_WORDS: Final = {
    "dO_x": "the object moves aside",
    "dO_y": "the object moves up or down",
    "dO_z": "the object moves along the beam",
    "alpha": "the object turns",
    "dS_x": "the source moves aside",
    "dS_y": "the source moves up or down",
    "dD_x": "the panel moves aside",
    "dD_y": "the panel moves up or down",
    "dD_z": "the panel moves along the beam",
}
"""Parameter -> words on its motion."""
ALIKE_MOTION: Final = {
    "dO_x": ("the source moves aside, the other way",),
    "dO_y": ("the source moves up or down, the other way",),
    "dO_z": ("the phantom grows or shrinks",),
}
"""Parameter -> other motions that look like this motion of the object."""
OF_MOTION: Final = frozenset(("drift", "vibration", "angles_wrong"))
"""Codes of findings on motion that may be followed from frame to frame."""
MAX_CURVED: Final = 0.2
"""Part of a turn that a factor on the angles may leave for it to be one."""
ASIDE: Final = ("dO_x", "dO_y", "dO_z", "alpha", "dD_x", "dD_y")
"""Parameters that are advised to differ between frames where all shadows stand aside."""
ASIDE_REST: Final = 0.2
"""Part of the shadows' distances from where they should be that stands for noise there."""
LEAST_ASIDE: Final = 4
"""Least number of shadows that are said to stand aside alike."""
UNEXPLAINED_MOTION: Final = ("dO_x", "dO_y", "alpha")
"""Parameters that are advised to differ between frames where no cause explains a misfit."""
MOST_FRAMES: Final = 720
"""Scans of more frames are not looked at: four motions at once take seconds there."""


def judge_places(fit: FitResult, looks: Sequence[Sequence[FrameSpots]]) -> list[Finding]:
    """Judge frames whose spots are not at the fitted places: wrong angles, a slip, a
    repeated image.

    A frame is bad if most of its complete spots are 5 px or more from every prediction, or
    most of its positions had to be left out of the fit; frames of fewer than two spots and
    repeated ones have no spots to judge. Every scan is judged by itself: wrong frame numbers
    come first. Otherwise a block of frames at an end, with no drift but the angle's, is an
    error ("angle_step"); else "frames_inconsistent": an error for more than 30 % of the
    frames, else a warning. At most 12 frames are listed, a block as first to last.

    Args:
        fit: to all frames.
        looks: spots and state of each frame of each scan.

    Returns:
        One finding a scan at most, that lists the frames, or names their numbers.
    """
    group = np.repeat(np.arange(len(looks)), [len(some) for some in looks])
    predicted = fit.problem.residuals(fit.solution.x)[0]
    out: list[Finding] = []
    for scan, some in enumerate(looks):
        detections = [
            nothing(look.detections.shape)
            if look.state is FrameState.REPEATED
            else look.detections
            for look in some
        ]
        out += listed(_judged_scan(fit, scan, group == scan, detections, predicted))
    return out


def _judged_scan(
    fit: FitResult,
    scan: int,
    own: npt.NDArray[np.bool_],
    detections: Sequence[Detections],
    predicted: FloatArray,
) -> Finding | None:
    """Judge the places of the spots of one scan, see `judge_places`.

    Args:
        fit: to the frames of all scans.
        scan: its number.
        own: which frames are its own.
        detections: spots of each of them.
        predicted: places of the beads in all frames.
    """
    of_scan = f" of scan {scan + 1}" if not own.all() else ""
    seen = fit.problem.seen[own].sum(axis=1)
    used = fit.certificate.used[own].sum(axis=1)
    bad = np.flatnonzero((seen >= 2) & (used < 0.5 * seen)).tolist()
    for i, (d, beads) in enumerate(zip(detections, predicted[own], strict=True)):
        places = d.centers[d.whole]
        if len(places) < 2:
            continue
        gap = np.linalg.norm(beads[:, None] - places[None], axis=2).min(axis=0)
        near = int((gap < 5.0).sum())
        if near < 0.5 * min(len(places), len(beads)):
            bad.append(i)
    bad = sorted(set(bad))
    if not bad:
        return None
    n = len(detections)
    whole = fit.certificate.used.sum(axis=1) > 0
    spread = float(np.nanmedian(fit.certificate.rms_per_frame[whole]))
    numbers = frame_numbers(
        detections,
        fit.beads,
        fit.problem.poses[np.flatnonzero(own)],
        fit.group_parameters[scan],
        2.0 * spread,
    )
    if numbers is not None:
        odd = numbers.judged(f"scan {scan + 1}" if of_scan else "the scan")
        if odd is not None:
            return odd
    # A frame of a block that happens to fit is of it all the same.
    at_end = bad[0] == 0 or bad[-1] == n - 1
    block = len(bad) >= BLOCK_SHARE * (bad[-1] - bad[0] + 1)
    block = block and at_end and 2 <= len(bad) < n
    if block:
        places_of = f"{bad[0]} to {bad[-1]}"
    else:
        places_of = ", ".join(str(i) for i in bad[:12])
    if block and (aside := _aside(fit, np.flatnonzero(own)[bad].tolist())) is not None:
        column, row = aside.tolist()
        return error(
            "frames_inconsistent",
            f"in frames {places_of} of {n}{of_scan} all shadows stand {column:+.1f} columns "
            f"and {row:+.1f} rows aside: the panel, the source or the object moved, or what "
            f"the camera reads of the panel: --per-frame {','.join(ASIDE)} follows it",
            per_frame=ASIDE,
        )
    # A drift of something else leaves its ends out, too.
    if block and all(d.column.split("@")[0] == "alpha" for d in fit.certificate.drifts):
        return error(
            "angle_step",
            f"in frames {places_of} of {n}{of_scan} the shadows are not where the others put "
            "them: frames are missing there, or the phantom slipped",
        )
    many = len(bad) > MOST_LEFT_OUT * n
    return (error if many else warning)(
        "frames_inconsistent",
        f"in {len(bad)} of {n} frames{of_scan} ({places_of}) the shadows are not where the "
        "others put them" + ("" if many else "; those frames are not used"),
    )


def _aside(fit: FitResult, frames: Sequence[int]) -> FloatArray | None:
    """Compute by how much all spots of some frames stand aside from where the fit has them.

    Args:
        fit: to all frames.
        frames: the frames.

    Returns:
        (2,) columns and rows [px]: the median; None if it leaves more than `ASIDE_REST` of
        the distances: what turns moves the shadows of near and far beads apart.
    """
    off = (fit.problem.pixels - fit.problem.residuals(fit.solution.x)[0])[list(frames)]
    off = off[np.isfinite(off).all(axis=-1)]
    if len(off) < LEAST_ASIDE:
        return None
    middle = np.asarray(np.median(off, axis=0))
    rest = float(np.median(np.linalg.norm(off - middle, axis=1)))
    return middle if rest < ASIDE_REST * float(np.linalg.norm(middle)) else None


def judge_offsets(fit: FitResult) -> Finding | None:
    """Judge whether the fitted place is within the possible errors of mount and motors.

    Returns:
        An error if dO_z of some scan exceeds `PLAUSIBLE_SHARE` of the SOD; else None.
    """
    sod = float(np.median(fit.problem.poses.sod))
    for parameters in fit.group_parameters:
        if abs(parameters.dO_z) > PLAUSIBLE_SHARE * sod:
            return error(
                "implausible_offset",
                f"dO_z comes out as {parameters.dO_z:.1f} mm at SOD {sod:.0f} mm: a phantom of "
                "another scale, or wrong nominal distances",
            )
    return None


def judge_first_size(
    found: Identification, looks: Sequence[FrameSpots], radii: FloatArray, allowed: float
) -> Finding | None:
    """Judge sizes coarsely from the first measurement: the median ratio of measured to
    expected radii of complete, identified spots.

    Args:
        found: the bead of each spot.
        looks: of every frame.
        radii: (n, k) expected radii [px].
        allowed: deviation that may be blur, as a share.

    Returns:
        An error on bead sizes; None if the ratio is within `allowed` of 1, or there is no
        such spot.
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


def judge_size(measured: Refined, radius_px: float) -> Finding | None:
    """Judge the spots' size against the one of the phantom's beads at the fitted
    geometry.

    A phantom of another scale at another distance gives the same bead positions; only the
    beads' own size reveals it.

    Args:
        measured: size (nan if unknown) and blur.
        radius_px: expected radius of the spots.

    Returns:
        Beyond `MAX_SIZE_ERROR` a warning if blur may explain it, else an error; None if
        the size fits or is unknown.
    """
    off = abs(measured.size - 1.0)
    blur = measured.blur_px / radius_px
    if not off >= MAX_SIZE_ERROR:
        return None
    if off < MAX_SIZE_ERROR + BLUR_TOLERANCE * blur**2:
        return warning(
            "blurred",
            f"the images are blurred by {measured.blur_px:.1f} px and the shadows are "
            f"{radius_px:.1f} px wide: the beads' size is known to "
            f"{100 * (MAX_SIZE_ERROR + BLUR_TOLERANCE * blur**2):.0f} % only, "
            "and with it the phantom's scale",
        )
    return _other_size(measured.size)


def _other_size(ratio: float) -> Finding:
    """Make the error that the shadows have another size than predicted, in per cent.

    Args:
        ratio: measured over predicted size.
    """
    return error(
        "bead_size",
        f"the shadows are {100 * abs(ratio - 1):.0f} % "
        f"{'larger' if ratio > 1 else 'smaller'} than "
        "those that the phantom's beads cast at the fitted geometry: beads of another "
        "size, or a "
        "phantom of another scale",
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
            "body_elsewhere",
            "the images do not show the phantom's body where it is described, so it was not "
            "subtracted: another body, or one that is turned or shifted against the beads; "
            "edges of the real one may pull shadows, which the intervals contain as far as "
            "the residuals show it",
        )
    for body in bodies:
        x, y, z = body.shift_mm
        if abs(math.log(body.factor)) > MAX_BODY_LOG or math.hypot(x, y, z) > MAX_BODY_MM:
            return warning(
                "body_differs",
                f"the phantom's body attenuates {body.factor:.2f} times what is described and "
                f"stands {x:+.2f}, {y:+.2f}, {z:+.2f} mm from there; it was subtracted so",
            )
    return None


def judge_lag(lag: Lag) -> Finding:
    """Make the warning that the camera shows part of the frame before (detector lag),
    with the part [%], whatever its size.
    """
    return warning(
        "lag",
        f"the camera still shows {100 * lag.part:.2g} % of the frame "
        "before: it was taken out of what was measured here; a volume is blurred by it "
        "along the "
        "turn, but with the correction reconstruct takes it out, of scans with as long "
        "exposures "
        "and pauses",
    )


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
    given. Beside these only lost beads are reported.

    Args:
        fit: to be judged; nothing is judged if it is not identifiable.
        known: statements on the phantom and the positions.
        refit: fits again with more parameters free.
        sigmas_known: the positions' sigmas were measured, and are no more than compared.
        misfit_px: residual up to which the fit is used, whatever its positions scatter.

    Returns:
        The fit to be reported (with the causes that explain the residuals) and the
        findings; only the factor's error, with the original fit, if that explains them.
    """
    if not fit.identifiable:
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
        return fit, out
    # What else the residuals show has no meaning where no cause explains them.
    explained = _moving_beside(plain, fit, named, causes, refit)
    if explained:
        # Most of a scan was left out because of it, and with that its beads.
        return fit, [*([] if crowd else _lost_beads(fit)), *explained]
    if not bad:
        return fit, out
    misfit = error(
        "misfit",
        f"the fit leaves residuals of {certificate.rms_px:.2f} px, and no cause that is "
        "looked for explains them: check that nothing is loose, or let frames differ, "
        f"--per-frame {','.join(UNEXPLAINED_MOTION)}",
        per_frame=UNEXPLAINED_MOTION,
    )
    return fit, [*_lost_beads(fit), misfit]


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
            return [found, *(f for f in others if f.code != "causes_open")]
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
                "drift",
                f"{drift.column} changes by {drift.size:+.3g} {unit} {how} ({drift.score:.0f} "
                f"sigma){_looks_alike(drift.column)}; its interval contains the change, and "
                f"--per-frame {','.join(MOVING)} would follow it",
                per_frame=MOVING,
            )
        )
    for there, code, what in (
        (
            certificate.shared,
            "vibration",
            "the beads of a frame err together (vibration or angle jitter)",
        ),
        (
            certificate.turning > BEAD_ERROR_SIGMAS,
            "bead_errors",
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
    return _alternatives(ALIKE_MOTION.get(column.split("@")[0], ()))


def _alternatives(words: Sequence[str]) -> str:
    """Return motions that look alike in brackets after a blank; "" without any."""
    if not words:
        return ""
    return f" (or {' or '.join(words)}, which look{'s' * (len(words) == 1)} alike)"


def open_motions(found: MotionFit, odds: float) -> list[str]:
    """List words on motions that may take the place of one that was found.

    Args:
        found: what moves.
        odds: of the found motion against another, up to which that is listed.
    """
    certain = set(found.moving)
    sets: list[tuple[str, ...]] = []
    for names in found.alike(1.0 / odds):
        part_of_it = any(set(less) <= set(names) for less in sets)
        if not certain <= set(names) and not part_of_it:
            sets.append(names)
    return [" and ".join(MOTION_WORDS[n] for n in names) for names in sets]


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
        return [judged("bead_displaced", f"{text} left out")]
    share = 1.0 - used.sum() / max(int(problem.seen.sum()), 1)
    text = f"{100 * share:.0f} % of the positions had to be left out"
    if share > 0.35:
        return [error("too_many_outliers", text)]
    return []


def largest_residual(fit: FitResult, chance: float, sigmas_known: bool = False) -> float:
    """Compute the root mean square residual that a right fit exceeds by chance.

    Positions scatter by their stated sigmas and, from image to image, by
    `certificate.POSITION_SPREAD_PX` with SPREAD_FREEDOM degrees of freedom.

    Args:
        fit: whose residuals are judged.
        chance: probability of more.
        sigmas_known: the positions' sigmas were measured, and are no more than compared;
            else the stated ones are ignored.

    Returns:
        [px].
    """
    usual = SPREAD_FREEDOM / float(chdtri(SPREAD_FREEDOM, 1.0 - chance))
    certificate = fit.certificate
    measured = sigmas_known and certificate.noise > 0.0
    if measured:
        stated = certificate.rms_px / certificate.noise
    else:
        stated = 0.0
    return math.hypot(POSITION_SPREAD_PX * math.sqrt(usual), NOISE_SIGMAS * stated)


def _explained(better: FitResult, fit: FitResult) -> bool:
    """Check whether `better` explains the residuals of `fit`: they are halved and may be
    chance, it is identifiable, and uses at least `MOST_USED` as many positions.
    """
    rms = better.certificate.rms_px
    return (
        better.identifiable
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
        "angle_endpoint" if known else "angle_scale",
        f"the frame angles are off by a factor {estimate.value:.5f}{known}; correct "
        "them, or free angle_scale",
        free=("angle_scale",),
    )


def moving(fit: FitResult, refit: Callable[[MotionFit], FitResult]) -> Finding | None:
    """Fit a motion of all parameters that may move, and name the moving one if that
    explains the residuals: halves them, to a chance of `EXPLAINED_CHANCE`.

    Args:
        fit: without motion.
        refit: the fit to poses with a motion.

    Returns:
        An error with the parameter that has most effect and how it moves: wrong angles or
        a named turn for alpha, else a vibration if it goes from frame to frame, or a
        drift. None if no motion explains them or it cannot be fitted, for scans of more
        than `MOST_FRAMES` frames, or if nothing may move.
    """
    problem = fit.problem
    sizes = np.bincount(problem.group)
    names = [n for n in MOVING if n in fit.values or n + "@0" in fit.values]
    if sizes.max() > MOST_FRAMES or not names or not fit.identifiable:
        return None
    try:
        better, found = follow_motion(fit, names, refit)
    except TwinError:
        return None
    # Frames that were left out are what is to be explained.
    off = problem.pixels - problem.residuals(fit.solution.x)[0]
    before = float(np.sqrt(np.mean(off[counted(problem, fit)] ** 2)))
    remaining = largest_residual(better, EXPLAINED_CHANCE)
    after = _after_motion(better, found)
    if not after < min(0.5 * before, remaining) or not found.moving:
        return None
    names = list(found.motions[0].names)
    use = problem.seen
    effects = []
    for i, name in enumerate(names):
        reach = float(
            np.sqrt(np.mean(derivative(problem, fit.solution.x, name, use) ** 2))
        )
        effects.append(reach * max(float(np.ptp(m.values[:, i])) for m in found.motions))
    first = int(np.argmax(effects))
    scan = max(
        range(len(sizes)), key=lambda g: float(np.ptp(found.motions[g].values[:, first]))
    )
    motion = found.motions[scan]
    of_scan = f" of scan {scan + 1}" if len(sizes) > 1 else ""
    in_scan = of_scan.replace("of", "in")
    name = names[first]
    curve = motion.values[:, first]
    motions = [
        f"{n} by {to_edge(n, float(np.ptp(motion.values[:, i]))):.3g} {UNITS[n]}"
        for i, n in sorted(enumerate(names), key=lambda pair: -effects[pair[0]])
        if effects[i] > 0.3 * effects[first]
    ]
    how, jump = _shape(curve)
    if name == "alpha":
        angles = problem.poses.angle[problem.group == scan]
        return _turned(curve, jump, angles, ", ".join(motions[1:]), of_scan)
    if how.startswith("from frame"):
        code = "vibration"
    else:
        code = "drift"
    alike = open_motions(found, math.exp(NAMED_LOG_ODDS))
    if name == "dO_z":
        alike += ALIKE_MOTION[name]
    return error(
        code,
        f"{', '.join(motions)} moves during the scan, {how}{in_scan}{_alternatives(alike)}: "
        f"--per-frame {','.join(names)} follows it",
        per_frame=names,
    )


def _after_motion(fit: FitResult, held: MotionFit) -> float:
    """Compute the residual of a fit as it would be with its motion's freedom counted: a
    value in each frame, less one, for each parameter that moves.

    Args:
        fit: to poses that hold the motion.
        held: the motion.

    Returns:
        [px]; inf if no freedom is left.
    """
    frames = len(fit.problem.seen)
    count = 2 * int(fit.certificate.used.sum()) - len(fit.problem.layout.names)
    left = count - len(held.moving) * (frames - 1)
    if left <= 0:
        return math.inf
    return fit.certificate.rms_px * math.sqrt(count / left)


def _turned(
    curve: FloatArray, jump: int | None, angle: FloatArray, others: str, of_scan: str
) -> Finding:
    """Name how an object turns otherwise than stated.

    Args:
        curve: (n,) turn of each frame beyond the stated one [rad].
        jump: number of the frame before a jump, None without one.
        angle: (n,) stated [rad].
        others: what else moves, and by how much; "" if nothing does.
        of_scan: which one of several; "" of a single one.
    """
    beside = f"; beside that, {others} moves during the scan" if others else ""
    if jump is not None:
        height = to_edge("alpha", float(curve[jump + 1] - curve[jump]))
        code, text = named_turn(height, angle)
        return error(
            code, f"between frames {jump} and {jump + 1}{of_scan} {text}{beside}"
        )
    turn = angle - angle.mean()
    share = float(turn @ curve) / max(float(turn @ turn), 1e-300)
    if float(np.std(curve - share * turn)) < MAX_CURVED * float(np.std(curve)):
        return error(
            "angle_scale",
            f"the frame angles{of_scan} are off by a factor {1.0 + share:.5f}; correct "
            f"them, or free angle_scale{beside}",
            free=("angle_scale",),
        )
    off = np.array([to_edge("alpha", v) for v in curve - np.median(curve)])
    return error(
        "angles_wrong",
        f"the frames' angles{of_scan} differ from the stated ones by {np.std(off):.3f} deg "
        f"rms (up to {np.abs(off).max():.3f}){beside}",
    )


def named_turn(turn_deg: float, angles: FloatArray) -> tuple[str, str]:
    """Name the likely cause where an object turns further or less far than stated: lost or
    doubled frames if by a whole number of steps (within 0.05 step), else a slip.

    Args:
        turn_deg: the turn beyond the stated one, in the sense of the angles.
        angles: stated angles of the frames [rad].

    Returns:
        Code of the finding, `frame_numbers` or `angle_step`, and its words.
    """
    step = math.degrees(float(np.median(np.diff(angles))))
    whole = round(turn_deg / step) if step else 0
    if whole and abs(turn_deg - whole * step) < 0.05 * abs(step):
        count = "1 frame is" if abs(whole) == 1 else f"{abs(whole)} frames are"
        what = "lost" if whole > 0 else "doubled"
        return "frame_numbers", (
            f"the object turns by {turn_deg:+.3f} deg beyond what is stated: {count} {what} "
            "there, or the frames' numbers are wrong"
        )
    return "angle_step", (
        f"the object turns by {turn_deg:+.3f} deg beyond what is stated: it slipped, or frames "
        "are missing there"
    )


def _shape(curve: FloatArray) -> tuple[str, int | None]:
    """Describe how a parameter moves over the frames.

    Args:
        curve: (n,) values of the frames, two at least.

    Returns:
        Words for the finding (at a frame, from frame to frame, steadily, or to and fro),
        and the number of the frame before a jump; None unless it jumps.
    """
    steps = np.abs(np.diff(curve))
    jump = int(np.argmax(steps))
    sides = [side for side in (curve[: jump + 1], curve[jump + 1 :]) if len(side)]
    if max(float(np.std(side)) for side in sides) < 0.2 * steps[jump]:
        return f"at frame {jump + 1}", jump
    off = curve - curve.mean()
    power = max(float(off @ off), 1e-300)
    if float(off[1:] @ off[:-1]) / power < 0.4:
        return "from frame to frame", None
    if abs(float(np.corrcoef(curve, np.arange(len(curve)))[0, 1])) > 0.9:
        return "steadily from the first to the last frame", None
    return "to and fro", None
