"""From the twin's state to positions in the world frame: what the scene draws, in mm.

Positions come from motors and calibration profile as in `kinematics`, and the correction in force
is added as in `poses`, so the drawing shows the public geometry that `geometry.get` states. The
hidden misalignment is unknown here.

A scrubbed plan is a blue ghost of the machine and the focal spot's path, drawn for the viser
clients of one page alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from flexdt.clients.viewer.scenes import parts as bodies
from flexdt.clients.viewer.scenes import sample as solids
from flexdt.clients.viewer.scenes.sample import MM
from flexdt.protocol.state_model import CameraState, State
from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import (
    FloatArray,
    from_unity,
    rotation_x,
    rotation_y,
    stage_rotation,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.rigid import Rigid
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.scanner.state import StagePlacement


@dataclass(frozen=True, eq=False)
class World:
    """One moment of the public geometry, world frame.

    Attributes:
        view: geometry of an image of this moment, one row that knows its shape.
        source, detector: focal spot and centre of the image (3,) [mm].
        u, v: step to the next column and to the next row (3,) [mm].
        axis: point of the rotation axis at the sample's reference height (3,) [mm].
        stage: from the object's frame to the world.
        sample: from the sample's own frame to the world.
        tube_shift, panel_shift: what the correction adds to source and detector (3,) [mm].
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
        """The piercing point: foot of the perpendicular from the focal spot (3,) [mm]."""
        return np.asarray(self.source + self.normal * self.distance)

    @property
    def piercing_px(self) -> FloatArray:
        """The piercing point in pixels (column, row), (2,)."""
        return self.view.piercing_points().reshape(2)

    def pixel(self, column: float, row: float) -> FloatArray:
        """Centre of a pixel (3,) [mm]."""
        rows, cols = self.shape
        across, down = column - (cols - 1) / 2, row - (rows - 1) / 2
        return np.asarray(self.detector + across * self.u + down * self.v)

    @property
    def corners(self) -> FloatArray:
        """Outer corners of the image: top left, top right, bottom right, bottom left (4, 3)."""
        rows, cols = self.shape
        a, b = self.u * cols / 2, self.v * rows / 2
        return np.asarray(self.detector + [-a - b, a - b, a + b, b - a])


def camera_of(machine: Machine, camera: CameraState) -> CameraSettings:
    """The twin's camera settings of the wire's."""
    return CameraSettings(
        camera.mode, Roi(*camera.roi), camera.exposure_ms, camera.averages, camera.frames,
        machine.detector.camera.modes,
    )  # fmt: skip


def parameters_of(state: State) -> Offsets:
    """The correction in force, or none."""
    correction = state.correction
    return NOMINAL if correction is None else Offsets.from_edge(correction.parameters)


def motors(machine: Machine, state: State) -> dict[str, float]:
    """Motor -> position, without virtual axes."""
    return {n: a.position for n, a in state.axes.items() if n in machine.axes}


def world_of(machine: Machine, profile: Profile, state: State) -> World:
    """Where everything is.

    Args:
        machine, profile: the twin's.
        state: as the twin sends it.
    """
    camera, positions = camera_of(machine, state.camera), motors(machine, state)
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
    """Where everything is.

    Args:
        machine, profile: the twin's.
        camera: says the image's pixels.
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
    at = StagePlacement() if offset is None else offset
    on_stage = Rigid(at.rotation, np.array([at.x, at.y, at.z]))
    source, detector, u, v = view.rows.reshape(4, 3)
    shifts = source - pose.source[0], detector - pose.detector[0]
    return World(view, source, detector, u, v, pivot, stage, stage @ on_stage, *shifts)


def quaternion(rotation: FloatArray) -> tuple[float, float, float, float]:
    """Rotation (3, 3) as (w, x, y, z)."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return (w, x, y, z)


def beads_on(
    cone_vec: Sequence[float], beads: FloatArray, world: World, shape: tuple[int, ...]
) -> list[list[float]]:
    """Where bead centres appear in an image of geometry `cone_vec` (object's frame).

    Args:
        cone_vec: twelve numbers, with the correction in force.
        beads: (k, 3) [mm], the sample's own frame.
        world: says how the sample stands on the stage.
        shape: (rows, cols) of the image.

    Returns:
        Those within the image, (column, row) in pixels.
    """
    points = world.stage.inverse @ world.sample @ beads
    rows, cols = shape[0], shape[1]
    pixels = ConeVec(np.asarray(cone_vec)).project_points(points, (rows, cols))[0]
    inside = (pixels > -0.5).all(axis=1) & (pixels < [cols - 0.5, rows - 0.5]).all(axis=1)
    return [[float(c), float(r)] for c, r in pixels[inside]]


SCREEN: Any = {"thickness_units": "screen"}
"""Lines have a width in pixels."""
GHOST = (60, 130, 255)
PATH = (90, 120, 255)
HOME = "/object/plan"
"""The node that holds the paths in all scenes: one switch for all of them."""
ORBIT = f"{HOME}/orbit"
RAY, RAY_COLOR = "/ray", (255, 60, 160)


class PlanDrawing:
    """Ghosts and paths in clients' own scenes.

    Args:
        machine: whose parts.
        collision: its collision bodies.
    """

    def __init__(self, machine: Machine, collision: CollisionScene) -> None:
        self._collision = collision
        moving = {part.name for part in machine.components if machine.chain(part)}
        self._moving = [body for body in collision.bodies if body.name in moving]

    def ghost(self, clients: Sequence[viser.ClientHandle], positions: Mapping[str, float]) -> None:
        """Show some clients where the moving parts would be for motor positions [mm, deg]."""
        q = self._collision.vector(positions)
        for client in clients:
            with client.atomic():
                if client.scene.get_handle_by_name("/ghost") is None:
                    client.scene.add_frame("/ghost", show_axes=False)
                for body in self._moving:
                    name = f"/ghost/{body.name}"
                    turn = quaternion(body.rotation(float(q @ body.turns)))
                    at = tuple(((body.origin + q @ body.slides) * MM).tolist())
                    handle = client.scene.get_handle_by_name(name)
                    if handle is None:
                        vertices, faces = solids.plain(bodies.bare(body.solid))
                        client.scene.add_mesh_simple(
                            name, vertices, faces, color=GHOST, opacity=0.28,
                            side="double", cast_shadow=False, receive_shadow=False,
                            wxyz=turn, position=at,
                        )  # fmt: skip
                    else:
                        handle.wxyz, handle.position = turn, at

    def unghost(self, clients: Iterable[viser.ClientHandle]) -> None:
        """Show them no longer."""
        _remove(clients, "/ghost")

    def orbit(self, clients: Sequence[viser.ClientHandle], points: FloatArray | None) -> None:
        """Show some clients the focal spot's path as the sample sees it; None: no longer.

        Args:
            clients: that see it.
            points: (n, 3) [mm], object frame.
        """
        steps = None if points is None else np.stack([points[:-1], points[1:]], axis=1)
        _draw_lines(clients, ORBIT, steps, PATH, 1.5)

    def ray(self, clients: Sequence[viser.ClientHandle], ends: FloatArray | None) -> None:
        """Show some clients a ray, (2, 3) [mm, world]; None: no longer."""
        _draw_lines(clients, RAY, None if ends is None else ends[None], RAY_COLOR, 3.0)


def _draw_lines(
    clients: Sequence[viser.ClientHandle], name: str, lines: FloatArray | None,
    color: tuple[int, int, int], px: float,
) -> None:  # fmt: skip
    """Lines (n, 2, 3) [mm] in place of those that clients had under this name; None for none."""
    _remove(clients, name)
    if lines is not None and len(lines):
        for client in clients:
            client.scene.add_line_segments(name, lines * MM, color, thickness=px, **SCREEN)


def _remove(clients: Iterable[viser.ClientHandle], name: str) -> None:
    for client in clients:
        handle = client.scene.get_handle_by_name(name)
        if handle is not None:
            handle.remove()
