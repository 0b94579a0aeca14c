"""`AsyncTwinClient`: the twin server's methods as coroutines, any number of them at once.

It has the methods, results and policy of `TwinClient`, which waits for it in another thread.
"""

from __future__ import annotations

import asyncio
import inspect
import ssl as tls
from typing import TypeVar

from flexdt.clients.client import twin_methods as m
from flexdt.clients.client.events import AsyncSubscription
from flexdt.clients.client.flows import Ask, Effect, Flow, Sleep, Tell, adrive, awaited
from flexdt.clients.client.policy import Core
from flexdt.clients.client.transport import TcpTransport, Transport
from flexdt.clients.client.twin_methods import Kind, Topic
from flexdt.protocol.results import HelloResult

_R = TypeVar("_R")


class AsyncTwinClient:
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
        return await adrive(flow, self._perform)

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
    upload_scene = awaited(m.upload_scene)
    upload_voxels = awaited(m.upload_voxels)
    projection = awaited(m.projection)
    geometry = awaited(m.geometry)
    predict_exposure = awaited(m.predict_exposure)
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
    datasets = awaited(m.datasets)
    dataset = awaited(m.dataset)
    dataset_frame = awaited(m.dataset_frame)
    apply_calibration = awaited(m.apply_calibration)
    calibration = awaited(m.calibration)
    calibrations = awaited(m.calibrations)
    revert_calibration = awaited(m.revert_calibration)
    fit_calibration = awaited(m.fit_calibration)
    align_dataset = awaited(m.align_dataset)
    save_scene = awaited(m.save_scene)
    load_scene = awaited(m.load_scene)

    async def _perform(self, effect: Effect) -> object:
        match effect:
            case Ask():
                return await self.core.call(effect)
            case Sleep(seconds):
                await asyncio.sleep(seconds)
            case Tell(function, args):
                told = function(*args)
                if inspect.isawaitable(told):
                    await told
        return None
