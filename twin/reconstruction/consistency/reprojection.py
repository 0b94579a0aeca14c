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
from flexdt.twin.reconstruction.consistency.suspects import moved
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
    """

    images: Float32Array
    values: Float32Array
    again: Float32Array
    image_noise: float

    @classmethod
    def of(
        cls,
        scan: CoarseScan,
        images: Float32Array,
        cone_vec: ConeVec,
        truncation: Truncation | None,
        shifts: FloatArray | None = None,
    ) -> Reprojection | None:
        """Reconstruct images as of a geometry, and project the volume again coarsely; NaN
        voxels count as 0.

        The object is raised meanwhile by at most half a layer of the grid (`_layers_off`).

        Args:
            scan: gives the grid.
            images: (n, rows, cols).
            cone_vec: n views.
            truncation: object beyond their edges, or None.
            shifts: (n, 2) by which each image is to the right and below [pixels]: images
                are shifted back before the reconstruction, and its projections shifted as
                the images; None for none.

        Returns:
            None where FDK cannot use the geometry.
        """
        straight = images if shifts is None else shifted_back(images, shifts)
        layers = _layers_off(scan, cone_vec)
        if layers:
            up_mm = [0.0, 0.0, layers * scan.grid.voxel_xyz[2]]
            cone_vec = cone_vec.moved(np.eye(3), up_mm)
        try:
            values = scan.fdk(straight, cone_vec, truncation)
        except GeometryError:
            return None
        shape = (images.shape[1], images.shape[2])
        seen_from = cone_vec if shifts is None else moved(cone_vec, *-shifts.T)
        again = scan.projected(np.nan_to_num(values), seen_from, shape, fine=False)
        if layers:
            values = lowered(values, layers)
        known = images is scan.images
        return cls(images, values, again, scan.noise if known else noise_of(images))

    def misfit(self, least: float = MIN_SIGNAL_SHARE) -> FloatArray:
        """Compute the root mean square of the residual, less noise, over that of the
        images.

        Args:
            least: share of the residual's mean square that is kept whatever the noise.

        Returns:
            (2,): of the values, and of their changes along rows, which scatter and beam
            hardening hardly alter.
        """
        residual, signal, noise = self._powers
        beside = np.maximum(residual - noise, least * residual)
        return np.asarray(np.sqrt(beside / np.maximum(signal, np.finfo(np.float32).tiny)))

    @cached_property
    def arcs(self) -> FloatArray:
        """Mean squares of the residual in `ARCS` arcs of neighbouring views: of its
        values, and of their changes along rows, (2, ARCS); above 0.
        """
        rest = self.again - self.images
        least = np.finfo(np.float32).tiny
        parts = [
            [max(_mean_square(arc), least) for arc in np.array_split(values, ARCS)]
            for values in (rest, _changes(rest))
        ]
        return np.array(parts)

    @cached_property
    def centroid_variance(self) -> float:
        """Variance of the centroids of images along rows by their noise [pixels^2]."""
        count, rows, cols = self.images.shape
        along = np.arange(cols) - 0.5 * (cols - 1)
        mass = float(np.maximum(self.images, 0.0).sum(dtype=np.float64)) / count
        spread = rows * float(np.square(along).sum())
        return float(self._noise * spread / max(mass**2, np.finfo(np.float64).tiny))

    @cached_property
    def _powers(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Mean squares (2,) of residual, images and noise: first of the values, then of
        their changes along rows. Noise is the images' less the reprojection's, at least
        0, times `NOISE_VARIANCE_RATIO`.
        """
        rest = self.again - self.images
        residual, signal = (
            np.array([_mean_square(values), _mean_square(_changes(values))])
            for values in (rest, self.images)
        )
        noise = NOISE_VARIANCE_RATIO * self._noise * NOISE_OF_CHANGES
        return residual, signal, noise

    @cached_property
    def _noise(self) -> float:
        """Variance of white noise in the images, at least 0: differences between
        neighbours that the reprojection has as well are the object's.
        """
        return max(self.image_noise - noise_of(self.again), 0.0)


def _layers_off(scan: CoarseScan, cone_vec: ConeVec) -> float:
    """Compute by how much the object has to be raised so that a geometry's rows fall on the
    grid's layers as those of the scan do [layers, at most 0.5 up or down].

    Else a panel that is moved along columns by half a row leaves up to two fifths less of
    fine parts' residual, whatever the object.

    Args:
        scan: gives the grid and the stated geometry.
        cone_vec: n views.
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


def shifted_back(images: Float32Array, shifts: FloatArray) -> Float32Array:
    """Shift images to the left and up, by cubic splines; pixels beyond an edge repeat the
    edge's.

    Args:
        images: (n, rows, cols).
        shifts: (n, 2) to the left and up [pixels].
    """
    from scipy.ndimage import shift

    back = [
        shift(image, (-up, -left), order=3, mode="nearest")
        for image, (left, up) in zip(images, shifts.tolist(), strict=True)
    ]
    return np.array(back, np.float32)


def _mean_square(values: Float32Array) -> float:
    return float(np.square(values).mean())


def _changes(images: Float32Array) -> Float32Array:
    """Return the changes between neighbouring columns of smoothed rows."""
    smooth = 0.25 * images[..., :-2] + 0.5 * images[..., 1:-1] + 0.25 * images[..., 2:]
    return np.diff(smooth, axis=-1)
