"""Motion that explains the residuals of a fit, in words."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.residual_limit import largest_residual
from flexdt.twin.calibration.fit.evidence import NAMED_LOG_ODDS
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import (
    MotionFit,
    counted,
    derivative,
    follow_motion,
)
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.errors import TwinError
from flexdt.twin.findings import Finding, error
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

EXPLAINED_CHANCE: Final = 0.001
"""Probability of residuals so large, below which a motion does not explain a scan."""
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
MAX_CURVED: Final = 0.2
"""Part of a turn that a factor on the angles may leave for it to be one."""
MOST_FRAMES: Final = 720
"""Scans of more frames are not looked at: four motions at once take seconds there."""


def alternatives(words: Sequence[str]) -> str:
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
    if sizes.max() > MOST_FRAMES or not names or not fit.determined:
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
        code = CalibrationCode.VIBRATION
    else:
        code = CalibrationCode.DRIFT
    alike = open_motions(found, math.exp(NAMED_LOG_ODDS))
    if name == "dO_z":
        alike += ALIKE_MOTION[name]
    return error(
        code,
        f"{', '.join(motions)} moves during the scan, {how}{in_scan}{alternatives(alike)}: "
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
            CalibrationCode.ANGLE_SCALE,
            f"the frame angles{of_scan} are off by a factor {1.0 + share:.5f}; correct "
            f"them, or free angle_scale{beside}",
            free=("angle_scale",),
        )
    off = np.array([to_edge("alpha", v) for v in curve - np.median(curve)])
    return error(
        CalibrationCode.ANGLES_WRONG,
        f"the frames' angles{of_scan} differ from the stated ones by {np.std(off):.3f} deg "
        f"rms (up to {np.abs(off).max():.3f}){beside}",
    )


def named_turn(turn_deg: float, angles: FloatArray) -> tuple[CalibrationCode, str]:
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
        return CalibrationCode.FRAME_NUMBERS, (
            f"the object turns by {turn_deg:+.3f} deg beyond what is stated: {count} {what} "
            "there, or the frames' numbers are wrong"
        )
    return CalibrationCode.ANGLE_STEP, (
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
