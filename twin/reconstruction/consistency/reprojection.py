"""Comparison of a coarse volume's projections with the images it was reconstructed from."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

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
SPLINE_MARGIN = 12
"""Values that repeat the end of a line before it is interpolated by splines."""
MAX_KEPT_SIZES = 8
"""Lengths of lines whose spline coefficients are remembered."""
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
        shifts: FloatArray | None = None,
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
            shifts: (n, 2) by which each image is to the right and below [pixels]: images
                are shifted back before the reconstruction, and its projections shifted as
                the images; None for none.
            noise: variance of white noise in the images; None: estimated.

        Returns:
            None where FDK cannot use the geometry.
        """
        straight = images if shifts is None else shifted_back(images, shifts)
        layers = layers_off(scan, cone_vec)
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
        if noise is None:
            noise = scan.noise if images is scan.images else noise_of(images)
        rows = scan.seen_rows
        if rows is None:
            return cls(images, values, again, noise)
        own_noise = noise_of(again)
        again = np.where(rows[:, :, None], again, images)
        return cls(images, values, again, noise, float(rows.mean()), own_noise)

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
        signals = self.images, _changes(self.images)
        residual, signal = (
            np.array([_mean_square(values), _mean_square(changes)])
            for values, changes in (self._rest, signals)
        )
        noise = self.seen * NOISE_VARIANCE_RATIO * self._noise * NOISE_OF_CHANGES
        return residual, signal, noise

    @cached_property
    def _noise(self) -> float:
        """Variance of white noise in the images, at least 0: differences between
        neighbours that the reprojection has as well are the object's.
        """
        return max(self.image_noise - self.noise_again, 0.0)

    @cached_property
    def noise_again(self) -> float:
        """Variance that differences between neighbours in the projections show as noise."""
        return noise_of(self.again) if self.own_noise is None else self.own_noise


def layers_off(scan: CoarseScan, cone_vec: ConeVec) -> float:
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
    rows, cols = images.shape[1:]
    down = _interpolation(shifts[:, 1], rows)
    across = _interpolation(shifts[:, 0], cols)
    back = down @ images.astype(np.float64) @ across.transpose(0, 2, 1)
    return np.asarray(back, np.float32)


def _interpolation(shifts: FloatArray, size: int) -> FloatArray:
    """Compute the matrices that shift lines of `size` values towards their first, as
    `scipy.ndimage.shift` does by cubic splines and repeated ends, image by image.

    Args:
        shifts: (n,) [values].
        size: of a line.

    Returns:
        (n, size, size): each new value's shares of the line's.
    """
    coefficients = _spline_coefficients(size)
    last = len(coefficients) - 1
    at = SPLINE_MARGIN + np.arange(size) + shifts[:, None]
    at = np.clip(at, 0.0, last)
    first = np.floor(at)
    t = at - first
    s = 1.0 - t
    shares = s**3, 4.0 - 6.0 * t**2 + 3.0 * t**3, 4.0 - 6.0 * s**2 + 3.0 * s**3, t**3
    line, place = np.indices(at.shape)
    weights = np.zeros((*at.shape, last + 1))
    for step, share in enumerate(shares, -1):
        index = np.abs(first.astype(np.intp) + step)
        weights[line, place, last - np.abs(last - index)] += share / 6.0
    return np.asarray(weights @ coefficients)


@lru_cache(MAX_KEPT_SIZES)
def _spline_coefficients(size: int) -> FloatArray:
    """Compute the coefficients of cubic splines through lines whose values are 0 but for one, and
    whose ends are repeated `SPLINE_MARGIN` times, (size + 2 `SPLINE_MARGIN`, size).
    """
    from scipy.ndimage import spline_filter1d

    lines = np.pad(np.eye(size), ((SPLINE_MARGIN, SPLINE_MARGIN), (0, 0)), "edge")
    return np.asarray(spline_filter1d(lines, 3, axis=0, mode="nearest"))


def _sums_of_squares(images: Float32Array) -> FloatArray:
    """Compute the sum of squares of each image, (n,)."""
    lines = images.reshape(len(images), -1)
    return np.asarray(np.einsum("ij,ij->i", lines, lines, dtype=np.float64))


def _mean_square(values: Float32Array) -> float:
    return float(np.square(values).mean())


def _changes(images: Float32Array) -> Float32Array:
    """Return the changes between neighbouring columns of smoothed rows."""
    smooth = 0.25 * images[..., :-2] + 0.5 * images[..., 1:-1] + 0.25 * images[..., 2:]
    return np.diff(smooth, axis=-1)
