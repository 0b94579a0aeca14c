"""Results of the methods whose answer is not simply a part of the state.

The models that events share are in `state_model`.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from flexdt.protocol.fields import ImageValue, NonNegative, Pair, Payload, Result, Shape2, Triple
from flexdt.protocol.state_model import Correction, ImageFlags, JobStatus, SampleState


class HelloResult(Result):
    """Who the server is."""

    protocol: str
    server: str = Field(description="name and version")
    machine: str
    profile: str | None = None
    session: str | None = Field(
        default=None, description="this connection's name, as in `controller`"
    )
    physics: str | None = Field(
        default=None, description="how images are made: ideal, mono or poly"
    )


class ControlResult(Result):
    """Who may move now."""

    controller: str | None
    yours: bool = Field(default=False, description="whether that is this connection")


class Pong(Result):
    """The server is alive."""

    time: float = Field(description="the twin's clock [s]")


class MoveResult(Result):
    """What the motion will take."""

    duration_s: NonNegative = Field(description="of the twin's clock")
    warnings: list[str] = Field(default_factory=list)
    moves: list[dict[str, float]] | None = Field(
        default=None, description="with plan: the moves in order, axis -> target"
    )
    arrived: bool | None = Field(
        default=None,
        description="with wait: whether the motors rest at their targets; false after a stop",
    )


class AxisSetResult(Result):
    """Speed and acceleration in force."""

    axis: str
    speed: float
    acceleration: float


class SampleResult(Result):
    """What stands on the stage now."""

    sample: SampleState
    warnings: list[str] = Field(default_factory=list)


class SampleInfo(Result):
    """A sample that could be set."""

    name: str
    kind: Literal["phantom", "mesh", "voxels", "scene"] = "phantom"
    description: str = ""
    size_mm: Triple | None = None
    uploaded: bool = False


class SampleListResult(Result):
    """All samples, and the materials a mesh may be made of."""

    samples: list[SampleInfo]
    materials: list[str] = Field(default_factory=list)


class UploadResult(Result):
    """How much of an upload has come."""

    name: str
    received: int = Field(description="bytes so far")
    complete: bool
    sample: SampleInfo | None = None
    warnings: list[str] = Field(default_factory=list)


class SampleMeshResult(Result):
    """A part of a mesh: binary STL, mm, in the sample's own frame (before its offset)."""

    name: str
    revision: str | None = None
    format: Literal["stl"] = "stl"
    total: int = Field(description="size of the whole [bytes]")
    start: int = Field(description="position of this part [bytes]")
    data: Payload


class Projection(ImageValue):
    """An image and the geometry it was made with (nominal plus correction)."""

    cone_vec: list[float] = Field(min_length=12, max_length=12)
    kind: Literal["line_integral", "counts"] = "line_integral"
    time: float | None = Field(default=None, description="of the pose, on the twin's clock [s]")
    flags: ImageFlags | None = None
    marks: ImageValue | None = Field(
        default=None,
        description="uint8, as large as the image, where asked for: sum of 1 saturated, 2 starved, "
        "4 sample cut off at this pixel of the edge; judged as though X-rays were on",
    )


class Problem(Result):
    """Something about a script, with its place."""

    severity: Literal["error", "warning"]
    code: str
    line: int | None = None
    column: int | None = None
    message: str


class CheckStep(Result):
    """A step of the plan."""

    line: int | None = None
    start_s: float
    duration_s: float
    what: str


class CheckCollision(Result):
    """A contact that the plan would run into."""

    line: int | None = None
    time_s: float
    pair: list[str]
    last_free: dict[str, float]


class CheckResult(Result):
    """The dry-run report: the same document as `flexdt check --json`."""

    ok: bool
    problems: list[Problem]
    steps: list[CheckStep]
    duration_s: float
    frames: int
    bytes: int
    collisions: list[CheckCollision] = Field(default_factory=list)
    min_clearance_mm: float | None = None


class SubmitResult(Result):
    """The job that was made."""

    job: str
    dataset: str | None = None
    warnings: list[str] = Field(default_factory=list)


class JobListResult(Result):
    """All jobs, oldest first."""

    jobs: list[JobStatus]


ImageKind = Literal["dark", "flat", "projection"]


class RayResult(Result):
    """What the ray of a pixel goes through, in the geometry of geometry.get."""

    paths_mm: dict[str, float] = Field(description="material -> path through it")


class DatasetInfo(Result):
    """A data set in a few words; what is not known of it is null."""

    name: str = Field(description="of its folder")
    modified: float = Field(description="when its folder last changed [s since 1970]")
    started: str | None = None
    duration_s: float | None = Field(default=None, description="of the twin's clock")
    state: Literal["complete", "incomplete", "running", "unknown"] = "unknown"
    reason: str = Field(default="", description="why it is incomplete")
    projections: int = Field(default=0, description="that it has, or should have")
    present: int = Field(default=0, description="projections that are there")
    machine: str | None = None
    sample: str = ""
    operator: str = ""
    kV: float | None = None
    power_W: float | None = None
    exposure_ms: float | None = None
    mode: str | None = None
    shape: Shape2 | None = None
    problem: str = Field(default="", description="why the rest is not known")
    thumbnail: ImageValue | None = Field(
        default=None, description="uint8, its projection in the middle, windowed"
    )


class DatasetListResult(Result):
    """Data sets, the newest first."""

    datasets: list[DatasetInfo]
    total: int = Field(description="data sets that the search finds")
    unread: int = Field(default=0, description="of those, not read yet for lack of time: ask again")
    left_out: int = Field(
        default=0, description="older folders, and folders whose names no data set may have"
    )


class DatasetResult(Result):
    """A data set over time: lists have one entry for each image of `indices`."""

    info: DatasetInfo
    images: int = Field(description="that it has, or should have, of all kinds")
    indices: list[int] = Field(description="of the images chosen, in the order taken")
    files: list[str]
    kinds: list[ImageKind]
    present: list[bool]
    times_s: list[float] | None = Field(description="on the scan's clock")
    positions: dict[str, list[float | None]] = Field(
        description="motor -> [mm, deg], script's sign; null where it is not known"
    )
    same_machine: bool = Field(description="whether this twin has the same axes, parts and zeros")
    counts: list[float | None] | None = Field(
        default=None, description="mean of each image; null where it cannot be read"
    )
    clearance_mm: list[float | None] | None = Field(
        default=None, description="of the nearest parts that may not touch"
    )
    clearance_of: str = Field(default="", description="what the clearances are of")
    script: str | None = None


class DatasetFrameResult(ImageValue):
    """An image of a data set, as it was saved, and its nominal geometry."""

    name: str
    index: int
    file: str
    image: ImageKind
    projection: int | None = Field(
        default=None, description="its number among the projections, as calibration.fit counts them"
    )
    kind: Literal["line_integral", "counts"]
    time_s: float | None = None
    exposure_ms: float | None = None
    positions: dict[str, float] | None = None
    cone_vec: list[float] | None = Field(default=None, description="nominal, without a correction")
    tube: dict[str, JsonValue] | None = Field(default=None, description="for projection.get")
    camera: dict[str, JsonValue] | None = Field(default=None, description="for projection.get")


class TransmissionShares(Result):
    """How much of the open beam the pixels see, in a few views of a turn."""

    least: float
    p1: float = Field(description="1 % of the pixels see less")
    p5: float
    median: float
    edges: list[float] = Field(description="of the bins; the last one has no upper edge")
    shares: list[float] = Field(description="of the pixels in each bin")


class PredictedSetting(Result):
    """Tube and camera, and what they give on the darkest ray."""

    kV: float
    filter: str
    exposure_ms: float
    averages: int
    cnr: float = Field(description="contrast of the detail to the noise of a pixel of one image")
    kerma_mGy: float = Field(description="air kerma of the scan on the axis, without a sample")


class ExposurePrediction(Result):
    """What a circular scan of a sample will look like, without scattered radiation."""

    sample: str
    transmission: TransmissionShares
    saturated: float = Field(ge=0, le=1, description="part of the pixels")
    starved: float = Field(ge=0, le=1, description="part of the pixels")
    detail: str
    asked: PredictedSetting
    best: list[PredictedSetting] = Field(description="of the same power and time, the best first")
    frames: int
    seconds: float = Field(description="that the frames take at least")
    bytes: int
    assumed: list[str] = Field(description="what is not known of the sample")


class CorrectionResult(Result):
    """The correction in force (or asked for), if there is one.

    Warnings: parts that its geometry brings within the safety margin where they stand.
    """

    correction: Correction | None
    warnings: list[str] = Field(default_factory=list)


class Estimated(Result):
    """An estimate [mm, deg, px or 1]; None where the images do not tell or must not be trusted."""

    value: float | None
    sigma: float | None
    unit: str


class CalibrationStep(Result):
    """What the first frames of a fit would know by themselves."""

    frames: int
    covariance: list[list[float]] | None = Field(
        description="[mm, deg], in the order of `parameters`; None: not all are determined"
    )


class CalibrationProblem(Result):
    """Something about the data; an error forbids the numbers."""

    code: str
    severity: Literal["error", "warning"]
    text: str


class CalibrationFitResult(Result):
    """A calibration; nothing is applied. Further fields are those of `flexdt calibrate --json`."""

    identifiable: bool
    parameters: dict[str, Estimated]
    correction: dict[str, float] | None = Field(default=None, description="for calibration.apply")
    covariance: list[list[float | None]] = Field(default_factory=list)
    rms_px: float | None
    rms_per_bead_px: list[float | None] = Field(default_factory=list)
    residuals_px: list[list[Pair | None]] | None = Field(
        default=None, description="of each frame and bead: measured minus predicted column and row"
    )
    steps: list[CalibrationStep] = Field(default_factory=list)
    tracks: dict[str, JsonValue] | None = Field(
        default=None, description="as `flexdt calibrate --tracks` writes them"
    )
    problems: list[CalibrationProblem]


class CalibrationAlignResult(Result):
    """The geometry that an ordinary scan tells; nothing is applied."""

    identifiable: bool
    parameters: dict[str, Estimated]
    refused: dict[str, str] = Field(description="what such a scan cannot tell, and why")
    warnings: list[str]
    correction: dict[str, float] | None = Field(default=None, description="for calibration.apply")
    motion: list[dict[str, JsonValue]] | None = Field(
        default=None, description="shifts of single frames, as `flexdt align --json` tells them"
    )


class CorrectionListResult(Result):
    """All corrections, oldest first, and which one is in force."""

    corrections: list[Correction]
    current: str | None = None


class SceneResult(Result):
    """The whole state as one versioned document."""

    document: dict[str, JsonValue]


class Discovery(Result):
    """An OpenRPC document."""

    openrpc: str
    info: dict[str, JsonValue]
    methods: list[dict[str, JsonValue]]
