"""The fit of a geometry to bead tracks: the public entry points of the estimation.

`estimate_geometry` always returns what the data determine, with its uncertainty report.
`fit_geometry` does the same but raises where the data do not determine what was requested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.fit.certificate import Certificate, certify, spread_of_residuals
from flexdt.twin.calibration.fit.priors import require_widths
from flexdt.twin.calibration.fit.problem import (
    SIX,
    Centre,
    FitProblem,
    Reading,
    Shape,
    build_problem,
    from_printed_reading,
    values_in,
)
from flexdt.twin.calibration.fit.solver import Solution, Solver, cost_at, solve
from flexdt.twin.calibration.fit.weak_directions import BOUND
from flexdt.twin.errors import NotIdentifiableError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.panel import Panel, PanelModel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.signatures import with_arguments_of

LEAST_NOISE = 1e-4
"""Exact data are weighed as if their whitened residuals had this spread: a prior then still keeps
what the data say nothing about, and counts when the rank is judged."""


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted geometry.

    Attributes:
        parameters: the whole geometry of the first (usually only) group, internal units, in the
            reading `Poses.cone_vec` and corrections use.
        group_parameters: the same for every group.
        beads: (k, 3) bead positions, moved if they were free [mm].
        certificate: values with uncertainties and everything else about quality.
        reading: reading of eq. 5.4 in which the estimates are expressed.
        iterations: Levenberg-Marquardt iterations.
        start_cost, cost: half the squared whitened residuals at start and end.
        converged: the solver met its tolerance.
        problem: the problem that was solved, for further analysis.
        solution: column values.
        bead_prior_mm: standard deviation of the prior on bead positions; 0 if they were fixed.
    """

    parameters: Offsets
    group_parameters: tuple[Offsets, ...]
    beads: FloatArray
    certificate: Certificate
    reading: Reading
    iterations: int
    start_cost: float
    cost: float
    converged: bool
    problem: FitProblem
    solution: Solution
    bead_prior_mm: float = 0.0

    @property
    def panel(self) -> Panel | None:
        """The panel's distortion; None if it was not estimated."""
        model, first = self.problem.panel, self.problem.layout.panel_column
        return None if model is None else Panel(model, tuple(self.solution.x[first:].tolist()))

    @property
    def values(self) -> dict[str, float]:
        """Fitted value of each free column in edge units (mm, deg, 1)."""
        return {name: e.value for name, e in self.certificate.estimates.items()}

    @property
    def sigmas(self) -> dict[str, float]:
        """Standard deviation of each free column in edge units."""
        return {name: e.sigma for name, e in self.certificate.estimates.items()}

    @property
    def covariance(self) -> FloatArray:
        """(p, p) in the order of `values`, edge units."""
        return self.certificate.covariance

    @property
    def identifiable(self) -> bool:
        """Every free parameter is determined."""
        return self.certificate.identifiable

    @property
    def cost_reduction_pct(self) -> float:
        """100 (c0 - c) / c0, the thesis's second metric; nan if the start was perfect."""
        if not self.start_cost > 0:
            return math.nan
        return 100.0 * (self.start_cost - self.cost) / self.start_cost


def estimate_geometry(
    tracks: npt.ArrayLike,
    phantom: BeadPhantom | BeadModel | npt.ArrayLike,
    geometry: Poses | ConeVec,
    free: Sequence[str] = SIX,
    *,
    shape: Shape = None,
    covariances: npt.ArrayLike | None = None,
    noise_px: float = 1.0,
    groups: npt.ArrayLike | None = None,
    per_group: Sequence[str] = (),
    free_beads: bool = False,
    bead_tolerance_mm: float | None = None,
    start: Offsets | Sequence[Offsets] = NOMINAL,
    reading: Reading = Reading.AXIS_AT_O_PLUS_TAU,
    centre: Centre | npt.ArrayLike = Centre.POINT,
    sampling_px: float = 0.0,
    solver: Solver | None = None,
    priors: Mapping[str, float] | None = None,
    prior_centre: Offsets | None = None,
    bound: float = BOUND,
    panel: PanelModel | None = None,
) -> FitResult:
    """Fit offsets (true minus nominal) to measured bead positions.

    Several scans go into one fit by concatenating their frames: poses link them through the motor
    readings, `groups` says which frames belong together and `per_group` which parameters each
    group has for itself (for example alpha, tau_x and tau_z after the phantom was remounted).

    Args:
        tracks: (n, k, 2) pixels (column, row), nan where a bead was not seen.
        phantom: k beads: anything with `beads` and `bead_radius_mm`, or their centres (k, 3) [mm].
        geometry: nominal geometry of each of the n frames.
        free: parameters to estimate, names of INTERFACE; what has no prior either stays at
            `start`. If source, stage and detector shifts of one direction are all free, the source
            is fixed.
        shape: detector (rows, cols); None is the default machine's camera.
        covariances: (n, k, 2, 2) of the positions [px^2]; None is noise_px for all.
        noise_px: standard deviation of a coordinate. Only ratios matter for the values; sigmas
            follow the residuals.
        groups: (n,) label of each frame's group; None is one group.
        per_group: names among `free` with a value in each group.
        free_beads: estimate bead positions too (bundle adjustment), with
        bead_tolerance_mm: the standard deviation of their prior; None is the phantom's own.
        start: where to start, and the value of what is not free.
        reading: of eq. 5.4.
        centre: what the positions are: projected centres or outline centres; or the bias factor of
            each position, (n, k), such as 0.8 for a centroid weighted by chord length.
        sampling_px: see `certify`; 0 for points, about 0.001 for centroids in images.
        solver: None is Huber, trimming, then least squares.
        priors: parameter -> standard deviation of what is known of it beforehand [mm, deg, 1]; 0
            is exactly known. A parameter that is not in `free` is estimated along with them. None:
            everything that is not free is exactly where `start` has it (`fit.priors` has widths
            for scanners).
        prior_centre: the offsets those priors are centred on; None is the start of the first group.
        bound: sigma [mm, deg] beyond which a direction counts as not determined.
        panel: terms of a distortion of the panel, estimated too; None: it has none.

    Returns:
        The fit with its certificate, also where not everything is determined.

    Raises:
        TwinError: shapes do not match, nothing was seen, a width is no length, or free beads
            without a tolerance.
        UnknownNameError: a name that is no parameter.
    """
    model = bead_model(phantom)
    tolerance = model.tolerance_mm if bead_tolerance_mm is None else bead_tolerance_mm
    if free_beads and not tolerance > 0:
        raise TwinError(
            "free beads need a tolerance as prior (phantom's, or bead_tolerance_mm > 0): without "
            "one, moving all beads is the same as moving the object",
            {"asked": tolerance, "allowed": "> 0"},
        )
    problem = build_problem(
        tracks, model, geometry, free=free, shape=shape, covariances=covariances,
        noise_px=noise_px, groups=groups, per_group=per_group, free_beads=free_beads, start=start,
        reading=reading, centre=centre, bead_tolerance_mm=tolerance,
        priors=require_widths(priors or {}), prior_centre=prior_centre, panel=panel,
    )  # fmt: skip
    if not problem.seen.any():
        raise TwinError("no bead was seen in any frame: there is nothing to fit", {"seen": 0})
    solution, noise = _solved(problem, solver)
    certificate = certify(problem, solution.x, solution.use, noise, sampling_px, bound)
    groups_at = problem.parameters(solution.x)
    return FitResult(
        parameters=groups_at[0],
        group_parameters=groups_at,
        beads=problem.spread(solution.x)[1],
        certificate=certificate,
        reading=problem.reading,
        iterations=solution.iterations,
        start_cost=solution.start_cost,
        cost=solution.cost,
        converged=solution.converged,
        problem=problem,
        solution=solution,
        bead_prior_mm=tolerance if free_beads else 0.0,
    )


@with_arguments_of(estimate_geometry)
def fit_geometry(*args: Any, **options: Any) -> FitResult:
    """Fit offsets to measured bead positions; an undetermined parameter is an error.

    Arguments and result are those of `estimate_geometry`.

    Raises:
        NotIdentifiableError: names the directions that are not determined, with advice.
        TwinError, UnknownNameError: as `estimate_geometry`.

    Example: the object stands 0.5 mm further to the right than the motors say.

    >>> import numpy as np
    >>> from flexdt.phantoms import bead_phantom
    >>> from flexdt.twin.geometry.poses import Poses
    >>> angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    >>> poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, angle)
    >>> phantom = bead_phantom("normal", 5)
    >>> from flexdt.twin.geometry.offsets import Offsets
    >>> tracks = poses.cone_vec(Offsets(dO_x=0.5)).project_points(phantom.beads, (760, 956))
    >>> fit = fit_geometry(tracks, phantom, poses, shape=(760, 956))
    >>> round(fit.values["dO_x"], 6)
    0.5
    """
    return require_identifiable(estimate_geometry(*args, **options))


def require_identifiable(result: FitResult) -> FitResult:
    """Return `result` if every parameter is determined.

    Raises:
        NotIdentifiableError: otherwise; data has rank, parameters and the directions.
    """
    spectrum = result.certificate.spectrum
    if not spectrum.full:
        directions = [d.text for d in spectrum.null]
        raise NotIdentifiableError(
            f"not identifiable: {len(directions)} of {len(spectrum.names)} directions are open: "
            + "; ".join(directions),
            {
                "asked": list(spectrum.names),
                "rank": spectrum.rank,
                "parameters": len(spectrum.names),
                "directions": directions,
            },
        )
    return result


def with_start(result: FitResult, start: Offsets, iterations: int) -> FitResult:
    """The result of a chain of fits, counted from the start of the first.

    Args:
        result: the last fit of the chain.
        start: offsets at which the first fit started; the start cost is computed there.
        iterations: of all fits together.
    """
    problem = result.problem
    base = np.array([values_in(from_printed_reading(start, problem.reading))] * len(problem.base))
    begun = problem.with_base(base)
    cost = cost_at(begun, begun.start, result.solution.use)
    return replace(result, start_cost=cost, iterations=iterations)


def _solved(problem: FitProblem, solver: Solver | None) -> tuple[Solution, float]:
    """The solution, and the spread of the whitened residuals its priors were weighed with, which is
    that of the previous pass."""
    noise, x = 1.0, problem.start
    for _ in range(4):
        solution = solve(problem, solver, x=x, prior_noise=noise)
        if np.isinf(problem.prior_sigma).all():
            break
        x = solution.x
        fresh = max(spread_of_residuals(problem, x, solution.use, noise)[0], LEAST_NOISE)
        if not abs(fresh - noise) >= 0.01 * noise:
            break
        noise = fresh
    return solution, noise
