"""axes.*, safety.*, clock.set, tube.set, camera.set and sample.*: motors,
settings, the sample."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal, get_args

from annotated_types import Ge, Gt, Le
from pydantic import Field, model_validator

from flexdt.protocol import fields as f
from flexdt.protocol.field_checks import require_extent
from flexdt.protocol.fields import (
    Integral,
    Params,
    Power,
    RoiAsked,
    Setting,
    ShortText,
    SpeedUp,
    Voltage,
)
from flexdt.protocol.method import Method, by_hand, command, read
from flexdt.protocol.methods.document_messages import Averages, Frames, Placement
from flexdt.protocol.state_model import (
    CameraState,
    ClockState,
    SampleState,
    State,
    Stopped,
    TubeState,
)

Bytes = Annotated[int, Ge(0), Le(2**53), Integral]
"""A place in, or a size of, something sent in parts [bytes]."""
MESH_CHUNK = 4 << 20
"""Longest part of a mesh in one answer [bytes]; its base64 fits into a frame."""
LengthUnit = Literal["um", "mm", "cm", "m", "inch"]
SamplePlace = Literal["keep", "centred"]
MeshFormat = Literal["stl", "obj", "ply", "glb", "off"]
VoxelFormat = Literal["raw"]
SceneFormat = Literal["json", "toml"]
KINDS: Mapping[str, str] = {
    **dict.fromkeys(get_args(MeshFormat), "mesh"),
    **dict.fromkeys(get_args(VoxelFormat), "voxels"),
    **dict.fromkeys(get_args(SceneFormat), "scene"),
}
"""Format of an upload -> its kind."""


class Move(f.Params):
    """Targets of one or several axes, which start together."""

    targets: f.Targets
    """axis -> position [mm or deg], in the script's sign"""
    relative: bool = False
    """targets are displacements"""
    wait: bool = False
    """answer when the motion has ended"""
    plan: bool = False
    """go around obstacles, as a series of free moves"""
    shortest: bool = False
    """rot_obj by the shortest way, not accumulated"""


class Jog(f.Params):
    """Move at a velocity until the lease runs out or is renewed."""

    axis: f.AxisName
    velocity: f.Velocity
    """[mm/s or deg/s], signed; 0 stops"""
    lease_s: Annotated[float, Ge(1e-6), Le(10)] = 0.5
    """of the twin's clock"""


class AxisSet(f.Params):
    """Speed and acceleration of later moves."""

    axis: f.AxisName
    speed: f.Pace | None = None
    """[mm/s or deg/s]"""
    acceleration: f.Pace | None = None
    """[mm/s2 or deg/s2]"""


class Reset(f.Params):
    """Leave the emergency stop, or blocked."""

    stop: Annotated[int, Ge(0), Le(2**53), Integral] | None = None
    """release this stop (safety.stop) alone; null: any"""


class MoveResult(f.Result):
    """Duration and moves of the motion."""

    duration_s: f.NonNegative
    """of the twin's clock"""
    warnings: list[str] = Field(default_factory=list)
    moves: list[dict[str, float]] | None = None
    """with plan: the moves in order, axis -> target"""
    arrived: bool | None = None
    """with wait: whether the motors rest at their targets; false after a stop"""


class AxisSetResult(f.Result):
    """Speed and acceleration in force."""

    axis: str
    speed: float
    acceleration: float


AXES_MOVE = by_hand(
    "axes.move", Move, MoveResult, "move axes to targets, starting together"
)
AXES_JOG = by_hand(
    "axes.jog", Jog, MoveResult, "move at a velocity until the lease runs out"
)
AXES_SET = by_hand(
    "axes.set", AxisSet, AxisSetResult, "set an axis's speed and acceleration"
)
AXES_STOP = Method("axes.stop", f.Empty, Stopped, "bring all axes to rest", urgent=True)
SAFETY_ESTOP = Method(
    "safety.estop", f.Empty, Stopped, "emergency stop; X-rays off", urgent=True
)
SAFETY_RESET = command("safety.reset", Reset, State, "leave the emergency stop")


class ClockSet(Params):
    """How fast the twin's time runs."""

    speed_up: SpeedUp


class TubeSet(Params):
    """X-ray tube settings; missing ones stay."""

    kV: Voltage | None = None
    power_W: Power | None = None
    on: bool | None = None


class CameraSet(Params):
    """Camera settings; missing ones stay."""

    exposure_ms: Setting | None = None
    mode: ShortText | None = None
    roi: RoiAsked | None = None
    """left, top, right, bottom; inclusive, unbinned"""
    averages: Averages | None = None
    frames: Frames | None = None


CLOCK_SET = command(
    "clock.set", ClockSet, ClockState, "set how fast the twin's time runs"
)
TUBE_SET = by_hand("tube.set", TubeSet, TubeState, "set kV, power and X-rays on or off")
CAMERA_SET = by_hand(
    "camera.set", CameraSet, CameraState, "set exposure, mode, ROI, averages, frames"
)


class SampleSet(f.Params):
    """The sample to put on the stage: a shipped phantom's name, or an uploaded file's."""

    name: f.Name | None = None
    file: f.Name | None = None
    """name under which it was uploaded"""
    material: f.Material | None = None
    offset: Placement | None = None

    @model_validator(mode="after")
    def _one(self) -> SampleSet:
        """Check that exactly one of name and file is given."""
        if (self.name is None) == (self.file is None):
            raise ValueError("give either name or file")
        return self


class SampleMesh(f.Params):
    """A part of the shape of the sample on the stage."""

    start: Bytes = 0
    """first byte"""
    count: Annotated[int, Ge(1), Le(MESH_CHUNK), Integral] = 1 << 20
    """bytes at most"""


class SampleUpload(f.Params):
    """A chunk of a mesh, of voxels or of a scene; the sample exists when all bytes have
    come."""

    name: f.Name
    kind: Literal["mesh", "voxels", "scene"] = "mesh"
    format: Literal[MeshFormat, VoxelFormat, SceneFormat]
    """raw: float32 little-endian voxels [z, y, x] of attenuation [1/mm]; json, toml: the text
    of a phantom or scene file"""
    total: Annotated[int, Ge(0), Le(2**53), Gt(0), Integral]
    """size of the whole [bytes]"""
    start: Bytes = 0
    """position of this chunk [bytes]"""
    data: f.Payload
    unit: LengthUnit | None = None
    """of mesh coordinates; left out: m for glb, mm for the others"""
    place: SamplePlace | None = None
    """of a mesh: as its coordinates have it (left out), or with the middle of its box on the
    axis"""
    material: f.Material | None = None
    shape: f.VoxelShape | None = None
    """(z, y, x) of voxels"""
    voxel_mm: f.VoxelPitch | None = None
    """(x, y, z)"""

    @model_validator(mode="after")
    def _fits(self) -> SampleUpload:
        """Check that the chunk fits into the total, and that format, kind, material,
        shape and voxel size agree.

        Returns the upload unchanged. In the order: end of the chunk, kind of the format,
        material of a scene, shape and voxel size of voxels, extent.

        Raises:
            ValueError: names the first of these that does not.
        """
        if self.start + len(self.data) > self.total:
            raise ValueError(
                f"chunk ends at {self.start + len(self.data)}, total is {self.total}"
            )
        kind = KINDS[self.format]
        if self.kind != kind:
            raise ValueError(f"format {self.format} is for kind {kind}, not {self.kind}")
        if self.kind == "scene" and self.material is not None:
            raise ValueError("a scene has its own materials")
        if self.kind == "voxels" and (self.shape is None or self.voxel_mm is None):
            raise ValueError("voxels need shape and voxel_mm")
        if self.shape is not None and self.voxel_mm is not None:
            require_extent(self.shape, self.voxel_mm)
        return self


class SampleDelete(f.Params):
    """Which upload to delete."""

    name: f.Name
    """of an upload that is neither on the stage nor in a scan that has not ended"""


class SampleDeleteResult(f.Result):
    """The deleted upload."""

    name: str
    bytes: int
    """of the upload"""


class SampleResult(f.Result):
    """The sample on the stage now."""

    sample: SampleState
    warnings: list[str] = Field(default_factory=list)


class SampleInfo(f.Result):
    """A sample that could be set."""

    name: str
    kind: Literal["phantom", "mesh", "voxels", "scene"] = "phantom"
    description: str = ""
    size_mm: f.Triple | None = None
    uploaded: bool = False


class SampleList(f.Part):
    """Which samples to list; all without parameters."""


class SampleListResult(f.Result):
    """Samples (the empty stage, shipped ones, uploads), and the materials a mesh may be
    made of."""

    samples: list[SampleInfo]
    total: int | None = None
    """samples that there are; null from an earlier server"""
    materials: list[str] = Field(default_factory=list)


class UploadResult(f.Result):
    """How much of an upload has come."""

    name: str
    received: int
    """bytes so far"""
    complete: bool
    sample: SampleInfo | None = None
    warnings: list[str] = Field(default_factory=list)


class SampleMeshResult(f.Result):
    """A part of a mesh: binary STL, mm, in the sample's own frame (before its offset)."""

    name: str
    revision: str | None = None
    format: Literal["stl"] = "stl"
    total: int
    """size of the whole [bytes]"""
    start: int
    """position of this part [bytes]"""
    data: f.Payload


SAMPLE_SET = by_hand("sample.set", SampleSet, SampleResult, "put a sample on the stage")
SAMPLE_LIST = read(
    "sample.list",
    SampleList,
    SampleListResult,
    "the samples there are, or a part of them",
)
SAMPLE_MESH = read(
    "sample.mesh", SampleMesh, SampleMeshResult, "the shape of the sample on the stage"
)
SAMPLE_UPLOAD = Method(
    "sample.upload",
    SampleUpload,
    UploadResult,
    "send a mesh, voxels or a scene in chunks",
    bulky=True,
)
SAMPLE_DELETE = command(
    "sample.delete", SampleDelete, SampleDeleteResult, "delete an upload"
)
