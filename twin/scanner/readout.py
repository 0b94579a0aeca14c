"""Derived geometry: distances, magnification, voxel size, field of view, piercing point.

Everything is computed from nominal poses and an optional correction. Voxel size is
pixel * SOD / SDD (the thesis's formula has the ratio upside down).
"""

from __future__ import annotations

import math

import numpy as np

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
    rows, cols = camera.shape
    cone = poses[:1].cone_vec(parameters)
    sdd = float(cone.source_detector_distance[0])
    # The axis in the object's frame: through tau, whose direction tau_y does not matter here.
    tau = np.array([parameters.tau_x, parameters.tau_z, 0.0]) - poses.mount[0]
    sod = float((tau - cone.source[0]) @ cone.normal[0])
    if sod <= 0.0 or sdd <= 0.0:
        return None
    pixel, row_pixel = camera.pixels_mm(sensor)
    column, row = cone.piercing_points((rows, cols))[0]
    on_axis = [tau[0], tau[1], cone.source[0, 2]]
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
