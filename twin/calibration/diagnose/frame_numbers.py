"""The pose that each frame really shows: lost, doubled and exposed-again frames.

The number of the pose that a frame shows, less its own number, is hidden and mostly
stays from frame to frame. The most likely sequence (Viterbi, IEEE Trans. Inf. Theory 13
(1967) 260) is found from the distances of each frame's spots from the beads' places at
neighboring poses: a stage that rises as it turns is at another angle and height.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.findings import Finding, error, warning
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

MOST_SHIFT: Final = 6
"""Numbers by which a frame may be off."""
CHANGE_COST: Final = math.log(1e3)
"""Cost of another shift than the frame's before; assumed: one frame in a thousand."""
ASTRAY_COST: Final = math.log(1e3)
"""Cost of a spot that belongs to no bead."""
GOOD_SHARE: Final = 0.8
"""Part of the frames that must show the phantom at the angles found."""
LEAST_SPREAD_PX: Final = 0.05
MAX_SHOWN: Final = 6
"""Largest number of changes that are listed."""


@dataclass(frozen=True, eq=False)
class FrameNumbers:
    """Numbers of the angles that the frames of a scan show.

    Attributes:
        shift: (n,) number of the angle that a frame shows, less its own, 0 in the first frame.
        fits: (n,) frames that show the phantom at that angle.
    """

    shift: npt.NDArray[np.int64]
    fits: npt.NDArray[np.bool_]

    def shown(self, poses: Poses) -> Poses:
        """Return the pose that each frame shows; the end steps go on beyond the ends."""
        return _at_numbers(poses, np.arange(len(poses)) + self.shift)

    @property
    def again(self) -> npt.NDArray[np.intp]:
        """Frames that show another angle, while the frames after them show their own."""
        return np.flatnonzero((self.shift != self._settled) & self.fits)

    @property
    def renumbered(self) -> bool:
        """The frames' numbers are wrong from some frame on."""
        return bool((self._settled != 0).any())

    @property
    def _settled(self) -> npt.NDArray[np.int64]:
        """Shift of frame numbers (n,) without changes that last one frame, or that only
        the last frame has, and without two frames in exchange: such frames get the shift
        before.
        """
        out = self.shift.copy()
        n = len(out)
        for i in range(1, n):
            before = out[i - 1]
            after = self.shift[i + 1 : i + 3] - before
            if out[i] == before:
                continue
            if not len(after) or after[0] == 0:
                out[i] = before
            elif out[i] == before + 1 and after[0] == -1 and not after[1:].any():
                out[i : i + 2] = before
        return out

    def _last_before(self, frame: int) -> int:
        """Return the last frame before one that shows the phantom; the first if none does."""
        return int(np.flatnonzero(self.fits[:frame]).max(initial=0))

    def judged(self, name: str) -> Finding | None:
        """Make the finding on wrong numbers of frames; at most `MAX_SHOWN` are listed.

        Args:
            name: of the scan.

        Returns:
            An error where frames are lost or repeated (all later numbers are wrong); a
            warning where single frames show another angle and are left out; None if all
            numbers are right.
        """
        if not self.renumbered:
            again = self.again.tolist()
            if not again:
                return None
            described = "; ".join(
                f"frame {i} shows what frame {i + int(self.shift[i])} should"
                for i in again[:MAX_SHOWN]
            )
            return warning(
                CalibrationCode.FRAMES_INCONSISTENT,
                f"{name}: in {len(again)} of {len(self.shift)} frames the shadows are "
                f"not where the others put them: {described}; those frames are not used",
            )
        settled = self._settled
        changes = np.flatnonzero(np.diff(settled)) + 1
        described = "; ".join(
            _change(self._last_before(i), i, int(settled[i] - settled[i - 1]))
            for i in changes[:MAX_SHOWN].tolist()
        )
        if len(changes) <= MAX_SHOWN:
            more = ""
        else:
            more = f" (and {len(changes) - MAX_SHOWN} more)"
        return error(
            CalibrationCode.FRAME_NUMBERS,
            f"{name}: {described}{more}: the frames' angles are those of other frames; number them "
            "anew, or scan again",
        )


def _change(last: int, frame: int, steps: int) -> str:
    """Describe in words lost or repeated frames before a frame, for the finding.

    Args:
        last: number of the last frame with the shift before.
        frame: number of the first frame with the new shift.
        steps: above 0: so many frames are lost; below 0: so many are repeated.
    """
    if steps >= 0:
        lost = "a frame is" if steps == 1 else f"{steps} frames are"
        return f"{lost} lost between frames {last} and {frame}"
    times = "" if steps == -1 else f" {-steps} times"
    if last == frame - 1:
        shown = f"frame {frame} shows the angle of frame {last} again"
    else:
        shown = (
            f"one of frames {last + 1} to {frame} shows the angle of the one before again"
        )
    return f"{shown}, and all after it come late: doubled{times}"


def frame_numbers(
    detections: Sequence[Detections],
    beads: FloatArray,
    poses: Poses,
    offsets: Offsets,
    spread_px: float,
) -> FrameNumbers | None:
    """Find the angle that each frame shows, up to `MOST_SHIFT` numbers or half of the scan
    from its own, by the cheapest path: a change of shift costs `CHANGE_COST`, a spot without a bead
    `ASTRAY_COST`.

    A frame that fits no angle has the shift of the one before, or of the first that fits;
    shifts are relative to the first frame's.

    Args:
        detections: spots of each of the n frames.
        beads: (k, 3) [mm].
        poses: nominal geometry.
        offsets: geometry that most frames agree with.
        spread_px: distance of spots from the beads' projections.

    Returns:
        Shift of each frame's number, and the frames that fit; None for fewer than three
        frames, or if less than `GOOD_SHARE` of those with two spots fit.
    """
    n = len(poses)
    most = min(MOST_SHIFT, (n - 1) // 2)
    if most < 1:
        return None
    shifts = np.arange(-most, most + 1)
    spread = max(spread_px, LEAST_SPREAD_PX)
    there = np.array([len(d) >= 2 for d in detections])
    costs = np.zeros((n, len(shifts)))
    near = np.zeros((n, len(shifts)))
    for column, step in enumerate(shifts.tolist()):
        places = (
            _at_numbers(poses, np.arange(n) + step)
            .cone_vec(offsets)
            .project_points(beads, detections[0].shape)
        )
        for i in np.flatnonzero(there).tolist():
            gap = np.linalg.norm(detections[i].centers[:, None] - places[i][None], axis=2)
            square = (gap.min(axis=1) / spread) ** 2
            costs[i, column] = float(np.minimum(0.5 * square, ASTRAY_COST).sum())
            near[i, column] = float(np.mean(0.5 * square < ASTRAY_COST))
    path = _likeliest(costs)
    fits = near[np.arange(n), path] > 0.5
    if fits[there].mean() < GOOD_SHARE:
        return None
    # A frame that fits no angle tells nothing: it has the shift of the one before, and the
    # first ones that of the first that fits.
    told = fits & there
    last = np.maximum.accumulate(np.where(told, np.arange(n), np.argmax(told)))
    found = np.asarray(shifts[path[last]], dtype=np.int64)
    return FrameNumbers(found - found[0], told)


def _at_numbers(poses: Poses, numbers: npt.NDArray[np.int64]) -> Poses:
    """Return the poses of given numbers; beyond the ends, the first and the last step
    go on.

    Args:
        poses: two at least.
        numbers: (m,) of frames, below 0 and above the last, too.
    """
    last = len(poses) - 1
    inside = np.clip(numbers, 0, last)
    beyond = numbers - inside

    def continued(values: FloatArray) -> FloatArray:
        """Return the values of the numbers, (m,) or (m, 3) of (n,) or (n, 3)."""
        before = beyond < 0
        step = np.where(
            before.reshape(-1, *(1,) * (values.ndim - 1)),
            values[1] - values[0],
            values[last] - values[last - 1],
        )
        return np.asarray(values[inside] + (beyond * step.T).T)

    return Poses(*(continued(getattr(poses, f.name)) for f in fields(Poses)))


def _likeliest(costs: FloatArray) -> npt.NDArray[np.intp]:
    """Find the path of least total cost through the states of all frames; every change of
    state adds `CHANGE_COST`.

    Args:
        costs: (n frames, states).

    Returns:
        (n,) state of each frame.
    """
    n, states = costs.shape
    total = costs[0].copy()
    came = np.zeros((n, states), dtype=np.intp)
    own = np.arange(states)
    for i in range(1, n):
        best = int(np.argmin(total))
        moved = total[best] + CHANGE_COST < total
        came[i] = np.where(moved, best, own)
        total = np.where(moved, total[best] + CHANGE_COST, total) + costs[i]
    path = np.empty(n, dtype=np.intp)
    path[-1] = int(np.argmin(total))
    for i in range(n - 1, 0, -1):
        path[i - 1] = came[i, path[i]]
    return path


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
