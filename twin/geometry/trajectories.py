"""Rows of cone_vec for ideal trajectories: a circle and a helix about the object frame's z axis.

`ConeVec.circular` and `ConeVec.helical` are the public names. The numbers follow from the frames of
`conventions`: at stage angle 0 the source stands at y = -sod and the panel at y = sdd - sod, and
the object turns clockwise, so that source and panel turn the other way in its frame.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    ROW_DIRECTION,
    UP,
    FloatArray,
    rotation_z,
    turn_detector,
)

FULL_TURN: Final = 360.0


@dataclass(frozen=True)
class Bench:
    """What stands still while the object turns.

    Attributes:
        sod: focal spot to rotation axis [mm].
        sdd: focal spot to panel [mm].
        pixel: pixel pitch along columns and rows [mm], or one number for both.
        offset: of the panel's centre towards growing columns and growing rows [mm].
        tilts: roll, pitch and yaw of the panel [deg]; yaw is applied first, roll last.
        height: of focal spot and panel above the object frame's origin [mm].
    """

    sod: float
    sdd: float
    pixel: float | Sequence[float]
    offset: Sequence[float] = (0.0, 0.0)
    tilts: Sequence[float] = (0.0, 0.0, 0.0)
    height: float = 0.0

    def rows(self, angles_deg: FloatArray, rise: float | FloatArray = 0.0) -> FloatArray:
        """The rows (n, 12) [mm] at these stage angles, raised by `rise` [mm] each.

        Raises:
            GeometryError: names the number that no scanner has.
        """
        pitch = _numbers("pixel", self.pixel, 2, "mm", repeated=True)
        columns, down = _numbers("offset", self.offset, 2, "mm")
        roll, tilt, yaw = (math.radians(a) for a in _numbers("tilts", self.tilts, 3, "deg"))
        places = {"sod": self.sod, "sdd": self.sdd, "height": self.height}
        sod, sdd, height = (_numbers(name, value, 1, "mm")[0] for name, value in places.items())
        if not 0.0 < sod <= sdd:
            raise GeometryError(
                f"sod {sod:g} mm and sdd {sdd:g} mm; allowed: 0 < sod <= sdd",
                {"asked": [sod, sdd], "allowed": "0 < sod <= sdd"},
            )
        if min(pitch) <= 0.0:
            raise GeometryError(
                f"pixel {pitch[0]:g} x {pitch[1]:g} mm; allowed: more than 0",
                {"asked": list(pitch), "allowed": "> 0"},
            )
        right, below = np.array(COLUMN_DIRECTION), np.array(ROW_DIRECTION)
        source = np.array([0.0, -sod, height])
        centre = np.array([0.0, sdd - sod, height]) + columns * right + down * below
        u, v = turn_detector(right * pitch[0], below * pitch[1], yaw, tilt, roll)
        turn = rotation_z(np.radians(angles_deg))
        up = np.multiply.outer(np.broadcast_to(rise, angles_deg.shape), np.array(UP))
        return np.concatenate([turn @ source + up, turn @ centre + up, turn @ u, turn @ v], axis=1)


def stage_angles(angles: int | npt.ArrayLike, turns: float = 1.0) -> FloatArray:
    """Stage angles [deg]: given ones, or a number of them from 0 on, evenly over whole turns.

    Raises:
        GeometryError: no views, or an angle that is not finite.
    """
    found: FloatArray = np.asarray(angles, dtype=np.float64)
    if isinstance(angles, int | np.integer):
        found = np.linspace(0.0, FULL_TURN * turns, max(int(angles), 0), endpoint=False)
    if found.ndim != 1 or len(found) == 0 or not np.isfinite(found).all():
        shown = angles if np.ndim(angles) == 0 else f"an array of shape {found.shape}"
        raise GeometryError(
            f"angles: {shown}; allowed: a number of views from 1, or finite angles (n,) [deg]",
            {"asked": repr(angles)[:100], "allowed": "views, or (n,) deg"},
        )
    return found


def _numbers(
    name: str, value: object, count: int, unit: str, *, repeated: bool = False
) -> tuple[float, ...]:
    array = np.asarray(value, dtype=np.float64)
    if array.ndim == 0 and (repeated or count == 1):
        array = np.full(count, array)
    if array.shape != (count,) or not np.isfinite(array).all():
        wanted = "one finite number" if count == 1 else f"{count} finite numbers"
        raise GeometryError(
            f"{name} is {value!r}; allowed: {wanted} [{unit}]",
            {"asked": repr(value)[:100], "allowed": wanted},
        )
    return tuple(array.tolist())
