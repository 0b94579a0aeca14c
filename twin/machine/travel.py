"""One rule for targets beyond a motor's limit, for every kind of command but jogs.

A target beyond the travel by rounding alone is the limit. One beyond it by no more than
the axis's `arrival_tolerance` (the thesis's arrivalThreshold) arrives at the limit, with
a message. For one farther beyond, the machine's `on_limit` decides whether a line of a
script goes to the limit, as at a limit switch, or is an error; a single request is
rejected, since its sender gets the error. Motors of a virtual axis give up the same
share.

Rates have no tolerance, and otherwise the same rule. A jog, which has no target, ends at
the limit (`twin.motion.drives`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, assert_never

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import Machine

POSITION_ROUNDING: Final = 1e-9
"""Largest difference between two positions that counts as rounding [mm or deg that the motor
moves a part]."""
Rate = Literal["speed", "acceleration"]


@dataclass(frozen=True)
class Arrival:
    """Where motors go, or how fast, once the rule for limits has moved what is asked beyond.

    Attributes:
        motors: motor -> target within its travel [mm, deg], or rate.
        messages: messages about what is beyond a limit by more than rounding.
        beyond: error for one that is beyond by more than the tolerance; None: there is
            none.
    """

    motors: Mapping[str, float]
    messages: tuple[str, ...] = ()
    beyond: LimitError | None = None

    def is_clamped(self, machine: Machine) -> bool:
        """Return whether a script's line continues with `motors`; otherwise it is an error."""
        if self.beyond is None:
            return True
        match machine.on_limit:
            case "clamp":
                return True
            case "reject":
                return False
            case _:
                assert_never(machine.on_limit)


def arrival(machine: Machine, axis: str, targets: Mapping[str, float]) -> Arrival:
    """Apply the rule for targets [mm, deg] beyond a limit to a move of `axis`; raise
    nothing.

    Beyond is by more than `POSITION_ROUNDING`; motors of a virtual axis are shortened
    together (`clamp`). Returns targets within the travel, a message for each beyond, and
    the error of the first beyond by more than its axis's `arrival_tolerance`, or None.
    """
    messages = []
    beyond = None
    for motor, target in targets.items():
        left = distance_beyond(machine, motor, target)
        if left <= POSITION_ROUNDING:
            continue
        error = _outside(machine, motor, target)
        messages.append(error.message)
        tolerated = machine.axes[motor].arrival_tolerance / machine.counts(motor)
        if not left <= tolerated + POSITION_ROUNDING:
            beyond = beyond or error
    return Arrival(clamp(machine, targets, axis), tuple(messages), beyond)


def rate(machine: Machine, axis: str, what: Rate, value: float) -> Arrival:
    """Apply the rule to a speed or acceleration of `axis` that may be above its motors'
    maximum; raises nothing.

    A value above by a share of `POSITION_ROUNDING` or less passes; one that is no number
    counts as above. There is no lower limit.

    Args:
        machine: whose motors these are.
        axis: motor or virtual axis.
        what: "speed" or "acceleration".
        value: of the axis [mm or deg, per s or s2]; a motor's is that times the absolute
            value of its share.

    Returns:
        Rates within the maximum, a message for each that is above, and the first one's
        error or None.
    """
    motors = {}
    messages = []
    beyond = None
    for motor, share in machine.moves(axis).items():
        a = machine.axes[motor]
        requested = value * abs(share)
        match what:
            case "speed":
                limit = a.max_speed
                unit = f"{a.unit}/s"
            case "acceleration":
                limit = a.max_acceleration
                unit = f"{a.unit}/s2"
            case _:
                assert_never(what)
        if not requested <= limit * (1.0 + POSITION_ROUNDING):  # as one that is no number
            messages.append(
                f"{motor} {what} {requested:g} {unit} is above {limit:g} {unit}"
            )
            beyond = beyond or LimitError.of_axis(
                messages[-1], motor, requested, limit, unit
            )
        motors[motor] = min(requested, limit)
    return Arrival(motors, tuple(messages), beyond)


def check_target(machine: Machine, axis: str, value: float) -> float:
    """Check that a motor's `value` [mm, deg] is within its travel.

    Within rounding it is the limit. Raises LimitError, UnknownNameError.
    """
    a = machine.axis(axis)
    if not distance_beyond(machine, axis, value) <= POSITION_ROUNDING:
        raise _outside(machine, axis, value)
    return min(max(value, a.lower), a.upper)


def clamp(machine: Machine, targets: Mapping[str, float], axis: str) -> dict[str, float]:
    """Return the targets [mm, deg] of an axis's motors, moved into their travel.

    If a motor of a virtual axis is cut short, all give up the same displacement of the
    axis, the largest that one needs, and are limited again.
    """
    bounded = _bounded(machine, targets)
    if axis in machine.axes or bounded == targets:
        return bounded
    moves = machine.moves(axis)
    back = max(
        ((targets[m] - bounded[m]) / f for m, f in moves.items()), key=abs, default=0.0
    )
    return _bounded(machine, {m: targets[m] - f * back for m, f in moves.items()})


def _bounded(machine: Machine, targets: Mapping[str, float]) -> dict[str, float]:
    """Move each target into its motor's travel, each by itself."""
    axes = machine.axes
    return {m: min(max(t, axes[m].lower), axes[m].upper) for m, t in targets.items()}


def distance_beyond(machine: Machine, motor: str, target: float) -> float:
    """Compute how far beyond travel a target brings the motor's part [mm, deg]; negative
    within it.
    """
    a = machine.axes[motor]
    return max(a.lower - target, target - a.upper) / machine.counts(motor)


def _outside(machine: Machine, motor: str, target: float) -> LimitError:
    """Make the error for a motor's target outside its travel; returned, not raised."""
    a = machine.axes[motor]
    message = f"{motor} target {target:g} {a.unit} is outside [{a.lower:g}, {a.upper:g}] {a.unit}"
    return LimitError.of_axis(message, motor, target, [a.lower, a.upper], a.unit)
