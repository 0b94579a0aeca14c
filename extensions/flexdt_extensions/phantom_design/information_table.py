"""The information that a bead at each possible position contributes to planned scans, and the score
of a set of positions.

Each bead adds a block of its own to the Fisher information of the planned frames, so a set of
positions is judged by adding blocks. A spot that touches another one in a frame counts for nothing
there, as in identification. `bead_search` does the choosing.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import (
    SIX,
    BeadModel,
    build_problem,
    edge_factor,
    spot_radii,
    tolerance_of,
    visible_beads,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses

Criterion = Literal["a", "d", "worst"]
CRITERIA: Final[Mapping[Criterion, str]] = {
    "a": "A-optimality: root mean square of sigma / tolerance",
    "d": "D-optimality: geometric mean of the ellipsoid's axes, in tolerances",
    "worst": "the largest sigma / tolerance",
}
RIDGE: Final = 1e-9
"""Information added so that sets which determine too little can still be compared."""


@dataclass(frozen=True, eq=False)
class PlannedScans:
    """The scans a phantom is designed for.

    Attributes:
        poses: nominal pose of every frame of every placement.
        shape: detector (rows, cols).
        noise_px: standard deviation of a detected coordinate.
        free: parameters to be estimated, shared by all placements.
        bead_tolerance_mm: > 0: how well beads sit where they should; they are estimated, too.
    """

    poses: Poses
    shape: tuple[int, int]
    noise_px: float = 0.1
    free: tuple[str, ...] = SIX
    bead_tolerance_mm: float = 0.0

    def sizes(self) -> FloatArray:
        """(n, 2) detector (rows, cols) of each frame."""
        return np.broadcast_to(np.asarray(self.shape, dtype=np.float64), (len(self.poses), 2))

    def thinned(self, frames: int) -> tuple[PlannedScans, float]:
        """At most `frames` of the frames, and how many each stands for."""
        n = len(self.poses)
        if n <= frames:
            return self, 1.0
        chosen = np.linspace(0, n, frames, endpoint=False).round().astype(np.intp)
        return replace(self, poses=self.poses[chosen]), n / frames


@dataclass(frozen=True, eq=False)
class SeatTable:
    """Every seat's share in the information, frame by frame.

    `blocks` (m, n, q q) is a seat's information in one frame, parameters in units of their
    tolerance, the bead's own coordinates after them; `pixels` (m, n, 2) and `reach` (m, n) say
    where its spot is and how far it must stay from others'; `visible` (m, n).
    """

    places: FloatArray
    names: tuple[str, ...]
    tolerances: FloatArray
    blocks: FloatArray
    pixels: FloatArray
    radii: FloatArray
    visible: npt.NDArray[np.bool_]
    prior: float

    @classmethod
    def of(
        cls, places: FloatArray, radius: float, planned: PlannedScans, weight: float
    ) -> SeatTable:
        """The table of places for beads of a radius [mm]; each frame counts `weight` times."""
        parts: list[FloatArray] = []
        names: tuple[str, ...] = ()
        prior = planned.bead_tolerance_mm
        for first in range(0, len(places), 8):
            rows, names = _rows(BeadModel(places[first : first + 8], np.array(radius)), planned)
            parts.append(rows)
        rows = np.concatenate(parts)  # (m, n, 2, q)
        p = len(names)
        tolerances = np.array([tolerance_of(name) for name in names])
        rows[..., :p] *= tolerances
        blocks = weight * np.einsum("mnip,mniq->mnpq", rows, rows)
        model = BeadModel(places, np.array(radius))
        return cls(
            places,
            names,
            tolerances,
            blocks.reshape(*blocks.shape[:2], -1),
            planned.poses.cone_vec().project_points(places, (1, 1)).transpose(1, 0, 2),
            spot_radii(model, planned.poses.cone_vec()).T,
            visible_beads(model, planned.poses, planned.sizes()).T,
            prior,
        )

    def touching(self, a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(a, b, n) whether the spots of two seats touch; the rule of `identify.overlapping`."""
        first, second = self.pixels[a], self.pixels[b]
        across = first[:, None, :, 0] - second[None, :, :, 0]
        down = first[:, None, :, 1] - second[None, :, :, 1]
        reach = 1.12 * (self.radii[a][:, None] + self.radii[b][None]) + 2.0
        return np.asarray(across * across + down * down < reach * reach)

    def alone(self, chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """(k, n) which spots of a set count."""
        touch = self.touching(chosen, chosen)
        touch[np.arange(len(chosen)), np.arange(len(chosen))] = False
        return np.asarray(self.visible[chosen] & ~touch.any(axis=1))

    def information(self, masks: npt.NDArray[np.bool_]) -> FloatArray:
        """(p, p) of a set of all seats under masks (m, n)."""
        summed = np.einsum("mn,mnf->mf", masks.astype(np.float64), self.blocks)
        return np.asarray(self.marginal(summed).sum(axis=0))

    def marginal(self, summed: FloatArray) -> FloatArray:
        """(..., p, p): beads' summed blocks (..., q q) with the beads' own places marginalised."""
        p = len(self.names)
        q = p + (3 if self.prior > 0 else 0)
        full = summed.reshape(*summed.shape[:-1], q, q)
        if q == p:
            return full
        cross = full[..., :p, p:]
        own = full[..., p:, p:] + np.eye(3) / self.prior**2
        return np.asarray(
            full[..., :p, :p] - cross @ np.linalg.solve(own, np.swapaxes(cross, -1, -2))
        )


def _rows(model: BeadModel, planned: PlannedScans) -> tuple[FloatArray, tuple[str, ...]]:
    """Whitened Jacobian rows of each bead, (k, n, 2, q) edge units, and the parameters' names."""
    n, k = len(planned.poses), len(model)
    problem = build_problem(
        np.zeros((n, k, 2)), model, planned.poses, free=planned.free, shape=planned.sizes(),
        noise_px=planned.noise_px, free_beads=planned.bead_tolerance_mm > 0,
    )  # fmt: skip
    names = problem.layout.names
    factor = np.array([edge_factor(name) for name in names])
    rows = (problem.jacobian(problem.start) / factor).reshape(n, k, 2, -1).transpose(1, 0, 2, 3)
    p = problem.layout.parameter_count
    if p == len(names):
        return np.array(rows), names
    # A bead's rows touch its own three coordinates only.
    own = np.stack([rows[i, :, :, p + 3 * i : p + 3 * i + 3] for i in range(k)])
    return np.concatenate([rows[..., :p], own], axis=3), names[:p]


def inverse(information: FloatArray) -> FloatArray:
    """Covariances (..., p, p) in units of tolerances; infinite diagonal where not determined."""
    values, vectors = np.linalg.eigh(information)
    lost = values <= 1e-12 * np.maximum(values[..., -1:], 1e-300)
    safe = np.where(lost, np.inf, values)
    covariance = (vectors / safe[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    touched = (np.abs(vectors) * lost[..., None, :] > 1e-6).any(axis=-1)
    p = information.shape[-1]
    covariance[..., np.arange(p), np.arange(p)] += np.where(touched, np.inf, 0.0)
    return np.asarray(covariance)


def score_of(information: FloatArray, criterion: Criterion) -> FloatArray:
    """The criterion of a stack of information matrices (m, p, p), ridge included."""
    p = information.shape[-1]
    values, vectors = np.linalg.eigh(information + RIDGE * np.eye(p))
    values = np.maximum(values, RIDGE / 2)
    match criterion:
        case "a":
            return np.asarray(np.sqrt(np.mean(1.0 / values, axis=-1)))
        case "d":
            return np.asarray(np.exp(-0.5 * np.mean(np.log(values), axis=-1)))
        case _:
            variances = np.einsum("mij,mj->mi", vectors**2, 1.0 / values)
            return np.asarray(np.sqrt(variances.max(axis=-1)))
