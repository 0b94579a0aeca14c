"""The motion of one body relative to another along a path, and how far it is proved safe.

Conservative advancement in path length: from a certified gap d across the direction n, the gap at
a later time is at least d + n . (displacement) - (what turning can bring nearer), a quadratic in
each segment of the path. `next_at` finds the first time at which that bound has fallen to a level;
no contact can occur before it, so none is ever stepped over. For pure translations the bound is
exact along n, so that grazing costs one evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.nearest import Separation
from flexdt.twin.collision.paths import ROUNDING, Path, coarseness
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray

Separate = Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]
"""The certified clearance of two solids: from b's origin to a's, orientations of a and b."""


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
        lengths = lengths[at.segment :].copy()
        lengths[0] -= at.dt
        rate, growth = self.rate[at.segment :].copy(), self.growth[at.segment :]
        rate[0] += growth[0] * at.dt
        change = lengths * (rate + 0.5 * growth * lengths)
        ends = value + np.cumsum(change)
        dips = (rate < 0.0) & (rate + growth * lengths > 0.0)
        # Where it turns round within a segment, its least value lies there.
        depth = 0.5 * rate * rate / np.where(dips, growth, 1.0)
        reached = np.flatnonzero(np.where(dips, ends - change - depth, ends) <= level)
        if len(reached) == 0:
            return None
        j = int(reached[0])
        above = (float(ends[j - 1]) if j else value) - level
        fall = _fall_time(above, float(rate[j]), float(growth[j]), float(lengths[j]))
        dt = float(lengths[j]) if fall is None else fall
        return Moment(at.segment + j, dt + (at.dt if j == 0 else 0.0))


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
    `nearing` is how far it turns in either sense.
    """

    body: Body
    side: float
    angle: FloatArray
    rate: FloatArray
    acceleration: FloatArray
    nearing: _Bound
    sense: float
    """Of all turns; 0 if they differ."""

    @classmethod
    def of(cls, body: Body, side: float, path: Path, kept: Kept) -> _Turn:
        angle, rate, growth = path.q[:-1] @ body.turns, path.v @ body.turns, path.a @ body.turns
        after = rate + growth * np.diff(path.times)
        # A path is cut where a motor turns round. There rounding may leave a velocity that still
        # points the old way; the acceleration tells.
        rounding = np.abs(growth) * (ROUNDING + coarseness(path.times[:-1]))
        signs = np.sign(np.where(np.abs(rate) > rounding, rate, growth))
        # What several turntables carry may turn round within a segment: it turns no faster there.
        both = (rate * after < 0.0) & (np.minimum(np.abs(rate), np.abs(after)) > rounding)
        fastest = np.maximum(np.abs(rate), np.abs(after))
        nearing = _Bound(
            np.where(both, fastest, signs * rate)[kept], np.where(both, 0.0, signs * growth)[kept]
        )
        senses = set(signs[kept].tolist()) - {0.0}
        sense = senses.pop() if len(senses) == 1 and not both[kept].any() else 0.0
        return cls(body, side, angle[kept], rate[kept], growth[kept], nearing, sense)

    def orientation(self, at: Moment) -> FloatArray:
        i, dt = at.segment, at.dt
        angle = self.angle[i] + dt * (self.rate[i] + 0.5 * dt * self.acceleration[i])
        return self.body.rotation(float(angle))

    @cached_property
    def turns(self) -> bool:
        """Whether it turns at all."""
        return bool(self.rate.any() or self.acceleration.any())

    @cached_property
    def left(self) -> _Bound:
        """A turn that is used up."""
        return _Bound(-self.nearing.rate, -self.nearing.growth)

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
        self._leave_out_repeated_turns()

    def _leave_out_repeated_turns(self) -> None:
        """Where one body turns evenly on the spot, every turn after the first meets what it met.

        Whole turns are taken out of such segments, so they end in the pose they ended in.
        """
        if len(self._turning) != 1:
            return
        [(_, turn)] = self._turning
        moving = self._velocity.any(axis=1) | self._acceleration.any(axis=1)
        rate = np.where(moving | (turn.acceleration != 0.0), 0.0, np.abs(turn.rate))
        again = np.maximum(np.floor(rate * self.lengths / (2.0 * math.pi)) - 1.0, 0.0)
        self.lengths -= 2.0 * math.pi * again / np.where(again > 0.0, rate, 1.0)

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

    def after_travel(self, at: Moment, distance: float) -> Moment | None:
        """The first moment after `at` by which a gap may have grown by `distance` [mm].

        Two points of the bodies move apart no faster than the origins slide and the farthest
        points turn. None if they travel less to the end.
        """
        return self._travel.first_fall(at, self.lengths, distance, 0.0)

    @cached_property
    def _travel(self) -> _Bound:
        """Travel that is used up. Speeds are convex in a segment: the chord is a bound."""
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
        """The segment end after a look that lies farthest towards b along its normal, unturned."""
        i = look.at.segment
        slide, lengths = self._slide(look.normal), self.lengths[i:]
        change = lengths * (slide.rate[i:] + 0.5 * slide.growth[i:] * lengths)
        j = i + int(np.argmin(np.cumsum(change)))
        return Moment(j, float(self.lengths[j]))

    def _slide(self, normal: FloatArray) -> _Bound:
        return _Bound(self._velocity @ normal, self._acceleration @ normal)
