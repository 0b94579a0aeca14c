"""What a client does, as generators that wait for nothing: a flow yields effects, a shell performs.

A blocking shell and an asyncio shell drive the same flows, so they differ only in how they wait.
It refuses to know sockets, threads and event loops.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from pydantic import BaseModel

from flexdt.protocol import parse_result

_R = TypeVar("_R")
_M = TypeVar("_M", bound=BaseModel)


@dataclass(frozen=True)
class Ask:
    """Call a method of the server; its answer comes back as it travelled.

    Attributes:
        patience_s: for the answer; None waits for ever, negative is the client's own.
    """

    method: str
    params: Mapping[str, object]
    patience_s: float | None = -1.0


@dataclass(frozen=True)
class Pause:
    """Let time pass [s]."""

    seconds: float


@dataclass(frozen=True)
class Tell:
    """Call the user's function; the asyncio shell awaits what it returns, if that can be."""

    function: Callable[..., object]
    args: tuple[object, ...]


@dataclass(frozen=True)
class Open:
    """Make a connection; a link comes back."""


@dataclass(frozen=True)
class Exchange:
    """Send a request over a link; the answer comes back."""

    link: Any
    method: str
    params: Mapping[str, object]
    timeout_s: float | None


@dataclass(frozen=True)
class Drop:
    """Close a link."""

    link: Any


@dataclass(frozen=True)
class Alone:
    """Drive a flow while nobody else does."""

    flow: Generator[Effect, Any, Any]


Effect: TypeAlias = Ask | Pause | Tell | Open | Exchange | Drop | Alone
Flow: TypeAlias = Generator[Effect, Any, _R]
"""Yields effects, is sent what they gave, returns its result."""


def ask(
    method: str, params: Mapping[str, object], model: type[_M], patience_s: float | None = -1.0
) -> Flow[_M]:
    """Call `method` and read the answer as `model`; members that are None are not sent.

    Raises:
        RpcError: the server's answer is an error, or is no `model`.
    """
    given = {k: v for k, v in params.items() if v is not None}
    answer = yield Ask(method, given, patience_s)
    return parse_result(model, answer)


def drive(flow: Flow[_R], perform: Callable[[Effect], object]) -> _R:
    """Run a flow to its end by blocking calls of `perform`."""
    try:
        effect = next(flow)
        while True:
            try:
                given = perform(effect)
            except BaseException as error:
                effect = flow.throw(error)
            else:
                effect = flow.send(given)
    except StopIteration as end:
        result: _R = end.value
        return result


async def adrive(flow: Flow[_R], perform: Callable[[Effect], Awaitable[object]]) -> _R:
    """Run a flow to its end by awaiting `perform`."""
    try:
        effect = next(flow)
        while True:
            try:
                given = await perform(effect)
            except BaseException as error:
                effect = flow.throw(error)
            else:
                effect = flow.send(given)
    except StopIteration as end:
        result: _R = end.value
        return result
