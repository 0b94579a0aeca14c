"""scene.* and rpc.discover: the whole state, and the wire itself, as documents.

The units of a scene are those of the wire: mm, deg, kV, W, ms. The hidden misalignment is
not part of it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, MaxLen
from pydantic import Field, JsonValue

from flexdt.protocol import fields as f
from flexdt.protocol.field_checks import few
from flexdt.protocol.method import by_hand, read
from flexdt.protocol.state_model import State

Averages = Annotated[int, Ge(1), Le(100_000), f.Integral]
Frames = Annotated[int, Ge(1), Le(1_000_000), f.Integral]
Kept = Annotated[float, Ge(-2e9), Le(2e9)]
"""A `Deviation` that has been to radians and back."""
Paces = Annotated[dict[f.AxisName, f.Pace], MaxLen(64), few(64)]


class Placement(f.Params):
    """Shift [mm] and turns about x, y, z [deg] of a sample in the object's frame."""

    x: f.Shift = 0.0
    y: f.Shift = 0.0
    z: f.Shift = 0.0
    rx: f.Turn = 0.0
    ry: f.Turn = 0.0
    rz: f.Turn = 0.0


class TubePart(f.Params):
    """Tube settings; `on` is kept for the record and never switched by loading."""

    kV: Annotated[float, Ge(0), Le(1e4)]
    power_W: Annotated[float, Ge(0), Le(1e6)]
    on: bool = False


class CameraPart(f.Params):
    """Camera settings."""

    mode: f.ShortText
    roi: f.RoiAsked
    exposure_ms: f.Exposure
    averages: Averages
    frames: Frames


class SamplePart(f.Params):
    """The sample on the stage; the empty name for none."""

    name: Literal[""] | f.Name
    material: f.Material | None = None
    offset: Placement = Field(default_factory=Placement)


class CorrectionPart(f.Params):
    """The correction in force; parameters in mm and deg."""

    name: f.Name
    date: f.ShortText
    parameters: Annotated[dict[f.AxisName, Kept], MaxLen(64), few(64)]
    comment: f.Comment = ""
    sides_known: bool = False
    """found from beads of known places, which determine the direction of rotation"""


class Scene(f.Params):
    """The document."""

    schema_version: f.Version1 = Field(alias="schema")
    flexdt: f.ShortText = ""
    name: f.ShortText = ""
    saved: f.ShortText = ""
    machine: f.ShortText
    profile: f.ShortText
    positions: Annotated[dict[f.AxisName, f.Position], MaxLen(64), few(64)]
    speeds: Paces = Field(default_factory=dict)
    accelerations: Paces = Field(default_factory=dict)
    tube: TubePart
    camera: CameraPart
    sample: SamplePart
    correction: CorrectionPart | None = None


class SceneSave(f.Params):
    """Name and comment for the document."""

    name: f.Name | None = None


class SceneLoad(f.Params):
    """A document made by `scene.save`."""

    document: Scene


class SceneLoaded(State):
    """The state afterwards."""

    warnings: list[str] = Field(default_factory=list)
    """what was not done as the document says: positions set to a limit, motion halted"""


class SceneResult(f.Result):
    """The whole state as one versioned document."""

    document: dict[str, JsonValue]


class Discovery(f.Result):
    """An OpenRPC document."""

    openrpc: str
    info: dict[str, JsonValue]
    methods: list[dict[str, JsonValue]]


SCENE_SAVE = read(
    "scene.save", SceneSave, SceneResult, "whole state as one versioned document"
)
SCENE_LOAD = by_hand("scene.load", SceneLoad, SceneLoaded, "restore such a document")
RPC_DISCOVER = read(
    "rpc.discover", f.Empty, Discovery, "this table as an OpenRPC document"
)
