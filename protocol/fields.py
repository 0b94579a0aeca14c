"""Base classes and field types shared by all wire models.

Parameters are strict (no text for a number, no unknown member); results may grow, so a
client keeps members that it does not know. The types of requests are bounded, so that the
schema rejects values that the code behind it cannot handle. `methods` has the models of
the methods.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Le, Len, MaxLen
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    model_validator,
)
from pydantic.json_schema import WithJsonSchema

from flexdt.protocol.field_checks import (
    MAX_STEM,
    few,
    line,
    lines,
    no_truth,
    payload,
    plain_name,
    whole,
)
from flexdt.protocol.image import Dtype

MAX_UNKNOWN = 50
"""Largest number of members beyond the declared fields before an object is rejected unread."""

_MODEL = ConfigDict(
    frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True
)
"""Configuration of all models; the text below a field is its description in OpenRPC."""
Payload = Annotated[
    bytes,
    BeforeValidator(payload),
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]
"""Binary data: base64 in JSON, raw bytes in MessagePack."""
Integral = BeforeValidator(whole)
"""Lets an integer be written with a fraction of zero: 8.0."""
Version1 = Annotated[Literal[1], BeforeValidator(no_truth), Integral]
"""The version of a document; `true`, which Python holds for 1, is none."""
_LINE_SCHEMA = {"pattern": r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$"}
Name = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MAX_STEM),
    AfterValidator(plain_name),
    Field(json_schema_extra={"pattern": r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029/\\]+$"}),
]
"""A name of something that is kept: no path separators, no control characters."""
AxisName = Annotated[
    str,
    StringConstraints(min_length=1, max_length=64),
    AfterValidator(line),
    Field(json_schema_extra=_LINE_SCHEMA),
]
"""A motor or virtual axis of the machine, e.g. `mag_obj`."""
Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]
# Ranges of numbers in requests. The machine's own limits are far narrower and reported by
# name with -32001; these ranges only keep the arithmetic behind them from overflowing.
Position = Annotated[float, Ge(-1e9), Le(1e9)]
"""[mm or deg]; angles are accumulated."""
Velocity = Annotated[float, Ge(-1e6), Le(1e6)]
"""[mm/s or deg/s]"""
Pace = Annotated[float, Ge(1e-6), Le(1e6)]
"""A speed or an acceleration above zero [mm or deg; s]."""
Setting = Annotated[float, Ge(-1e7), Le(1e7)]
"""Of a camera [ms]; the machine's own limits are reported by name."""
Exposure = Annotated[float, Ge(1e-6), Le(1e7)]
"""[ms]"""
Voltage = Annotated[float, Ge(1e-3), Le(1e4)]
"""[kV]"""
Power = Annotated[float, Ge(1e-6), Le(1e6)]
"""[W]"""
Shift = Annotated[float, Ge(-1e4), Le(1e4)]
"""Shift of a sample from its default place [mm]."""
Turn = Annotated[float, Ge(-3600), Le(3600)]
"""[deg]"""
Distance = Annotated[float, Ge(1e-3), Le(1e5)]
"""Of source, object and detector [mm]."""
Pitch = Annotated[float, Ge(1e-6), Le(1e3)]
"""Of voxels [mm]."""
Side = Annotated[int, Ge(1), Le(32_768), Integral]
"""Voxels, or pixels, along a side."""
Deviation = Annotated[float, Ge(-1e9), Le(1e9)]
"""True minus nominal, of a geometric parameter [mm or deg]."""
Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Shape2 = Annotated[tuple[int, int], Field(strict=False)]
"""(rows, columns)."""
Roi = Annotated[tuple[int, int, int, int], Field(strict=False)]
"""(left, top, right, bottom), inclusive, unbinned pixels, origin top left."""
Pixel = Annotated[int, Ge(0), Le(65_535), Integral]
RoiAsked = Annotated[tuple[Pixel, Pixel, Pixel, Pixel], Field(strict=False)]
"""A `Roi` in a request."""
Place = Annotated[float, Ge(-1), Le(65_535)]
PixelAsked = Annotated[tuple[Place, Place], Field(strict=False)]
"""(column, row) of an image in a request."""
VoxelPitch = Annotated[tuple[Pitch, Pitch, Pitch], Field(strict=False)]
"""(x, y, z) [mm]."""
VoxelShape = Annotated[tuple[Side, Side, Side], Field(strict=False)]
"""(z, y, x)."""
Targets = Annotated[dict[AxisName, Position], Len(1, 64), few(64)]
"""Axis -> value [mm or deg], in the script's sign."""
MAX_SPEED_UP = 1e6
SpeedUp = Annotated[float, Gt(0), Le(MAX_SPEED_UP)] | Literal["max"]
"""Twin seconds per real second, or "max"."""
ShortText = Annotated[
    str, MaxLen(1000), AfterValidator(line), Field(json_schema_extra=_LINE_SCHEMA)
]
"""One line."""
Material = Annotated[ShortText, MaxLen(100)]
"""A name, or a formula and a density."""
VolumeName = Annotated[ShortText, Len(1, 300)]
"""Name of a body in the projector."""
Comment = Annotated[str, MaxLen(1000), AfterValidator(lines)]
"""Some lines."""
TopicName = Literal["state", "projection", "job", "log"]


class Params(BaseModel):
    """Parameters of a method: frozen, strict, no unknown members, finite numbers only."""

    model_config = ConfigDict(**_MODEL, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _few(cls, value: object) -> object:
        """Return the value unchanged; raise ValueError for an object with far more
        members than fields, before they are validated.

        Far more is over `MAX_UNKNOWN`; values that are no objects pass.
        """
        fields = cls.model_fields
        if isinstance(value, Mapping) and len(value) > len(fields) + MAX_UNKNOWN:
            raise ValueError(
                f"{len(value)} members; allowed: {', '.join(fields) or 'none'}"
            )
        return value


class Result(BaseModel):
    """A result: frozen, finite numbers only; unknown members are kept (the protocol may
    grow)."""

    model_config = ConfigDict(**_MODEL, extra="allow")


class Empty(Params):
    """No parameters."""


class Part(Params):
    """Which part of a list to answer; all of it without parameters."""

    start: Annotated[int, Ge(0), Le(2**53), Integral] = 0
    """left out before"""
    count: Annotated[int, Ge(1), Le(2**53), Integral] | None = None
    """listed at most; null: all others"""


class Nothing(Result):
    """An empty result."""


class ImageValue(Result):
    """An array: little-endian, C order."""

    dtype: Dtype
    shape: list[int]
    """sizes, slowest first: (rows, columns) for an image"""
    data: Payload
