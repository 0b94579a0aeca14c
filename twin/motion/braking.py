"""How motors come to rest: along the path they are on together, or each motor by itself.

A programme of several motors is free only as a whole: a motor that brakes by itself while
another drives on leaves the path that was swept. `braked_along` therefore slows the
programme's own time, p(s(t)) with ds/dt from 1 down to 0, so that every position passed
was swept before. `braked_apart` stops every motor as soon as that motor can; it leaves
the path and has to be swept.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from flexdt.twin.machine.description import Machine
from flexdt.twin.machine.travel import POSITION_ROUNDING
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.drives import Drive, Drives
from flexdt.twin.motion.profiles import TIME_ROUNDING_S, Piece, Trajectory

PATH_TOLERANCE = 1e-5
"""Largest distance of the pieces of constant acceleration from the slowed path [mm or deg
that the motor moves a part].

A thousandth of the tolerance of a sweep, so that a swept path stays certified.
"""
MIN_TIME_RATE = 1e-9
"""Rate of programme time below which it counts as stopped."""
VELOCITY_ROUNDING = 1e-6
"""Velocity that counts as rounding [mm/s or deg/s of a part]."""
MIN_CELL_S = 1e-7
"""Shortest piece of programme time [s]."""
MAX_SINGLE_PIECE_S = 1e-4
"""Longest duration of one piece of constant acceleration that stands for two [s]."""
SINGLE_PIECE_STRAY = 1e-9
"""How far it may end from where the path goes on [mm or deg of a part]."""
STEP_TOLERANCE = 1e-9
"""Relative difference of two velocities below which the motors run in step."""

Most = Mapping[str, float] | None
"""Motor -> acceleration that braking may use; None: that of the motion in force."""


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
        """Programme time that the cell covers [s]."""
        return self.length * (self.rate - 0.5 * self.slowing * self.length)


def braked_along(drives: Drives, now: float, most: Most = None) -> dict[str, Trajectory]:
    """Slow everything under way to rest on the path it is on, from `now` [s].

    A motor that brakes with all it may use holds up the common path. `most`: greatest
    accelerations. Deviation: `PATH_TOLERANCE`.
    """
    due = {name: drive for name, drive in drives.items() if drive.end > now}
    cells = _cells(due, now, most)
    return {name: _braked_trajectory(drive, cells, now) for name, drive in due.items()}


def braked_apart(
    machine: Machine, drives: Drives, now: float, most: Most = None
) -> dict[str, Trajectory]:
    """Stop every motor as soon as it can; motors of one virtual axis that move in step
    stay so, and brake as long as the slowest of them.

    A motor with motions left that stands now ends where it is. A stop within
    `POSITION_ROUNDING` of the present target ends exactly there.

    Args:
        machine: defines which motors belong together.
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
            current = drive.at(now)
            takes = seconds[name]
            rest = motion.at_rest(current.position(now), now)
            if takes > 0.0:
                acceleration = abs(velocity[name]) / takes
                rest = motion.stop(
                    current.position(now), velocity[name], acceleration, now
                )
            # It was braking anyway: where it was bound is where it ends, exactly (and not a
            # rounding error beyond its limit).
            near = abs(rest.target - current.target) < POSITION_ROUNDING * drive.counts
            if near:
                out[name] = replace(rest, target=current.target)
            else:
                out[name] = rest
    return out


def coasting(
    machine: Machine, drives: Drives, now: float, decelerations: Mapping[str, float]
) -> dict[str, Trajectory]:
    """Compute motion without power: each motor slows by friction, or ends at its hard
    stop.

    At a hard stop, the limit of its travel, the motor rests at once.

    Args:
        machine: travel limits.
        drives: every motor with all that it is to follow.
        now: when power is cut [s].
        decelerations: motor -> by how much it slows, of each that is under way [mm/s2,
            deg/s2].

    Returns:
        Motor -> trajectory from `now` on, of those that have anything left to do; one
        that stands now rests where it is.
    """
    out = {}
    for name, drive in drives.items():
        if drive.end <= now:
            continue
        current = drive.at(now)
        axis = machine.axes[name]
        free = motion.stop(
            current.position(now), current.velocity(now), decelerations[name], now
        )
        end = min(max(free.target, axis.lower), axis.upper)
        met = None
        if end != free.target:
            met = free.time_at(end)
        if met is not None:
            pieces = tuple(p for p in free.pieces if p.start < met)
            pieces = pieces or motion.at_rest(end, now).pieces
            free = Trajectory(pieces, max(met, now), end)
        out[name] = free
    return out


def programme_time_at_rest(drives: Drives, at: float, most: Most) -> float:
    """Compute the programme time [s] that a stop along the path from `at` reaches.

    It is `at` if nothing moves then.
    """
    due = {name: drive for name, drive in drives.items() if drive.end > at}
    cells = _cells(due, at, most)
    if cells:
        return cells[-1].programme + cells[-1].advance
    return at


def braked_at(
    drives: Drives, at: float, trajectories: Mapping[str, Trajectory], most: Most
) -> dict[str, Drive]:
    """Return drives that follow `trajectories` up to `at` [s] and then brake along their
    path.

    A trajectory replaces all that its motor was to follow; one with nothing left to do is
    not braked. `most`: as for `braked_along`.
    """
    following = {**drives, **{n: drives[n].following(t) for n, t in trajectories.items()}}
    braked = braked_along(following, at, most)
    return {
        name: drive.following(motion.rejoined(drive.ahead(at), at, braked[name]))
        if name in braked
        else drive
        for name, drive in following.items()
    }


def _coupled(machine: Machine, velocity: Mapping[str, float]) -> Iterable[list[str]]:
    """Yield the motors of each virtual axis whose motors move in step now.

    Their velocities [mm/s, deg/s] over their shares agree within `STEP_TOLERANCE` of the
    fastest, not all 0.
    """
    for virtual in machine.virtual_axes.values():
        rates = [velocity.get(name, 0.0) / share for name, share in virtual.moves.items()]
        fastest = max(map(abs, rates))
        if fastest > 0.0 and max(rates) - min(rates) <= STEP_TOLERANCE * fastest:
            yield list(virtual.moves)


def greatest(name: str, leg: Trajectory, time: float, most: Most) -> float:
    """Return the acceleration that a motor may brake with while it follows `leg`."""
    planned = leg.acceleration(time)
    if most is None:
        return planned
    return max(planned, most[name])


def _cells(drives: Drives, now: float, most: Most) -> list[_Cell]:
    """Compute the law of programme time that brings all motors to rest soonest, within
    their accelerations.

    It begins with the programme time `now` at rate 1, and has constant slowing in each
    cell. A cell ends where a motor's acceleration changes. Where a motor accelerates,
    constant slowing is an approximation, in cells so short that it strays by at most
    `PATH_TOLERANCE`. No more cells follow once all are slower than `VELOCITY_ROUNDING`;
    none at all if nothing moves.

    Args:
        drives: motors with something left to do.
        now: start of braking [s].
        most: as for `braked_along`.

    Returns:
        Cells that join up in real and programme time, until the rate is zero or all
        stand.
    """
    cells: list[_Cell] = []
    s = now
    rate = 1.0
    time = now
    while rate > 0.0 and drives:
        states = [_state(name, drive, s, most) for name, drive in drives.items()]
        if max(state.speed_of_part for state in states) < VELOCITY_ROUNDING:
            break
        until = min(state.until for state in states)
        ahead = until - s
        if ahead <= TIME_ROUNDING_S:  # a knot that rounding has put a hair ahead
            step = max(TIME_ROUNDING_S, 4.0 * math.ulp(s))
            s = s + step
            time = time + step
            continue
        roughly = min(state.slowing(rate, 0.0) for state in states)
        # Where a motor accelerates, constant acceleration is an approximation over a
        # short time; it strays by 3 |a| rate slowing length^3 / 324.
        jerk = max(
            3.0 * abs(state.acceleration) / state.counts * rate * roughly
            for state in states
        )
        if jerk > 0.0:
            longest = min((324.0 * PATH_TOLERANCE / jerk) ** (1.0 / 3.0), rate / roughly)
            shorter = longest * (rate - 0.5 * roughly * longest)
            ahead = min(ahead, max(shorter, MIN_CELL_S))
        slowing = min(state.slowing(rate, ahead) for state in states)
        # `ahead` is programme time, which is to the rate what way is to velocity: its square
        # falls by twice the slowing times the way.
        left = rate * rate - 2.0 * slowing * ahead
        ends = left < MIN_TIME_RATE * MIN_TIME_RATE
        following = 0.0 if ends else math.sqrt(left)
        if ends:
            length = rate / slowing
        else:
            length = 2.0 * ahead / (rate + following)
        cell = _Cell(time, s, rate, slowing, length)
        cells.append(cell)
        if ahead == until - s:
            s = until
        else:
            s = s + cell.advance
        rate = following
        time = time + length
    return cells


@dataclass(frozen=True)
class _State:
    """One motor at a moment of programme time, until its acceleration changes."""

    velocity: float
    acceleration: float
    most: float
    until: float
    counts: float

    @property
    def speed_of_part(self) -> float:
        """Speed of its part [mm/s, deg/s]."""
        return abs(self.velocity) / self.counts

    def slowing(self, rate: float, ahead: float) -> float:
        """Compute how fast programme time may slow within the motor's acceleration [1/s].

        The motor's own acceleration counts: braking leaves less for the slowing, speeding
        up more. inf without velocity now and `ahead`.

        Args:
            rate: of programme time at the start, programme seconds a second.
            ahead: programme seconds over which the slowing is constant.
        """
        speed = abs(self.velocity)
        a = abs(self.acceleration)
        if (
            self.velocity * self.acceleration < 0.0
        ):  # it brakes: both are greatest at the start
            return max(0.0, self.most - a * rate * rate) / speed
        fastest = speed + a * ahead
        if fastest == 0.0:
            return math.inf
        # Its own speeding up works against the slowing; least so at the end.
        first = (self.most + a * rate * rate) / fastest
        slowest = max(0.0, rate * rate - 2.0 * first * ahead)
        return (self.most + a * slowest) / fastest


def _state(name: str, drive: Drive, s: float, most: Most) -> _State:
    """Evaluate a motor at programme time `s`, and until when that holds.

    It ends with the piece, at a turn, or at the next trajectory.
    """
    leg = drive.at(s)
    velocity, acceleration, until = leg.law(s)
    return _State(
        velocity,
        acceleration,
        greatest(name, leg, s, most),
        min(until, drive.next_start(s)),
        drive.counts,
    )


def _braked_trajectory(drive: Drive, cells: list[_Cell], now: float) -> Trajectory:
    """Convert the cells to one motor's trajectory from `now` on.

    A motor that does not move in the cells rests at once where it is. Within a cell of
    constant slowing an accelerated motor has two pieces of constant acceleration, or one
    if that is shorter than `MAX_SINGLE_PIECE_S` and ends where the next begins, to
    `SINGLE_PIECE_STRAY`. An end within `POSITION_ROUNDING` of the
    present trajectory's target is set to that.

    Args:
        drive: the motor's programme.
        cells: parts of the braking, in order, with the pace of programme time.
        now: moment of the stop [s].

    Returns:
        The trajectory, which ends at rest.
    """
    pieces: list[Piece] = []
    end = now
    target = drive.at(now).position(now)
    for cell in cells:
        leg = drive.at(cell.programme)
        velocity, acceleration, _ = leg.law(cell.programme)
        if velocity == 0.0 and acceleration == 0.0:
            if pieces and (pieces[-1].velocity != 0.0 or pieces[-1].acceleration != 0.0):
                pieces.append(Piece(end, target, 0.0, 0.0))
            continue
        ds = cell.advance
        left = cell.rate - cell.slowing * cell.length
        x = leg.position(cell.programme)
        v = velocity * cell.rate
        distance = ds * (velocity + 0.5 * acceleration * ds)
        reached = x + distance
        arrives = (velocity + acceleration * ds) * max(0.0, left)
        if not pieces and cell.start > now:
            pieces.append(Piece(now, x, 0.0, 0.0))
        if cell.slowing == 0.0 or acceleration == 0.0:
            rate = acceleration * cell.rate**2 - velocity * cell.slowing
            pieces.append(Piece(cell.start, x, v, rate))
        elif (
            cell.length < MAX_SINGLE_PIECE_S
            and abs(distance - 0.5 * cell.length * (v + arrives))
            < SINGLE_PIECE_STRAY * drive.counts
        ):
            pieces.append(Piece(cell.start, x, v, (arrives - v) / cell.length))
        else:
            # Two halves of constant acceleration that meet position and velocity at both ends.
            length = cell.length
            half = 0.5 * cell.length
            # Not `reached - x`: its rounding, over a short length twice, would put motors that
            # run in step out of it.
            gained = arrives - v
            moved = distance - v * length
            first = 4.0 * moved / length**2 - gained / length
            second = 3.0 * gained / length - 4.0 * moved / length**2
            pieces.append(Piece(cell.start, x, v, first))
            middle = x + half * (v + 0.5 * first * half)
            pieces.append(Piece(cell.start + half, middle, v + first * half, second))
        end = cell.start + cell.length
        target = reached
    while pieces and pieces[-1].velocity == 0.0 and pieces[-1].acceleration == 0.0:
        pieces.pop()
    if not pieces or end == now:
        return motion.at_rest(target, now)
    final = drive.at(now).target
    if abs(target - final) < POSITION_ROUNDING * drive.counts:
        target = final
    return Trajectory(tuple(pieces), end, target)
