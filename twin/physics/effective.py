"""A spectrum reduced to a few effective energies with the same transmission.

The transmission of a spectrum through any mixture of the sample's materials is a weighted
sum of exponentials, one for each energy. Far fewer exponentials give the same sum over
the thicknesses that occur: energies are taken one by one where they help most, with
non-negative weights, until the largest relative error on a set of thicknesses is below
the tolerance. Then many more thicknesses are drawn; those that miss the tolerance join
the set, and the fit is repeated. The result holds the tolerance on thicknesses that had
no part in the choice; otherwise there is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SIGNAL_TOLERANCE = 1e-3
"""Largest relative error of the signal."""
MIN_TRANSMISSION = 1e-4
"""Transmission below which the error is relative to this value instead (about a
count of 14 bit)."""
LEAST_SIGNAL = 1e-19
"""Signal of an energy that counts as none: float32 does not hold its square."""
MAX_ENERGIES = 48
"""Largest number of effective energies; six metals at once take about 25."""
AIMED_SHARE = 0.5
"""Part of the tolerance that the fit aims at; the rest is for thicknesses between."""
OPEN_BEAM_WEIGHT = 100.0
"""Weight of the open beam in the fit, on which all flats and calibrations depend."""
MIN_OPTICAL_DEPTH = 0.002
"""Smallest optical depth of the fitted thicknesses, at the energy that is weakened most."""
CHECKS_PER_PATH = 5
"""Number of thicknesses that are checked for each one of the fit."""
MAX_ROUNDS = 6
"""Largest number of rounds in which thicknesses outside the tolerance are added."""
BLOCK_PIXELS = 1 << 15
"""Number of pixels in a step, so that they stay in the cache."""


@dataclass(frozen=True, eq=False)
class EffectiveBeam:
    """Effective energies of a beam behind certain materials.

    Attributes:
        names: materials, in the order of `mu`.
        mu: (m, k) attenuation of each material at each effective energy [1/mm].
        signal: (k,) weights, adding up to the open beam's signal.
        noise: (k,) weights of the signal's variance.
        bins: (k,) their bins in the tables.
        worst: largest relative error of the signal over thicknesses that had no part in
            choosing.
    """

    names: tuple[str, ...]
    mu: FloatArray
    signal: FloatArray
    noise: FloatArray
    bins: tuple[int, ...]
    worst: float

    def transmit(self, paths_mm: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Compute the signal and its variance behind path lengths.

        Exponentials are summed over the effective energies, in single precision.

        Args:
            paths_mm: float32 (m, ...) [mm].

        Returns:
            Two float32 arrays (...), in the units of `signal` and `noise`.
        """
        flat = paths_mm.reshape(len(paths_mm), int(np.prod(paths_mm.shape[1:])))
        mu = -self.mu.astype(np.float32)
        weights = np.array([self.signal, self.noise], dtype=np.float32)
        out = np.empty((2, flat.shape[1]), np.float32)
        for start in range(0, flat.shape[1], BLOCK_PIXELS):
            part = slice(start, start + BLOCK_PIXELS)
            through = np.exp(np.einsum("mk,mp->kp", mu, flat[:, part]))
            out[:, part] = np.einsum("wk,kp->wp", weights, through)
        mean, variance = out.reshape(2, *paths_mm.shape[1:])
        return mean, variance

    def mean_mu(self) -> FloatArray:
        """Compute the attenuation of each material, weighted by the open beam's signal, (m,)
        [1/mm]: behind a thickness it is less."""
        return np.asarray(self.mu @ self.signal / self.signal.sum())


def effective_beam(
    signal: FloatArray,
    noise: FloatArray,
    substances: Sequence[Substance],
    thickest_mm: Sequence[float],
    tolerance: float = SIGNAL_TOLERANCE,
) -> EffectiveBeam:
    """Choose effective energies, and fit their weights to signal and variance behind
    sampled paths.

    The variance has the same energies, less exactly: its error is not checked.

    Args:
        signal: (e,) contribution of each bin to the open beam's signal.
        noise: (e,) contribution of each bin to its variance.
        substances: m materials.
        thickest_mm: longest path through each [mm].
        tolerance: largest relative error of the signal.

    Raises:
        LimitError: no energy has a signal.
        TwinError: the tolerance is not reached within `MAX_ROUNDS` rounds of at most
            `MAX_ENERGIES` energies.

    Returns:
        The beam: at most `MAX_ENERGIES` energies whose signal is within the tolerance on
        thicknesses that were not fitted, with the largest error there.
    """
    if not signal.max() > LEAST_SIGNAL:
        message = "no photon leaves anything in the detector"
        raise LimitError.instead(message, 0.0, "one that absorbs some of the spectrum")
    used = np.flatnonzero(signal > signal.max() * 1e-9)
    mu = np.array([s.attenuation()[used] for s in substances]).reshape(
        len(substances), len(used)
    )
    paths = sample_paths(mu, signal[used], thickest_mm)
    chosen: list[int] = []
    for turn in range(MAX_ROUNDS):
        columns, wanted = _relative(paths, mu, signal[used])
        chosen, weights = _pursue(columns, wanted, AIMED_SHARE * tolerance, chosen)
        others = sample_paths(mu, signal[used], thickest_mm, CHECKS_PER_PATH, turn + 1)
        columns, wanted = _relative(others, mu, signal[used])
        error = np.abs(columns[:, chosen] @ weights - wanted)
        worst = float(error.max())
        if worst <= tolerance:
            break
        paths = np.concatenate([paths, others[error > AIMED_SHARE * tolerance]])
    else:
        raise TwinError(
            f"{len(chosen)} effective energies reach {worst:.2g}, not {tolerance:.2g}, for "
            f"{', '.join(s.name for s in substances)}",
            {"asked": tolerance, "reached": worst},
        )
    keep = weights > 0
    bins = np.array(chosen)[keep]
    # The variance on the same energies; its own error matters less (noise, not signal).
    spread, truth = _relative(paths, mu, noise[used])
    heavy = np.ones(len(truth))
    heavy[0] = OPEN_BEAM_WEIGHT
    variance = _non_negative(spread[:, bins] * heavy[:, None], truth * heavy)
    return EffectiveBeam(
        tuple(s.name for s in substances),
        mu[:, bins],
        weights[keep] * signal[used][bins],
        variance * noise[used][bins],
        tuple(int(b) for b in used[bins]),
        worst,
    )


def sample_paths(
    mu: FloatArray,
    signal: FloatArray,
    thickest_mm: Sequence[float],
    more: int = 1,
    seed: int = 0,
) -> FloatArray:
    """Draw path lengths (j, m) [mm] that represent all that occur: alone, together, thin
    and thick; the first row is the open beam.

    They end at the thickness at which a material alone lets nearly nothing through, and
    begin at `MIN_OPTICAL_DEPTH`, apart from the open beam.

    Args:
        mu: (m, e) [1/mm].
        signal: (e,) weights of the energies.
        thickest_mm: longest path through each [mm].
        more: factor on their number.
        seed: other thicknesses for each.
    """
    m = len(mu)
    random = np.random.default_rng([m, seed])
    rows = [np.zeros((1, m))]
    opaque = np.log(1e6 * len(signal)) / np.maximum(mu.min(axis=1, initial=np.inf), 1e-12)
    limit = np.minimum(
        np.maximum(np.asarray(thickest_mm, dtype=np.float64), 1e-6), opaque
    )
    least = np.minimum(
        MIN_OPTICAL_DEPTH / np.maximum(mu.max(axis=1, initial=0.0), 1e-12), limit / 2
    )
    for i in range(m):
        n = 60 * more
        even = (np.arange(n) + random.uniform(size=n)) / (n - 1)
        part = np.minimum(even, 1.0)
        single = np.zeros((2 * n, m))
        single[:n, i] = least[i] * (limit[i] / least[i]) ** part
        single[n:, i] = limit[i] * part**2
        rows.append(single)
    if m > 1:
        part = random.uniform(size=(200 * m * more, m))
        present = random.uniform(size=part.shape) < 0.7
        rows.append(least * (limit / least) ** part * present)
        rows.append(limit * random.uniform(size=part.shape) ** 2)
    return np.concatenate(rows)


def _relative(
    paths: FloatArray, mu: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Compute each energy's contribution behind `paths`, (j, e), and their sum, (j,).

    Both are relative to that sum, or to `MIN_TRANSMISSION` of the open beam's.
    """
    columns = np.exp(-paths @ mu) * weights
    total = columns.sum(axis=1)
    scale = 1.0 / np.maximum(total, MIN_TRANSMISSION * weights.sum())
    return columns * scale[:, None], total * scale


def _pursue(
    columns: FloatArray, wanted: FloatArray, tolerance: float, chosen: list[int]
) -> tuple[list[int], FloatArray]:
    """Choose few columns, `chosen` and more, whose sum with weights >= 0 is `wanted`:
    within `tolerance`, or as near as `MAX_ENERGIES` of them come.

    Args:
        columns: (j, e) contribution of each energy.
        wanted: (j,) their sum.
        tolerance: largest deviation of the sum.
        chosen: columns to begin with.

    Returns:
        Indices of the columns, and their weights.
    """
    norms = np.linalg.norm(columns, axis=0)
    heavy = np.ones(len(wanted))
    heavy[0] = OPEN_BEAM_WEIGHT
    weights = np.zeros(len(chosen))
    chosen = list(chosen)
    rest = wanted
    while True:
        if chosen:
            weights = _non_negative(columns[:, chosen] * heavy[:, None], wanted * heavy)
            rest = wanted - columns[:, chosen] @ weights
            enough = len(chosen) >= min(MAX_ENERGIES, columns.shape[1])
            if enough or float(np.abs(rest).max()) <= tolerance:
                return chosen, weights
        gain = (columns * heavy[:, None] ** 2).T @ rest / np.maximum(norms, 1e-300)
        gain[chosen] = -np.inf
        chosen = sorted([*chosen, int(np.argmax(gain))])


def _non_negative(columns: FloatArray, wanted: FloatArray) -> FloatArray:
    """Solve a least squares problem with weights that are not negative; by a slower method
    (BVLS) where NNLS does not converge.

    `columns`: (m, p) what each weight adds; `wanted`: (m,).
    Returns (p,) weights.
    """
    from scipy.optimize import lsq_linear, nnls

    try:
        weights, _ = nnls(columns, wanted, maxiter=30 * columns.shape[1])
    except RuntimeError:  # nearly equal columns can send it round in circles
        weights = lsq_linear(columns, wanted, (0.0, np.inf), method="bvls").x
    return np.asarray(weights)
