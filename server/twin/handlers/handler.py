"""The type of a handler, and the connection that it answers."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from flexdt.protocol.connection import encoded
from flexdt.server.network.shell_application import Peer
from flexdt.server.twin.core import TwinServer

Item = TypeVar("Item")
View = TypeVar("View")
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
"""(twin, client, parameters) -> result model; the table says which parameters' model it is."""


def still(twin: TwinServer, client: Client, what: str) -> Callable[[], None]:
    """Checks that control has not changed hands since the request."""
    return lambda: twin.control.still(client.name, what)


def free(twin: TwinServer, client: Client, method: str, what: str) -> Callable[[], None]:
    """Checks that neither control has changed hands nor a job begun since the request."""

    def check() -> None:
        twin.control.still(client.name, method)
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


async def encoded_apart(client: Client, result: object, count: int) -> object:
    """An answer of `count` items; a long one as bytes, made in a thread."""
    if count <= A_TURN:
        return result
    return await asyncio.to_thread(encoded, result, client.peer.codec)
