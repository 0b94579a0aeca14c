"""First contact and least clearance of one pair of bodies along their relative motion.

It advances from certified gap to certified gap (see `Relative`), so motion that counts as free
keeps the margin everywhere, not only where it was evaluated: clearance >= margin along everything
before the reported contact. A contact is reported where the certified gap is within `tolerance` of
the margin.

The motion of one body relative to another along a path, and how far it is proved safe.

Conservative advancement in path length: from a certified gap d across the direction n, the gap at
a later time is at least d + n . (displacement) - (what turning can bring nearer), a quadratic in
each segment of the path. `next_at` finds the first time at which that bound has fallen to a level;
no contact can occur before it, so none is ever stepped over. For pure translations the bound is
exact along n, so that grazing costs one evaluation.

The distance of two convex solids with a certificate; the one module that wraps python-fcl.

fcl proposes the nearest points; the clearance that counts is then computed from the two solids'
supports along that direction, a lower bound of the true distance whatever fcl said. So an error of
the library can stop a motion too early but never call a touch free. fcl is imported when the first
pair is made. Its continuous collision (which misses contacts) is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.convex_solids import Cylinder, Polytope, Solid
from flexdt.twin.collision.paths import ROUNDING, Path, coarseness
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray

Separation = tuple[float, FloatArray]
"""Certified clearance [mm], 0 when they touch or overlap, and the unit direction from b to a."""

_IDENTITY = np.eye(3)
_ORIGIN = np.zeros(3)
_NOWHERE: Separation = (0.0, np.array([0.0, 0.0, 1.0]))
DOUBT = 1e-5
"""A certificate this far below fcl's distance [mm] is tried across other directions."""
SNAP = 0.01
"""Components of a direction below this may be fcl's inaccuracy (with cylinders it has some)."""


def separation_of(
    a: Solid, b: Solid
) -> Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]:
    """A function that separates `a` from `b`.

    Returns:
        A function of the vector from b's origin to a's (3,) [mm] and of the orientations of a and
        b (3, 3), None for a body that never turns.
    """
    import fcl

    request = fcl.DistanceRequest(enable_nearest_points=True)
    shape_a, shift_a = _as_fcl(a)
    shape_b, shift_b = _as_fcl(b)
    still_b = fcl.CollisionObject(shape_b, fcl.Transform(_IDENTITY, shift_b))

    def separate(
        offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        # Nothing is shared that changes: several threads may ask at once.
        ra = _IDENTITY if turn_a is None else turn_a
        object_a = fcl.CollisionObject(shape_a, fcl.Transform(ra, offset + ra @ shift_a))
        object_b = still_b
        if turn_b is not None:
            object_b = fcl.CollisionObject(shape_b, fcl.Transform(turn_b, turn_b @ shift_b))
        result = fcl.DistanceResult()
        distance = fcl.distance(object_a, object_b, request, result)
        if not distance > 0.0:
            return _NOWHERE
        on_a, on_b = result.nearest_points
        apart = on_a - on_b
        length = math.sqrt(apart @ apart)
        if length == 0.0:
            return _NOWHERE
        normal = apart / length
        gap = _gap(a, b, normal, offset, turn_a, turn_b)
        if gap < distance - DOUBT:
            for other in _second_guesses(normal):
                wider = _gap(a, b, other, offset, turn_a, turn_b)
                if wider > gap:
                    gap, normal = wider, other
        return (gap, normal) if gap > 0.0 else _NOWHERE

    return separate


def _gap(
    a: Solid,
    b: Solid,
    normal: FloatArray,
    offset: FloatArray,
    turn_a: FloatArray | None,
    turn_b: FloatArray | None,
) -> float:
    """Width of the empty slab between them across `normal`: no two points are nearer than that."""
    in_a = -normal if turn_a is None else -normal @ turn_a
    in_b = normal if turn_b is None else normal @ turn_b
    return float(normal @ offset) - a.support(in_a) - b.support(in_b)


def _second_guesses(normal: FloatArray) -> list[FloatArray]:
    """Directions that fcl may have meant: small components zero; nearest points swapped."""
    snapped = np.where(np.abs(normal) < SNAP, 0.0, normal)
    snapped /= math.sqrt(snapped @ snapped)
    return [snapped, -normal]


def _as_fcl(solid: Solid) -> tuple[Any, FloatArray]:
    """fcl's shape and where its own centre lies in the solid's frame."""
    import fcl

    match solid:
        case Cylinder(center, radius, height):
            return fcl.Cylinder(radius, height), np.array(center)
        case Polytope():
            counts = np.full((len(solid.faces), 1), 3, dtype=np.int32)
            faces = np.concatenate([counts, solid.faces], axis=1).ravel()
            return fcl.Convex(np.array(solid.vertices), len(solid.faces), faces), _ORIGIN
    raise TypeError(f"no collision shape for {type(solid).__name__}")


Separate = Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]
"""The certified clearance of two solids: from b's origin to a's, orientations of a and b."""

ONE_BY_ONE = 4
"""Segments that are gone through singly before the rest is searched at once."""


@dataclass(frozen=True, slots=True)
class Moment:
    """A time within segment `segment` of a relative motion: `dt` seconds after its start."""

    segment: int
    dt: float


START = Moment(0, 0.0)
Kept = slice | npt.NDArray[np.intp]
"""Which segments of a path matter."""


@dataclass(frozen=True, slots=True)
class Look:
    """A distance evaluation: when, the certified gap [mm], its direction from b to a, the turns."""

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
        return _Bound(self.rate - factor * other.rate, self.growth - factor * other.growth)

    def first_fall(
        self, at: Moment, lengths: FloatArray, value: float, level: float
    ) -> Moment | None:
        """The first moment from `at` on at which it, being `value` there, reaches `level`."""
        near = min(at.segment + ONE_BY_ONE, len(lengths))
        dt = at.dt
        for j in range(at.segment, near):
            growth = float(self.growth[j])
            rate, length = float(self.rate[j]) + growth * dt, float(lengths[j]) - dt
            fall = _fall_time(value - level, rate, growth, length)
            if fall is not None:
                return Moment(j, dt + fall)
            value += length * (rate + 0.5 * growth * length)
            dt = 0.0
        if near == len(lengths):
            return None
        rate_, growth_, length_ = self.rate[near:], self.growth[near:], lengths[near:]
        change = length_ * (rate_ + 0.5 * growth_ * length_)
        ends = value + np.cumsum(change)
        dips = (rate_ < 0.0) & (rate_ + growth_ * length_ > 0.0)
        # Where it turns round within a segment, its least value lies there.
        depth = 0.5 * rate_ * rate_ / np.where(dips, growth_, 1.0)
        reached = np.flatnonzero(np.where(dips, ends - change - depth, ends) <= level)
        if len(reached) == 0:
            return None
        j = int(reached[0])
        above = float(ends[j] - change[j]) - level
        fall = _fall_time(above, float(rate_[j]), float(growth_[j]), float(length_[j]))
        return Moment(near + j, float(length_[j]) if fall is None else fall)


def _fall_time(above: float, rate: float, growth: float, length: float) -> float | None:
    """First dt in [0, length] at which above + rate dt + growth dt^2 / 2 is 0, or None."""
    if above <= 0.0:
        return 0.0
    square = rate * rate - 2.0 * growth * above
    if square < 0.0:
        return None
    root = math.sqrt(square)
    dt = 2.0 * above / (root - rate) if root > rate else math.inf
    return dt if dt <= length else None


@dataclass(frozen=True, eq=False)
class _Turn:
    """The turning of one body over the segments: angle, rate, acceleration [rad].

    `side` is the sign of the direction to the other body along the normal: -1 for a, +1 for b.
    """

    body: Body
    side: float
    angle: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    signs: FloatArray
    """Sense of the turning in each segment, which is one: a path is cut where a motor turns round.
    There rounding may leave a velocity that still points the old way; the acceleration tells."""

    @classmethod
    def of(cls, body: Body, side: float, path: Path, kept: Kept) -> _Turn:
        angle, rate, growth = path.q[:-1] @ body.turns, path.v @ body.turns, path.a @ body.turns
        rounding = np.abs(growth) * (ROUNDING + coarseness(path.times[:-1]))
        signs = np.sign(np.where(np.abs(rate) > rounding, rate, growth))
        return cls(body, side, angle[kept], rate[kept], growth[kept], signs[kept])

    def orientation(self, at: Moment) -> FloatArray:
        i, dt = at.segment, at.dt
        angle = self.angle[i] + dt * (self.rate[i] + 0.5 * dt * self.acceleration[i])
        return self.body.rotation(float(angle))

    @cached_property
    def turns(self) -> bool:
        """Whether it turns at all."""
        return bool(self.rate.any() or self.acceleration.any())

    @cached_property
    def nearing(self) -> _Bound:
        """How far it turns, either way; no segment holds a turn-round."""
        return _Bound(self.signs * self.rate, self.signs * self.acceleration)

    @cached_property
    def left(self) -> _Bound:
        """A turn that is used up."""
        return _Bound(-self.nearing.rate, -self.nearing.growth)

    @cached_property
    def sense(self) -> float:
        """Sense of all turns, 0 if they differ."""
        low, high = float(self.signs.min()), float(self.signs.max())
        return high if low >= 0.0 else low if high <= 0.0 else 0.0

    def lever(
        self, normal: FloatArray, orientation: FloatArray, allowance: float
    ) -> tuple[float, float]:
        """(mm per rad, rad): within that turn the solid comes no nearer than that, per radian.

        The nearing along a fixed normal is a convex function of the turn, so a chord is a bound.
        """
        along = float(normal @ self.body.spin_axis)
        crude = self.body.reach * math.sqrt(max(0.0, 1.0 - along * along))
        turn = self.body.turn_until(self.side * normal @ orientation, allowance, self.sense)
        if turn * crude <= allowance:
            return crude, math.inf
        return allowance / turn, turn


class RelativeMotion:
    """Body `a` as seen from body `b` over the segments in which they move relative to each other.

    Args:
        a: one body.
        b: the other; its origin is the origin here.
        path: all motors.
    """

    def __init__(self, a: Body, b: Body, path: Path) -> None:
        slides = a.slides - b.slides
        velocity, acceleration = path.v @ slides, path.a @ slides
        changes = [velocity, acceleration]
        for body in (a, b):
            if body.spins:
                changes += [(path.v @ body.turns)[:, None], (path.a @ body.turns)[:, None]]
        moving = np.concatenate(changes, axis=1).any(axis=1)
        kept: Kept = np.flatnonzero(moving) if moving.any() else slice(0, 1)
        self.times: FloatArray = path.times[:-1][kept]
        self.lengths: FloatArray = np.diff(path.times)[kept]
        self._origin = (path.q @ slides + (a.origin - b.origin))[:-1][kept]
        self._velocity, self._acceleration = velocity[kept], acceleration[kept]
        self._turn_a = _Turn.of(a, -1.0, path, kept) if a.spins else None
        self._turn_b = _Turn.of(b, 1.0, path, kept) if b.spins else None
        self._turning = [
            (i, t) for i, t in enumerate((self._turn_a, self._turn_b)) if t is not None and t.turns
        ]

    def __len__(self) -> int:
        return len(self.times)

    def time(self, at: Moment) -> float:
        """Time of `at` [s]."""
        return float(self.times[at.segment] + at.dt)

    def look(self, at: Moment, separate: Separate) -> Look:
        """Separate the two bodies at a moment."""
        i, dt = at.segment, at.dt
        offset = self._origin[i] + dt * (self._velocity[i] + 0.5 * dt * self._acceleration[i])
        turn_a = None if self._turn_a is None else self._turn_a.orientation(at)
        turn_b = None if self._turn_b is None else self._turn_b.orientation(at)
        gap, normal = separate(offset, turn_a, turn_b)
        return Look(at, gap, normal, (turn_a, turn_b))

    def next_at(self, look: Look, level: float) -> Moment | None:
        """First moment after a look at which the gap may have fallen to `level` [mm].

        `level` is below the look's gap. None if the gap stays above it to the end.
        """
        bound = self._slide(look.normal)
        horizons = []
        for i, turn in self._turning:
            orientation = look.turns[i]
            assert orientation is not None
            allowance = (look.gap - level) / len(self._turning)
            lever, horizon = turn.lever(look.normal, orientation, allowance)
            bound = bound.less(turn.nearing, lever)
            if math.isfinite(horizon):
                horizons.append(turn.left.first_fall(look.at, self.lengths, horizon, 0.0))
        found = [bound.first_fall(look.at, self.lengths, look.gap, level), *horizons]
        return min(
            (f for f in found if f is not None), key=lambda f: (f.segment, f.dt), default=None
        )

    def nearest_end(self, look: Look) -> Moment:
        """The segment end after a look that lies farthest towards b along its normal, unturned."""
        i, dt = look.at.segment, look.at.dt
        slide, lengths = self._slide(look.normal), self.lengths[i:]
        change = lengths * (slide.rate[i:] + 0.5 * slide.growth[i:] * lengths)
        change[0] -= dt * (slide.rate[i] + 0.5 * slide.growth[i] * dt)
        j = i + int(np.argmin(np.cumsum(change)))
        return Moment(j, float(self.lengths[j]))

    def _slide(self, normal: FloatArray) -> _Bound:
        return _Bound(self._velocity @ normal, self._acceleration @ normal)


ESCAPE = 0.1
"""Of the tolerance: how much nearer a motion may come that starts within the margin."""


@dataclass(frozen=True)
class Limits:
    """What counts as a contact, and how well the least clearance is wanted [mm].

    Attributes:
        margin: clearance that is kept.
        tolerance: a gap within this of the margin is a contact.
        accuracy: absolute [mm] and relative error allowed in the least clearance (it is never
            reported smaller than it is).
    """

    margin: float
    tolerance: float
    accuracy: tuple[float, float]

    def slack(self, clearance: float) -> float:
        """Error allowed in a least clearance of this size."""
        return max(self.accuracy[0], self.accuracy[1] * clearance)


@dataclass(frozen=True)
class PairResult:
    """What one pair's sweep found.

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
    """Follow one pair until it touches, the motion ends, or `until` [s].

    A pair that starts within the margin (after a halt, or a new sample) may move, but not nearer.

    Args:
        motion: of one body relative to the other.
        separate: their certified clearance in a pose.
        limits: margin, tolerance.
        start: where to begin.
        until: what happens after this time does not matter [s].
    """
    margin, tolerance = limits.margin, limits.tolerance
    at, before, looks, least = start, None, 0, math.inf
    while True:
        look = motion.look(at, separate)
        looks += 1
        least = min(least, look.gap)
        if looks == 1 and 0.0 < look.gap <= margin + tolerance:
            margin, tolerance = max(0.0, look.gap - ESCAPE * tolerance), 0.5 * ESCAPE * tolerance
        if look.gap <= margin + tolerance:
            if before is None:
                return PairResult(look.gap, at, None, looks)
            # The bound that led here holds as well as the look.
            free = _last_free(motion, before, margin + 2 * tolerance)
            return PairResult(max(look.gap, margin), at, free, looks)
        before = look
        following = motion.next_at(look, margin)
        if following is None or motion.time(following) > until:
            break
        at = following
    # Free. Where it ends nearest is a good guess of the least clearance.
    end = motion.nearest_end(before)
    if motion.time(end) <= until:
        least, looks = min(least, motion.look(end, separate).gap), looks + 1
    return PairResult(least, None, None, looks)


def refine_pair(
    motion: RelativeMotion, separate: Separate, limits: Limits, best: float
) -> tuple[float, int]:
    """Least clearance of a pair that is known to be free, if it is below `best` [mm].

    Returns:
        A clearance that occurs, not more than `limits.slack` above the least (`best` if nothing
        is below that), and the number of evaluations.
    """
    at: Moment | None = START
    looks = 0
    while at is not None:
        look = motion.look(at, separate)
        looks += 1
        best = min(best, look.gap)
        level = best - limits.slack(best)
        if level <= 0.0:
            break
        at = motion.next_at(look, level)
    return best, looks


def _last_free(motion: RelativeMotion, before: Look, wanted: float) -> Moment:
    """The last moment known to have clearance `wanted`, or the last one looked at."""
    if before.gap <= wanted:
        return before.at
    return motion.next_at(before, wanted) or before.at
