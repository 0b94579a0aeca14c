"""Measures of image quality: signal, noise, sharpness, photon transfer.

All work on plain arrays, of this twin or of the scanner; the caller chooses the regions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import FloatArray

FINE = 4
"""Bins a pixel of an edge profile."""


@dataclass(frozen=True)
class Region:
    """Statistics of a region: mean, standard deviation, and their ratio."""

    signal: float
    noise: float

    @property
    def snr(self) -> float:
        """Signal to noise ratio; infinite without noise."""
        return self.signal / self.noise if self.noise > 0 else float("inf")


@dataclass(frozen=True)
class PhotonTransfer:
    """Result of `photon_transfer`.

    Attributes:
        counts_per_quantum: slope of variance over signal; its inverse is the number of
            effective quanta a count stands for.
        read_noise_counts: noise without signal, quantisation taken off.
        signal, variance: the curve, (k,) both [counts, counts^2].
    """

    counts_per_quantum: float
    read_noise_counts: float
    signal: FloatArray
    variance: FloatArray


@dataclass(frozen=True)
class EdgeResponse:
    """Result of `edge_mtf`: modulation by frequency [cycles a pixel], both (k,)."""

    frequency: FloatArray
    modulation: FloatArray

    def at(self, modulation: float) -> float:
        """Find the lowest frequency at which the modulation falls to `modulation`,
        linearly between samples [cycles a pixel].

        Raises:
            LimitError: it does not fall so far, or begins below.
        """
        below = np.flatnonzero(self.modulation < modulation)
        if len(below) == 0 or below[0] == 0:
            raise LimitError(
                f"the modulation does not fall to {modulation:g}",
                {"asked": modulation, "lowest": float(self.modulation.min())},
            )
        i = int(below[0])
        m0, m1 = self.modulation[i - 1], self.modulation[i]
        part = (m0 - modulation) / (m0 - m1)
        return float(
            self.frequency[i - 1] + part * (self.frequency[i] - self.frequency[i - 1])
        )


def region(values: npt.ArrayLike) -> Region:
    """Mean and standard deviation of a region's values."""
    data = np.asarray(values, dtype=np.float64)
    return Region(float(data.mean()), float(data.std(ddof=1)))


def photon_transfer(
    pairs: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    darks: Sequence[tuple[npt.ArrayLike, npt.ArrayLike]],
    *,
    reach: int = 3,
) -> PhotonTransfer:
    """Estimate conversion gain and read noise from pairs of equal exposures.

    The difference of two equal images has no fixed pattern. Blur spreads the noise of a
    quantum over neighbours without changing its sum, so the covariance with neighbours up
    to `reach` pixels counts as variance.

    Args:
        pairs: flats of growing exposure, none saturated, (rows, cols) each.
        darks: at least one pair without X-rays.
        reach: neighbours whose covariance is added [pixels].
    """
    level = float(np.mean([_mean(a, b) for a, b in darks]))
    floor = float(np.mean([_difference_variance(a, b, 0) for a, b in darks]))
    signal = np.array([_mean(a, b) - level for a, b in pairs])
    variance = np.array([_difference_variance(a, b, reach) for a, b in pairs]) - floor
    # Relative errors of all variances are alike, so each point weighs with its inverse.
    slope = float(np.mean(variance / signal))
    return PhotonTransfer(
        slope, float(np.sqrt(max(floor - 1.0 / 12.0, 0.0))), signal, variance
    )


def _mean(a: npt.ArrayLike, b: npt.ArrayLike) -> float:
    both = np.asarray([a, b], dtype=np.float64)
    return float(both.mean())


def _difference_variance(a: npt.ArrayLike, b: npt.ArrayLike, reach: int) -> float:
    """Compute half the variance of a - b, with the covariances of pixels up to `reach`
    apart added.
    """
    d = np.asarray(a, dtype=np.float64) - np.asarray(b, dtype=np.float64)
    d -= d.mean()
    rows, cols = d.shape
    total = 0.0
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            one = d[max(dy, 0) : rows + min(dy, 0), max(dx, 0) : cols + min(dx, 0)]
            two = d[max(-dy, 0) : rows + min(-dy, 0), max(-dx, 0) : cols + min(-dx, 0)]
            total += float((one * two).mean())
    return total / 2.0


def edge_mtf(image: npt.ArrayLike) -> EdgeResponse:
    """Measure the modulation transfer from a straight, slightly slanted, nearly vertical
    edge.

    The profile across the edge is sampled in FINE bins a pixel; frequencies end at 1
    cycle a pixel.

    Args:
        image: (rows, cols) of a linear signal, the edge crossing all rows, flat on both
            sides.

    Raises:
        LimitError: no edge crosses all rows, it is too close to the border, or not
            slanted enough.
    """
    data = np.asarray(image, dtype=np.float64)
    rows, cols = data.shape
    steep = np.abs(np.diff(data, axis=1))
    strength = steep.sum(axis=1)
    if strength.min() <= 0:
        raise LimitError("no edge crosses all rows of this region", {"rows": rows})
    # First moments of the derivative, twice: the second time only near the line, against noise.
    x = np.arange(cols - 1) + 0.5
    at = (steep * x).sum(axis=1) / strength
    line = np.polyfit(np.arange(rows), at, 1)
    for _ in range(3):
        near = np.abs(x[None, :] - np.polyval(line, np.arange(rows))[:, None]) < max(
            4, cols / 8
        )
        weight = steep * near
        line = np.polyfit(
            np.arange(rows), (weight * x).sum(axis=1) / weight.sum(axis=1), 1
        )
    tilt = float(np.cos(np.arctan(line[0])))
    distance = (
        np.arange(cols)[None, :] - np.polyval(line, np.arange(rows))[:, None]
    ) * tilt
    half = int(np.floor(np.abs(distance).min(axis=0)[[0, -1]].min()))
    if half < 4:
        raise LimitError(
            "the edge lies too close to the border", {"pixels": half, "allowed": 4}
        )
    edges = np.arange(-half * FINE, half * FINE + 1) / FINE
    which = np.digitize(distance.ravel(), edges) - 1
    inside = (which >= 0) & (which < len(edges) - 1)
    count = np.bincount(which[inside], minlength=len(edges) - 1)
    if count.min() == 0:
        raise LimitError(
            "the edge is not slanted enough for this region", {"slope": line[0]}
        )
    profile = np.bincount(which[inside], data.ravel()[inside], len(edges) - 1) / count
    spread = np.diff(profile)
    spectrum = np.abs(np.fft.rfft(spread * np.hanning(len(spread) + 2)[1:-1]))
    frequency = np.fft.rfftfreq(len(spread), 1.0 / FINE)
    # Binning and the finite difference each average over a fine bin: taken off.
    average = np.sinc(frequency / FINE) ** 2
    keep = frequency <= 1.0
    modulation: FloatArray = (spectrum / spectrum[0] / average)[keep].astype(np.float64)
    return EdgeResponse(frequency[keep].astype(np.float64), modulation)
