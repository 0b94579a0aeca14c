"""All motors over an interval of time, cut where any of them changes its acceleration.

Within a segment every motor has constant acceleration and does not reverse, so its displacement is
one quadratic.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.motion.profiles import AxisPath

CONTINUITY = 1e-6
"""Largest jump of a motor between two pieces that counts as rounding [mm, deg]."""


STEPS_OF_TIME = 8.0
"""How many of the smallest steps of a time count as its rounding."""
ROUNDING = 1e-9
"""Shortest time that counts as a segment of its own where a motor turns round [s]."""


@dataclass(frozen=True, eq=False)
class Path:
    """Every motor over time.

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
        """Positions at `times` (n,) within the path, (n, axes)."""
        i = np.clip(np.searchsorted(self.times, times, side="right") - 1, 0, len(self.v) - 1)
        dt = np.clip(times - self.times[i], 0.0, self.times[i + 1] - self.times[i])[:, None]
        at = self.q[i] + dt * (self.v[i] + 0.5 * dt * self.a[i])
        return np.where((times >= self.times[-1])[:, None], self.q[-1], at)

    def positions(self, time: float) -> dict[str, float]:
        """Motor -> position at `time` within the path [mm, deg]."""
        return dict(zip(self.axes, self.vectors(np.array([time]))[0].tolist(), strict=True))

    def after(self, time: float) -> Path:
        """What is left of it from `time` on, which lies before its end."""
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
        """(axes,) whether each motor ever moves."""
        moving: npt.NDArray[np.bool_] = np.abs(self.v).sum(axis=0) + np.abs(self.a).sum(axis=0) > 0
        return moving


def path_of(axes: Sequence[str], tables: Mapping[str, AxisPath], start: float, end: float) -> Path:
    """The path of `axes` from `start` to `end` [s].

    Raises:
        KeyError: a motor has no table.
        ValueError: a motor jumps; a sweep over it would prove nothing.
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
    begin, length = times[:-1], np.diff(times)
    q = np.tile([float(tables[name].x[0]) for name in axes], (len(times), 1))
    v, a = np.zeros((2, len(begin), len(axes)))
    for column, name, table in moving:
        x0, v0, a0 = _state(table, begin)
        arrives = x0 + length * (v0 + 0.5 * a0 * length)
        # The times themselves are rounded, also those of a programme that is slowed: its places are
        # off by what the motor goes before it is. A clock that is late has coarse ones.
        rounding = coarseness(begin[1:]) * float(np.abs(table.v).max())
        jumps = np.abs(arrives[:-1] - x0[1:]) > CONTINUITY + rounding
        if jumps.any():
            where = int(np.argmax(jumps))
            raise ValueError(
                f"{name} jumps from {arrives[where]:g} to {x0[where + 1]:g} at "
                f"{times[where + 1]:g} s; a path must be continuous"
            )
        q[:-1, column], q[-1, column], v[:, column], a[:, column] = x0, arrives[-1], v0, a0
    return Path(tuple(axes), times, q, v, a)


def coarseness(times: FloatArray) -> FloatArray:
    """How far times of that size may be off by rounding [s]."""
    return STEPS_OF_TIME * np.asarray(np.spacing(np.abs(times)))


def _stands(table: AxisPath) -> bool:
    return not (table.v.any() or table.a.any() or (table.x != table.x[0]).any())


def _state(table: AxisPath, times: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Position, velocity, acceleration in force from each of `times` (in order) on."""
    i = table.times.searchsorted(times, side="right") - 1
    before, i = i < 0, np.maximum(i, 0)  # there it stands
    dt, v0, a0 = np.where(before, 0.0, (times - table.times[i], table.v[i], table.a[i]))
    gained = a0 * dt
    return table.x[i] + dt * (v0 + 0.5 * gained), v0 + gained, a0


def _turning_times(table: AxisPath) -> FloatArray:
    """When the motor turns round within a piece."""
    turning = table.v * table.a < 0.0
    if not turning.any():
        return table.times[:0]
    at = table.times[turning] - table.v[turning] / table.a[turning]
    # A piece that brakes to rest turns round where it ends; rounding must not cut it there.
    ends = np.append(table.times[1:], np.inf)[turning]
    return np.asarray(at[at < ends - ROUNDING])
