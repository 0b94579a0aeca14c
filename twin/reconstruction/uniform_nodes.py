"""Nodes of a coarse volume in the object's uniform regions."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray

SMOOTHING_NODES: Final = 1.5
"""Standard deviation of the smoothing of the coarse volume [nodes]: steps between its
voxels would show as flaws of their own."""
EDGE_CHANGE_SHARE: Final = 0.05
"""Change between nodes at an edge, relative to the object's attenuation; blur hides
flaws there."""
MIN_NEIGHBOURHOOD_SHARE: Final = 0.5
"""Least attenuation of a node of the object, relative to the smooth value there."""
MIN_BODY_SHARE: Final = 0.25
"""Least attenuation of a node of the object, relative to the body's: more than streaks
in the air."""
MIN_EVENNESS: Final = 0.5
"""Least weight of a node in a uniform region."""


@dataclass(frozen=True, eq=False)
class UniformNodes:
    """A coarse volume's smooth values, and where the object is uniform.

    Attributes:
        sharp: attenuation, 0 outside the views' circle, (nz, ny, nx) [1/mm].
        found: the same, smooth.
        even: weights of nodes, small where values change fast and where some views do
            not see them, (nz, ny, nx).
        inside: nodes of the object, (nz, ny, nx).
    """

    sharp: Float32Array
    found: Float32Array
    even: FloatArray
    inside: npt.NDArray[np.bool_]

    @classmethod
    def of(cls, values: Float32Array, rim: npt.NDArray[np.bool_]) -> UniformNodes:
        """Find the uniform nodes of a volume [1/mm], NaN unseen.

        Edges change by `EDGE_CHANGE_SHARE` of the body. Nodes of the object are seen by
        all views and have `MIN_NEIGHBOURHOOD_SHARE` of the smooth value, `MIN_BODY_SHARE`
        of the body's, at least. Others have a weight of 1e-3. `rim`: columns (ny, nx)
        outside some views; they count as 0.
        """
        unseen = np.isnan(values) | rim
        sharp = np.where(rim, np.float32(0.0), np.nan_to_num(values))
        found = smoothed(sharp)
        body = _typical(sharp)
        weights = _evenness(found, EDGE_CHANGE_SHARE * body)
        even = np.where(unseen, 0.0, weights) + 1e-3  # a mean needs weight
        inside = (sharp > MIN_NEIGHBOURHOOD_SHARE * found) & ~unseen
        inside &= np.minimum(sharp, found) > MIN_BODY_SHARE * body
        return cls(sharp, found, even, inside)

    @cached_property
    def uniform(self) -> npt.NDArray[np.bool_]:
        """Nodes of the object away from edges; all of its nodes if it has edges alone."""
        away = self.inside & (self.even > MIN_EVENNESS)
        return away if away.any() else self.inside

    def change(self, other: Float32Array) -> float:
        """Compute the largest relative change of nine of ten uniform nodes; 0 without
        any.
        """
        if not self.uniform.any():
            return 0.0
        ratios = other[self.uniform] / self.found[self.uniform]
        return float(np.percentile(np.abs(ratios - 1.0), 90.0))


def smoothed(values: Float32Array) -> Float32Array:
    """Smooth values of nodes by a Gaussian of `SMOOTHING_NODES`, along z at most a
    quarter of the layers less one; returns a new array (nz, ny, nx), not smoothed along z
    if there is one layer.
    """
    from scipy.ndimage import gaussian_filter

    layers = min(SMOOTHING_NODES, (len(values) - 1) / 4)
    sigma = (layers, SMOOTHING_NODES, SMOOTHING_NODES)
    return np.asarray(gaussian_filter(values, sigma, mode="nearest"))


def _typical(values: Float32Array) -> float:
    """Compute the attenuation below which half of the summed attenuation is: of a body, not of a
    pin in it.

    `values`: of any shape; only those above 0 count.
    Returns [1/mm]; 0 without any."""
    ordered = np.sort(values[values > 0.0], axis=None)
    if not ordered.size:
        return 0.0
    below = np.cumsum(ordered, dtype=np.float64)
    return float(ordered[np.searchsorted(below, 0.5 * below[-1])])


def _evenness(values: Float32Array, most: float) -> FloatArray:
    """Compute weights of nodes, exp(-(gradient / `most`)^2): 1 where values are uniform, near 0
    where they change by more than `most` a node.

    `values`: (nz, ny, nx); `most`: change between nodes [1/mm]. Returns (nz, ny, nx)."""
    from scipy.ndimage import gaussian_gradient_magnitude

    steep = gaussian_gradient_magnitude(values.astype(np.float64), 0.5, mode="nearest")
    least = float(np.finfo(np.float32).tiny)
    return np.asarray(np.exp(-np.square(steep / max(most, least))))
