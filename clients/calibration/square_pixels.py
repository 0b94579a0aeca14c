"""A data set of pixels that are not square, as one whose pixels are: its rows are taken anew.

Spots of balls are then nearly round, as detection and the second look expect. Columns stay what
they are, and with them the column of the rotation axis.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from flexdt.clients.datasets.data_set import Counts, DataSet
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array

UNEQUAL = 1e-3
"""Relative difference of the pixel's sides from which rows are taken anew."""


def squared(data: DataSet) -> DataSet:
    """`data`, or where its pixels are not square the same with rows as far apart as its columns."""
    poses = data.poses
    ratio = float(np.median(np.linalg.norm(poses.v, axis=1) / np.linalg.norm(poses.u, axis=1)))
    if abs(ratio - 1.0) < UNEQUAL:
        return data
    rows, cols = data.shape
    shape = max(1, int(rows * ratio)), cols
    table = np.array(data.cone_vec.rows)
    table[:, 9:] /= ratio
    said = (
        f"the pixels are {np.linalg.norm(poses.u[0]):.4g} x {np.linalg.norm(poses.v[0]):.4g} mm; "
        f"calibration takes their {rows} rows as {shape[0]} of the columns' pitch"
    )
    own: dict[str, Any] = {f.name: getattr(data, f.name) for f in fields(data)}
    own |= {
        "shape": shape,
        "cone_vec": ConeVec(table).with_shape(shape),
        "nominal": replace(poses, v=poses.v / ratio),
        "warnings": (*data.warnings, said),
    }
    return _Square(**own, original=data, ratio=ratio)


@dataclass(frozen=True, eq=False, repr=False)
class _Square(DataSet):
    """The images of `original` with rows `ratio` times as close."""

    original: DataSet | None = None
    ratio: float = 1.0

    def counts(self, index: int | None = None) -> Counts:
        assert self.original is not None
        if index is None:
            return super().counts()
        return np.rint(self._taken(self.original.counts(index))).clip(0, 65535).astype(np.uint16)

    @cached_property
    def dark(self) -> Float32Array:
        assert self.original is not None
        return self._taken(self.original.dark)

    @cached_property
    def flat(self) -> Float32Array:
        assert self.original is not None
        return self._taken(self.original.flat)

    def _taken(self, image: Counts | Float32Array) -> Float32Array:
        """Means over the new rows, in the middle of the old ones, of a spline with their sums."""
        rows, cols = image.shape
        total = np.concatenate([np.zeros((1, cols)), np.cumsum(image, axis=0, dtype=np.float64)])
        edges = (np.arange(self.shape[0] + 1) - self.shape[0] / 2) / self.ratio + rows / 2
        up_to = CubicSpline(np.arange(rows + 1), total)(edges.clip(0, rows))
        return np.asarray(np.diff(up_to, axis=0) * self.ratio, dtype=np.float32)
