"""Comparison of a coarse volume's projections with the images it was reconstructed from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.reconstruction.acquisition.truncation import Truncation
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.white_noise import noise_of

ARCS = 12
"""Arcs of a scan's views in which residuals are compared: at least one view each."""
NOISE_VARIANCE_RATIO = 1.5
"""Variance of noise relative to the estimate by its median: few photons deviate more."""
NOISE_OF_CHANGES = np.array([1.0, 0.25])
"""Variance of white noise in the values, and in their changes, over that in the values."""
MIN_SIGNAL_SHARE = 0.3
"""Share of a residual that is kept whatever the noise, so that of two in much noise
none is far better than the other."""


@dataclass(frozen=True, eq=False)
class Reprojection:
    """Images, and the projections of a volume reconstructed from them.

    Attributes:
        images: (n, rows, cols) line integrals.
        values: of the volume, (nz, ny, nx), NaN where no data cover it [1/mm].
        again: line integrals through the volume, (n, rows, cols).
        image_noise: variance of white noise in the images.
        seen: share of the pixels that are compared; in others (`CoarseScan.seen_rows`)
            `again` is as the images.
        own_noise: variance of white noise in the projections, None to measure it in
            `again`.
    """

    images: Float32Array
    values: Float32Array
    again: Float32Array
    image_noise: float
    seen: float = 1.0
    own_noise: float | None = None

    @classmethod
    def of(
        cls,
        scan: CoarseScan,
        images: Float32Array,
        cone_vec: ConeVec,
        truncation: Truncation | None,
        noise: float | None = None,
    ) -> Reprojection | None:
        """Reconstruct images as of a geometry, and project the volume again coarsely; NaN
        voxels count as 0.

        The object is raised meanwhile by at most half a layer of the grid (`layers_off`).

        Args:
            scan: gives the grid.
            images: (n, rows, cols).
            cone_vec: n views.
            truncation: object beyond their edges, or None.
            noise: variance of white noise in the images; None: estimated.

        Returns:
            None where FDK cannot use the geometry.
        """
        layers = layers_off(scan, cone_vec)
        if layers:
            up_mm = [0.0, 0.0, layers * scan.grid.voxel_xyz[2]]
            cone_vec = cone_vec.moved(np.eye(3), up_mm)
        try:
            values = scan.fdk(images, cone_vec, truncation)
        except GeometryError:
            return None
        shape = (images.shape[1], images.shape[2])
        again = scan.projected(np.nan_to_num(values), cone_vec, shape, fine=False)
        if layers:
            values = lowered(values, layers)
        if noise is None:
            noise = scan.noise if images is scan.images else noise_of(images)
        rows = scan.seen_rows
        if rows is None:
            return cls(images, values, again, noise)
        own_noise = noise_of(again)
        again = np.where(rows[:, :, None], again, images)
        return cls(images, values, again, noise, float(rows.mean()), own_noise)

    def misfit(self, least: float = MIN_SIGNAL_SHARE) -> FloatArray:
        """Compute the rms residual, less noise, over the images', (2,).

        Of values, and of changes along rows. `least` of its square always stays.
        """
        residual, signal, noise = self._powers
        beside = np.maximum(residual - noise, least * residual)
        return np.asarray(np.sqrt(beside / np.maximum(signal, np.finfo(np.float32).tiny)))

    @cached_property
    def arcs(self) -> FloatArray:
        """Mean squares of the residual in `ARCS` arcs of neighboring views: of its
        values, and of their changes along rows, (2, ARCS); above 0. Views of which no row
        is compared are left out.
        """
        rest, changes = self._rest
        some = rest.any(axis=(1, 2))
        if self.seen < 1.0 and some.any():
            rest = rest[some]
            changes = changes[some]
        count = len(rest)
        arcs = np.arange(min(ARCS, count))
        # The first arcs have a view more where they cannot all have as many.
        starts = count // ARCS * arcs + np.minimum(arcs, count % ARCS)
        parts = [
            np.add.reduceat(_sums_of_squares(values), starts)
            / np.add.reduceat(np.full(len(values), values[0].size), starts)
            for values in (rest, changes)
        ]
        return np.maximum(parts, np.finfo(np.float32).tiny)

    @cached_property
    def _rest(self) -> tuple[Float32Array, Float32Array]:
        """Residual in the values, and in their changes along rows."""
        rest = self.again - self.images
        return rest, _changes(rest)

    @cached_property
    def _powers(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean squares (2,) of residual, images and noise: first of the values, then of
        their changes along rows. Noise is the images' less the reprojection's, at least
        0, times `NOISE_VARIANCE_RATIO`.
        """
        signals = self.images, _changes(self.images)
        residual, signal = (
            np.array([_mean_square(values), _mean_square(changes)])
            for values, changes in (self._rest, signals)
        )
        noise = self.seen * NOISE_VARIANCE_RATIO * self._noise * NOISE_OF_CHANGES
        return residual, signal, noise

    @cached_property
    def _noise(self) -> float:
        """Variance of white noise: differences of neighbors that the reprojection lacks."""
        return max(self.image_noise - self.noise_again, 0.0)

    @cached_property
    def noise_again(self) -> float:
        """Variance that neighbors in the projections show as noise."""
        return noise_of(self.again) if self.own_noise is None else self.own_noise


def layers_off(scan: CoarseScan, cone_vec: ConeVec) -> float:
    """Compute how far to raise the object so that rows fall on layers, as the scan's.

    Else a panel half a row off leaves less residual. [layers, to 0.5]
    """
    fall = scan.cone_vec.v[:, 2]
    rows = float(((cone_vec.detector - scan.cone_vec.detector)[:, 2] / fall).mean())
    return float(np.sign(fall.mean())) * (round(rows) - rows)


def lowered(values: Float32Array, layers: float) -> Float32Array:
    """Lower a volume (nz, ny, nx) by at most a layer, or raise it (negative), linearly;
    the outermost layer is repeated.
    """
    if layers > 0.0:
        beside = np.concatenate([values[1:], values[-1:]])
    else:
        beside = np.concatenate([values[:1], values[:-1]])
    share = np.float32(abs(layers))
    return np.asarray((1.0 - share) * values + share * beside, np.float32)


def _sums_of_squares(images: Float32Array) -> FloatArray:
    """Compute the sum of squares of each image, (n,)."""
    lines = images.reshape(len(images), -1)
    return np.asarray(np.einsum("ij,ij->i", lines, lines, dtype=np.float64))


def _mean_square(values: Float32Array) -> float:
    return float(np.square(values).mean())


def _changes(images: Float32Array) -> Float32Array:
    """Return the changes between neighboring columns of smoothed rows."""
    smooth = 0.25 * images[..., :-2] + 0.5 * images[..., 1:-1] + 0.25 * images[..., 2:]
    return np.diff(smooth, axis=-1)
