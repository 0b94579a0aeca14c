"""Checks of the data before a fit: frames, phantom, handedness, angles.

When spots and phantom disagree, possible mistakes are tried one by one and the one that
explains the spots is reported; the data are not changed. A finding is an error where the
numbers must not be used, and a warning where they may.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections, SpotFinder
from flexdt.twin.calibration.diagnose import OF_MOTION, CalibrationCode
from flexdt.twin.calibration.diagnose.frame_numbers import named_turn
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.verdict import judged
from flexdt.twin.calibration.fit.fit import Solver, estimate_geometry
from flexdt.twin.calibration.fit.priors import OFFSETS
from flexdt.twin.calibration.fit.problem import SIX, UNSTRAINED
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, Scan
from flexdt.twin.calibration.identify import Identification, Search, attempt
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses

GOOD_SHARE = 0.7
"""Share of the spots that must be some bead, and of the beads in view that must be seen."""
GOOD_RMS_PX = 0.6
"""Residual of the first assignment above which another explanation is looked for."""
OTHER_SIZE = 1.3
"""Factor between seen and expected radii from which the finding names the size."""
STRAY_SHARE = 0.15
"""Share of the frames in which another spot may be at the place of a lost bead."""
SOME_SPOTS = 0.95
"""Share of the spots that are beads below which a finding names other spots."""
MOST_LEFT_OUT = 12
"""Beads of a phantom of which each is left out in turn to see whether it is the cause."""
MOVED = OF_MOTION | {
    CalibrationCode.ANGLE_STEP,
    CalibrationCode.FRAME_NUMBERS,
    CalibrationCode.ANGLE_SCALE,
    CalibrationCode.ANGLE_ENDPOINT,
}
"""What explains that spots are far from where one geometry has them."""
WIDE_GATE_PX = 25.0
"""Gate of an assignment to beads that may be moving [px]."""
LEAST_TURN_DEG = 0.2
"""Turn between two parts of a scan from which it is reported [deg]."""
FEW_TURNED = math.radians(75.0)
"""Stated turn of the frames of which the true one is looked for."""
TURN_FACTORS = (0.5, 0.56, 0.62, 0.7, 0.8, 0.9, 1.1, 1.25, 1.4, 1.6, 1.8, 2.0)
"""Trial factors of the angles; values between them are fitted."""
LEAST_TURN = 0.04
"""Least relative error of a turn for that; smaller ones are found in other ways."""
TURN_WIDTH = {CalibrationCode.ANGLE_SCALE: 0.1}
"""Standard deviation of the factor about a trial value."""
ONE_FRAME_TURN = math.radians(8.0)
"""Error of the turn that a frame shows by itself (assumed) [rad]."""
SAMPLED_FRAMES = 8
"""Number of frames that are examined one by one."""

SHOWN_AT_LEAST = 0.5
"""Least share of the frames with spots for another reading of the images to be reported."""
MAX_SHOWN = 5
"""Largest number of unusable files that are named."""
_STATES = {
    FrameState.MISSING: (CalibrationCode.FRAMES_MISSING, "missing"),
    FrameState.DARK: (CalibrationCode.FRAMES_DARK, "dark"),
    FrameState.REPEATED: (CalibrationCode.FRAMES_REPEATED, "copies of the frame before"),
}


def judge_frames(
    scan: Scan, looks: Sequence[FrameSpots], sought: SpotFinder
) -> list[Finding]:
    """Judge missing, dark and repeated frames, and frames without a bead.

    Frames without beads are judged among usable ones; if none shows any, images are
    searched once more as intensities, and the error says whether that helps. Unusable
    files are named, `MAX_SHOWN` at most.

    Args:
        scan: gives the name, and its images.
        looks: spots and state of each frame.
        sought: sizes of spots.

    Returns:
        At most one finding for each of the three states, then one on beads: warnings, and
        errors where no frame is usable (of beads: where no usable one shows any). Empty if
        all show beads.
    """
    out = []
    name = scan.name
    n = len(looks)
    usable = [look for look in looks if look.state is FrameState.USABLE]
    for state, (code, words) in _STATES.items():
        some = [look for look in looks if look.state is state]
        files = sorted({look.unusable for look in some if look.unusable})
        rest = "; the others are used" if usable else ""
        text = f"{name}: {len(some)} of {n} frames are {words}{rest}"
        if files:
            if len(files) > MAX_SHOWN:
                more = f" (and {len(files) - MAX_SHOWN} more)"
            else:
                more = ""
            text += f"; unusable: {'; '.join(files[:MAX_SHOWN])}{more}"
        if some:
            out.append((warning if usable else error)(code, text))
    empty = sum(len(look.detections) == 0 for look in usable)
    if usable and empty == len(usable):
        out.append(
            error(
                CalibrationCode.NO_BEADS,
                f"{name}: no bead was found in any of {len(usable)} frames"
                f"{_of_intensities(scan, sought) or _looked_for(sought)}",
            )
        )
    elif empty:
        out.append(
            warning(
                CalibrationCode.FRAMES_EMPTY,
                f"{name}: {empty} of {n} frames show no bead",
            )
        )
    return out


def _of_intensities(scan: Scan, sought: SpotFinder) -> str:
    """Search for spots as if the images held intensities instead of line integrals; reads
    all images again.

    Returns:
        The end of the finding's sentence; empty if fewer than `SHOWN_AT_LEAST` of the
        frames show spots then.
    """
    looks = scan.frames.look(replace(sought, intensities=True))
    shown = sum(len(look.detections) > 0 for look in looks)
    if shown < SHOWN_AT_LEAST * len(looks):
        return ""
    return (
        f", but {shown} of {len(looks)} show such spots taken as transmissions: the images "
        "hold transmissions or counts, not line integrals; give a flat image (of ones, for "
        "transmissions), or -ln of the images"
    )


def _looked_for(sought: SpotFinder) -> str:
    """Write what was looked for, and what may be wrong, as the end of a sentence."""
    low, high = sought.radius_px
    return (
        "; looked for were round spots, darker than what is round them, of "
        f"{low:.1f} to {high:.1f} px radius: is this a bead phantom, is it in the beam, and "
        "are geometry and pixel size right?"
    )


def explain_identification(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    name: str,
    start: Offsets = NOMINAL,
    *,
    right_angles: bool = False,
    mistakes: frozenset[CalibrationCode] | None = None,
) -> Finding | None:
    """Judge an assignment; if it is poor, find the mistake that explains the spots.

    In this order: at most one spot a frame; an ambiguous assignment (error); lost or
    displaced beads, or other spots (warnings); a mistake (`_alternative`); else nothing
    for a plausible assignment, or the error "wrong_phantom". Single frames that the
    others contradict are ignored.

    Args:
        found: the assignment; None if no one was found.
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        name: of the scan, the text's beginning.
        start: offsets that are known before.
        right_angles: the spots turn together as the angles say, so that no mistake of angles
            or of frames, and no motion, is looked for where the assignment is not plausible.
        mistakes: codes of those that are tried then; None: all.

    Returns:
        None for a good assignment.
    """
    most = max((len(d) for d in detections), default=0)
    if most == 1:
        if len(model) == 1 and found is not None:
            judged = warning
        else:
            judged = error
        return judged(
            CalibrationCode.ONE_BEAD,
            f"{name}: no frame shows more than one bead: one bead alone fixes neither the "
            "scale nor the angle",
        )
    if found is not None and not found.one_axis and convincing(found):
        listed = ", ".join(f"{a:.1f}" for a in found.start_angles)
        return error(
            CalibrationCode.AMBIGUOUS,
            f"{name}: the beads cannot be told apart: start angles {listed} deg explain the "
            "shadows equally well",
            "state how the phantom stands, as --start alpha=DEG --prior alpha=5, or take its "
            "beads for markers, --phantom unknown",
            figure=found.parameters.to_edge()["alpha"],
        )
    if found is not None:
        found = _without_bad_frames(found)
        judged_beads = _beads_or_spots(found, detections, model, name)
        if judged_beads is not None or convincing(found):
            return judged_beads
    plausible = found is not None and _plausible(found)
    explanation = _alternative(
        found, detections, model, poses, start,
        right_angles and not plausible, None if plausible else mistakes,
    )  # fmt: skip
    if explanation is not None:
        return replace(explanation, message=f"{name}: {explanation.message}")
    if found is not None and _plausible(found):
        return None
    why = _why_wrong(found, detections, model, poses)
    return error(
        CalibrationCode.WRONG_PHANTOM,
        f"{name}: the shadows do not fit the phantom {model.name!r}: {why}; wrong phantom, or "
        "wrong frame angles",
    )


def _beads_or_spots(
    found: Identification, detections: Sequence[Detections], model: BeadModel, name: str
) -> Finding | None:
    """Warn of beads that are lost or displaced, or of spots that are none, in an assignment
    that is good for the rest; None without.
    """
    counts = np.array([len(d) for d in detections])
    rest = (1.0 - found.explained) * counts.sum() / max(int((counts > 0).sum()), 1)
    if missing := _missing(found):
        whose = (
            f"{name}: bead {', '.join(map(str, missing))} of {model.name!r} has no spot"
        )
        if found.explained >= SOME_SPOTS:
            return warning(
                CalibrationCode.BEADS_MISSING,
                f"{whose} in any frame, and all spots fit the others: it is lost or out of "
                "view; the others are used",
            )
        return warning(
            CalibrationCode.BEAD_DISPLACED,
            f"{whose} where it should be, and in each frame {rest:.1f} spots are no "
            "bead: it is elsewhere, or lost; the others are used",
        )
    if not convincing(found):
        return None
    if found.explained > SOME_SPOTS or not _extra(found, counts):
        return None
    return warning(
        CalibrationCode.EXTRA_SPOTS,
        f"{name}: in each frame {rest:.1f} of the spots are none of the beads of "
        f"{model.name!r}: other balls, or something round; not used",
    )


def _why_wrong(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
) -> str:
    """Describe how badly an assignment fits, and another size of the spots."""
    why = "no orientation of the phantom explains them"
    if found is not None:
        why = (
            f"at best {100 * found.explained:.0f} % of the shadows are a bead, "
            f"{100 * found.found:.0f} % of the beads in view have a shadow, and they lie "
            f"{found.rms_px:.2f} px off"
        )
    expected = float(np.median(model.bead_radius_mm) * np.median(poses.pixels_per_mm))
    radius = float(np.median(np.concatenate([d.radii_px for d in detections])))
    if abs(math.log(radius / expected)) > math.log(OTHER_SIZE):
        why += (
            f"; their radius is {radius:.1f} px instead of {expected:.1f}: "
            "other pixels or beads?"
        )
    return why


def _extra(found: Identification, counts: npt.NDArray[np.intp]) -> bool:
    """Check whether more than 0.6 of the frames with nearly all beads have further spots.

    `found`: the assignment; `counts`: (n,) all spots of each frame."""
    seen = (found.index >= 0).sum(axis=1)
    good = seen >= 0.7 * max(float(np.median(seen)), 1.0)
    return bool(np.mean(counts[good] > seen[good]) > 0.6)


def _without_bad_frames(found: Identification) -> Identification:
    """Drop single frames with at most 0.7 of the usual beads, which the others
    contradict.

    After the fit they are listed. The residual becomes the typical one. Returns `found`
    itself without such frames, or if they are more than a fifth.
    """
    seen = (found.index >= 0).sum(axis=1)
    if seen.any():
        usual = np.median(seen[seen > 0])
    else:
        usual = 0
    bad = (seen > 0) & (seen <= 0.7 * usual)
    if not bad.any() or bad.sum() > 0.2 * len(seen):
        return found
    return replace(
        found, index=np.where(bad[:, None], -1, found.index), rms_px=found.typical_px
    )


def _missing(found: Identification) -> list[int]:
    """List beads without a spot (in fewer than `STRAY_SHARE` of the frames) where nearly
    every spot fits one of the others, at least three of them.

    A bead that is hidden at times, in up to half of the frames, counts as seen.

    Returns:
        Numbers of beads; empty if the identification is poor or a bead is in neither
        group.
    """
    if found.explained < GOOD_SHARE or not found.rms_px < GOOD_RMS_PX:
        return []
    share = (found.index >= 0).mean(axis=0)
    lost = share < STRAY_SHARE
    often = share >= 0.5  # what others hide has no spot
    if np.count_nonzero(often) < 3 or not (lost | often).all():
        return []
    missing: list[int] = np.flatnonzero(lost).tolist()
    return missing


def _leaves_less(some: Identification, every: Identification) -> bool:
    """Check whether an assignment to some beads leaves fewer spots and beads without each
    other, and the others closer, than one to every bead: so it is without a bead that is
    elsewhere and has now and then a stray spot at its stated place."""
    without = [2.0 - found.explained - found.found for found in (some, every)]
    return without[0] < without[1] and some.rms_px < every.rms_px


def _clearly_better(other: Identification, found: Identification | None) -> bool:
    """Check whether an assignment fits much closer, or explains many more spots, than one
    that was found; any is better than none.
    """
    if found is None:
        return True
    much_closer = other.rms_px < 0.3 * found.rms_px
    return much_closer or other.explained > found.explained + 0.2


def _plausible(found: Identification) -> bool:
    return found.explained >= 0.85 and found.found >= 0.85 and found.rms_px < 4.0


def convincing(found: Identification) -> bool:
    """Check whether an identification explains and finds most spots (`GOOD_SHARE`),
    closely enough (`GOOD_RMS_PX`) to be believed.
    """
    return (
        found.explained >= GOOD_SHARE
        and found.found >= GOOD_SHARE
        and found.rms_px < GOOD_RMS_PX
        and bool((found.index >= 0).any())
    )


def _flipped(detections: Sequence[Detections], axis: int) -> list[Detections]:
    """Mirror the spot centers of all frames in columns (`axis` 0) or in rows (1); shapes
    and covariances stay. Returns copies.
    """
    out = []
    for d in detections:
        centers = d.centers.copy()
        size = d.shape[1] if axis == 0 else d.shape[0]
        centers[:, axis] = size - 1 - centers[:, axis]
        out.append(replace(d, centers=centers))
    return out


_Mistake = tuple[CalibrationCode, str, dict[str, Any]]
"""Code and text of a mistake, and what is different if it was made: arguments of `attempt`."""


class _Tried(NamedTuple):
    """A mistake, and the assignment of spots to beads as if it was made."""

    code: CalibrationCode
    text: str
    found: Identification

    @property
    def off(self) -> tuple[float, float]:
        """How far spots and phantom disagree, for comparison."""
        # A mistake that explains all spots comes before one that fits most of them more
        # closely: four of the LEGO phantom's five beads are a helix, which turns round into
        # itself.
        return round(1.0 - self.found.explained, 1), self.found.rms_px

    @property
    def finding(self) -> Finding:
        """The finding that the mistake was made."""
        return error(self.code, self.text)


def _bead_elsewhere(fit_well: Sequence[_Tried], found: Identification) -> Finding | None:
    """Find the bead without which less is left of an assignment to all; None without."""
    less = [
        one
        for one in fit_well
        if one.code is CalibrationCode.BEAD_DISPLACED and _leaves_less(one.found, found)
    ]
    return min(less, key=lambda one: one.off).finding if less else None


def _mistakes(
    detections: Sequence[Detections], model: BeadModel, poses: Poses
) -> list[_Mistake]:
    """List the mistakes that are tried, see `_alternative`."""
    n = len(poses)
    k = len(model)
    trials: list[_Mistake] = []
    for factor, true, stated in (
        ((n / (n - 1), n - 1, n), ((n - 1) / n, n, n - 1)) if n > 1 else ()
    ):
        turned = replace(
            poses, angle=poses.angle[0] + factor * (poses.angle - poses.angle[0])
        )
        text = (
            f"the angles are off by a factor {factor:.5f}: the frames turn by 360 / "
            f"{true}, not 360 / {stated} (endpoint error)"
        )
        trials.append((CalibrationCode.ANGLE_ENDPOINT, text, {"poses": turned}))
    across, along = (_flipped(detections, axis) for axis in (0, 1))
    trials += [
        (
            CalibrationCode.MIRRORED_PHANTOM,
            "the phantom is the mirror image of its model, or the images are mirrored "
            "left to right and the stage turns the other way, which looks alike",
            {"model": model.mirrored()},
        ),
        (
            CalibrationCode.ANGLE_REVERSED,
            "the stage turns the other way than the angles say: negate the angles "
            "of the settings or of the geometry",
            {"poses": replace(poses, angle=-poses.angle)},
        ),
        (
            CalibrationCode.IMAGE_MIRRORED,
            "the images are mirrored left to right",
            {"detections": across},
        ),
        (
            CalibrationCode.IMAGE_UPSIDE_DOWN,
            "the images are upside down, or each z of the phantom has the wrong "
            "sign, which looks alike",
            {"detections": along},
        ),
        (
            CalibrationCode.IMAGE_TURNED,
            "the images are upside down and mirrored: turned by 180 deg",
            {"detections": _flipped(across, 1)},
        ),
        (
            CalibrationCode.PHANTOM_UPSIDE_DOWN,
            "the phantom stands on its head",
            {"model": model.turned_over()},
        ),
        (
            CalibrationCode.NOT_TURNING,
            "the object does not turn although the angles say so",
            {"poses": replace(poses, angle=np.zeros(n))},
        ),
    ]
    for j in range(k if 4 < k <= MOST_LEFT_OUT else 0):
        others = BeadModel(
            np.delete(model.beads, j, 0), np.delete(model.bead_radius_mm, j)
        )
        text = (
            f"without bead {j} the others fit: it is not where the phantom's model has it"
        )
        trials.append((CalibrationCode.BEAD_DISPLACED, text, {"model": others}))
    return trials


def _alternative(
    found: Identification | None,
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    start: Offsets,
    right_angles: bool,
    mistakes: frozenset[CalibrationCode] | None,
) -> Finding | None:
    """Find the mistake that makes phantom and spots agree best.

    Tried are endpoint errors of the angles, mirrored or turned phantoms and images, a
    reversed or resting stage, and each bead left out (5 to `MOST_LEFT_OUT` beads). Only
    if none is convincing and clearly better than `found`: motion, a bead without which
    less is left, parts of the scan, another turn, and single frames; these not for a
    plausible assignment.

    Args:
        found: the poor assignment, or None.
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        start: offsets that are known before.
        right_angles, mistakes: see `explain_identification`.

    Returns:
        Its finding, an error; None if no mistake explains the spots.
    """
    trials = _mistakes(detections, model, poses)
    if mistakes is not None:
        trials = [one for one in trials if one[0] in mistakes]
    given: dict[str, Any] = {
        "detections": detections, "model": model, "poses": poses, "start": start,
    }  # fmt: skip
    fit_well = [
        _Tried(code, text, other)
        for code, text, change in trials
        if (other := attempt(**(given | change))) is not None and convincing(other)
    ]
    better = [one for one in fit_well if _clearly_better(one.found, found)]
    if better:
        return min(better, key=lambda one: one.off).finding
    plausible = found is not None and _plausible(found)
    if right_angles:
        return None if found is None else _bead_elsewhere(fit_well, found)
    if found is not None and plausible and found.typical_px > 0.3 * found.rms_px:
        return None  # The right beads in about the right places: the residuals will tell.
    return (
        _in_motion(detections, model, poses, start)
        or (None if found is None or plausible else _bead_elsewhere(fit_well, found))
        or _in_parts(detections, model, poses, start)
        or _frame_by_frame(detections, model, poses, start)
    )


def _in_motion(
    detections: Sequence[Detections], model: BeadModel, poses: Poses, start: Offsets
) -> Finding | None:
    """Check whether the spots are those of the phantom, up to a motion.

    Args:
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        start: offsets that are known before.

    Returns:
        The finding that names the motion; None if there is none, or if the spots do not
        fit the beads even with a gate of `WIDE_GATE_PX`.
    """
    wide = Search(gate_px=WIDE_GATE_PX)
    found = attempt(detections, model, poses, search=wide, start=start)
    if found is None or min(found.explained, found.found) < GOOD_SHARE:
        return None
    shape = np.array([d.shape for d in detections], dtype=np.float64)
    # Of a large motion panel and axis have taken up a part: they begin where they should be.
    still = replace(start, **{name: getattr(found.parameters, name) for name in SIX})
    fit = estimate_geometry(
        found.tracks,
        model,
        poses,
        shape=shape,
        start=still,
        centre=found.bias,
        priors=OFFSETS,
        prior_centre=start,
        bound=math.inf,
    )
    known = Known(UNSTRAINED, None, Solver().floor_px)
    told = judged(fit, known, sigmas_known=False)[1]
    if any(f.code is CalibrationCode.MISFIT for f in told):
        return None
    return next((f for f in told if f.code in MOVED), None)


def _in_parts(
    detections: Sequence[Detections], model: BeadModel, poses: Poses, start: Offsets
) -> Finding | None:
    """Check whether the first or the last frames alone fit the phantom.

    Tried are halves, thirds and quarters until both ends fit.

    Args:
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        start: offsets that are known before.

    Returns:
        An error: on frame numbers if one end fits, on a turn above `LEAST_TURN_DEG` or
        else the largest shift between them if both do; None if no part fits.
    """
    n = len(poses)
    ends: dict[str, tuple[slice, Offsets]] = {}
    for share in (2, 3, 4):
        for end, part in (
            ("first", slice(0, n // share)),
            ("last", slice(n - n // share, n)),
        ):
            own = attempt(detections[part], model, poses[part], start=start)
            if own is not None and convincing(own):
                ends.setdefault(end, (part, own.parameters))
        if len(ends) > 1:
            break
    if not ends:
        return None
    if len(ends) == 1:
        ((part, _),) = ends.values()
        return error(
            CalibrationCode.FRAME_NUMBERS,
            f"frames {part.start} to {part.stop - 1} by themselves fit the phantom, all of "
            "them do not: frames are missing, their numbers or angles are wrong, or beads move "
            "against the others",
        )
    first, last = (ends[end][1].to_edge() for end in ("first", "last"))
    turn = (last["alpha"] - first["alpha"] + 180.0) % 360.0 - 180.0
    if abs(turn) > LEAST_TURN_DEG:
        code, text = named_turn(turn, poses.angle)
        return error(code, f"between the first and the last frames {text}")
    name = max(("dO_x", "dO_y", "dO_z"), key=lambda n: abs(last[n] - first[n]))
    return error(
        CalibrationCode.DRIFT,
        f"the first and the last frames fit the phantom, but {name} changes by "
        f"{last[name] - first[name]:+.3g} mm between them",
    )


def _other_turn(
    detections: Sequence[Detections],
    model: BeadModel,
    poses: Poses,
    start: Offsets,
    factors: Sequence[float],
) -> Finding | None:
    """Check whether the stage turns by another angle than stated, from the frames within
    75 deg of the first.

    Args:
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        start: offsets that are known before.
        factors: on the angles, that are tried.

    Returns:
        An error with the factor on the angles; None if no other one fits, it is within
        `LEAST_TURN` of 1, or for fewer than four such frames.
    """
    turned = poses.angle - poses.angle[0]
    n = int(np.count_nonzero(np.abs(turned) <= FEW_TURNED))
    if n < 4:
        return None
    best = (GOOD_RMS_PX, 1.0)
    for factor in factors:
        some = replace(poses, angle=poses.angle[0] + factor * turned)[:n]
        own = attempt(detections[:n], model, some, loose=TURN_WIDTH, start=start)
        if own is not None and convincing(own) and own.rms_px < best[0]:
            best = own.rms_px, factor * own.parameters.angle_scale
    if abs(best[1] - 1.0) < LEAST_TURN:
        return None
    return error(
        CalibrationCode.ANGLE_TURN,
        f"the first {n} frames fit the phantom if the stage turns {best[1]:.3f} times "
        f"as far as the angles say: {abs(math.degrees(float(turned[-1]))) * best[1]:.0f} "
        "deg from the first to the last frame",
    )


def _frame_by_frame(
    detections: Sequence[Detections], model: BeadModel, poses: Poses, start: Offsets
) -> Finding | None:
    """Check whether frames fit the phantom one by one, though not together:
    `SAMPLED_FRAMES` are tried, each with 5 spots or more.

    Args:
        detections: spots of each frame.
        model: the beads.
        poses: nominal geometry.
        start: offsets that are known before.

    Returns:
        An error on another turn if their start angles follow one or they are too few to
        tell; on the frames' order or angles if they follow none; None if neither fits.
    """
    chosen = np.linspace(0, len(poses) - 1, SAMPLED_FRAMES).astype(int).tolist()
    turned: list[float] = []
    stated: list[float] = []
    for i in chosen:
        if len(detections[i]) < 5:
            continue
        alone = slice(i, i + 1)
        search = Search(starts=36)
        own = attempt(detections[alone], model, poses[alone], search=search, start=start)
        if own is not None and convincing(own) and own.explained > SOME_SPOTS:
            turned.append(own.parameters.alpha + float(poses.angle[i]))
            stated.append(float(poses.angle[i]))
    if len(turned) < 0.7 * len(chosen):
        return _other_turn(detections, model, poses, start, TURN_FACTORS)
    factor = _factor_of(np.array(turned), np.array(stated))
    other = None
    if factor is not None:
        other = _other_turn(detections, model, poses, start, (factor,))
    return other or error(
        CalibrationCode.FRAME_NUMBERS,
        f"{len(turned)} of {len(chosen)} frames that were tried fit the phantom each "
        "by itself, together they do not: the frames are in another order, "
        "or their angles are wrong",
    )


def _factor_of(turned: FloatArray, stated: FloatArray) -> float | None:
    """Find the factor f, 0.5 to 2, for which turned = f * stated + a constant: the one of least
    median difference; None if that is `ONE_FRAME_TURN` or more.

    `turned`: what single frames show, up to whole turns [rad]; `stated`: of the same frames
    [rad].
    """
    best: tuple[float, float | None] = (ONE_FRAME_TURN, None)
    for factor in np.geomspace(TURN_FACTORS[0], TURN_FACTORS[-1], 400).tolist():
        off = np.exp(1j * (turned - factor * stated))
        apart = np.abs(np.angle(off / np.mean(off)))
        best = min(best, (float(np.median(apart)), factor), key=lambda one: one[0])
    return best[1]
