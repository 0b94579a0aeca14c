"""The uncertainty report of a fit: covariance, rank, weak directions, residuals.

Everything is computed from the whitened Jacobian and the residuals at the solution. The
covariance is s^2 (J'J)^-1 from reprojection residuals alone. Where residuals are
correlated from frame to frame, that of a fit by itself is enlarged by their correlation length,
and the report states it. `table` explains the residuals, and states the covariance over what
they leave open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.special import fdtr, stdtrit

from flexdt.twin.calibration.fit.curved_region import Bend, bend_of
from flexdt.twin.calibration.fit.problem import FitProblem, edge_factors
from flexdt.twin.calibration.fit.residual_structure import (
    Residuals,
    correlation_length,
    cross,
)
from flexdt.twin.calibration.fit.weak_directions import (
    BOUND,
    TOLERANCE,
    Direction,
    null_directions,
    tolerance_of,
    unit_of,
    weak_direction,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.told_lengths import PHANTOM, TOLD_SOURCES

RANK_TOLERANCE = 1e-8
"""Singular values of the column-scaled Jacobian below this share of the largest are zero."""
MAX_ROUNDING = 1e-9
"""Residuals of exact positions [whitened] below which structure is rounding."""
POSITION_SPREAD_PX = 0.02
"""Assumed: what positions scatter by beyond the noise of their image: .005 to .09 px."""
SPREAD_FREEDOM = 3.0
"""Degrees of freedom that a spread expected of the residuals counts for; assumed. Two
positions to spare may agree by chance 20 times better than they are known."""
LEAST_FREEDOM = 1e-3
"""Degrees of freedom from which the residuals have a spread."""
ROUNDING_OF_COLUMNS = 1e-13
"""Least eigenvalue of the scaled normal equations; directions below it are undetermined."""
SOURCES = {
    "bead": "beads",
    "strain": "the phantom's shape",
    "arc": "the exposure's arc",
    "rows": "the turn while rows are read",
    "panel": "the panel's distortion",
}
"""First word of a column's name that is no parameter -> its source, in words."""
MEASUREMENT_ADVICE = {
    SOURCES["bead"]: "beads measured more exactly would tell more",
    TOLD_SOURCES[PHANTOM]: (
        "a measured distance of two beads, and --prior phantom=SIGMA, would tell more"
    ),
}
"""Source that limits a sigma -> the measurement that would reduce it."""
WEAK_CONDITION = 500.0
"""A column-scaled condition number above this makes the smallest direction weak."""


@dataclass(frozen=True, eq=False)
class Conditioning:
    """Rank and conditioning of a Jacobian, edge units.

    Attributes:
        names: columns.
        unit_covariance: (p, p) (J'J)^-1 in edge units; inf on columns touched by a null
            direction.
        rank, condition: of the column-scaled Jacobian; condition is inf if rank-deficient.
        null: directions that are not determined.
        weak: directions that are determined badly.
        bound: sigma [mm, deg] beyond which a direction counts as not determined.
    """

    names: tuple[str, ...]
    unit_covariance: FloatArray
    rank: int
    condition: float
    null: tuple[Direction, ...]
    weak: tuple[Direction, ...]
    bound: float = BOUND

    @property
    def full(self) -> bool:
        """Every column is determined."""
        return self.rank == len(self.names) and not self.null

    @property
    def singular(self) -> bool:
        """The data leave some direction open altogether."""
        return any(math.isinf(direction.sigma) for direction in self.null)


def spectrum(
    jacobian: FloatArray,
    names: Sequence[str],
    beads: int,
    *,
    noise: float = 1.0,
    reported: int | None = None,
    bound: float = BOUND,
) -> Conditioning:
    """Analyse whitened Jacobian rows (m, p) in internal units (prior rows included).

    A direction among the judged columns is null if it is open (`RANK_TOLERANCE`) or known
    worse than `bound`, weak if its sigma exceeds its tolerance or its condition
    `WEAK_CONDITION`. A column worse than `bound` without such a direction makes one null,
    too; each lowers the rank.

    Args:
        jacobian: rows.
        names: columns.
        beads: number of beads seen, for the advice.
        noise: standard deviation of the whitened residuals, for the sigmas of weak
            directions.
        reported: only the first `reported` columns are judged (the rest are nuisance);
            None: all.
        bound: a direction known worse than this [mm, deg; 0.0025 of it in angle_scale]
            counts as not determined.

    Returns:
        Covariance for unit noise (infinite or nan for what is open), rank, condition, and
        the null and weak directions in words.
    """
    unusable = bound / TOLERANCE["mm"]
    p = len(names)
    judged = p if reported is None else reported
    factor = edge_factors(names)
    j = jacobian / factor
    # Columns of length 1: rank and condition must not depend on whether a column is in mm or
    # a scale.
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
    # A column that takes part in an open direction has no sigma, however well the others are
    # known.
    touched = (np.abs(basis) > 1e-5).any(axis=1)
    covariance[touched, :] = np.nan
    covariance[:, touched] = np.nan
    covariance[touched, touched] = np.inf
    if basis.size:
        null = list(null_directions(basis, scale, names, beads))
    else:
        null = []
    weak: list[Direction] = []
    sigma = noise * np.sqrt(np.diag(covariance))
    tolerance = np.array([tolerance_of(n) for n in names])
    if rank < p:
        condition = math.inf
    elif p:
        condition = top / float(s[-1])
    else:
        condition = 1.0
    # From the worst direction on; the first that is good ends the list.
    for i in range(rank - 1, -1, -1):
        direction = weak_direction(vt[i], scale, names, noise / s[i], beads)
        size = direction.sigma / tolerance_of(direction.names[0])
        lead = names.index(direction.names[0])
        # Nobody asked for what leads it.
        if lead >= judged:
            continue
        if size > unusable:
            null.append(
                replace(
                    direction,
                    advice=f"worse than {bound:g} mm or deg: {direction.advice}",
                )
            )
        elif size > 1.0 or top / s[i] > WEAK_CONDITION:
            weak.append(direction)
        else:
            break
    # Several directions, each good enough, may add up to a column that is not.
    hopeless = np.isfinite(sigma) & (sigma > unusable * tolerance)
    hopeless[judged:] = False
    # Directions that are open altogether are missing from the rank already.
    rank -= sum(1 for d in null if math.isfinite(d.sigma))
    if hopeless.any() and not null:
        worst = int(np.argmax(np.where(hopeless, sigma / tolerance, 0.0)))
        advice = f"worse than {bound:g} mm or deg: add a placement at another SOD, frames or beads"
        null.append(Direction(((names[worst], 1.0),), float(sigma[worst]), advice))
        rank -= 1
    return Conditioning(
        tuple(names), covariance, rank, condition, tuple(null), tuple(weak), bound
    )


def beyond_bound(sigmas: Mapping[str, float], bound: float) -> tuple[Direction, ...]:
    """List the columns that are stated worse than a bound, with advice.

    Args:
        sigmas: column -> stated standard deviation, edge units.
        bound: see `spectrum`.
    """
    advice = (
        f"worse than {bound:g} mm or deg, with what the residuals and open causes add: "
        "add a placement at another SOD, frames or beads"
    )
    unusable = bound / TOLERANCE["mm"]
    return tuple(
        Direction(((name, 1.0),), sigma, advice)
        for name, sigma in sigmas.items()
        if sigma > unusable * tolerance_of(name)
    )


def _singular(j: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute singular values, largest first, and right singular vectors (rows) of (m,
    p).

    From the Gram matrix where that is accurate (it squares the condition number), else by
    QR; zeros make up for fewer rows than columns.

    Returns:
        (p,) and (p, p).
    """
    p = j.shape[1]
    if len(j) >= p:
        # Squares of singular values: down to 1e-9 of the largest they keep seven digits, and
        # cost a fraction of a QR of all rows.
        values, vectors = np.linalg.eigh(cross(j, j))
        if p and values[0] > 1e-9 * values[-1]:
            return np.sqrt(values[::-1]), vectors.T[::-1]
    # The triangle has the singular values and right vectors of all rows.
    r = np.linalg.qr(j, mode="r") if len(j) >= p else j
    _, s, vt = np.linalg.svd(r, full_matrices=True)
    return np.concatenate([s, np.zeros(p - len(s))]), vt


@dataclass(frozen=True)
class Estimate:
    """One parameter with its uncertainty, edge unit (mm, deg, 1).

    `low` and `high` bound the 95 % interval (Student's t with the fit's degrees of freedom).

    Attributes:
        images: standard deviation that the noise of the images alone causes.
        priors: standard deviation that the prior of each other parameter (or "beads") causes,
            largest first; sigma^2 is the sum of all squares. Those below a tenth of sigma are
            left out.
        prior: standard deviation of this parameter's own prior; None: without one.
        asked: whether it was requested; otherwise it is estimated for the sake of the
            others.
    """

    value: float
    sigma: float
    low: float
    high: float
    unit: str
    images: float = math.nan
    priors: Mapping[str, float] = field(default_factory=dict)
    prior: float | None = None
    asked: bool = True


@dataclass(frozen=True)
class Outlier:
    """A measured position that was left out: its frame and bead."""

    frame: int
    bead: int


@dataclass(frozen=True, eq=False)
class Rival:
    """What the estimates are if one of several explanations of the images holds.

    Attributes:
        weight: probability of the explanation.
        off: (p,) its values less the estimates, edge units.
        covariance: (p, p) of them, edge units.
    """

    weight: float
    off: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, repr=False)
class Hidden:
    """What a cause could do to the geometry without being told.

    Attributes:
        cause: in words.
        group: of the cause, by its name: which part, or how.
        size_px: root mean square shift of the spots that it moves, of the smallest that is as
            likely as none; of a cause that no size makes so, of the largest that there is [px].
        detected: it is told from that size on.
        axis_px: shift of the axis column by one of that size that is not told [px].
        lengths: change of the magnification by it, as a part of it.
    """

    cause: str
    group: str
    size_px: float
    detected: bool
    axis_px: float
    lengths: float

    def __repr__(self) -> str:
        """Format on one line."""
        return (
            f"<{self.cause} ({self.group}), below {self.size_px:.2g} px: the axis by "
            f"{self.axis_px:.2g} px, lengths by {100 * self.lengths:.2g} %>"
        )


@dataclass(frozen=True, eq=False)
class Certificate:
    """The quality of one fit.

    Attributes:
        estimates: column -> value and uncertainty; empty of meaning (nan) where not determined.
        covariance: (p, p) of the reported columns, edge units, enlargement included.
        bend: computes the second-order term that the covariance lacks: the region of
            likely values is not quite an ellipsoid.
        correlation: (p, p).
        spectrum: rank, condition, null and weak directions.
        dof: degrees of freedom of s^2, after allowing for correlated residuals.
        noise: s, the spread of the whitened residuals; 1 means the stated noise explains them.
        rms_px: root mean square residual per coordinate.
        enlargement: factor on the covariance for residuals correlated from frame to frame.
        residuals_px: (n, k, 2) measured minus predicted, nan where unseen.
        used: (n, k) positions in the fit.
        outliers: positions left out.
        held: parameters held by the gauge, with the reason.
        own: column -> standard deviation of the fit with what its residuals show [edge unit];
            `estimates` state what causes leave open, too.
        rivals: explanations that the images leave open, of which `covariance` is the mean
            square about the estimates; empty for one alone.
        hidden: what each cause could hide that is not told, of the axis the most first.
    """

    estimates: dict[str, Estimate]
    covariance: FloatArray
    bend: Callable[[], Bend]
    correlation: FloatArray
    spectrum: Conditioning
    dof: float
    noise: float
    rms_px: float
    enlargement: float
    residuals_px: FloatArray
    used: npt.NDArray[np.bool_]
    outliers: tuple[Outlier, ...]
    held: tuple[tuple[str, str], ...]
    rivals: tuple[Rival, ...] = ()
    own: Mapping[str, float] = field(default_factory=dict)
    hidden: tuple[Hidden, ...] = ()

    @property
    def determined(self) -> bool:
        """Whether the data, if their errors are white, determine every requested parameter."""
        return self.spectrum.full

    @property
    def beyond(self) -> tuple[Direction, ...]:
        """Requested parameters that white noise would determine, but that the residuals
        show to be known worse than the bound: they drift by more, for example."""
        own = {n: s for n, s in self.own.items() if self.estimates[n].asked}
        return beyond_bound(own, self.spectrum.bound) if self.determined else ()

    @property
    def wide(self) -> tuple[Direction, ...]:
        """Requested parameters stated worse than the bound only by causes that are open.

        Such causes are open in one of twenty right scans: no reason not to use the fit.
        """
        known = {n for d in self.open for n in d.names}
        stated = {
            n: e.sigma
            for n, e in self.estimates.items()
            if e.asked and n not in known and math.isfinite(e.sigma)
        }
        return beyond_bound(stated, self.spectrum.bound)

    @property
    def identifiable(self) -> bool:
        """Whether data and residuals determine every requested parameter within the bound."""
        return self.determined and not self.beyond

    @property
    def open(self) -> tuple[Direction, ...]:
        """Directions and parameters for which the fit is not identifiable."""
        return (*self.spectrum.null, *self.beyond)

    @property
    def weak(self) -> tuple[str, ...]:
        """Open directions first, then what is wide or weak, as text."""
        return tuple(d.text for d in (*self.open, *self.wide, *self.spectrum.weak))

    @property
    def limited(self) -> dict[str, str]:
        """Requested parameters that owe more than half of their variance to priors: name
        -> words on the limit, and the measurement that would reduce it; empty without
        any.
        """
        out = {}
        for name, e in self.estimates.items():
            if e.asked and e.sigma**2 > 2 * e.images**2 and e.priors:
                sources = list(e.priors)
                better = MEASUREMENT_ADVICE.get(
                    sources[0],
                    "a second placement at another SOD in the same fit would tell more",
                )
                out[name] = (
                    f"+- {e.sigma:.2g} {e.unit}, of it {e.images:.1g} "
                    "from the images and the rest from what is not known of "
                    f"{', '.join(sources)}: {better}"
                )
        return out

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
        """Compute the root mean square of the used residuals over frames (`axis` 0: one a
        bead) or beads (1: one a frame) [px]; nan where nothing was used.
        """
        square = np.where(self.used[:, :, None], self.residuals_px, 0.0) ** 2
        count = 2 * self.used.sum(axis=axis)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.sqrt(square.sum(axis=(axis, 2)) / count))

    def mahalanobis2(self, truth: Mapping[str, float]) -> float:
        """Compute the squared distance of values (edge units) from the estimates.

        Along the region's bend. Raises ValueError for a column not reported.
        """
        at, off = self._places(truth)
        return self.bend().distance2(off, at, self.covariance[np.ix_(at, at)])

    def level(self, truth: Mapping[str, float]) -> float:
        """Compute the level of the smallest joint region that contains some values: 0 at
        the estimates, above 0.95 outside of the 95 % region; arguments as `mahalanobis2`.

        That of one explanation is Hotelling's (F distribution). Of rivals it is the mean
        of theirs, each as likely as the values make it: a mean of numbers that are evenly
        distributed over the values that the explanations expect.
        """
        at, off = self._places(truth)
        p = len(at)
        if not self.rivals:
            return float(fdtr(p, self.dof, self.mahalanobis2(truth) / p))
        bend = self.bend()
        levels = []
        likely = []
        for rival in self.rivals:
            covariance = rival.covariance[np.ix_(at, at)]
            distance2 = bend.distance2(off - rival.off[at], at, covariance)
            size = np.sqrt(np.diag(covariance))
            # Determinant in two parts: of mm and scales together it would be lost to
            # rounding.
            volume = 2.0 * np.log(size).sum()
            volume += np.linalg.slogdet(covariance / np.outer(size, size))[1]
            levels.append(float(fdtr(p, self.dof, distance2 / p)))
            likely.append(math.log(rival.weight) - 0.5 * (distance2 + float(volume)))
        # Against the likeliest: far from all rivals, each alone would be 0.
        weights = np.exp(np.array(likely) - max(likely))
        return float(weights @ np.array(levels) / weights.sum())

    def inside_95(self, truth: Mapping[str, float]) -> bool:
        """Check that values are in the joint 95 % region; arguments as `mahalanobis2`."""
        return self.level(truth) <= 0.95

    def _places(self, truth: Mapping[str, float]) -> tuple[list[int], FloatArray]:
        """Find the columns of some values, and compute the values less the estimates."""
        names = list(self.estimates)
        at = [names.index(n) for n in truth]
        off = [v - self.estimates[n].value for n, v in truth.items()]
        return at, np.array(off, dtype=np.float64)


def widened(
    certificate: Certificate, more: FloatArray | Mapping[str, float]
) -> Certificate:
    """Add a covariance to a certificate; estimates keep their values.

    A covariance widens the images' share of each sigma too, a mapping (of systematic
    errors) does not. Intervals are 95 %.

    Args:
        certificate: of a fit; not changed.
        more: (p, p) covariance that the images leave open, edge units; or column -> its
            possible error (0 if missing), as the covariance (off) (off)'.

    Returns:
        A copy with wider covariance, correlation, sigmas and intervals.
    """
    images = np.array([e.images for e in certificate.estimates.values()])
    if isinstance(more, Mapping):
        off = np.array([more.get(n, 0.0) for n in certificate.estimates])
        more = np.outer(off, off)
    else:
        images = np.sqrt(np.maximum(images**2 + np.diag(more), 0.0))
    covariance = certificate.covariance + more
    sigma = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    t = float(stdtrit(certificate.dof, 0.975))
    estimates = {
        n: replace(e, sigma=s, low=e.value - t * s, high=e.value + t * s, images=i)
        for (n, e), s, i in zip(
            certificate.estimates.items(), sigma.tolist(), images.tolist(), strict=True
        )
    }
    return replace(
        certificate,
        estimates=estimates,
        covariance=covariance,
        correlation=covariance / np.outer(sigma, sigma),
        rivals=tuple(
            replace(r, covariance=r.covariance + more) for r in certificate.rivals
        ),
    )


def certify(
    problem: FitProblem,
    x: FloatArray,
    use: npt.NDArray[np.bool_],
    prior_noise: float = 1.0,
    sampling_px: float = 0.0,
    bound: float = BOUND,
) -> Certificate:
    """Make the certificate of column values `x` fitted to the positions `use`.

    The estimate x = U (J' y + W b) with U = (J'J + W)^-1 errs by U J' times the noise of
    the images and by U W times the error of the prior means b. The covariance is the sum
    of both, and residuals that are correlated from frame to frame enlarge only the first.
    Rank and condition are those of the requested columns, all others given.

    Args:
        problem: the data.
        x: column values, internal units.
        use: (n, k) positions that counted; seen ones beyond them are outliers.
        prior_noise: spread of the whitened residuals with which the priors were weighed.
        sampling_px: standard deviation of the part of a detection's error that depends on
            where in a pixel the spot lies. Beads that stay at one place of the pixel grid
            in every frame keep it; on beads that wander it averages out.
        bound: see `spectrum`.

    Returns:
        The certificate, in edge units; inf and nan where not determined.
    """
    names = problem.layout.names
    reported = problem.layout.parameter_count
    jac = problem.jacobian(x, use)
    keep = np.repeat(use.ravel(), 2)
    weight = problem.prior_weight(prior_noise)
    # A prior is one more residual, of its column alone.
    rows = np.concatenate([jac[keep], np.diag(np.sqrt(weight))[weight > 0]])
    beads = int(problem.seen.any(axis=0).sum())
    noise, dof = spread_of_residuals(problem, x, use, prior_noise)
    predicted = problem.predictions(x, use)[0]
    residual = problem.pixels - predicted
    enlargement = correlation_length(residual, use, problem.group)
    if dof:
        effective = max(dof / enlargement, 1.0)
    else:
        effective = 1.0
    asked = problem.layout.asked
    judge = partial(
        spectrum,
        beads=beads,
        noise=noise * math.sqrt(enlargement),
        reported=asked,
        bound=bound,
    )
    spec = judge(rows, names)
    strained = range(problem.layout.bead_columns.stop, problem.layout.panel_column)
    if asked < reported or strained:
        # What the residuals show beyond white noise does not widen priors.
        grown = noise * math.sqrt(enlargement) / prior_noise
        fair = rows.copy()
        fair[len(rows) - int((weight > 0).sum()) :] *= grown if grown > 1.0 else 1.0
        unit = spec.unit_covariance
        spec = replace(judge(fair, names), unit_covariance=unit)
        # Rank and condition say what the images tell of what was asked for, all else given.
        given = [
            i
            for i in range(len(names))
            if not asked <= i < reported and i not in strained
        ]
        spec = _of_what_was_asked(judge(fair[:, given], [names[i] for i in given]), spec)
    factor = edge_factors(names)
    # d(estimate) / d(prior mean), times the width of each prior
    pull = np.zeros((reported, len(names)))
    if spec.full and weight.any():
        shares = np.where(weight > 0, weight / factor**2, 0.0)
        widths = np.where(weight > 0, problem.prior_sigma * factor, 0.0)
        pull = spec.unit_covariance[:reported] * shares * widths
    # noise^2 U counts the priors as if they scattered like the images. That part, gain gain',
    # is taken out before the rest is enlarged, and each prior counts with its own width: pull
    # pull'.
    gain = pull * (noise / prior_noise)
    prior = cross(pull.T, pull.T)
    covariance = prior + enlargement * (
        noise**2 * spec.unit_covariance[:reported, :reported] - cross(gain.T, gain.T)
    )
    bend: Callable[[], Bend] = partial(Bend.none, len(covariance))
    if spec.full and noise > MAX_ROUNDING:
        left = Residuals(
            problem,
            jac[keep] / factor,
            problem.whitened(x).ravel()[keep],
            keep,
            spec.unit_covariance,
            noise,
        )
        bend = partial(bend_of, left, x, factor, reported)
        covariance = _with_common_shifts(left, predicted, covariance, sampling_px)
    images = np.sqrt(np.maximum(np.diag(covariance) - np.diag(prior), 0.0))
    sigma = np.sqrt(np.diag(covariance))
    with np.errstate(invalid="ignore", divide="ignore"):
        correlation = covariance / np.outer(sigma, sigma)
    # The spread is estimated from as many residuals as are left: few make the interval
    # longer.
    t = float(stdtrit(effective, 0.975))
    estimates = {}
    for i, name in enumerate(names[:reported]):
        value = float(x[i] * factor[i])
        half = t * float(sigma[i])
        own = float(problem.prior_sigma[i] * factor[i])
        estimates[name] = Estimate(
            value,
            float(sigma[i]),
            value - half,
            value + half,
            unit_of(name),
            float(images[i]),
            _shares(names, pull[i], float(sigma[i])),
            own if math.isfinite(own) else None,
            i < asked,
        )
    dropped = np.argwhere(problem.seen & ~use)
    outliers = tuple(Outlier(int(f), int(k)) for f, k in dropped)
    used_residual = residual[use]
    return Certificate(
        estimates=estimates,
        covariance=covariance,
        bend=bend,
        correlation=correlation,
        spectrum=spec,
        dof=effective,
        noise=noise,
        rms_px=float(np.sqrt(np.mean(used_residual**2))) if use.any() else math.nan,
        enlargement=enlargement,
        residuals_px=residual,
        used=use,
        outliers=outliers,
        held=problem.layout.held,
        own={name: e.sigma for name, e in estimates.items()},
    )


def _of_what_was_asked(given: Conditioning, whole: Conditioning) -> Conditioning:
    """Return `given` with covariance and null directions of `whole`, which has more
    columns, and its rank lowered to what these leave.
    """
    rank = min(given.rank, len(given.names) - len(whole.null))
    return replace(
        given, unit_covariance=whole.unit_covariance, rank=rank, null=whole.null
    )


def spread_of_residuals(
    problem: FitProblem, x: FloatArray, use: npt.NDArray[np.bool_], prior_noise: float
) -> tuple[float, float]:
    """Compute the standard deviation of whitened residuals at `x`, and degrees of
    freedom.

    A column costs the part of a degree of freedom that the images, not its prior,
    determine (MacKay, Neural Computation 4 (1992) 415). Where priors are moved by more
    than that, their shifts count as residuals. A spread that the problem expects counts
    as `SPREAD_FREEDOM` residuals.
    `use`: (n, k) positions that counted; `prior_noise`: with which priors were weighed.
    Returns (nan, 0) for `LEAST_FREEDOM` or fewer.
    """
    _, _, norms, _, normal, _ = problem.evaluate(x, use, 1)
    weight = problem.prior_weight(prior_noise)
    count = 2.0 * int(use.sum())
    dof = count - _determined(normal, weight)
    if not dof > LEAST_FREEDOM:
        return math.nan, 0.0
    square = float(np.sum(norms[use] ** 2))
    if problem.expected_spread > 0.0:
        dof += SPREAD_FREEDOM
        count += SPREAD_FREEDOM
        square += SPREAD_FREEDOM * problem.expected_spread**2
    moved = float(np.sum(weight * (x - problem.prior_mean) ** 2))
    with_priors = max(count - float((weight == 0.0).sum()), LEAST_FREEDOM)
    return math.sqrt(max(square / dof, (square + moved) / with_priors)), dof


def _determined(told: FloatArray, weight: FloatArray) -> float:
    """Count the columns that the images determine: each by the share of its precision
    that is not its prior's; the result is no whole number.

    Directions that are open altogether (`ROUNDING_OF_COLUMNS`) do not count.

    Args:
        told: (c, c) normal equations of the images.
        weight: (c,) of the priors.
    """
    whole = told + np.diag(weight)
    diagonal = np.diag(whole)
    # Scaled, so that one bound of rounding serves columns of all units.
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(whole * np.outer(scale, scale))
    some = values > ROUNDING_OF_COLUMNS
    prior_share = (
        np.einsum("ij,i->j", vectors[:, some] ** 2, weight * scale**2) / values[some]
    )
    return float(some.sum() - prior_share.sum())


def _shares(names: Sequence[str], pull: FloatArray, sigma: float) -> dict[str, float]:
    """Compute the part of a sigma from each prior; those of one source (`SOURCES`) together, as
    the root of their squares.

    `names`: of the priors; `pull`: (p,) effect of each on the parameter; `sigma`: of the
    parameter.
    Returns source -> part, largest first, without those below a tenth of the sigma.
    """
    square: dict[str, float] = {}
    for name, value in zip(names, pull.tolist(), strict=True):
        kind = name.split(" ")[0]
        source = SOURCES.get(kind) or TOLD_SOURCES.get(name.split("@")[0], name)
        square[source] = square.get(source, 0.0) + value**2
    ordered = sorted(square.items(), key=lambda item: -item[1])
    return {n: math.sqrt(s) for n, s in ordered if s > 0.01 * sigma**2}


def _with_common_shifts(
    left: Residuals, predicted: FloatArray, covariance: FloatArray, sampling_px: float
) -> FloatArray:
    """Add to a covariance what shifts make of it that have one size in all frames: those
    of places in the pixel grid, and those of the problem.

    Args:
        left: residuals.
        predicted: (n, k, 2) [px].
        covariance: (p, p) nominal, edge units.
        sampling_px: see `certify`; 0 for none.
    """
    reported = len(covariance)
    shifts = []
    if sampling_px > 0:
        shifts.append(sampling_px * _sampling_vectors(left.problem, predicted))
    if left.problem.common is not None:
        shifts.append(_whitened_shifts(left.problem, left.problem.common))
    for shift in shifts:
        # An error that all frames have in common moves the estimates as a whole: no number of
        # frames averages it out.
        gain = left.unit_covariance[:reported] @ cross(left.jacobian, shift[left.keep])
        covariance = covariance + gain @ gain.T
    return covariance


def _whitened_shifts(problem: FitProblem, shifts: FloatArray) -> FloatArray:
    """Whiten shifts of the positions [px], (n, k, 2, c); returns (2 n k, c)."""
    w = problem.whiten[..., None]
    across = w[:, :, 0] * shifts[:, :, 0] + w[:, :, 1] * shifts[:, :, 1]
    down = w[:, :, 2] * shifts[:, :, 1]
    return np.stack([across, down], axis=2).reshape(-1, shifts.shape[-1])


def _sampling_vectors(problem: FitProblem, predicted: FloatArray) -> FloatArray:
    """Compute whitened unit errors that follow a bead's place in the pixel grid.

    An error e(x) with the pixel's period, a sin(2 pi x + theta) with theta unknown, has the
    covariance a^2 cos 2 pi (x - x'): two vectors, cosine and sine, for each bead and coordinate.

    `problem`: n frames and k beads; `predicted`: (n, k, 2) places [px].
    Returns (2 n k, 4 k).
    """
    n, k = problem.seen.shape
    # Beads that stay in one place of the grid keep the same error, those that wander have all
    # phases: the two vectors say which.
    phase = 2.0 * math.pi * predicted
    w = problem.whiten
    out = np.zeros((n, k, 2, k, 4))
    for bead in range(k):
        for i, wave in enumerate((np.cos(phase[:, bead]), np.sin(phase[:, bead]))):
            out[:, bead, 0, bead, i] = w[:, bead, 0] * wave[:, 0]
            out[:, bead, 0, bead, 2 + i] = w[:, bead, 1] * wave[:, 1]
            out[:, bead, 1, bead, 2 + i] = w[:, bead, 2] * wave[:, 1]
    return out.reshape(2 * n * k, 4 * k)
