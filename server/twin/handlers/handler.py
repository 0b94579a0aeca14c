"""The type of a handler, and the connection that it answers."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Any

from flexdt.server.network.shell_application import Peer
from flexdt.server.twin.core import TwinServer


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
