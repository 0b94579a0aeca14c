"""Derived geometry: distances, magnification, voxel size, field of view, piercing point.

Everything is computed from nominal poses and an optional correction. Voxel size is
pixel * SOD / SDD (the thesis's formula has the ratio upside down).
"""

from __future__ import annotations

import math

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, PixelGrid
from flexdt.twin.scanner.state import Readout


def readout(
    poses: Poses, camera: CameraSettings, sensor: PixelGrid, parameters: Offsets = NOMINAL
) -> Readout | None:
    """Derived quantities of the first of `poses`.

    Args:
        poses: nominal poses, world frame.
        camera: decides the image's shape.
        sensor: decides the pixel pitch.
        parameters: the correction in force.

    Returns:
        The readout, or None where there is none: the axis or the detector is not in front of
        the focal spot.
    """
    cone = poses[:1].cone_vec(parameters)
    # The axis in the object's frame: through tau, whose direction tau_y does not matter here.
    tau = np.array([parameters.tau_x, parameters.tau_z, 0.0]) - poses.mount[0]
    return readout_of(cone, camera.shape, camera.pixels_mm(sensor), tau)


def readout_of(
    cone: ConeVec, shape: tuple[int, int], pixels_mm: tuple[float, float], axis: FloatArray
) -> Readout | None:
    """Derived quantities of the first view of a geometry, or None as `readout` has it.

    Args:
        cone: in the object's frame.
        shape: of the image, (rows, cols).
        pixels_mm: pitch along columns and along rows.
        axis: a point (3,) of the rotation axis, which is parallel to z [mm].
    """
    rows, cols = shape
    pixel, row_pixel = pixels_mm
    sdd = float(cone.source_detector_distance[0])
    sod = float((axis - cone.source[0]) @ cone.normal[0])
    if sod <= 0.0 or sdd <= 0.0:
        return None
    column, row = cone.piercing_points((rows, cols))[0]
    on_axis = [axis[0], axis[1], cone.source[0, 2]]
    axis_column = cone.project_points(on_axis, (rows, cols))[0, 0, 0]
    scale = sod / sdd
    up, down = (x * row_pixel / sdd for x in (row + 0.5, rows - 0.5 - row))
    return Readout(
        SOD_mm=sod,
        SDD_mm=sdd,
        magnification=sdd / sod,
        voxel_size_mm=pixel * scale,
        field_of_view_mm=(cols * pixel * scale, rows * row_pixel * scale),
        piercing_point_px=(float(column), float(row)),
        cone_angle_deg=math.degrees(math.atan(up) + math.atan(down)),
        axis_column_px=float(axis_column),
    )
