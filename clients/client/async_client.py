"""`AsyncTwinClient`: the twin server's methods as coroutines, any number of them at once.

It has the methods, results and policy of `TwinClient`, which waits for it in another thread.
"""

from __future__ import annotations

import ssl as tls
from typing import TypeVar

from flexdt.clients.client.events import AsyncSubscription
from flexdt.clients.client.flows import Flow, adrive
from flexdt.clients.client.policy import Core
from flexdt.clients.client.shared_methods import SharedMethods
from flexdt.clients.client.transport import TcpTransport, Transport
from flexdt.clients.client.twin_methods import Kind, Topic
from flexdt.protocol.methods.session_messages import HelloResult
from flexdt.twin.signatures import public

_R = TypeVar("_R")


class AsyncTwinClient(SharedMethods):
    """A connection to a twin server; an async context manager.

    It connects on entering, or with the first call. Errors are `TwinClient`'s. A call that is
    cancelled may still be carried out by the server (use `stop` to end a motion).

    Args:
        host, port: of the server.
        token: where the server requires one.
        transport: replaces TCP (for tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer [s]; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost [s].
        wait_s: how long to try the first time [s].
        ssl: TLS context; None for plain TCP.

    Attributes:
        core: the connection, by the policy.

    Example:
        >>> async def turn() -> None:  # doctest: +SKIP
        ...     async with AsyncTwinClient("127.0.0.1", 55000) as twin:
        ...         await twin.move({"rot_obj": 90.0}, wait=True)
    """

    @public
    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        transport: Transport | None = None,
        *,
        name: str = "flexdt.clients",
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        self.core = Core(
            TcpTransport(host, port, ssl=ssl) if transport is None else transport,
            name=name, token=token, timeout_s=timeout_s, reconnect_s=reconnect_s, wait_s=wait_s,
        )  # fmt: skip

    async def connect(self) -> AsyncTwinClient:
        """Connect now; returns the client.

        Raises:
            ConnectionLost: no server answers.
            RpcError: the server refuses the client (-32004), or is another version.
        """
        await self.core.connected()
        return self

    async def __aenter__(self) -> AsyncTwinClient:
        return await self.connect()

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection; this releases control."""
        await self.core.close()

    @property
    def server(self) -> HelloResult:
        """The server's answer to the hello of the newest connection.

        Raises:
            RuntimeError: there has been no connection yet.
        """
        if self.core.hello is None:
            raise RuntimeError("not connected yet: await connect(), or use `async with`")
        return self.core.hello

    async def run(self, flow: Flow[_R]) -> _R:
        """Run a flow of `twin_methods`, or your own made of them."""
        return await adrive(flow, self.core.call)

    def subscribe(
        self,
        *topics: Topic,
        max_rate_hz: float | None = None,
        projection_kind: Kind | None = None,
        projection_binning: int | None = None,
        max_queue: int = 256,
    ) -> AsyncSubscription:
        """Events of `topics` (default: state), for `async with` and `async for`.

        Args:
            topics: state, projection, job, log.
            max_rate_hz: most events per second for each topic.
            projection_kind, projection_binning: for the topic projection.
            max_queue: events kept until they are read; the oldest are dropped first.

        Raises:
            ValueError: this client already follows one of the topics with other options.
        """
        core = self.core
        options = {
            "max_rate_hz": max_rate_hz,
            "projection_kind": projection_kind,
            "projection_binning": projection_binning,
        }
        return AsyncSubscription(
            topics or ("state",), max_queue,
            lambda made: core.subscribe(made, options), core.connected, core.unsubscribe,
        )  # fmt: skip
