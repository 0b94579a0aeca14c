"""One connection to the twin for all of a laboratory's devices, and the newest known state.

Requests go through an `AsyncTwinClient`; one subscription serves all watchers.
"""

from __future__ import annotations

import asyncio
import contextlib
import ssl as tls
from collections.abc import AsyncIterator, Callable

from flexdt.clients.client.async_client import AsyncTwinClient
from flexdt.clients.client.transport import ConnectionLost
from flexdt.protocol.state_model import State

Watcher = Callable[[State], None]

RATE_HZ = 20.0
"""At most this many states per second reach a watcher."""

PATIENCE_S = 0.1
"""How long to wait for an event before the state is requested."""


class LabConnection:
    """The twin, as devices need it; used from the event loop that connects it (RunEngine's).

    Args:
        host, port, token, ssl: of the twin server.

    Attributes:
        client: for all methods of the twin.
        state: the newest known; None before the first connection.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        *,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        self.address = f"{host}:{port}"
        self.client = AsyncTwinClient(host, port, token, name="flexdt.clients.lab", ssl=ssl)
        self.state: State | None = None
        self._watchers: list[Watcher] = []
        self._news = asyncio.Event()
        self._connecting = asyncio.Lock()
        self._pump: asyncio.Task[None] | None = None

    async def connect(self) -> None:
        """Connect, once.

        Raises:
            ConnectionLost: no server answers.
            RpcError: the server refuses the client.
        """
        async with self._connecting:
            if self._pump is not None and not self._pump.done():
                return
            await self.client.connect()
            await self.fresh()
            self._pump = asyncio.create_task(self._listen(), name="flexdt-lab")

    async def close(self) -> None:
        """End the connection."""
        if self._pump is not None:
            self._pump.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._pump
        await self.client.close()

    async def fresh(self) -> State:
        """Request the present state."""
        state = await self.client.state()
        self._take(state)
        if self._pump is not None and self._pump.done():  # the twin was gone for too long
            self._pump = asyncio.create_task(self._listen(), name="flexdt-lab")
        return state

    def watch(self, watcher: Watcher) -> Callable[[], None]:
        """Call `watcher` with every new state; the returned function ends that."""
        self._watchers.append(watcher)
        if self.state is not None:
            watcher(self.state)

        def end() -> None:
            if watcher in self._watchers:
                self._watchers.remove(watcher)

        return end

    async def states(self) -> AsyncIterator[State]:
        """Fresh states: one at once, then one after every change of the twin."""
        while True:
            self._news.clear()
            yield await self.fresh()
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(PATIENCE_S):
                    await self._news.wait()

    async def _listen(self) -> None:
        async with self.client.subscribe("state", "job", max_rate_hz=RATE_HZ) as events:
            with contextlib.suppress(ConnectionLost):
                async for event in events:
                    if isinstance(event.data, State):
                        self._take(event.data)
                    self._news.set()

    def _take(self, state: State) -> None:
        if self.state is not None and state.time < self.state.time:
            return  # an event that is older than the answer to a request
        self.state = state
        for watcher in list(self._watchers):
            watcher(state)
