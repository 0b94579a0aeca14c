"""The values that describe a scanner at one moment: plain, frozen, comparable;
and their changes.

They describe tube, sample, safety state and the scanner. `scanner.ScannerTwin`, the one
mutable object, returns them. A hidden misalignment is never part of them. Settings of
tube and camera change by pure functions, old value and request to new value, which raise
without a change.

`readout` is derived geometry: distances, magnification, voxel size, field of view,
piercing point. Everything is computed from nominal poses and an optional correction.
Voxel size is pixel * SOD / SDD (the thesis's formula has the ratio upside down).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final, Literal, TypedDict

import numpy as np

from flexdt.twin.errors import GeometryError, LimitError
from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.conventions import (
    FloatArray,
    cross,
    rotation_x,
    rotation_y,
    rotation_z,
    turn_detector,
)
from flexdt.twin.geometry.offsets import NOMINAL, Offsets, require_plausible
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.geometry.poses import Poses
from flexdt.twin.machine.camera import CameraSettings, PixelGrid, Roi, check_roi
from flexdt.twin.machine.description import DetectorSpec, Machine, Profile, TubeSpec
from flexdt.twin.machine.kinematics import motor_poses

SafetyName = Literal["ready", "blocked", "estopped"]


UNITS_OF_SETTINGS: Final = {"kV": " kV", "power_W": " W", "exposure_ms": " ms"}
"""Unit behind the limits of a setting."""


@dataclass(frozen=True)
class AxisReading:
    """One motor or `virtual` axis: mm or deg, per second; the fields are those of the wire."""

    position: float
    target: float
    velocity: float
    moving: bool
    limits: tuple[float, float]
    speed: float
    acceleration: float
    unit: str
    virtual: bool = False


@dataclass(frozen=True)
class TubeSettings:
    """The X-ray tube's settings, and when it was switched.

    Attributes:
        kV, power_W: settings.
        on: high voltage is on; the image stays dark until X-rays are ready.
        since: time of the last switch [s]; a twin begins with a tube that was in use till
            then.
        ready_at: time from which X-rays are stable, while on [s].
    """

    kV: float
    power_W: float
    on: bool = False
    since: float = -math.inf
    ready_at: float = -math.inf

    def ready(self, now: float) -> bool:
        """Return whether X-rays are on and stable."""
        return self.on and now >= self.ready_at

    def ready_in_s(self, now: float) -> float | None:
        """Return the time until they are [s]; None while the tube is off."""
        if self.on:
            return max(0.0, self.ready_at - now)
        return None


@dataclass(frozen=True)
class StagePlacement:
    """Placement of the sample on the stage: shift [mm], then turns about x, y, z [deg].

    A point p of the sample is at R_z R_y R_x p + (x, y, z) in the object's frame; all
    turns are right-handed (the order is assumed).
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0

    def __post_init__(self) -> None:
        """Check that every offset is finite; raise LimitError, which names the first that is
        not.
        """
        for f in fields(self):
            if not math.isfinite(getattr(self, f.name)):
                what = f"sample offset {f.name} is {getattr(self, f.name)}; it must be finite"
                raise LimitError(
                    what, {"asked": str(getattr(self, f.name)), "setting": f.name}
                )

    @property
    def rotation(self) -> FloatArray:
        """Turn of the sample on the stage, object from sample frame, (3, 3)."""
        rx, ry, rz = (math.radians(a) for a in (self.rx, self.ry, self.rz))
        turned: FloatArray = rotation_z(rz) @ rotation_y(ry) @ rotation_x(rx)
        return turned

    def to_sample(self, cone_vec: ConeVec) -> ConeVec:
        """Transform a geometry of the object's frame to the sample's own, by its
        placement.
        """
        if self == StagePlacement():
            return cone_vec
        back = self.rotation.T
        return cone_vec.moved(back, -back @ [self.x, self.y, self.z])


EMPTY_STAGE: Final = "empty"
"""Name by which users put nothing on the stage."""


@dataclass(frozen=True)
class Sample:
    """The sample on the stage, by name; "" is an empty stage."""

    name: str = ""
    offset: StagePlacement = field(default_factory=StagePlacement)
    material: str | None = None


@dataclass(frozen=True)
class NamedCorrection:
    """A dated, named, immutable calibration result: true minus nominal, added to nominal.

    Attributes:
        name: unique among the corrections of an installation.
        date: ISO 8601.
        parameters: the offsets [mm, rad].
        note: its origin (data set, phantom, residual).
        panel: the distortion that was found along with it; None: none. It is undone in
            images, and no state of the twin has it.
        sides_known: it was found from beads of known places in images of this geometry,
            which tell the direction of rotation and mirrored images.
    """

    name: str
    date: str
    parameters: Offsets = NOMINAL
    note: str = ""
    panel: Panel | None = None
    sides_known: bool = False

    @classmethod
    def from_edge(
        cls,
        name: str,
        date: str,
        values: Mapping[str, float],
        note: str,
        *,
        sides_known: bool = False,
    ) -> NamedCorrection:
        """Make the correction of values [mm, deg]. Raises UnknownNameError."""
        parameters = Offsets.from_edge(values)
        return cls(name, date, parameters, note, sides_known=sides_known)


@dataclass(frozen=True)
class Safety:
    """The safety state: ready, blocked (too many blocked attempts) or estopped.

    Attributes:
        state: which of the three.
        blocked_attempts: motions in a row that a contact cut short.
        max_blocked_attempts: at so many the state becomes blocked.
        reason: why it is not ready, as a message.
        stop: number of the latest E-stop or block; each has the next one.
        stopped_by: connection that pressed the E-stop in force; "" if there is none or it
            is unknown.
        contact: two parts that touch, or are closer than the safety margin; a reset does
            not end that, and only motions that bring no such pair nearer are allowed.
    """

    state: SafetyName = "ready"
    blocked_attempts: int = 0
    max_blocked_attempts: int = 3
    reason: str = ""
    stop: int = 0
    stopped_by: str = ""
    contact: tuple[str, str] | None = None


@dataclass(frozen=True)
class Readout:
    """Derived quantities of one geometry, as scanners show them; the fields are
    those of the wire.

    Attributes:
        SOD_mm: source-object distance along the beam.
        SDD_mm: source-detector distance along the beam.
        magnification: SDD / SOD.
        voxel_size_mm: binned pixel pitch * SOD / SDD.
        field_of_view_mm: (width, height) of the image, scaled back to the rotation axis.
        piercing_point_px: (column, row) of the foot of the perpendicular from the focal
            spot.
        cone_angle_deg: full vertical opening angle.
        axis_column_px: column of the rotation axis at the height of the focal spot.
    """

    SOD_mm: float
    SDD_mm: float
    magnification: float
    voxel_size_mm: float
    field_of_view_mm: tuple[float, float]
    piercing_point_px: tuple[float, float]
    cone_angle_deg: float
    axis_column_px: float


@dataclass(frozen=True)
class ScannerState:
    """Everything public about a scanner at `time` [s of the twin's clock]."""

    time: float
    axes: Mapping[str, AxisReading]
    tube: TubeSettings
    camera: CameraSettings
    sample: Sample
    readout: Readout | None
    safety: Safety
    correction: NamedCorrection | None
    moving: bool


def readout(
    poses: Poses, camera: CameraSettings, sensor: PixelGrid, parameters: Offsets = NOMINAL
) -> Readout | None:
    """Compute derived quantities of the first of `poses` with the correction's
    `parameters`.

    None where axis or detector are not in front of the focal spot.
    """
    cone = poses[:1].cone_vec(parameters)
    # The axis in the object's frame: through tau, whose direction tau_y does not matter here.
    tau = np.array([parameters.tau_x, parameters.tau_z, 0.0]) - poses.mount[0]
    return readout_of(cone, camera.shape, camera.pixels_mm(sensor), tau)


def readout_of(
    cone: ConeVec,
    shape: tuple[int, int],
    pixels_mm: tuple[float, float],
    axis: FloatArray,
) -> Readout | None:
    """Compute derived quantities of the first view of a geometry.

    Voxel and field are at the axis [mm], the cone angle up and down [deg], piercing point
    and axis column in pixels.

    Args:
        cone: in the object's frame.
        shape: of the image, (rows, cols).
        pixels_mm: pitch along columns and along rows.
        axis: a point (3,) of the rotation axis, which is parallel to z [mm].

    Returns:
        Distances, magnification, voxel and field; None where SOD or SDD is not positive.
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


class CameraChange(TypedDict, total=False):
    """Settings of the camera to change; those left out, or None, stay."""

    exposure_ms: float | None
    mode: str | None
    roi: Roi | None
    averages: int | None
    frames: int | None


def switched(
    machine: Machine, tube: TubeSettings, on: bool, now: float | None, *, warm: bool
) -> TubeSettings:
    """Switch the tube on or off at `now` [s]; None: it is ready already.

    X-rays are ready after the times of switching on and stabilising, and of the warm-up
    if the tube rested longer than `cold_after_s`, unless `warm`. Its present state again
    changes nothing, unless `now` is None.
    """
    if now is None:
        return replace(tube, on=on, ready_at=-math.inf)
    if on == tube.on:
        return tube
    if not on:
        return replace(tube, on=False, since=now)
    timing = machine.timing
    spec = machine.tube
    rested = now - tube.since > spec.cold_after_s
    takes = timing.xrayon_s + timing.xray_ready_s
    if rested and not warm:
        takes += spec.warm_up_s
    return replace(tube, on=True, since=now, ready_at=now + takes)


def changed_tube(
    spec: TubeSpec, tube: TubeSettings, kV: float | None, power_W: float | None
) -> TubeSettings:
    """Change voltage [kV] or power [W] of a tube; None keeps it.

    X-rays stay as they are; the tube itself is not changed.

    Raises:
        LimitError: outside the tube's range; the message names the setting.
    """
    if kV is None:
        kV = tube.kV
    if power_W is None:
        power_W = tube.power_W
    new = replace(tube, kV=kV, power_W=power_W)
    _require_within("tube", "kV", new.kV, spec.min_kV, spec.max_kV)
    _require_within("tube", "power_W", new.power_W, 0.0, spec.max_W)
    return new


def changed_camera(
    spec: DetectorSpec, camera: CameraSettings, change: CameraChange
) -> CameraSettings:
    """Change settings of a camera; those left out stay.

    `spec`: the detector, with its modes, pixels and range of exposures [ms]. `camera`: settings
    before. `change`: the new values; None and what is left out stay. Averages are 1 to 10 000,
    frames 1 to 1 000 000.
    Returns the new settings.
    Raises LimitError: an unknown mode, a region outside the panel, or a number outside its
    range; the message names the setting.
    """
    stated: dict[str, Any] = {name: x for name, x in change.items() if x is not None}
    new = replace(camera, **stated)
    spec.check_mode(new.mode)
    check_roi(new.roi, spec.pixels, new.binning)
    least = spec.min_exposure_ms
    longest = spec.max_exposure_ms
    _require_within("camera", "exposure_ms", new.exposure_ms, least, longest)
    _require_within("camera", "averages", new.averages, 1, 10_000)
    _require_within("camera", "frames", new.frames, 1, 1_000_000)
    return new


def _require_within(
    device: str, name: str, value: float, lower: float, upper: float
) -> None:
    """Raise LimitError unless `lower` <= `value` <= `upper`; a value that is not a number fails."""
    if not lower <= value <= upper:
        unit = UNITS_OF_SETTINGS.get(name, "")
        what = f"{device} {name} {value:g} is outside [{lower:g}, {upper:g}]{unit}"
        raise LimitError(
            what, {"setting": name, "asked": value, "allowed": [lower, upper]}
        )


BEFORE_SOURCE_MM: Final = 1e-6
"""Least distance of axis and panel before the source [mm]: more than the rounding of one."""


def require_applicable(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    correction: NamedCorrection | None,
) -> None:
    """Check that a correction leaves a possible geometry, anywhere in the travel.

    None checks the nominal one. Raises GeometryError: as `require_before_source`.
    """
    if correction is None:
        what = "the machine file's travel"
        require_before_source(machine, profile, camera, NOMINAL, what)
    else:
        offsets = correction.parameters
        require_before_source(machine, profile, camera, offsets, "the correction")


def require_before_source(
    machine: Machine,
    profile: Profile,
    camera: CameraSettings,
    offsets: Offsets,
    cause: str,
) -> None:
    """Check that offsets leave a geometry that a scanner can have, anywhere in the travel.

    Each offset is plausible beside the machine's longest linear travel; rotation axis and panel
    are before the source at every pose of the travel, whatever the region of interest; and the
    rows are of the camera's pixels.

    Args:
        machine: with the travel of its motors.
        profile: zero offsets.
        camera: settings in force.
        offsets: correction, or true misalignment.
        cause: of the geometry, for the message.

    Raises GeometryError: it does not; the message names the offset, or the positions of the
    motors at the worst pose.
    """
    travels = (a.upper - a.lower for a in machine.axes.values() if a.unit == "mm")
    require_plausible(offsets, max(travels, default=math.inf))
    whole = Roi(
        0, 0, machine.detector.pixels.columns - 1, machine.detector.pixels.rows - 1
    )
    everywhere = replace(camera, roi=whole)
    for what, pose, mm in least_before_source(machine, profile, everywhere, offsets):
        if mm > BEFORE_SOURCE_MM:
            continue
        place = ", ".join(f"{name} {x:g}" for name, x in pose.items())
        raise GeometryError(
            f"{cause} puts the {what} behind the source ({mm:.4g} mm before it) at {place}",
            {"check": "sod", "pose": pose, "asked": mm, "allowed": "> 0 at every pose"},
        )
    home = motor_poses(machine, profile, camera, {}).cone_vec(offsets)
    check_cone_vec(home, camera.pixels_mm(machine.detector.pixels))


def least_before_source(
    machine: Machine, profile: Profile, camera: CameraSettings, offsets: Offsets
) -> Iterator[tuple[str, dict[str, float], float]]:
    """Yield what must be before the source, the pose of the travel at which it is least
    so, and how far there [mm].

    The three distances are affine in the positions of the motors: no motor turns source
    or panel, so that the panel's normal n and the tilted axis's direction t are the same
    at every pose, and a turntable moves no point of its axis. Between the source and the
    axis, the vector w is affine, and so are n . w (SOD), n . (w - (t . w) t) (the point
    of the axis at the source's height) and the panel's n . d. An affine function has its
    least value over a box in a corner, and which end of each travel that is does not
    depend on the other motors: two poses of each motor tell it. A region of interest
    shifts the panel's center in its untilted plane, which with a yaw counts along the
    beam: the farthest shift, half a panel, is taken away.

    Yields:
        Name; motor -> position [mm, deg], of those that matter; distance [mm].
    """
    names = list(machine.axes)
    ends = [machine.axes[name] for name in names]
    standing = np.array([a.home for a in ends])
    lower = np.array([a.lower for a in ends])
    upper = np.array([a.upper for a in ends])
    tried = np.tile(standing, (2 * len(names), 1))
    each = np.arange(len(names))
    tried[each, each] = lower
    tried[len(names) + each, each] = upper

    def distances(positions: FloatArray) -> FloatArray:
        """Compute the three distances of each pose (n, motors): (n, 3) [mm]."""
        columns = dict(zip(names, positions.T, strict=True))
        return _before_source(
            machine, motor_poses(machine, profile, camera, columns), offsets
        )

    at_lower, at_upper = np.split(distances(tried), 2)
    for k, what in enumerate(
        ("rotation axis", "rotation axis at the source's height", "panel")
    ):
        change = at_upper[:, k] - at_lower[:, k]
        matters = np.abs(change) > BEFORE_SOURCE_MM
        worst = np.where(change > 0.0, lower, upper)
        worst = np.where(matters, worst, standing)
        pose = {
            name: float(x) for name, x, m in zip(names, worst, matters, strict=True) if m
        }
        yield what, pose, float(distances(worst[None])[0, k])


def _before_source(machine: Machine, poses: Poses, offsets: Offsets) -> FloatArray:
    """Compute how far axis, axis at the source's height, and the panel under its least
    favorable region of interest are before the source, (n, 3) [mm].

    Args:
        machine: has the sensor's size.
        poses: nominal, n, with the whole sensor read out.
        offsets: to be added.
    """
    cone = poses.cone_vec(offsets)
    beam = np.array([offsets.tau_x, offsets.tau_z, 0.0]) - poses.mount - cone.source
    level = beam * [1.0, 1.0, 0.0]
    turned = cross(
        *turn_detector(
            poses.u, poses.v, offsets.det_yaw, offsets.det_pitch, offsets.det_roll
        )
    )
    along = np.abs(np.einsum("nki,ni->nk", np.stack([poses.u, poses.v], axis=1), turned))
    halves = 0.5 * np.array(machine.detector.pixels.size_mm)
    pitches = np.linalg.norm(turned, axis=1, keepdims=True) * np.stack(
        [np.linalg.norm(poses.u, axis=1), np.linalg.norm(poses.v, axis=1)], axis=1
    )
    shift = (along / pitches) @ halves
    return np.stack(
        [
            np.einsum("ni,ni->n", beam, cone.normal),
            np.einsum("ni,ni->n", level, cone.normal),
            cone.source_detector_distance - shift,
        ],
        axis=1,
    )
