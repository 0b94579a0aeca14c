"""Forecast of the parameters that a planned scan determines, and changes to improve it.

The prediction is that of the fit (`fit.forecast`) to scans that are drawn, with what the
causes that a calibration looks for leave open of each: what it states depends on the noise, as a
cause that the noise looks like stays open. The suggestions are planned
scans too and are evaluated in the same way.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.bead_model import BeadModel, BeadPhantom, bead_model
from flexdt.twin.calibration.diagnose.table.group import Known
from flexdt.twin.calibration.diagnose.table.groups import every_family, strain
from flexdt.twin.calibration.diagnose.table.linearised import (
    Linearised,
    State,
    with_every_column,
)
from flexdt.twin.calibration.diagnose.table.posterior import Search
from flexdt.twin.calibration.fit.certificate import beyond_bound
from flexdt.twin.calibration.fit.fit import image_slopes
from flexdt.twin.calibration.fit.forecast import Forecast, Stated, forecast, visible_beads
from flexdt.twin.calibration.fit.priors import (
    NOISE_PX,
    Given,
    known,
    known_scale,
    known_strain,
    with_tolerance,
)
from flexdt.twin.calibration.fit.problem import (
    SIX,
    FitProblem,
    Shape,
    as_poses,
    build_problem,
    edge_factors,
    frame_shapes,
    require_tolerance,
)
from flexdt.twin.calibration.fit.weak_directions import BOUND, Direction, tolerance_of
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.geometry.told_lengths import PHANTOM

DRAWS: Final = 39
"""Number of scans that are drawn."""
SEED: Final = 39
_Plan = tuple[BeadModel, Poses, FloatArray]


@dataclass(frozen=True)
class Suggestion:
    """A change to the plan and the uncertainty it would bring.

    Attributes:
        change: the change, in words.
        worst: largest sigma in units of its tolerance (0.2 mm, 0.2 deg) after the change.
        gain: by what factor the worst one shrinks.
        sigmas: predicted sigma of every parameter, edge units.
    """

    change: str
    worst: float
    gain: float
    sigmas: dict[str, float]


@dataclass(frozen=True, eq=False)
class Prediction:
    """The parameters that a planned scan determines.

    Attributes:
        sigmas: column -> predicted standard deviation, edge units; inf where not determined.
        image_sigmas: the same of the quantities that a reconstruction needs: IN_IMAGES of
            `fit.fit`.
        covariance: (p, p) edge units.
        rank, condition: of the column-scaled Jacobian.
        null, weak: directions not determined, or badly, also because of open causes.
        visible: (n, k) beads entirely in view.
        suggestions: changes that help, best first; empty if nothing is weak.
        ranges: column or quantity of `image_sigmas` -> least and largest of the sigmas that
            eight of ten such scans state: what a cause may hide depends on the noise. Empty
            without causes, or where something is not determined.
    """

    sigmas: dict[str, float]
    image_sigmas: dict[str, float]
    covariance: FloatArray
    rank: int
    condition: float
    null: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    visible: npt.NDArray[np.bool_]
    suggestions: tuple[Suggestion, ...]
    ranges: dict[str, tuple[float, float]] = field(default_factory=dict)

    @property
    def identifiable(self) -> bool:
        """Whether every requested parameter is determined."""
        return not self.null

    @property
    def worst(self) -> float:
        """Largest sigma in units of its tolerance."""
        return _worst(self.sigmas)


def identifiability(
    phantom: BeadPhantom | BeadModel | npt.ArrayLike,
    geometry: Poses | ConeVec,
    noise_px: float = NOISE_PX,
    free: Sequence[str] = SIX,
    *,
    shape: Shape = None,
    at: Offsets = NOMINAL,
    bead_tolerance_mm: float | None = None,
    priors: Given | None = None,
    bound: float = BOUND,
    causes: bool = True,
) -> Prediction:
    """Predict the uncertainty of a calibration, and that of changed plans.

    Args:
        phantom: the beads.
        geometry: nominal geometry of each planned frame.
        noise_px: standard deviation of a detected coordinate.
        free: parameters to be estimated.
        shape: detector (rows, cols); None is the default machine's camera. Beads that
            would not be entirely on it do not count.
        at: the geometry to predict at.
        bead_tolerance_mm: > 0: bead positions are unknowns with this prior; 0: they are
            exact; None: the phantom may be strained, as `flexdt calibrate` assumes.
        priors: standard deviations of other offsets [mm, deg, 1], in place of those that
            `flexdt calibrate` assumes for a scanner without its own; 0 is exactly, "none"
            is all exactly.
        bound: sigma [mm, deg] beyond which a direction counts as not determined.
        causes: count what the causes that `calibrate` looks for leave open; False: the fit
            alone, as `estimate_geometry` states it.

    Returns:
        Predicted sigmas (half of such scans state less, half of them more) with their
        ranges, rank, directions not determined, and suggestions, best first: changes that
        lower the worst sigma, over its tolerance, by a fifth; none for a plan whose
        directions are all determined within their tolerances.

    Raises:
        TwinError, UnknownNameError: as `estimate_geometry`.

    Example: one bead fixes neither the scale nor the angle.

    >>> import numpy as np
    >>> from flexdt.phantoms import bead_phantom
    >>> from flexdt.twin.geometry.poses import Poses
    >>> angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    >>> poses = Poses.upright([0, 0, 0], [0, 600, 0], [0, 1059, 0], 0.1496, angle)
    >>> phantom = bead_phantom("normal", 5)
    >>> identifiability(phantom, poses, shape=(760, 956)).identifiable
    True
    >>> identifiability(bead_phantom("normal", 1), poses, shape=(760, 956)).identifiable
    False
    """
    model = bead_model(phantom)
    priors, bead_tolerance_mm = with_tolerance(model, priors, bead_tolerance_mm)
    tolerance = bead_tolerance_mm or 0.0
    require_tolerance(tolerance)
    poses = as_poses(geometry)

    widths = known(free, priors)

    def predict(
        beads: BeadModel, plan: Poses, sizes: FloatArray, rivals: bool = False
    ) -> tuple[Forecast, npt.NDArray[np.bool_]]:
        """Predict the certificate of a fit to a planned scan.

        Beads count where they are visible; their places are free if there is a tolerance.

        Args:
            beads: the phantom's k beads.
            plan: poses of n frames.
            sizes: (n, 2) rows and columns of the frames.
            rivals: count what other causes leave open.

        Returns:
            The forecast, and the visible beads (n, k).
        """
        visible = visible_beads(beads, plan, sizes, at)
        pixels = plan.cone_vec(at).project_points(beads.beads, (1, 1))
        origin = (sizes[:, ::-1] - 1) / 2
        tracks = np.where(visible[..., None], pixels + origin[:, None], np.nan)
        strain = known_strain(beads, free, priors, bead_tolerance_mm)
        problem = build_problem(
            tracks,
            beads,
            plan,
            free=free,
            shape=sizes,
            noise_px=noise_px,
            free_beads=tolerance > 0,
            start=at,
            bead_tolerance_mm=tolerance,
            priors=widths
            | {PHANTOM: known_scale(beads, free, priors, bead_tolerance_mm)},
            strain=strain,
        )
        fitted = forecast(problem, bound)
        if rivals and not fitted.spectrum.null and visible.any():
            stated = _foreseen(problem, Known(strain, bead_tolerance_mm, 1.0))
            return forecast(problem, bound, stated), visible
        return fitted, visible

    sizes = frame_shapes(shape, len(poses))
    expected, visible = predict(model, poses, sizes, causes)
    spec = expected.spectrum
    sigmas = expected.sigmas
    suggestions: list[Suggestion] = []
    before = _worst(sigmas)
    if spec.null or spec.weak or before > 1.0:
        for change, plan in _changes(model, poses, sizes).items():
            after = predict(*plan)[0].sigmas
            worst = _worst(after)
            if worst < before * 0.8 or (not np.isfinite(before) and np.isfinite(worst)):
                suggestions.append(Suggestion(change, worst, before / worst, after))
        suggestions.sort(key=lambda s: s.worst)
    return Prediction(
        sigmas=sigmas,
        image_sigmas=expected.image_sigmas,
        covariance=expected.covariance,
        rank=spec.rank,
        condition=spec.condition,
        null=spec.null,
        weak=spec.weak if spec.null else (*beyond_bound(sigmas, bound), *spec.weak),
        visible=visible,
        suggestions=tuple(suggestions),
        ranges=expected.ranges,
    )


def _worst(sigmas: dict[str, float]) -> float:
    return max((s / tolerance_of(n) for n, s in sigmas.items()), default=0.0)


def _changes(model: BeadModel, poses: Poses, sizes: FloatArray) -> dict[str, _Plan]:
    """List changes worth trying: a placement at an SOD a quarter less or more, 20 mm to
    the side, or both; twice the frames; two beads more.

    Args:
        model: the beads.
        poses: the planned frames.
        sizes: (n, 2) detector (rows, cols).

    Returns:
        Words -> the changed plan.
    """

    def with_more(axis: float = 0.0, beam: float = 0.0, angle: float = 0.0) -> _Plan:
        aside = poses.axis + np.array([axis, beam, 0.0])
        more = replace(poses, axis=aside, angle=poses.angle + angle)
        return model, Poses.concatenate([poses, more]), np.concatenate([sizes, sizes])

    half = np.median(np.diff(np.sort(poses.angle))) / 2 if len(poses) > 1 else np.pi / 2
    spread = np.ptp(model.beads, axis=0)
    spread = np.where(spread > 0, spread, max(10.0, float(spread.max())))
    centre = (model.beads.max(axis=0) + model.beads.min(axis=0)) / 2
    extra = centre + spread * np.array([[-0.5, 0.25, 0.3], [0.4, -0.5, -0.4]])
    radius = np.append(model.bead_radius_mm, [model.bead_radius_mm.mean()] * 2)
    stated = model.stated
    if stated is not None and isinstance(stated.bead_mm, tuple):
        stated = replace(stated, bead_mm=stated.typical_mm)
    beads = BeadModel(
        np.concatenate([model.beads, extra]), radius, model.tolerance_mm, stated=stated
    )
    sod = float(np.median(poses.sod))
    near = -round(0.25 * sod / 10) * 10
    place = "add a placement"
    return {
        f"{place} at SOD {sod + near:.0f} mm ({near:+.0f} mm)": with_more(beam=near),
        f"{place} at SOD {sod - near:.0f} mm ({-near:+.0f} mm)": with_more(beam=-near),
        f"{place} 20 mm to the side": with_more(20.0),
        f"{place} 20 mm to the side and at SOD {sod + near:.0f} mm": with_more(
            20.0, near
        ),
        "take twice as many frames": with_more(angle=float(half)),
        "use a phantom with two beads more": (beads, poses, sizes),
    }


def _foreseen(problem: FitProblem, known: Known) -> Stated:
    """Draw what scans of a plan state; the same in every call.

    The fit is linearized where a scanner and a phantom are (small offsets turn the image of
    the axis by more than it is known), what causes add at the plan.

    Args:
        problem: planned, with its positions as predicted at the start; their whitened errors
            have spread 1.
        known: statements on the phantom and the positions.

    Returns:
        `DRAWS` scans.
    """
    rng = np.random.default_rng(SEED)
    _, x = with_every_column(problem, problem.start)
    still = State(x, {}, np.zeros((*problem.seen.shape, 2)))
    table = Linearised(problem, still, known.floor)
    families = every_family(table, known)
    bases = [table.geometry]
    widths = [np.where(table.precision > 0, table.precision, np.inf) ** -0.5]
    shape: list[int] = []
    for family in families:
        if family.always and family.rows is not None:
            bases.append(family.rows[0])
            widths.append(np.full(family.rows.shape[2], family.always))
            if family.cause == strain.NAME:
                first = sum(map(len, widths[:-1]))
                shape += range(first, first + family.rows.shape[2])
    base = np.concatenate(bases, axis=1)
    spread = np.concatenate(widths)
    drawn = spread[:, None] * rng.normal(size=(len(spread), DRAWS))
    noise = (
        rng.normal(size=(len(base), DRAWS)) * np.repeat(table.weight.ravel(), 2)[:, None]
    )
    # A fit takes the geometry up by iterations: its table is linear there, and has the rest.
    count = table.parameters
    search = Search(table, families, 0.0, base[:, count:] @ drawn[count:] + noise)
    search.keep_shapes()
    factor = edge_factors(problem.layout.names)
    unit = np.outer(factor[:count], factor[:count])
    precision = np.diag(1.0 / (problem.prior_sigma * factor) ** 2)
    keep = np.repeat(problem.seen.ravel(), 2)
    columns = [
        *range(count),
        *range(len(problem.layout.names))[problem.layout.strain_columns],
    ]
    sources = [*range(count), *shape[: len(columns) - count]]
    slopes = image_slopes(problem, problem.start, 0)[1]
    covariances = []
    images = []
    for number in range(DRAWS):
        search.draw(number)
        model = search.model({}, 1.0)
        posterior = search.mixture(model, search.further(model))
        mean = model.solved.mean[:count]
        wide = sum(
            p.weight * (p.covariance + np.outer(p.mean - mean, p.mean - mean))
            for p in posterior.parts
        )
        more = (np.asarray(wide) - model.solved.covariance[:count, :count]) * unit
        there = problem.start
        there[columns] += drawn[sources, number]
        rows: FloatArray = problem.jacobian(there)[keep] / factor
        told = rows.T @ rows / model.noise2
        here = np.linalg.inv(told + precision)[:count, :count]
        turned = image_slopes(problem, there, 0)[1]
        covariances.append(here + more)
        images.append(
            np.einsum("qi,ij,qj->q", turned, here, turned)
            + np.einsum("qi,ij,qj->q", slopes, more, slopes)
        )
    return Stated(np.array(covariances), np.array(images))
