"""Resample images of oblong pixels to square ones.

Spots of balls are then nearly round, as detection and the second measurement expect. Columns
stay as they are, and with them the column of the rotation axis.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import overload

import numpy as np
import numpy.typing as npt

from flexdt.library.datasets.image_set import Arrays, Counts, Images, ImageSet
from flexdt.twin.dataset.dataset_errors import DatasetMissingError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array

MAX_SIDE_DIFFERENCE = 1e-3
"""Relative difference of the pixel's sides above which rows are resampled."""


def squared(data: Images) -> Images:
    """Resample rows to the columns' pitch where pixels are not square, with a warning in
    the data set.

    Pixels whose sides differ by less than `MAX_SIDE_DIFFERENCE` count as square. The copy
    has images that are resampled when they are read, resampled dark and flat images, and
    the geometry of the new rows.

    Args:
        data: a data set; itself is returned if its pixels are square.
    """
    poses = data.poses
    ratio = float(
        np.median(np.linalg.norm(poses.v, axis=1) / np.linalg.norm(poses.u, axis=1))
    )
    if abs(ratio - 1.0) < MAX_SIDE_DIFFERENCE:
        return data
    rows, cols = data.shape
    shape = max(1, int(rows * ratio)), cols
    table = np.array(data.cone_vec.rows)
    table[:, 9:] /= ratio
    warning = (
        f"the pixels are {np.linalg.norm(poses.u[0]):.4g} x "
        f"{np.linalg.norm(poses.v[0]):.4g} mm; "
        f"calibration takes their {rows} rows as {shape[0]} of the columns' pitch"
    )
    images = ResampledRows(data, shape[0], ratio)
    return replace(
        data,
        shape=shape,
        cone_vec=ConeVec(table).with_shape(shape),
        nominal=replace(poses, v=poses.v / ratio),
        arrays=Arrays(images, images.of(data.dark)[None], images.flats()),
        warnings=(*data.warnings, warning),
    )


@dataclass(frozen=True, eq=False)
class ResampledRows:
    """Counts of images with resampled rows, `ratio` times as close.

    Attributes:
        original: the images.
        rows: of the new images.
        ratio: old distance of rows over the new one.
    """

    original: ImageSet
    rows: int
    ratio: float

    @overload
    def __getitem__(self, index: int) -> Counts: ...
    @overload
    def __getitem__(self, index: npt.NDArray[np.int64]) -> ResampledRows: ...
    def __getitem__(self, index: int | npt.NDArray[np.int64]) -> Counts | ResampledRows:
        """Return the resampled counts of one image, rounded and cut to uint16; for an
        array of indices these images as `ResampledRows`, not yet read.
        """
        if isinstance(index, np.ndarray) and index.ndim:
            return replace(self, original=self.original[index])
        counts = self.of(self.original.counts(int(index)))
        return np.rint(counts).clip(0, np.iinfo(np.uint16).max).astype(np.uint16)

    def flats(self) -> Float32Array | None:
        """Return the resampled mean flat image, (1, rows, cols) [counts], or None."""
        try:
            return self.of(self.original.flat)[None]
        except DatasetMissingError:
            return None

    def of(self, image: Counts | Float32Array) -> Float32Array:
        """Compute means of an image over the new rows, centered on the old ones.

        Args:
            image: (old rows, cols).

        Returns:
            (rows, cols): means of the spline that has the sums of the old rows.
        """
        from scipy.interpolate import CubicSpline

        rows, cols = image.shape
        total = np.concatenate(
            [np.zeros((1, cols)), np.cumsum(image, axis=0, dtype=np.float64)]
        )
        edges = (np.arange(self.rows + 1) - self.rows / 2) / self.ratio + rows / 2
        up_to = CubicSpline(np.arange(rows + 1), total)(edges.clip(0, rows))
        return np.asarray(np.diff(up_to, axis=0) * self.ratio, dtype=np.float32)
