"""The motion of one body relative to another along a path, and how far it is proved safe.

Conservative advancement in path length: from a certified gap d across the direction n,
the gap at a later time is at least d + n . (displacement) - (approach by turning), a
quadratic in each segment of the path. `next_at` finds the first time at which that bound
has fallen to a level; no contact can occur before it, so none is ever stepped over. For
pure translations the bound is exact along n, so that grazing costs one evaluation.

A path is all motors over an interval of time, cut where any of them changes its
acceleration. Within a segment every motor has constant acceleration and does not reverse,
so its displacement is one quadratic.

`sweep_pair` finds the first contact and the least clearance of one pair of bodies along
their relative motion. It advances from certified gap to certified gap, so motion that
counts as free keeps the margin everywhere, not only where it was evaluated: clearance >=
margin along everything before the reported contact. A contact is reported where the
certified gap is within `tolerance` of the margin. A pair that is as near as that when a
motion begins keeps to its floor instead (`twin.scanner.safety.floor`), which depends on
the gap alone, so that no number of motions wears it down.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.separation import Separation
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.motion.profiles import AxisPath
from flexdt.twin.scanner.safety import ROUNDING_MM, floor

JUMP_TOLERANCE = 1e-6
"""Largest jump of a motor between two pieces that counts as rounding [mm or deg that it moves
a part]."""


TIME_ROUNDING_SPACINGS = 8.0
"""Rounding of a time, in units of its floating-point spacing."""
MIN_SEGMENT_S = 1e-9
"""Shortest segment that begins where a motor reverses [s]."""
Separate = Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]
"""The certified clearance of two solids: from b's origin to a's, orientations of a and b."""
Kept = slice | npt.NDArray[np.intp]
"""Selection of a path's segments."""


@dataclass(frozen=True, eq=False)
class Path:
    """Positions of every motor over time.

    Attributes:
        axes: names of the motors, in the order of the columns.
        times: (n + 1,) ends of the segments [s].
        q: (n + 1, axes) positions there [mm, deg].
        v: (n, axes) velocities at the start of each segment.
        a: (n, axes) accelerations in each segment.
    """

    axes: tuple[str, ...]
    times: FloatArray
    q: FloatArray
    v: FloatArray
    a: FloatArray

    def vectors(self, times: FloatArray) -> FloatArray:
        """Compute positions at `times` (n,) [s]: (n, axes) [mm, deg]; times outside the
        path get its ends.
        """
        i = np.clip(
            np.searchsorted(self.times, times, side="right") - 1, 0, len(self.v) - 1
        )
        dt = np.clip(times - self.times[i], 0.0, self.times[i + 1] - self.times[i])[
            :, None
        ]
        at = self.q[i] + dt * (self.v[i] + 0.5 * dt * self.a[i])
        return np.where((times >= self.times[-1])[:, None], self.q[-1], at)

    def positions(self, time: float) -> dict[str, float]:
        """Compute motor -> position at `time` within the path [mm, deg]."""
        return dict(
            zip(self.axes, self.vectors(np.array([time]))[0].tolist(), strict=True)
        )

    def after(self, time: float) -> Path:
        """Return the rest of the path from `time` [s] on, which is within the path and
        before its end.
        """
        later = self.times > time
        first = max(0, int(np.argmax(later)) - 1)
        dt = time - self.times[first]
        v = self.v[first:].copy()
        v[0] = v[0] + dt * self.a[first]
        q = np.concatenate([self.vectors(np.array([time])), self.q[first + 1 :]])
        times = np.concatenate([[time], self.times[first + 1 :]])
        return Path(self.axes, times, q, v, self.a[first:])

    @property
    def moving(self) -> npt.NDArray[np.bool_]:
        """(axes,) whether each motor has a velocity or acceleration in any segment."""
        moving: npt.NDArray[np.bool_] = (
            np.abs(self.v).sum(axis=0) + np.abs(self.a).sum(axis=0) > 0
        )
        return moving


def path_of(
    axes: Sequence[str],
    tables: Mapping[str, AxisPath],
    start: float,
    end: float,
    counts: npt.ArrayLike = 1.0,
) -> Path:
    """Make the path of `axes` from `start` to `end`, cut wherever a motor changes its
    law.

    Cuts are where a motor changes its acceleration or reverses. Motors that stand have
    zero rates. There is at least one segment, of no length if `end` is not later.

    Args:
        axes: names of the motors, in the order of the columns.
        tables: motor -> its path; it rests before the beginning.
        start: of the path [s].
        end: of the path [s].
        counts: units of each motor that move a part by 1 mm or 1 deg, (axes,).

    Raises:
        KeyError: a motor has no table.
        ValueError: a motor jumps by more than `JUMP_TOLERANCE` and the rounding of the
            times; a sweep over it would prove nothing.
    """
    moving = [
        (column, name, tables[name])
        for column, name in enumerate(axes)
        if not _stands(tables[name])
    ]
    cuts = [np.array([start, max(start, end)])]
    for _, _, table in moving:
        cuts += [table.times, _turning_times(table)]
    times = np.unique(np.concatenate(cuts))
    times = times[(times >= start) & (times <= end)]
    if len(times) < 2:
        times = np.array([start, start])
    begin = times[:-1]
    length = np.diff(times)
    jumpy = JUMP_TOLERANCE * np.broadcast_to(counts, len(axes))
    q = np.tile([float(tables[name].x[0]) for name in axes], (len(times), 1))
    v, a = np.zeros((2, len(begin), len(axes)))
    for column, name, table in moving:
        x0, v0, a0 = _state(table, begin)
        arrives = x0 + length * (v0 + 0.5 * a0 * length)
        # The times themselves are rounded, also those of a programme that is slowed: its
        # places are off by the distance that the motor moves in that time. A clock that
        # is late has coarse ones.
        rounding = coarseness(begin[1:]) * float(np.abs(table.v).max())
        jumps = np.abs(arrives[:-1] - x0[1:]) > jumpy[column] + rounding
        if jumps.any():
            where = int(np.argmax(jumps))
            raise ValueError(
                f"{name} jumps from {arrives[where]:g} to {x0[where + 1]:g} at "
                f"{times[where + 1]:g} s; a path must be continuous"
            )
        q[:-1, column], q[-1, column], v[:, column], a[:, column] = (
            x0,
            arrives[-1],
            v0,
            a0,
        )
    return Path(tuple(axes), times, q, v, a)


def coarseness(times: FloatArray) -> FloatArray:
    """Compute how far times of that size may be off by rounding [s]."""
    return TIME_ROUNDING_SPACINGS * np.asarray(np.spacing(np.abs(times)))


def _stands(table: AxisPath) -> bool:
    """Return whether a motor never moves."""
    return not (table.v.any() or table.a.any() or (table.x != table.x[0]).any())


def _state(
    table: AxisPath, times: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute position, velocity and acceleration of a motor from each of `times` on,
    (n,) each.

    Before the table's beginning the motor rests at its first position.
    """
    i = table.times.searchsorted(times, side="right") - 1
    before, i = i < 0, np.maximum(i, 0)  # it is at rest there
    dt, v0, a0 = np.where(before, 0.0, (times - table.times[i], table.v[i], table.a[i]))
    gained = a0 * dt
    return table.x[i] + dt * (v0 + 0.5 * gained), v0 + gained, a0


def _turning_times(table: AxisPath) -> FloatArray:
    """Find the times at which the motor reverses inside a piece; reversals within
    `MIN_SEGMENT_S` of its end are left out.
    """
    turning = table.v * table.a < 0.0
    if not turning.any():
        return table.times[:0]
    at = table.times[turning] - table.v[turning] / table.a[turning]
    # A piece that brakes to rest turns round where it ends; rounding must not cut it there.
    ends = np.append(table.times[1:], np.inf)[turning]
    return np.asarray(at[at < ends - MIN_SEGMENT_S])


@dataclass(frozen=True, slots=True)
class Moment:
    """A time within segment `segment` of a relative motion: `dt` seconds after its start."""

    segment: int
    dt: float


START = Moment(0, 0.0)
"""The first moment of a relative motion."""


@dataclass(frozen=True, slots=True)
class Look:
    """One distance evaluation: moment, certified gap [mm], its direction from b
    to a, orientations."""

    at: Moment
    gap: float
    normal: FloatArray
    turns: tuple[FloatArray | None, FloatArray | None]


@dataclass(frozen=True, slots=True)
class _Bound:
    """A piecewise quadratic of time, from the start of each segment on: rate and growth."""

    rate: FloatArray
    growth: FloatArray

    def less(self, other: _Bound, factor: float) -> _Bound:
        """Return this bound less `factor` (a number or one a segment) times another."""
        return _Bound(
            self.rate - factor * other.rate, self.growth - factor * other.growth
        )

    def first_fall(
        self, at: Moment, lengths: FloatArray, value: float, level: float
    ) -> Moment | None:
        """Find the first moment from `at` on at which the bound, being `value` there, has
        fallen to `level`.

        Dips within a segment count. The argument `lengths` and the bound's own arrays are
        not changed.

        Args:
            at: segment, and time in it [s].
            lengths: of all segments (n,) [s].
            value: of the bound at `at`.
            level: below `value`.

        Returns:
            The moment; None if the bound stays above `level`.
        """
        lengths = lengths[at.segment :].copy()
        # From the moment on: the first segment is shorter, and its rate has grown.
        lengths[0] -= at.dt
        rate = self.rate[at.segment :].copy()
        growth = self.growth[at.segment :]
        rate[0] += growth[0] * at.dt
        change = lengths * (rate + 0.5 * growth * lengths)
        ends = value + np.cumsum(change)
        dips = (rate < 0.0) & (rate + growth * lengths > 0.0)
        # Where it reverses within a segment, its least value is there.
        depth = 0.5 * rate * rate / np.where(dips, growth, 1.0)
        reached = np.flatnonzero(np.where(dips, ends - change - depth, ends) <= level)
        if len(reached) == 0:
            return None
        j = int(reached[0])
        above = (float(ends[j - 1]) if j else value) - level
        fall = _fall_time(above, float(rate[j]), float(growth[j]), float(lengths[j]))
        if fall is None:
            dt = float(lengths[j])
        else:
            dt = fall
        return Moment(at.segment + j, dt + (at.dt if j == 0 else 0.0))


def _fall_time(above: float, rate: float, growth: float, length: float) -> float | None:
    """Solve for the first dt in [0, length] at which above + rate dt + growth dt^2 / 2 is
    0; None if there is none.

    0 if `above` is 0 or less; a parabola that touches counts.

    Args:
        above: value at dt = 0.
        rate: per s.
        growth: per s^2.
        length: longest dt [s].
    """
    if above <= 0.0:
        return 0.0
    square = rate * rate - 2.0 * growth * above
    if square < 0.0:
        return None
    root = math.sqrt(square)
    # The first root in the form 2 c / (root - b): where the bound falls nothing cancels, and
    # a growth of 0 needs no case of its own.
    if root > rate:
        dt = 2.0 * above / (root - rate)
    else:
        dt = math.inf
    return dt if dt <= length else None


@dataclass(frozen=True, eq=False)
class _Turn:
    """The turning of one body over the segments: angle, rate, acceleration [rad].

    `side` is the sign of the direction to the other body along the normal: -1 for a, +1
    for b. `nearing` is how far it turns in either sense.
    """

    body: Body
    side: float
    angle: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    nearing: _Bound
    sense: float
    """Sign of all turns; 0 if they differ."""

    @classmethod
    def of(cls, body: Body, side: float, path: Path, kept: Kept) -> _Turn:
        """Evaluate the turning of a body over the segments of a path.

        `sense` is the one direction of turning over all kept segments, 0 if it changes or
        the body stands. In a segment in which it reverses, `nearing` has its fastest rate
        throughout.

        Args:
            body: that turns.
            side: -1 for a, +1 for b.
            path: all motors.
            kept: segments that are evaluated; others are left out of the result.
        """
        angle = path.q[:-1] @ body.turns
        rate = path.v @ body.turns
        growth = path.a @ body.turns
        after = rate + growth * np.diff(path.times)
        # A path is cut where a motor turns round. There rounding may leave a velocity
        # that still points the old way; the acceleration decides.
        rounding = np.abs(growth) * (MIN_SEGMENT_S + coarseness(path.times[:-1]))
        signs = np.sign(np.where(np.abs(rate) > rounding, rate, growth))
        # Bodies on several turntables may reverse within a segment: it turns no faster there.
        both = (rate * after < 0.0) & (np.minimum(np.abs(rate), np.abs(after)) > rounding)
        fastest = np.maximum(np.abs(rate), np.abs(after))
        nearing = _Bound(
            np.where(both, fastest, signs * rate)[kept],
            np.where(both, 0.0, signs * growth)[kept],
        )
        senses = set(signs[kept].tolist()) - {0.0}
        sense = 0.0
        if len(senses) == 1 and not both[kept].any():
            sense = senses.pop()
        return cls(body, side, angle[kept], rate[kept], growth[kept], nearing, sense)

    def orientation(self, at: Moment) -> FloatArray:
        """Compute the body's rotation matrix at a moment, (3, 3)."""
        i = at.segment
        dt = at.dt
        angle = self.angle[i] + dt * (self.rate[i] + 0.5 * dt * self.acceleration[i])
        return self.body.rotation(float(angle))

    @cached_property
    def turns(self) -> bool:
        """Whether the body turns at all."""
        return bool(self.rate.any() or self.acceleration.any())

    @cached_property
    def left(self) -> _Bound:
        """Bound that falls as a turn is used up."""
        return _Bound(-self.nearing.rate, -self.nearing.growth)

    def lever(
        self, normal: FloatArray, orientation: FloatArray, allowance: float
    ) -> tuple[float, float]:
        """Bound how fast the solid approaches by turning, and within what turn: (mm per
        rad, rad).

        The reach across the axis holds for any turn (inf). A chord may be better, as the
        nearing along a fixed normal is a convex function of the turn.
        `normal`: (3,) from b to a; `allowance`: approach for which the bound is made
        [mm], > 0.
        """
        along = float(normal @ self.body.spin_axis)
        crude = self.body.reach * math.sqrt(max(0.0, 1.0 - along * along))
        turn = self.body.turn_until(
            self.side * normal @ orientation, allowance, self.sense
        )
        # The chord is no better than the bound that holds for any turn, and which needs no
        # new look at the end of this one.
        if turn * crude <= allowance:
            return crude, math.inf
        return allowance / turn, turn


class RelativeMotion:
    """Body `a` as seen from body `b` over the segments in which they move relative
    to each other.

    Args:
        a: one body.
        b: the other; its origin is the origin here.
        path: all motors.
    """

    def __init__(self, a: Body, b: Body, path: Path) -> None:
        """Compute the motion of body `a` relative to body `b` along a path, for each
        segment in which it changes.

        Segments in which neither moves relative to the other are left out; if all are
        such, the first one is kept. Whole turns that repeat the same relative motion are
        taken out, too (`_leave_out_repeated_turns`).
        """
        slides = a.slides - b.slides
        velocity = path.v @ slides
        acceleration = path.a @ slides
        changes = [velocity, acceleration]
        for body in (a, b):
            if body.spins:
                changes += [
                    (path.v @ body.turns)[:, None],
                    (path.a @ body.turns)[:, None],
                ]
        moving = np.concatenate(changes, axis=1).any(axis=1)
        if moving.any():
            kept: Kept = np.flatnonzero(moving)
        else:
            kept = slice(0, 1)
        self.times: FloatArray = path.times[:-1][kept]
        self.lengths: FloatArray = np.diff(path.times)[kept]
        self._origin = (path.q @ slides + (a.origin - b.origin))[:-1][kept]
        self._velocity = velocity[kept]
        self._acceleration = acceleration[kept]
        self._turn_a = _Turn.of(a, -1.0, path, kept) if a.spins else None
        self._turn_b = _Turn.of(b, 1.0, path, kept) if b.spins else None
        self._turning = [
            (i, t)
            for i, t in enumerate((self._turn_a, self._turn_b))
            if t is not None and t.turns
        ]
        self._leave_out_repeated_turns()

    def _leave_out_repeated_turns(self) -> None:
        """Shorten segments in which one body turns evenly in place by the whole turns
        that repeat the first.

        They end in the pose they ended in; at least one whole turn stays. Does nothing if
        none or both of the bodies turn. Later segments keep their times.
        """
        if len(self._turning) != 1:
            return
        [(_, turn)] = self._turning
        moving = self._velocity.any(axis=1) | self._acceleration.any(axis=1)
        rate = np.where(moving | (turn.acceleration != 0.0), 0.0, np.abs(turn.rate))
        # One whole turn passes every pose that the others would.
        again = np.maximum(np.floor(rate * self.lengths / (2.0 * math.pi)) - 1.0, 0.0)
        self.lengths -= 2.0 * math.pi * again / np.where(again > 0.0, rate, 1.0)

    def __len__(self) -> int:
        return len(self.times)

    def time(self, at: Moment) -> float:
        """Return the time of `at` [s]."""
        return float(self.times[at.segment] + at.dt)

    def look(self, at: Moment, separate: Separate) -> Look:
        """Compute the certified gap of the two bodies at a moment.

        A body that never turns has None as orientation.

        Args:
            at: segment, and time in it [s].
            separate: certified separation of the two solids in a pose.

        Returns:
            The moment, the gap [mm] (0 for an overlap, by `separation_of`), its unit
            direction from b to a, and the orientations of a and b.
        """
        i = at.segment
        dt = at.dt
        offset = self._origin[i] + dt * (
            self._velocity[i] + 0.5 * dt * self._acceleration[i]
        )
        turn_a = None
        if self._turn_a is not None:
            turn_a = self._turn_a.orientation(at)
        turn_b = None
        if self._turn_b is not None:
            turn_b = self._turn_b.orientation(at)
        gap, normal = separate(offset, turn_a, turn_b)
        return Look(at, gap, normal, (turn_a, turn_b))

    def next_at(self, look: Look, level: float) -> Moment | None:
        """Find the first moment after a look at which the gap may have fallen to `level`,
        or the bound's validity ends.

        It is never too late: the gap is above `level` until then.

        Args:
            look: a distance evaluation.
            level: gap below the look's [mm].

        Returns:
            The moment; None if the gap stays above `level` to the end.
        """
        bound = self._slide(look.normal)
        horizons = []
        for i, turn in self._turning:
            orientation = look.turns[i]
            assert orientation is not None
            # Approaches by turning add up: of two bodies that turn, each may use half of the
            # gap.
            allowance = (look.gap - level) / len(self._turning)
            lever, horizon = turn.lever(look.normal, orientation, allowance)
            bound = bound.less(turn.nearing, lever)
            # A chord bounds the approach within its turn only: where that is used up, the
            # pair is looked at again.
            if math.isfinite(horizon):
                horizons.append(turn.left.first_fall(look.at, self.lengths, horizon, 0.0))
        moments = [bound.first_fall(look.at, self.lengths, look.gap, level), *horizons]
        return min(
            (f for f in moments if f is not None),
            key=lambda f: (f.segment, f.dt),
            default=None,
        )

    def after_travel(self, at: Moment, distance: float) -> Moment | None:
        """Find the first moment after `at` by which two points of the bodies may have
        moved apart by `distance` [mm].

        They move apart no faster than the origins slide and the farthest points turn.

        Returns:
            The moment; None if they travel less to the end.
        """
        return self._travel.first_fall(at, self.lengths, distance, 0.0)

    @cached_property
    def _travel(self) -> _Bound:
        """Bound of travel, sliding plus turning times reach, that falls as travel is used
        up [mm/s; mm/s2].

        Speeds are convex in a segment: the chord between its ends is a bound.
        """
        lengths = self.lengths[:, None]
        begin = np.linalg.norm(self._velocity, axis=1)
        end = np.linalg.norm(self._velocity + self._acceleration * lengths, axis=1)
        for _, turn in self._turning:
            begin = begin + turn.body.reach * np.abs(turn.rate)
            last = turn.rate + turn.acceleration * self.lengths
            end = end + turn.body.reach * np.abs(last)
        growth = (end - begin) / np.where(self.lengths > 0.0, self.lengths, 1.0)
        return _Bound(-begin, -growth)

    def nearest_end(self, look: Look) -> Moment:
        """Find the segment end, from the look's segment on, at which a has slid farthest
        towards b along the look's normal.

        Turning is ignored, and the time in the look's segment: it is a guess, not a
        bound.
        """
        i = look.at.segment
        slide = self._slide(look.normal)
        lengths = self.lengths[i:]
        change = lengths * (slide.rate[i:] + 0.5 * slide.growth[i:] * lengths)
        j = i + int(np.argmin(np.cumsum(change)))
        return Moment(j, float(self.lengths[j]))

    def _slide(self, normal: FloatArray) -> _Bound:
        """Project the sliding of a on a direction."""
        return _Bound(self._velocity @ normal, self._acceleration @ normal)


@dataclass(frozen=True)
class Limits:
    """Definition of a contact, and the accuracy of the least clearance [mm].

    Attributes:
        margin: clearance that is kept.
        tolerance: a gap within this of the margin is a contact.
        accuracy: absolute [mm] and relative error allowed in the least clearance (it is
            never reported smaller than it is).
    """

    margin: float
    tolerance: float
    accuracy: tuple[float, float]

    def slack(self, clearance: float) -> float:
        """Return the error allowed in such a least clearance [mm]."""
        return max(self.accuracy[0], self.accuracy[1] * clearance)


@dataclass(frozen=True)
class PairResult:
    """Result of the sweep of one pair.

    Attributes:
        least: smallest clearance looked at before the contact, or at it [mm].
        contact: where the margin is reached, or None.
        last_free: a moment before it with a little more clearance; None if there is none.
        looks: number of distance evaluations.
    """

    least: float
    contact: Moment | None
    last_free: Moment | None
    looks: int


def sweep_pair(
    motion: RelativeMotion,
    separate: Separate,
    limits: Limits,
    *,
    start: Moment = START,
    until: float = math.inf,
) -> PairResult:
    """Sweep one pair from `start` until it touches, the motion ends, or `until`.

    A pair that starts within the tolerance of the margin, or nearer without overlap, may
    move, but not below its floor (`safety.floor`). Without a contact the segment end that
    is nearest by a guess is evaluated, too.

    Args:
        motion: of one body relative to the other.
        separate: their certified clearance in a pose.
        limits: margin, tolerance.
        start: where to begin.
        until: end of the sweep [s].

    Returns:
        The least gap that was evaluated [mm], the moment of the contact and the last free
        one before it (None without them), and the number of evaluations. A pair that
        overlaps at the start is a contact there, without a free moment.
    """
    level = floor(math.inf, limits.margin)
    near = limits.margin + limits.tolerance
    clear = near + limits.tolerance
    at = start
    before = None
    looks = 0
    least = math.inf
    while True:
        look = motion.look(at, separate)
        looks += 1
        least = min(least, look.gap)
        # Near from the start, and allowed to leave: it keeps the floor of the gap that it
        # has.
        if looks == 1 and 0.0 < look.gap <= near:
            level = max(0.0, floor(look.gap, limits.margin))
            near = level + 0.5 * ROUNDING_MM
            clear = level + ROUNDING_MM
        elif look.gap <= near:
            # An overlap at the start; there was no free moment.
            if before is None:
                return PairResult(look.gap, at, None, looks)
            # The bound that led here holds as well as the look.
            free = _last_free(motion, before, clear)
            return PairResult(max(look.gap, level), at, free, looks)
        before = look
        following = motion.next_at(look, level)
        if following is None or motion.time(following) > until:
            break
        at = following
    # Free. Where it ends nearest is a good guess of the least clearance.
    end = motion.nearest_end(before)
    if motion.time(end) <= until:
        least = min(least, motion.look(end, separate).gap)
        looks = looks + 1
    return PairResult(least, None, None, looks)


def refine_pair(
    motion: RelativeMotion, separate: Separate, limits: Limits, best: float
) -> tuple[float, int]:
    """Refine the least clearance of a pair that is known to be free.

    It ends once the best is within the slack of 0. `best`: clearance of interest [mm];
    greater ones are not refined. Returns a clearance that occurs, not more than
    `limits.slack` above the least (`best` if nothing is below), and the number of looks.
    """
    at: Moment | None = START
    looks = 0
    while at is not None:
        look = motion.look(at, separate)
        looks += 1
        best = min(best, look.gap)
        # What cannot fall to this level before the next look cannot lower the best by more
        # than is allowed; so the search advances from level to level, not from gap to gap.
        level = best - limits.slack(best)
        if level <= 0.0:
            break
        at = motion.next_at(look, level)
    return best, looks


def _last_free(motion: RelativeMotion, before: Look, wanted: float) -> Moment:
    """Find the moment after the look `before` until which the gap stays above `wanted` [mm].

    The look's own moment if its gap is not above that, or the gap never falls to it."""
    if before.gap <= wanted:
        return before.at
    return motion.next_at(before, wanted) or before.at
