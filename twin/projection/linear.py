"""The projector of smooth volumes: values between voxel centers are linear, pixels are areas.

`forward` and `back` of `operators` call it for `model="linear"`; the kernels' page says what is
computed. Levels are stacked along the axis that rays are most nearly at right angles to, and
columns are those of the panel's sides that follow it.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
import numpy.typing as npt

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection.kernels.fan_types import Box

Model = Literal["exact", "linear"]
"""Voxels of one value each, or values between their centers."""
MODELS: Final = ("exact", "linear")
EXCHANGED: Final = [0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8]
"""Order of a view's numbers with u and v exchanged."""


def check_model(model: object) -> None:
    """Check the name of a model.

    Raises LimitError: unknown; lists the allowed ones."""
    if model not in MODELS:
        allowed = ", ".join(repr(name) for name in MODELS)
        raise LimitError.instead(f"model is {model!r}", repr(model), allowed)


def level_axes(rays: FloatArray, shape: tuple[int, int]) -> npt.NDArray[np.intp]:
    """Choose the axis of each view, (n,), along which levels are stacked: 0 for z, 1 for x, 2
    for y, as the orders of `operators.ORDERS`, by the steepest ray along it.

    Args:
        rays: (n, 12) source, first pixel minus source, u, v in voxel units.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    first, u, v = (rays[:, None, i : i + 3] for i in (3, 6, 9))
    r = np.array([0, 0, rows - 1, rows - 1])[:, None]
    c = np.array([0, cols - 1, 0, cols - 1])[:, None]
    size = np.abs(first + r * v + c * u)
    size = size / np.linalg.norm(size, axis=2, keepdims=True)
    steepest = size.max(axis=1)[:, [2, 0, 1]]
    return np.asarray(np.argmin(steepest - [1e-9, 0.0, 0.0], axis=1))


def _columns_along(g: FloatArray) -> tuple[FloatArray, bool]:
    """Return a view's numbers with the columns along z, and whether they were exchanged."""
    if abs(g[8]) > abs(g[11]):
        return np.ascontiguousarray(g[EXCHANGED]), True
    return g, False


def _prepared(
    box: Box, g: FloatArray, shape: tuple[int, int]
) -> tuple[npt.NDArray[np.int64], FloatArray, FloatArray, FloatArray]:
    """Compute what the columns of a view need, see `linear_kernels.prepare`."""
    from flexdt.twin.projection.kernels import linear_kernels

    rows, cols = shape
    main = np.empty(cols, np.int64)
    along, across = np.empty((2, cols, rows + 1))
    factor = np.empty((cols, rows))
    linear_kernels.prepare(box, g, main, along, across, factor)
    return main, along, across, factor


def project(box: Box, views: FloatArray, out: Float32Array) -> None:
    """Fill out (n, rows, cols) with line integrals of the interpolated volume.

    Args:
        box: the volume, with levels along z.
        views: (n, 12) source, first pixel minus source, u, v in voxel units of the box.
        out: C-ordered float32.
    """
    from flexdt.twin.projection.kernels import linear_kernels

    for view, image in zip(views, out, strict=True):
        g, turned = _columns_along(view)
        seen = np.empty(image.shape[::-1], np.float32) if turned else image
        ready = _prepared(box, g, (seen.shape[0], seen.shape[1]))
        linear_kernels.project_linear(box, g, *ready, seen)
        if turned:
            image[...] = seen.T


def spread(box: Box, views: FloatArray, values: Float32Array) -> None:
    """Apply the transpose of `project`: add values (n, rows, cols) to box.flat.

    Args:
        box: the volume, its spans are not used.
        views, values: as of `project`.
    """
    from flexdt.twin.projection.kernels import linear_kernels

    for view, image in zip(views, values, strict=True):
        g, turned = _columns_along(view)
        seen = np.ascontiguousarray(image.T if turned else image)
        ready = _prepared(box, g, (seen.shape[0], seen.shape[1]))
        for axis in range(2):
            linear_kernels.spread_linear(box, g, *ready, seen, axis)
