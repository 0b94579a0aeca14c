"""A spectrum in a few effective energies, chosen so that they transmit what the spectrum does.

The transmission of a spectrum through any mixture of the sample's materials is a weighted sum of
exponentials, one an energy. Far fewer exponentials give the same sum over the thicknesses that
occur: energies are taken one by one where they help most, with non-negative weights, until the
largest relative error on a set of thicknesses is a quarter of the tolerance (the rest is for
thicknesses between). It refuses to return a beam that does not hold it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexdt.twin.conventions import Float32Array, FloatArray
from flexdt.twin.errors import TwinError
from flexdt.twin.physics.attenuation import Substance

TOLERANCE = 1e-3
FAINTEST = 1e-4
"""Below this transmission the error is measured against it instead (about a count of 14 bit)."""
MOST = 24
"""Effective energies at most."""
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
        worst: largest relative error met while choosing.
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
        shape = paths_mm.shape[1:]
        flat = paths_mm.reshape(len(paths_mm), int(np.prod(shape)))
        mean = np.empty(flat.shape[1], np.float32)
        variance = np.empty_like(mean)
        mu = -self.mu.astype(np.float32)
        signal, noise = self.signal.astype(np.float32), self.noise.astype(np.float32)
        for start in range(0, len(mean), BLOCK):
            part = flat[:, start : start + BLOCK]
            s, v = mean[start : start + BLOCK], variance[start : start + BLOCK]
            s[:], v[:] = 0.0, 0.0
            t = np.empty_like(s)
            more = np.empty_like(s)
            for k in range(len(signal)):
                t[:] = 0.0
                for m in range(len(part)):
                    t += np.multiply(part[m], mu[m, k], out=more)
                np.exp(t, out=t)
                s += np.multiply(t, signal[k], out=more)
                v += np.multiply(t, noise[k], out=more)
        return mean.reshape(shape), variance.reshape(shape)


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
        TwinError: not reached with `MOST` energies.
    """
    used = np.flatnonzero(signal > signal.max() * 1e-9)
    mu = np.array([s.attenuation()[used] for s in substances]).reshape(len(substances), len(used))
    paths = sample_paths(mu, signal[used], thickest_mm)
    each = np.exp(-paths @ mu)
    wanted = each @ signal[used]
    scale = 1.0 / np.maximum(wanted, FAINTEST * signal[used].sum())
    columns = each * signal[used] * scale[:, None]
    chosen, weights, worst = _pursue(columns, wanted * scale, tolerance / 4)
    if worst > tolerance:
        raise TwinError(
            f"{MOST} effective energies reach {worst:.2g}, not {tolerance:.2g}, for "
            f"{', '.join(s.name for s in substances)}",
            {"asked": tolerance, "reached": worst},
        )
    # The variance on the same energies; its own error matters less (noise, not signal).
    spread = each[:, chosen]
    truth = each @ noise[used]
    # Exact in the open beam, close elsewhere: one heavy row more.
    rows = spread / np.maximum(truth, FAINTEST * noise[used].sum())[:, None]
    from scipy.optimize import nnls

    aim = truth / np.maximum(truth, FAINTEST * noise[used].sum())
    variance, _ = nnls(np.vstack([rows, 1e3 * rows[:1]]), np.append(aim, 1e3 * aim[0]))
    return EffectiveBeam(
        tuple(s.name for s in substances),
        mu[:, chosen],
        weights * signal[used][chosen],
        variance,
        tuple(int(b) for b in used[chosen]),
        worst,
    )


def sample_paths(mu: FloatArray, signal: FloatArray, thickest_mm: Sequence[float]) -> FloatArray:
    """Path lengths (j, m) [mm] that stand for all that occur: alone, together, thin and thick.

    Nothing is asked beyond the thickness at which a material alone lets nearly nothing through.
    """
    m = len(mu)
    axes = []
    for one, most in zip(mu, thickest_mm, strict=True):
        opaque = float(np.log(1e6 * len(signal)) / max(one[signal > 0].min(), 1e-12))
        axes.append(min(most, opaque) * np.linspace(0.0, 1.0, 25) ** 2)
    rows = [np.zeros((1, m))]
    for i, lengths in enumerate(axes):
        alone = np.zeros((len(lengths), m))
        alone[:, i] = lengths
        rows.append(alone)
    if m > 1:
        random = np.random.default_rng(m)
        mixed = random.uniform(size=(160 * m, m)) ** 2
        rows.append(mixed * np.array([lengths[-1] for lengths in axes]))
    return np.concatenate(rows)


def _pursue(
    columns: FloatArray, wanted: FloatArray, tolerance: float
) -> tuple[list[int], FloatArray, float]:
    """Few columns with non-negative weights that add up to `wanted` within `tolerance`."""
    from scipy.optimize import nnls

    chosen: list[int] = []
    weights = np.zeros(0)
    rest = wanted.copy()
    norms = np.linalg.norm(columns, axis=0)
    heavy = np.ones(len(wanted))
    heavy[0] = 10.0  # the open beam, which all flats and all calibrations hang on
    while True:
        gain = (columns * heavy[:, None] ** 2).T @ rest / np.maximum(norms, 1e-300)
        gain[chosen] = -np.inf
        chosen = sorted([*chosen, int(np.argmax(gain))])
        weights, _ = nnls(columns[:, chosen] * heavy[:, None], wanted * heavy)
        rest = wanted - columns[:, chosen] @ weights
        worst = float(np.abs(rest).max())
        if worst <= tolerance or len(chosen) >= min(MOST, columns.shape[1]):
            keep = weights > 0
            return [c for c, k in zip(chosen, keep, strict=True) if k], weights[keep], worst
