"""From the twin's state to positions in the world frame; in mm.

Positions come from motors and calibration profile as in `kinematics`, and the correction in
force is added as in `poses`, so the drawing shows the public geometry that `geometry.get`
states. The hidden misalignment is unknown here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial.transform import Rotation

from flexdt.protocol.state_model import CameraState, State
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import (
    FloatArray,
    from_unity,
    rotation_x,
    rotation_y,
    stage_rotation,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.panel_corners import panel_corners
from flexdt.twin.geometry.rigid import Rigid
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.scanner.state import StagePlacement

MM: Final = 0.001
"""Scene units (m) per mm: viser's renderer clips at 1 cm and 1 km."""


@dataclass(frozen=True, eq=False)
class World:
    """One moment of the public geometry, world frame.

    Attributes:
        view: geometry of an image of this moment, one row that knows its shape.
        source, detector: focal spot and center of the image (3,) [mm].
        u, v: step to the next column and to the next row (3,) [mm].
        axis: point of the rotation axis at the sample's reference height (3,) [mm].
        stage: from the object's frame to the world.
        sample: from the sample's own frame to the world.
        tube_shift, panel_shift: shift of source and detector by the correction (3,) [mm].
    """

    view: ConeVec
    source: FloatArray
    detector: FloatArray
    u: FloatArray
    v: FloatArray
    axis: FloatArray
    stage: Rigid
    sample: Rigid
    tube_shift: FloatArray
    panel_shift: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Image (rows, cols)."""
        return self.view.shape[1:]

    @property
    def cone_vec(self) -> ConeVec:
        """The geometry of an image of this moment, in the object's frame, one row."""
        return self.stage.inverse @ self.view

    @property
    def normal(self) -> FloatArray:
        """Unit normal of the detector, away from the source (3,)."""
        return self.view.normal.reshape(3)

    @property
    def distance(self) -> float:
        """Of the focal spot from the detector's plane [mm]."""
        return float(self.view.source_detector_distance[0])

    @property
    def foot(self) -> FloatArray:
        """Foot of the perpendicular from the focal spot (3,) [mm]."""
        return np.asarray(self.source + self.normal * self.distance)

    @property
    def piercing_px(self) -> FloatArray:
        """The piercing point (column, row), (2,) [px]."""
        return self.view.piercing_points().reshape(2)

    def pixel(self, column: float, row: float) -> FloatArray:
        """Compute the center of a pixel in the world's frame, (3,) [mm].

        The first one is (0, 0), at the top left.
        """
        rows, cols = self.shape
        across = column - (cols - 1) / 2
        down = row - (rows - 1) / 2
        return np.asarray(self.detector + across * self.u + down * self.v)

    @property
    def corners(self) -> FloatArray:
        """Outer corners of the image: top left, top right, bottom right, bottom left (4, 3)."""
        return np.asarray(panel_corners(self.view)[0])


def camera_of(machine: Machine, camera: CameraState) -> CameraSettings:
    """Convert the wire's camera settings to the twin's, with the machine's modes."""
    return CameraSettings(
        camera.mode,
        Roi(*camera.roi),
        camera.exposure_ms,
        camera.averages,
        camera.frames,
        machine.detector.camera.modes,
    )


def parameters_of(state: State) -> Offsets:
    """Return the offsets of the correction in force, or the nominal ones."""
    correction = state.correction
    if correction is None:
        return NOMINAL
    return Offsets.from_edge(correction.parameters)


def motors(machine: Machine, state: State) -> dict[str, float]:
    """Return motor -> position, without virtual axes."""
    return {n: a.position for n, a in state.axes.items() if n in machine.axes}


def world_of(machine: Machine, profile: Profile, state: State) -> World:
    """Compute the geometry of a state.

    With the correction in force, the motors' positions and the sample's offset on the stage.
    `machine` and `profile`: the twin's; `state`: as the twin sends it."""
    camera = camera_of(machine, state.camera)
    positions = motors(machine, state)
    offset = StagePlacement(**state.sample.offset.model_dump())
    return placed(machine, profile, camera, positions, parameters_of(state), offset)


def placed(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    positions: Mapping[str, float],
    p: Offsets = NOMINAL,
    offset: StagePlacement | None = None,
) -> World:
    """Compute the geometry for motor positions.

    Returns view, source, panel, axis, stage and sample in the world's frame [mm], and how
    far source and panel are shifted by the correction. The nominal geometry comes from
    `motor_poses`; the correction moves the axis by dO and tau, tilts and turns the stage,
    and shifts source and panel. The sample's pose is the stage's times its offset.

    Args:
        machine, profile: the twin's.
        camera: with the image's pixels.
        positions: motor -> position [mm, deg].
        p: the correction in force.
        offset: of the sample on the stage; None is none.
    """
    pose = motor_poses(machine, profile, camera, positions)
    tau = from_unity([p.tau_x, 0.0, p.tau_z])
    pivot = pose.axis[0] + from_unity([p.dO_x, p.dO_y, p.dO_z]) + tau
    tilt = rotation_y(p.axis_tilt_z) @ rotation_x(p.axis_tilt_x)
    turn = tilt @ stage_rotation(p.alpha + p.angle_scale * float(pose.angle[0]))
    stage = Rigid(turn, pivot + turn @ (pose.mount[0] - tau))
    # The rows are the authority on geometry: back from the object's frame to the world.
    view = stage @ pose.cone_vec(p).with_shape(camera.shape)
    if offset is None:
        at = StagePlacement()
    else:
        at = offset
    on_stage = Rigid(at.rotation, np.array([at.x, at.y, at.z]))
    source, detector, u, v = view.rows.reshape(4, 3)
    shifts = source - pose.source[0], detector - pose.detector[0]
    return World(view, source, detector, u, v, pivot, stage, stage @ on_stage, *shifts)


def quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Convert a rotation (3, 3) to (w, x, y, z)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return (w, x, y, z)


def beads_on(
    cone_vec: Sequence[float], beads: FloatArray, world: World, shape: tuple[int, ...]
) -> list[list[float]]:
    """Project bead centers (k, 3) [mm], sample's frame, into an image of `cone_vec`.

    Returns those within the image, in order, (column, row) [px]; centers of pixels are
    whole numbers. `cone_vec`: twelve numbers, with the correction in force.
    """
    points = world.stage.inverse @ world.sample @ beads
    rows = shape[0]
    cols = shape[1]
    pixels = ConeVec(np.asarray(cone_vec)).project_points(points, (rows, cols))[0]
    inside = (pixels > -0.5).all(axis=1) & (pixels < [cols - 0.5, rows - 0.5]).all(axis=1)
    return [[float(c), float(r)] for c, r in pixels[inside]]
