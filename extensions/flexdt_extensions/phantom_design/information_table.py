"""The information that a bead at each possible position contributes to planned scans, and
the score of a set of positions.

Each bead adds a block of its own to the Fisher information of the planned frames, so a
set of positions is judged by the sum of blocks and of the parameters' priors. A spot that
touches another one in a frame counts for nothing there, as in identification.
`bead_search` does the choosing.

A set is scored by its effect on a reconstruction: the displacement of the image at the
panel's edge by column and angle of the axis and magnification. The stage's offsets are
dominated by the unknown offsets of the panel, which no bead determines.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final, Literal, assert_never

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import (
    SIX,
    BeadModel,
    build_problem,
    edge_factors,
    image_slopes,
    spot_radii,
    tolerance_of,
    visible_beads,
)
from flexdt.twin.calibration.fit.priors import NOISE_PX, known
from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses

Criterion = Literal["a", "d", "worst"]
CRITERIA: Final[Mapping[Criterion, str]] = {
    "a": "A-optimality: root mean square displacement at the panel's edge [px] by column and angle "
    "of the axis and magnification",
    "d": "D-optimality: geometric mean of the axes of their ellipsoid [px at the panel's edge]",
    "worst": "the largest displacement at the panel's edge [px] by one of them",
}
SEATS_AT_ONCE: Final = 8
"""Number of seats whose share is computed together."""
RIDGE: Final = 1e-9
"""Information added so that sets that determine too little can still be compared."""


@dataclass(frozen=True, eq=False)
class PlannedScans:
    """The scans a phantom is designed for.

    Attributes:
        poses: nominal pose of every frame of every placement.
        shape: detector (rows, cols).
        noise_px: standard deviation of a detected coordinate.
        free: parameters to be estimated, shared by all placements.
        bead_tolerance_mm: > 0: standard deviation of the beads' places; they are
            estimated, too. 0 and None: a search takes them as exact; None: a calibration
            is not told so.
        priors: standard deviations of the other parameters [mm, deg, 1], 0 exactly known;
            None: as `known` of `fit.priors` has it.
    """

    poses: Poses
    shape: tuple[int, int]
    noise_px: float = NOISE_PX
    free: tuple[str, ...] = SIX
    bead_tolerance_mm: float | None = 0.0
    priors: Mapping[str, float] | None = None

    @property
    def widths(self) -> Mapping[str, float]:
        """The priors, those that are assumed where none are given."""
        if self.priors is None:
            return known(self.free)
        return self.priors

    @property
    def spread_mm(self) -> float:
        """Standard deviation of the beads' places that a search counts; 0: exact."""
        return self.bead_tolerance_mm or 0.0

    def sizes(self) -> FloatArray:
        """Return (n, 2) detector (rows, cols) of each frame."""
        return np.broadcast_to(
            np.asarray(self.shape, dtype=np.float64), (len(self.poses), 2)
        )

    def thinned(self, frames: int) -> tuple[PlannedScans, float]:
        """Select at most `frames` of the frames, spread evenly; returns as well how many
        frames each stands for (1.0 if all are kept).
        """
        n = len(self.poses)
        if n <= frames:
            return self, 1.0
        chosen = np.linspace(0, n, frames, endpoint=False).round().astype(np.intp)
        return replace(self, poses=self.poses[chosen]), n / frames


@dataclass(frozen=True, eq=False)
class SeatTable:
    """Every seat's share in the information, frame by frame.

    `blocks` (m, n, q q) is a seat's information in one frame, parameters in units of
    their tolerance, the bead's own coordinates after them; `pixels` (m, n, 2) and `reach`
    (m, n) are the place of its spot and its least distance from others'; `visible` (m,
    n). `known` (p,) is the information of the parameters' priors, and `slopes` (3, p) the
    derivatives of IN_IMAGES, both in tolerances; `edge_px` (3,) is the displacement at
    the panel's edge by a unit of these.
    """

    places: FloatArray
    names: tuple[str, ...]
    asked: int
    tolerances: FloatArray
    known: FloatArray
    slopes: FloatArray
    edge_px: FloatArray
    blocks: FloatArray
    pixels: FloatArray
    radii: FloatArray
    visible: npt.NDArray[np.bool_]
    prior: float

    @classmethod
    def of(
        cls, places: FloatArray, radius: float, planned: PlannedScans, weight: float
    ) -> SeatTable:
        """Compute the table of places for beads of a radius; each frame counts `weight`
        times.

        Parameters are in units of their tolerances; spots and their sizes are projected
        at nominal geometry.

        Args:
            places: (m, 3) [mm].
            radius: of the beads [mm].
            planned: the scans.
            weight: of each frame.
        """
        problems = [
            _problem(
                BeadModel(places[first : first + SEATS_AT_ONCE], np.array(radius)),
                planned,
            )
            for first in range(0, len(places), SEATS_AT_ONCE)
        ]
        rows = np.concatenate([_rows(problem) for problem in problems])  # (m, n, 2, q)
        layout = problems[0].layout
        p = layout.parameter_count
        names = layout.names[:p]
        tolerances = np.array([tolerance_of(name) for name in names])
        rows[..., :p] *= tolerances
        blocks = weight * np.einsum("mnip,mniq->mnpq", rows, rows)
        model = BeadModel(places, np.array(radius))
        seen, slopes = image_slopes(problems[0], problems[0].start, 0)
        widths = problems[0].prior_sigma[:p] * edge_factors(names)
        return cls(
            places,
            names,
            layout.asked,
            tolerances,
            (tolerances / widths) ** 2,
            slopes * tolerances,
            _edge_px(seen, planned.shape),
            blocks.reshape(*blocks.shape[:2], -1),
            planned.poses.cone_vec().project_points(places, (1, 1)).transpose(1, 0, 2),
            spot_radii(model, planned.poses.cone_vec()).T,
            visible_beads(model, planned.poses, planned.sizes()).T,
            planned.spread_mm,
        )

    def touching(
        self, a: npt.NDArray[np.int64], b: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Return whether the spots of seats `a` and `b` touch in each frame, (a, b, n),
        with the margins of `identify.overlapping`.
        """
        first = self.pixels[a]
        second = self.pixels[b]
        across = first[:, None, :, 0] - second[None, :, :, 0]
        down = first[:, None, :, 1] - second[None, :, :, 1]
        reach = 1.12 * (self.radii[a][:, None] + self.radii[b][None]) + 2.0
        return np.asarray(across * across + down * down < reach * reach)

    def alone(self, chosen: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
        """Find the spots of a set that count, (k, n)."""
        touch = self.touching(chosen, chosen)
        touch[np.arange(len(chosen)), np.arange(len(chosen))] = False
        return np.asarray(self.visible[chosen] & ~touch.any(axis=1))

    def information(self, masks: npt.NDArray[np.bool_]) -> FloatArray:
        """Sum up the information (p, p) of a set of all seats under masks (m, n)."""
        summed = np.einsum("mn,mnf->mf", masks.astype(np.float64), self.blocks)
        return np.asarray(self.marginal(summed).sum(axis=0))

    def marginal(self, summed: FloatArray) -> FloatArray:
        """Reduce beads' summed information (..., q q) to the parameters' (..., p, p): the
        beads' own places are marginalised with their prior, if it is not 0.
        """
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

    def felt(self, information: FloatArray) -> FloatArray:
        """Compute the covariance (..., 3, 3) of IN_IMAGES [px at the panel's edge].

        Args:
            information: (..., p, p) of the images; `RIDGE` is added for parameters not
                determined.
        """
        whole = information + np.diag(self.known + RIDGE)
        rows = self.slopes * self.edge_px[:, None]
        return np.asarray(rows @ np.linalg.solve(whole, rows.T))


def _edge_px(seen: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Compute the displacement at the panel's edge [px] by a unit of each of
    IN_IMAGES: px, deg, 1."""
    rows, cols = shape
    return np.array([1.0, math.radians(1.0) * rows / 2.0, cols / 2.0 / seen[2]])


def _problem(model: BeadModel, planned: PlannedScans) -> FitProblem:
    """Build the problem of the planned scans of some beads, each of them seen in every
    frame.

    Measured positions are zeros: only the Jacobian is of use. Bead places are free if a
    tolerance is given.
    """
    n = len(planned.poses)
    k = len(model)
    return build_problem(
        np.zeros((n, k, 2)),
        model,
        planned.poses,
        free=planned.free,
        shape=planned.sizes(),
        noise_px=planned.noise_px,
        free_beads=planned.spread_mm > 0,
        priors=planned.widths,
    )


def _rows(problem: FitProblem) -> FloatArray:
    """Compute the whitened Jacobian rows of each bead in edge units, (k, n, 2, q).

    q is the number of parameters, and with free beads three more for the bead's own
    coordinates.
    """
    n, k = problem.seen.shape
    factor = edge_factors(problem.layout.names)
    rows = (
        (problem.jacobian(problem.start) / factor)
        .reshape(n, k, 2, -1)
        .transpose(1, 0, 2, 3)
    )
    p = problem.layout.parameter_count
    if problem.layout.bead_column < 0:
        return np.array(rows[..., :p])
    # A bead's rows touch its own three coordinates only.
    own = np.stack([rows[i, :, :, p + 3 * i : p + 3 * i + 3] for i in range(k)])
    return np.concatenate([rows[..., :p], own], axis=3)


def inverse(information: FloatArray) -> FloatArray:
    """Invert information matrices.

    Args:
        information: (..., p, p) in units of tolerances.

    Returns:
        Covariances (..., p, p); the variance of a parameter that a lost direction (an
        eigenvalue of at most 1e-12 of the largest) touches is inf.
    """
    values, vectors = np.linalg.eigh(information)
    lost = values <= 1e-12 * np.maximum(values[..., -1:], 1e-300)
    safe = np.where(lost, np.inf, values)
    covariance = (vectors / safe[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    touched = (np.abs(vectors) * lost[..., None, :] > 1e-6).any(axis=-1)
    p = information.shape[-1]
    covariance[..., np.arange(p), np.arange(p)] += np.where(touched, np.inf, 0.0)
    return np.asarray(covariance)


def score_of(covariance: FloatArray, criterion: Criterion) -> FloatArray:
    """Compute the criterion of a stack of covariances (m, q, q), (m,); less is better.

    "a": root of the mean variance; "d": geometric mean of the standard deviations along
    the principal axes; "worst": the largest standard deviation.
    """
    variances = np.diagonal(covariance, axis1=-2, axis2=-1)
    match criterion:
        case "a":
            return np.asarray(np.sqrt(variances.mean(axis=-1)))
        case "d":
            values = np.linalg.eigvalsh(covariance)
            return np.asarray(
                np.exp(0.5 * np.log(np.maximum(values, RIDGE**2)).mean(axis=-1))
            )
        case "worst":
            return np.asarray(np.sqrt(variances.max(axis=-1)))
        case _:
            assert_never(criterion)
