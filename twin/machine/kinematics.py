"""Motor positions to nominal poses: the machine's linear map, the profile's offsets, the ROI.

quantity = sum(factor * motor) + offset, then `Poses`. Positions are in the script's sign
and unit (mm, deg), one number or an array per motor. Corrections are applied later, by
`Poses.cone_vec`.

`place` describes where a machine's motors put source, sample and detector: the terms of a
distance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import (
    COLUMN_DIRECTION,
    COORDINATES,
    ROW_DIRECTION,
    FloatArray,
    turn_detector,
)
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.machine.description import Machine, Profile, unknown_axis
from flexdt.twin.machine.travel import arrival, check_target

_QUANTITY_NAMES: Final = {
    "object_y": "SOD",
    "detector_y": "SDD",
    "source_x": "source to the right",
    "source_z": "source up",
    "object_x": "sample to the right",
    "object_z": "sample up",
    "detector_x": "detector to the right",
    "detector_z": "detector up",
    "angle": "turntable",
    "mount_x": "stage on the turntable, x",
    "mount_y": "stage on the turntable, y",
}
"""Quantity of a machine file -> name for tables."""


def poses(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    positions: Mapping[str, npt.ArrayLike],
) -> Poses:
    """Compute nominal poses for motor positions within travel; see `motor_poses`.

    Rounding beyond passes. Raises UnknownNameError: no such motor; LimitError: a position
    outside.
    """
    for name, values in positions.items():
        for extreme in (np.min(values), np.max(values)) if np.size(values) else ():
            check_target(machine, name, float(extreme))
    return motor_poses(machine, profile, camera, positions)


def motor_poses(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    positions: Mapping[str, npt.ArrayLike],
) -> Poses:
    """Compute nominal poses for motor positions as they were read, without limits.

    The pixel's directions follow the profile's roll only; no correction is applied. The
    detector's place includes the shift of the ROI's center.

    Args:
        machine: whose motors these are.
        profile: zero offsets in force.
        camera: decides pixel pitch and the place of the image's center on the sensor.
        positions: motor -> scalar or (n,) [mm, deg], broadcast together; motors left out
            are at home.

    Returns:
        n poses (n = 1 if every position is a scalar).

    Raises:
        UnknownNameError: a motor the machine does not have.
    """
    for name in positions:
        if name not in machine.axes:
            raise unknown_axis(name, machine)
    stand = [np.atleast_1d(positions.get(n, a.home)) for n, a in machine.axes.items()]
    columns = np.broadcast_arrays(*(np.asarray(x, dtype=np.float64) for x in stand))
    values = dict(zip(machine.axes, columns, strict=True))

    def total(quantity: str) -> FloatArray:
        """Sum up a quantity over its motors and its fixed part, (n,) [mm, deg]; zero
        offsets are not in it.

        A quantity that no motor moves is its fixed part, or zero."""
        out = np.full_like(columns[0], machine.fixed.get(quantity, 0.0))
        for motor, factor in machine.geometry.get(quantity, {}).items():
            out = out + factor * values[motor]
        return out

    def place(anchor: str, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> FloatArray:
        """Compute a place in the world from the motors of `anchor` and `x`, `y`, `z`
        added to it, (n, 3) [mm]."""
        added = zip(COORDINATES, (x, y, z), strict=True)
        return np.stack([total(f"{anchor}_{c}") + more for c, more in added], axis=1)

    column_shift, row_shift = camera.roi_shift_mm(machine.detector.pixels)
    pixel, row_pixel = camera.pixels_mm(machine.detector.pixels)
    u, v = turn_detector(
        np.multiply(COLUMN_DIRECTION, pixel),
        np.multiply(ROW_DIRECTION, row_pixel),
        0.0,
        0.0,
        math.radians(profile.det_roll_deg),
    )
    roi = column_shift * u / pixel + row_shift * v / row_pixel
    return Poses(
        source=place("source", z=profile.src_ort),
        axis=place("object", profile.axs_tan, profile.c_obj, machine.sample_height_mm),
        detector=place("detector", profile.det_tan, profile.c_det) + roi,
        u=u,
        v=v,
        angle=np.radians(total("angle")),
        mount=place("mount"),
    )


def virtual_reading(machine: Machine, name: str, positions: Mapping[str, float]) -> float:
    """Compute the reading of virtual axis `name` [mm] for motor positions."""
    virtual = machine.virtual_axes[name]
    return virtual.constant + virtual.factor * positions[virtual.of]


def resolve_targets(
    machine: Machine,
    targets: Mapping[str, float],
    positions: Mapping[str, float],
    *,
    relative: bool = False,
) -> dict[str, float]:
    """Resolve targets of motors and virtual axes to motor targets within their travel;
    targets beyond it by no more than the tolerance become the limit.

    `twin/machine/travel.py` has the rule for targets beyond a limit. A motor that two
    axes move gets the later one's target; each axis begins at `positions`.

    Args:
        machine: whose axes these are.
        targets: axis -> value [mm, deg], absolute, or a displacement when `relative`.
        positions: motor -> where it is [mm, deg] (or its present target).
        relative: read `targets` as displacements.

    Returns:
        Motor -> target [mm, deg].

    Raises:
        UnknownNameError: no such axis.
        LimitError: a motor would leave its travel by more than its tolerance.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine
        >>> machine = builtin_machine("flexray")
        >>> resolve_targets(machine, {"rot_obj": 10.0}, {"rot_obj": 30.0}, relative=True)
        {'rot_obj': 40.0}
    """
    out: dict[str, float] = {}
    for name, value in targets.items():
        requested = motor_targets(machine, name, value, positions, relative=relative)
        limited = arrival(machine, name, requested)
        if limited.beyond is not None:
            raise _too_far(
                machine, name, value, positions, limited.beyond, relative=relative
            )
        out.update(limited.motors)
    return out


def motor_targets(
    machine: Machine,
    axis: str,
    value: float,
    positions: Mapping[str, float],
    *,
    relative: bool = False,
) -> dict[str, float]:
    """Compute the motor targets [mm, deg] of a move of `axis`, without regard to limits.

    The motors of a virtual axis move by their shares of the displacement; `value` is one
    if `relative`. `positions`: motor -> reading.

    Raises:
        UnknownNameError: no such axis.
    """
    moves = machine.moves(axis)
    if axis in machine.axes:  # exactly, and not a sum that rounds to it
        return {axis: value + positions[axis] if relative else value}
    step = value
    if not relative:
        step = value - virtual_reading(machine, axis, positions)
    return {motor: positions[motor] + factor * step for motor, factor in moves.items()}


def _too_far(
    machine: Machine,
    axis: str,
    value: float,
    positions: Mapping[str, float],
    error: LimitError,
    *,
    relative: bool,
) -> LimitError:
    """Convert a motor's limit error to one of the axis that was to move; returned, not
    raised.

    The range is that of the axis while all its motors stay within their travel, from
    where they are.

    Args:
        machine: with the virtual axis.
        axis: that was to move.
        value: its target, or its step [mm, deg].
        positions: motor -> reading now [mm, deg].
        error: of one of its motors.
        relative: `value` is a step.

    Returns:
        The error with target and range of the virtual axis; `error` itself for a motor.
    """
    if axis in machine.axes:
        return error
    reading = virtual_reading(machine, axis, positions)
    ends = []
    for motor, factor in machine.moves(axis).items():
        a = machine.axes[motor]
        left = (a.lower - positions[motor], a.upper - positions[motor])
        ends.append(sorted(reading + way / factor for way in left))
    low = max(low for low, _ in ends)
    high = min(high for _, high in ends)
    target = reading + value if relative else value
    unit = error.data["unit"]
    message = (
        f"{axis} target {target:g} {unit} is outside [{low:g}, {high:g}] {unit}, "
        f"which is how far its motors go from here: {error}"
    )
    return LimitError.of_axis(message, axis, target, [low, high], str(unit))


@dataclass(frozen=True)
class Place:
    """One quantity of `[geometry]`, without zero offsets.

    Attributes:
        name: in words.
        total: its terms, such as "900 + D".
        least, most, home: its ends over the travel of its motors, and at home [mm, deg].
    """

    name: str
    total: str
    least: float
    most: float
    home: float


def places(machine: Machine) -> list[Place]:
    """List SOD, SDD and the other quantities that motors move or the file fixes.

    SOD and SDD are listed in any case. The order is that of `_QUANTITY_NAMES`.

    Example:
        >>> from flexdt.twin.machine.description import builtin_machine
        >>> places(builtin_machine("xyzr_cabinet"))[0]
        Place(name='SOD', total='Z', least=20.0, most=850.0, home=400.0)"""
    return [
        place(machine, quantity)
        for quantity in _QUANTITY_NAMES
        if machine.geometry.get(quantity)
        or quantity in (*machine.fixed, "object_y", "detector_y")
    ]


def place(machine: Machine, quantity: str) -> Place:
    """Describe one quantity by its name in the machine file.

    The formula is text such as "600 + rot - 2 mag": the fixed part, then a term for each
    motor; "0" if there is neither. The ends are sums over the ends of all motors.
    object_z includes the machine's `sample_height_mm`.

    Args:
        machine: the machine.
        quantity: such as object_y, of `QUANTITIES`.

    Returns:
        Name, formula, and the values at the ends of travel and at home [mm, deg].
    """
    fixed = machine.fixed.get(quantity, 0.0) + (
        machine.sample_height_mm if quantity == "object_z" else 0.0
    )
    words = [f"{fixed:g}"] if fixed else []
    ends = [fixed, fixed]
    home = fixed
    for motor, factor in machine.geometry.get(quantity, {}).items():
        axis = machine.axes[motor]
        both = sorted((factor * axis.lower, factor * axis.upper))
        ends = [a + b for a, b in zip(ends, both, strict=True)]
        home += factor * axis.home
        times = ""
        if abs(factor) != 1.0:
            times = f"{abs(factor):g} "
        if factor < 0:
            sign = "- "
        else:
            sign = "+ " if words else ""
        words.append(f"{sign}{times}{motor}")
    return Place(
        _QUANTITY_NAMES[quantity], " ".join(words) or "0", ends[0], ends[1], home
    )
