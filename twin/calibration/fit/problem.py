"""The calibration problem as a value: which frames, beads, measurements and free parameters.

It converts the public arguments to the plain arrays of the kernels and back, and knows the two
readings of eq. 5.4 and the gauge. `fit` solves it.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.fit import fit_kernels as kernels
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NAMES, NOMINAL, Offsets, to_edge, to_internal
from flexdt.twin.geometry.panel import PanelModel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import (
    PARAMETERS,
    PLACES,
    TOLD,
    offsets_in,
    poses_at,
    told_by,
    ways,
)
from flexdt.twin.machine.description import builtin_machine

Shape = tuple[int, int] | FloatArray | None
"""Detector (rows, cols) of all frames, or (n, 2) of each; None is the default machine's
camera."""

SIX = ("dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z")
"""The thesis's active vector, eq. 5.6."""
EIGHT = (*SIX, "dD_x", "dD_y")
"""The thesis's extended vector, eq. 5.19."""

STRAINS = ("xx", "yy", "zz", "xy", "yx", "xz", "zx", "yz", "zy")
"""Displacements of beads along the first axis proportional to the second coordinate. The
phantom's scale is a told length (`geometry.told_lengths.PHANTOM`)."""
STRETCHES = 3
"""Number of stretches at the start of STRAINS; the others are shears."""
Strain = tuple[float, float]
"""Standard deviations of stretches and of shears [1]; 0: without them."""
UNSTRAINED: Strain = (0.0, 0.0)
LEAST_STRAIN = 1e-7
"""Width of absent stretches or shears next to present ones."""
ARC_PRIOR = 0.5
"""Standard deviation of the squared share of a step that an exposure lasts; it is 0 to 1."""
ROWS_PRIOR = 0.5
"""Standard deviation of the share of a step by which the last row of a frame is read later
than the first; it is -1 to 1."""
ROWS_POWERS = 3
"""Powers of the turn between two rows by which the path of a bead is followed."""
ARC_ANGLE_RAD = 0.02
"""Between the positions that give the derivatives of the beads' paths."""

GAUGES = (("dS_x", "dO_x", "dD_x"), ("dS_y", "dO_y", "dD_y"))
"""Parameters whose common shift changes no image: the first is fixed when all three are
free."""


class Reading(enum.Enum):
    """The two readings of thesis eq. 5.4, which differ in the place of the rotation axis.

    With every parameter of dO and tau free they describe the same set of geometries; the values
    of dO_x and dO_z differ by tau_x and tau_z.
    """

    AXIS_AT_O_PLUS_TAU = "axis at O + tau"
    """As printed: tau + R (b - tau) + O. The one `Poses.cone_vec` and corrections use."""
    MOUNT_SHIFT = "R (b - tau) + O"
    """The axis stays at O and the phantom is shifted by -tau on its mount: the reading
    with which the thesis's two groups of real scans are consistent."""

    @property
    def pivot(self) -> float:
        """Weight of tau in the axis's position."""
        if self is Reading.AXIS_AT_O_PLUS_TAU:
            return 1.0
        return 0.0


class Centre(enum.Enum):
    """Kind of a measured bead position; the value is the sphere-centre bias factor."""

    POINT = 0.0
    """The projection of the bead's center itself (simulated points)."""
    OUTLINE = 1.0
    """Centre of the spot's elliptic outline."""


@dataclass(frozen=True)
class ColumnLayout:
    """Meaning of the columns of the normal equations.

    Attributes:
        names: label of each column: a parameter, `parameter@group`, `bead k x|y|z`, `strain ab`,
            `arc`, `rows`, or `panel term`.
        asked: number of requested columns; those after them are there for their prior.
        colmap: (groups, 28) column of each group's parameter, -1 if not free.
        bead_column: first column of the beads' coordinates, -1 if fixed.
        strain_column: first column of the phantom's strain, -1 without strain.
        arc_column: of the exposure's arc, -1 without arc.
        rows_column: of the turn while the rows are read, -1 without it.
        parameter_count: columns that are geometric parameters; all others come after.
        panel_column: first column of the panel's distortion, the last ones; the number of
            columns without distortion.
        active: indices of parameters that have a column in at least one group.
        held: requested parameters that the gauge holds, with the reason.
    """

    names: tuple[str, ...]
    asked: int
    colmap: npt.NDArray[np.int64]
    bead_column: int
    strain_column: int
    arc_column: int
    rows_column: int
    parameter_count: int
    panel_column: int
    active: npt.NDArray[np.int64]
    held: tuple[tuple[str, str], ...]

    @property
    def bead_columns(self) -> slice:
        """Columns of the beads' coordinates, three a bead; empty if beads are not free."""
        if self.bead_column < 0:
            return slice(self.parameter_count, self.parameter_count)
        if self.strain_column < 0:
            last = self.shift_column
        else:
            last = self.strain_column
        return slice(self.bead_column, last)

    @property
    def strain_columns(self) -> slice:
        """Columns of the phantom's strain, in the order of STRAINS; empty if it is rigid."""
        last = self.shift_column
        return slice(last if self.strain_column < 0 else self.strain_column, last)

    @property
    def shift_column(self) -> int:
        """First of the columns whose coefficients shift the positions, arc, rows and panel;
        the number of columns if there are none.
        """
        if self.arc_column >= 0:
            return self.arc_column
        if self.rows_column >= 0:
            return self.rows_column
        return self.panel_column


def require_names(names: Iterable[str], others: Iterable[str] = ()) -> None:
    """Check that every name is a parameter, or one of the others; returns nothing.

    Raises:
        UnknownNameError: the first that is not; lists the allowed names.
    """
    allowed = (*PARAMETERS, *others)
    for name in names:
        if name not in allowed:
            raise UnknownNameError.among(
                f"unknown parameter {name!r}; allowed", name, allowed
            )


def require_tolerance(tolerance_mm: float) -> float:
    """Check that a value is a standard deviation of bead positions, and return it; 0 is
    allowed.

    Raises:
        TwinError: negative, infinite or not a number.
    """
    if not 0.0 <= tolerance_mm < math.inf:
        raise TwinError(
            f"bead tolerance {tolerance_mm:g} mm; allowed: 0 (beads sit where the "
            "phantom says) or more",
            {"asked": tolerance_mm, "allowed": ">= 0"},
        )
    return tolerance_mm


def layout(
    free: Sequence[str],
    groups: int,
    per_group: Sequence[str],
    beads: int,
    free_beads: bool,
    priors: Sequence[str] = (),
    panel: Sequence[str] = (),
    strained: bool = False,
    arc: bool = False,
    rows: bool = False,
) -> ColumnLayout:
    """Assign columns: parameters (requested, then those with a prior alone) in the order
    of PARAMETERS, then beads, strain, arc, rows, panel. Told places have one in each group.

    Where source, object and detector could shift together without priors, the source is
    held. With one group `per_group` has no effect.

    Args:
        free: names of free parameters, any order, each once or more.
        groups: number of groups of frames.
        per_group: those of `free` that have a value of their own in every group.
        beads: number of beads.
        free_beads: whether the beads' coordinates are unknowns too.
        priors: names of parameters with a prior; each has a column, requested or not.
        panel: terms of the panel's distortion.
        strained: whether the phantom may be strained.
        arc: whether the object may turn while a frame is exposed.
        rows: whether it may turn while the rows of a frame are read.

    Raises:
        UnknownNameError: a name that is no parameter.
        TwinError: `per_group` names a parameter that is not free.
    """
    require_names((*free, *per_group, *priors))
    for name in per_group:
        if name not in free:
            raise TwinError(
                f"per_group parameter {name!r} is not among the free ones: {', '.join(free)}",
                {"asked": name, "allowed": list(free)},
            )
    held = _held_sources(free, priors)
    unasked = {source for source, _ in held}
    wanted = [n for n in PARAMETERS if n in free and n not in unasked]
    extra = [n for n in PARAMETERS if n in priors and n not in free]
    each = (*per_group, *PLACES) if groups > 1 else ()
    names, colmap = _parameter_columns((*wanted, *extra), each, groups)
    asked = sum(groups if name in each else 1 for name in wanted)
    count = len(names)

    def appended(more: Sequence[str], there: bool) -> int:
        """Append columns if they are there; returns the first one, -1 without."""
        if not there:
            return -1
        names.extend(more)
        return len(names) - len(more)

    bead_names = [f"bead {k} {axis}" for k in range(beads) for axis in "xyz"]
    bead_column = appended(bead_names, free_beads)
    strain_column = appended([f"strain {term}" for term in STRAINS], strained)
    arc_column = appended(["arc"], arc)
    rows_column = appended(["rows"], rows)
    panel_column = appended([f"panel {term}" for term in panel], there=True)
    active = np.array([PARAMETERS.index(n) for n in (*wanted, *extra)], dtype=np.int64)
    return ColumnLayout(
        tuple(names),
        asked,
        colmap,
        bead_column,
        strain_column,
        arc_column,
        rows_column,
        count,
        panel_column,
        active,
        held,
    )


def _parameter_columns(
    parameters: Sequence[str], each: Sequence[str], groups: int
) -> tuple[list[str], npt.NDArray[np.int64]]:
    """Assign columns to parameters in their order: one, or one a group to those of `each`.

    Returns:
        The columns' names, and (groups, 28) the column of each parameter, -1 without.
    """
    names: list[str] = []
    colmap = np.full((groups, len(PARAMETERS)), -1, dtype=np.int64)
    for name in parameters:
        own = [f"{name}@{g}" for g in range(groups)] if name in each else [name]
        colmap[:, PARAMETERS.index(name)] = len(names) + np.arange(len(own))
        names += own
    return names, colmap


def _held_sources(
    free: Sequence[str], priors: Sequence[str]
) -> tuple[tuple[str, str], ...]:
    """List the source's parameters that are held, with the reason: those of `GAUGES` whose
    three shifts are all free and without a prior.
    """
    loose = set(free) - set(priors)
    return tuple(
        (
            source,
            f"held at its start: shifting {source}, {stage} and {detector} together "
            "changes no image, so the source defines the frame",
        )
        for source, stage, detector in GAUGES
        if {source, stage, detector} <= loose
    )


@dataclass(frozen=True, eq=False)
class FitProblem:
    """All input of the kernels; arrays are C-contiguous float64 / int64 / bool.

    Attributes:
        poses: nominal geometry of the n frames.
        model: the phantom's beads.
        measured: (n, k, 2) pixels from the detector's center, 0 where unseen.
        whiten: (n, k, 3) upper triangle (w0, w1; 0, w2) that makes residuals unit variance.
        seen: (n, k) which positions were measured.
        group: (n,) group of each frame.
        base: one start per group, (groups, 28) of PARAMETERS, internal units, in the chosen
            reading.
        layout: columns.
        reading: of eq. 5.4.
        bias: (n, k) sphere-centre bias factor of each position.
        origin: (n, 2) pixel coordinates (column, row) of the detector's center.
        prior_mean, prior_sigma: of each column, internal units; sigma inf without a
            prior.
        panel: terms of the panel's distortion; None: no distortion.
        turning: (n, k, 2, m) shifts of the positions by an exposure of a full step, and by
            each power of the share of a step over which rows are read, as far as they have
            columns (`turning_shifts`); None: each frame is an instant.
        expected_spread: of the whitened residuals, expected before they are seen; 0: nothing is
            expected.
        common: (n, k, 2, c) shifts of the positions [px] by one standard deviation of each of c
            quantities that all frames share; None: positions err each by itself.
    """

    poses: Poses
    model: BeadModel
    measured: FloatArray
    whiten: FloatArray
    seen: npt.NDArray[np.bool_]
    group: npt.NDArray[np.int64]
    base: FloatArray
    layout: ColumnLayout
    reading: Reading
    bias: FloatArray
    origin: FloatArray
    prior_mean: FloatArray
    prior_sigma: FloatArray
    panel: PanelModel | None = None
    turning: FloatArray | None = None
    expected_spread: float = 0.0
    common: FloatArray | None = None

    @property
    def start(self) -> FloatArray:
        """Values of the columns at the start, internal units: the base's for free
        parameters (of a shared one the last group's), the model's for free beads, else 0.
        """
        x = np.zeros(len(self.layout.names))
        free = self.layout.colmap >= 0
        x[self.layout.colmap[free]] = self.base[
            free
        ]  # of a shared column, the last group's
        if self.layout.bead_column >= 0:
            x[self.layout.bead_columns] = self.model.beads.ravel()
        return x

    @cached_property
    def data(self) -> kernels.Data:
        """The problem's arrays as the kernels take them: poses by frame, beads,
        positions, weights and columns. Cached; the beads' first column is -1 if neither
        beads nor strain are free.
        """
        p = self.poses
        return kernels.Data(
            np.column_stack(
                [
                    p.source,
                    p.axis,
                    p.detector,
                    p.u,
                    p.v,
                    p.angle,
                    p.mount[:, :2],
                    *ways(p),
                ]
            ),
            self.group,
            self.reading.pivot,
            self.model.middle,
            self.model.bead_radius_mm,
            self.bias,
            self.measured,
            self.whiten,
            self.layout.active,
            self.layout.colmap,
            self.layout.parameter_count if self._moved_beads else -1,
            self.shift_terms,
        )

    @property
    def _moved_beads(self) -> bool:
        """The beads' places depend on columns."""
        return self.layout.bead_column >= 0 or self.layout.strain_column >= 0

    @cached_property
    def strain_basis(self) -> FloatArray:
        """Displacement (3 k, 9) of the beads' coordinates [mm] by a unit of each strain, which
        leaves their middle where it is.
        """
        beads = self.model.about_middle
        out = np.zeros((len(beads), 3, len(STRAINS)))
        for i, term in enumerate(STRAINS):
            out[:, "xyz".index(term[0]), i] = beads[:, "xyz".index(term[1])]
        return out.reshape(-1, len(STRAINS))

    def _columns_of_kernel(self, x: FloatArray) -> FloatArray | None:
        """Compute the matrix (kernel's columns, columns) by which the kernel's columns change
        with those of the layout at `x`; None where they are the same.

        With strain the kernel's columns have the beads' coordinates, with rows that are
        read one after another each power of their share.
        """
        still = self._columns_without_rows
        if self.layout.rows_column < 0:
            return still
        if still is None:
            still = np.eye(len(self.layout.names))
        powers = np.arange(ROWS_POWERS)
        slopes = np.zeros((ROWS_POWERS, still.shape[1]))
        share = x[self.layout.rows_column]
        slopes[:, self.layout.rows_column] = (powers + 1) * share**powers
        before = len(still) - (still.shape[1] - self.layout.rows_column)
        return np.concatenate([still[:before], slopes, still[before + 1 :]])

    @cached_property
    def _columns_without_rows(self) -> FloatArray | None:
        """Matrix (columns of the kernel, columns) with a single column of the rows' share;
        None without strain.
        """
        if self.layout.strain_column < 0:
            return None
        count = self.layout.parameter_count
        own = 3 * len(self.model)
        shifts = len(self.layout.names) - self.layout.shift_column
        out = np.zeros((count + own + shifts, len(self.layout.names)))
        out[:count, :count] = np.eye(count)
        if self.layout.bead_column >= 0:
            out[count : count + own, self.layout.bead_columns] = np.eye(own)
        out[count : count + own, self.layout.strain_columns] = self.strain_basis
        out[count + own :, self.layout.shift_column :] = np.eye(shifts)
        return out

    def _shift_coefficients(self, x: FloatArray) -> FloatArray:
        """Return the coefficients of `shift_terms`: the layout's, and all powers of the share
        of a step over which rows are read.
        """
        first = self.layout.shift_column
        rows = self.layout.rows_column
        if rows < 0:
            return np.array(x[first:])
        powers = x[rows] ** np.arange(1, ROWS_POWERS + 1)
        return np.concatenate([x[first:rows], powers, x[rows + 1 :]])

    def spread(self, x: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Compute parameter sets and beads for the values `x` of the columns.

        Fixed parameters keep the base's values; without free beads the model's places are
        taken, moved by the strain if that is fitted.

        Returns:
            (groups, 28) of PARAMETERS, internal units, in the problem's reading, and a new
            array (k, 3) [mm], without the phantom's growth.
        """
        columns = self.layout.colmap
        own = self.layout.bead_column
        params = np.where(columns < 0, self.base, np.append(x, 0.0)[columns])
        if own < 0:
            beads = self.model.beads
        else:
            beads = x[self.layout.bead_columns].reshape(-1, 3)
        if self.layout.strain_column >= 0:
            beads = beads + (self.strain_basis @ x[self.layout.strain_columns]).reshape(
                -1, 3
            )
        return params, np.array(beads)

    @cached_property
    def shift_terms(self) -> FloatArray:
        """(n, k, 2, m) shifts of the positions by a coefficient of 1 of the exposure's
        arc and of each power of the rows' turn, if there are any, and each of the panel's
        terms [px]."""
        if self.turning is None:
            return self.panel_terms
        return np.concatenate([self.turning, self.panel_terms], axis=-1)

    @cached_property
    def panel_terms(self) -> FloatArray:
        """(n, k, 2, m) shifts by a coefficient of 1 of each term of the panel's
        distortion, at the measured places [px]; m is 0 without distortion.
        """
        if self.panel is None:
            return np.zeros((*self.measured.shape, 0))
        return self.panel.terms(self.measured + self.origin[:, None, :])

    def parameters(self, x: FloatArray) -> tuple[Offsets, ...]:
        """Return the geometry of each group for column values `x`, in the reading of
        corrections."""
        params, _ = self.spread(x)
        return tuple(to_printed_reading(offsets_in(row), self.reading) for row in params)

    def poses_at(self, x: FloatArray) -> Poses:
        """Return the poses with the told lengths of column values `x`, offsets not applied."""
        params, _ = self.spread(x)
        return poses_at(self.poses, params[self.group])

    def predictions(
        self, x: FloatArray, use: npt.NDArray[np.bool_] | None = None
    ) -> tuple[FloatArray, FloatArray]:
        """Predict positions [px] of all beads, (n, k, 2), and lengths of whitened
        residuals.

        Lengths (n, k) are -1 where unused. Raises TwinError behind the source.
        """
        predicted, norms, _ = self._evaluate(x, self.seen if use is None else use, 0)
        return predicted + self.origin[:, None, :], norms

    def whitened(self, x: FloatArray) -> FloatArray:
        """Compute whitened residuals (n, k, 2), measured minus predicted, in the order of
        `jacobian`; 0 where unseen. Raises as `predictions`.
        """
        predicted = self.predictions(x)[0]
        w = self.whiten
        off = self.measured + self.origin[:, None, :] - predicted
        return np.stack(
            [w[..., 0] * off[..., 0] + w[..., 1] * off[..., 1], w[..., 2] * off[..., 1]],
            axis=-1,
        )

    def jacobian(
        self, x: FloatArray, use: npt.NDArray[np.bool_] | None = None
    ) -> FloatArray:
        """Compute whitened rows d(column, row)/dx, (2 n k, columns), 0 if unused."""
        return self._evaluate(x, self.seen if use is None else use, 2)[2]

    def _evaluate(
        self, x: FloatArray, use: npt.NDArray[np.bool_], want: int
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Evaluate the problem at `x`, as `evaluate`.

        Returns predictions from the detector's center, residuals' norms, Jacobian. Raises
        TwinError: a bead is at or behind the source.
        """
        cost, predicted, norms, jac, _, _ = self.evaluate(x, use, want)
        if not np.isfinite(cost):
            raise TwinError("a bead lies at or behind the source in this geometry")
        return predicted, norms, jac

    def evaluate(
        self,
        x: FloatArray,
        use: npt.NDArray[np.bool_],
        want: int,
        huber: float = math.inf,
    ) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
        """Evaluate column values by `fit_kernels.evaluate`.

        Args:
            x: (c,) column values.
            use, want, huber: as of the kernel.

        Returns:
            Cost (inf if a bead is at or behind the source), predicted, norms, jac (2 n k,
            c), hess (c, c, symmetric) and grad (c,). Zeros where `want` leaves them out;
            jac then has no rows.
        """
        x = np.asarray(x, dtype=np.float64)
        params, beads = self.spread(x)
        table = self._columns_of_kernel(x)
        size = len(x) if table is None else len(table)
        written = (
            np.zeros((*use.shape, 2)),
            np.zeros(use.shape),
            np.zeros((2 * use.size if want == 2 else 0, size)),
            np.zeros((size, size)),
            np.zeros(size),
        )
        shifts = self._shift_coefficients(x)
        cost = kernels.evaluate(
            self.data, params, beads, shifts, use, huber, want, *written
        )
        if want == 0:
            return float(cost), *written
        predicted, norms, jac, hess, grad = written
        if table is None:
            return float(cost), predicted, norms, jac, hess, grad
        return (
            float(cost),
            predicted,
            norms,
            jac @ table,
            table.T @ hess @ table,
            grad @ table,
        )

    @property
    def pixels(self) -> FloatArray:
        """Measured positions (n, k, 2) in pixels of the image, nan where unseen."""
        return np.where(
            self.seen[..., None], self.measured + self.origin[:, None, :], np.nan
        )

    def prior_weight(self, noise: float) -> FloatArray:
        """Compute the weight of each column's prior against whitened residuals of that
        spread; 0 without one.

        Priors are absolute, and the residuals only known up to their spread s: s^2 / sigma^2."""
        return np.asarray((noise / self.prior_sigma) ** 2)

    def with_paths_at(self, x: FloatArray) -> FitProblem:
        """Return the problem with the paths of the beads, along which they turn while a frame
        is exposed or read, at the geometry of column values `x`.
        """
        params, beads = self.spread(x)
        paths = turning_shifts(
            self.poses_at(x),
            beads,
            params,
            self.group,
            self.reading,
            panel_heights(self.measured, self.origin),
        )
        columns = self.layout
        return replace(
            self, turning=_with_columns(paths, columns.arc_column, columns.rows_column)
        )

    def with_base(self, base: FloatArray) -> FitProblem:
        """Return the problem with other starts, one row of PARAMETERS for each group."""
        return replace(self, base=base)


def _groups(labels: npt.ArrayLike | None, n: int) -> npt.NDArray[np.int64]:
    """Give the groups of n frames numbers in the order of their labels, (n,); 0 without.

    Raises:
        TwinError: not one label a frame.
    """
    if labels is None:
        return np.zeros(n, dtype=np.int64)
    given = np.asarray(labels)
    if given.shape != (n,):
        raise TwinError.of_shape("groups", given.shape, (n,))
    return np.unique(given, return_inverse=True)[1].astype(np.int64).reshape(n)


def _bases(
    start: Offsets | Sequence[Offsets], groups: int, reading: Reading
) -> FloatArray:
    """Return the start of each group, (groups, 28), internal units, in a reading.

    Raises TwinError: several starts, but not one a group.
    """
    starts = [start] * groups if isinstance(start, Offsets) else list(start)
    if len(starts) != groups:
        raise TwinError(f"{len(starts)} starts for {groups} groups of frames")
    return np.array([values_in(from_printed_reading(p, reading)) for p in starts])


def _common_shifts(common: npt.ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """Return shifts that all frames have in common, (n, k, 2, c).

    Raises TwinError: they are not of the tracks' shape.
    """
    shared = np.asarray(common, dtype=np.float64)
    if shared.shape[:-1] != shape:
        raise TwinError.of_shape("common shifts", shared.shape[:-1], shape)
    return shared


def build_problem(
    tracks: npt.ArrayLike,
    model: BeadModel,
    geometry: Poses | ConeVec,
    *,
    free: Sequence[str],
    shape: Shape,
    covariances: npt.ArrayLike | None = None,
    noise_px: float = 1.0,
    groups: npt.ArrayLike | None = None,
    per_group: Sequence[str] = (),
    free_beads: bool = False,
    start: Offsets | Sequence[Offsets] = NOMINAL,
    reading: Reading = Reading.AXIS_AT_O_PLUS_TAU,
    centre: Centre | npt.ArrayLike = Centre.POINT,
    bead_tolerance_mm: float = math.inf,
    priors: Mapping[str, float] | None = None,
    prior_centre: Offsets | None = None,
    panel: PanelModel | None = None,
    strain: Strain = UNSTRAINED,
    arc: bool = False,
    rows: bool = False,
    expected_spread: float = 0.0,
    common: npt.ArrayLike | None = None,
) -> FitProblem:
    """Check the arguments of a fit and put them into arrays.

    Args:
        tracks: (n, k, 2) measured column and row of each bead [px], nan where not seen.
        model: k beads [mm].
        geometry: n stated poses.
        free: names of the parameters to estimate.
        shape: (rows, cols), of all frames or of each.
        covariances: (n, k, 2, 2) of the tracks [px^2]; `noise_px` without.
        noise_px: sigma of the tracks.
        groups: (n,) labels of the scans; frames of a label share their parameters. Groups
            are numbered in the order of sorted labels.
        per_group: names of free parameters with a value in each scan.
        free_beads: the beads' positions are estimated, too.
        start: offsets to start from, of all scans or of each.
        reading: definition of the offsets of the axis.
        centre: kind of the positions, or bias factors that broadcast to (n, k).
        bead_tolerance_mm: sigma of the stated bead positions, if they are free; inf: no
            prior.
        priors: sigma of each offset; see `estimate_geometry`. Widths of 0 have no column.
        prior_centre: means of the priors; `start` of the first group without.
        panel: distortion of the panel to estimate.
        strain: distortion of the phantom to estimate, with its prior; (0, 0): none.
        arc: the arc that the object turns during an exposure is estimated, too.
        rows: the arc that it turns while a frame's rows are read is estimated, too.
        expected_spread: see `FitProblem`.
        common: see `FitProblem`.

    Returns:
        The problem; perhaps without any seen position.

    Raises:
        TwinError: shapes or numbers do not fit together, a covariance is not positive
            definite, or `per_group` is not free.
        UnknownNameError: a name that is no parameter.
    """
    poses = as_poses(geometry)
    t = np.array(tracks, dtype=np.float64)
    n = len(poses)
    k = len(model)
    if t.shape != (n, k, 2):
        raise TwinError.of_shape(
            "tracks", t.shape, (n, k, 2), f" for {n} frames and {k} beads"
        )
    seen = np.ascontiguousarray(np.isfinite(t).all(axis=2))
    origin = (frame_shapes(shape, n)[:, ::-1] - 1) / 2
    measured = np.where(seen[:, :, None], t - origin[:, None, :], 0.0)
    group = _groups(groups, n)
    base = _bases(start, int(group.max()) + 1 if n else 1, reading)
    acting = told_by(poses, group, per_group)
    widths = {
        n: w if n in TOLD else to_internal(n, w)
        for n, w in (priors or {}).items()
        if w > 0 and (n in acting or n in NAMES)
    }
    terms, of_terms = ((), ()) if panel is None else (panel.names, panel.sigmas)
    strained = max(strain) > 0
    columns = layout(
        free, len(base), per_group, k, free_beads, tuple(widths), terms, strained, arc,
        rows,
    )  # fmt: skip
    centres = base[0]
    if prior_centre is not None:
        centres = values_in(from_printed_reading(prior_centre, reading))
    bases = [n.split("@")[0] for n in columns.names[: columns.parameter_count]]
    beads = 3 * k if free_beads else 0
    strains = strain_widths(strain) if strained else np.zeros(0)
    shared = None if common is None else _common_shifts(common, t.shape)
    turning = None
    if arc or rows:
        places = panel_heights(measured, origin)
        paths = turning_shifts(poses, model.beads, base, group, reading, places)
        turning = _with_columns(paths, columns.arc_column, columns.rows_column)
    mean = [centres[PARAMETERS.index(n)] for n in bases]
    sigma = [widths.get(n, math.inf) for n in bases]
    return FitProblem(
        poses=poses,
        model=model,
        measured=np.ascontiguousarray(measured),
        whiten=whitening(covariances, noise_px, seen),
        seen=seen,
        group=group,
        base=base,
        layout=columns,
        reading=reading,
        bias=bias_factors(centre, (n, k)),
        origin=origin,
        prior_mean=np.concatenate(
            [
                mean,
                model.beads.ravel()[:beads],
                np.zeros(len(strains) + arc + rows + len(terms)),
            ]
        ),
        prior_sigma=np.concatenate(
            [
                sigma,
                np.repeat(bead_tolerance_mm * model.spreads, 3)[:beads],
                strains,
                np.full(int(arc), ARC_PRIOR),
                np.full(int(rows), ROWS_PRIOR),
                of_terms,
            ]
        ),
        panel=panel,
        turning=turning,
        expected_spread=expected_spread,
        common=shared,
    )


def strain_widths(strain: Strain) -> FloatArray:
    """Return the standard deviation of each of STRAINS, (9,)."""
    stretch, shear = (max(width, LEAST_STRAIN) for width in strain)
    return np.array([stretch] * STRETCHES + [shear] * (len(STRAINS) - STRETCHES))


def usual_step(angle: FloatArray) -> float:
    """Return the median step of a stage between frames at some angles [rad]; 0 for one frame."""
    return float(np.median(np.abs(np.diff(angle)))) if len(angle) > 1 else 0.0


def panel_heights(measured: FloatArray, origin: FloatArray) -> FloatArray:
    """Compute rows from the panel's middle in panel heights, (n, k)."""
    return np.asarray(measured[..., 1] / (2.0 * origin[:, None, 1] + 1.0))


def _with_columns(paths: FloatArray, arc_column: int, rows_column: int) -> FloatArray:
    """Take those of `turning_shifts` that have columns; -1: none."""
    return paths[..., [arc_column >= 0, *[rows_column >= 0] * ROWS_POWERS]]


def turning_shifts(
    poses: Poses,
    beads: FloatArray,
    base: FloatArray,
    group: npt.NDArray[np.int64],
    reading: Reading,
    places: FloatArray,
) -> FloatArray:
    """Compute shifts of beads' positions by a stage that turns on, by a usual step a
    frame.

    A path p of the angle has the mean p + p'' arc^2 / 24 over an arc (2e-4 px of 100 px
    off for 15 deg). A row read when the stage has turned on by t shows p + p' t + p'' t^2
    / 2 + p''' t^3 / 6 (5e-4 px of 100 px off for 6 deg).

    Args:
        base: (groups, 28) values of PARAMETERS, internal units, in the reading.
        places: (n, k) rows from the panel's middle, in panel heights.

    Returns:
        (n, k, 2, 1 + ROWS_POWERS) [px], of the exposure and of the rows' powers; 0 in
            groups of one frame.
    """
    out = np.zeros((len(poses), len(beads), 2, 1 + ROWS_POWERS))
    for g, row in enumerate(base):
        mine = group == g
        some = poses[np.flatnonzero(mine)]
        if len(some) < 2:
            continue
        step = usual_step(some.angle)
        offsets = to_printed_reading(offsets_in(row), reading)
        slope, bent, twisted = _path_derivatives(some, offsets, beads)
        out[mine, ..., 0] = bent * step**2 / 24.0
        way = float(np.sign(np.median(np.diff(some.angle))))
        late = (way * step * places[mine])[..., None]
        out[mine, ..., 1] = slope * late
        out[mine, ..., 2] = bent * late**2 / 2.0
        out[mine, ..., 3] = twisted * late**3 / 6.0
    return out


def _path_derivatives(
    poses: Poses, offsets: Offsets, beads: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Compute the first three derivatives of the beads' positions by the stage's angle, each
    (n, k, 2) [px/rad, px/rad^2, px/rad^3], from positions at five angles.
    """
    h = ARC_ANGLE_RAD
    before, behind, here, ahead, beyond = (
        replace(poses, angle=poses.angle + i * h)
        .cone_vec(offsets)
        .project_points(beads, (1, 1))
        for i in (-2, -1, 0, 1, 2)
    )
    odd, far_odd = ahead - behind, beyond - before
    even, far_even = ahead + behind, beyond + before
    return (
        (8.0 * odd - far_odd) / (12.0 * h),
        (16.0 * even - far_even - 30.0 * here) / (12.0 * h**2),
        (far_odd - 2.0 * odd) / (2.0 * h**3),
    )


def frame_shapes(shape: Shape, frames: int) -> FloatArray:
    """Return the detector (rows, cols) of each frame, (n, 2) float64.

    Args:
        shape: of all frames, or of each; None: the default machine's.
        frames: n.

    Raises:
        TwinError: `shape` is neither (2,) nor (n, 2).
    """
    value = builtin_machine().detector.camera.shape if shape is None else shape
    try:
        return np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), (frames, 2)))
    except ValueError:
        raise TwinError(
            f"shape {np.shape(value)} is neither (rows, cols) nor one pair for each of "
            f"{frames} frames"
        ) from None


def as_poses(geometry: Poses | ConeVec) -> Poses:
    """Return the poses of a geometry; GeometryError if rows tell no angles."""
    if isinstance(geometry, Poses):
        return geometry
    return Poses.from_cone_vec(geometry)


def bias_factors(centre: Centre | npt.ArrayLike, shape: tuple[int, int]) -> FloatArray:
    """Return the sphere-centre bias factor of every position, (n, k).

    Args:
        centre: kind of the positions, a value for all, or an array that broadcasts; NaN
            becomes 0.
        shape: (n, k).

    Raises:
        TwinError: an array of another shape.
    """
    value = centre.value if isinstance(centre, Centre) else centre
    try:
        out = np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), shape))
    except ValueError:
        raise TwinError.of_shape("centre", np.shape(value), shape) from None
    return np.nan_to_num(out)


def whitening(
    covariances: npt.ArrayLike | None, noise_px: float, seen: npt.NDArray[np.bool_]
) -> FloatArray:
    """Compute upper triangular W with W C W' = 1 for each detection.

    Args:
        covariances: (n, k, 2, 2) [px^2], or None.
        noise_px: standard deviation of all coordinates, without covariances.
        seen: (n, k) positions that were measured; others get 0 with covariances, and 1 /
            noise_px without.

    Returns:
        (n, k, 3): w0, w1, w2 of (w0, w1; 0, w2) [1/px].

    Raises:
        TwinError: covariances of another shape, one of a seen bead is not positive
            definite, or noise_px <= 0.
    """
    out = np.zeros((*seen.shape, 3))
    if covariances is None:
        if not noise_px > 0:
            raise TwinError(f"noise_px is {noise_px}; it must be positive")
        out[..., 0] = out[..., 2] = 1.0 / noise_px
        return out
    c = np.asarray(covariances, dtype=np.float64)
    if c.shape != (*seen.shape, 2, 2):
        raise TwinError.of_shape("covariances", c.shape, (*seen.shape, 2, 2))
    cc = c[..., 0, 0]
    cr = c[..., 0, 1]
    rr = c[..., 1, 1]
    bad = seen & ~((rr > 0) & (cc * rr - cr * cr > 0))
    if bad.any():
        frame, bead = (int(i[0]) for i in np.nonzero(bad))
        raise TwinError(
            f"covariance of bead {bead} in frame {frame} is not positive definite",
            {"frame": frame, "bead": bead},
        )
    with np.errstate(invalid="ignore", divide="ignore"):
        # Remove from the column what the row explains, then scale both.
        w0 = 1.0 / np.sqrt(cc - cr * cr / rr)
        out[..., 0] = w0
        out[..., 1] = -w0 * cr / rr
        out[..., 2] = 1.0 / np.sqrt(rr)
    out[~seen] = 0.0
    return out


def values_in(p: Offsets) -> FloatArray:
    """List values of `p` in the order of PARAMETERS, internal units; told lengths are right."""
    return np.array([getattr(p, name) for name in NAMES] + [0.0] * len(TOLD))


def to_printed_reading(p: Offsets, reading: Reading) -> Offsets:
    """Convert values in `reading` to the reading of `Poses.cone_vec` (the axis at O + tau)."""
    if reading.pivot:
        return p
    return replace(p, dO_x=p.dO_x - p.tau_x, dO_z=p.dO_z - p.tau_z)


def from_printed_reading(p: Offsets, reading: Reading) -> Offsets:
    """Convert values in the reading of `Poses.cone_vec` to `reading`."""
    if reading.pivot:
        return p
    return replace(p, dO_x=p.dO_x + p.tau_x, dO_z=p.dO_z + p.tau_z)


def edge_factor(column: str) -> float:
    """Return the edge units per internal unit of a column: deg per rad, else 1."""
    name = column.split("@")[0]
    if name in NAMES:
        return to_edge(name, 1.0)
    return 1.0


def edge_factors(columns: Iterable[str]) -> FloatArray:
    """Return `edge_factor` of each of some columns, (p,)."""
    return np.array([edge_factor(column) for column in columns])
