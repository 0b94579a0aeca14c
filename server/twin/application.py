"""The twin server as an application behind the TCP shell: connections to sessions to handlers.

A session checks who may command, calls the handler of the method, and turns the twin's exceptions
into the wire's errors. What a method does is in `handlers`.
"""

from __future__ import annotations

import inspect
from contextlib import AbstractContextManager, nullcontext

from flexdt.protocol import AnyMethod
from flexdt.protocol.fields import Params
from flexdt.runtime.wire_errors import explain, is_user_error
from flexdt.server.network.shell_application import Peer
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers import HANDLERS
from flexdt.server.twin.handlers.handler import Client


class TwinSession:
    """One connection to the twin."""

    def __init__(self, twin: TwinServer, peer: Peer) -> None:
        self._twin = twin
        self._client = Client(peer)

    async def handle(self, method: AnyMethod, params: Params) -> object:
        """Answer one call.

        Raises:
            RpcError: what the wire says of it.
        """
        twin, client = self._twin, self._client
        twin.control.heard(client.name)
        try:
            if method.control:
                self._take_control(method.name)
            by_hand: AbstractContextManager[None] = nullcontext()
            if method.by_hand:
                twin.jobs.require_free(method.name)
                by_hand = twin.jobs.manual_control()
            with by_hand:
                result = HANDLERS[method.name](twin, client, params)
                return await result if inspect.isawaitable(result) else result
        except Exception as error:
            if is_user_error(error):
                raise explain(error, twin.root) from None
            raise

    def close(self) -> None:
        """The connection has ended: no more events, and control is free again."""
        if self._twin.control.holder == self._client.name:
            self._twin.detours.cancel()  # what the controller planned ends with the present leg
        self._twin.hub.drop(self._client.peer)
        self._twin.control.release(self._client.name)
        self._twin.feed.changed()

    def _take_control(self, what: str) -> None:
        before = self._twin.control.holder
        self._twin.control.require(self._client.name, what)
        if before != self._twin.control.holder:
            self._twin.feed.changed()


class TwinApp:
    """The application that `tcp.serve` serves.

    Args:
        twin: started.
    """

    def __init__(self, twin: TwinServer) -> None:
        self._twin = twin

    def open(self, peer: Peer) -> TwinSession:
        """A connection has been let in."""
        return TwinSession(self._twin, peer)
