"""Structure in residuals that white noise does not have, and its effect on the covariance.

Three questions: are residuals correlated from frame to frame (slow errors), or within a frame
(a vibration moves all beads together), and do they follow a drift or a jump of a parameter
during the scan? Each test has a threshold that white noise passes once in some ten thousand
fits, so that clean data keep the nominal covariance. Causes are not looked for here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.special import chdtrc, chdtri, stdtr

from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.geometry.conventions import FloatArray

SIGNIFICANT = 4.5
"""Standard deviations from which a test statistic is significant."""
SUSPECT_SIGMAS = 2.3
"""The same for a steady drift to be allowed for without being reported: a drift that just
escapes notice moves a parameter by 1.7 times its score."""
SUSPECT_STEP = 3.5
"""The same for jumps, of which many are tried."""
CLUSTER_SIGMAS = 3.2
"""The same for errors that the beads of a frame share."""
FEWEST_CLUSTERS = 12
"""Frames from which their shared errors have a covariance (a sandwich estimate by frames)."""
JITTER_CHANCE = 1e-3
"""Probability below which frames do not scatter so much, or do not drift so much for their
scatter, by chance."""
HARMONICS = 3
"""Number of harmonics of the turn in which errors of single beads are sought."""
MIN_MOVING_FRAMES = 2
"""Least number of frames between which something may move."""
HINT_SIGMAS = 1.5
"""The same for a second drift once a first is found."""
MOVING = ("dO_x", "dO_y", "dO_z", "alpha")
"""Parameters that may change during a scan: the object's place and angle (a drift of the source
or the detector looks like one of the object)."""


@dataclass(frozen=True)
class Drift:
    """A change of a parameter during the scan.

    Attributes:
        column: the parameter.
        size: end minus start, edge unit.
        step_at: frame of a jump, counted in its scan, or None for a steady drift.
        score: its size in standard deviations.
        bias: (p,) its effect on the fitted values, edge units.
        scan: number of the group of frames that drifts.
        jitter: the frames scatter so much that this is no drift, but a part of that.
    """

    column: str
    size: float
    step_at: int | None
    score: float
    bias: FloatArray
    scan: int = 0
    jitter: bool = False


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute a.T @ b of two tall matrices, (m, i) and (m, j), in one thread.

    These products are too small for BLAS threads, which cost more than the work and spin where
    the cores are busy.
    """
    return np.asarray(np.einsum("mi,mj->ij", a, b))


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of a fit of p columns at its m used coordinates, and its covariance.

    Attributes:
        problem: for the columns and groups.
        jacobian: whitened rows (m, p), edge units.
        values: (m,) whitened, measured minus predicted.
        keep: (2 n k,) which of all rows are used.
        unit_covariance: (p, p) (J'J)^-1 in edge units.
        noise: standard deviation of the values.
    """

    problem: FitProblem
    jacobian: FloatArray
    values: FloatArray
    keep: npt.NDArray[np.bool_]
    unit_covariance: FloatArray
    noise: float

    @property
    def frame(self) -> npt.NDArray[np.intp]:
        """(m,) frame of each row."""
        return np.asarray(np.flatnonzero(self.keep) // (2 * self.problem.seen.shape[1]))


def drifts(left: Residuals) -> tuple[Drift, ...]:
    """Find drifts and jumps of single parameters (MOVING) in the residuals, strongest
    first, in each group of `MIN_MOVING_FRAMES` or more.

    A column's ramp and 11 jumps at most are compared. If some drift exceeds `SIGNIFICANT`, hints
    of others (`HINT_SIGMAS`) count, too.

    Args:
        left: residuals with their derivatives, covariance and noise.

    Returns:
        With a certain drift, it and the hints; else the possible ones, unsorted (jumps
        beyond `SUSPECT_STEP`, steady drifts beyond `SUSPECT_SIGMAS`). Empty for few
        residuals or without noise.
    """
    names = left.problem.layout.names
    columns = [i for i, n in enumerate(names) if n.split("@")[0] in MOVING]
    if left.noise <= 0 or len(left.values) <= len(names) + 8 or not columns:
        return ()
    told = np.einsum("mp,m->p", left.jacobian, left.values)
    clean = left.values - left.jacobian @ (left.unit_covariance @ told)
    found: list[Drift] = []
    suspects: list[Drift] = []
    for group in np.unique(left.problem.group).tolist():
        if np.count_nonzero(left.problem.group == group) < MIN_MOVING_FRAMES:
            continue
        motions = _Motions.of(left, clean, columns, group)
        for i in range(len(columns)):
            if (suspect := motions.suspect(i)) is not None:
                suspects.append(motions.drift(i, suspect))
            if (hint := motions.hint(i)) is not None:
                found.append(motions.drift(i, hint))
    if not any(d.score > SIGNIFICANT for d in found):
        return tuple(suspects)
    # Where one thing moves, hints of others count too.
    return tuple(sorted(found, key=lambda d: -d.score))


@dataclass(frozen=True, eq=False)
class _Motions:
    """A ramp, and jumps, of each of c columns in the frames of one group, beside the
    residuals.

    Attributes:
        left: residuals.
        clean: (m,) residuals, less what the fit's columns take.
        columns: (c,) their numbers in the fit.
        group: number of the group.
        frames: its number of frames.
        inside: (m,) which residuals are of its frames.
        jumps_at: (s,) frame of each jump, counted in the group; None for the ramp, the first.
        vectors: (m, c s) changes of the residuals.
        absorbed: (p, c s) what the fit's columns see of them.
        power: (c s,) squares of what these leave.
        push: (c s,) what the residuals have in common with them.
    """

    left: Residuals
    clean: FloatArray
    columns: Sequence[int]
    group: int
    frames: int
    inside: npt.NDArray[np.bool_]
    jumps_at: Sequence[int | None]
    vectors: FloatArray
    absorbed: FloatArray
    power: FloatArray
    push: FloatArray

    @classmethod
    def of(
        cls, left: Residuals, clean: FloatArray, columns: Sequence[int], group: int
    ) -> _Motions:
        """Compare a ramp, and 11 jumps at most, with the residuals."""
        groups = left.problem.group
        members = np.flatnonzero(groups == group)
        n = len(members)
        order = np.full(len(groups), 0.0)
        order[members] = np.arange(n)
        inside = (groups == group)[left.frame]
        place = order[left.frame]
        at = np.unique(np.linspace(2, n - 2, 11).round().astype(int)).tolist()
        ramp = np.where(inside, place / (n - 1) - 0.5, 0.0)
        shapes = [ramp, *(np.where(inside, (place >= a) - 0.5, 0.0) for a in at)]
        vectors = np.stack(
            [left.jacobian[:, c] * shape for c in columns for shape in shapes], axis=1
        )
        absorbed = cross(left.jacobian, vectors)
        whole = np.einsum("mi,mi->i", vectors, vectors)
        taken = np.einsum("pi,pq,qi->i", absorbed, left.unit_covariance, absorbed)
        power = whole - taken
        # What the columns take almost whole cannot be told: its power is rounding.
        told = power > 1e-3 * np.maximum(whole, 1e-30)
        return cls(
            left,
            clean,
            columns,
            group,
            n,
            inside,
            (None, *at),
            vectors,
            absorbed,
            power,
            np.where(told, np.einsum("mi,m->i", vectors, clean), 0.0),
        )

    @cached_property
    def score(self) -> FloatArray:
        """Size of each motion in its standard deviations, (c, s); 0 where it cannot be told."""
        deviation = np.sqrt(np.maximum(self.power, 1e-30))
        score = np.abs(self.push / deviation / self.left.noise)
        return score.reshape(len(self.columns), len(self.jumps_at))

    def suspect(self, i: int) -> int | None:
        """Return which motion of column i is possible: its best one, else the ramp; None
        without.
        """
        best = int(np.argmax(self.score[i]))
        if self.score[i, best] > SUSPECT_STEP:
            return best
        return 0 if self.score[i, 0] > SUSPECT_SIGMAS else None

    def hint(self, i: int) -> int | None:
        """Return the best motion of column i, if it counts beside a certain one; else None."""
        best = int(np.argmax(self.score[i]))
        return best if self.score[i, best] > HINT_SIGMAS else None

    def drift(self, i: int, shape: int) -> Drift:
        """Describe a motion of column i, fitted to the residuals."""
        left = self.left
        j = i * len(self.jumps_at) + shape
        size = float(self.push[j] / self.power[j])
        taken = left.jacobian @ (left.unit_covariance @ self.absorbed[:, j])
        column = self.columns[i]
        scatter = self.frames < FEWEST_CLUSTERS and _scatters(
            left,
            np.where(self.inside, left.jacobian[:, column], 0.0),
            self.clean,
            (self.vectors[:, j] - taken) * size,
            len(self.push),
        )
        return Drift(
            left.problem.layout.names[column],
            size,
            self.jumps_at[shape],
            float(self.score[i, shape]),
            left.unit_covariance @ (self.absorbed[:, j] * size),
            self.group,
            scatter,
        )


def _scatters(
    left: Residuals, slope: FloatArray, clean: FloatArray, drift: FloatArray, tried: int
) -> bool:
    """Check whether a parameter scatters from frame to frame, so that its drift may be chance.

    Of few frames any scatter has a slope. The size of the drift is compared with the scatter
    that it leaves, by Student's t with the degrees of freedom that the fit leaves the frames.

    Args:
        left: residuals.
        slope: (m,) their change by a unit of the parameter; 0 in frames of other groups.
        clean: (m,) residuals, less what the fit's columns take.
        drift: (m,) their change by the drift, less that, too.
        tried: number of drifts that were compared.
    """
    power = np.bincount(left.frame, slope**2)
    there = power > 0
    power = power[there]
    each = left.frame[:, None] == np.flatnonzero(there)
    absorbed = cross(left.jacobian, slope[:, None] * each)
    taken = np.einsum("pf,pq,qf->f", absorbed, left.unit_covariance, absorbed)
    freedom = float((1.0 - taken / power).sum()) - 1.0
    if freedom < 1.0:
        return False
    rest = np.bincount(left.frame, slope * (clean - drift))[there] ** 2 / power
    gone = np.bincount(left.frame, slope * drift)[there] ** 2 / power
    square = float(rest.sum())
    if chdtrc(freedom, square / left.noise**2) > JITTER_CHANCE:
        return False
    score = math.sqrt(float(gone.sum()) / (square / freedom))
    return bool(2.0 * tried * stdtr(freedom, -score) > JITTER_CHANCE)


def with_lost_frames(
    seen: npt.NDArray[np.bool_], use: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Mark the used positions, and all seen ones of a frame whose positions were mostly
    left out, (n, k).

    Single beads left out are outliers, all of them together are motion.
    """
    out = use.copy()
    lost = (seen & ~use).sum(axis=1) > 0.5 * seen.sum(axis=1)
    out[lost] = seen[lost]
    return out


def cluster_covariance(left: Residuals) -> FloatArray | None:
    """Compute the covariance that allows for errors all beads of a frame share (a
    sandwich estimate by frames).

    Judged by the parameters that may move from frame to frame: the residuals of a frame
    must act on one of them together by `CLUSTER_SIGMAS`.

    Args:
        left: residuals with their derivatives, covariance and noise.

    Returns:
        (p, p); None if beads of a frame do not err together, or for fewer than 12 frames
        or twice the columns without a prior.
    """
    problem = left.problem
    jacobian = left.jacobian
    residual = left.values
    frame = left.frame
    unit_covariance = left.unit_covariance
    noise = left.noise
    frames, member = np.unique(frame, return_inverse=True)
    n = len(frames)
    p = jacobian.shape[1]
    fitted = int(
        np.isinf(problem.prior_sigma).sum()
    )  # a prior leaves hardly a degree of freedom
    if n < FEWEST_CLUSTERS or n < 2 * fitted or noise <= 0:
        return None
    names = problem.layout.names
    alike = 0.0
    for i, name in enumerate(names):
        if name.split("@")[0] not in MOVING:
            continue
        w = jacobian[:, i]
        wr = w * residual
        together = np.bincount(member, wr, n) ** 2 - np.bincount(member, wr**2, n)
        spread = np.bincount(member, w**2, n) ** 2 - np.bincount(member, w**4, n)
        total = float(spread.sum())
        if total > 0:
            alike = max(
                alike, float(together.sum()) / (noise**2 * math.sqrt(2.0 * total))
            )
    if alike < CLUSTER_SIGMAS:
        return None
    scores = np.zeros((n, p))
    np.add.at(scores, member, jacobian * residual[:, None])
    out: FloatArray = unit_covariance @ cross(scores, scores) @ unit_covariance
    return np.asarray(out * (n / (n - fitted / 2)))


@dataclass(frozen=True, eq=False)
class TurningErrors:
    """Errors of single beads that are smooth functions of the angle.

    Attributes:
        covariance: (p, p) that they add to the fitted values', edge units.
        size: root mean square, in standard deviations of a position.
    """

    covariance: FloatArray
    size: float


def turning_errors(left: Residuals) -> TurningErrors | None:
    """Estimate errors of a bead that repeat as the object turns, and the covariance to add.

    Bead positions that are off, a background that pulls centroids, distortion of the
    detector: each bead's error is then a smooth function of the angle. Its harmonics 0 to
    3 are sought in every bead's columns and rows. An error found in one bead is assumed
    in all, and in harmonic 0, most of which the fit hides, as much as in any other.

    Args:
        left: residuals with their derivatives, covariance and noise.

    Returns:
        The errors; None if there are none, or for fewer than 16 frames.
    """
    problem = left.problem
    jacobian = left.jacobian
    residual = left.values
    keep = left.keep
    unit_covariance = left.unit_covariance
    noise = left.noise
    n, k = problem.seen.shape
    if n < 16 or noise <= 0:
        return None
    angle = problem.poses.angle
    w = problem.whiten
    waves = [np.ones(n)]
    for m in range(1, HARMONICS + 1):
        waves += [np.cos(m * angle), np.sin(m * angle)]
    count = len(waves)
    table = np.stack(waves, axis=1)
    frames = np.flatnonzero(keep) // (2 * k)
    beads = np.flatnonzero(keep) // 2 % k
    rows = np.flatnonzero(keep) % 2
    # A column (bead, coordinate, wave) is zero but for the rows of its bead, so all products
    # are made bead by bead.
    columns = 2 * k * count
    gram = np.zeros((columns, columns))
    absorbed = np.zeros((jacobian.shape[1], columns))
    push = np.zeros(columns)
    for bead in range(k):
        mine = np.flatnonzero(beads == bead)
        f = frames[mine]
        upper = rows[mine] == 0
        first = np.where(upper, w[f, bead, 0], 0.0)[:, None] * table[f]
        second = np.where(upper, w[f, bead, 1], w[f, bead, 2])[:, None] * table[f]
        part = np.concatenate([first, second], axis=1)
        place = slice(2 * count * bead, 2 * count * (bead + 1))
        gram[place, place] = cross(part, part)
        absorbed[:, place] = cross(jacobian[mine], part)
        push[place] = np.einsum("mi,m->i", part, residual[mine])
    kind = np.tile(np.arange(count), 2 * k)
    coordinate = np.tile(np.repeat([0, 1], count), k)
    fitted = unit_covariance @ np.einsum("mp,m->p", jacobian, residual)
    gain = unit_covariance @ absorbed
    whole = np.diag(gram).copy()
    # What the fit absorbs of each column is taken out.
    gram -= absorbed.T @ unit_covariance @ absorbed
    push -= absorbed.T @ fitted
    present = whole > 0
    # Constant errors have few degrees of freedom left, and would drown among the harmonics.
    found = [
        _excess(gram, push, residual, present & of_kind, jacobian.shape[1])
        for of_kind in (kind == 0, kind > 0)
    ]
    if all(f is None for f in found):
        return None
    excess = np.zeros(columns)
    for f, of_kind in zip(found, (kind == 0, kind > 0), strict=True):
        if f is not None:
            excess[present & of_kind] = f
    left_of = np.diag(gram)
    # A wave counts by what is seen of it: nothing at its zeros.
    told = np.where(present & (left_of > 0.05 * whole), left_of, 0.0)
    out = np.zeros_like(unit_covariance)
    for c in (0, 1):
        variances = []
        for m in range(HARMONICS + 1):
            mine = (coordinate == c) & ((kind + 1) // 2 == m)
            total = float(told[mine].sum())
            variances.append(float(told[mine] @ excess[mine]) / max(total, 1e-300))
        variances[0] = max(variances)
        for m, variance in enumerate(variances):
            part = gain[:, (coordinate == c) & ((kind + 1) // 2 == m)]
            out += variance * part @ part.T
    size = math.sqrt(float(excess @ whole) / len(residual)) / noise
    return TurningErrors(out, size)


def _excess(
    gram: FloatArray,
    push: FloatArray,
    residual: FloatArray,
    which: npt.NDArray[np.bool_],
    parameters: int,
) -> FloatArray | None:
    """Compute squared amplitudes of some columns beyond noise, if together they are
    significant (chance 1e-3).

    Args:
        gram: (c, c) products of the columns.
        push: (c,) products with the residuals.
        residual: (m,).
        which: (c,) columns to judge.
        parameters: number of fitted columns.

    Returns:
        (number judged,), 0 where noise explains it; None if not significant, or for fewer
        than three residuals a direction.
    """
    part = gram[np.ix_(which, which)]
    power = np.maximum(np.diag(part), 1e-30)
    spread = float(residual @ residual) / max(len(residual) - parameters, 1)
    rough = float(np.sum(push[which] ** 2 / power)) / max(spread, 1e-30)
    if rough < len(power) + math.sqrt(2.0 * len(power)):
        return None  # nothing there: the exact test need not be made
    values, directions = np.linalg.eigh(part)
    if len(values):
        free = values > 1e-6 * max(float(values[-1]), 1e-30)
    else:
        free = np.zeros(0, bool)
    rank = int(free.sum())
    if rank == 0 or len(residual) < 3 * rank:
        return None
    inside = float(np.sum((directions[:, free].T @ push[which]) ** 2 / values[free]))
    rest = (float(residual @ residual) - inside) / max(
        len(residual) - rank - parameters, 1
    )
    # An energy of `rank` is expected; its chi-square tail at the level of the other tests.
    if inside / max(rest, 1e-30) < chdtri(rank, 1e-3):
        return None
    return np.asarray(np.maximum((push[which] / power) ** 2 - rest / power, 0.0))


def larger(a: FloatArray, b: FloatArray) -> FloatArray:
    """Compute the smallest covariance of a's shape that is at least as wide as both in
    every direction.

    Args:
        a: (p, p), positive diagonal.
        b: (p, p).
    """
    # Of exact positions `a` is the priors' alone and of lower rank.
    low = np.linalg.cholesky(a + 1e-12 * np.diag(np.diag(a)))
    inverse = np.linalg.inv(low)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    wide: FloatArray = low @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ low.T
    return wide


def correlation_length(
    residual: FloatArray, use: npt.NDArray[np.bool_], group: npt.NDArray[np.int64]
) -> float:
    """Estimate the correlation length of residuals along the frames.

    It is 1 + 2 sum(rho) over the lags until the correlation first falls below noise (2
    sigma), half of the frames at most: the number of frames that count as one. It stays 1
    unless lag one is significant (4 sigma), so that white residuals keep the nominal
    covariance, and for fewer than 8 frames or 24 used coordinates.

    Args:
        residual: (n, k, 2) px.
        use: (n, k).
        group: (n,) frames of different groups are not neighbours.

    Returns:
        1 or more [frames].
    """
    n = len(residual)
    clean = np.where(use[:, :, None], residual, 0.0)
    power = float(np.sum(clean**2))
    count = 2 * int(use.sum())
    if n < 8 or count < 24 or power <= 0.0:
        return 1.0
    power /= count

    def rho(lag: int) -> tuple[float, int]:
        """Compute the correlation of residuals `lag` frames apart in the same scan, as a
        share of the variance, and the number of values it is from; (0, 0) where no two
        frames have that distance.
        """
        together = use[:-lag] & use[lag:] & (group[:-lag] == group[lag:])[:, None]
        pairs = 2 * int(together.sum())
        if pairs == 0:
            return 0.0, 0
        value = float(np.sum(clean[:-lag] * clean[lag:] * together[:, :, None]))
        return value / pairs / power, pairs

    first, pairs = rho(1)
    if pairs == 0 or first * math.sqrt(pairs) < 4.0:
        return 1.0
    length = 1.0 + 2.0 * first
    for lag in range(2, n // 2):
        value, pairs = rho(lag)
        if pairs == 0 or value * math.sqrt(pairs) < 2.0:
            break
        length += 2.0 * value
    return length
