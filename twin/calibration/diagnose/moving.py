"""What moves during a scan, by name: the motion that explains the residuals of a fit."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.finding import Finding, error
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.fitted_motion import MotionFit, derivative, follow_motion
from flexdt.twin.calibration.fit.residual_structure import MOVING
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import UNITS, to_edge

OF_MOTION: Final = frozenset(("drift", "vibration", "angles_wrong"))
"""What is called so may be followed from frame to frame."""
EXPLAINED_PX: Final = 0.2
"""Residual that may remain of a motion that is named."""
MOST_FRAMES: Final = 720
"""Scans of more frames are not looked at: four motions at once take seconds there."""


def moving(fit: FitResult, refit: Callable[[MotionFit], FitResult]) -> Finding | None:
    """Name what moves, if that explains the residuals.

    Args:
        fit: in which nothing moves.
        refit: the fit to poses with a motion.
    """
    problem, before = fit.problem, fit.certificate.rms_px
    sizes = np.bincount(problem.group)
    names = [n for n in MOVING if n in fit.values or n + "@0" in fit.values]
    if sizes.min() < 12 or sizes.max() > MOST_FRAMES or not names or not fit.identifiable:
        return None
    try:
        better, found = follow_motion(fit, names, refit)
    except TwinError:
        return None
    if not better.certificate.rms_px < min(0.5 * before, EXPLAINED_PX):
        return None
    use = problem.seen
    effects = []
    for i, name in enumerate(names):
        reach = float(np.sqrt(np.mean(derivative(problem, fit, name, use) ** 2)))
        effects.append(reach * max(float(np.ptp(m.values[:, i])) for m in found.motions))
    first = int(np.argmax(effects))
    motion = max(found.motions, key=lambda m: float(np.ptp(m.values[:, first])))
    name, curve = names[first], motion.values[:, first]
    said = [
        f"{n} by {to_edge(n, float(np.ptp(motion.values[:, i]))):.3g} {UNITS[n]}"
        for i, n in sorted(enumerate(names), key=lambda pair: -effects[pair[0]])
        if effects[i] > 0.3 * effects[first]
    ]
    how, jump = _shape(curve)
    if name == "alpha":
        if jump is not None:
            height = to_edge(name, float(curve[jump + 1] - curve[jump]))
            code, text = named_turn(height, problem.poses.angle)
            return error(code, f"between frames {jump} and {jump + 1} {text}")
        off = np.array([to_edge(name, v) for v in curve - np.median(curve)])
        return error(
            "angles_wrong",
            f"the frames' angles differ from the stated ones by {np.std(off):.3f} deg rms (up to "
            f"{np.abs(off).max():.3f})",
        )
    code = "vibration" if how.startswith("from frame") else "drift"
    return error(
        code,
        f"{', '.join(said)} moves during the scan, {how}: --per-frame {','.join(names)} follows it",
    )


def named_turn(turn_deg: float, angles: FloatArray) -> tuple[str, str]:
    """What it is called if the object turns too far somewhere in a scan with `angles` [rad]."""
    step = abs(math.degrees(float(np.median(np.diff(angles)))))
    whole = round(turn_deg / step) if step else 0
    if whole and abs(turn_deg - whole * step) < 0.05 * step:
        return "frame_numbers", (
            f"the object turns by {turn_deg:+.3f} deg too far, {abs(whole)} steps: frames are "
            "missing there, or their numbers are wrong"
        )
    return "angle_step", (
        f"the object turns by {turn_deg:+.3f} deg too far: it slipped, or frames are missing there"
    )


def _shape(curve: FloatArray) -> tuple[str, int | None]:
    """How a parameter moves, and after which frame it jumps if it does."""
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
