"""scene.* and rpc.discover: the whole state, and the wire itself, as documents.

The units of a scene are those of the wire: mm, deg, kV, W, ms. The hidden misalignment is not part
of it.
"""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, MaxLen
from pydantic import ConfigDict, Field, JsonValue

from flexdt.protocol.fields import (
    AxisName,
    Comment,
    Empty,
    Exposure,
    Material,
    Name,
    Pace,
    Params,
    Position,
    Result,
    RoiAsked,
    Shift,
    ShortText,
    Turn,
    Version1,
    few,
)
from flexdt.protocol.method import by_hand, read
from flexdt.protocol.state_model import State

Averages = Annotated[int, Ge(1), Le(100_000)]
Frames = Annotated[int, Ge(1), Le(1_000_000)]
Kept = Annotated[float, Ge(-2e9), Le(2e9)]
"""A `Deviation` that has been to radians and back."""
Paces = Annotated[dict[AxisName, Pace], MaxLen(64), few(64)]


class Placement(Params):
    """Shift [mm] and turns about x, y, z [deg] of a sample in the object's frame."""

    x: Shift = 0.0
    y: Shift = 0.0
    z: Shift = 0.0
    rx: Turn = 0.0
    ry: Turn = 0.0
    rz: Turn = 0.0


class TubePart(Params):
    """Tube settings; `on` is kept for the record and never switched by loading."""

    kV: Annotated[float, Ge(0), Le(1e4)]
    power_W: Annotated[float, Ge(0), Le(1e6)]
    on: bool = False


class CameraPart(Params):
    """Camera settings."""

    mode: ShortText
    roi: RoiAsked
    exposure_ms: Exposure
    averages: Averages
    frames: Frames


class SamplePart(Params):
    """What stood on the stage; the empty name for nothing."""

    name: Literal[""] | Name
    material: Material | None = None
    offset: Placement = Field(default_factory=Placement)


class CorrectionPart(Params):
    """The correction in force; parameters in mm and deg."""

    name: Name
    date: ShortText
    parameters: Annotated[dict[AxisName, Kept], MaxLen(64), few(64)]
    comment: Comment = ""


class Scene(Params):
    """The whole state of a scanner as one versioned document: the result of `scene.save`."""

    schema_version: Version1 = Field(alias="schema")
    flexdt: ShortText = ""
    name: ShortText = ""
    saved: ShortText = ""
    machine: ShortText
    profile: ShortText
    positions: Annotated[dict[AxisName, Position], MaxLen(64), few(64)]
    speeds: Paces = Field(default_factory=dict)
    accelerations: Paces = Field(default_factory=dict)
    tube: TubePart
    camera: CameraPart
    sample: SamplePart
    correction: CorrectionPart | None = None

    model_config = ConfigDict(populate_by_name=True)


class SceneSave(Params):
    """Name and comment for the document."""

    name: Name | None = None


class SceneLoad(Params):
    """A document made by `scene.save`."""

    document: Scene


class SceneResult(Result):
    """The whole state as one versioned document."""

    document: dict[str, JsonValue]


class Discovery(Result):
    """An OpenRPC document."""

    openrpc: str
    info: dict[str, JsonValue]
    methods: list[dict[str, JsonValue]]


SCENE_SAVE = read("scene.save", SceneSave, SceneResult, "whole state as one versioned document")
SCENE_LOAD = by_hand("scene.load", SceneLoad, State, "restore such a document")
RPC_DISCOVER = read("rpc.discover", Empty, Discovery, "this table as an OpenRPC document")
