"""What a volume, projected again, leaves of a scan's images."""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, forward
from flexdt.twin.projection.volume import Residuals
from flexdt.twin.reconstruction.coarse_scan import CoarseScan

MIN_COVERED = 0.95
"""Least share of the field of view, along each axis, that a volume covers which is projected;
in place of a smaller one a coarse volume of the field of view is."""


def residuals_of(volume: Volume, scan: CoarseScan) -> Residuals:
    """Project a volume as the views of a copy of its scan see it, and compare.

    Pixels are means of two by two rays. Voxels without a value count as 0.

    Args:
        volume: of the scan.
        scan: the copy.

    Raises:
        GeometryError: the volume is a part of the field of view, and FDK cannot use the
            copy.
    """
    own = _covers(volume, scan.grid)
    if own:
        thing = volume.like(np.nan_to_num(volume.data))
    else:
        thing = scan.grid.like(np.nan_to_num(scan.volume))
    count, rows, cols = scan.images.shape
    views = scan.cone_vec
    finer = ConeVec.from_vectors(
        views.source, views.detector, 0.5 * views.u, 0.5 * views.v
    )
    rays = forward(thing, finer, (2 * rows, 2 * cols))
    again = rays.reshape(count, rows, 2, cols, 2).mean(axis=(2, 4), dtype=np.float32)
    rest = scan.images - again
    if scan.circle.rise:  # the copy repeats the outermost rows
        rest = rest[:, 1:-1]
    return Residuals(rest, scan.numbers, scan.binned, own)


def _covers(volume: Volume, field: Volume) -> bool:
    """Return whether a volume holds the field of view."""
    low, high = volume.boxes[0]
    first, last = field.boxes[0]
    inside = np.minimum(high, last) - np.maximum(low, first)
    return bool((inside >= MIN_COVERED * (last - first)).all())
