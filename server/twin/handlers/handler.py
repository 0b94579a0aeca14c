"""The type of a handler, and the connection that it answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, TypeVar

from flexdt.protocol import Method
from flexdt.protocol.connection import encoded
from flexdt.protocol.fields import Params, Result
from flexdt.protocol.messages import Encoded
from flexdt.server.network.shell_application import Peer
from flexdt.server.twin.core import TwinServer

Item = TypeVar("Item")
View = TypeVar("View")
_P = TypeVar("_P", bound=Params)
_R = TypeVar("_R", bound=Result)
A_TURN = 20
"""Items of a list that are looked at in one turn of the loop, well below a millisecond."""


@dataclass
class Client:
    """One connection.

    Attributes:
        peer: where events go; its name is the connection's.
        program: what the client called itself.
    """

    peer: Peer
    program: str = ""

    @property
    def name(self) -> str:
        """The connection's name, as in `controller`."""
        return self.peer.name


Handler = Callable[[TwinServer, Client, Any], object | Awaitable[object]]
"""(twin, client, parameters) -> result."""
Answer: TypeAlias = _R | Encoded | Mapping[str, Any]
"""A method's result: as its model, or as bytes or plain data that were made of it."""
_Handler: TypeAlias = Callable[[TwinServer, Client, _P], Answer[_R] | Awaitable[Answer[_R]]]


def answers(*methods: Method[_P, _R]) -> Callable[[_Handler[_P, _R]], _Handler[_P, _R]]:
    """Mark a function as the handler of `methods`, whose parameters and result it has."""

    def mark(handler: _Handler[_P, _R]) -> _Handler[_P, _R]:
        handler.answered = methods  # type: ignore[attr-defined]
        return handler

    return mark


def ensure_allowed(twin: TwinServer, client: Client, what: str) -> Callable[[], None]:
    """Checks that control has not changed hands since the request."""
    return lambda: twin.control.ensure_allowed(client.name, what)


def free(twin: TwinServer, client: Client, method: str, what: str) -> Callable[[], None]:
    """Checks that neither control has changed hands nor a job begun since the request."""

    def check() -> None:
        twin.control.ensure_allowed(client.name, method)
        twin.jobs.require_free(what)

    return check


async def in_turns(items: Sequence[Item], view: Callable[[Item], View]) -> list[View]:
    """`view` of each item; other requests are answered meanwhile, however many items there are."""
    views = []
    for at, item in enumerate(items, start=1):
        views.append(view(item))
        if at % A_TURN == 0 and at < len(items):
            await asyncio.sleep(0.0)
    return views


async def encoded_apart(client: Client, result: _R, count: int) -> _R | Encoded:
    """An answer of `count` items; a long one as bytes, made in a thread."""
    if count <= A_TURN:
        return result
    return await asyncio.to_thread(encoded, result, client.peer.codec)
