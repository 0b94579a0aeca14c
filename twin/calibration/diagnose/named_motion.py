"""Motion in words: what moves, what looks alike, and how far something turned."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.fit.fitted_motion import MotionFit
from flexdt.twin.geometry.conventions import FloatArray

MOTION_WORDS: Final = {
    "dO_x": "the object moves aside",
    "dO_y": "the object moves up or down",
    "dO_z": "the object moves along the beam",
    "alpha": "the object turns",
    "dS_x": "the source moves aside",
    "dS_y": "the source moves up or down",
    "dS_z": "the source moves along the beam",
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
