"""The twin's state on the wire: the result of `state.get` and the data of `state` events.

Units: mm, deg, s of the twin's clock, kV, W, ms for exposure.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from flexdt.protocol.fields import (
    NonNegative,
    Pair,
    Positive,
    Result,
    Roi,
    Shape2,
    SpeedUp,
    Triple,
)

EndedPhase = Literal["done", "failed", "aborted", "incomplete"]
JobPhase = Literal["queued", "running", "paused", EndedPhase]
StopPath = Literal["along", "apart", "coasting"]
LogLevel = Literal["debug", "info", "warning", "error"]
ImageEdge = Literal["left", "right", "top", "bottom"]


class AxisState(Result):
    """One axis, in the script's sign; mm or deg, per second."""

    position: float
    target: float
    velocity: float
    limits: Pair
    """lowest and highest position"""
    moving: bool
    unit: Literal["mm", "deg"] = "mm"
    speed: float | None = None
    """cruise speed in force [unit/s]"""
    acceleration: float | None = None
    """acceleration in force [unit/s2]"""
    virtual: bool = False
    """moves several motors, has none of its own"""


class TubeState(Result):
    """The X-ray tube."""

    on: bool
    kV: float
    power_W: float
    ready: bool = True
    """X-rays are on and stable; before that images stay dark"""
    ready_in_s: float | None = None
    """seconds until X-rays are ready; null while they are off [s]"""


class CameraState(Result):
    """The camera's settings, and image shape and pitch that follow from them."""

    mode: str
    exposure_ms: float
    roi: Roi
    averages: int = 1
    frames: int = 1
    shape: Shape2
    """(rows, columns) of an image"""
    pixel_mm: float
    """pitch of an image pixel"""


class SamplePlacement(Result):
    """Placement of the sample in the object's frame: shift [mm], turns [deg]."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0


class SampleState(Result):
    """The sample on the stage."""

    name: str | None
    material: str | None = None
    offset: SamplePlacement = Field(default_factory=SamplePlacement)
    size_mm: Triple | None = None
    description: str = ""
    revision: str | None = None
    """of an upload: another one whenever its content changes"""


class GeometryState(Result):
    """Geometry at the present positions: nominal plus the correction in force."""

    SOD_mm: float
    """source to rotation axis"""
    SDD_mm: float
    """source to detector"""
    magnification: float
    voxel_size_mm: float
    """pixel pitch over magnification"""
    piercing_point_px: Pair
    """(column, row) of the normal from the source"""
    field_of_view_mm: Pair
    """(width, height) at the rotation axis"""
    cone_angle_deg: float | None = None
    """full vertical opening angle"""
    axis_column_px: float | None = None
    """column of the projected rotation axis"""


class SafetyState(Result):
    """Whether the machine may move, and how close things are."""

    state: str
    """ok, estop, aborted, ..."""
    estop: bool
    message: str = ""
    stop: int = 0
    """number of the latest E-stop or block"""
    stopped_by: str | None = None
    """connection that pressed the E-stop in force, as in controller"""
    blocked_attempts: int = 0
    clearance_mm: float | None = None
    """smallest distance of two parts"""
    pair: list[str] | None = None
    """the two parts that are closest"""
    warnings: list[str] = Field(default_factory=list)
    """parts that are within the safety margin now"""


class Correction(Result):
    """A dated, named, immutable calibration; values in mm and deg."""

    name: str
    date: str
    """ISO 8601"""
    parameters: dict[str, float]
    comment: str = ""
    source: str | None = None
    """data sets or method it came from"""
    sides_known: bool = False
    """found from beads of known places, which determine the direction of rotation"""


class ClockState(Result):
    """The twin's clock."""

    time_s: float
    speed_up: SpeedUp
    """requested: twin seconds per real second, or max"""
    real_time_factor: float | None = None
    """achieved, over the last seconds"""


class JobStatus(Result):
    """A script or trajectory being run; times in twin seconds."""

    job: str
    state: JobPhase
    name: str = ""
    dataset: str | None = None
    """folder of the data set"""
    frames_done: int = 0
    frames_total: int = 0
    elapsed_s: NonNegative = 0.0
    remaining_s: NonNegative | None = None
    time: float = 0.0
    """the twin's clock"""
    speed_up: SpeedUp = 1.0
    real_time_factor: float | None = None
    error: dict[str, object] | None = None
    """{code, message, data} when failed"""
    retry_s: float | None = None
    """paused by a fault that may pass: real seconds to the next try"""
    warnings: list[str] = Field(default_factory=list)
    step: int | None = None
    """index of the current step"""
    line: int | None = None
    """line of the script being run"""
    what: str = ""
    """present command, for people"""
    ended_by: str | None = None
    """connection that aborted it, named as in `controller`; null if none did"""
    start: dict[str, float] | None = None
    """positions of the motors when it began [mm, deg]; null before that"""


class ImageFlags(Result):
    """Saturation, starvation and truncation of an image, judged as though X-rays were on."""

    time: float | None = None
    """of the pose, on the twin's clock [s]"""
    saturated: float = Field(ge=0, le=1)
    """part of the pixels at full scale"""
    starved: float = Field(ge=0, le=1)
    """part of the pixels with hardly a count above dark"""
    truncated: list[ImageEdge]
    """edges of the image at which the sample is cut off"""
    good_counts: Pair | None = None
    """a pixel with fewer counts than the first is starved, from the second on saturated"""
    good_lines: Pair | None = None
    """the same of line integrals: saturated below the first, starved above the second"""


class State(Result):
    """Everything, as one snapshot."""

    time: float
    """the twin's clock [s]"""
    axes: dict[str, AxisState]
    tube: TubeState
    camera: CameraState
    sample: SampleState
    geometry: GeometryState | None
    """null where there is none at this pose, or none could be computed; `missing` says why"""
    safety: SafetyState
    job: JobStatus | None = None
    correction: Correction | None = None
    clock: ClockState
    controller: str | None = None
    """session that may move; null: no session holds control"""
    image: ImageFlags | None = None
    """the image made last, by anyone's request or by a scan"""
    unsaved: str | None = None
    """what of this state is not on the server's disk, or why: an E-stop, a reset or positions at
    rest that are still being written, or changes that a failing disk does not take. A server that
    is killed now comes back without it; null where all of it is there"""
    projector: str | None = None
    """why no image can be computed now, as where no projector answers; null where nothing is
    wrong, or without subscribers to the state"""
    missing: dict[str, str] = Field(default_factory=dict)
    """what is derived and could not be computed -> why, in words: `geometry`, `clearance`,
    `sample` (its size, description and revision), `job`, `correction`, `image`. It is null in
    this state; time, axes, tube, camera, safety, clock and controller are told all the same"""


class Stopping(Result):
    """How the motors come to rest after a stop."""

    path: StopPath
    """along the path they were on together; apart, each by itself, on a path that was swept;
    coasting, without power (E-stop of category 0), on a path nothing keeps free"""
    duration_s: NonNegative
    """until all rest, on the twin's clock"""
    distances: dict[str, NonNegative]
    """motor -> how far it still travels [mm or deg]"""
    would_hit: list[str] | None = None
    """the two parts that coasting brings together"""
    would_hit_in_s: NonNegative | None = None


class Stopped(State):
    """The state, and how the motors come to rest."""

    stopping: Stopping | None = None
    """of this server's motors"""


class LogEntry(Result):
    """Data of a `log` event."""

    level: LogLevel
    message: str
    data: dict[str, object] = Field(default_factory=dict)


class GeometryResult(Result):
    """`geometry.get`: nominal plus the correction in force."""

    cone_vec: list[float] = Field(min_length=12, max_length=12)
    detector_shape: Shape2
    pixel_mm: Positive
