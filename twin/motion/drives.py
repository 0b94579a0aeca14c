"""Motion commands as functions of where every motor is: they return new drives and change nothing.

A `Drive` is one motor: its speed and acceleration settings and the trajectories it follows. The
functions plan moves (several motors at once, coupled virtual axes, retargets in flight) and jogs so
that velocity is continuous and no motor ever passes its limits. A retarget never uses less
acceleration than the motion in force was planned with, so a setting lowered in flight cannot carry
a motor past its end. What stands in their way is in `joining`.

Motors come to rest along the path they are on together, or each motor by itself. A programme of
several motors is free only as a whole: a motor that brakes by itself while another drives on leaves
the path that was swept. `braked_along` therefore slows the programme's own time, p(s(t)) with ds/dt
from 1 down to 0, so that every position passed was swept before. `braked_apart` stops every motor
as soon as that motor can; it leaves the path and has to be swept.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import Axis, Machine
from flexdt.twin.machine.kinematics import resolve_targets
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import LEAST_RATE, ROUNDING, Piece, Trajectory

SAME_PLACE = 1e-9
"""Difference between two positions that is rounding [mm, deg]."""


@dataclass(frozen=True)
class Drive:
    """One motor: settings [mm/s or deg/s, per s] and trajectories in the order of their starts.

    The trajectory in force at a time is the last that has begun; several of them are a programme
    (a scan plan) whose later ones begin where the earlier ones end.

    Attributes:
        speed, acceleration: of motions to come.
        trajectories: on the programme's own clock; a programme may have 100 000 of them, which
            take most of a second to shift.
        origin: the time at which that clock shows 0 [s].
    """

    speed: float
    acceleration: float
    trajectories: tuple[Trajectory, ...]
    origin: float = 0.0

    @cached_property
    def _starts(self) -> tuple[float, ...]:
        # Rounded as `shifted` rounds: where one leg ends in motion, the next one has begun.
        return tuple(t.start + self.origin for t in self.trajectories)

    def _index(self, now: float) -> int:
        return max(0, bisect_right(self._starts, now) - 1)

    def at(self, now: float) -> Trajectory:
        """The trajectory in force at `now` [s]."""
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
        """The leg that was asked for last, by its index, on the clock of `now`."""
        return {}

    def next_start(self, now: float) -> float:
        """When the trajectory after the one in force begins [s]; inf if there is none."""
        index = self._index(now) + 1
        return self._starts[index] if index < len(self._starts) else math.inf

    @property
    def end(self) -> float:
        """When the motor comes to its last rest [s]."""
        return self.trajectories[-1].end + self.origin

    @property
    def final(self) -> float:
        """Where it comes to its last rest [mm, deg]."""
        return self.trajectories[-1].target

    def ahead(self, now: float) -> Trajectory:
        """All that it is to follow from `now` on, as one trajectory."""
        left = self.trajectories[self._index(now) :]
        if self.origin:
            left = tuple(leg.shifted(self.origin) for leg in left)
        return left[0] if len(left) == 1 else motion.joined(left)

    def following(self, *trajectories: Trajectory, origin: float = 0.0) -> Drive:
        """The same motor on `trajectories` alone."""
        return replace(self, trajectories=trajectories, origin=origin)


Drives = Mapping[str, Drive]


def home(machine: Machine, now: float) -> dict[str, Drive]:
    """Every motor at rest at its home position, with the machine's speed and acceleration."""
    return {
        name: Drive(a.speed, a.acceleration, (motion.at_rest(a.home, now),))
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
    """Trajectories of the motors that `targets` moves; all begin now.

    Args:
        machine: whose motors these are.
        drives: every motor.
        targets: axis (motor or virtual) -> position [mm, deg].
        now: time of the command [s].
        relative: targets are displacements from where the motors are bound for.
        shortest: rotations go the shorter way round to an equivalent angle (thesis 4.5.2).

    Raises:
        UnknownNameError: no such axis.
        LimitError: a target outside its travel, or one motor asked twice.
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
    machine: Machine, drives: Drives, axis: str, velocity: float, lease_s: float, now: float
) -> dict[str, Trajectory]:
    """Trajectories of a jog: run until the lease ends, brake; brake in time for a travel limit.

    Args:
        machine: whose motors these are.
        drives: every motor.
        axis: motor or virtual axis.
        velocity: signed [mm/s, deg/s]; 0 brakes.
        lease_s: how long it runs unless renewed [s].
        now: time of the command [s].

    Raises:
        UnknownNameError: no such axis.
        LimitError: faster than the motor allows, or not a finite number.
    """
    moves = machine.moves(axis)
    if not (math.isfinite(lease_s) and lease_s > 0):
        what = f"jog lease {lease_s} s must be positive and finite"
        raise LimitError(what, {"asked": str(lease_s), "allowed": "> 0"})
    pace = _paces(machine, drives, {axis: velocity})
    limit, name = min((machine.axes[n].max_speed / abs(f), n) for n, f in moves.items())
    if not abs(velocity) <= limit:
        unit = machine.axes[name].unit
        raise LimitError(
            f"jog of {axis} at {velocity:g} {unit}/s: {name} allows {limit:g} {unit}/s",
            {"axis": axis, "asked": str(velocity), "allowed": limit, "unit": f"{unit}/s"},
        )

    def run(name: str, lease: float) -> Trajectory:
        """A motor's share: it runs for `lease` [s], or as far as its limit."""
        axis, current = machine.axes[name], drives[name].at(now)
        wanted = velocity * moves[name]
        acceleration = max(pace[name][1], current.acceleration(now))
        here = current.position(now), current.velocity(now)
        free = motion.jog(*here, wanted, lease, acceleration, now)
        if axis.lower <= free.target <= axis.upper:
            return free
        limit = axis.upper if free.target > axis.upper else axis.lower
        return current.redirected(limit, max(abs(wanted), 1e-9), acceleration, now)

    # Coupled motors brake together, when the first of them has to brake for its limit.
    lease = lease_s
    for name in moves:
        planned, axis_of = run(name, lease_s), machine.axes[name]
        if planned.target in (axis_of.lower, axis_of.upper):
            lease = max(0.0, min(lease, planned.pieces[-1].start - now))
    return {name: run(name, lease) for name in moves}


def with_settings(
    machine: Machine,
    drives: Drives,
    axis: str,
    speed: float | None = None,
    acceleration: float | None = None,
) -> dict[str, Drive]:
    """Drives with other settings for the motors of `axis`; they hold from the next motion on.

    Raises:
        UnknownNameError: no such axis.
        LimitError: not within (0, maximum].
    """
    out = dict(drives)
    shares = {name: abs(factor) for name, factor in machine.moves(axis).items()}
    for what, value in (("speed", speed), ("acceleration", acceleration)):
        most = {name: getattr(machine.axes[name], f"max_{what}") for name in shares}
        if value is None or all(LEAST_RATE <= value * s <= most[n] for n, s in shares.items()):
            continue
        low = LEAST_RATE / min(shares.values())
        high = min(most[name] / share for name, share in shares.items())
        raise LimitError(
            f"{axis} {what} {value:g} is outside [{low:g}, {high:g}]",
            {"axis": axis, "setting": what, "asked": value, "allowed": [low, high]},
        )
    for name, share in shares.items():
        drive = drives[name]
        out[name] = replace(
            drive,
            speed=drive.speed if speed is None else speed * share,
            acceleration=drive.acceleration if acceleration is None else acceleration * share,
        )
    return out


def _refuse_double(machine: Machine, targets: Mapping[str, float]) -> None:
    seen: dict[str, str] = {}
    for name in targets:
        for motor in machine.moves(name):
            if motor in seen:
                what = f"{motor} is asked to move twice: by {seen[motor]} and by {name}"
                raise LimitError(what, {"axis": motor, "asked": [seen[motor], name]})
            seen[motor] = name


def _paces(
    machine: Machine, drives: Drives, targets: Mapping[str, float]
) -> dict[str, tuple[float, float]]:
    """Speed and acceleration of every motor; those of one axis run in step."""
    out: dict[str, tuple[float, float]] = {}
    for name in targets:
        moves = {m: abs(f) for m, f in machine.moves(name).items()}
        speed = min(drives[m].speed / f for m, f in moves.items())
        acceleration = min(drives[m].acceleration / f for m, f in moves.items())
        out.update({m: (speed * f, acceleration * f) for m, f in moves.items()})
    return out


def _shortest(axis: Axis, position: float, target: float) -> float:
    """The angle equivalent to `target` that is nearest to `position` and within travel."""
    if axis.kind != "rotation":
        return target
    turns = round((position - target) / 360.0)
    # The nearest may lie past the travel's end: then the next one inwards is the shortest allowed.
    candidates = [target + 360.0 * (turns + more) for more in (0, -1, 1)]
    allowed = [c for c in candidates if axis.lower <= c <= axis.upper]
    return min(allowed, key=lambda c: abs(c - position)) if allowed else target


PATH_ERROR = 1e-5
"""How far the pieces of constant acceleration may stray from the path that is slowed [mm, deg].

A thousandth of the tolerance of a sweep, so that what was swept stays certified."""
AT_REST = 1e-9
"""Programme time that passes at less than this rate stands still."""
STILL = 1e-6
"""A velocity that is rounding [mm/s, deg/s]."""
LEAST_S = 1e-7
"""Programme time is not cut finer than this [s]."""
SHORT_S = 1e-4
"""Over less than this one piece of constant acceleration strays by less than rounding [s]."""
IN_STEP = 1e-9
"""Relative difference of two velocities that is rounding: such motors run in step."""

Most = Mapping[str, float] | None
"""Motor -> acceleration that braking may use; None: what the motion in force was planned with."""


@dataclass(frozen=True)
class _Cell:
    """Programme time over a span of real time: s = s0 + rate t - slowing t^2 / 2.

    Attributes:
        start: real time [s].
        programme: programme time at the start [s].
        rate: ds/dt at the start, in (0, 1].
        slowing: -d2s/dt2 >= 0 [1/s].
        length: real seconds.
    """

    start: float
    programme: float
    rate: float
    slowing: float
    length: float

    @property
    def advance(self) -> float:
        """Programme seconds that it covers."""
        return self.length * (self.rate - 0.5 * self.slowing * self.length)


def braked_along(drives: Drives, now: float, most: Most = None) -> dict[str, Trajectory]:
    """Trajectories that slow everything under way to rest on the path it is on.

    The motors keep their common path and pass it ever more slowly. While a motor brakes with all
    it may use, the programme's time cannot slow, so that this may take longer than stopping each
    motor by itself.

    Args:
        drives: every motor with all that it is to follow.
        now: from when on [s].
        most: motor -> greatest acceleration, not below the one in force [mm/s2, deg/s2].

    Returns:
        Motor -> trajectory, of those that had anything left to do. Positions stray from the path
        by at most `PATH_ERROR`.
    """
    due = {name: drive for name, drive in drives.items() if drive.end > now}
    cells = _cells(due, now, most)
    return {name: _along(drive, cells, now) for name, drive in due.items()}


def braked_apart(
    machine: Machine, drives: Drives, now: float, most: Most = None
) -> dict[str, Trajectory]:
    """Trajectories that stop every motor as soon as it can; motors of one virtual axis in step.

    Args:
        machine: says which motors belong together.
        drives: every motor with all that it is to follow.
        now: from when on [s].
        most: as for `braked_along`.

    Returns:
        Motor -> trajectory, of those that had anything left to do.
    """
    velocity = {name: drive.at(now).velocity(now) for name, drive in drives.items()}
    seconds = {
        name: abs(v) / greatest(name, drives[name].at(now), now, most) if v else 0.0
        for name, v in velocity.items()
    }
    for together in _coupled(machine, velocity):
        slowest = max(seconds[name] for name in together)
        seconds.update(dict.fromkeys(together, slowest))
    out = {}
    for name, drive in drives.items():
        if drive.end > now:
            current, takes = drive.at(now), seconds[name]
            rest = motion.at_rest(current.position(now), now)
            if takes > 0.0:
                acceleration = abs(velocity[name]) / takes
                rest = motion.stop(current.position(now), velocity[name], acceleration, now)
            # It was braking anyway: where it was bound is where it ends, exactly (and not a
            # rounding error beyond its limit).
            near = abs(rest.target - current.target) < SAME_PLACE
            out[name] = replace(rest, target=current.target) if near else rest
    return out


def coasting(
    machine: Machine, drives: Drives, now: float, decelerations: Mapping[str, float]
) -> dict[str, Trajectory]:
    """Trajectories of motors without power: each slows by friction, or ends at its hard stop.

    Args:
        machine: travel limits.
        drives: every motor with all that it is to follow.
        now: when power is cut [s].
        decelerations: motor -> by how much it slows [mm/s2, deg/s2].
    """
    out = {}
    for name, drive in drives.items():
        if drive.end <= now:
            continue
        current, axis = drive.at(now), machine.axes[name]
        free = motion.stop(current.position(now), current.velocity(now), decelerations[name], now)
        end = min(max(free.target, axis.lower), axis.upper)
        met = None if end == free.target else free.time_at(end)
        if met is not None:
            pieces = tuple(p for p in free.pieces if p.start < met)
            pieces = pieces or motion.at_rest(end, now).pieces
            free = Trajectory(pieces, max(met, now), end)
        out[name] = free
    return out


def programme_time_at_rest(drives: Drives, at: float, most: Most) -> float:
    """The programme's own time [s] at which a stop along its path, begun at `at`, has ended."""
    due = {name: drive for name, drive in drives.items() if drive.end > at}
    cells = _cells(due, at, most)
    return cells[-1].programme + cells[-1].advance if cells else at


def braked_at(
    drives: Drives, at: float, trajectories: Mapping[str, Trajectory], most: Most
) -> dict[str, Drive]:
    """`drives` that follow `trajectories`, and are braked along their path from `at` on."""
    following = {**drives, **{n: drives[n].following(t) for n, t in trajectories.items()}}
    braked = braked_along(following, at, most)
    return {
        name: drive.following(motion.rejoined(drive.ahead(at), at, braked[name]))
        if name in braked
        else drive
        for name, drive in following.items()
    }


def _coupled(machine: Machine, velocity: Mapping[str, float]) -> Iterable[list[str]]:
    """Motors of a virtual axis that run in step now, so that they have to stop in step."""
    for virtual in machine.virtual_axes.values():
        rates = [velocity.get(name, 0.0) / share for name, share in virtual.moves.items()]
        fastest = max(map(abs, rates))
        if fastest > 0.0 and max(rates) - min(rates) <= IN_STEP * fastest:
            yield list(virtual.moves)


def greatest(name: str, leg: Trajectory, time: float, most: Most) -> float:
    """The acceleration that a motor may brake with while it follows `leg` [mm/s2, deg/s2]."""
    planned = leg.acceleration(time)
    return planned if most is None else max(planned, most[name])


def _cells(drives: Drives, now: float, most: Most) -> list[_Cell]:
    """The law of programme time that brings all motors to rest soonest, within the limits."""
    cells: list[_Cell] = []
    s, rate, time = now, 1.0, now
    while rate > 0.0 and drives:
        states = [_state(name, drive, s, most) for name, drive in drives.items()]
        if max(abs(state.velocity) for state in states) < STILL:
            break
        until = min(state.until for state in states)
        ahead = until - s
        if ahead <= ROUNDING:  # a knot that rounding has put a hair ahead
            step = max(ROUNDING, 4.0 * math.ulp(s))
            s, time = s + step, time + step
            continue
        roughly = min(state.slowing(rate, 0.0) for state in states)
        # Where a motor accelerates, constant acceleration is an approximation over a short time;
        # it strays by 3 |a| rate slowing length^3 / 324.
        jerk = max(3.0 * abs(state.acceleration) * rate * roughly for state in states)
        if jerk > 0.0:
            longest = min((324.0 * PATH_ERROR / jerk) ** (1.0 / 3.0), rate / roughly)
            shorter = longest * (rate - 0.5 * roughly * longest)
            ahead = min(ahead, max(shorter, LEAST_S))
        slowing = min(state.slowing(rate, ahead) for state in states)
        left = rate * rate - 2.0 * slowing * ahead
        ends = left < AT_REST * AT_REST
        following = 0.0 if ends else math.sqrt(left)
        length = rate / slowing if ends else 2.0 * ahead / (rate + following)
        cell = _Cell(time, s, rate, slowing, length)
        cells.append(cell)
        s = until if ahead == until - s else s + cell.advance
        rate, time = following, time + length
    return cells


@dataclass(frozen=True)
class _State:
    """One motor at a moment of programme time, until its acceleration changes."""

    velocity: float
    acceleration: float
    most: float
    until: float

    def slowing(self, rate: float, ahead: float) -> float:
        """How much programme time may slow over the next `ahead` programme seconds [1/s]."""
        speed, a = abs(self.velocity), abs(self.acceleration)
        if self.velocity * self.acceleration < 0.0:  # it brakes: both are greatest at the start
            return max(0.0, self.most - a * rate * rate) / speed
        fastest = speed + a * ahead
        if fastest == 0.0:
            return math.inf
        # Its own speeding up works against the slowing; least so at the end.
        first = (self.most + a * rate * rate) / fastest
        slowest = max(0.0, rate * rate - 2.0 * first * ahead)
        return (self.most + a * slowest) / fastest


def _state(name: str, drive: Drive, s: float, most: Most) -> _State:
    leg = drive.at(s)
    velocity, acceleration, until = leg.law(s)
    return _State(
        velocity, acceleration, greatest(name, leg, s, most), min(until, drive.next_start(s))
    )


def _along(drive: Drive, cells: list[_Cell], now: float) -> Trajectory:
    """One motor's way through the cells."""
    pieces: list[Piece] = []
    end, target = now, drive.at(now).position(now)
    for cell in cells:
        leg = drive.at(cell.programme)
        velocity, acceleration, _ = leg.law(cell.programme)
        if velocity == 0.0 and acceleration == 0.0:
            if pieces and (pieces[-1].velocity != 0.0 or pieces[-1].acceleration != 0.0):
                pieces.append(Piece(end, target, 0.0, 0.0))
            continue
        ds, left = cell.advance, cell.rate - cell.slowing * cell.length
        x = leg.position(cell.programme)
        v = velocity * cell.rate
        gone = ds * (velocity + 0.5 * acceleration * ds)
        reached = x + gone
        arrives = (velocity + acceleration * ds) * max(0.0, left)
        if not pieces and cell.start > now:
            pieces.append(Piece(now, x, 0.0, 0.0))
        if cell.slowing == 0.0 or acceleration == 0.0:
            rate = acceleration * cell.rate**2 - velocity * cell.slowing
            pieces.append(Piece(cell.start, x, v, rate))
        elif cell.length < SHORT_S:
            pieces.append(Piece(cell.start, x, v, (arrives - v) / cell.length))
        else:
            # Two halves of constant acceleration that meet position and velocity at both ends.
            length, half = cell.length, 0.5 * cell.length
            # Not `reached - x`: its rounding, over a short length twice, would put motors that run
            # in step out of it.
            gained, moved = arrives - v, gone - v * length
            first = 4.0 * moved / length**2 - gained / length
            second = 3.0 * gained / length - 4.0 * moved / length**2
            pieces.append(Piece(cell.start, x, v, first))
            middle = x + half * (v + 0.5 * first * half)
            pieces.append(Piece(cell.start + half, middle, v + first * half, second))
        end, target = cell.start + cell.length, reached
    while pieces and pieces[-1].velocity == 0.0 and pieces[-1].acceleration == 0.0:
        pieces.pop()
    if not pieces or end == now:
        return motion.at_rest(target, now)
    final = drive.at(now).target
    return Trajectory(tuple(pieces), end, final if abs(target - final) < SAME_PLACE else target)
