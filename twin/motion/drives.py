"""Motion commands as functions of where every motor is: they return new drives
and change nothing.

A `Drive` is one motor: its speed and acceleration settings and the trajectories it
follows. The functions plan moves (several motors at once, coupled virtual axes, retargets
in flight) and jogs so that velocity is continuous and no motor ever passes its limits. A
retarget never uses less acceleration than the motion in force was planned with, so a
setting lowered in flight cannot carry a motor past its end. Obstacles are the subject of
`joining`; how they come to rest, in `braking`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import assert_never

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import Axis, Machine
from flexdt.twin.machine.kinematics import resolve_targets
from flexdt.twin.machine.travel import Rate, rate
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import MIN_RATE, Trajectory


@dataclass(frozen=True)
class Drive:
    """One motor: settings [mm/s or deg/s, per s] and trajectories in the order of their starts.

    The trajectory in force at a time is the last that has begun; several of them are a
    programme (a scan plan) whose later ones begin where the earlier ones end.

    Attributes:
        speed, acceleration: of motions to come.
        trajectories: on the programme's own clock; a programme may have 100 000 of them,
            which take most of a second to shift.
        origin: the time at which that clock shows 0 [s].
        counts: units of the motor that move a part by 1 mm, or turn it by 1 deg; what
            counts as rounding is so many times that of a mm.
    """

    speed: float
    acceleration: float
    trajectories: tuple[Trajectory, ...]
    origin: float = 0.0
    counts: float = 1.0

    @cached_property
    def _starts(self) -> tuple[float, ...]:
        """Starts of the trajectories on the clock of `now` [s]."""
        # Rounded as `shifted` rounds: where one leg ends in motion, the next one has begun.
        return tuple(t.start + self.origin for t in self.trajectories)

    def _index(self, now: float) -> int:
        """Return the index of the trajectory in force at `now`."""
        return max(0, bisect_right(self._starts, now) - 1)

    def at(self, now: float) -> Trajectory:
        """Return the trajectory in force at `now`, in the twin's time [s]: the last that
        has begun, or the first.

        If the programme has another origin the trajectory is shifted; the one shifted
        last is cached.
        """
        index = self._index(now)
        if not self.origin:
            return self.trajectories[index]
        leg = self._latest.get(index)
        if leg is None:
            leg = self.trajectories[index].shifted(self.origin)
            self._latest.clear()
            self._latest[index] = leg
        return leg

    @cached_property
    def _latest(self) -> dict[int, Trajectory]:
        """The leg requested last, by its index, on the clock of `now`."""
        return {}

    def next_start(self, now: float) -> float:
        """Return the start of the trajectory after that of `now`, in the twin's time [s];
        inf without one.
        """
        index = self._index(now) + 1
        if index < len(self._starts):
            return self._starts[index]
        return math.inf

    @property
    def end(self) -> float:
        """Moment of the motor's last rest [s]."""
        return self.trajectories[-1].end + self.origin

    @property
    def final(self) -> float:
        """Position at which it comes to its last rest [mm, deg]."""
        return self.trajectories[-1].target

    def ahead(self, now: float) -> Trajectory:
        """Join the trajectory in force at `now` and all later ones into one, in the
        twin's time [s].

        One that has ended is among them if no later one has begun.
        """
        left = self.trajectories[self._index(now) :]
        if self.origin:
            left = tuple(leg.shifted(self.origin) for leg in left)
        if len(left) == 1:
            return left[0]
        return motion.joined(left)

    def following(self, *trajectories: Trajectory, origin: float = 0.0) -> Drive:
        """Make the same motor follow `trajectories` alone."""
        return replace(self, trajectories=trajectories, origin=origin)


Drives = Mapping[str, Drive]


def clock_left(now: float) -> float:
    """Return how long motion may still take at time `now` [s]."""
    return max(now, motion.LATE_S) + motion.LATEST_MOTION_S - now


def require_time(what: str, end: float, now: float) -> None:
    """Check that a motion ends before the clock does, whose steps would be too coarse.

    `end` [s] may be inf, as of a renewed jog. Raises LimitError: `what` ends more than
    `LATEST_MOTION_S` after `LATE_S` and now.
    """
    last = now + clock_left(now)
    if last < end < math.inf:
        raise LimitError(
            f"{what} would end at {end:.6g} s of the twin's clock, and motion ends by "
            f"{last:.6g} s; a higher speed is quicker, and a twin that is started anew "
            "begins at 0 s",
            {"asked": end, "allowed": [now, last]},
        )


def home(machine: Machine, now: float) -> dict[str, Drive]:
    """Make a drive for each axis, at rest at home since `now` [s], with the axis's rates."""
    return {
        name: Drive(
            a.speed,
            a.acceleration,
            (motion.at_rest(a.home, now),),
            counts=machine.counts(name),
        )
        for name, a in machine.axes.items()
    }


def plan_move(
    machine: Machine,
    drives: Drives,
    targets: Mapping[str, float],
    now: float,
    *,
    relative: bool = False,
    shortest: bool = False,
) -> dict[str, Trajectory]:
    """Plan the motions to `targets` of the motors that these move; all begin `now` [s].

    Motors of a virtual axis get paces in proportion, so that from rest they keep in step;
    acceleration is at least that in force. `relative`: displacements from where motors
    are bound for; `shortest`: rotations to an equivalent angle the shorter way (thesis
    4.5.2), if not relative. Targets are axis -> [mm, deg].
    Raises UnknownNameError: no such axis; LimitError: a target outside travel by more
    than the tolerance, or two of one motor.
    """
    bound = {name: d.at(now).target for name, d in drives.items()}
    _refuse_double(machine, targets)
    motors = resolve_targets(machine, targets, bound, relative=relative)
    if shortest and not relative:
        motors = {
            name: _shortest(machine.axes[name], bound[name], value)
            for name, value in motors.items()
        }
    pace = _paces(machine, drives, targets)
    out = {}
    for name, target in motors.items():
        current = drives[name].at(now)
        speed, acceleration = pace[name]
        acceleration = max(acceleration, current.acceleration(now))
        out[name] = current.redirected(target, speed, acceleration, now)
    return out


def plan_jog(
    machine: Machine,
    drives: Drives,
    axis: str,
    velocity: float,
    lease_s: float,
    now: float,
) -> dict[str, Trajectory]:
    """Plan a jog: run until the lease ends, then brake; or go to a travel limit and stop
    there, if that comes first.

    Motors of a virtual axis brake together, when the first must for its limit.
    Acceleration is at least that of the motion in force.

    Args:
        machine: whose motors these are.
        drives: every motor.
        axis: motor or virtual axis.
        velocity: signed [mm/s, deg/s]; 0 brakes.
        lease_s: how long it runs unless renewed [s], above 0.
        now: time of the command [s].

    Returns:
        Motor -> trajectory, of the motors of `axis`.

    Raises:
        UnknownNameError: no such axis.
        LimitError: a velocity above the motors' `max_speed` or not a finite number; a
            lease that is not positive and finite.
    """
    moves = machine.moves(axis)
    if not (math.isfinite(lease_s) and lease_s > 0):
        what = f"jog lease {lease_s} s must be positive and finite"
        raise LimitError(what, {"asked": str(lease_s), "allowed": "> 0"})
    pace = _paces(machine, drives, {axis: velocity})
    limit, name = min((machine.axes[n].max_speed / abs(f), n) for n, f in moves.items())
    if not abs(velocity) <= limit:
        unit = machine.axes[name].unit
        message = (
            f"jog of {axis} at {velocity:g} {unit}/s: {name} allows {limit:g} {unit}/s"
        )
        raise LimitError.of_axis(message, axis, str(velocity), limit, f"{unit}/s")

    def run(name: str, lease: float) -> Trajectory:
        """Plan a motor's share of a jog: it runs for `lease` [s], then brakes.

        If it would end beyond a limit, it goes to that limit and stops there, whatever
        the lease. Acceleration is at least that of the motion in force.
        """
        axis = machine.axes[name]
        current = drives[name].at(now)
        wanted = velocity * moves[name]
        acceleration = max(pace[name][1], current.acceleration(now))
        here = current.position(now), current.velocity(now)
        free = motion.jog(*here, wanted, lease, acceleration, now)
        if axis.lower <= free.target <= axis.upper:
            return free
        if free.target > axis.upper:
            limit = axis.upper
        else:
            limit = axis.lower
        return current.redirected(limit, max(abs(wanted), 1e-9), acceleration, now)

    # Coupled motors brake together, when the first of them has to brake for its limit.
    lease = lease_s
    for name in moves:
        planned = run(name, lease_s)
        axis_of = machine.axes[name]
        if planned.target in (axis_of.lower, axis_of.upper):
            lease = max(0.0, min(lease, planned.pieces[-1].start - now))
    return {name: run(name, lease) for name in moves}


def least_rate(machine: Machine, axis: str) -> float:
    """Return the least speed, and acceleration, that an axis may be set to [per s, per s2]. It
    is that of its motor that would be the slowest; see `MIN_RATE`."""
    shares = machine.moves(axis).items()
    return max(MIN_RATE * machine.counts(name) / abs(share) for name, share in shares)


def with_settings(
    machine: Machine,
    drives: Drives,
    axis: str,
    speed: float | None = None,
    acceleration: float | None = None,
) -> dict[str, Drive]:
    """Change speed and acceleration of the motors of `axis` for motions to come.

    Motion under way is not changed. A virtual axis is limited by the motor that reaches
    its maximum first; its motors get their shares.

    Args:
        machine: whose motors these are.
        drives: every motor; not changed.
        axis: motor or virtual axis.
        speed: [mm/s, deg/s] of the axis; None keeps it.
        acceleration: [mm/s2, deg/s2] of the axis; None keeps it.

    Returns:
        Motor -> drive, of all motors.

    Raises:
        UnknownNameError: no such axis.
        LimitError: not from `least_rate` to the maximum; axis, setting,
            value and range.
    """
    out = dict(drives)
    shares = {name: abs(factor) for name, factor in machine.moves(axis).items()}
    low = least_rate(machine, axis)
    settings: tuple[tuple[Rate, float | None], ...] = (
        ("speed", speed),
        ("acceleration", acceleration),
    )
    for quantity, value in settings:
        if value is None:
            continue
        above = rate(machine, axis, quantity, value).messages
        if not above and value >= low:
            continue
        axes = machine.axes
        high = min(
            getattr(axes[name], f"max_{quantity}") / share
            for name, share in shares.items()
        )
        raise LimitError(
            f"{axis} {quantity} {value:g} is outside [{low:g}, {high:g}]",
            {"axis": axis, "setting": quantity, "asked": value, "allowed": [low, high]},
        )
    for name, share in shares.items():
        drive = drives[name]
        most = machine.axes[name]
        out[name] = replace(
            drive,
            speed=drive.speed if speed is None else min(speed * share, most.max_speed),
            acceleration=(
                drive.acceleration
                if acceleration is None
                else min(acceleration * share, most.max_acceleration)
            ),
        )
    return out


def _refuse_double(machine: Machine, targets: Mapping[str, float]) -> None:
    """Raise LimitError if two of `targets` move the same motor, such as a motor and a
    virtual axis of it.

    UnknownNameError for an axis that the machine does not have.
    """
    seen: dict[str, str] = {}
    for name in targets:
        for motor in machine.moves(name):
            if motor in seen:
                message = (
                    f"{motor} is asked to move twice: by {seen[motor]} and by {name}"
                )
                raise LimitError(message, {"axis": motor, "asked": [seen[motor], name]})
            seen[motor] = name


def _paces(
    machine: Machine, drives: Drives, targets: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Compute motor -> (speed, acceleration) for the motors of the axes of `targets`,
    from the drives' settings [mm/s, deg/s; per s2].

    Motors of a virtual axis run in step: the least speed and the least acceleration per
    share determine all. Values of `targets` are not used.
    """
    out: dict[str, tuple[float, float]] = {}
    for name in targets:
        moves = {m: abs(f) for m, f in machine.moves(name).items()}
        speed = min(drives[m].speed / f for m, f in moves.items())
        acceleration = min(drives[m].acceleration / f for m, f in moves.items())
        out.update({m: (speed * f, acceleration * f) for m, f in moves.items()})
    return out


def _shortest(axis: Axis, position: float, target: float) -> float:
    """Find the angle equivalent to `target` nearest to `position` in travel [deg].

    A linear axis' target stays.
    """
    match axis.kind:
        case "linear":
            return target
        case "rotation":
            return _shortest_turn(axis, position, target)
        case _:
            assert_never(axis.kind)


def _shortest_turn(axis: Axis, position: float, target: float) -> float:
    """Find that angle for a rotation axis (`_shortest`)."""
    turns = round((position - target) / 360.0)
    # The nearest may be past the travel's end: then the next one inwards is the shortest
    # allowed.
    candidates = [target + 360.0 * (turns + more) for more in (0, -1, 1)]
    allowed = [c for c in candidates if axis.lower <= c <= axis.upper]
    if allowed:
        return min(allowed, key=lambda c: abs(c - position))
    return target
