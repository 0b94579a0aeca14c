"""session.* and state.*: connections, control and subscriptions."""

from __future__ import annotations

from typing import Annotated, Literal

from annotated_types import Ge, Le, Len, MaxLen
from pydantic import AfterValidator, BeforeValidator, Field
from pydantic.json_schema import WithJsonSchema

from flexdt.protocol.field_checks import line
from flexdt.protocol.fields import (
    Empty,
    Integral,
    Nothing,
    Params,
    Result,
    ShortText,
    TopicName,
)
from flexdt.protocol.method import Method, read
from flexdt.protocol.state_model import State


def _version(value: object) -> object:
    """Convert a number below 1000 in absolute value to its text; return other values unchanged."""
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


class Hello(Params):
    """Who the client is; the token where the server wants one."""

    protocol: Version = Field(description='the protocol the client speaks, e.g. "1.0"')
    client: ShortText
    """name of the program, for people"""
    token: Annotated[str, MaxLen(4096)] | None = None


ControlAction = Literal["acquire", "release", "force"]


class Control(Params):
    """Take control, give it back, or take it from the client that has it."""

    action: ControlAction


class Subscribe(Params):
    """Which events to send."""

    topics: Annotated[list[TopicName], Len(1, 16)]
    max_rate_hz: Annotated[float, Ge(1e-3), Le(1000)] | None = None
    """at most so many events a second and topic; the newest value wins"""
    projection_kind: Literal["line_integral", "counts"] = "line_integral"
    projection_binning: Annotated[int, Ge(1), Le(32), Integral] = 1
    """mean over so many pixels a side, for the topic projection"""


class Unsubscribe(Params):
    """Which events to send no longer."""

    topics: Annotated[list[TopicName], Len(1, 16)]


class HelloResult(Result):
    """Who the server is."""

    protocol: str
    server: str
    """name and version"""
    machine: str
    profile: str | None = None
    session: str | None = None
    """this connection's name, as in `controller`"""
    physics: str | None = None
    """how images are made: ideal, mono or poly"""
    rays: int | Literal["auto"] | None = None
    """along each side of a pixel that an edge of the sample reaches"""
    instance: str | None = None
    """made up when the server started: results of another instance may be out of date"""


class ControlResult(Result):
    """Who may move now."""

    controller: str | None
    yours: bool = False
    """whether that is this connection"""


class Pong(Result):
    """The server is alive."""

    time: float
    """the twin's clock [s]"""
    serving: list[str] | None = None
    """methods that this connection has called and that are being worked at"""
    working: str | None = None
    """what takes long now, such as kernels that compile"""


SESSION_HELLO = read(
    "session.hello", Hello, HelloResult, "introduce the client; bring the token"
)
SESSION_CONTROL = Method(
    "session.control", Control, ControlResult, "acquire, release or force control"
)
SESSION_PING = read(
    "session.ping",
    Empty,
    Pong,
    "a heartbeat, and what is being worked at for the connection",
    urgent=True,
)
STATE_GET = read("state.get", Empty, State, "everything, as one snapshot")
STATE_SUBSCRIBE = read(
    "state.subscribe", Subscribe, Nothing, "send events of these topics"
)
STATE_UNSUBSCRIBE = read("state.unsubscribe", Unsubscribe, Nothing, "send them no longer")
