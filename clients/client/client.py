"""`TwinClient`: the twin server's methods as blocking, typed Python calls.

It waits for what an `AsyncTwinClient` does on an event loop in a thread of its own, one for all
clients of the process. So it works in scripts, in threads and in a notebook whose own event loop is
running.
"""

from __future__ import annotations

import asyncio
import atexit
import functools
import os
import ssl as tls
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from flexdt.clients.client.async_client import AsyncTwinClient
from flexdt.clients.client.events import Subscription
from flexdt.clients.client.flows import Effect, Flow, Tell, drive, perform
from flexdt.clients.client.shared_methods import SharedMethods
from flexdt.clients.client.transport import Transport
from flexdt.clients.client.twin_methods import Kind, Topic
from flexdt.protocol.methods.session_messages import HelloResult
from flexdt.twin.signatures import public

_R = TypeVar("_R")


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="flexdt-clients", daemon=True).start()
    atexit.register(_end_links)
    return loop


def _end_links() -> None:
    """End the connections of clients that were not closed, before the loop goes with Python."""

    async def cancel() -> None:
        readers = asyncio.all_tasks() - {asyncio.current_task()}
        for reader in readers:
            reader.cancel()
        await asyncio.gather(*readers, return_exceptions=True)

    _result(cancel())


if hasattr(os, "register_at_fork"):  # a forked process has no thread that runs the loop
    os.register_at_fork(after_in_child=_loop.cache_clear)


def _result(work: Coroutine[Any, Any, _R]) -> _R:
    """What `work` returns on the loop; an interrupt of the thread that waits here cancels it."""
    doing = asyncio.run_coroutine_threadsafe(work, _loop())
    try:
        return doing.result()
    except BaseException:
        doing.cancel()
        raise


class TwinClient(SharedMethods):
    """A connection to a twin server; a context manager, usable from several threads.

    Errors of all methods are `RpcError` with code, message and data, or `ConnectionLost`.

    Args:
        host, port: of the server.
        token: where the server requires one.
        transport: replaces TCP (for tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer [s]; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost [s].
        wait_s: how long to try the first time [s].
        ssl: TLS context; None for plain TCP.

    Raises:
        ConnectionLost: no server answers.
        RpcError: the server refuses the client (-32004), or is another version.

    Example:
        >>> with TwinClient("127.0.0.1", 55000) as twin:  # doctest: +SKIP
        ...     twin.move({"mag_obj": 660.0, "rot_obj": 90.0}, wait=True)
        ...     image = twin.projection("counts").image
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
        self._client = AsyncTwinClient(
            host, port, token, transport,
            name=name, timeout_s=timeout_s, reconnect_s=reconnect_s, wait_s=wait_s, ssl=ssl,
        )  # fmt: skip
        self._wait(self._client.connect())

    def __repr__(self) -> str:
        return f"<TwinClient: {self._client.core.transport!r}>"

    def __enter__(self) -> TwinClient:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; this releases control."""
        self._wait(self._client.close())

    @property
    def server(self) -> HelloResult:
        """The server's answer to the hello of the newest connection."""
        return self._client.server

    def run(self, flow: Flow[_R]) -> _R:
        """Run a flow of `twin_methods`, or your own made of them."""
        return drive(flow, self._perform)

    def subscribe(
        self,
        *topics: Topic,
        max_rate_hz: float | None = None,
        projection_kind: Kind | None = None,
        projection_binning: int | None = None,
        max_queue: int = 256,
    ) -> Subscription:
        """Events of `topics` (default: state), to iterate over.

        Args:
            topics: state, projection, job, log.
            max_rate_hz: most events per second for each topic.
            projection_kind, projection_binning: for the topic projection.
            max_queue: events kept until they are read; the oldest are dropped first.

        Raises:
            ValueError: this client already follows one of the topics with other options.
        """
        events = self._client.subscribe(
            *topics, max_rate_hz=max_rate_hz, projection_kind=projection_kind,
            projection_binning=projection_binning, max_queue=max_queue,
        )  # fmt: skip
        self._wait(events.__aenter__())
        return Subscription(events, self._wait)

    def _perform(self, effect: Effect) -> object:
        if isinstance(effect, Tell):  # in the thread that calls, where it may call the client
            return effect.function(*effect.args)
        return self._wait(perform(effect, self._client.core.call))

    def _wait(self, work: Coroutine[Any, Any, _R]) -> _R:
        return _result(work)
