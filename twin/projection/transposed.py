"""Detectors mounted on their side: rows are taken for columns.

The fans of `fan_plan` follow a detector's columns. A view in which images of vertical planes run
along the rows instead is projected as the view of a detector with u and v exchanged, whose image is
the transpose; thus the kernels know one orientation only.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray

ROOM = 64 << 20
"""Bytes of transposed images at a time (one image, if that is more)."""
EXCHANGED = [0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8]
"""A view (source, first pixel minus source, u, v) with u and v exchanged."""


def lying(views: FloatArray, shape: tuple[int, int]) -> npt.NDArray[np.bool_]:
    """Views in which images of vertical planes run along the rows more than along the columns.

    Args:
        views: (n, 12) source, first pixel minus source, u, v in voxel units.
        shape: detector (rows, cols).
    """
    rows, cols = shape
    first, u, v = (views[:, i : i + 3] for i in (3, 6, 9))
    middle = first + (cols - 1) / 2 * u + (rows - 1) / 2 * v

    def across(a: FloatArray) -> FloatArray:
        return np.asarray(np.abs(a[:, 0] * middle[:, 1] - a[:, 1] * middle[:, 0]))

    return np.asarray(across(v) > across(u))


def exchanged(views: FloatArray) -> FloatArray:
    """The same rays with rows taken for columns."""
    return np.ascontiguousarray(views[:, EXCHANGED])


def runs(views: FloatArray, shape: tuple[int, int]) -> Iterator[tuple[slice, bool]]:
    """Ranges of neighbouring views of one orientation, each with whether it is transposed.

    Of those that lie no more than fit into ROOM.
    """
    on_side = lying(views, shape)
    most = max(1, ROOM // (4 * shape[0] * shape[1]))
    edges = np.flatnonzero(np.diff(on_side)) + 1
    for begin, end in zip([0, *edges.tolist()], [*edges.tolist(), len(views)], strict=True):
        turned = bool(on_side[begin])
        step = most if turned else end - begin
        for at in range(begin, end, step):
            yield slice(at, min(at + step, end)), turned
