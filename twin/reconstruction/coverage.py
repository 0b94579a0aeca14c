"""Which voxels the views of a circle cover, and what becomes of the others.

A voxel near the upper or lower end of the field of view lies above or below the panel in the views
whose source is near. The other views still see lines of every direction through it, so what they
gave is scaled. A voxel of which the data say too little is NaN.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.trajectory import Circle

LEAST_SEEN: Final = 0.4
"""Part of the weight of all views that must see a voxel. At the panel's upper and lower edge it is
about half in a whole turn."""
ALL_LINES: Final = 0.97
"""Part of the directions in which a voxel must be seen where the panel cuts the object off, less
the arc that a view stands for."""
MOST_VIEWS: Final = 360
"""Coverage is judged by so many of the views at most, evenly over the circle."""


def normalise_coverage(
    data: Float32Array,
    like: Volume,
    circle: Circle,
    table: FloatArray,
    weights: FloatArray,
    rows: int,
    panel: tuple[int, int],
    *,
    cut_off: bool,
) -> None:
    """Scale voxels that lie above or below the panel in some views; those seen too little are NaN.

    See `fdk_kernels.normalise_coverage`. Of many views, one stands for some neighbours.

    Args:
        data: the volume's, (ny, nx, nz), changed in place.
        like: its grid.
        circle: of the views.
        table: what the kernel needs of each view, (n, 11).
        weights: of rays, (n, cols).
        rows: of the images.
        panel: first and last column of the panel, among the images' columns.
        cut_off: whether the panel cuts the object off, so that voxels which are not seen in lines
            of all directions become NaN.
    """
    from flexdt.twin.reconstruction import fdk_kernels

    first, size = first_and_steps(like)
    x, y, z = (np.array([places[0], places[-1]]) for places in like.centers())
    corner = np.hypot(x[:, None] - circle.centre[0], y - circle.centre[1]).max()
    depth = np.array([max(circle.radius - corner, 1e-9), circle.radius + corner])
    # The rows between which the grid's voxels lie: highest and lowest, nearest and farthest.
    high = ((z - table[:, 2, None]) * table[:, 9, None])[:, :, None] / depth
    row = table[:, 10, None, None] - high
    if not cut_off and row.min() >= 0.0 and row.max() <= rows - 1:
        return
    order = np.argsort(circle.angle, kind="stable")
    starts = np.arange(0, len(order), -(-len(order) // MOST_VIEWS))
    middle = order[(starts + np.append(starts[1:], len(order))) // 2]
    step = np.add.reduceat(circle.step[order], starts)
    fdk_kernels.normalise_coverage(
        np.ascontiguousarray(table[middle]), weights[middle] * step[:, None], rows,
        np.array(panel) + (-0.5, 0.5), circle.radius, *first, *size, LEAST_SEEN,
        (ALL_LINES * np.pi - circle.step.max()) * cut_off, data,
    )  # fmt: skip


def first_and_steps(like: Volume) -> tuple[list[float], list[float]]:
    """Centre of the first voxel and steps (x, y, z) [mm]."""
    return [float(places[0]) for places in like.centers()], list(like.voxel_xyz)


def lost_layers(data: Float32Array) -> int:
    """Layers of a volume (nz, ny, nx) without a value, judged by every fourth voxel of a side."""
    return int(np.isnan(data[:, ::4, ::4]).all(axis=(1, 2)).sum())


def layer_warnings(lost: int, layers: int) -> list[str]:
    """A warning where some of a grid's layers are lost."""
    if not lost:
        return []
    return [
        f"{lost} of {layers} layers of the grid lie outside what the panel sees; their voxels are "
        "NaN"
    ]
