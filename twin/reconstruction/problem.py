"""What every iterative method has in hand: data, geometry and grid, and the matched pair of
operators on plain arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid, Volume, as_volume, back, forward, room_like
from flexdt.twin.projection.operators import as_cone_vec, check_projections

SMALLEST = 1e-6
"""Sums of weights below this part of the largest are not divided by."""


@dataclass(frozen=True)
class Step:
    """What happened in one iteration.

    Attributes:
        iteration: from 1.
        of: iterations in all.
        residual: root mean square of measured minus projected line integrals, before this
            iteration's correction.
    """

    iteration: int
    of: int
    residual: float


Watch = Callable[[Step], None]


@dataclass(frozen=True, eq=False)
class Problem:
    """Data, geometry and grid, with the pair of operators on plain arrays."""

    measured: Float32Array
    geometry: ConeVec
    like: Volume

    @classmethod
    def of(
        cls,
        projections: npt.ArrayLike,
        cone_vec: ConeVec | npt.ArrayLike,
        like: Volume | Grid,
        iterations: int,
    ) -> Problem:
        """From checked arguments.

        Raises:
            GeometryError: shapes that do not fit.
            LimitError: no iterations.
        """
        if iterations < 1:
            raise LimitError(
                f"{iterations} iterations; allowed: at least 1", {"asked": iterations, "allowed": 1}
            )
        geometry = as_cone_vec(cone_vec)
        values = check_projections(projections, len(geometry))
        geometry.of_shape((values.shape[1], values.shape[2]))
        return cls(values, geometry, as_volume(like))

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, cols) of the detector."""
        return self.measured.shape[1], self.measured.shape[2]

    def first(self, start: Volume | None) -> Float32Array:
        """Values to begin with: a copy of the first guess, or zeros."""
        if start is None:
            return np.zeros(self.like.shape, np.float32)
        if start.shape != self.like.shape:
            raise GeometryError(
                f"the first guess has shape {start.shape}; allowed: the grid's {self.like.shape}",
                {"asked": list(start.shape), "allowed": list(self.like.shape)},
            )
        return np.array(start.data, dtype=np.float32)

    def project(self, x: Float32Array, geometry: ConeVec | None = None) -> Float32Array:
        """Projections of voxels, for the whole scan or for `geometry`."""
        geometry = self.geometry if geometry is None else geometry
        return forward(replace(self.like, data=x), geometry, self.shape)

    def spread(self, y: Float32Array, geometry: ConeVec | None = None) -> Float32Array:
        """The adjoint, in memory that the next call overwrites."""
        geometry = self.geometry if geometry is None else geometry
        return back(y, geometry, self.like, self.room).data

    @cached_property
    def room(self) -> Float32Array:
        """Memory for the adjoint."""
        return room_like(self.like)

    def inverse_sums(self, geometry: ConeVec) -> tuple[Float32Array, Float32Array]:
        """Inverse sums of the projector's rows and columns, zero where (nearly) nothing is."""
        rows = self.project(np.ones(self.like.shape, np.float32), geometry)
        columns = self.spread(np.ones_like(rows), geometry)
        return _inverse(rows), _inverse(columns)

    def tell(self, watch: Watch | None, i: int, of: int, rest: Float32Array) -> None:
        """Report iteration i (from 0) with the residual `rest`."""
        if watch is not None:
            watch(Step(i + 1, of, float(np.sqrt(dot(rest, rest) / rest.size))))


def _inverse(values: Float32Array) -> Float32Array:
    out = np.zeros_like(values)
    np.divide(1.0, values, out=out, where=values > SMALLEST * float(values.max()))
    return out


def dot(a: Float32Array, b: Float32Array) -> float:
    """Inner product of two stacks or volumes, summed in double precision."""
    return float(np.einsum("ijk,ijk->", a, b, dtype=np.float64))


def far_apart(count: int) -> list[int]:
    """0 .. count-1 ordered so that neighbours in time are far apart (golden-section steps)."""
    return [int(i) for i in np.argsort((np.arange(count) * 0.6180339887498949) % 1.0)]
