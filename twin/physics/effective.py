"""A spectrum reduced to a few effective energies that transmit what the spectrum transmits.

The transmission of a spectrum through any mixture of the sample's materials is a weighted sum of
exponentials, one for each energy. Far fewer exponentials give the same sum over the thicknesses
that occur: energies are taken one by one where they help most, with non-negative weights, until the
largest relative error on a set of thicknesses is below the tolerance. Then many more thicknesses
are drawn; those that miss the tolerance join the set, and the fit is repeated. The result holds the
tolerance on thicknesses that had no part in the choice; otherwise there is an error.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray

TOLERANCE = 1e-3
FAINTEST = 1e-4
"""Below this transmission the error is measured against it instead (about a count of 14 bit)."""
MOST = 48
"""Effective energies at most; six metals at once take about 25."""
AIM = 0.5
"""Part of the tolerance that is aimed at; the rest is for thicknesses between."""
OPEN_BEAM = 100.0
"""Weight of the open beam, which all flats and all calibrations hang on."""
THIN = 0.002
"""Optical depth, at the energy that is weakened most, from which on thicknesses are asked."""
CHECKED = 5
"""Thicknesses checked for each that is chosen from."""
ROUNDS = 6
"""Times that thicknesses which miss are added."""
BLOCK = 1 << 15
"""Pixels worked on at a time, so that they stay in cache."""


@dataclass(frozen=True, eq=False)
class EffectiveBeam:
    """Effective energies of a beam behind certain materials.

    Attributes:
        names: materials, in the order of `mu`.
        mu: (m, k) attenuation of each material at each effective energy [1/mm].
        signal: (k,) weights, adding up to the open beam's signal.
        noise: (k,) weights of the signal's variance.
        bins: (k,) their bins in the tables.
        worst: largest relative error of the signal over thicknesses that had no part in choosing.
    """

    names: tuple[str, ...]
    mu: FloatArray
    signal: FloatArray
    noise: FloatArray
    bins: tuple[int, ...]
    worst: float

    def transmit(self, paths_mm: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Signal and its variance behind path lengths.

        Args:
            paths_mm: float32 (m, ...) [mm].

        Returns:
            Two float32 arrays (...), in the units of `signal` and `noise`.
        """
        flat = paths_mm.reshape(len(paths_mm), int(np.prod(paths_mm.shape[1:])))
        mu = -self.mu.astype(np.float32)
        weights = np.array([self.signal, self.noise], dtype=np.float32)
        out = np.empty((2, flat.shape[1]), np.float32)
        for start in range(0, flat.shape[1], BLOCK):
            part = slice(start, start + BLOCK)
            through = np.exp(np.einsum("mk,mp->kp", mu, flat[:, part]))
            out[:, part] = np.einsum("wk,kp->wp", weights, through)
        mean, variance = out.reshape(2, *paths_mm.shape[1:])
        return mean, variance


def effective_beam(
    signal: FloatArray,
    noise: FloatArray,
    substances: Sequence[Substance],
    thickest_mm: Sequence[float],
    tolerance: float = TOLERANCE,
) -> EffectiveBeam:
    """Choose effective energies.

    Args:
        signal: (e,) what each bin adds to the open beam's signal.
        noise: (e,) what each bin adds to its variance.
        substances: m materials.
        thickest_mm: longest path through each [mm].
        tolerance: largest relative error of the signal.

    Raises:
        LimitError: no energy has a signal.
        TwinError: not reached with `MOST` energies.
    """
    if not signal.max() > 0.0:
        said = "no photon leaves anything in the detector"
        raise LimitError.instead(said, 0.0, "one that absorbs some of the spectrum")
    used = np.flatnonzero(signal > signal.max() * 1e-9)
    mu = np.array([s.attenuation()[used] for s in substances]).reshape(len(substances), len(used))
    paths = sample_paths(mu, signal[used], thickest_mm)
    chosen: list[int] = []
    for turn in range(ROUNDS):
        columns, wanted = _relative(paths, mu, signal[used])
        chosen, weights = _pursue(columns, wanted, AIM * tolerance, chosen)
        others = sample_paths(mu, signal[used], thickest_mm, CHECKED, turn + 1)
        columns, wanted = _relative(others, mu, signal[used])
        error = np.abs(columns[:, chosen] @ weights - wanted)
        worst = float(error.max())
        if worst <= tolerance:
            break
        paths = np.concatenate([paths, others[error > AIM * tolerance]])
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
    heavy[0] = OPEN_BEAM
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
    """Path lengths (j, m) [mm] that stand for all that occur: alone, together, thin and thick.

    Nothing is asked beyond the thickness at which a material alone lets nearly nothing through,
    and nothing but the open beam below `THIN`.

    Args:
        mu: (m, e) [1/mm].
        signal: (e,) weights of the energies.
        thickest_mm: longest path through each [mm].
        more: times as many of them.
        seed: other thicknesses for each.
    """
    m = len(mu)
    random = np.random.default_rng([m, seed])
    rows = [np.zeros((1, m))]
    opaque = np.log(1e6 * len(signal)) / np.maximum(mu.min(axis=1, initial=np.inf), 1e-12)
    most = np.minimum(np.maximum(np.asarray(thickest_mm, dtype=np.float64), 1e-6), opaque)
    least = np.minimum(THIN / np.maximum(mu.max(axis=1, initial=0.0), 1e-12), most / 2)
    for i in range(m):
        n = 60 * more
        even = (np.arange(n) + random.uniform(size=n)) / (n - 1)
        part = np.minimum(even, 1.0)
        alone = np.zeros((2 * n, m))
        alone[:n, i] = least[i] * (most[i] / least[i]) ** part
        alone[n:, i] = most[i] * part**2
        rows.append(alone)
    if m > 1:
        part = random.uniform(size=(200 * m * more, m))
        there = random.uniform(size=part.shape) < 0.7
        rows.append(least * (most / least) ** part * there)
        rows.append(most * random.uniform(size=part.shape) ** 2)
    return np.concatenate(rows)


def _relative(
    paths: FloatArray, mu: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """What each energy adds behind `paths`, (j, e), and their sum, (j,), over that sum."""
    columns = np.exp(-paths @ mu) * weights
    whole = columns.sum(axis=1)
    scale = 1.0 / np.maximum(whole, FAINTEST * weights.sum())
    return columns * scale[:, None], whole * scale


def _pursue(
    columns: FloatArray, wanted: FloatArray, tolerance: float, chosen: list[int]
) -> tuple[list[int], FloatArray]:
    """Few columns, `chosen` and more, with weights >= 0 that add up to `wanted`: within
    `tolerance`, or as near as `MOST` of them come.
    """
    norms = np.linalg.norm(columns, axis=0)
    heavy = np.ones(len(wanted))
    heavy[0] = OPEN_BEAM
    chosen, weights = list(chosen), np.zeros(len(chosen))
    rest = wanted
    while True:
        if chosen:
            weights = _non_negative(columns[:, chosen] * heavy[:, None], wanted * heavy)
            rest = wanted - columns[:, chosen] @ weights
            enough = len(chosen) >= min(MOST, columns.shape[1])
            if enough or float(np.abs(rest).max()) <= tolerance:
                return chosen, weights
        gain = (columns * heavy[:, None] ** 2).T @ rest / np.maximum(norms, 1e-300)
        gain[chosen] = -np.inf
        chosen = sorted([*chosen, int(np.argmax(gain))])


def _non_negative(columns: FloatArray, wanted: FloatArray) -> FloatArray:
    """Least squares with weights >= 0."""
    from scipy.optimize import lsq_linear, nnls

    try:
        weights, _ = nnls(columns, wanted, maxiter=30 * columns.shape[1])
    except RuntimeError:  # nearly equal columns can send it round in circles
        weights = lsq_linear(columns, wanted, (0.0, np.inf), method="bvls").x
    return np.asarray(weights)
