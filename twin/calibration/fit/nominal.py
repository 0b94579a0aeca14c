"""What calibration accepts as nominal geometry: poses, or cone_vec rows turned back into poses.

Where no detector shape is given, the one of the default machine's camera is used.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.description import builtin_machine

Shape = tuple[int, int] | FloatArray | None
"""Detector (rows, cols) of all frames, or (n, 2) of each; None is the default machine's camera."""


def frame_shapes(shape: Shape, frames: int) -> FloatArray:
    """Detector (rows, cols) of each frame, (n, 2).

    Raises:
        TwinError: `shape` is neither (2,) nor (n, 2).
    """
    value = builtin_machine().detector.camera.shape if shape is None else shape
    try:
        return np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), (frames, 2)))
    except ValueError:
        raise TwinError(
            f"shape {np.shape(value)} is neither (rows, cols) nor one pair for each of "
            f"{frames} frames"
        ) from None


def as_poses(geometry: Poses | ConeVec) -> Poses:
    """Poses of a nominal geometry.

    Raises:
        GeometryError: `Poses.from_cone_vec` cannot read the stage angles from the rows.
    """
    return geometry if isinstance(geometry, Poses) else Poses.from_cone_vec(geometry)
