"""Outer corners of the panel in each view of a geometry."""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray


def panel_corners(cone_vec: ConeVec) -> FloatArray:
    """Compute the outer corners of the panel, (n, 4, 3) [mm].

    As the source sees them: top left (row 0, column 0), top right, bottom right, bottom
    left. GeometryError without the detector's shape.
    """
    _, rows, cols = cone_vec.shape
    across, down = cone_vec.u * cols / 2, cone_vec.v * rows / 2
    offsets = np.stack(
        [-across - down, across - down, across + down, down - across], axis=1
    )
    return np.asarray(cone_vec.detector[:, None] + offsets)
