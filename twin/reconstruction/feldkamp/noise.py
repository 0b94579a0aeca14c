"""The standard deviation of the noise in a volume of FDK, from the images themselves.

Nothing has to be known of the camera. What differs from view to view: the views are added up
once more, every second one with a minus (in the order of their angles). What the object gives
to neighboring views cancels, what noise gives does not, and has the variance that it has in
the volume. What all views share, the noise of the flat and dark images: its spectrum is that of
the views' mean, less that of their alternating mean. A voxel's variance follows from where the
views see it. On a grid of every few voxels, both cost little.

How the variance changes from voxel to voxel follows from the rays through it: that of a pixel is
a function of its value (`NoiseByValue`), and a share of the views, back-projected, gives its
shape. How large it is, the alternating sum says, in wide windows.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.cpu import threads
from flexdt.twin.projection.volume import Volume
from flexdt.twin.reconstruction.acquisition.coverage import first_and_steps
from flexdt.twin.reconstruction.acquisition.trajectory import Circle
from flexdt.twin.reconstruction.feldkamp.fdk_views import Views
from flexdt.twin.reconstruction.feldkamp.half_scans import HalfScanMeter, HalfScans
from flexdt.twin.reconstruction.feldkamp.noise_by_value import NoiseByValue
from flexdt.twin.reconstruction.feldkamp.slabs import layers
from flexdt.twin.reconstruction.volume_errors import interpolated

NODES: Final = 24
"""Largest number of nodes of the coarse grid along a side."""
SHAPE_LAYERS: Final = 128
"""Largest number of layers of the variance's shape: along the axis it is as sharp as the
object."""
VALUED_VIEWS: Final = 4
"""Views, at most, of which the noise by value is measured."""
SHAPE_VIEWS: Final = 24
"""Views, at most, from which the variance's shape is computed."""
MIN_ROW_DISTANCE: Final = 3
"""Least distance of two compared rows of the panel: blur correlates neighbors."""
BANDS: Final = 16
"""Bands of the spectrum over which it is averaged."""
AVERAGED_POINTS: Final = 8
POINTS: Final = 32 * AVERAGED_POINTS
"""Places at which the variance common to all views is computed, and how many are
averaged."""
WINDOW_NODES: Final = 5
"""Side of the window about a node whose values are compared [nodes]."""
NORMAL_MEDIAN: Final = 0.67449
"""Median of the absolute values of standard normal deviates."""
TINY: Final = float(np.finfo(np.float32).tiny)


@dataclass(frozen=True, eq=False)
class Noise:
    """Variances of the noise in a volume.

    Attributes:
        views: variance of the views' own noise, on a coarse grid [1/mm^2].
        centre: of the circle [mm].
        radii: about it, growing [mm].
        shared: variance common to all views at these radii [1/mm^2].
    """

    views: Volume
    centre: tuple[float, float]
    radii: FloatArray
    shared: FloatArray

    def sigma(self, grid: Volume) -> Float32Array:
        """Compute the standard deviation of noise at a grid's voxels [1/mm]; NaN where
        its values are.

        The views' own variance, interpolated, plus what they share by distance from the
        axis. A mean over rows: near the axis one on a row has 1.2 times as much, between
        two .85.
        """
        x, y, _ = grid.centers()
        flat = np.hypot(x - self.centre[0], (y - self.centre[1])[:, None])
        out = interpolated(self.views, grid)
        np.sqrt(
            out + np.interp(flat, self.radii, self.shared), out=out, casting="same_kind"
        )
        return np.where(np.isnan(grid.data), np.float32(np.nan), out)


@dataclass(frozen=True, eq=False)
class NoiseOfViews:
    """Noise that is computed when it is first asked for, and then kept.

    Attributes:
        meter: what the views gave.
    """

    meter: NoiseMeter

    @cached_property
    def noise(self) -> Noise:
        """The variances."""
        return self.meter.measured()

    def sigma(self, grid: Volume) -> Float32Array:
        """Compute the standard deviation at each voxel of a grid; see `Noise`."""
        return self.noise.sigma(grid)

    @cached_property
    def half_scans(self) -> HalfScans | None:
        """Planes from parts of the scan; None where a device made the volume."""
        return self.meter.halves.found()


@dataclass(frozen=True, eq=False)
class NoiseOfSlabs:
    """Noise of a volume that was made slab by slab.

    Attributes:
        slabs: layers (first, last) of each.
        noises: of each.
    """

    slabs: tuple[tuple[int, int], ...]
    noises: tuple[NoiseOfViews, ...]

    def sigma(self, grid: Volume) -> Float32Array:
        """Compute the standard deviation on the complete grid; see `Noise`."""
        parts = zip(self.slabs, self.noises, strict=True)
        return np.concatenate([noise.sigma(layers(grid, *slab)) for slab, noise in parts])

    @cached_property
    def half_scans(self) -> HalfScans | None:
        """Planes from parts of the scan, as `NoiseOfViews`."""
        parts = [noise.half_scans for noise in self.noises]
        found = [part for part in parts if part is not None]
        return HalfScans.stacked(found) if len(found) == len(parts) else None


class NoiseMeter:
    """Collects the data for the noise of a volume while views are added to it.

    Args:
        like: the volume's grid.
        circle: of the views.
        table: of all views, of `fdk_kernels.backproject`.

    Attributes:
        grid: coarse.
        data: the alternating sum of the views on it, (ny, nx, nz).
        shape_grid: of the variance's shape; coarse across, finer along the axis.
        shape: the variance but for a factor that changes slowly, (ny, nx, nz).
    """

    def __init__(self, like: Volume, circle: Circle, table: FloatArray) -> None:
        """Make a coarse grid of at most `NODES` nodes along a side, in which views are
        added with alternating signs.

        Nodes along z are at least `MIN_ROW_DISTANCE` rows apart. By angle the signs
        alternate; the last of an odd number has sign 0.

        Args:
            like: the volume's grid.
            circle: of the sources.
            table: (n, 11) of `view_table`.
        """
        self._circle = circle
        self._table = table
        rows_per_mm = float(table[:, 9].mean()) / circle.radius
        size = np.array(like.voxel_xyz)
        steps = np.maximum(2, -(-np.array(like.shape[::-1]) // NODES))
        steps[2] = max(steps[2], np.ceil(MIN_ROW_DISTANCE / (rows_per_mm * size[2])))
        counts = np.maximum(1, np.array(like.shape[::-1]) // steps)
        nx, ny, nz = (int(n) for n in counts)
        dx, dy, dz = (float(s) for s in steps * size)
        self.grid = Volume(
            np.zeros((nz, ny, nx), np.float32), (dx, dy, dz), like.center_mm
        )
        self.data = np.zeros((ny, nx, nz), np.float32)
        layers_mm = like.shape[0] * size[2]
        fine = min(like.shape[0], SHAPE_LAYERS)
        self.shape_grid = Volume(
            np.zeros((fine, ny, nx), np.float32),
            (dx, dy, float(layers_mm / fine)),
            like.center_mm,
        )
        self.shape = np.zeros((ny, nx, fine), np.float32)
        self._by_value: NoiseByValue | None = None
        order = np.argsort(circle.angle % (2.0 * np.pi), kind="stable")
        self._signs = np.zeros(len(order), np.float32)
        self._signs[order] = np.where(np.arange(len(order)) % 2, -1.0, 1.0)
        self._rank = np.argsort(order)
        if len(order) % 2:  # the last has no neighbour to cancel
            self._signs[order[-1]] = 0.0
        self._hits: list[tuple[FloatArray, FloatArray]] = []
        self._means: Float32Array | None = None
        self._done = 0
        self._response: FloatArray = np.zeros(0)
        self.halves = HalfScanMeter(like, circle, self._signs)

    def note(self, views: Views) -> Float32Array:
        """Record the next views, in the order of the scan: adds their images to plain and
        alternating sums, and stores where they see the points of `_points`.

        Args:
            views: n views, before the filter.

        Returns:
            (n,) sign of each in the alternating sum: 1, -1 or 0.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        n = len(views.images)
        signs = self._signs[self._done : self._done + n]
        if self._means is None:
            shape = (2, views.sizes[3], views.images.shape[2])
            self._means = np.zeros(shape, np.float32)
        images = np.ascontiguousarray(views.images)
        fdk_kernels.add_views(images, views.top, signs, self._means)
        self._hits.append(self._seen_at(views))
        self._add_shape(views)
        self._response = views.response.astype(np.float64)
        self._done += n
        return signs

    def add(self, views: Views, columns: Float32Array) -> None:
        """Record the next views (`note`) and add their filtered columns to the
        alternating volume `data`.

        Args:
            views: n views.
            columns: (n or more, cols, rows) filtered; overwritten, times the signs.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        self.halves.add(views, columns, self._done)
        signs = self.note(views)
        rows = views.sizes[3]
        for column, sign in zip(columns, signs, strict=False):
            if sign <= 0.0:  # half of them: those with a plus stay as they are
                np.multiply(column, sign, out=column)
        first, size = first_and_steps(self.grid)
        fdk_kernels.backproject(
            columns, rows, views.shares, views.table, *first, *size, self.data, threads()
        )

    def _add_shape(self, views: Views) -> None:
        """Add the variances of some of the next views' pixels to the shape of the variance.

        The filter takes three quarters of a pixel's variance from that pixel, so that the
        variance before it has the shape of that behind it.
        """
        from flexdt.twin.reconstruction.kernels import fdk_kernels

        rank = self._rank[self._done : self._done + len(views.images)]
        turn = np.argsort(rank)
        chosen = turn[rank[turn] * SHAPE_VIEWS % len(self._rank) < SHAPE_VIEWS]
        some = views.of(chosen)
        shown = some.images[:, some.shown]
        if not len(chosen) or min(shown.shape[1:]) < 2:
            return
        if self._by_value is None:
            self._by_value = NoiseByValue.of(shown[:: -(-len(shown) // VALUED_VIEWS)])
        n, wide, cols, rows = some.sizes
        images = np.zeros((n, rows, wide), np.float32)
        some.widen(images)
        variance = self._by_value(images[:, :, some.kept])
        variance *= np.square(some.factors[:, None, some.kept])
        variance /= some.across[:, None, some.kept] + some.up[:, :, None]
        columns = fdk_kernels.room(n, cols, rows, some.few)
        columns[:, :, :rows] = variance.transpose(0, 2, 1)
        first, size = first_and_steps(self.shape_grid)
        fdk_kernels.backproject(
            columns, rows, some.shares, some.table, *first, *size, self.shape, threads()
        )

    def _points(self) -> tuple[FloatArray, FloatArray]:
        """Place POINTS points on a spiral about the rotation axis, at which the shared
        variance is computed.

        Radii grow geometrically from a quarter of a pixel's size at the axis to the
        grid's corner; the first is 0.

        Returns:
            Radii (POINTS,) and places (POINTS, 2) [mm].
        """
        x, y, _ = self.grid.centers()
        farthest = float(np.hypot(*(np.abs([x[[0, -1]], y[[0, -1]]]).max(axis=1))))
        pitch = self._circle.radius / float(self._table[:, 7].mean())
        radii = np.append(
            0.0, np.geomspace(0.25 * pitch, max(farthest, pitch), POINTS - 1)
        )
        turn = np.arange(POINTS) * np.pi * (3.0 - np.sqrt(5.0))  # even at every few radii
        around = np.stack([np.cos(turn), np.sin(turn)], 1)
        return radii, radii[:, None] * around + self._circle.centre

    def _seen_at(self, views: Views) -> tuple[FloatArray, FloatArray]:
        """Compute the column, before the filter, at which views see the points, and the
        weight there.

        Args:
            views: n views.

        Returns:
            (n, POINTS) each: column, a fraction; weight at the nearest column over
            depth^2. Both 0 for a point beside the panel or behind the source.
        """
        points = self._points()[1]
        g = views.table[:, :, None]
        x = points[:, 0] - g[:, 0]
        y = points[:, 1] - g[:, 1]
        depth = x * g[:, 3] + y * g[:, 4]
        column = (
            g[:, 8] + (x * g[:, 5] + y * g[:, 6]) / depth * g[:, 7] + views.kept.start
        )
        inside = (
            (depth > 0.0) & (column >= 0.0) & (column <= views.factors.shape[1] - 1.0)
        )
        nearest = np.where(inside, column, 0.0).round().astype(int)
        factors = np.take_along_axis(
            views.factors / np.sqrt(views.across), nearest, axis=1
        )
        return np.where(inside, column, 0.0), np.where(inside, factors / depth**2, 0.0)

    def found(self) -> NoiseOfViews | None:
        """Return the noise after all views, computed on request.

        Returns None if at most `MIN_ROW_DISTANCE` + 1 rows see the grid, or no voxel is
        seen.
        """
        assert self._means is not None
        if self._means.shape[1] <= MIN_ROW_DISTANCE + 1 or np.isnan(self.data).all():
            return None
        return NoiseOfViews(self)

    def measured(self) -> Noise:
        """Compute the noise.

        The variance of the views' own noise has the shape that the rays give it, times a
        factor from differences of neighboring layers of the alternating sum, if there are
        more than two; that common to all views is given over the radius from the rotation
        axis.
        """
        shape = self._filled_shape()
        spread = np.sqrt(interpolated(shape, self.grid)).transpose(1, 2, 0)
        alternating = (self.data / spread).astype(np.float32)
        if (
            alternating.shape[2] > 2
        ):  # without what few views cause, which layers have in common
            pairs = np.diff(alternating, axis=2, append=alternating[:, :, -2:-1])
            pairs /= np.float32(np.sqrt(2.0))
            alternating = np.where(np.isnan(pairs), alternating, pairs)
        factor = self.grid.like(_local_variance(alternating.transpose(2, 0, 1)))
        variance = shape.data * interpolated(factor, shape)
        radii = self._points()[0].reshape(-1, AVERAGED_POINTS).mean(axis=1)
        shared = self._shared_variance().reshape(-1, AVERAGED_POINTS).mean(axis=1)
        centre = (float(self._circle.centre[0]), float(self._circle.centre[1]))
        return Noise(shape.like(variance), centre, radii, shared)

    def _filled_shape(self) -> Volume:
        """Return the variance's shape; the least that is known where no chosen view sees."""
        values = self.shape.transpose(2, 0, 1)
        seen = values > 0.0
        least = float(values[seen].min()) if seen.any() else 1.0
        return self.shape_grid.like(np.where(seen, values, np.float32(least)))

    def _shared_variance(self) -> FloatArray:
        """Compute the variance at each point of the noise that all views share (as of a
        pixel's fixed error), (POINTS,) [1/mm^2].

        Its share is the excess of the mean image's power over that of the alternating
        sum, in the finer half of the spectrum, where the object is blurred; 0 if there is
        none.
        """
        assert self._means is not None
        length = 2 * (len(self._response) - 1)
        column = np.concatenate([columns for columns, _ in self._hits])
        counts = np.concatenate([factors for _, factors in self._hits])
        first = np.floor(column).astype(int)
        part = column - first
        row = np.arange(column.shape[1]) * length
        hits = np.bincount(
            (row + first).ravel(), (counts * (1.0 - part)).ravel(), row[-1] + length
        )
        hits += np.bincount(
            (row + first + 1).ravel(), (counts * part).ravel(), row[-1] + length
        )
        power = np.abs(np.fft.rfft(hits.reshape(-1, length))) ** 2 * self._response**2
        mean, alternating = self._means / self._done
        share = excess_of_mean(mean, alternating, length)
        alternating = _spectrum(alternating, length)
        twice = np.full(len(self._response), 2.0)
        twice[[0, -1]] = 1.0  # frequencies without a negative one
        found: FloatArray = power @ (twice * share * alternating) / length
        return found


def excess_of_mean(
    mean: npt.NDArray[np.floating],
    alternating: npt.NDArray[np.floating],
    length: int | None = None,
) -> float:
    """Compute the variance of the noise that all views share, over that of the mean of their own.

    Args:
        mean, alternating: of the views, without and with alternating signs, (rows, cols), more
            than `MIN_ROW_DISTANCE` + 1 rows.
        length: of a padded row; None for no padding.
    """
    length = mean.shape[1] if length is None else length
    power, own = _spectrum(mean, length), _spectrum(alternating, length)
    # The object is in the mean, blurred as it turned: its finest details are not.
    fine = slice(len(power) // 2, None)
    return float(max(power[fine].sum() / max(own[fine].sum(), TINY) - 1.0, 0.0))


def _local_variance(values: Float32Array) -> Float32Array:
    """Compute the variance of zero-mean values about each of them, from the median of their
    sizes in a window of `WINDOW_NODES`, which few strong edges do not change, smoothed.

    Args:
        values: (nz, ny, nx); NaN is replaced by the nearest value, one at least must be
            finite.

    Returns (nz, ny, nx) without NaN.
    """
    from scipy.ndimage import distance_transform_edt, gaussian_filter, median_filter

    unseen = np.isnan(values)
    if unseen.any():
        nearest = distance_transform_edt(
            unseen, return_distances=False, return_indices=True
        )
        values = values[tuple(nearest)]
    typical = median_filter(np.abs(values), WINDOW_NODES, mode="nearest") / NORMAL_MEDIAN
    out: Float32Array = gaussian_filter(typical**2, 1.0, mode="nearest")
    return out


def _spectrum(image: npt.NDArray[np.floating], length: int) -> FloatArray:
    """Compute the power of an image's noise along its rows.

    The volume's voxels may be anywhere between two rows, so that rows and their means are
    mixed. Rows `MIN_ROW_DISTANCE` apart are compared, so that only the object's edges
    remain, which the median over all pairs of rows ignores. Averaged over `BANDS` bands.

    Args:
        image: (rows, cols), more than `MIN_ROW_DISTANCE` + 1 rows.
        length: of a padded row.

    Returns:
        (length / 2 + 1,), a column's share.
    """
    between = 0.5 * (image[1:] + image[:-1])
    power = [
        np.median(
            np.abs(np.fft.rfft(rows[MIN_ROW_DISTANCE:] - rows[:-MIN_ROW_DISTANCE])) ** 2,
            axis=0,
        )
        for rows in (image, between)
    ]
    # Of an exponential distribution the median is log 2 times the mean; linear interpolation at
    # any place is a third of what it is on the rows and two thirds of what it is between them.
    mean = (power[0] + 2.0 * power[1]) / 3.0 / np.log(2.0) / 2.0 / image.shape[1]
    bands = np.array_split(np.arange(len(mean)), BANDS)
    middle = [band.mean() / (len(mean) - 1) for band in bands if len(band)]
    averaged = [mean[band].mean() for band in bands if len(band)]
    out: FloatArray = np.interp(np.linspace(0.0, 1.0, length // 2 + 1), middle, averaged)
    return out
