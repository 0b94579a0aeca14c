"""Motion of one motor as a closed form of time: pieces of constant acceleration.

A `Trajectory` gives position and velocity at any time; nothing is stepped. Builders make
the trapezoidal profile of thesis 4.5.1 (triangular when short) from any state of motion,
the stop with deceleration, and the jog. Arrival is exact: after the end the position is
the target (the thesis's 1 mm arrival threshold is a simulation artifact). Limits are
checked by the callers. An `AxisPath` is the same as arrays: for sweeps and plans, which
evaluate many moments at once.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.values import ArrayValue

MIN_RATE = 1e-6
"""Least speed and acceleration that can be set [mm or deg per s, per s^2], whatever unit a motor
counts in: a move may be slow, but it ends."""


LATE_S = 1e9
"""Time from which on (31 years) a clock runs no faster than real time [s]: its steps are
0.1 us then, and motion is swept with an allowance for such steps."""
LATEST_MOTION_S = 1e6
"""How long after `LATE_S`, or after a command that is given later, motion may end [s]."""
TIME_ROUNDING_S = 1e-9
"""Largest difference between two times that counts as rounding [s]."""


@dataclass(frozen=True)
class Piece:
    """Constant acceleration from time `start` on: x = x0 + v0 dt + a dt^2 / 2."""

    start: float
    position: float
    velocity: float
    acceleration: float


@dataclass(frozen=True)
class Trajectory:
    """A motor's motion over all time; before the first piece it is at its position.

    Attributes:
        pieces: in time order, at least one.
        end: when the motor comes to rest at `target` [s]; inf for a jog without end.
        target: the position from `end` on, exact.
    """

    pieces: tuple[Piece, ...]
    end: float
    target: float

    @property
    def start(self) -> float:
        """When motion begins [s]."""
        return self.pieces[0].start

    @property
    def duration(self) -> float:
        """Time from start to rest [s]."""
        return self.end - self.start

    @cached_property
    def knots(self) -> tuple[float, ...]:
        """Times at which the acceleration changes [s]: starts of the pieces, and a finite end."""
        times = [p.start for p in self.pieces]
        if math.isfinite(self.end) and self.end > times[-1]:
            times.append(self.end)
        return tuple(times)

    def _piece(self, time: float) -> Piece | None:
        """Return the piece in force, or None at rest (before the start or after the end)."""
        if time >= self.end or time < self.start:
            return None
        return self.pieces[bisect_right(self.knots, time, hi=len(self.pieces)) - 1]

    def position(self, time: float) -> float:
        """Compute the position at `time` [s]: before the motion its start, from its end
        on the target.
        """
        piece = self._piece(time)
        if piece is None:
            if time >= self.end:
                return self.target
            return self.pieces[0].position
        dt = time - piece.start
        return piece.position + dt * (piece.velocity + 0.5 * piece.acceleration * dt)

    def velocity(self, time: float) -> float:
        """Compute the velocity at `time` [s]; 0 before and after the motion."""
        piece = self._piece(time)
        if piece is None:
            return 0.0
        return piece.velocity + piece.acceleration * (time - piece.start)

    def moving(self, time: float) -> bool:
        """Return whether it moves at `time`."""
        return self.start <= time < self.end

    def positions(self, times: npt.ArrayLike) -> FloatArray:
        """Compute positions at many times [s], of the same shape as `times`."""
        return AxisPath.along(self).positions(times)

    def law(self, time: float) -> tuple[float, float, float]:
        """Return velocity and acceleration at `time`, and until when that acceleration
        holds without a change of direction [s].

        Before the start they are 0 until then; after the end 0 until inf. A motor that
        brakes obeys until it turns round; within `TIME_ROUNDING_S` of that its velocity
        is 0.

        Args:
            time: moment [s].
        """
        if time >= self.end:
            return 0.0, 0.0, math.inf
        if time < self.start:
            return 0.0, 0.0, self.start
        index = bisect_right(self.knots, time, hi=len(self.pieces)) - 1
        piece = self.pieces[index]
        if index + 1 < len(self.knots):
            until = self.knots[index + 1]
        else:
            until = self.end
        velocity = piece.velocity + piece.acceleration * (time - piece.start)
        a = piece.acceleration
        if velocity * a < 0.0:
            turns = -velocity / a
            if turns <= TIME_ROUNDING_S:
                return 0.0, a, until
            until = min(until, time + turns)
        return velocity, a, until

    def acceleration(self, time: float) -> float:
        """Return the largest absolute acceleration from `time` on [mm/s2, deg/s2].

        Before the start it is that of the whole motion; after the end 0.
        """
        if time >= self.end:
            return 0.0
        return max(
            abs(p.acceleration)
            for p, stop in zip(self.pieces, (*self.knots[1:], self.end), strict=False)
            if stop > time
        )

    @property
    def top_speed(self) -> float:
        """Largest absolute speed of the motion [mm/s, deg/s]; each piece has it at one of
        its ends.
        """
        ends = zip(
            self.pieces, (*[p.start for p in self.pieces[1:]], self.end), strict=True
        )
        return max(
            max(abs(p.velocity), abs(p.velocity + p.acceleration * (stop - p.start)))
            if p.acceleration
            else abs(p.velocity)
            for p, stop in ends
        )

    def redirected(
        self, target: float, speed: float, acceleration: float, time: float
    ) -> Trajectory:
        """Plan the motion from the state at `time` to rest at `target`; see `move`."""
        return move(
            self.position(time), self.velocity(time), target, speed, acceleration, time
        )

    def shifted(self, dt: float) -> Trajectory:
        """Return the same motion `dt` seconds later; positions and target are unchanged."""
        pieces = tuple(
            Piece(p.start + dt, p.position, p.velocity, p.acceleration)
            for p in self.pieces
        )
        return Trajectory(pieces, self.end + dt, self.target)

    def time_at(self, position: float) -> float | None:
        """Find the first time at which the motor passes `position`, from the start of its
        motion on.

        Rounding counts as passing: a position within 1e-9 of the target, or eight times
        the spacing of numbers there, is passed at the end at the latest.

        Args:
            position: of the motor [mm, deg].

        Returns:
            Time [s]; None if it never does.
        """
        for i, piece in enumerate(self.pieces):
            if i + 1 < len(self.pieces):
                stop = self.pieces[i + 1].start
            else:
                stop = self.end
            dt = _first_root(
                0.5 * piece.acceleration, piece.velocity, piece.position - position
            )
            # Rounding may put the root a hair past the piece that reaches the position exactly.
            if dt is not None and piece.start + dt <= stop + 1e-9 + 4.0 * math.ulp(stop):
                return min(piece.start + dt, stop)
        # A position that rounding puts a hair past the target is the target.
        if abs(position - self.target) <= max(1e-9, 8.0 * math.ulp(self.target)):
            return self.end
        return None


@dataclass(frozen=True, eq=False)
class AxisPath(ArrayValue):
    """One axis over time: constant acceleration from each of `times` on, (k,) arrays.

    Attributes:
        times: starts of the pieces [s], in order; before the first it is at `x[0]`.
        x: positions then [mm, deg].
        v: velocities then, per s.
        a: accelerations from then on, per s^2.
    """

    times: FloatArray
    x: FloatArray
    v: FloatArray
    a: FloatArray

    @classmethod
    def of(
        cls, start: float, trajectories: Sequence[tuple[float, Trajectory]]
    ) -> AxisPath:
        """Join (time, trajectory) in order, after rest at `start` [mm, deg]."""
        return cls.along(joined([at_rest(start), *(later for _, later in trajectories)]))

    @classmethod
    def along(cls, trajectory: Trajectory) -> AxisPath:
        """Convert one trajectory to a table of pieces; after a finite end comes a piece
        at rest at the target.
        """
        rows = [
            (p.start, p.position, p.velocity, p.acceleration) for p in trajectory.pieces
        ]
        if math.isfinite(trajectory.end):
            rows.append((trajectory.end, trajectory.target, 0.0, 0.0))
        return cls(*np.array(rows).T)

    @classmethod
    def standing(cls, position: float) -> AxisPath:
        """Make the path of a motor that does not move."""
        zero = np.zeros(1)
        return cls(zero, np.array([position]), zero, zero)

    def _at(self, times: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], FloatArray]:
        """Find for each of `times` the index of the piece in force, and the time since its start
        [s], of the same shape. Before the path: 0 and 0."""
        t = np.asarray(times, dtype=np.float64)
        index = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, None)
        return index, np.maximum(t - self.times[index], 0.0)

    def positions(self, times: npt.ArrayLike) -> FloatArray:
        """Compute positions at `times` [s], of the same shape; before the path its beginning."""
        i, dt = self._at(times)
        return np.asarray(self.x[i] + dt * (self.v[i] + 0.5 * self.a[i] * dt))

    def velocities(self, times: npt.ArrayLike) -> FloatArray:
        """Compute velocities at `times` [s], of the same shape; before the path that of
        its first piece."""
        i, dt = self._at(times)
        return np.asarray(self.v[i] + self.a[i] * dt)


def at_rest(position: float, time: float = 0.0) -> Trajectory:
    """Make the trajectory of a motor at rest at `position`, from `time` [s] on and
    before.

    Example:
        >>> at_rest(5.0).position(100.0)
        5.0"""
    return Trajectory((Piece(time, position, 0.0, 0.0),), time, position)


def move(
    position: float,
    velocity: float,
    target: float,
    speed: float,
    acceleration: float,
    time: float,
) -> Trajectory:
    """Plan the fastest trapezoidal motion to rest at `target` from any state of motion.

    Velocity is continuous. A motor that is too fast to stop in time, or runs the wrong
    way, brakes to rest first and then comes back; one that is faster than `speed` brakes
    to it first. A short motion is triangular. Positions are not limited here; a motor at
    rest at the target gets a trajectory without duration.

    Args:
        position: where the motor is.
        velocity: how fast it moves now (signed).
        target: where it shall come to rest.
        speed: cruise speed, > 0.
        acceleration: of speeding up and braking, > 0.
        time: now [s].

    Raises:
        ValueError: speed or acceleration is not positive.

    Example:
        >>> m = move(0.0, 0.0, target=10.0, speed=2.0, acceleration=4.0, time=0.0)
        >>> m.end, m.position(m.end)
        (5.5, 10.0)
    """
    require_positive(speed, "speed")
    require_positive(acceleration, "acceleration")
    build = _Builder(time, position, velocity)
    stop_at = position + velocity * abs(velocity) / (2 * acceleration)
    if (target - stop_at) * velocity < 0:
        build.ramp(0.0, acceleration)
    distance = target - build.position
    if distance != 0.0:
        sign = math.copysign(1.0, distance)
        forward = sign * build.velocity
        if forward > speed:
            build.ramp(sign * speed, acceleration)
            forward = speed
        remaining = abs(target - build.position)
        peak = min(speed, math.sqrt(acceleration * remaining + 0.5 * forward * forward))
        peak = max(peak, forward)
        build.ramp(sign * peak, acceleration)
        brake = peak * peak / (2 * acceleration)
        cruise = abs(target - build.position) - brake
        if cruise > 0.0 and peak > 0.0:
            build.coast(cruise / peak)
        build.ramp(0.0, acceleration)
    return build.rest_at(target)


def stop(
    position: float, velocity: float, acceleration: float, time: float
) -> Trajectory:
    """Plan the fastest stop, with constant acceleration; limits of the travel are not
    considered.

    Args:
        position: where the motor is.
        velocity: its speed, signed; 0 gives a trajectory without duration.
        acceleration: of braking, > 0.
        time: now [s].

    Returns:
        The trajectory to rest where the motor gets.

    Raises:
        ValueError: the acceleration is not positive.

    Example:
        >>> s = stop(0.0, velocity=2.0, acceleration=4.0, time=0.0)
        >>> s.end, s.target
        (0.5, 0.5)
    """
    require_positive(acceleration, "acceleration")
    build = _Builder(time, position, velocity)
    build.ramp(0.0, acceleration)
    return build.rest_at(build.position)


def jog(
    position: float,
    velocity: float,
    wanted: float,
    lease: float,
    acceleration: float,
    time: float,
) -> Trajectory:
    """Plan a run at velocity `wanted` (signed) for `lease` seconds, then braking to rest.

    A lease of 0 or less brakes at once; positions are not limited here. If the lease is
    shorter than the ramp, the motor brakes from the velocity reached by then.

    Args:
        position: where the motor is.
        velocity: how fast it moves now, signed.
        wanted: velocity of the run, signed.
        lease: duration of ramp and run [s], before braking.
        acceleration: of ramp and braking, > 0.
        time: now [s].

    Raises:
        ValueError: the acceleration is not positive.

    Example:
        >>> jog(0.0, 0.0, wanted=2.0, lease=1.0, acceleration=4.0, time=0.0).end
        1.5
    """
    require_positive(acceleration, "acceleration")
    build = _Builder(time, position, velocity)
    ramp = abs(wanted - velocity) / acceleration
    if ramp <= lease:
        build.ramp(wanted, acceleration)
        build.coast(lease - ramp)
    elif lease > 0.0:
        gained = math.copysign(acceleration * lease, wanted - velocity)
        build.ramp(velocity + gained, acceleration)
    build.ramp(0.0, acceleration)
    return build.rest_at(build.position)


def rejoined(before: Trajectory, at: float, after: Trajectory) -> Trajectory:
    """Join the part of `before` that begins before time `at`, and `after`, which begins
    at `at`.

    End and target are those of `after`; whether position and velocity agree is not
    checked.

    Example:
        >>> m = move(0.0, 0.0, target=10.0, speed=2.0, acceleration=4.0, time=0.0)
        >>> halt = stop(m.position(3.0), m.velocity(3.0), acceleration=4.0, time=3.0)
        >>> rejoined(m, 3.0, halt).target
        6.0"""
    pieces = tuple(p for p in before.pieces if p.start < at)
    return Trajectory((*pieces, *after.pieces), after.end, after.target)


def continued(trajectory: Trajectory, at: float) -> Trajectory:
    """Return `trajectory` without its part before time `at` [s].

    Up to its start it is returned unchanged; from its end on it is rest at the target
    from `at`.

    Example:
        >>> m = move(0.0, 0.0, target=10.0, speed=2.0, acceleration=4.0, time=0.0)
        >>> continued(m, 3.0).position(4.0) == m.position(4.0)
        True
    """
    if at <= trajectory.start:
        return trajectory
    if at >= trajectory.end:
        return at_rest(trajectory.target, at)
    index = bisect_right([p.start for p in trajectory.pieces], at) - 1
    now = Piece(
        at,
        trajectory.position(at),
        trajectory.velocity(at),
        trajectory.pieces[index].acceleration,
    )
    return Trajectory(
        (now, *trajectory.pieces[index + 1 :]), trajectory.end, trajectory.target
    )


def joined(trajectories: Sequence[Trajectory]) -> Trajectory:
    """Join trajectories, each followed from its start until the next begins; one that
    ends earlier rests until then.

    Args:
        trajectories: at least one, in the order of their starts; each begins where the
            motor is.

    Returns:
        The trajectory, with end and target of the last.

    Example:
        >>> m = move(0.0, 0.0, target=10.0, speed=2.0, acceleration=4.0, time=0.0)
        >>> back = move(10.0, 0.0, target=0.0, speed=2.0, acceleration=4.0, time=6.0)
        >>> joined([m, back]).position(5.5), joined([m, back]).target
        (10.0, 0.0)
    """
    pieces: list[Piece] = []
    for trajectory, later in pairwise(trajectories):
        begins = later.start
        pieces += [
            p for p in trajectory.pieces if p.start < begins
        ]  # or sent elsewhere on its way
        if trajectory.end < begins:
            pieces.append(Piece(trajectory.end, trajectory.target, 0.0, 0.0))
    last = trajectories[-1]
    return Trajectory((*pieces, *last.pieces), last.end, last.target)


def require_positive(value: float, name: str) -> None:
    """Check that `value` is positive and finite; raise ValueError otherwise."""
    if not (math.isfinite(value) and value > 0):
        raise ValueError(f"{name} is {value}; it must be positive and finite")


class _Builder:
    """Collects pieces; used only while a trajectory is being made."""

    def __init__(self, time: float, position: float, velocity: float) -> None:
        """Begin a trajectory without pieces at `time` [s], with position and velocity."""
        self.begin = (time, position, velocity)
        self.time = time
        self.position = position
        self.velocity = velocity
        self.pieces: list[Piece] = []

    def _add(self, dt: float, acceleration: float) -> None:
        """Add a piece of `dt` seconds and move time and position to its end; do nothing
        for `dt` <= 0.

        The velocity stays that of the piece's start: the caller changes it.
        """
        if dt <= 0.0:
            return
        self.pieces.append(Piece(self.time, self.position, self.velocity, acceleration))
        self.position += dt * (self.velocity + 0.5 * acceleration * dt)
        self.time += dt

    def ramp(self, velocity: float, acceleration: float) -> None:
        """Add a change to `velocity` with constant acceleration (> 0); no piece if that is
        the velocity.
        """
        change = velocity - self.velocity
        self._add(abs(change) / acceleration, math.copysign(acceleration, change))
        self.velocity = velocity

    def coast(self, dt: float) -> None:
        """Add `dt` seconds at constant velocity."""
        self._add(dt, 0.0)

    def rest_at(self, target: float) -> Trajectory:
        """Return the trajectory of the pieces, at rest at `target` from the present time
        on; without pieces rest since the beginning.

        Whether the pieces end at `target` is not checked."""
        pieces = self.pieces or [Piece(self.begin[0], target, 0.0, 0.0)]
        return Trajectory(tuple(pieces), self.time, target)


def _first_root(a: float, b: float, c: float) -> float | None:
    """Solve a x^2 + b x + c = 0; return the smallest non-negative finite root, or None if
    there is none.

    A discriminant that is negative by rounding counts as 0. With c = 0 the root is 0,
    whatever the others.

    Args:
        a: quadratic coefficient.
        b: linear coefficient.
        c: constant.
    """
    if c == 0.0:
        return 0.0
    if a == 0.0:
        if b != 0.0 and -c / b >= 0:
            return -c / b
        return None
    discriminant = b * b - 4 * a * c
    if discriminant < 0:
        # A parabola that only just touches (the end of a ramp at the target) may round
        # below zero.
        if discriminant < -1e-12 * b * b - 1e-24:
            return None
        discriminant = 0.0
    q = -0.5 * (b + math.copysign(math.sqrt(discriminant), b))
    roots = [r for r in (q / a, c / q if q != 0.0 else math.inf) if r >= 0]
    finite = [r for r in roots if math.isfinite(r)]
    return min(finite) if finite else None
