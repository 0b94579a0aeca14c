"""`AsyncTwinClient`: the twin server's methods as coroutines, any number of them at once.

The sibling of `TwinClient` with the same methods, results and policy; it runs the flows of
`methods` and `core` in an event loop and differs in nothing but how it waits.
"""

from __future__ import annotations

import asyncio
import inspect
import ssl as tls
from types import TracebackType
from typing import TypeVar

from flexdt.clients import methods as m
from flexdt.clients.async_link import AsyncLink, AsyncTcpTransport, AsyncTransport
from flexdt.clients.core import Core
from flexdt.clients.events import AsyncSubscription
from flexdt.clients.flows import Alone, Drop, Effect, Exchange, Flow, Open, Pause, Tell, adrive
from flexdt.clients.methods import Kind, Topic
from flexdt.clients.shells import awaited
from flexdt.protocol.results import HelloResult

_R = TypeVar("_R")


class AsyncTwinClient:
    """A connection to a twin server; an async context manager.

    It connects on entering, or with the first call. Errors are `TwinClient`'s. A cancelled call is
    not waited for any more; what it asked for may still happen (`stop` brakes a motion).

    Args:
        host, port: of the server.
        token: where the server wants one.
        transport: another way to the server; host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost.
        wait_s: how long to try at first.
        ssl: TLS context.
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 55000,
        token: str | None = None,
        transport: AsyncTransport | None = None,
        *,
        name: str = "flexdt.clients",
        timeout_s: float = 30.0,
        reconnect_s: float = 10.0,
        wait_s: float = 0.0,
        ssl: tls.SSLContext | None = None,
    ) -> None:
        self._transport = AsyncTcpTransport(host, port, ssl=ssl) if transport is None else transport
        self._core = Core(
            name=name, token=token, timeout_s=timeout_s, reconnect_s=reconnect_s, wait_s=wait_s
        )
        self._lock = asyncio.Lock()

    async def connect(self) -> AsyncTwinClient:
        """Connect now; returns the client.

        Raises:
            ConnectionLost: nobody answers.
            RpcError: the server does not let us in (-32004), or is another version.
        """
        await self.run(self._core.connected())
        return self

    async def __aenter__(self) -> AsyncTwinClient:
        return await self.connect()

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection; control is given back with it."""
        await adrive(self._core.close(), self._perform)

    @property
    def server(self) -> HelloResult:
        """What the server said of itself when the connection was made.

        Raises:
            RuntimeError: there has been no connection yet.
        """
        if self._core.hello is None:
            raise RuntimeError("not connected yet: await connect(), or use `async with`")
        return self._core.hello

    async def run(self, flow: Flow[_R]) -> _R:
        """Run one of `methods`' flows, or your own made of them."""
        return await adrive(self._core.run(flow), self._perform)

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
            max_rate_hz: at most so many a second and topic.
            projection_kind, projection_binning: of the topic projection.
            max_queue: events kept while nobody iterates; the oldest go first.

        Raises:
            ValueError: this client follows one of the topics with another rate or view already.
        """
        core = self._core
        options = {
            "max_rate_hz": max_rate_hz,
            "projection_kind": projection_kind,
            "projection_binning": projection_binning,
        }
        return AsyncSubscription(
            topics or ("state",), max_queue,
            lambda made: adrive(core.subscribe(made, options), self._perform),
            lambda: adrive(core.connected(), self._perform),
            lambda closed: adrive(core.unsubscribe(closed), self._perform),
        )  # fmt: skip

    control = awaited(m.control)
    ping = awaited(m.ping)
    discover = awaited(m.discover)
    state = awaited(m.state)
    move = awaited(m.move)
    jog = awaited(m.jog)
    set_axis = awaited(m.set_axis)
    stop = awaited(m.stop)
    estop = awaited(m.estop)
    reset = awaited(m.reset)
    set_clock = awaited(m.set_clock)
    set_tube = awaited(m.set_tube)
    set_camera = awaited(m.set_camera)
    samples = awaited(m.samples)
    sample_mesh = awaited(m.sample_mesh)
    set_sample = awaited(m.set_sample)
    upload_mesh = awaited(m.upload_mesh)
    upload_voxels = awaited(m.upload_voxels)
    projection = awaited(m.projection)
    geometry = awaited(m.geometry)
    check_script = awaited(m.check_script)
    submit_script = awaited(m.submit_script)
    check_trajectory = awaited(m.check_trajectory)
    submit_trajectory = awaited(m.submit_trajectory)
    jobs = awaited(m.jobs)
    job_status = awaited(m.job_status)
    pause_job = awaited(m.pause_job)
    resume_job = awaited(m.resume_job)
    step_job = awaited(m.step_job)
    abort_job = awaited(m.abort_job)
    wait_job = awaited(m.wait_job)
    apply_calibration = awaited(m.apply_calibration)
    calibration = awaited(m.calibration)
    calibrations = awaited(m.calibrations)
    revert_calibration = awaited(m.revert_calibration)
    save_scene = awaited(m.save_scene)
    load_scene = awaited(m.load_scene)

    async def _perform(self, effect: Effect) -> object:
        match effect:
            case Exchange(link, method, params, timeout_s):
                return await link.request(method, params, timeout_s)
            case Pause(seconds):
                await asyncio.sleep(seconds)
            case Tell(function, args):
                told = function(*args)
                if inspect.isawaitable(told):
                    await told
            case Open():
                core = self._core
                return await AsyncLink.opened(self._transport, core.deliver, core.ended)
            case Drop(link):
                await link.close()
            case Alone(flow):
                async with self._lock:
                    return await adrive(flow, self._perform)
        return None


__all__ = ["AsyncTwinClient"]
