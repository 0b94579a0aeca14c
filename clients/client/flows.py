"""A client's methods as generators without I/O: a flow yields effects, and a client performs
them.

The blocking and the asynchronous client drive the same flows; they differ only in how they
wait.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import Awaitable, Callable, Generator, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeAlias, TypeVar

from flexdt.protocol import Method, parse_result
from flexdt.protocol.fields import Params, Result
from flexdt.protocol.methods import scanner_messages as scanner

_R = TypeVar("_R")
_M = TypeVar("_M", bound=Result)

OWN_PATIENCE: Final = -1.0
"""Time limit that selects the client's own [s]."""


@dataclass(frozen=True)
class Ask:
    """Call a method of the server; the client sends the undecoded result back into the flow.

    Attributes:
        method, params: of the request.
        patience_s: timeout for the answer [s]; None waits for ever, negative is the client's
            own.
    """

    method: str
    params: Mapping[str, object]
    patience_s: float | None = OWN_PATIENCE


@dataclass(frozen=True)
class Sleep:
    """Wait for some seconds."""

    seconds: float


@dataclass(frozen=True)
class Tell:
    """Call the user's function; the asynchronous client awaits an awaitable result."""

    function: Callable[..., object]
    args: tuple[object, ...]


Effect: TypeAlias = Ask | Sleep | Tell
Flow: TypeAlias = Generator[Effect, Any, _R]
"""Yields effects, is sent their results, returns its own result."""


def ask(
    method: Method[Params, _M],
    patience_s: float | None = OWN_PATIENCE,
    /,
    **params: object,
) -> Flow[_M]:
    """Call `method` with params but those that are None; return its result's model.

    With "seconds" in its limits there is no time limit. Raises RpcError: the answer is an
    error, or no such result.
    """
    given = {k: v for k, v in params.items() if v is not None}
    answer = yield Ask(
        method.name, given, None if "seconds" in method.limits else patience_s
    )
    return parse_result(method.result, answer)


def sample_shape() -> Flow[scanner.SampleMeshResult]:
    """Fetch the mesh of the sample on the stage, in parts; returns the first part with the
    bytes of all in `data`.

    Starts again when another sample is put on the stage meanwhile. Parts are fetched
    until `total` bytes are there; name, revision and total of each are compared with the
    first's.
    """
    while True:
        content = b""
        first = None
        while first is None or len(content) < first.total:
            part = yield from ask(scanner.SAMPLE_MESH, start=len(content))
            first = part if first is None else first
            if (part.name, part.revision, part.total) != (
                first.name,
                first.revision,
                first.total,
            ):
                break  # another sample is on the stage by now: start again
            content += part.data
        else:
            return first.model_copy(update={"data": content})


def drive(flow: Flow[_R], perform: Callable[[Effect], object]) -> _R:
    """Run a flow to its end by blocking calls of `perform`; returns the flow's result.

    An exception of `perform` is thrown into the flow, which may handle it. Each effect is
    performed before the next one is requested.
    """
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


async def perform(effect: Effect, call: Callable[[Ask], Awaitable[object]]) -> object:
    """Perform an effect on an event loop and return its result.

    Only `Ask` has a result: that of `call`. `Sleep` waits, `Tell` calls the function and
    awaits its result if that is awaitable; both return None.

    Args:
        effect: a request, a pause or a call of the caller's function.
        call: sends a request to the server and returns the result.
    """
    match effect:
        case Ask():
            return await call(effect)
        case Sleep(seconds):
            await asyncio.sleep(seconds)
        case Tell(function, args):
            told = function(*args)
            if inspect.isawaitable(told):
                await told
    return None


async def adrive(flow: Flow[_R], call: Callable[[Ask], Awaitable[object]]) -> _R:
    """Run a flow to its end, and return its result.

    Errors of an effect are thrown into the flow, which may handle them. Cancellation is
    thrown into the flow, too. Each effect is awaited before the next one is requested.

    Args:
        flow: yields effects, and gets their results or errors.
        call: sends a request to the server.
    """
    try:
        effect = next(flow)
        while True:
            try:
                given = await perform(effect, call)
            except BaseException as error:
                effect = flow.throw(error)
            else:
                effect = flow.send(given)
    except StopIteration as end:
        result: _R = end.value
        return result
