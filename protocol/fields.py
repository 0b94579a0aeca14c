"""Base classes and field types shared by all wire models.

Parameters are strict (no text for a number, no unknown member); results may grow, so a client
keeps members that it does not know. The types of requests are bounded, so that the schema rejects
what the code behind it could not handle. `methods` has the models of the methods.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Literal
from urllib.parse import quote

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

from flexdt.protocol import image
from flexdt.protocol.rpc_errors import RpcError

MAX_UNKNOWN = 50
"""An object with this many members more than it has fields is rejected without a closer look."""

_MODEL = ConfigDict(frozen=True, strict=True, allow_inf_nan=False, use_attribute_docstrings=True)
"""Of all models; the text below a field is its description in the OpenRPC document."""


class Params(BaseModel):
    """Parameters of a method: frozen, strict, no unknown members, finite numbers only."""

    model_config = ConfigDict(**_MODEL, extra="forbid")

    @model_validator(mode="before")
    @classmethod
    def _few(cls, value: object) -> object:
        fields = cls.model_fields
        if isinstance(value, Mapping) and len(value) > len(fields) + MAX_UNKNOWN:
            raise ValueError(f"{len(value)} members; allowed: {', '.join(fields) or 'none'}")
        return value


def few(most: int) -> BeforeValidator:
    """A validator that rejects an object of more than `most` members before it reads any."""

    def check(value: object) -> object:
        if isinstance(value, Mapping) and len(value) > most:
            raise ValueError(f"{len(value)} members; at most {most} are allowed")
        return value

    return BeforeValidator(check)


class Result(BaseModel):
    """A result: frozen, finite numbers only; unknown members are kept (the protocol may grow)."""

    model_config = ConfigDict(**_MODEL, extra="allow")


class Empty(Params):
    """No parameters."""


class Nothing(Result):
    """An empty result."""


def _payload(value: object) -> object:
    try:
        return bytes(image.payload(value))
    except RpcError as error:
        raise ValueError(error.message) from None


Payload = Annotated[
    bytes,
    BeforeValidator(_payload),
    WithJsonSchema({"type": "string", "contentEncoding": "base64"}),
]
"""Binary data: base64 in JSON, raw bytes in MessagePack."""


def _no_truth(value: object) -> object:
    if isinstance(value, bool):
        raise ValueError("a number is needed, not true or false")
    return value


Version1 = Annotated[Literal[1], BeforeValidator(_no_truth)]
"""The version of a document; `true`, which Python holds for 1, is none."""

_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_BUT_LINES = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")
MAX_STEM = 100
"""Bytes of a name, percent-encoded: it becomes a file's name, with a date before and a suffix."""


def encoded(name: str) -> str:
    """`name`, percent-encoded, for use in a file's name; different names give different texts."""
    return quote(name, safe=" ", errors="surrogatepass").replace(".", "%2E")


def line(value: str) -> str:
    """A text without control characters; raises ValueError."""
    if _CONTROL.search(value):
        raise ValueError("control characters and line ends are not allowed")
    return value


def _lines(value: str) -> str:
    if _BUT_LINES.search(value):
        raise ValueError("control characters but TAB and line ends are not allowed")
    return value


def _plain_name(value: str) -> str:
    if "/" in value or "\\" in value or _CONTROL.search(value):
        raise ValueError("a name may hold anything but /, \\ and control characters")
    if (size := len(encoded(value))) > MAX_STEM:
        raise ValueError(
            f"too long: {size} bytes percent-encoded (what is no letter, digit, space, _, - or ~ "
            f"takes 3 to 12), {MAX_STEM} allowed"
        )
    return value


_LINE_SCHEMA = {"pattern": r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*$"}

Name = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MAX_STEM),
    AfterValidator(_plain_name),
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

# Ranges of numbers in requests. The machine's own limits are far narrower and reported by name with
# -32001; these ranges only keep the arithmetic behind them from overflowing.
Position = Annotated[float, Ge(-1e9), Le(1e9)]
"""[mm or deg]; angles are accumulated."""
Velocity = Annotated[float, Ge(-1e6), Le(1e6)]
"""[mm/s or deg/s]"""
Pace = Annotated[float, Ge(1e-6), Le(1e6)]
"""A speed or an acceleration above zero [mm or deg; s]."""
Exposure = Annotated[float, Ge(1e-6), Le(1e7)]
"""[ms]"""
Voltage = Annotated[float, Ge(1e-3), Le(1e4)]
"""[kV]"""
Power = Annotated[float, Ge(1e-6), Le(1e6)]
"""[W]"""
Shift = Annotated[float, Ge(-1e4), Le(1e4)]
"""Of a sample from where it stands by itself [mm]."""
Turn = Annotated[float, Ge(-3600), Le(3600)]
"""[deg]"""
Distance = Annotated[float, Ge(1e-3), Le(1e5)]
"""Of source, object and detector [mm]."""
Pitch = Annotated[float, Ge(1e-6), Le(1e3)]
"""Of voxels [mm]."""
Side = Annotated[int, Ge(1), Le(32_768)]
"""Voxels, or pixels, along a side."""
Deviation = Annotated[float, Ge(-1e9), Le(1e9)]
"""True minus nominal, of a geometric parameter [mm or deg]."""
MAX_SIDE_MM = 1e4
"""Longest side of a grid of voxels [mm]."""

Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Shape2 = Annotated[tuple[int, int], Field(strict=False)]
"""(rows, columns)."""
Roi = Annotated[tuple[int, int, int, int], Field(strict=False)]
"""(left, top, right, bottom), inclusive, unbinned pixels, origin top left."""

Pixel = Annotated[int, Ge(0), Le(65_535)]
RoiAsked = Annotated[tuple[Pixel, Pixel, Pixel, Pixel], Field(strict=False)]
"""A `Roi` in a request."""
Place = Annotated[float, Ge(-1), Le(65_535)]
PixelAsked = Annotated[tuple[Place, Place], Field(strict=False)]
"""(column, row) of an image in a request."""
VoxelPitch = Annotated[tuple[Pitch, Pitch, Pitch], Field(strict=False)]
"""(x, y, z) [mm]."""
VoxelShape = Annotated[tuple[Side, Side, Side], Field(strict=False)]
"""(z, y, x)."""


def require_extent(shape: tuple[int, ...], voxel_mm: tuple[float, ...]) -> None:
    """Raise ValueError where a grid of `shape` (z, y, x) and `voxel_mm` (x, y, z) is too large."""
    side = max(n * v for n, v in zip(reversed(shape), voxel_mm, strict=True))
    if side > MAX_SIDE_MM:
        raise ValueError(
            f"shape and voxel_mm: a side of {side:g} mm; at most {MAX_SIDE_MM:g} mm are allowed"
        )


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
"""Of what the projector keeps."""
Comment = Annotated[str, MaxLen(1000), AfterValidator(_lines)]
"""Some lines."""
TopicName = Literal["state", "projection", "job", "log"]


class ImageValue(Result):
    """An array: little-endian, C order."""

    dtype: Literal["uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
    shape: list[int]
    """sizes, slowest first: (rows, columns) for an image"""
    data: Payload
