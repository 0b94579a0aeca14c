"""Offsets that the pixels of a scan add to all its views."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.reconstruction import ring_errors
from flexdt.twin.reconstruction.acquisition.rectify import on_its_side
from flexdt.twin.reconstruction.acquisition.trajectory import Circle, circle_of

MAX_LEAN_PX: Final = 1.0
"""Columns between the axis at the panel's upper and lower edge, at most: beyond, columns on
both sides of it do not see the same rays."""
SECTORS: Final = 8
"""Number of parts of a turn whose numbers of views are compared."""
MAX_UNEVEN_RATIO: Final = 1.3
"""Views of the fullest sector over those of the emptiest, at most."""


def scan_rings(
    view: Callable[[int], Float32Array], cone_vec: ConeVec, shape: tuple[int, int]
) -> Float32Array:
    """Estimate the offset (rows, cols) that each pixel adds to all views.

    `view` gives line integrals by number. 0 where none exceeds object and noise.
    """
    lies = on_its_side(cone_vec)
    numbers = range(len(cone_vec))
    views: Iterator[Float32Array] = (view(k).T if lies else view(k) for k in numbers)
    offsets = ring_errors(views, _axis_column(cone_vec, shape, lies=lies))
    return offsets.T if lies else offsets


def _axis_column(
    cone_vec: ConeVec, shape: tuple[int, int], *, lies: bool
) -> float | None:
    """Return the column of the axis of a full turn.

    Args:
        cone_vec: of all views.
        shape: (rows, cols).
        lies: whether the panel is on its side.

    Returns:
        The column (of the upright image); None if the sources are on no level circle, the
        turn is not full and even, or the axis leans by more than `MAX_LEAN_PX` over the
        image.
    """
    try:
        circle = circle_of(cone_vec)
    except GeometryError:
        return None
    if circle.rise or not circle.full or not _evenly_turned(circle):
        return None
    around = np.tile(circle.centre, (2, 1))
    height = cone_vec.source[0, 2]
    axis = np.column_stack(
        [around, height + 0.01 * circle.radius * np.array([-1.0, 1.0])]
    )
    columns, rows = np.median(cone_vec.project_points(axis, shape), axis=0).T
    tall = shape[0]
    if lies:
        columns, rows = rows, columns
        tall = shape[1]
    lean_px = tall * np.ptp(columns) / np.ptp(rows)
    middle = float(columns.mean())
    if np.isfinite(middle) and lean_px <= MAX_LEAN_PX:
        return middle
    return None


def _evenly_turned(circle: Circle) -> bool:
    """Check whether all directions have as many views: those of a turn and a half do not."""
    views, _ = np.histogram(circle.angle, SECTORS, (0.0, 2.0 * np.pi))
    return bool(views.max() <= MAX_UNEVEN_RATIO * views.min() + 1.0)
