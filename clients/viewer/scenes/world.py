"""From the twin's state to positions in the world frame, and to cameras; in mm.

Positions come from motors and calibration profile as in `kinematics`, and the correction in force
is added as in `poses`, so the drawing shows the public geometry that `geometry.get` states. The
hidden misalignment is unknown here.

What a page shows of it is each person's own choice (`Shown`).

The views: where each camera stands and, for the beam's eye, how the page crops it.

The overview holds focal spot, sample and image whatever their distances, and the sample's own view
the ball around it, both as large as the picture allows (`fitted`).

The beam's eye stands in the focal spot and looks along the detector's normal, so the panel is an
undistorted rectangle. Where the piercing point is off its centre the picture is rendered larger and
cropped by the page, since a browser's camera is symmetric. Units: m for viser, ratios for the page.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

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
from flexdt.twin.geometry.rigid import Rigid
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import motor_poses
from flexdt.twin.scanner.state import StagePlacement

MM = 0.001
"""Scene units (m) per mm: viser's renderer clips at 1 cm and 1 km."""
LAYERS: Final[Mapping[str, bool]] = {
    "beam": True, "axis": True, "panel": True, "ranges": False, "bodies": False, "margin": False,
    "sample": True, "machine": True, "orbit": True, "gizmos": False, "labels": False,
    "names": True, "cabinet": True,
}  # fmt: skip
"""Layer -> whether it is shown until somebody chooses."""

Nodes = Mapping[str, Mapping[str, Any]]
"""Name of a node -> its properties; `visible` is one of them."""


@dataclass(frozen=True)
class Shown:
    """The layers that are shown, and the opacity of the sample (0, 1]."""

    layers: frozenset[str] = frozenset(name for name, on in LAYERS.items() if on)
    opacity: float = 0.5

    def __contains__(self, layer: str) -> bool:
        return layer in self.layers

    def changed(self, opacity: float | None = None, **layers: bool | None) -> Shown:
        """The same, but for what is given.

        >>> sorted(Shown(frozenset(["beam", "axis"])).changed(axis=False, names=True).layers)
        ['beam', 'names']
        """
        on = {name for name, wanted in layers.items() if wanted}
        off = {name for name, wanted in layers.items() if wanted is False}
        opaque = self.opacity if opacity is None else opacity
        return replace(self, layers=self.layers - off | on, opacity=opaque)

    @property
    def told(self) -> dict[str, object]:
        """For the page."""
        return {"shown": {name: name in self for name in LAYERS}, "opacity": self.opacity}


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


Vector = tuple[float, float, float]
WIDEST = 3.0
"""The beam's eye is rendered at most this many times as wide or high as the panel; beyond, the
camera looks at the panel's centre instead and the frame is no longer exact."""


@dataclass(frozen=True)
class Standpoint:
    """A camera: metres, and its vertical opening angle [rad]."""

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


WIDE = 1.35
"""Aspect (width over height) for which cameras are made; narrower pictures open wider (`roomy`)."""
ROOM = 0.86
"""Part of the picture, in width and height, that what is fitted takes."""
TUBE_MM = 60.0
"""Of the tube behind its focal spot that the overview shows."""
ISO_WAY, ISO_FOV = (-0.5, 0.75, -0.42), math.radians(38.0)
SAMPLE_WAY, SAMPLE_FOV = (-0.62, 0.68, -0.39), math.radians(30.0)
SIDE = Standpoint((3.15, 0.52, 0.1), (0.0, 0.52, 0.1), (0.0, 0.0, 1.0), math.radians(30.0))
FREE = Standpoint((-0.95, 0.1, 0.52), (0.0, 0.72, 0.0), (0.0, 0.0, 1.0), math.radians(45.0))
FIXED = {"side": SIDE, "free": FREE}
"""View -> camera, for those that do not depend on the machine's pose."""


def presets(world: World, radius_mm: float) -> dict[str, Standpoint]:
    """View -> the camera that it opens with, for all but the beam's eye.

    Args:
        world: the machine's pose.
        radius_mm: of the ball around the sample.
    """
    middle = world.sample.shift
    ball = middle + max(radius_mm, 5.0) * np.concatenate([np.eye(3), -np.eye(3)])
    tube = world.source + TUBE_MM * np.outer((0.0, 1.0), (0.0, -1.0, 0.0))
    whole = np.concatenate([tube, ball, world.corners])
    iso = fitted(whole * MM, ISO_WAY, ISO_FOV, middle * MM)
    return {**FIXED, "iso": iso, "sample": fitted(ball * MM, SAMPLE_WAY, SAMPLE_FOV, middle * MM)}


def fitted(points: FloatArray, way: Vector, fov: float, around: FloatArray) -> Standpoint:
    """The nearest camera that looks along `way` and holds all points; up is +z.

    Args:
        points: (n, 3) [m].
        way: direction of the look.
        fov: vertical opening of a picture that is `WIDE` [rad].
        around: (3,) [m], what turns of the camera keep at their distance.
    """
    ahead = np.asarray(way) / np.linalg.norm(way)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, ahead), ahead])
    seen = points @ axes.T
    eye, back = np.zeros(3), []
    for k, aspect in ((0, WIDE), (1, 1.0)):
        slope = ROOM * aspect * math.tan(0.5 * fov)
        # On the left each point wants x - eye >= -slope * (depth - eye's depth); right likewise.
        left = (seen[:, k] + slope * seen[:, 2]).min()
        right_of = (seen[:, k] - slope * seen[:, 2]).max()
        back.append((left - right_of) / (2.0 * slope))
        eye[k] = 0.5 * (left + right_of)
    eye[2] = min(back)
    position = eye @ axes
    target = position + ahead * ((around - position) @ ahead)
    return Standpoint(_vector(position), _vector(target), (0.0, 0.0, 1.0), fov)


def roomy(camera: Standpoint, aspect: float) -> Standpoint:
    """The camera with as wide an opening in a narrow picture as in one that is `WIDE`."""
    wider = max(1.0, WIDE / max(aspect, 0.3))
    return replace(camera, fov=2.0 * math.atan(wider * math.tan(0.5 * camera.fov)))


def beam_view(world: World) -> tuple[Standpoint, dict[str, object]]:
    """The beam's eye of a geometry, and how a page crops it to show the image and nothing else.

    Lengths for the page are in units of the image's width: the picture is `width` x `height`, and
    the image, 1 x `aspect`, has its top left corner `left`, `top` inside it; the sample stands
    `sample_height_mm` above the focal spot. Where not `exact` the eye looks at the panel's middle.
    """
    rows, cols = world.shape
    pu, pv = float(np.linalg.norm(world.u)), float(np.linalg.norm(world.v))
    column, row = world.piercing_px.tolist()
    width, height = cols * pu, rows * pv
    left, top = (column + 0.5) * pu, (row + 0.5) * pv
    half_w, half_h = max(left, width - left), max(top, height - top)
    exact = 2.0 * half_w <= WIDEST * width and 2.0 * half_h <= WIDEST * height
    if exact:
        target, far = world.foot, world.distance
    else:
        left, top, half_w, half_h = 0.5 * width, 0.5 * height, 0.5 * width, 0.5 * height
        target, far = world.detector, float(np.linalg.norm(world.detector - world.source))
    up = tuple((-world.v / pv).tolist())
    eye = Standpoint(_m(world.source), _m(target), up, 2.0 * math.atan2(half_h, far))
    return eye, {
        "width": 2.0 * half_w / width,
        "height": 2.0 * half_h / width,
        "left": (half_w - left) / width,
        "top": (half_h - top) / width,
        "aspect": height / width,
        "exact": exact,
        "sample_height_mm": float(world.axis[2] - world.source[2]),
    }


def _m(point: FloatArray) -> Vector:
    return _vector(point * MM)


def _vector(point: FloatArray) -> Vector:
    x, y, z = point.tolist()
    return (x, y, z)
