"""The table of a fit: its residuals, the geometry's columns, and what groups are made of.

It is made where the fit stands, with what groups have explained so far: in the fit's columns,
in the poses of single frames, or in the places in the image. Weights that are found in the
table are totals, not changes, so that a table can be made again and again.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.fit.fit import RAYLEIGH_MEDIAN
from flexdt.twin.calibration.fit.problem import (
    STRAINS,
    ColumnLayout,
    FitProblem,
    layout,
    panel_heights,
    turning_shifts,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import MOVABLE, Motion
from flexdt.twin.geometry.offsets import NAMES
from flexdt.twin.geometry.panel import PanelModel

LEANS: Final = ("axis_tilt_x", "axis_tilt_z")
PER_FRAME: Final = (*MOVABLE, *LEANS)
"""Parameters that may differ from frame to frame, in the order of their slopes."""
OUTLIER_SPREADS: Final = 5.0
"""Robust standard deviations beyond which a position counts less."""


@dataclass(frozen=True, eq=False)
class State:
    """What has been explained so far.

    Attributes:
        x: values of every column (`with_every_column`), internal units.
        frames: parameter -> (n,) deviations of single frames, internal units.
        shift: (n, k, 2) shift of the positions by what is neither [px].
        found: what groups are about that are there, so far.
        torn: (n, k) positions that are part of two places, so that they count for nothing.
    """

    x: FloatArray
    frames: Mapping[str, FloatArray]
    shift: FloatArray
    found: tuple[object, ...] = ()
    torn: npt.NDArray[np.bool_] | None = None


def image_shape(problem: FitProblem) -> tuple[int, int] | None:
    """Return (rows, cols) of the images; None where frames differ."""
    sizes = np.unique(2 * problem.origin + 1, axis=0)
    if len(sizes) == 1:
        return (int(sizes[0, 1]), int(sizes[0, 0]))
    return None


def with_every_column(
    problem: FitProblem, x: FloatArray
) -> tuple[FitProblem, FloatArray]:
    """Add a column for every cause that is a column of a fit.

    Layout: the fit's parameters, beads, strain, arc, rows, panel (none for images of several
    shapes); all beads are free.

    Args:
        problem: of the fit; not changed.
        x: (c,) its column values.

    Returns:
        The problem, and values of all columns: those of the fit, and the problem's start
        for those that it does not have.
    """
    old = problem.layout
    count = old.parameter_count
    k = len(problem.model)
    shape = image_shape(problem)
    panel = None if shape is None else PanelModel(1.0, shape)
    terms = () if panel is None else panel.names
    names = [
        *old.names[:count],
        *(f"bead {b} {axis}" for b in range(k) for axis in "xyz"),
        *(f"strain {term}" for term in STRAINS),
        "arc",
        "rows",
        *(f"panel {term}" for term in terms),
    ]
    strain = count + 3 * k
    arc = strain + len(STRAINS)
    columns = ColumnLayout(
        tuple(names), old.asked, old.colmap, count, strain, arc, arc + 1, count, arc + 2,
        old.active, old.held,
    )  # fmt: skip
    base, beads = problem.spread(x)
    rows = panel_heights(problem.measured, problem.origin)
    whole = replace(
        problem,
        layout=columns,
        panel=panel,
        base=base,
        turning=turning_shifts(
            problem.poses, beads, base, problem.group, problem.reading, rows
        ),
    )
    there = whole.start
    places = {name: i for i, name in enumerate(names)}
    for name, value in zip(old.names, x.tolist(), strict=True):
        if name in places:
            there[places[name]] = value
    return whole, there


class Linearised:
    """Rows of a table, two a position (2 n k), whitened and weighted.

    Attributes:
        problem: with every column, the deviations in its poses and positions.
        state: what it was made with.
        weight: (n, k) of each position, 0 where none counts.
        spread: robust standard deviation of the whitened residuals.
        count: number of whitened coordinates that count.
        geometry: (2 n k, p) of the fit's parameters.
        values: (2 n k,) that geometry and groups are to explain.
        slopes: (s, n, 2 k): of the parameters of `PER_FRAME`, of the beads' coordinates, of
            growth, of each coordinate of a position by itself, and of the upper beads' places.
    """

    def __init__(self, plain: FitProblem, state: State, floor: float) -> None:
        """Make the table of a problem.

        Args:
            plain: of the fit, without deviations.
            state: with every column.
            floor: least standard deviation of whitened residuals.
        """
        _n, _k = plain.seen.shape
        self.plain = plain
        self.state = state
        self.problem, x = moved(plain, state)
        problem = self.problem
        layout_ = problem.layout
        self.parameters = layout_.parameter_count
        whitened = problem.whitened(x)
        lengths = np.linalg.norm(whitened, axis=2)
        self.lengths = lengths
        seen = problem.seen
        self.spread = max(float(np.median(lengths[seen])) / RAYLEIGH_MEDIAN, floor)
        self.weight = weights(lengths, seen, self.spread)
        if state.torn is not None:
            self.weight[state.torn] = 0.0
        self.count = 2.0 * float((self.weight**2).sum())
        share = np.repeat(self.weight.ravel(), 2)
        # Of what stands still: beside frames that differ, a phantom that shrinks towards the
        # source would look like these, in a linear table.
        still, _ = moved(plain, replace(state, frames={}))
        jacobian = still.jacobian(x) * share[:, None]
        self.columns = jacobian
        self.geometry = np.ascontiguousarray(jacobian[:, : self.parameters])
        taken = x - problem.start
        taken[: self.parameters] = 0.0
        self.values = whitened.ravel() * share + jacobian @ taken
        self.slopes = self._slopes(x)
        for name, off in state.frames.items():
            own = self.slopes[PER_FRAME.index(name)] * off[:, None]
            self.values += own.reshape(-1)
        self.values += self._whitened(state.shift).ravel() * share
        # A prior is about its mean, and geometry's weights are changes.
        own = slice(0, self.parameters)
        self.mean = plain.prior_mean[own] - x[own]
        self.precision = plain.prior_sigma[own] ** -2.0

    @property
    def n(self) -> int:
        """Number of frames."""
        return len(self.problem.seen)

    @property
    def k(self) -> int:
        """Number of beads."""
        return int(self.problem.seen.shape[1])

    @property
    def scans(self) -> list[npt.NDArray[np.intp]]:
        """Frames of each scan."""
        group = self.problem.group
        return [np.flatnonzero(group == g) for g in range(group.max() + 1)]

    @property
    def measured(self) -> FloatArray:
        """Measured column and row of each position, (n, k, 2) [px]."""
        return np.asarray(self.plain.measured + self.plain.origin[:, None, :])

    @cached_property
    def places(self) -> FloatArray:
        """Predicted column and row of each position, (n, k, 2) [px]."""
        return self.problem.predictions(self.state.x)[0]

    @property
    def bead_slopes(self) -> npt.NDArray[np.intp]:
        """Numbers of the slopes of the beads' coordinates, (k, 3)."""
        return len(PER_FRAME) + np.arange(3 * self.k).reshape(-1, 3)

    @property
    def growth_slope(self) -> int:
        """Number of the slope of a phantom that grows."""
        return len(PER_FRAME) + 3 * self.k

    @property
    def spot_slopes(self) -> npt.NDArray[np.intp]:
        """Numbers of the slopes of the positions' coordinates, (2 k,)."""
        return self.growth_slope + 1 + np.arange(2 * self.k)

    @cached_property
    def upper_beads(self) -> list[npt.NDArray[np.intp]]:
        """Beads above a height, of each height between two beads, two on either side at
        least."""
        order = np.argsort(self.problem.model.beads[:, 2])
        return [order[i:] for i in range(2, self.k - 1)]

    @property
    def upper_slopes(self) -> npt.NDArray[np.intp]:
        """Numbers of the slopes of the places of `upper_beads`, (pieces, 3)."""
        first = self.growth_slope + 1 + 2 * self.k
        return first + np.arange(3 * len(self.upper_beads)).reshape(-1, 3)

    @property
    def place_slopes(self) -> npt.NDArray[np.intp]:
        """Numbers of the slopes of the phantom's place, (3,)."""
        first = self.growth_slope + 1 + 2 * self.k
        return first + 3 * len(self.upper_beads) + np.arange(3)

    def _slopes(self, x: FloatArray) -> FloatArray:
        """Compute the slopes, weighted (s, n, 2 k)."""
        n, k = self.n, self.k
        problem = self.problem
        share = np.repeat(self.weight, 2, axis=1)
        params, beads = problem.spread(x)
        names = tuple(sorted(PER_FRAME, key=_order))
        alone = layout(names, len(params), names, k, False, names)
        still = replace(
            problem, base=params, layout=alone, panel=None, turning=None,
            model=replace(problem.model, beads=beads),
        )  # fmt: skip
        each = still.jacobian(still.start).reshape(2 * n * k, len(names), -1).sum(axis=2)
        at = [names.index(name) for name in PER_FRAME]
        moved_ = each[:, at].T.reshape(-1, n, 2 * k) * share
        own = self.columns[:, problem.layout.bead_columns]
        bead = own.T.reshape(3 * k, n, 2 * k)
        grown = np.einsum("b,bnq->nq", problem.model.about_middle.ravel(), bead)
        spots = np.zeros((2 * k, n, 2 * k))
        spots[np.arange(2 * k), :, np.arange(2 * k)] = share.T
        each_bead = bead.reshape(k, 3, n, 2 * k)
        upper = [each_bead[some].sum(axis=0) for some in self.upper_beads]
        whole = each_bead.sum(axis=0)
        return np.concatenate([moved_, bead, grown[None], spots, *upper, whole])

    def _whitened(self, shift: FloatArray) -> FloatArray:
        """Whiten shifts of the positions, (n, k, 2, ...) [px]."""
        w = self.problem.whiten.reshape(
            *self.problem.seen.shape, 3, *[1] * (shift.ndim - 3)
        )
        across = w[:, :, 0] * shift[:, :, 0] + w[:, :, 1] * shift[:, :, 1]
        return np.stack([across, w[:, :, 2] * shift[:, :, 1]], axis=2)

    def rows_of(self, shift: FloatArray) -> FloatArray:
        """Make rows of the table, (2 n k, c), of shifts of the positions (n, k, 2, c) [px]."""
        share = np.repeat(self.weight.ravel(), 2)
        return self._whitened(shift).reshape(len(share), -1) * share[:, None]

    def shift_of(self, rows: FloatArray) -> FloatArray:
        """Return the shift of the positions, (n, k, 2, ...) [px], that unweighted whitened rows
        (2 n k, ...) stand for; 0 where a position does not count.
        """
        n, k = self.n, self.k
        own = rows.reshape(n, k, 2, *rows.shape[1:])
        further = (1,) * (rows.ndim - 1)
        w = self.problem.whiten.reshape(n, k, 3, *further)
        share = np.where(self.weight > 0, self.weight, 1.0).reshape(n, k, *further)
        with np.errstate(divide="ignore", invalid="ignore"):
            down = own[:, :, 1] / share / w[:, :, 2]
            across = (own[:, :, 0] / share - w[:, :, 1] * down) / w[:, :, 0]
        out = np.stack([across, down], axis=2)
        seen = self.problem.seen.reshape(n, k, 1, *further)
        return np.where(seen & np.isfinite(out), out, 0.0)


def _order(name: str) -> int:
    return NAMES.index(name)


def weights(
    lengths: FloatArray, seen: npt.NDArray[np.bool_], spread: float
) -> FloatArray:
    """Weigh positions by the lengths of their whitened residuals, (n, k): 1 up to
    `OUTLIER_SPREADS`, less beyond."""
    out = seen * np.minimum(1.0, OUTLIER_SPREADS * spread / np.maximum(lengths, 1e-12))
    return np.asarray(out, dtype=np.float64)


def moved(plain: FitProblem, state: State) -> tuple[FitProblem, FloatArray]:
    """Put what a state has explained beside the columns into poses and positions.

    Args:
        plain: of the fit.
        state: with every column.

    Returns:
        The problem with every column, and the state's column values.
    """
    count = plain.layout.parameter_count
    own = np.concatenate([state.x[:count], np.zeros(len(plain.layout.names) - count)])
    first = plain.layout.bead_columns
    if plain.layout.bead_column >= 0:
        own[first] = plain.model.beads.ravel()
    there = replace(plain, measured=plain.measured - state.shift * plain.seen[..., None])
    if state.frames:
        there = replace(there, poses=motion_of(state.frames).applied(there.poses))
    every, _ = with_every_column(there, own)
    return every, state.x


def motion_of(frames: Mapping[str, FloatArray]) -> Motion:
    """Return deviations of frames as a motion without sigmas."""
    values = np.stack(list(frames.values()), axis=1)
    return Motion(
        tuple(frames), values, np.full(values.shape, math.nan), (0.0,) * len(frames)
    )
