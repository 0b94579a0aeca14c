"""The values that describe a scanner at one moment: plain, frozen, comparable.

They describe tube, sample, safety state and the whole scanner. `scanner.ScannerTwin`, the one
mutable object, returns them. A hidden misalignment is never part of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Literal

from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, rotation_x, rotation_y, rotation_z
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.panel import Panel
from flexdt.twin.machine.camera import CameraSettings

SafetyName = Literal["ready", "blocked", "estopped"]


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


@dataclass(frozen=True)
class StagePlacement:
    """Placement of the sample on the stage: shift [mm], then turns about x, y, z [deg].

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
        if self == StagePlacement():
            return cone_vec
        back = self.rotation.T
        return cone_vec.moved(back, -back @ [self.x, self.y, self.z])


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
        panel: the distortion that was found along with it; None: none. It is undone in images, and
            no state of the twin has it.
    """

    name: str
    date: str
    parameters: Offsets = NOMINAL
    note: str = ""
    panel: Panel | None = None

    @classmethod
    def from_edge(
        cls, name: str, date: str, values: Mapping[str, float], note: str
    ) -> NamedCorrection:
        """The correction with these values [mm, deg].

        Raises:
            UnknownNameError: a name that is not a parameter.
        """
        return cls(name, date, Offsets.from_edge(values), note)


@dataclass(frozen=True)
class Safety:
    """The safety state: ready, blocked (too many blocked attempts) or estopped.

    Attributes:
        state: which of the three.
        blocked_attempts: motions in a row that a contact cut short.
        max_blocked_attempts: at so many the state becomes blocked.
        reason: why it is not ready, as a message.
        stop: number of the latest E-stop or block; each has the next one.
        stopped_by: who pressed the E-stop in force; "" where nobody did or nobody knows.
        contact: two parts that touch, or are closer than the safety margin; a reset does not end
            that, and only motions that bring no such pair nearer are allowed.
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
    """Derived quantities of one geometry, as scanners show them; the fields are those of the wire.

    Attributes:
        SOD_mm: source-object distance along the beam.
        SDD_mm: source-detector distance along the beam.
        magnification: SDD / SOD.
        voxel_size_mm: binned pixel pitch * SOD / SDD.
        field_of_view_mm: (width, height) of the image, scaled back to the rotation axis.
        piercing_point_px: (column, row) of the foot of the perpendicular from the focal spot.
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
