"""Parameters of every method of the twin server; one model each, units in the descriptions.

Each field is bounded to what the code behind it bears; names and limits of the machine are the
twin's business.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, MaxLen, MinLen
from pydantic import AfterValidator, BeforeValidator, FailFast, Field, model_validator
from pydantic.json_schema import WithJsonSchema

from flexdt.protocol.fields import (
    AxisName,
    Comment,
    Deviation,
    Distance,
    Exposure,
    Material,
    Name,
    NonNegative,
    Pace,
    Params,
    Payload,
    PixelAsked,
    Place,
    Power,
    RoiAsked,
    ShortText,
    SpeedUp,
    Targets,
    TopicName,
    Velocity,
    Voltage,
    VoxelPitch,
    VoxelShape,
    few,
    line,
    require_extent,
)
from flexdt.protocol.scene_document import Averages, Frames, Placement, Scene


def _version(value: object) -> object:
    if type(value) is int or type(value) is float:
        return str(value) if abs(value) < 1000 else value
    return value


Version = Annotated[
    str,
    BeforeValidator(_version),
    MaxLen(40),
    AfterValidator(line),
    WithJsonSchema(
        {
            "anyOf": [
                {"type": "string", "maxLength": 40},
                {"type": "number", "exclusiveMinimum": -1000, "exclusiveMaximum": 1000},
            ]
        }
    ),
]
"""A version, as text or as a number."""

Moments = Annotated[
    int,
    Ge(1),
    Le(64),
    Field(description="moments averaged within the exposure of an image taken in motion"),
]
Seed = Annotated[
    int | None, Field(ge=0, le=2**63 - 1, description="of the noise; made up if left out")
]
ScriptText = Annotated[str, MaxLen(8 * 2**20)]
Bytes = Annotated[int, Ge(0), Le(2**53)]
"""A place in, or a size of, something sent in parts [bytes]."""
MESH_CHUNK = 4 << 20
"""Bytes of a mesh in one answer: below a frame, also as base64."""


class Hello(Params):
    """Who the client is; the token where the server wants one."""

    protocol: Version = Field(description='the protocol the client speaks, e.g. "1.0"')
    client: ShortText = Field(description="name of the program, for people")
    token: Annotated[str, MaxLen(4096)] | None = None


class Control(Params):
    """Take control, give it back, or take it from whoever has it."""

    action: Literal["acquire", "release", "force"]


class Subscribe(Params):
    """Which events to send."""

    topics: Annotated[list[TopicName], Len(1, 16)]
    max_rate_hz: Annotated[float, Ge(1e-3), Le(1000)] | None = Field(
        default=None, description="at most so many events a second and topic; the newest value wins"
    )
    projection_kind: Literal["line_integral", "counts"] = "line_integral"
    projection_binning: Annotated[int, Ge(1), Le(32)] = Field(
        default=1, description="mean over so many pixels a side, for the topic projection"
    )


class Unsubscribe(Params):
    """Which events to send no longer."""

    topics: Annotated[list[TopicName], Len(1, 16)]


class Move(Params):
    """Targets of one or several axes, which start together."""

    targets: Targets = Field(description="axis -> position [mm or deg], in the script's sign")
    relative: bool = Field(default=False, description="targets are displacements")
    wait: bool = Field(default=False, description="answer when the motion has ended")
    plan: bool = Field(default=False, description="go around obstacles, as a series of free moves")
    shortest: bool = Field(
        default=False, description="rot_obj by the shortest way, not accumulated"
    )


class Jog(Params):
    """Move at a velocity until the lease runs out or is renewed."""

    axis: AxisName
    velocity: Velocity = Field(description="[mm/s or deg/s], signed; 0 stops")
    lease_s: Annotated[float, Ge(1e-6), Le(10)] = Field(
        default=0.5, description="of the twin's clock"
    )


class AxisSet(Params):
    """Speed and acceleration of later moves."""

    axis: AxisName
    speed: Pace | None = Field(default=None, description="[mm/s or deg/s]")
    acceleration: Pace | None = Field(default=None, description="[mm/s2 or deg/s2]")


class Reset(Params):
    """Leave the emergency stop, or blocked."""

    stop: Annotated[int, Ge(0), Le(2**53)] | None = Field(
        default=None, description="release this stop (safety.stop) alone; null: any"
    )


class ClockSet(Params):
    """How fast the twin's time runs."""

    speed_up: SpeedUp


class TubeSet(Params):
    """X-ray tube settings; what is left out stays."""

    kV: Voltage | None = None
    power_W: Power | None = None
    on: bool | None = None


class CameraSet(Params):
    """Camera settings; what is left out stays."""

    exposure_ms: Exposure | None = None
    mode: ShortText | None = None
    roi: RoiAsked | None = Field(
        default=None, description="left, top, right, bottom; inclusive, unbinned"
    )
    averages: Averages | None = None
    frames: Frames | None = None


class SampleSet(Params):
    """Which sample stands on the stage: a shipped phantom's name, or an uploaded file's."""

    name: Name | None = None
    file: Name | None = Field(default=None, description="name under which it was uploaded")
    material: Material | None = None
    offset: Placement | None = None

    @model_validator(mode="after")
    def _one(self) -> SampleSet:
        if (self.name is None) == (self.file is None):
            raise ValueError("give either name or file")
        return self


class SampleMesh(Params):
    """A part of the shape of the sample on the stage."""

    start: Bytes = Field(default=0, description="first byte")
    count: Annotated[int, Ge(1), Le(MESH_CHUNK)] = Field(
        default=1 << 20, description="bytes at most"
    )


LengthUnit = Literal["um", "mm", "cm", "m", "inch"]


class SampleUpload(Params):
    """A chunk of a mesh, of voxels or of a scene; the sample exists when all bytes have come."""

    name: Name
    kind: Literal["mesh", "voxels", "scene"] = "mesh"
    format: Literal["stl", "obj", "ply", "glb", "off", "raw", "json", "toml"] = Field(
        description="raw: float32 little-endian voxels [z, y, x] of attenuation [1/mm]; json, "
        "toml: the text of a phantom or scene file"
    )
    total: Annotated[Bytes, Gt(0)] = Field(description="size of the whole [bytes]")
    start: Bytes = Field(default=0, description="position of this chunk [bytes]")
    data: Payload
    unit: LengthUnit | None = Field(
        default=None, description="of mesh coordinates; left out: m for glb, mm for the others"
    )
    material: Material | None = None
    shape: VoxelShape | None = Field(default=None, description="(z, y, x) of voxels")
    voxel_mm: VoxelPitch | None = Field(default=None, description="(x, y, z)")

    @model_validator(mode="after")
    def _fits(self) -> SampleUpload:
        if self.start + len(self.data) > self.total:
            raise ValueError(f"chunk ends at {self.start + len(self.data)}, total is {self.total}")
        own = {"raw": "voxels", "json": "scene", "toml": "scene"}.get(self.format, "mesh")
        if self.kind != own:
            raise ValueError(f"format {self.format} is for kind {own}, not {self.kind}")
        if self.kind == "scene" and self.material is not None:
            raise ValueError("a scene has its own materials")
        if self.kind == "voxels" and (self.shape is None or self.voxel_mm is None):
            raise ValueError("voxels need shape and voxel_mm")
        if self.shape is not None and self.voxel_mm is not None:
            require_extent(self.shape, self.voxel_mm)
        return self


class ProjectionGet(Params):
    """What kind of image, at the current pose, or as though it stood and were set otherwise.

    Such an image is predicted: from the geometry of `geometry.get`, without noise.
    """

    kind: Literal["line_integral", "counts"] = "line_integral"
    binning: Annotated[int, Ge(1), Le(32)] = Field(
        default=1, description="mean over so many pixels a side, beyond the camera's mode"
    )
    marks: bool = Field(
        default=False, description="say which pixels are saturated, starved or cut off as well"
    )
    positions: Targets | None = Field(
        default=None,
        description="motor -> [mm, deg] there, beyond its travel too; others stand as they do",
    )
    tube: TubeSet | None = Field(default=None, description="as though set so")
    camera: CameraSet | None = Field(default=None, description="as though set so")


class RayGet(Params):
    """A pixel of the image of this moment."""

    pixel: PixelAsked = Field(description="(column, row); (0, 0) is the centre of the top left one")


LayerText = Annotated[ShortText, MaxLen(100)]


class ExposurePredict(Params):
    """A scan to predict; what is left out is as it is now."""

    sample: Name | None = Field(default=None, description="default: the one on the stage")
    kV: Voltage | None = None
    power_W: Power | None = None
    filter: LayerText = Field(default="", description="MATERIAL:MM beside the machine's own")
    exposure_ms: Exposure | None = None
    averages: Averages | None = None
    frames: Frames = Field(default=361, description="of the scan")
    sod_mm: Distance | None = Field(default=None, description="default: as it stands")
    sdd_mm: Distance | None = Field(default=None, description="default: as it stands")
    detail: LayerText = Field(
        default="void:0.5", description="MATERIAL:MM or void:MM on the darkest ray, to be seen"
    )


class ScriptInput(Params):
    """An Acquila script, as text or (byte for byte) as base64."""

    text: ScriptText | None = None
    data_base64: ScriptText | None = None
    name: Name | None = Field(default=None, description="name of the data set; made up if left out")
    speed_up: SpeedUp | None = Field(
        default=None, description="for this job; the clock's if left out"
    )
    motion_samples: Moments = 1
    seed: Seed = None

    @model_validator(mode="after")
    def _one(self) -> ScriptInput:
        if (self.text is None) == (self.data_base64 is None):
            raise ValueError("give either text or data_base64")
        return self


class TrajectoryInput(Params):
    """Poses to go through, one image each (thesis 4.6.2)."""

    poses: Annotated[list[Targets], FailFast(), MinLen(1), MaxLen(200_000)] = Field(
        description="each: axis -> value [mm or deg]; axes left out stay"
    )
    exposure_ms: Exposure | None = None
    name: Name | None = None
    speed_up: SpeedUp | None = None
    motion_samples: Moments = 1
    seed: Seed = None


class JobRef(Params):
    """Which job; the current or last one if left out."""

    job: Annotated[ShortText, Len(1, 120)] | None = None


class DatasetList(Params):
    """Which data sets of the data directory to list."""

    search: Annotated[ShortText, MaxLen(200)] = Field(
        default="",
        description="words; each occurs in name, sample, operator, date, state or a setting",
    )
    start: Annotated[int, Ge(0), Le(1_000_000)] = Field(default=0, description="left out before")
    count: Annotated[int, Ge(1), Le(200)] = Field(default=50, description="listed at most")
    thumbnail: Annotated[int, Ge(0), Le(256)] = Field(
        default=0, description="longer side of a small image of each [pixels]; 0 for none"
    )


DataSetName = Annotated[ShortText, Len(1, 255)]


class DatasetGet(Params):
    """A data set, and what to say of it."""

    name: DataSetName = Field(description="of its folder")
    points: Annotated[int, Ge(2), Le(2000)] = Field(
        default=400, description="images at most, evenly chosen, of which poses and times are told"
    )
    measure: bool = Field(default=False, description="tell their mean counts and clearances, too")
    script: bool = Field(default=False, description="tell its script, too")


class DatasetFrame(Params):
    """An image of a data set."""

    name: DataSetName = Field(description="of its folder")
    index: Annotated[int, Ge(0), Le(10_000_000)] = Field(
        description="of the image, in the order taken: dark and flat images count"
    )
    kind: Literal["line_integral", "counts"] = "counts"
    binning: Annotated[int, Ge(1), Le(64)] = Field(
        default=1, description="mean over so many pixels a side"
    )


class CalibrationApply(Params):
    """A correction to put in force; it replaces the last."""

    parameters: Annotated[dict[AxisName, Deviation], MaxLen(64), few(64)] = Field(
        description="name -> value [mm or deg], true minus nominal"
    )
    name: Name | None = None
    comment: Comment = ""
    source: ShortText | None = None


class CalibrationGet(Params):
    """Which correction; the one in force if left out."""

    name: Name | None = None


Parameters = Annotated[list[AxisName], MaxLen(17)]


class Mark(Params):
    """Where a bead was seen in a projection; pixel (0, 0) is the middle of the upper left one."""

    frame: Annotated[int, Ge(0), Le(10_000_000)] = Field(description="projection, counted from 0")
    marker: AxisName = Field(
        description="number of the bead in its phantom, counted from 0; any name of an unknown one"
    )
    column: Place
    row: Place
    sigma: Annotated[float, Ge(1e-3), Le(1e4)] | None = Field(
        default=None, description="standard deviation of each [px]; 0.5 if left out"
    )


class CalibrationFit(Params):
    """Data sets of a bead phantom, and what to estimate from them."""

    datasets: Annotated[list[DataSetName], Len(1, 8)] = Field(description="of their folders")
    phantom: Name = Field(
        description="one that ships, a TOML or JSON file among the data sets, or unknown: markers "
        "of which nobody knows where they are, in one data set"
    )
    free: Annotated[Parameters, MinLen(1)] | None = Field(
        default=None,
        description="what is estimated; default: dO_x, dO_y, dO_z, alpha, tau_*, of unknown "
        "markers dO_x",
    )
    priors: Annotated[dict[AxisName, NonNegative], MaxLen(17), few(17)] = Field(
        default_factory=dict, description="name -> standard deviation [mm or deg]; 0: exactly known"
    )
    per_frame: Parameters = Field(
        default_factory=list, description="what may also move during the scan"
    )
    steps: Annotated[int, Ge(0), Le(50)] = Field(
        default=0, description="covariances after so many parts of the frames are told"
    )
    residuals: bool = Field(default=False, description="tell those of every bead in every frame")
    tracks: bool = Field(
        default=False, description="tell where beads are, and were put before and after"
    )
    markers: Annotated[list[Mark], Len(1, 10_000)] | None = Field(
        default=None, description="where beads were seen in the one data set; default: found there"
    )
    scale: Annotated[ShortText, MaxLen(300)] | None = Field(
        default=None, description="distance of two unknown markers [mm]: A-B=MM or A-B=MM+-SIGMA"
    )


class CalibrationAlign(Params):
    """A scan of anything over a full turn."""

    name: DataSetName = Field(description="of its folder")
    per_frame: bool = Field(default=False, description="look for shifts of single frames too")


class SceneSave(Params):
    """Name and comment for the document."""

    name: Name | None = None


class SceneLoad(Params):
    """A document made by `scene.save`."""

    document: Scene
