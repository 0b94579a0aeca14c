"""Base classes and field types shared by all wire models.

Parameters are strict (no text for a number, no unknown member); results may grow, so a client
keeps members that it does not know. It refuses to hold any method's own model.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal

from annotated_types import Ge, Gt, Len, MaxLen
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
)
from pydantic.json_schema import WithJsonSchema

from flexdt.protocol import image
from flexdt.protocol.errors import RpcError


class Params(BaseModel):
    """Parameters of a method: frozen, strict, no unknown members, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Result(BaseModel):
    """A result: frozen, finite numbers only; unknown members are kept (the protocol may grow)."""

    model_config = ConfigDict(frozen=True, extra="allow", strict=True, allow_inf_nan=False)


class Empty(Params):
    """No parameters."""


class Nothing(Result):
    """Nothing to say."""


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

_NO_NAME = re.compile(r"[\x00-\x1f/\\]")


def _plain_name(value: str) -> str:
    if _NO_NAME.search(value):
        raise ValueError("a name may hold anything but /, \\ and control characters")
    return value


Name = Annotated[
    str,
    StringConstraints(min_length=1, max_length=120),
    AfterValidator(_plain_name),
    Field(json_schema_extra={"pattern": r"^[^\x00-\x1f/\\]+$"}),
]
"""A name of something: no path separators, no control characters."""

AxisName = Annotated[str, StringConstraints(min_length=1, max_length=64)]
"""A motor or virtual axis of the machine, e.g. `mag_obj`."""

Positive = Annotated[float, Gt(0)]
NonNegative = Annotated[float, Ge(0)]

Pair = Annotated[tuple[float, float], Field(strict=False)]
Triple = Annotated[tuple[float, float, float], Field(strict=False)]
Shape2 = Annotated[tuple[int, int], Field(strict=False)]
"""(rows, columns)."""
Roi = Annotated[tuple[int, int, int, int], Field(strict=False)]
"""(left, top, right, bottom), inclusive, unbinned pixels, origin top left."""
ConeRow = Annotated[list[float], Len(12, 12)]
"""Source, detector centre, u, v in the object's frame [mm], three numbers each."""

Targets = Annotated[dict[AxisName, float], Len(1, 64)]
"""Axis -> value [mm or deg], in the script's sign."""

SpeedUp = Positive | Literal["max"]
"""Twin seconds per real second, or "max"."""

ShortText = Annotated[str, MaxLen(1000)]
TopicName = Literal["state", "projection", "job", "log"]


class ImageValue(Result):
    """An array: little-endian, C order."""

    dtype: Literal["uint8", "int16", "uint16", "int32", "uint32", "float32", "float64"]
    shape: list[int] = Field(description="sizes, slowest first: (rows, columns) for an image")
    data: Payload
