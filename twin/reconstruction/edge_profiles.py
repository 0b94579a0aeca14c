"""Widths of the edges in a volume: a blurred step, fitted to voxels about places of steep change.

The surface about each place may lean and bend; what is fitted beside is the standard deviation
of the blur across it. Noise is the scatter about the fits, so that each width has a standard
error.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.volume import Width

REACH: Final = 5
"""Voxels on either side of a place that are fitted."""
SIDE_REACH: Final = 2.3
"""Voxels beside the normal that are fitted."""
LAYERS: Final = 24
"""Layers in which places are looked for."""
PLACES: Final = 200
"""Places that are fitted at most."""
MIN_STEEPNESS_SHARE: Final = 0.3
"""Least change of a place, relative to the steepest."""
STEPS: Final = 12
"""Steps of Gauss and Newton."""
WIDTHS: Final = (0.15, 3.0)
"""Fitted standard deviations that are believed [voxels]."""
MAX_FITTED: Final = 1.7
"""Median above which a volume of every second voxel is fitted instead [voxels]."""
MAX_COARSENING: Final = 8
MIN_EDGES: Final = 8
"""Least number of fitted edges of which a width is stated."""
LEVELS: Final = (0.1, 0.9)
"""Levels of a step between which it is measured."""
BINS: Final = np.linspace(-4.0, 4.0, 81)
"""Limits of the distances over which steps are averaged [sigmas of the fitted blur]."""
QUARTILE: Final = 0.6745
"""Distance of a normal distribution's quartile from its middle."""
CHUNK: Final = 48


@dataclass(frozen=True, eq=False)
class Edges:
    """Fitted edges.

    Attributes:
        sigma: of the blur, (n,) [voxels].
        error: of its logarithm, (n,).
        normal: unit vectors (x, y, z), (n, 3).
        sums, counts: of the steps' values, 0 to 1, in each of `BINS`, (n, k).
    """

    sigma: FloatArray
    error: FloatArray
    normal: FloatArray
    sums: FloatArray
    counts: FloatArray

    def width(self, which: npt.NDArray[np.bool_], voxel_mm: float) -> Width | None:
        """Compute the width of some edges; None of fewer than `MIN_EDGES`.

        Args:
            which: (n,).
            voxel_mm: edge of a voxel.
        """
        if which.sum() < MIN_EDGES:
            return None
        size = np.log(self.sigma[which])
        error = self.error[which]
        middle = float(np.median(size))
        spread = float(np.median(np.abs(size - middle))) / QUARTILE
        own = np.sqrt(max(spread**2 - float(np.median(error)) ** 2, 0.0))
        sigmas = self._levels_apart(which)
        sharp = sigmas * voxel_mm * float(np.exp(middle - QUARTILE * own))
        # A median's standard error is 1.25 times a mean's.
        share = 1.25 * max(spread, 1e-3) / np.sqrt(len(size))
        return Width(sharp, sharp * share, len(size))

    def _levels_apart(self, which: npt.NDArray[np.bool_]) -> float:
        """Compute the distance of the levels on the mean step of some edges, which need
        not be a Gaussian's: doubled edges have two steps [sigmas of the fitted blur].
        """
        counts = self.counts[which].sum(axis=0)
        known = counts > 0.0
        step = self.sums[which].sum(axis=0)[known] / counts[known]
        place = (0.5 * (BINS[1:] + BINS[:-1]))[known]
        middle = int(np.abs(place).argmin())
        ends = []
        for level, side in zip(LEVELS, (-1, 1), strict=True):
            # From the middle outwards: noise of the levels beside is not met.
            values, at = step[middle::side], place[middle::side]
            past = np.flatnonzero((values - level) * side > 0.0)
            k = max(int(past[0]), 1) if len(past) else len(values) - 1
            share = (level - values[k - 1]) / (values[k] - values[k - 1] or 1.0)
            ends.append(float(at[k - 1] + share * (at[k] - at[k - 1])))
        return ends[1] - ends[0]


def edges_of(data: Float32Array) -> tuple[Edges, int] | None:
    """Fit the steep edges of a volume.

    Args:
        data: (nz, ny, nx); NaN where there is no value.

    Returns:
        The edges, and every how many-th voxel was fitted; None without edges.
    """
    every = 1
    while True:
        some = data[::every, ::every, ::every]
        if min(some.shape[1:]) < 2 * REACH + 3:
            return None
        places, normals = _places(some)
        if not len(places):
            return None
        edges = _fitted(some, places, normals)
        if edges is None:
            return None
        wide = float(np.median(edges.sigma)) > MAX_FITTED
        if not wide or every >= MAX_COARSENING:
            return edges, every
        every *= 2


def _places(data: Float32Array) -> tuple[npt.NDArray[np.intp], FloatArray]:
    """Find places of steep change, evenly among layers.

    Args:
        data: (nz, ny, nx).

    Returns:
        (n, 3) indices (z, y, x), and unit normals (x, y, z) towards larger values.
    """
    from scipy.ndimage import gaussian_filter1d, maximum_filter

    nz = len(data)
    deep = min(REACH, (nz - 1) // 2)
    layers = np.unique(np.linspace(deep, nz - 1 - deep, LAYERS).round().astype(int))
    found, change, steep = [], [], []
    for layer in layers.tolist():
        low, high = max(layer - 1, 0), min(layer + 1, nz - 1)
        part = np.nan_to_num(data[[low, layer, high]])
        part = gaussian_filter1d(gaussian_filter1d(part, 0.8, axis=1), 0.8, axis=2)
        gy, gx = np.gradient(part[1])
        gz = (part[2] - part[0]) / max(high - low, 1)
        size = np.sqrt(gx**2 + gy**2 + gz**2)
        size[:REACH] = size[-REACH:] = 0.0
        size[:, :REACH] = size[:, -REACH:] = 0.0
        ridge = np.argwhere((size == maximum_filter(size, 3)) & (size > 0.0))
        y, x = ridge.T
        found.append(np.column_stack([np.full(len(ridge), layer), ridge]))
        change.append(np.column_stack([gx[y, x], gy[y, x], gz[y, x]]))
        steep.append(size[y, x])
    at, slope, size = (np.concatenate(one) for one in (found, change, steep))
    if not len(at):
        return at, slope
    enough = size >= MIN_STEEPNESS_SHARE * np.percentile(size, 99.0)
    at, slope, size = at[enough], slope[enough], size[enough]
    # Both kinds of edges, across the layers and along the axis, whichever is rarer.
    flat = np.abs(slope[:, 2]) > 0.8 * size
    rng = np.random.default_rng(0)
    chosen = np.concatenate(
        [rng.permutation(np.flatnonzero(kind))[: PLACES // 2] for kind in (flat, ~flat)]
    )
    return at[chosen], slope[chosen] / size[chosen, None]


def _fitted(
    data: Float32Array, places: npt.NDArray[np.intp], normals: FloatArray
) -> Edges | None:
    """Fit a blurred step about each place; None without one that is believed.

    Args:
        data: (nz, ny, nx).
        places: (n, 3) indices (z, y, x).
        normals: (n, 3) unit vectors (x, y, z).
    """
    parts = [
        _fitted_some(data, places[k : k + CHUNK], normals[k : k + CHUNK])
        for k in range(0, len(places), CHUNK)
    ]
    found, rest, error, step, sums, counts = (
        np.concatenate(one) for one in zip(*parts, strict=True)
    )
    sigma = np.exp(found[:, 8])
    good = (sigma > WIDTHS[0]) & (sigma < WIDTHS[1]) & (np.abs(found[:, 2]) < 2.0)
    good &= np.isfinite(error) & (error < 0.5) & (step > 0.0)
    if not good.any():
        return None
    share = rest / step
    good &= share <= 2.0 * np.median(share[good])
    return Edges(sigma[good], error[good], normals[good], sums[good], counts[good])


def _mean_where(values: FloatArray, chosen: npt.NDArray[np.bool_]) -> FloatArray:
    """Return the mean of the chosen values of each row, (n,); 0 without one."""
    return np.asarray((values * chosen).sum(axis=1) / np.maximum(chosen.sum(axis=1), 1))


def _fitted_some(
    data: Float32Array, places: npt.NDArray[np.intp], normals: FloatArray
) -> tuple[FloatArray, ...]:
    """Fit values a + b F((n r - d) / s) by least squares, F the normal distribution, of
    surfaces that lean (2) and bend (3).

    Returns:
        Parameters (n, 9): a, b, d, lean (2), bend (3), ln s; root mean square of the rest
        (n,); standard error of ln s (n,); the size of the step b (n,); sums and counts of
        `Edges`, (n, k) each.
    """
    from scipy.special import erf

    deep = min(REACH, (len(data) - 1) // 2)
    span = np.arange(-REACH, REACH + 1)
    z, y, x = (
        one.ravel()
        for one in np.meshgrid(np.arange(-deep, deep + 1), span, span, indexing="ij")
    )
    at = np.column_stack([x, y, z]).astype(np.float64)
    values = data[
        np.clip(places[:, :1] + z, 0, len(data) - 1),
        places[:, 1:2] + y,
        places[:, 2:] + x,
    ].astype(np.float64)
    helper = np.eye(3)[np.abs(normals).argmin(axis=1)]
    first = np.cross(normals, helper)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(normals, first)
    across = normals @ at.T
    u, v = first @ at.T, second @ at.T
    weight = (np.abs(across) <= REACH - 0.5) & (u**2 + v**2 <= SIDE_REACH**2)
    weight &= np.isfinite(values)
    values = np.where(weight, values, 0.0)
    shape = np.stack([u, v, 0.5 * u**2, 0.5 * v**2, u * v])
    p = np.zeros((len(places), 9))
    p[:, 0] = _mean_where(values, weight & (across < -2.0))
    p[:, 1] = _mean_where(values, weight & (across > 2.0)) - p[:, 0]
    count = np.maximum(weight.sum(axis=1), 10)
    damp = np.full(len(places), 1e-2)
    best = np.full(len(places), np.inf)
    kept = p.copy()

    def model(p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the weighted residuals (n, k), and the model's derivatives (9, n, k)."""
        d = across - p[:, 2:3] - np.einsum("ni,ink->nk", p[:, 3:8], shape)
        s = np.exp(np.clip(p[:, 8:9], -3.0, 2.0))
        q = d / s
        step = 0.5 * (1.0 + erf(q / np.sqrt(2.0)))
        bell = p[:, 1:2] * np.exp(-0.5 * q**2) / np.sqrt(2.0 * np.pi)
        slopes = np.concatenate(
            [
                np.stack([np.ones_like(q), step, -bell / s]),
                -bell / s * shape,
                (-bell * q)[None],
            ]
        )
        return weight * (values - p[:, :1] - p[:, 1:2] * step), weight * slopes

    normal = np.zeros((len(places), 9, 9))
    for _ in range(STEPS):
        rest, slopes = model(p)
        squares = (rest**2).sum(axis=1)
        better = squares < best
        kept[better], best[better] = p[better], squares[better]
        damp = np.where(better, 0.3 * damp, 5.0 * damp)
        if not better.all():
            rest, slopes = model(kept)
        normal = np.einsum("ink,jnk->nij", slopes, slopes)
        pull = np.einsum("ink,nk->ni", slopes, rest)
        held = normal + damp[:, None, None] * np.einsum("nii,ij->nij", normal, np.eye(9))
        held += (
            1e-12 * (1.0 + np.trace(normal, axis1=1, axis2=2))[:, None, None] * np.eye(9)
        )
        p = kept + np.clip(np.linalg.solve(held, pull[..., None])[..., 0], -1.0, 1.0)
    size = np.sqrt(best / count)
    inverse = np.linalg.pinv(normal)
    error = size * np.sqrt(np.maximum(inverse[:, 8, 8], 0.0) * count / (count - 9.0))
    away = across - kept[:, 2:3] - np.einsum("ni,ink->nk", kept[:, 3:8], shape)
    which = np.digitize(away / np.exp(kept[:, 8:9]), BINS) - 1
    inside = weight & (which >= 0) & (which < len(BINS) - 1)
    share = (values - kept[:, :1]) / np.where(kept[:, 1:2] == 0.0, 1.0, kept[:, 1:2])
    flat = np.arange(len(places))[:, None] * (len(BINS) - 1) + which
    length = len(places) * (len(BINS) - 1)
    sums = np.bincount(flat[inside], share[inside], length).reshape(len(places), -1)
    counts = np.bincount(flat[inside], minlength=length).reshape(len(places), -1)
    results = kept, size, error, np.abs(kept[:, 1]), sums, counts
    return tuple(np.asarray(one, np.float64) for one in results)
