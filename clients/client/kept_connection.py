"""A connection to the twin that is kept for as long as a program runs: for the viewer and
gateway.

Built on the asynchronous client, with two differences that such programs need. It
reconnects by itself, not with the next call; and a request fails at once while there is
no connection, and is never repeated: the user of the page decides whether to send it
again.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import ssl as tls
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, cast

from flexdt.clients.client.client import AsyncTwinClient, back_off
from flexdt.clients.client.transport import ConnectionLost
from flexdt.protocol import Code, RpcError
from flexdt.protocol.methods.session_messages import HelloResult
from flexdt.runtime.log import log

FIRST_PAUSE_S: Final = 0.1
HELLO_S: Final = 10.0

OnEvent = Callable[[str, Mapping[str, object]], None]
"""Called with an event's topic and its params."""


class Unsendable(RpcError):
    """Parameters that cannot be encoded, such as a number that is not finite."""

    def __init__(self, method: str, error: Exception) -> None:
        super().__init__(Code.INVALID_PARAMS, f"{method}: cannot be sent: {error}")


@dataclass(frozen=True)
class TwinAddress:
    """Where a twin server is and how to get in.

    Attributes:
        host, port: of the server.
        token: where it wants one.
        ssl: a client's TLS context; None for plain TCP.
    """

    host: str
    port: int
    token: str | None = None
    ssl: tls.SSLContext | None = None

    def __str__(self) -> str:
        return f"{self.host}:{self.port}"


class KeptConnection:
    """A connection that comes back by itself while `run` runs.

    Args:
        address: of the twin server.
        name: of this program, for people who look at the server.
        on_event: called with every event; an exception in it is logged.
        on_change: called when the connection has been made or lost, or could not be made.
        subscription: parameters of `state.subscribe`, sent after every hello; None for none.

    Attributes:
        problem: why there is no connection; empty while there is one.
    """

    def __init__(
        self,
        address: TwinAddress,
        name: str,
        on_event: OnEvent = lambda topic, params: None,
        on_change: Callable[[], None] = lambda: None,
        subscription: Mapping[str, object] | None = None,
    ) -> None:
        """Prepare a client for the address, not yet connected; `run` connects.

        The client itself never reconnects; `problem` says why there is no connection. A
        request waits `HELLO_S` for the hello only.

        Args:
            name: of this client, which the twin shows.
            on_change: called when the connection is made or lost.
            subscription: parameters of `events.subscribe`, with `topics`.
        """
        self.address = address
        self.name = name
        self.problem = "not connected yet"
        self._on_event = on_event
        self._on_change = on_change
        self._client = AsyncTwinClient(
            address.host,
            address.port,
            address.token,
            name=name,
            timeout_s=HELLO_S,
            reconnect_s=0.0,
            ssl=address.ssl,
        )
        self.topics: tuple[str, ...] = ()
        if subscription is not None:
            self.topics = tuple(cast(list[str], subscription["topics"]))
            self._client.core.follow(self, subscription)

    async def subscribe(self, subscription: Mapping[str, object]) -> None:
        """Change rate and view of the subscription, now and after each later connection; its
        topics stay.

        Without a connection the next one begins with it; a refusal is ignored."""
        self._client.core.follow(self, subscription)
        if self.connected:
            with contextlib.suppress(ConnectionLost, RpcError):
                await self.request("state.subscribe", subscription)

    @property
    def connected(self) -> bool:
        """Whether the twin has answered the hello of the present connection."""
        link = self._client.core.link
        return link is not None and link.alive

    @property
    def hello(self) -> HelloResult | None:
        """The twin's answer to the greeting; None without a connection."""
        if self.connected:
            return self._client.core.hello
        return None

    async def run(self) -> None:
        """Keep the connection until canceled: connect again after each loss, with growing
        pauses; may be called again after that.

        `problem` is the reason why there is none, and `on_change` is called when that
        changes. OSError and RpcError of a connection attempt become `problem`; pauses
        start at `FIRST_PAUSE_S`, double up to a limit, and start again after a success.
        `on_change` is called after each attempt and each loss. The connection is closed
        at the end.
        """
        core = self._client.core
        pauses = back_off(FIRST_PAUSE_S)
        try:
            while True:
                try:
                    link = await core.connected()
                except OSError as error:  # ConnectionLost and TimeoutError are ones
                    self._change(str(error))
                except RpcError as error:
                    self._change(
                        f"the twin on {self.address} refuses {self.name}: {error}"
                    )
                else:
                    self._change("")
                    await link.ended()
                    self._change(str(ConnectionLost.of(link.calls, sent=False)))
                    pauses = back_off(FIRST_PAUSE_S)
                await asyncio.sleep(next(pauses))
        finally:
            await core.disconnect()

    async def rename(self, name: str) -> None:
        """Take another name: at once where there is a connection, and in every later hello.

        Raises:
            RpcError: the twin refuses it.
            ConnectionLost: the connection was lost meanwhile; the next one has the name.
        """
        self.name = self._client.core.name = name
        link = self._client.core.link
        if link is not None and link.alive:
            await self._client.core.introduce(link)
            self._on_change()

    async def request(
        self, method: str, params: Mapping[str, object] | None = None
    ) -> object:
        """Send a request over the present connection and wait for its result, however long.

        It never waits for a connection and is never repeated; parameters are {} if None.
        The result is not validated.

        Raises:
            RpcError: the twin's answer is an error; `Unsendable`: the parameters cannot be
                sent.
            ConnectionLost: there is no connection, or it was lost before the answer came.
        """
        link = self._client.core.link
        if link is None or not link.alive:
            raise ConnectionLost(self.problem)
        try:
            return await link.request(method, params or {}, None)
        except ConnectionLost:
            raise
        except (ValueError, TypeError, OverflowError, RecursionError) as error:
            raise Unsendable(method, error) from None

    def put(self, params: Mapping[str, object]) -> None:
        """Call the event handler with topic and params; log its exception without raising
        it.
        """
        try:
            self._on_event(str(params.get("topic")), params)
        except Exception:
            log("an event could not be handled", logging.ERROR, error=True)

    def connection_lost(self) -> None:
        """Do nothing: `run` makes the next connection."""

    def end(self) -> None:
        """Do nothing: the connection is not closed for good."""

    def _change(self, problem: str) -> None:
        self.problem = problem
        self._on_change()
