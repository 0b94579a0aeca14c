"""`TwinClient`: the twin server's methods as blocking, typed Python calls.

It runs the flows of `methods` and `core` by blocking, so it works in scripts, in threads and in a
notebook whose own event loop is running. It refuses to hold a method of its own: parameters and
results are `methods`', the connection's policy is `core`'s, sockets are `transport`'s.
"""

from __future__ import annotations

import ssl as tls
import threading
import time
from types import TracebackType
from typing import TypeVar

from flexdt.clients import methods as m
from flexdt.clients.core import Core
from flexdt.clients.events import Subscription
from flexdt.clients.flows import Alone, Drop, Effect, Exchange, Flow, Open, Pause, Tell, drive
from flexdt.clients.link import Link
from flexdt.clients.methods import FINAL_STATES, Kind, Topic
from flexdt.clients.shells import blocking
from flexdt.clients.transport import TcpTransport, Transport
from flexdt.protocol.results import HelloResult

_R = TypeVar("_R")


class TwinClient:
    """A connection to a twin server; a context manager.

    Errors are `RpcError` with code, message and data, or `ConnectionLost`. Usable from several
    threads.

    Args:
        host, port: of the server.
        token: where the server wants one.
        transport: another way to the server (tests); host, port and ssl are not used then.
        name: of this program, for people who look at the server.
        timeout_s: for an answer; calls that wait for a motion or a job have none.
        reconnect_s: how long to try after the connection was lost.
        wait_s: how long to try at first.
        ssl: TLS context.

    Raises:
        ConnectionLost: nobody answers.
        RpcError: the server does not let us in (-32004), or is another version.
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
        self._transport = TcpTransport(host, port, ssl=ssl) if transport is None else transport
        self._core = Core(
            name=name, token=token, timeout_s=timeout_s, reconnect_s=reconnect_s, wait_s=wait_s
        )
        self._lock = threading.RLock()
        self.run(self._core.connected())

    def __enter__(self) -> TwinClient:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection; control is given back with it."""
        drive(self._core.close(), self._perform)

    @property
    def server(self) -> HelloResult:
        """What the server said of itself when the connection was made."""
        assert self._core.hello is not None
        return self._core.hello

    def run(self, flow: Flow[_R]) -> _R:
        """Run one of `methods`' flows, or your own made of them."""
        return drive(self._core.run(flow), self._perform)

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
            max_rate_hz: at most so many a second and topic.
            projection_kind, projection_binning: of the topic projection.
            max_queue: events kept while nobody iterates; the oldest go first.

        Raises:
            ValueError: this client follows one of the topics with another rate or view already.
        """
        core = self._core
        made = Subscription(
            topics or ("state",), max_queue,
            lambda: drive(core.connected(), self._perform),
            lambda closed: drive(core.unsubscribe(closed), self._perform),
        )  # fmt: skip
        options = {
            "max_rate_hz": max_rate_hz,
            "projection_kind": projection_kind,
            "projection_binning": projection_binning,
        }
        drive(core.subscribe(made, options), self._perform)
        return made

    control = blocking(m.control)
    ping = blocking(m.ping)
    discover = blocking(m.discover)
    state = blocking(m.state)
    move = blocking(m.move)
    jog = blocking(m.jog)
    set_axis = blocking(m.set_axis)
    stop = blocking(m.stop)
    estop = blocking(m.estop)
    reset = blocking(m.reset)
    set_clock = blocking(m.set_clock)
    set_tube = blocking(m.set_tube)
    set_camera = blocking(m.set_camera)
    samples = blocking(m.samples)
    sample_mesh = blocking(m.sample_mesh)
    set_sample = blocking(m.set_sample)
    upload_mesh = blocking(m.upload_mesh)
    upload_voxels = blocking(m.upload_voxels)
    projection = blocking(m.projection)
    geometry = blocking(m.geometry)
    check_script = blocking(m.check_script)
    submit_script = blocking(m.submit_script)
    check_trajectory = blocking(m.check_trajectory)
    submit_trajectory = blocking(m.submit_trajectory)
    jobs = blocking(m.jobs)
    job_status = blocking(m.job_status)
    pause_job = blocking(m.pause_job)
    resume_job = blocking(m.resume_job)
    step_job = blocking(m.step_job)
    abort_job = blocking(m.abort_job)
    wait_job = blocking(m.wait_job)
    apply_calibration = blocking(m.apply_calibration)
    calibration = blocking(m.calibration)
    calibrations = blocking(m.calibrations)
    revert_calibration = blocking(m.revert_calibration)
    save_scene = blocking(m.save_scene)
    load_scene = blocking(m.load_scene)

    def _perform(self, effect: Effect) -> object:
        match effect:
            case Exchange(link, method, params, timeout_s):
                return link.request(method, params, timeout_s)
            case Pause(seconds):
                time.sleep(seconds)
            case Tell(function, args):
                function(*args)
            case Open():
                return Link(self._transport, self._core.deliver, self._core.ended)
            case Drop(link):
                link.close()
            case Alone(flow):
                with self._lock:
                    return drive(flow, self._perform)
        return None


__all__ = ["FINAL_STATES", "TwinClient"]
