"""The values a scanner is described by at one moment: plain, frozen, comparable.

What a tube, a sample, a safety state and a whole scanner look like when somebody asks. It refuses
to change anything: the one mutable object is `scanner.ScannerTwin`, which hands these out. No
hidden misalignment is ever part of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Literal

from flexdt.twin.camera import CameraSettings
from flexdt.twin.conventions import FloatArray, rotation_x, rotation_y, rotation_z
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry import ConeVec
from flexdt.twin.machine import Machine
from flexdt.twin.parameters import NOMINAL, Parameters

SafetyName = Literal["ready", "blocked", "estopped"]


@dataclass(frozen=True)
class AxisState:
    """One motor, or a virtual axis (then `motor` is False): mm or deg, per second."""

    position: float
    target: float
    velocity: float
    moving: bool
    lower: float
    upper: float
    speed: float
    acceleration: float
    unit: str
    motor: bool = True


@dataclass(frozen=True)
class TubeState:
    """The X-ray tube's settings, and when it was switched.

    Attributes:
        kV, power_W: settings.
        on: high voltage is on; the image stays dark until X-rays are ready.
        since: time of the last switch [s]; a twin begins with a tube that was in use till then.
        ready_at: time from which X-rays are stable, while on [s].
    """

    kV: float
    power_W: float
    on: bool = False
    since: float = -math.inf
    ready_at: float = -math.inf

    def ready(self, now: float) -> bool:
        """Whether X-rays are on and stable."""
        return self.on and now >= self.ready_at

    def ready_in_s(self, now: float) -> float | None:
        """Seconds until they are; None while the tube is off."""
        return max(0.0, self.ready_at - now) if self.on else None


def switched(machine: Machine, tube: TubeState, on: bool, now: float, *, warm: bool) -> TubeState:
    """`tube` after it is switched on or off.

    Args:
        machine: says how long the high voltage takes, and a warm-up after a long rest.
        tube: before; switching on what is on changes nothing.
        on: which.
        now: time of the command [s].
        warm: no warm-up, however long the rest was.
    """
    if on == tube.on:
        return tube
    if not on:
        return replace(tube, on=False, since=now)
    timing, spec = machine.timing, machine.tube
    rested = now - tube.since > spec.cold_after_s
    takes = timing.xrayon_s + timing.xray_ready_s
    if rested and not warm:
        takes += spec.warm_up_s
    return replace(tube, on=True, since=now, ready_at=now + takes)


@dataclass(frozen=True)
class Offset:
    """Where the sample sits on the stage: shift [mm], then turns about x, y, z [deg].

    A point p of the sample lies at R_z R_y R_x p + (x, y, z) in the object's frame; all turns are
    right-handed (the order is assumed).
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0

    def __post_init__(self) -> None:
        for f in fields(self):
            if not math.isfinite(getattr(self, f.name)):
                raise LimitError(
                    f"sample offset {f.name} is {getattr(self, f.name)}; it must be finite",
                    {"asked": str(getattr(self, f.name)), "setting": f.name},
                )

    @property
    def rotation(self) -> FloatArray:
        """T_object_sample, rotation part, (3, 3)."""
        rx, ry, rz = (math.radians(a) for a in (self.rx, self.ry, self.rz))
        turned: FloatArray = rotation_z(rz) @ rotation_y(ry) @ rotation_x(rx)
        return turned

    def to_sample(self, cone_vec: ConeVec) -> ConeVec:
        """A geometry of the object's frame in the sample's own frame (for the projector)."""
        if self == Offset():
            return cone_vec
        back = self.rotation.T
        return cone_vec.moved(back, -back @ [self.x, self.y, self.z])


@dataclass(frozen=True)
class Sample:
    """What stands on the stage, by name; "" is an empty stage."""

    name: str = ""
    offset: Offset = field(default_factory=Offset)
    material: str | None = None


@dataclass(frozen=True)
class Correction:
    """A dated, named, immutable calibration result: true minus nominal, added to nominal.

    Attributes:
        name: unique among the corrections of an installation.
        date: ISO 8601.
        parameters: the offsets [mm, rad].
        note: where it came from (data set, phantom, residual).
    """

    name: str
    date: str
    parameters: Parameters = NOMINAL
    note: str = ""


@dataclass(frozen=True)
class Safety:
    """The safety state: ready, blocked (too many blocked attempts) or estopped.

    Attributes:
        state: which of the three.
        blocked_attempts: motions in a row that a contact cut short.
        max_blocked_attempts: at so many the state becomes blocked.
        reason: why it is not ready, for people.
        contact: two parts that touch, or are closer than the safety margin; a reset does not end
            that, and only motions that bring no such pair nearer are allowed.
    """

    state: SafetyName = "ready"
    blocked_attempts: int = 0
    max_blocked_attempts: int = 3
    reason: str = ""
    contact: tuple[str, str] | None = None


@dataclass(frozen=True)
class Readout:
    """Derived quantities of one geometry, as scanners show them.

    Attributes:
        sod_mm: source-object distance along the beam.
        sdd_mm: source-detector distance along the beam.
        magnification: sdd / sod.
        pixel_mm: binned pixel pitch.
        voxel_mm: pixel * sod / sdd.
        field_of_view_mm: (width, height) of the image, scaled back to the rotation axis.
        piercing_point_px: (column, row) of the foot of the perpendicular from the focal spot.
        axis_column_px: column of the rotation axis at the height of the focal spot.
        angle_deg: accumulated stage angle.
    """

    sod_mm: float
    sdd_mm: float
    magnification: float
    pixel_mm: float
    voxel_mm: float
    field_of_view_mm: tuple[float, float]
    piercing_point_px: tuple[float, float]
    axis_column_px: float
    angle_deg: float


@dataclass(frozen=True)
class ScannerState:
    """Everything public about a scanner at `time` [s of the twin's clock]."""

    time: float
    axes: Mapping[str, AxisState]
    tube: TubeState
    camera: CameraSettings
    sample: Sample
    readout: Readout | None
    safety: Safety
    correction: Correction | None
    moving: bool


def check_tube(machine: Machine, tube: TubeState) -> TubeState:
    """Return `tube` if machine's tube can do it.

    Raises:
        LimitError: names the setting, its value and what is allowed.
    """
    t = machine.tube
    for name, value, lower, upper in (
        ("kV", tube.kV, t.min_kV, t.max_kV),
        ("power_W", tube.power_W, 0.0, t.max_W),
    ):
        if not lower <= value <= upper:
            raise LimitError(
                f"tube {name} {value:g} is outside [{lower:g}, {upper:g}]",
                {"setting": name, "asked": value, "allowed": [lower, upper]},
            )
    return tube
