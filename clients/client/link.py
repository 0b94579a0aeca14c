"""One connection's life in an event loop: one task reads, any number of tasks send requests."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from typing import Any

from flexdt.clients.client.transport import ConnectionLost, Transport
from flexdt.protocol import Answered, Correlation, Message, Notification, ProtocolError, Role


class Link:
    """An open connection; made by `opened`.

    Attributes:
        alive: until the connection has ended.
        calls: its open requests; `calls.reason` is what the server reported about the connection.
    """

    def __init__(
        self,
        transport: Transport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> None:
        self._transport, self._on_event, self._on_end = transport, on_event, on_end
        self.calls: Correlation[asyncio.Future[Answered[Any]]] = Correlation(Role.CLIENT)
        self.alive = True
        self._reader = asyncio.create_task(self._read(), name="flexdt-link")

    @classmethod
    async def opened(
        cls,
        transport: Transport,
        on_event: Callable[[Mapping[str, object]], None],
        on_end: Callable[[], None],
    ) -> Link:
        """Connect.

        Raises:
            ConnectionLost: no server answers.
        """
        await transport.open()
        return cls(transport, on_event, on_end)

    async def request(
        self, method: str, params: Mapping[str, object], timeout_s: float | None
    ) -> object:
        """Send a request and wait for its result.

        Raises:
            RpcError: the server's answer is an error.
            ConnectionLost: the connection ended; `.sent` says whether the request had been sent.
            TimeoutError: no answer in time.
        """
        if not self.alive:
            raise ConnectionLost.of(self.calls, sent=False)
        waiter: asyncio.Future[Answered[Any]] = asyncio.get_running_loop().create_future()
        request = self.calls.request(method, params, waiter)
        # A call cancelled while it sends may have handed its bytes over, so its answer may come.
        sent = True
        try:
            async with asyncio.timeout(timeout_s) as limit:
                try:
                    await self._transport.send(request)
                except Exception:
                    sent = False
                    raise
                return (await waiter).result()
        except TimeoutError:
            if not limit.expired():
                raise
            raise TimeoutError(f"no answer to {method} within {timeout_s:g} s") from None
        finally:
            self.calls.abandon(request, sent=sent)
            waiter.cancel()

    async def ended(self) -> None:
        """Wait until the connection has ended."""
        await asyncio.wait([self._reader])

    async def close(self) -> None:
        """End the connection; waiting requests fail."""
        self._transport.close()
        self._reader.cancel()
        await self.ended()

    async def _read(self) -> None:
        try:
            while messages := await self._transport.receive():
                for message in messages:
                    self._take(message)
        except ProtocolError as violation:
            self.calls.violate(violation)
            self._transport.close()
        finally:
            self.alive = False
            for waiter in self.calls.waiting():
                if not waiter.done():
                    waiter.set_exception(ConnectionLost.of(self.calls, sent=True))
            self._on_end()

    def _take(self, message: Message) -> None:
        for item in self.calls.receive(message):
            match item:
                case Answered(waiter) if not waiter.done():
                    waiter.set_result(item)
                case Notification("event", params) if isinstance(params, Mapping):
                    self._on_event(params)
