"""One motor over time as arrays: what sweeps and plans ask for many moments at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.motion.profiles import Trajectory, at_rest, joined
from flexdt.twin.values import ArrayValue


@dataclass(frozen=True, eq=False)
class AxisPath(ArrayValue):
    """One axis over time: constant acceleration from each of `times` on, (k,) arrays.

    Attributes:
        times: starts of the pieces [s], in order; before the first it stands at `x[0]`.
        x: positions then [mm, deg].
        v: velocities then, per s.
        a: accelerations from then on, per s^2.
    """

    times: FloatArray
    x: FloatArray
    v: FloatArray
    a: FloatArray

    @classmethod
    def of(cls, start: float, trajectories: Sequence[tuple[float, Trajectory]]) -> AxisPath:
        """Join trajectories, each in force from its time until the next one's."""
        return cls.along(joined([at_rest(start), *(later for _, later in trajectories)]))

    @classmethod
    def along(cls, trajectory: Trajectory) -> AxisPath:
        """One trajectory, with the rest after it."""
        rows = [(p.start, p.position, p.velocity, p.acceleration) for p in trajectory.pieces]
        if math.isfinite(trajectory.end):
            rows.append((trajectory.end, trajectory.target, 0.0, 0.0))
        return cls(*np.array(rows).T)

    @classmethod
    def standing(cls, position: float) -> AxisPath:
        """A motor that does not move."""
        zero = np.zeros(1)
        return cls(zero, np.array([position]), zero, zero)

    def _at(self, times: npt.ArrayLike) -> tuple[npt.NDArray[np.intp], FloatArray]:
        t = np.asarray(times, dtype=np.float64)
        index = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, None)
        return index, np.maximum(t - self.times[index], 0.0)

    def positions(self, times: npt.ArrayLike) -> FloatArray:
        """Positions at `times` [s], same shape."""
        i, dt = self._at(times)
        return np.asarray(self.x[i] + dt * (self.v[i] + 0.5 * self.a[i] * dt))

    def velocities(self, times: npt.ArrayLike) -> FloatArray:
        """Velocities at `times` [s], same shape."""
        i, dt = self._at(times)
        return np.asarray(self.v[i] + self.a[i] * dt)
