"""What calibration accepts as nominal geometry: poses, or cone_vec rows turned back into poses.

Where no detector shape is given, the one of the default machine's camera is used.
"""

from __future__ import annotations

import numpy as np

from flexdt.twin.errors import GeometryError, TwinError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, stage_rotation
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

    For `ConeVec` the world's directions are taken from the rows: the detector's steps are
    untilted up to a roll about the beam, so the stage angle is the direction of u in the
    horizontal plane, unwrapped in frame order; the rotation axis is the rows' origin.

    Raises:
        GeometryError: the rows do not turn about the vertical (u has no horizontal part).
    """
    if isinstance(geometry, Poses):
        return geometry
    flat = np.hypot(geometry.u[:, 0], geometry.u[:, 1])
    if (flat < 1e-6 * np.linalg.norm(geometry.u, axis=1)).any():
        i = int(np.argmin(flat))
        raise GeometryError(
            f"cone_vec row {i}: u is vertical, so the stage angle cannot be read from it; give "
            "Poses instead",
            {"row": i},
        )
    # stage_rotation(phi)^-1 turns +x to (cos phi, sin phi).
    angle = np.unwrap(np.arctan2(geometry.u[:, 1], geometry.u[:, 0]))
    world = geometry.moved(stage_rotation(angle), np.zeros(3))
    axis = np.zeros((len(geometry), 3))
    return Poses(world.source, axis, world.detector, world.u, world.v, angle)
