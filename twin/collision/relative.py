"""The motion of one body relative to another along a path, and how far it is surely safe.

Conservative advancement in path length: from a certified gap d across the direction n, the gap at
a later time is at least d + n . (displacement) - (what turning can bring nearer), a quadratic in
each segment of the path. `next_at` finds the first time at which that bound has fallen to a level;
nothing in between can touch, so nothing is ever stepped over. For pure translations the bound is
exact along n, so that grazing costs one evaluation. It refuses to know names and margins.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.bodies import Body
from flexdt.twin.collision.paths import Path
from flexdt.twin.conventions import FloatArray


@dataclass(frozen=True, slots=True)
class Moment:
    """A time within segment `segment` of a relative motion: `dt` seconds after its start."""

    segment: int
    dt: float


START = Moment(0, 0.0)
Kept = slice | npt.NDArray[np.intp]
"""Which segments of a path matter."""


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
    lengths: FloatArray

    @classmethod
    def of(cls, body: Body, side: float, path: Path, kept: Kept) -> _Turn:
        angle, rate, growth = path.q[:-1] @ body.turns, path.v @ body.turns, path.a @ body.turns
        lengths = np.diff(path.times)
        return cls(body, side, angle[kept], rate[kept], growth[kept], lengths[kept])

    def orientation(self, at: Moment) -> FloatArray:
        i, dt = at.segment, at.dt
        angle = self.angle[i] + dt * (self.rate[i] + 0.5 * dt * self.acceleration[i])
        return self.body.rotation(float(angle))

    @cached_property
    def turns(self) -> bool:
        """Whether it turns at all."""
        return bool(self.rate.any() or self.acceleration.any())

    @cached_property
    def signs(self) -> FloatArray:
        """Sense of the turn in each segment; no segment holds a turn-round."""
        return np.sign(np.where(self.rate != 0.0, self.rate, self.acceleration))

    def rest(self, at: Moment) -> _Quadratics:
        """How far it turns from `at` on, either way."""
        i = at.segment
        growth = self.signs[i:] * self.acceleration[i:]
        return _Quadratics.after(at, np.abs(self.rate[i:]), growth, self.lengths[i:])

    @cached_property
    def sense(self) -> float:
        """Sense of all turns, 0 if they differ."""
        low, high = float(self.signs.min()), float(self.signs.max())
        return high if low >= 0.0 else low if high <= 0.0 else 0.0

    def lever(self, normal: FloatArray, at: Moment, allowance: float) -> tuple[float, float]:
        """(mm per rad, rad): within that turn the solid comes no nearer than that, per radian.

        The nearing along a fixed normal is a convex function of the turn, so a chord is a bound.
        """
        along = float(normal @ self.body.spin_axis)
        crude = self.body.reach * math.sqrt(max(0.0, 1.0 - along * along))
        toward = self.side * normal @ self.orientation(at)
        turn = self.body.turn_until(toward, allowance, self.sense)
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
        self._turning = [t for t in (self._turn_a, self._turn_b) if t is not None and t.turns]

    def __len__(self) -> int:
        return len(self.times)

    def time(self, at: Moment) -> float:
        """Time of `at` [s]."""
        return float(self.times[at.segment] + at.dt)

    def moment(self, time: float) -> Moment | None:
        """The first moment not before `time`, or None when the motion is over by then."""
        i = max(0, int(np.searchsorted(self.times, time, side="right")) - 1)
        if time <= self.times[i]:
            return Moment(i, 0.0)
        if time - self.times[i] <= self.lengths[i]:
            return Moment(i, float(time - self.times[i]))
        return Moment(i + 1, 0.0) if i + 1 < len(self) else None

    @property
    def end(self) -> Moment:
        """The last moment."""
        return Moment(len(self) - 1, float(self.lengths[-1]))

    def pose(self, at: Moment) -> tuple[FloatArray, FloatArray | None, FloatArray | None]:
        """Vector from b's origin to a's [mm] and the orientations of a and b (None: unturned)."""
        i, dt = at.segment, at.dt
        offset = self._origin[i] + dt * (self._velocity[i] + 0.5 * dt * self._acceleration[i])
        turn_a = None if self._turn_a is None else self._turn_a.orientation(at)
        turn_b = None if self._turn_b is None else self._turn_b.orientation(at)
        return offset, turn_a, turn_b

    def next_at(self, at: Moment, gap: float, normal: FloatArray, level: float) -> Moment | None:
        """First moment after `at` at which the gap may have fallen to `level`.

        Args:
            at: where the gap is known.
            gap: certified gap across `normal` there [mm], above `level`.
            normal: (3,) unit direction from b to a.
            level: [mm].

        Returns:
            The moment, or None if the gap stays above `level` to the end.
        """
        i = at.segment
        rest = self._slide(at, normal)
        horizons = []
        for turn in self._turning:
            lever, horizon = turn.lever(normal, at, (gap - level) / len(self._turning))
            nearing = turn.rest(at)
            rest = rest.less(nearing, lever)
            if math.isfinite(horizon):
                horizons.append(nearing.first_fall(horizon, 0.0, sign=-1.0))
        found = [rest.first_fall(gap, level), *horizons]
        first = min((f for f in found if f is not None), default=None)
        if first is None:
            return None
        j, dt = first
        return Moment(i + j, dt + (at.dt if j == 0 else 0.0))

    def nearest_end(self, at: Moment, normal: FloatArray) -> Moment:
        """The segment end after `at` that lies farthest towards b along `normal`, unturned."""
        ends = np.cumsum(self._slide(at, normal).change)
        j = int(np.argmin(ends))
        return Moment(at.segment + j, float(self.lengths[at.segment + j]))

    def _slide(self, at: Moment, normal: FloatArray) -> _Quadratics:
        i = at.segment
        return _Quadratics.after(
            at, self._velocity[i:] @ normal, self._acceleration[i:] @ normal, self.lengths[i:]
        )


@dataclass(frozen=True, eq=False)
class _Quadratics:
    """A piecewise quadratic of time: rate at the start and growth in each segment of `length`."""

    rate: FloatArray
    growth: FloatArray
    length: FloatArray

    @classmethod
    def after(
        cls, at: Moment, rate: FloatArray, growth: FloatArray, length: FloatArray
    ) -> _Quadratics:
        """From arrays that begin with the segment of `at`, of which `at.dt` is over."""
        if at.dt > 0.0:
            rate, length = rate.copy(), length.copy()
            rate[0] += growth[0] * at.dt
            length[0] -= at.dt
        return cls(rate, growth, length)

    @property
    def change(self) -> FloatArray:
        """Difference over each segment."""
        return self.length * (self.rate + 0.5 * self.growth * self.length)

    def less(self, other: _Quadratics, factor: float) -> _Quadratics:
        """This minus `factor` times another over the same segments."""
        return _Quadratics(
            self.rate - factor * other.rate, self.growth - factor * other.growth, self.length
        )

    def first_fall(self, value: float, level: float, sign: float = 1.0) -> tuple[int, float] | None:
        """(segment, dt) at which `sign` times it, begun at `value`, first reaches `level`."""
        change, rate, growth = sign * self.change, sign * self.rate, sign * self.growth
        ends = value + np.cumsum(change)
        lowest = ends
        dips = (rate < 0.0) & (rate + growth * self.length > 0.0)
        if dips.any():
            # It turns round within these segments.
            dip = ends - change - 0.5 * rate * rate / np.where(dips, growth, 1.0)
            lowest = np.where(dips, dip, ends)
        reached = lowest <= level
        j = int(np.argmax(reached))
        if not reached[j]:
            return None
        above = float(ends[j] - change[j]) - level
        return j, _fall_time(above, float(rate[j]), float(growth[j]), float(self.length[j]))


def _fall_time(above: float, rate: float, growth: float, length: float) -> float:
    """First dt >= 0 at which above + rate dt + growth dt^2 / 2 reaches 0, at most `length`."""
    if above <= 0.0:
        return 0.0
    root = math.sqrt(max(0.0, rate * rate - 2.0 * growth * above))
    return min(length, 2.0 * above / (root - rate)) if root > rate else length
