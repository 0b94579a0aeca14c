"""The uncertainty report of a fit: covariance, rank, weak directions, residuals, whiteness.

Everything is computed from the whitened Jacobian and the residuals at the solution. The covariance
is s^2 (J'J)^-1 from reprojection residuals alone. Where residuals are correlated from frame to
frame, it is enlarged by their correlation length, and the report says so. `diagnose` looks for the
causes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import stats

from flexdt.twin.calibration.fit.problem import Problem, edge_factor
from flexdt.twin.calibration.fit.residual_structure import (
    SIGNIFICANT,
    Drift,
    cluster_covariance,
    correlation_length,
    cross,
    drifts,
    larger,
    turning_errors,
)
from flexdt.twin.calibration.fit.weak_directions import (
    Direction,
    null_directions,
    tolerance_of,
    unit_of,
    weak_direction,
)
from flexdt.twin.geometry.conventions import FloatArray

RANK_TOLERANCE = 1e-8
"""Singular values of the column-scaled Jacobian below this share of the largest are zero."""
WEAK_CONDITION = 500.0
"""A column-scaled condition number above this makes the smallest direction weak."""
UNUSABLE = 150.0
"""A parameter whose sigma exceeds this many tolerances (30 mm, 30 deg) counts as not determined:
the linearisation behind sigma does not hold there."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Rank and conditioning of a Jacobian, edge units.

    Attributes:
        names: columns.
        unit_covariance: (p, p) (J'J)^-1 in edge units; inf on columns touched by a null direction.
        rank, condition: of the column-scaled Jacobian; condition is inf if rank-deficient.
        singular: its singular values, largest first.
        null: directions that are not determined.
        weak: directions that are determined badly.
    """

    names: tuple[str, ...]
    unit_covariance: FloatArray
    rank: int
    condition: float
    singular: FloatArray
    null: tuple[Direction, ...]
    weak: tuple[Direction, ...]

    @property
    def full(self) -> bool:
        """Every column is determined."""
        return self.rank == len(self.names) and not self.null


def spectrum(
    jacobian: FloatArray,
    names: Sequence[str],
    beads: int,
    *,
    noise: float = 1.0,
    reported: int | None = None,
) -> Spectrum:
    """Analyse whitened Jacobian rows (m, p) in internal units (prior rows included).

    Args:
        jacobian: rows.
        names: columns.
        beads: how many beads were seen, for the advice.
        noise: standard deviation of the whitened residuals, for the sigmas of weak directions.
        reported: only the first `reported` columns are judged (the rest are nuisance).
    """
    p = len(names)
    judged = p if reported is None else reported
    factor = np.array([edge_factor(n) for n in names])
    j = jacobian / factor
    norm = np.linalg.norm(j, axis=0)
    scale = np.where(norm > 0, norm, 1.0)
    s, vt = _singular(j / scale)
    top = float(s[0]) if p else 1.0
    zero = s <= RANK_TOLERANCE * max(top, 1e-300)
    rank = int((~zero).sum())
    basis = vt[zero].T
    inverse = np.where(zero, 0.0, 1.0 / np.where(zero, 1.0, s))
    v = vt.T * inverse
    covariance = (v @ v.T) / np.outer(scale, scale)
    touched = (np.abs(basis) > 1e-5).any(axis=1)
    covariance[touched, :] = np.nan
    covariance[:, touched] = np.nan
    covariance[touched, touched] = np.inf
    null = list(null_directions(basis, scale, names, beads)) if basis.size else []
    weak: list[Direction] = []
    sigma = noise * np.sqrt(np.diag(covariance))
    tolerance = np.array([tolerance_of(n) for n in names])
    condition = math.inf if rank < p else top / float(s[-1]) if p else 1.0
    for i in range(rank - 1, -1, -1):
        direction = weak_direction(vt[i], scale, names, noise / s[i], beads)
        size = direction.sigma / tolerance_of(direction.names[0])
        lead = names.index(direction.names[0])
        if lead >= judged:
            continue
        if size > UNUSABLE:
            null.append(direction)
        elif size > 1.0 or top / s[i] > WEAK_CONDITION:
            weak.append(direction)
        else:
            break
    hopeless = np.isfinite(sigma) & (sigma > UNUSABLE * tolerance)
    hopeless[judged:] = False
    rank -= sum(1 for d in null if math.isfinite(d.sigma))
    if hopeless.any() and not null:
        worst = int(np.argmax(np.where(hopeless, sigma / tolerance, 0.0)))
        null.append(
            Direction(
                ((names[worst], 1.0),), float(sigma[worst]), "add frames, beads or placements"
            )
        )
        rank -= 1
    return Spectrum(tuple(names), covariance, rank, condition, s, tuple(null), tuple(weak))


def _singular(j: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Singular values, largest first, and right singular vectors (rows) of (m, p).

    From the Gram matrix where that is accurate (it squares the condition number), else by QR.
    """
    p = j.shape[1]
    if len(j) >= p:
        values, vectors = np.linalg.eigh(cross(j, j))
        if p and values[0] > 1e-9 * values[-1]:
            return np.sqrt(values[::-1]), vectors.T[::-1]
    r = np.linalg.qr(j, mode="r") if len(j) >= p else j
    _, s, vt = np.linalg.svd(r, full_matrices=True)
    return np.concatenate([s, np.zeros(p - len(s))]), vt


@dataclass(frozen=True)
class Estimate:
    """One parameter with its uncertainty, edge unit (mm, deg, 1).

    `low` and `high` bound the 95 % interval (Student's t with the fit's degrees of freedom).
    """

    value: float
    sigma: float
    low: float
    high: float
    unit: str


@dataclass(frozen=True)
class Outlier:
    """A measured position that was left out: its frame, bead and residual (column, row) [px]."""

    frame: int
    bead: int
    residual_px: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Certificate:
    """The quality of one fit.

    Attributes:
        estimates: column -> value and uncertainty; empty of meaning (nan) where not determined.
        covariance: (p, p) of the reported columns, edge units, enlargement included.
        correlation: (p, p).
        spectrum: rank, condition, null and weak directions.
        dof: degrees of freedom of s^2, after allowing for correlated residuals.
        noise: s, the spread of the whitened residuals; 1 means the stated noise explains them.
        rms_px: root mean square residual per coordinate.
        enlargement: factor on the covariance for residuals correlated from frame to frame.
        whiteness: lag-one autocorrelation of the residuals along the frames.
        shared: the beads of a frame err together; the covariance allows for it.
        turning: errors of single beads repeat as the object turns; the covariance allows for it.
        drifts: changes of parameters during the scan that the residuals show; each parameter's
            sigma contains its own.
        residuals_px: (n, k, 2) measured minus predicted, nan where unseen.
        used: (n, k) positions in the fit.
        outliers: positions left out.
        held: parameters held by the gauge, with the reason.
    """

    estimates: dict[str, Estimate]
    covariance: FloatArray
    correlation: FloatArray
    spectrum: Spectrum
    dof: float
    noise: float
    rms_px: float
    enlargement: float
    whiteness: float
    shared: bool
    turning: bool
    drifts: tuple[Drift, ...]
    residuals_px: FloatArray
    used: npt.NDArray[np.bool_]
    outliers: tuple[Outlier, ...]
    held: tuple[tuple[str, str], ...]

    @property
    def identifiable(self) -> bool:
        """Every asked parameter is determined by the data."""
        return self.spectrum.full

    @property
    def weak(self) -> tuple[str, ...]:
        """Null directions first, then weak ones, as text."""
        return tuple(d.text for d in (*self.spectrum.null, *self.spectrum.weak))

    @property
    def beads_per_frame(self) -> npt.NDArray[np.int64]:
        """Usable beads in each frame, (n,)."""
        return np.asarray(self.used.sum(axis=1), dtype=np.int64)

    @property
    def rms_per_bead(self) -> FloatArray:
        """Root mean square residual of each bead, (k,) [px]; nan if never used."""
        return self._rms(0)

    @property
    def rms_per_frame(self) -> FloatArray:
        """Root mean square residual of each frame, (n,) [px]; nan if nothing was used."""
        return self._rms(1)

    def _rms(self, axis: int) -> FloatArray:
        square = np.where(self.used[:, :, None], self.residuals_px, 0.0) ** 2
        count = 2 * self.used.sum(axis=axis)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt(square.sum(axis=(axis, 2)) / count))

    def mahalanobis2(self, truth: dict[str, float]) -> float:
        """Squared distance of `truth` (edge units, all reported columns) in the covariance."""
        d = np.array([truth[n] - e.value for n, e in self.estimates.items()])
        return float(d @ np.linalg.solve(self.covariance, d))

    def inside_95(self, truth: dict[str, float]) -> bool:
        """Whether `truth` lies in the joint 95 % ellipsoid (Hotelling: F distribution)."""
        p = len(self.estimates)
        return self.mahalanobis2(truth) <= p * float(stats.f.ppf(0.95, p, self.dof))


def widened(certificate: Certificate, bias: Mapping[str, float]) -> Certificate:
    """The certificate with the covariance of a possible error added, (bias) (bias)'.

    Args:
        certificate: of a fit.
        bias: column -> how far it may be off, edge units.
    """
    names = list(certificate.estimates)
    off = np.array([bias[n] for n in names])
    covariance = certificate.covariance + np.outer(off, off)
    sigma = np.sqrt(np.diag(covariance))
    t = float(stats.t.ppf(0.975, certificate.dof))
    estimates = {
        n: replace(e, sigma=float(s), low=e.value - t * float(s), high=e.value + t * float(s))
        for (n, e), s in zip(certificate.estimates.items(), sigma, strict=True)
    }
    return replace(
        certificate,
        estimates=estimates,
        covariance=covariance,
        correlation=covariance / np.outer(sigma, sigma),
    )


def certify(
    problem: Problem,
    x: FloatArray,
    use: npt.NDArray[np.bool_],
    prior_weight: FloatArray | None = None,
    prior_residual: FloatArray | None = None,
    sampling_px: float = 0.0,
) -> Certificate:
    """Certificate of column values `x` fitted to the positions `use`.

    Args:
        problem: the data.
        x: column values, internal units.
        use: (n, k) positions that counted.
        prior_weight: 1 / variance of each column's prior in units of the whitened residuals.
        prior_residual: value minus prior mean of each column.
        sampling_px: standard deviation of the part of a detection's error that depends on where
            in a pixel the spot lies. Beads that stay at one place of the pixel grid in every
            frame keep it; on beads that wander it averages out.
    """
    names = problem.layout.names
    reported = problem.layout.parameter_count
    jac = problem.jacobian(x, use)
    keep = np.repeat(use.ravel(), 2)
    rows = jac[keep]
    chi2 = float(np.sum(problem.residuals(x, use)[1][use] ** 2))
    if prior_weight is not None and prior_residual is not None:
        strong = prior_weight > 0
        rows = np.concatenate([rows, np.diag(np.sqrt(prior_weight))[strong]])
        chi2 += float(np.sum(prior_weight * prior_residual**2))
    beads = int(problem.seen.any(axis=0).sum())
    dof = max(len(rows) - len(names), 0)
    noise = math.sqrt(chi2 / dof) if dof else math.nan
    predicted = problem.residuals(x, use)[0]
    residual = problem.pixels - predicted
    whiteness, enlargement = correlation_length(residual, use, problem.group)
    effective = max(dof / enlargement, 1.0) if dof else 1.0
    spec = spectrum(rows, names, beads, noise=noise * math.sqrt(enlargement), reported=reported)
    covariance = noise**2 * enlargement * spec.unit_covariance[:reported, :reported]
    factor = np.array([edge_factor(n) for n in names])
    structure = (False, False)
    moving: tuple[Drift, ...] = ()
    if spec.full:
        covariance, structure, moving = _widened(
            problem, jac[keep] / factor, predicted, keep, noise, spec, covariance, sampling_px
        )
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(sigma, sigma)
    t = float(stats.t.ppf(0.975, effective))
    estimates = {}
    for i, name in enumerate(names[:reported]):
        value = float(x[i] * factor[i])
        half = t * float(sigma[i])
        estimates[name] = Estimate(
            value, float(sigma[i]), value - half, value + half, unit_of(name)
        )
    dropped = np.argwhere(problem.seen & ~use)
    outliers = tuple(
        Outlier(int(f), int(k), (float(residual[f, k, 0]), float(residual[f, k, 1])))
        for f, k in dropped
    )
    used_residual = residual[use]
    return Certificate(
        estimates=estimates,
        covariance=covariance,
        correlation=correlation,
        spectrum=spec,
        dof=effective,
        noise=noise,
        rms_px=float(np.sqrt(np.mean(used_residual**2))) if use.any() else math.nan,
        enlargement=enlargement,
        whiteness=whiteness,
        shared=structure[0],
        turning=structure[1],
        drifts=moving,
        residuals_px=residual,
        used=use,
        outliers=outliers,
        held=problem.layout.held,
    )


def _widened(
    problem: Problem,
    rows: FloatArray,
    predicted: FloatArray,
    keep: npt.NDArray[np.bool_],
    noise: float,
    spec: Spectrum,
    covariance: FloatArray,
    sampling_px: float,
) -> tuple[FloatArray, tuple[bool, bool], tuple[Drift, ...]]:
    """The covariance with what the residuals show beyond white noise; whether the beads of a frame
    err together, and whether errors repeat with the turn; and drifts.

    rows: whitened Jacobian of the used positions in edge units; keep: which of all rows they are.
    """
    reported = len(covariance)
    frame = np.repeat(np.arange(len(problem.poses)), 2 * problem.seen.shape[1])[keep]
    w = problem.whiten
    off = problem.measured + problem.origin[:, None, :] - predicted
    whitened = np.stack(
        [w[..., 0] * off[..., 0] + w[..., 1] * off[..., 1], w[..., 2] * off[..., 1]], axis=-1
    ).ravel()[keep]
    together = cluster_covariance(problem, rows, whitened, frame, spec.unit_covariance, noise)
    if together is not None:
        covariance = larger(covariance, together[:reported, :reported])
    if sampling_px > 0:
        shifts = _sampling_vectors(problem, predicted)[keep]
        gain = spec.unit_covariance[:reported] @ cross(rows, shifts)
        covariance = covariance + sampling_px**2 * gain @ gain.T
    turning = turning_errors(problem, rows, whitened, keep, spec.unit_covariance, noise)
    if turning is not None:
        covariance = covariance + turning[:reported, :reported]
    moving = drifts(problem, rows, whitened, frame, spec.unit_covariance, noise)
    for drift in moving:
        bias = drift.bias[:reported]
        covariance = covariance + np.outer(bias, bias)
        i = problem.layout.names.index(drift.column)
        if i < reported:
            # Which of the values it had is the parameter's is a matter of definition: the first,
            # or, of a drift that may not be one, the middle.
            steady = drift.score <= SIGNIFICANT and drift.step_at is None
            covariance[i, i] += (0.5 * drift.size if steady else drift.size) ** 2
    certain = moving if any(d.score > SIGNIFICANT for d in moving) else ()
    return covariance, (together is not None, turning is not None), certain


def _sampling_vectors(problem: Problem, predicted: FloatArray) -> FloatArray:
    """Whitened unit errors that follow a bead's place in the pixel grid, (2 n k, 4 k).

    An error e(x) with the pixel's period, a sin(2 pi x + theta) with theta unknown, has the
    covariance a^2 cos 2 pi (x - x'): two vectors, cosine and sine, for each bead and coordinate.
    """
    n, k = problem.seen.shape
    phase = 2.0 * math.pi * predicted
    w = problem.whiten
    out = np.zeros((n, k, 2, k, 4))
    for bead in range(k):
        for i, wave in enumerate((np.cos(phase[:, bead]), np.sin(phase[:, bead]))):
            out[:, bead, 0, bead, i] = w[:, bead, 0] * wave[:, 0]
            out[:, bead, 0, bead, 2 + i] = w[:, bead, 1] * wave[:, 1]
            out[:, bead, 1, bead, 2 + i] = w[:, bead, 2] * wave[:, 1]
    return out.reshape(2 * n * k, 4 * k)
