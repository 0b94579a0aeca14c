"""The fit of a geometry to bead tracks: the public entry points of the estimation, its
solver, and quantities that follow from its covariance.

`estimate_geometry` always returns an estimate, with its uncertainty report.
`fit_geometry` does the same but raises where the data do not determine the requested
parameters.

The solver is Levenberg-Marquardt. Its Huber stage finds the solution in spite of outliers;
positions further than `trim` robust standard deviations are then left out and the rest is
fitted by plain least squares, so that the covariance is that of least squares on clean data.

The quantities that a reconstruction needs (axis column, in-plane angle and magnification)
are known far better than the offsets of which they are functions: offsets that trade
against each other (a detector aside and an object aside) leave the images as they are. So
their sigmas need the full covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack
from scipy.special import stdtrit

from flexdt.twin.calibration.bead_model import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.fit.certificate import (
    SPREAD_FREEDOM,
    Certificate,
    Estimate,
    certify,
    spread_of_residuals,
)
from flexdt.twin.calibration.fit.priors import require_widths
from flexdt.twin.calibration.fit.problem import (
    SIX,
    UNSTRAINED,
    Centre,
    FitProblem,
    Reading,
    Shape,
    Strain,
    build_problem,
    edge_factor,
    edge_factors,
    from_printed_reading,
    values_in,
)
from flexdt.twin.calibration.fit.weak_directions import BOUND
from flexdt.twin.errors import NotIdentifiableError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.motion import Motion
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.panel import Panel, PanelModel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.signatures import with_arguments_of

PATH_SIGMAS = 0.1
"""Change of a position [standard deviation] that other paths of the beads may make."""
PATH_ROUNDS = 4
"""Solutions with the paths of the one before, at most."""
RAYLEIGH_MEDIAN = 1.1774100225154747
"""Median length of a 2-vector with independent unit normal parts."""
LEAST_PIVOT = 1e-15
"""Least pivot of the scaled normal equations; below it is rounding."""
LEAST_NOISE = 1e-4
"""Least spread of whitened residuals, assumed for exact data: priors then still fix
directions that the data leave open, and count when the rank is judged."""
FEW_VALUES: Final = 4
"""Measured coordinates per column up to which two spreads of the residuals are tried."""
QUIET_SHARES: Final = (0.1, 0.01)
"""Parts of the spread that was found from which smaller ones are sought."""
QUIET_LOG_ODDS: Final = math.log(10.0)
"""Logarithm of the odds from which a smaller spread is believed."""
TRIMMED_SPREADS: Final = 10.0
"""Range of positions that are left out, in the larger of their noise and sigma; assumed."""
IN_IMAGES: Final[Mapping[str, str]] = {
    "axis_column": "px",
    "axis_angle": "deg",
    "magnification": "1",
}
"""axis_column: where the image of the rotation axis crosses the detector's middle row.
axis_angle: of that image against the detector's columns, positive where its upper end leans to
    the right.
magnification: of a short line parallel to the detector's rows, on the axis at the object's
reference height."""

SLOPE_STEP: Final = 1e-4
"""Step [mm, deg, 1] of the differences that give their derivatives."""


@dataclass(frozen=True)
class Solver:
    """Settings of the solver.

    Attributes:
        huber: threshold of the Huber loss in robust standard deviations; inf switches it off.
        trim: positions beyond this many robust standard deviations are left out; inf: all
            are kept.
        floor_px: the robust spread is taken to be at least this [whitened units], so that exact
            data have no outliers.
        max_iterations: of each Levenberg-Marquardt run.
        tolerance: stop when the residuals' rms would change by less [whitened units].
        spread_px: spread of the residuals that is expected before they are seen [whitened
            units], see `certificate.spread_of_residuals`; 0: nothing is expected.
    """

    huber: float = 3.0
    trim: float = 5.0
    floor_px: float = 1e-3
    max_iterations: int = 60
    tolerance: float = 1e-9
    spread_px: float = 0.0


LEAST_SQUARES = Solver(huber=math.inf, trim=math.inf)
"""No robustness at all."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Column values and how they were reached.

    Attributes:
        x: column values, internal units.
        use: (n, k) positions that counted at the end.
        iterations: Levenberg-Marquardt iterations, all stages.
        start_cost, cost: half the sum of squared whitened residuals of `use`, at start and end.
        converged: the last stage met its tolerance.
    """

    x: FloatArray
    use: npt.NDArray[np.bool_]
    iterations: int
    start_cost: float
    cost: float
    converged: bool


def solve(
    problem: FitProblem,
    solver: Solver | None = None,
    *,
    x: FloatArray | None = None,
    prior_noise: float = 1.0,
) -> Solution:
    """Minimise the robust reprojection error, first with a Huber loss, then by least
    squares without the positions that are far off, in up to four rounds.

    Ends when the same positions are used again, when fewer than half as many as columns
    would be left, or, without a limit to trim by, after one round.

    Args:
        problem: the data and columns.
        solver: settings; the default is robust.
        x: start of the columns; None is the problem's own.
        prior_noise: spread of the whitened residuals, with which the problem's priors are
            weighed.

    Returns:
        Values, used positions, iterations of all rounds and whether the last one
        converged; a start with a bead behind the source is returned as it is.
    """
    how = Solver() if solver is None else solver
    value = np.array(problem.start if x is None else x, dtype=np.float64)
    use = problem.seen
    first = value
    value, iterations, huber, converged = _levenberg(
        problem, value, use, how, prior_noise
    )
    for _ in range(4):
        norms = problem.predictions(value)[1]
        limit = how.trim * _spread(norms[use], len(value), how.floor_px)
        keep = problem.seen & (norms <= limit)
        settled = np.array_equal(keep, use) and (norms[use] <= huber).all()
        if settled or keep.sum() * 2 < len(value):
            break
        use = keep
        plain = replace(how, huber=math.inf)
        value, more, huber, converged = _levenberg(
            problem, value, use, plain, prior_noise
        )
        iterations += more
        if math.isinf(how.trim):
            break
    return Solution(
        x=value,
        use=use,
        iterations=iterations,
        start_cost=cost_at(problem, first, use),
        cost=cost_at(problem, value, use),
        converged=converged,
    )


def _spread(norms: FloatArray, columns: int, floor: float) -> float:
    """Compute the robust sigma of (m,) lengths of residuals, larger for few data.

    A fit absorbs noise, and a median of few is unreliable. Returns inf without freedom.
    """
    dof = 2 * len(norms) - columns
    if dof <= 0:
        return math.inf
    generous = math.sqrt(2 * len(norms) / dof) * (1.0 + 8.0 / dof)
    return max(floor, generous * _median(norms) / RAYLEIGH_MEDIAN)


def _median(values: FloatArray) -> float:
    """Compute the median of (m,) values, one at least, in a fifth of the time of
    `numpy.median` for some hundred: fits need it several times a step.
    """
    ordered = np.sort(values)
    middle = len(ordered) // 2
    if len(ordered) % 2:
        return float(ordered[middle])
    return 0.5 * float(ordered[middle - 1] + ordered[middle])


def _levenberg(
    p: FitProblem,
    x: FloatArray,
    use: npt.NDArray[np.bool_],
    how: Solver,
    prior_noise: float,
) -> tuple[FloatArray, int, float, bool]:
    """Run Levenberg-Marquardt with Marquardt's diagonal from `x`.

    The first step is tried almost undamped; damping appears only when a step fails. The
    Huber threshold follows the residuals: `how.huber` times their robust spread. Stops
    when a step is predicted to change the residuals' rms by less than the tolerance plus
    a millionth of it, after 40 failed steps, or after the iterations allowed.

    Args:
        p: the problem.
        x: (columns,) values to start from.
        use: (frames, beads) spots that count.
        how: settings of the solver.
        prior_noise: spread of the whitened residuals, which scales the priors' weight.

    Returns:
        (values, iterations, Huber threshold, converged); the start, 0 and False if its
        cost is infinite.
    """
    weight = p.prior_weight(prior_noise)
    rows = max(1, 2 * int(np.count_nonzero(use)))
    huber = math.inf

    def at(x: FloatArray) -> tuple[float, FloatArray, FloatArray, FloatArray]:
        """Evaluate cost, norms of the residuals, and Hessian and gradient with the priors in
        them.

        The cost is inf if a bead is at or behind the source."""
        cost, _, norms, _, hess, grad = p.evaluate(x, use, 1, huber)
        off = x - p.prior_mean
        hess.flat[:: len(x) + 1] += weight
        return cost + 0.5 * float(weight @ off**2), norms, hess, grad + weight * off

    def threshold(norms: FloatArray) -> float:
        """Compute the whitened residual norm beyond which Huber's loss is linear."""
        if use.any():
            spread = _median(norms[use]) / RAYLEIGH_MEDIAN
        else:
            spread = 0.0
        return how.huber * max(how.floor_px, spread)

    robust = math.isfinite(how.huber)
    if robust:
        huber = threshold(p.evaluate(x, use, 0)[2])
    cost, norms, hess, grad = at(x)
    if not cost < math.inf:
        return x, 0, huber, False
    damping = 1e-9
    iterations = 0
    converged = len(x) == 0
    small = False
    while iterations < how.max_iterations and not converged:
        iterations += 1
        accepted = False
        for _ in range(40):
            step = _step(hess, grad, damping)
            if step is None:
                damping = max(damping * 10.0, 1e-12)
                continue
            damped = damping * float(np.diag(hess) @ step**2)
            change = -float(step @ grad) - damped  # step' H step
            least = how.tolerance + 1e-6 * math.sqrt(2.0 * cost / rows)
            small = math.sqrt(abs(change) / rows) < least
            there = x + step
            trial = at(there)
            accepted = trial[0] < cost or (
                small and trial[0] <= cost * (1.0 + 1e-9) + 1e-24
            )
            if accepted or small:
                break
            damping = max(damping * 10.0, 1e-4)
        converged = small
        if not accepted:
            break
        gain = cost - trial[0]
        promised = 0.5 * change + damped
        if gain > 0.5 * promised:
            damping = max(damping * 0.02, 1e-14)
        elif gain < 0.1 * promised:
            damping = max(damping * 4.0, 1e-6)
        x = there
        cost, norms, hess, grad = trial
        if robust and not converged:
            fresh = threshold(norms)
            if abs(fresh - huber) > 0.02 * huber:
                changed = (norms > min(fresh, huber)).any()
                huber = fresh
                if changed:
                    cost, norms, hess, grad = at(x)
    return x, iterations, huber, converged


def _step(hess: FloatArray, grad: FloatArray, damping: float) -> FloatArray | None:
    """Solve the column-scaled, damped normal equations.

    `hess`: (c, c), not changed; `grad`: (c,); `damping`: added to the scaled diagonal, which is
    1.
    Returns the step (c,) down the gradient; None where the equations are not positive definite,
    or only by rounding (`LEAST_PIVOT`).
    """
    diagonal = np.diag(hess)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scaled = hess * np.outer(scale, scale)
    scaled.flat[:: len(grad) + 1] += damping
    factor, solved, failed = lapack.dposv(scaled, grad * scale)
    if failed or (np.diag(factor) ** 2 <= LEAST_PIVOT).any():
        return None
    return np.asarray(-scale * solved)


def cost_at(problem: FitProblem, x: FloatArray, use: npt.NDArray[np.bool_]) -> float:
    """Compute half the whitened squares of `use`, no priors; inf behind the source."""
    try:
        norms = problem.predictions(x)[1]
    except TwinError:
        return math.inf
    return float(0.5 * np.sum(norms[use] ** 2))


@dataclass(frozen=True, eq=False)
class FitResult:
    """A fitted geometry.

    Attributes:
        parameters: the complete geometry of the first (usually only) group, internal
            units, in the reading `Poses.cone_vec` and corrections use.
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
        strain_prior: that of the phantom's stretches and shears; 0 if it has its stated shape.
        motions: deviations of single frames from the geometry, which is that of their mean, of
            each group; empty: they were not asked for.
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
    strain_prior: Strain = UNSTRAINED
    motions: tuple[Motion, ...] = ()

    @property
    def panel(self) -> Panel | None:
        """The panel's estimated distortion with its coefficients; None if it was not
        estimated.
        """
        model = self.problem.panel
        first = self.problem.layout.panel_column
        if model is None:
            return None
        return Panel(model, tuple(self.solution.x[first:].tolist()))

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

    @cached_property
    def image_slopes(self) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """`image_slopes` of each group."""
        groups = range(len(self.group_parameters))
        return tuple(image_slopes(self.problem, self.solution.x, g) for g in groups)

    @property
    def determined(self) -> bool:
        """Whether white noise alone leaves every free parameter determined."""
        return self.certificate.determined

    @property
    def identifiable(self) -> bool:
        """Every free parameter is determined, with what the residuals show."""
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
    common_px: npt.ArrayLike | None = None,
    solver: Solver | None = None,
    priors: Mapping[str, float] | None = None,
    prior_centre: Offsets | None = None,
    bound: float = BOUND,
    panel: PanelModel | None = None,
    strain: Strain = UNSTRAINED,
    arc: bool = False,
    rows: bool = False,
) -> FitResult:
    """Fit offsets (true minus nominal) to measured bead positions.

    Several scans go into one fit by concatenating their frames: poses link them through
    the motor readings, `groups` labels the frames that belong together and `per_group`
    lists the parameters that each group has for itself (for example alpha, tau_x and
    tau_z after the phantom was remounted).

    Args:
        tracks: (n, k, 2) pixels (column, row), nan where a bead was not seen.
        phantom: k beads: anything with `beads` and `bead_radius_mm`, or their centers (k, 3)
            [mm].
        geometry: nominal geometry of each of the n frames.
        free: parameters to estimate, of `told_lengths.PARAMETERS`; parameters without a
            prior either stay at `start`. If source, stage and detector shifts of one
            direction are all free, the source is fixed.
        shape: detector (rows, cols); None is the default machine's camera.
        covariances: (n, k, 2, 2) of the positions [px^2]; None is noise_px for all.
        noise_px: standard deviation of a coordinate. Only ratios matter for the values; sigmas
            follow the residuals.
        groups: (n,) label of each frame's group; None is one group.
        per_group: names among `free` with a value in each group.
        free_beads: estimate bead positions too (bundle adjustment), with
        bead_tolerance_mm: the standard deviation of their prior; None is the phantom's own.
        start: start values, and the values of parameters that are not free.
        reading: of eq. 5.4.
        centre: kind of the positions: projected centers or outline centers; or the bias
            factor of each position, (n, k), such as 0.8 for a centroid weighted by chord
            length.
        sampling_px: see `certify`; 0 for points, about 0.001 for centroids in images.
        common_px: (n, k, 2, c) shifts of the positions by one standard deviation of each of c
            quantities that all frames share, such as how beads fade; None: there are none.
        solver: None is Huber, trimming, then least squares.
        priors: parameter -> standard deviation of its prior [mm, deg, 1]; 0 is exactly
            known. A parameter that is not in `free` is estimated along with them. None:
            all parameters that are not free are exactly at `start` (`fit.priors` has
            widths for scanners).
        prior_centre: the offsets those priors are centered on; None is the start of the first
            group.
        bound: sigma [mm, deg] beyond which a direction counts as not determined.
        panel: terms of a distortion of the panel, estimated too; None: no distortion.
        strain: standard deviations of the phantom's stretches and shears [1], estimated too.
        arc: the object may turn while a frame is exposed, by an unknown share of a step.
        rows: the same while the rows of a frame are read one after another.

    Returns:
        The fit with its certificate, also where not everything is determined.

    Raises:
        TwinError: shapes do not match, no bead was seen, a width is no length, or free
            beads without a tolerance.
        UnknownNameError: a name that is no parameter.
    """
    model = bead_model(phantom)
    if bead_tolerance_mm is None:
        tolerance = model.tolerance_mm
    else:
        tolerance = bead_tolerance_mm
    if free_beads and not tolerance > 0:
        raise TwinError(
            "free beads need a tolerance as prior (phantom's, or bead_tolerance_mm > 0): "
            "without one, moving all beads is the same as moving the object",
            {"asked": tolerance, "allowed": "> 0"},
        )
    problem = build_problem(
        tracks,
        model,
        geometry,
        free=free,
        shape=shape,
        covariances=covariances,
        noise_px=noise_px,
        groups=groups,
        per_group=per_group,
        free_beads=free_beads,
        start=start,
        reading=reading,
        centre=centre,
        bead_tolerance_mm=tolerance,
        priors=require_widths(priors or {}),
        prior_centre=prior_centre,
        panel=panel,
        strain=strain,
        arc=arc,
        rows=rows,
        expected_spread=0.0 if solver is None else solver.spread_px,
        common=common_px,
    )
    if not problem.seen.any():
        raise TwinError(
            "no bead was seen in any frame: there is nothing to fit", {"seen": 0}
        )
    problem, solution, noise = _followed(problem, solver)
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
        strain_prior=strain,
    )


@with_arguments_of(estimate_geometry)
def fit_geometry(*args: Any, **options: Any) -> FitResult:
    """Fit offsets to measured bead positions; an undetermined parameter is an error.

    Arguments and result are those of `estimate_geometry`.

    Raises:
        NotIdentifiableError: names the directions that are not determined, with advice.
        TwinError, UnknownNameError: as `estimate_geometry`.

    Example: the object is 0.5 mm further to the right than the motors report.

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
    """Check that every parameter is determined, and return the result as it is.

    Raises:
        NotIdentifiableError: lists the open directions, with advice; its data has rank,
            parameters and directions.
    """
    spectrum = result.certificate.spectrum
    if not result.identifiable:
        directions = [d.text for d in result.certificate.open]
        raise NotIdentifiableError(
            f"not identifiable: {len(directions)} of {len(spectrum.names)} "
            "directions are open: " + "; ".join(directions),
            {
                "asked": list(spectrum.names),
                "rank": spectrum.rank,
                "parameters": len(spectrum.names),
                "directions": directions,
            },
        )
    return result


def with_start(result: FitResult, start: Offsets, iterations: int) -> FitResult:
    """Return the result of a chain of fits, counted from the start of the first.

    `start`: offsets of all groups there; its cost is that of the positions used in the
    end.
    """
    problem = result.problem
    base = np.array(
        [values_in(from_printed_reading(start, problem.reading))] * len(problem.base)
    )
    begun = problem.with_base(base)
    cost = cost_at(begun, begun.start, result.solution.use)
    return replace(result, start_cost=cost, iterations=iterations)


def _followed(
    problem: FitProblem, solver: Solver | None
) -> tuple[FitProblem, Solution, float]:
    """Solve a problem; where the object turns while rows are read, again with the paths of
    the solution, until they move no position by more than `PATH_SIGMAS` or for
    `PATH_ROUNDS`.

    Args:
        problem: data, columns and priors.
        solver: settings; the default is robust.

    Returns:
        The problem that was solved last, and what `_solved` returns.
    """
    solution, noise = _solved(problem, solver)
    if problem.layout.rows_column < 0:
        return problem, solution, noise
    for _ in range(PATH_ROUNDS):
        x = solution.x
        moved = problem.with_paths_at(x)
        change = (moved.whitened(x) - problem.whitened(x))[solution.use]
        if np.abs(change).max(initial=0.0) <= PATH_SIGMAS * noise:
            break
        problem = moved
        solution, noise = _weighted(problem, solver, x, noise)
    return problem, solution, noise


def _solved(problem: FitProblem, solver: Solver | None) -> tuple[Solution, float]:
    """Solve a problem, and weight its priors by the spread of the residuals.

    Few positions (up to `FEW_VALUES` coordinates a column) may be explained by priors
    that hold and noise, or by priors that are off and hardly any noise. Then smaller
    spreads (`QUIET_SHARES`) are tried, and one is taken if it is more likely by
    `QUIET_LOG_ODDS`.
    Returns also the spread of the whitened residuals that weighted the priors.
    """
    found = _weighted(problem, solver, problem.start, 1.0)
    weighed = bool(np.isfinite(problem.prior_sigma).any())
    if not weighed or 2 * problem.seen.sum() > FEW_VALUES * len(problem.layout.names):
        return found
    solution, noise = found
    best = found
    likelihood = _log_likelihood(problem, *found) + QUIET_LOG_ODDS
    for share in QUIET_SHARES:
        quiet = _weighted(problem, solver, solution.x, max(share * noise, LEAST_NOISE))
        gained = _log_likelihood(problem, *quiet)
        if gained > likelihood:
            best = quiet
            likelihood = gained
    return best


def _weighted(
    problem: FitProblem, solver: Solver | None, x: FloatArray, noise: float
) -> tuple[Solution, float]:
    """Solve a problem from a spread of the residuals on, until that repeats within 1 %.

    Four rounds at most; one without priors. Returns the last solution, and the spread
    that weighted its priors; if not settled, the one it gave (`LEAST_NOISE` at least).
    """
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


def _log_likelihood(problem: FitProblem, solution: Solution, noise: float) -> float:
    """Compute the logarithm of the likelihood of the positions used, with the expected
    spread and priors, all columns integrated out (Laplace), but for a constant.

    Args:
        problem: the data and columns.
        solution: about which is integrated; each coordinate that it leaves out is an
            outlier of TRIMMED_SPREADS times the noise, or times 1 if that is larger.
        noise: spread of the whitened residuals.
    """
    use = solution.use
    x = solution.x
    normal = problem.evaluate(x, use, 1)[4]
    precision = 1.0 / problem.prior_sigma**2
    with_prior = precision > 0.0
    whole = normal / noise**2 + np.diag(precision)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(whole), 1e-300))
    volume = (
        np.linalg.slogdet(whole * np.outer(scale, scale))[1] - 2.0 * np.log(scale).sum()
    )
    moved = float(precision @ np.square(x - problem.prior_mean))
    left_out = 2.0 * float(problem.seen.sum() - use.sum())
    outliers = left_out * math.log(TRIMMED_SPREADS * max(noise, 1.0))
    if problem.expected_spread > 0.0:
        expected = SPREAD_FREEDOM
    else:
        expected = 0.0
    square = 2.0 * solution.cost + expected * problem.expected_spread**2
    count = 2.0 * float(use.sum()) + expected
    spread = count * math.log(noise) + 0.5 * square / noise**2
    return (
        -spread
        - outliers
        - 0.5 * (moved + float(volume) - float(np.log(precision[with_prior]).sum()))
    )


def image_quantities(fit: FitResult) -> tuple[dict[str, Estimate], ...]:
    """Compute the quantities of IN_IMAGES, in the first frame of each group of frames, to
    first order.

    Where frames deviate, those of their mean are meant: the sigmas are of it.

    Args:
        fit: whose estimates are all determined.

    Returns:
        One dictionary for each group: quantity -> estimate with value, sigma, 95 %
        interval and unit.
    """
    t = float(stdtrit(fit.certificate.dof, 0.975))
    out = []
    for here, rows in fit.image_slopes:
        variance = np.einsum("qi,ij,qj->q", rows, fit.covariance, rows)
        sigma = np.sqrt(np.maximum(variance, 0.0))
        out.append(
            {
                name: Estimate(v, s, v - t * s, v + t * s, unit)
                for (name, unit), v, s in zip(
                    IN_IMAGES.items(), here.tolist(), sigma.tolist(), strict=True
                )
            }
        )
    return tuple(out)


def image_slopes(
    problem: FitProblem, x: FloatArray, group: int
) -> tuple[FloatArray, FloatArray]:
    """Compute the quantities of IN_IMAGES, and their derivatives by the parameters, by central
    differences of `SLOPE_STEP`.

    `problem`: the data; `x`: column values, internal units; `group`: of frames.
    Returns values (3,) in the group's first frame, and derivatives (3, p) by the columns that
    are parameters, edge units.
    """
    names = problem.layout.names[: problem.layout.parameter_count]
    slopes = []
    for i, name in enumerate(names):
        step = np.zeros_like(x)
        step[i] = SLOPE_STEP / edge_factor(name)
        ends = _axis_at(problem, x + step, group), _axis_at(problem, x - step, group)
        slopes.append((ends[0] - ends[1]) / (2.0 * SLOPE_STEP))
    return _axis_at(problem, x, group), np.array(slopes).T


def _axis_at(problem: FitProblem, x: FloatArray, group: int) -> FloatArray:
    frame = int(np.flatnonzero(problem.group == group)[0])
    offsets = problem.parameters(x)[group]
    poses = problem.poses_at(x)
    return axis_in_image(poses[frame : frame + 1], offsets, problem.origin[frame])


def axis_in_image(pose: Poses, offsets: Offsets, middle: FloatArray) -> FloatArray:
    """Compute the values of IN_IMAGES, in its order, of one pose.

    Args:
        pose: one frame.
        offsets: of the geometry.
        middle: the detector's center (column, row) [px].

    Returns:
        (3,): column where the axis crosses the middle row [px], its angle to the columns
        [deg], and magnification at the axis.
    """
    cone = pose.cone_vec(offsets)
    # In the object's frame the axis is vertical and passes through tau (`Poses.cone_vec`).
    foot = np.array([offsets.tau_x, offsets.tau_z, 0.0])
    pixel = float(np.linalg.norm(cone.u[0]))
    along = cone.u[0] / pixel
    points = np.array(
        [foot + [0, 0, 5.0], foot - [0, 0, 5.0], foot + along, foot - along]
    )
    up, down, right, left = cone.project_points(points, (1, 1))[0]
    column = down[0] - down[1] * (up[0] - down[0]) / (up[1] - down[1])
    angle = math.degrees(math.atan2(up[0] - down[0], down[1] - up[1]))
    return np.array(
        [column + middle[0], angle, float(np.linalg.norm(right - left)) / 2 * pixel]
    )


def covariance_by_step(fit: FitResult, count: int) -> list[tuple[int, FloatArray | None]]:
    """Predict the covariance that the first frames of a fit alone would have, with the
    noise of all.

    Steps with the same number of frames are listed once; the noise is at least
    `LEAST_NOISE`. Priors count; the structure of residuals does not.

    Args:
        fit: of n frames.
        count: of steps, evenly spread; 0 gives none.

    Returns:
        (frames, covariance (p, p) of the reported columns in edge units; None where they
        do not determine it), the last with all frames.
    """
    problem = fit.problem
    n, k = problem.seen.shape
    noise = max(LEAST_NOISE, fit.certificate.noise)
    rows = problem.jacobian(fit.solution.x, fit.solution.use)
    rows = np.where(np.repeat(fit.solution.use.ravel(), 2)[:, None], rows, 0.0)
    parts = rows.reshape(n, 2 * k, -1)
    factor = edge_factors(problem.layout.names)
    reported = problem.layout.parameter_count
    out: list[tuple[int, FloatArray | None]] = []
    for frames in np.unique(
        np.ceil(n * np.arange(1, count + 1) / max(count, 1)).astype(int)
    ):
        some = parts[:frames].reshape(frames * 2 * k, -1)
        normal = np.einsum("mi,mj->ij", some, some) + np.diag(problem.prior_weight(noise))
        scale = np.sqrt(np.diag(normal))
        matrix = None
        if (scale > 0).all():
            values, vectors = np.linalg.eigh(normal / np.outer(scale, scale))
            if values[0] > 1e-12:
                inverse = (vectors / values) @ vectors.T / np.outer(scale, scale)
                matrix = (noise**2 * inverse * np.outer(factor, factor))[
                    :reported, :reported
                ]
        out.append((int(frames), matrix))
    return out
