"""Structure in residuals that white noise does not have, and what it does to the covariance.

Three questions: are residuals alike from frame to frame (slow errors), alike within a frame (a
vibration moves all beads together), and do they follow a drift or a jump of a parameter during the
scan? Each test has a threshold that white noise passes once in some ten thousand fits, so that
clean data keep the nominal covariance. It refuses to say what caused the structure.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.model import Problem
from flexdt.twin.conventions import FloatArray

SIGNIFICANT = 4.5
"""Standard deviations a test statistic must exceed."""
HARMONICS = 3
"""Of the turn, in which errors of single beads are sought."""
HINT = 1.5
"""The same for a second drift once a first is found."""
MOVING = ("dO_x", "dO_y", "dO_z", "alpha")
"""Parameters that may change during a scan: the object's place and angle (a drift of the source or
the detector looks like one of the object)."""


@dataclass(frozen=True)
class Drift:
    """A change of a parameter during the scan.

    Attributes:
        column: the parameter.
        size: end minus start, edge unit.
        step_at: frame of a jump, or None for a steady drift.
        score: its size in standard deviations.
        bias: (p,) what it does to the fitted values, edge units.
    """

    column: str
    size: float
    step_at: int | None
    score: float
    bias: FloatArray


def _reduced(rows: FloatArray, vectors: FloatArray) -> FloatArray:
    """Vectors (m, v) less what the fit absorbs."""
    q, _ = np.linalg.qr(rows)
    return np.asarray(vectors - q @ (q.T @ vectors))


def drifts(
    problem: Problem,
    jacobian: FloatArray,
    residual: FloatArray,
    frame: npt.NDArray[np.intp],
    unit_covariance: FloatArray,
    noise: float,
) -> tuple[Drift, ...]:
    """Drifts and jumps of single parameters that the residuals follow, strongest first.

    Args:
        problem: for the columns and groups.
        jacobian: whitened rows (m, p) of the used positions, edge units.
        residual: (m,) whitened, measured minus predicted.
        frame: (m,) frame of each row.
        unit_covariance: (p, p) (J'J)^-1 in edge units.
        noise: standard deviation of the whitened residuals.
    """
    found: list[Drift] = []
    names = problem.layout.names
    columns = [i for i, n in enumerate(names) if n.split("@")[0] in MOVING]
    if noise <= 0 or len(residual) <= len(names) + 8:
        return ()
    for group in np.unique(problem.group):
        members = np.flatnonzero(problem.group == group)
        n = len(members)
        if n < 12:
            continue
        order = np.full(len(problem.group), 0.0)
        order[members] = np.arange(n)
        inside = (problem.group == group)[frame]
        place = order[frame]
        ramp = np.where(inside, place / (n - 1) - 0.5, 0.0)
        shapes: list[tuple[int | None, FloatArray]] = [(None, ramp)]
        for at in np.unique(np.linspace(2, n - 2, 11).round().astype(int)).tolist():
            shapes.append((int(members[at]), np.where(inside, (place >= at) - 0.5, 0.0)))
        vectors = (
            np.stack([jacobian[:, c] * shape for c in columns for _, shape in shapes], axis=1)
            if columns
            else np.zeros((len(residual), 0))
        )
        reduced = _reduced(jacobian, vectors)
        power = np.einsum("ij,ij->j", reduced, reduced)
        push = reduced.T @ residual
        usable = power > 1e-3 * np.maximum(np.einsum("ij,ij->j", vectors, vectors), 1e-30)
        score = np.where(usable, push / np.sqrt(np.maximum(power, 1e-30)) / noise, 0.0)
        for i, c in enumerate(columns):
            part = slice(i * len(shapes), (i + 1) * len(shapes))
            best = int(np.argmax(np.abs(score[part])))
            j = i * len(shapes) + best
            if abs(score[j]) > HINT:
                size = float(push[j] / power[j])
                bias = unit_covariance @ (jacobian.T @ (vectors[:, j] * size))
                found.append(Drift(names[c], size, shapes[best][0], float(abs(score[j])), bias))
    if not any(d.score > SIGNIFICANT for d in found):
        return ()
    # Where one thing moves, hints of others count too.
    return tuple(sorted(found, key=lambda d: -d.score))


def cluster_covariance(
    problem: Problem,
    jacobian: FloatArray,
    residual: FloatArray,
    frame: npt.NDArray[np.intp],
    unit_covariance: FloatArray,
    noise: float,
) -> FloatArray | None:
    """Covariance (p, p) that allows for errors shared by all beads of a frame; None if not needed.

    Args:
        problem, jacobian, residual, frame, unit_covariance, noise: as `drifts`.
    """
    frames, member = np.unique(frame, return_inverse=True)
    n, p = len(frames), jacobian.shape[1]
    if n < 12 or n < 2 * p or noise <= 0:
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
            alike = max(alike, float(together.sum()) / (noise**2 * math.sqrt(2.0 * total)))
    if alike < SIGNIFICANT:
        return None
    scores = np.zeros((n, p))
    np.add.at(scores, member, jacobian * residual[:, None])
    out: FloatArray = unit_covariance @ (scores.T @ scores) @ unit_covariance * (n / (n - p / 2))
    return out


def turning_errors(
    problem: Problem,
    jacobian: FloatArray,
    residual: FloatArray,
    keep: npt.NDArray[np.bool_],
    unit_covariance: FloatArray,
    noise: float,
) -> FloatArray | None:
    """Covariance (p, p) to add for errors of a bead that repeat as the object turns; None if none.

    Bead positions that are off, a background that pulls centroids, distortion of the detector: each
    bead's error is then a smooth function of the angle. Its harmonics 1 to 3 are sought in every
    bead's columns and rows; what is found there is also assumed in the harmonic 0, which the fit
    hides.

    Args:
        problem, jacobian, residual, unit_covariance, noise: as `drifts`.
        keep: (2 n k,) which rows are used.
    """
    n, k = problem.seen.shape
    if n < 16 or noise <= 0:
        return None
    angle = problem.poses.angle
    w = problem.whiten
    waves = [np.ones(n)]
    for m in range(1, HARMONICS + 1):
        waves += [np.cos(m * angle), np.sin(m * angle)]
    # vectors[(bead, coordinate, wave)] as whitened rows of the used positions
    basis = np.zeros((n, k, 2, k, 2, len(waves)))
    for bead in range(k):
        for i, wave in enumerate(waves):
            basis[:, bead, 0, bead, 0, i] = w[:, bead, 0] * wave
            basis[:, bead, 0, bead, 1, i] = w[:, bead, 1] * wave
            basis[:, bead, 1, bead, 1, i] = w[:, bead, 2] * wave
    vectors = basis.reshape(2 * n * k, -1)[keep]
    kind = np.tile(np.arange(len(waves)), 2 * k)
    coordinate = np.tile(np.repeat([0, 1], len(waves)), k)
    turning = (kind > 0) & (np.abs(vectors).sum(axis=0) > 0)
    reduced = _reduced(jacobian, vectors[:, turning])
    q, r = np.linalg.qr(reduced)
    q = q[:, np.abs(np.diag(r)) > 1e-6 * np.abs(r).max()]
    if len(residual) < 3 * q.shape[1]:
        return None
    inside = q.T @ residual
    rest = float(residual @ residual - inside @ inside) / max(
        len(residual) - q.shape[1] - jacobian.shape[1], 1
    )
    energy = float(inside @ inside) / max(rest, 1e-30)
    if energy - q.shape[1] < SIGNIFICANT * math.sqrt(2.0 * q.shape[1]):
        return None
    # Amplitudes of each harmonic and coordinate, over the beads, less what noise gives.
    power = np.einsum("ij,ij->j", reduced, reduced)
    size = (reduced.T @ residual) / np.maximum(power, 1e-30)
    excess = np.maximum(size**2 - rest / np.maximum(power, 1e-30), 0.0)
    usable = power > 0.2 * np.einsum("ij,ij->j", vectors[:, turning], vectors[:, turning])
    gain = unit_covariance @ jacobian.T @ vectors
    out = np.zeros_like(unit_covariance)
    for c in (0, 1):
        strongest = 0.0
        for m in range(1, HARMONICS + 1):
            mine = (coordinate[turning] == c) & ((kind[turning] + 1) // 2 == m) & usable
            variance = float(excess[mine].mean()) if mine.any() else 0.0
            strongest = max(strongest, variance)
            part = gain[:, (coordinate == c) & ((kind + 1) // 2 == m)]
            out += variance * part @ part.T
        part = gain[:, (coordinate == c) & (kind == 0)]
        out += strongest * part @ part.T
    return out


def larger(a: FloatArray, b: FloatArray) -> FloatArray:
    """The smallest covariance of a's shape that is at least as wide as both in every direction."""
    low = np.linalg.cholesky(a)
    inverse = np.linalg.inv(low)
    values, vectors = np.linalg.eigh(inverse @ b @ inverse.T)
    wide: FloatArray = low @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ low.T
    return wide


def correlation_length(
    residual: FloatArray, use: npt.NDArray[np.bool_], group: npt.NDArray[np.int64]
) -> tuple[float, float]:
    """Lag-one autocorrelation of residuals along the frames, and their correlation length.

    The length is 1 + 2 sum(rho) over the lags until the correlation first falls below noise: the
    number of frames that count as one. It stays 1 unless lag one is significant (4 sigma), so
    that white residuals keep the nominal covariance.

    Args:
        residual: (n, k, 2) px.
        use: (n, k).
        group: (n,) frames of different groups are not neighbours.
    """
    n = len(residual)
    clean = np.where(use[:, :, None], residual, 0.0)
    power = float(np.sum(clean**2))
    count = 2 * int(use.sum())
    if n < 8 or count < 24 or power <= 0.0:
        return 0.0, 1.0
    power /= count

    def rho(lag: int) -> tuple[float, int]:
        together = use[:-lag] & use[lag:] & (group[:-lag] == group[lag:])[:, None]
        pairs = 2 * int(together.sum())
        if pairs == 0:
            return 0.0, 0
        value = float(np.sum(clean[:-lag] * clean[lag:] * together[:, :, None]))
        return value / pairs / power, pairs

    first, pairs = rho(1)
    if pairs == 0 or first * math.sqrt(pairs) < 4.0:
        return first, 1.0
    length = 1.0 + 2.0 * first
    for lag in range(2, n // 2):
        value, pairs = rho(lag)
        if pairs == 0 or value * math.sqrt(pairs) < 2.0:
            break
        length += 2.0 * value
    return first, length
