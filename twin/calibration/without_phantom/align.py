"""Geometry of an ordinary circular scan from its own projections: what it tells, and what not.

Mirror symmetry (`mirror_symmetry.py`) tells where the image of the axis lies and, less well, the
panel's yaw. They are given as offsets: dO_x for the column, det_roll for the panel against the
axis, det_yaw. A panel shifted sideways looks as an axis shifted the other way does, but for a yaw
of shift / SDD, so that the geometry as a whole is right whichever of the two it was.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.fit.image_quantities import axis_in_image
from flexdt.twin.calibration.without_phantom.mirror_symmetry import (
    REACH,
    Symmetry,
    find_symmetry,
    first_column,
)
from flexdt.twin.calibration.without_phantom.turn import Image, Turn, read_turn
from flexdt.twin.errors import NotIdentifiableError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

FREE: Final = ("dO_x", "det_roll", "det_yaw")
UNTOLD: Final[Mapping[str, str]] = {
    "source_row_px": "the row of the source plane lies in the plane of symmetry, which is the same "
    "for every row; a phantom tells it (flexdt calibrate: det_pitch, dD_y)",
    "SOD": "an object twice as large at twice the distance gives the same images; a phantom of "
    "known size tells it",
    "magnification": "it is SDD / SOD; a phantom of known size tells it",
    "SDD": "in a circular scan it trades against the object's size and the row of the source "
    "plane; a phantom tells it (dD_z)",
    "det_pitch": "its axis is perpendicular to the plane of symmetry, which stays as it is; a "
    "phantom tells it",
    "dO_y": "a shift along the axis moves the object alone; a phantom tells it",
}
"""What a circular scan, or this method, cannot tell, and why."""

STANDS: Final = 0.05
"""Source and panel may move so far between frames, seen from the axis [px]."""
LEAST_RATIO: Final = 1.5
"""How much less symmetric the mean must be about any other column (ratio of squares; assumed)."""
MOST_ASYMMETRY: Final = 0.05
"""Of the mean's structure, what may be neither symmetric nor noise (assumed)."""
MOST_COLUMN: Final = 2.0
"""Largest sigma of the column that is offered [px]."""
MOST_ROLL: Final = 0.5
"""Largest sigma of the roll that is offered [deg]."""
FLOOR_PX: Final = 0.01
"""Added to the column's sigma: what beam hardening and lag do to the mean (assumed) [px]."""
FLOOR_DEG: Final = 0.001
"""The same for the roll [deg]."""
STEP_TOLD: Final = 0.2
"""From here on a step of the images is a warning [px]."""


class Told(NamedTuple):
    """A value with its standard deviation."""

    value: float
    sigma: float
    unit: str


@dataclass(frozen=True)
class Alignment:
    """What a scan tells of its geometry.

    Attributes:
        offsets: the correction, all of it: what was in force with what was found; None: refused.
        parameters: axis_column_px, det_roll and, if the images tell it, det_yaw [px, deg].
        refused: name -> why it is not given.
        warnings: what is doubtful about the scan.
        frames: number of those that were used.
    """

    offsets: Offsets | None
    parameters: Mapping[str, Told]
    refused: Mapping[str, str]
    warnings: tuple[str, ...]
    frames: int

    @property
    def identifiable(self) -> bool:
        """Whether axis column and roll are given."""
        return self.offsets is not None


def align_turn(
    image: Image,
    poses: Poses,
    present: tuple[int, ...],
    shape: tuple[int, int],
    base: Offsets,
    priors: Mapping[str, float],
) -> Alignment:
    """Estimate axis column, roll and yaw from the frames of a turn.

    Args:
        image: line integrals of a frame, (rows, cols).
        poses: nominal poses of all frames.
        present: indices of the frames that are there.
        shape: (rows, cols) of every image.
        base: offsets in force; dO_x, det_roll and det_yaw are replaced.
        priors: standard deviation of each offset [mm, deg]; those of det_yaw and dD_x count.

    Returns:
        The alignment; what the scan cannot tell is in `refused`.
    """
    try:
        return _align(image, poses, present, shape, base, priors)
    except NotIdentifiableError as error:
        why = dict.fromkeys(("axis_column_px", "det_roll", "det_yaw"), error.message)
        return Alignment(None, {}, {**why, **UNTOLD}, (), 0)


def _align(
    image: Image, poses: Poses, present: tuple[int, ...], shape: tuple[int, int],
    base: Offsets, priors: Mapping[str, float],
) -> Alignment:  # fmt: skip
    _refuse_if(len(present) == 0, "no frame is there")
    pose = _standing(poses, present)
    turn = read_turn(image, base.angle_scale * poses.angle, present)
    rows, cols = shape
    middle = np.array([(cols - 1) / 2, (rows - 1) / 2])
    foot = np.array([base.tau_x, base.tau_z, 0.0])

    def offsets(values: FloatArray) -> Offsets:
        return replace(base, **dict(zip(FREE, values.tolist(), strict=True)))

    def view(values: FloatArray) -> FloatArray:
        parts: FloatArray = pose.cone_vec(offsets(values)).rows[0].reshape(4, 3).copy()
        parts[:2] -= foot
        return parts.ravel()

    def seen(values: FloatArray) -> float:
        return float(axis_in_image(pose, offsets(values), middle)[0])

    start = np.array([getattr(base, name) for name in FREE])
    pitch, sdd = float(np.linalg.norm(pose.u[0])), float(pose.sdd[0])
    scales = np.array([pitch * float(pose.sod[0]) / sdd, 2 / rows, 2 * sdd / (pitch * cols**2)])
    sideways = math.atan(priors["dD_x"] / sdd)
    yaw = max(math.hypot(math.radians(priors["det_yaw"]), sideways), 1e-9)
    nominal = seen(start)
    column, ratio = first_column(turn.mean, nominal)
    _refuse_if(
        ratio == 0.0,
        f"the mean is symmetric about no column within {REACH * cols:.0f} px of the nominal one "
        f"({nominal:.1f}): the axis is elsewhere, or too much of the object is out of view",
    )
    _refuse_if(
        ratio < LEAST_RATIO,
        f"the mean is about as symmetric about another column as about {column:.1f} (ratio "
        f"{ratio:.2f}; at least {LEAST_RATIO:g})",
    )
    start[0] += (column - nominal) / _slopes(seen, start, scales)[0]
    found = find_symmetry(turn, view, start, scales, np.array([math.inf, math.inf, yaw]))
    _refuse_if(
        not found.converged,
        "no plane of symmetry is found: too little structure for the noise, or too few columns on "
        "both sides of the axis",
    )
    _refuse_if(
        found.asymmetry > MOST_ASYMMETRY,
        f"{100 * found.asymmetry:.1f} % of the mean is not symmetric (at most "
        f"{100 * MOST_ASYMMETRY:g} %): something does not turn with the stage, or the angles or "
        "the object change during the scan",
    )
    step = (0.0, 0.0) if turn.step_px is None else turn.step_px[0]
    covariance = found.covariance.copy()
    covariance[0, 0] += (math.hypot(FLOOR_PX, step[0] / 2) * scales[0]) ** 2
    covariance[1, 1] += math.radians(FLOOR_DEG) ** 2 + (step[0] / rows) ** 2
    slopes = _slopes(seen, found.values, scales)
    sigma = math.sqrt(slopes @ covariance @ slopes)
    roll, turned = np.degrees(np.sqrt(np.diag(covariance)[1:])).tolist()
    _refuse_if(
        sigma > MOST_COLUMN or roll > MOST_ROLL,
        f"the column would be known to {sigma:.2g} px and the roll to {roll:.2g} deg; allowed: "
        f"{MOST_COLUMN:g} px and {MOST_ROLL:g} deg (more views or light help)",
    )
    parameters = {
        "axis_column_px": Told(seen(found.values), sigma, "px"),
        "det_roll": Told(math.degrees(found.values[1]), roll, "deg"),
    }
    refused = dict(UNTOLD)
    if found.images[2] < yaw / 2:
        aside = math.hypot(turned, math.degrees(sideways))
        parameters["det_yaw"] = Told(math.degrees(found.values[2]), aside, "deg")
    else:
        refused["det_yaw"] = (
            f"the images tell it to +- {math.degrees(found.images[2]):.2g} deg, its prior to +- "
            f"{math.degrees(yaw):.2g} deg: that is what the correction contains"
        )
    warnings = _warnings(turn, found, len(poses) - len(present))
    return Alignment(offsets(found.values), parameters, refused, warnings, len(turn.used))


def _standing(poses: Poses, present: tuple[int, ...]) -> Poses:
    """The pose that all frames share but for the angle of the stage.

    Raises:
        NotIdentifiableError: source or panel move, so the scan is not on one circle.
    """
    chosen = np.array(present)
    table = np.hstack([poses.source - poses.axis, poses.detector - poses.axis, poses.u, poses.v])
    table = table[chosen]
    pitch = float(np.linalg.norm(poses.u[chosen[0]]))
    moved = float(np.abs(table - table[0]).max()) / pitch
    _refuse_if(
        moved > STANDS,
        f"source or panel move by {moved:.4g} px between frames; allowed: {STANDS:g} px (one "
        "circle about the rotation axis)",
    )
    return poses[chosen[:1]]


def _slopes(seen: Callable[[FloatArray], float], at: FloatArray, scales: FloatArray) -> FloatArray:
    """Change of the column with each parameter, (k,)."""
    steps = np.diag(0.1 * scales)
    return np.array([(seen(at + e) - seen(at - e)) / (2 * e.sum()) for e in steps])


def _refuse_if(wrong: bool, why: str) -> None:
    if wrong:
        raise NotIdentifiableError(why)


def _warnings(turn: Turn, found: Symmetry, missing: int) -> tuple[str, ...]:
    out = []
    if turn.repeated:
        out.append(f"frames {list(turn.repeated)} repeat the one before and are left out")
    if missing:
        out.append(f"{missing} frames are missing; the sigmas contain what that may do")
    if turn.step_px is not None and abs(turn.step_px[0][0]) > STEP_TOLD:
        (right, down), after = turn.step_px
        out.append(
            f"after frame {after} the images step by {right:.2f} px to the right and {down:.2f} px "
            "down: a jump there, or a drift over the scan; the sigmas contain half of it"
        )
    return tuple(out)
