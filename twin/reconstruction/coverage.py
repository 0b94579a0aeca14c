"""Which voxels the views of a circle cover, and what becomes of the others.

A voxel near the upper or lower end of the field of view lies above or below the panel in the views
whose source is near. The other views still see lines of every direction through it, so what they
gave is scaled. A voxel of which the data say too little is NaN.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array, FloatArray
from flexdt.twin.projection import Volume
from flexdt.twin.reconstruction.trajectory import UNEVEN, Circle, circle_of

LEAST_SEEN: Final = 0.4
"""Part of the weight of all views that must see a voxel. At the panel's upper and lower edge it is
about half in a whole turn."""
ALL_LINES: Final = 0.97
"""Part of the directions in which a voxel must be seen where the panel cuts the object off, less
the arc that a view stands for."""
WEDGE: Final = np.deg2rad(5.0)
"""Angle without lines that is worth a word: it leaves 2 % of a part's contrast in the others."""
MADE_UP_BY: Final = 360
"""Views by which that part is judged, of as many or more."""


def make_up(
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
    """Make voxels up for views that see them above or below the panel; see `fdk_kernels.make_up`.

    Where there are many views, one stands for some neighbours.

    Args:
        data: of the volume, (ny, nx, nz), changed in place.
        like: its grid.
        circle: of the views.
        table: what the kernel needs of each view, (n, 11).
        weights: of rays, (n, cols).
        rows: that the table's rows count.
        panel: of these columns the first and the last that are the panel's.
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
    starts = np.arange(0, len(order), -(-len(order) // MADE_UP_BY))
    middle = order[(starts + np.append(starts[1:], len(order))) // 2]
    step = np.add.reduceat(circle.step[order], starts)
    fdk_kernels.make_up(
        np.ascontiguousarray(table[middle]), weights[middle] * step[:, None], rows,
        np.array(panel) + (-0.5, 0.5), circle.radius, *first, *size, LEAST_SEEN,
        (ALL_LINES * np.pi - circle.step.max()) * cut_off, data,
    )  # fmt: skip


def first_and_steps(like: Volume) -> tuple[list[float], list[float]]:
    """Centre of the first voxel and steps (x, y, z) [mm]."""
    return [float(places[0]) for places in like.centers()], list(like.voxel_xyz)


def missing_wedge(cone_vec: ConeVec) -> list[str]:
    """What is to be said of directions in which neither views nor their opposites saw a line.

    Raises:
        GeometryError: neither a circle nor a helix.
    """
    lines = np.unique((circle_of(cone_vec).angle % np.pi).round(9))
    ahead = np.diff(lines, append=lines[0] + np.pi)
    widest, usual = float(ahead.max()), float(np.median(ahead))
    if widest <= max(UNEVEN * usual, WEDGE):
        return []
    return [
        f"no view sees lines within a wedge of {np.rad2deg(widest):.3g} deg (the usual step is "
        f"{np.rad2deg(usual):.3g} deg): streaks, and values some per cent off near edges along it"
    ]


def unseen_layers(data: Float32Array) -> list[str]:
    """What is to be said of layers of a volume (nz, ny, nx) without a single voxel from data."""
    lost = int(np.isnan(data[:, ::4, ::4]).all(axis=(1, 2)).sum())
    if not lost:
        return []
    return [
        f"{lost} of {len(data)} layers of the grid lie above or below what the panel sees; their "
        "voxels are NaN"
    ]
