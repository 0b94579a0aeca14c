"""The twin server as an application behind the TCP shell: connections to sessions to handlers.

A session checks who may command, calls the handler of the method, and turns the twin's
exceptions into the wire's errors. The methods are in `handlers`. The pages for monitoring
show the twin's health; the scanner's details are in `state.get`.
"""

from __future__ import annotations

import inspect
from collections import Counter
from contextlib import AbstractContextManager, nullcontext
from typing import get_args

from prometheus_client import Metric

from flexdt.protocol import AnyMethod
from flexdt.protocol.fields import Params, TopicName
from flexdt.protocol.state_model import JobPhase
from flexdt.runtime.fair_turns import REQUESTER, Requester
from flexdt.runtime.files.directory import free_bytes
from flexdt.runtime.http_pages import Pages, Requests, counter, gauge, watching_pages
from flexdt.runtime.wire_errors import explain, is_user_error
from flexdt.server.imaging.projector_pool import ProjectorPool
from flexdt.server.network.shell_parts import Peer
from flexdt.server.network.tcp import TcpServer
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers import HANDLERS
from flexdt.server.twin.handlers.handler import Client
from flexdt.twin.scanner.state import SafetyName


class TwinSession:
    """One client connection to the twin."""

    def __init__(self, twin: TwinServer, peer: Peer) -> None:
        """Begin the session of a connection with the twin."""
        self._twin = twin
        self._client = client = Client(peer)
        self._requester = Requester(peer, lambda: twin.control.holder == client.name)

    async def handle(self, method: AnyMethod, params: Params) -> object:
        """Answer one call: renew the client's lease, take control where the method needs
        it, and call the method's handler.

        Methods that move by hand are refused while a job runs; during such a call no
        paused job resumes by itself.

        Args:
            method: of the wire.
            params: validated.

        Returns:
            The handler's result; a result that must be awaited is awaited here.

        Raises:
            RpcError: the wire's form of any error that a user can cause; -32003 if
                another client is the controller or a job runs.
            Exception: a programming error, as it is.
        """
        twin = self._twin
        client = self._client
        twin.control.heard(client.name)
        REQUESTER.set(self._requester)
        client.serving.append(method.name)
        twin.in_service += 1
        try:
            if method.control:
                self._take_control(method.name)
            by_hand: AbstractContextManager[None] = nullcontext()
            if method.by_hand:
                twin.jobs.require_idle(method.name)
                by_hand = twin.jobs.manual_control()
            with by_hand:
                result = HANDLERS[method.name](twin, client, params)
                if inspect.isawaitable(result):
                    return await result
                return result
        except Exception as error:
            if is_user_error(error):
                raise explain(error, twin.root) from None
            raise
        finally:
            client.serving.remove(method.name)
            twin.in_service -= 1

    def close(self) -> None:
        """End the session of a closed connection: drop its subscriptions, release its
        control, and publish the state.

        If it was the controller, its way around obstacles ends with the leg under way.
        Other motion goes on."""
        if self._twin.control.holder == self._client.name:
            self._twin.detours.cancel()  # the controller's way ends with the present leg
        self._twin.hub.drop(self._client.peer)
        self._twin.control.release(self._client.name)
        self._twin.feed.changed()

    def _take_control(self, what: str) -> None:
        """Take control for the client if it is free, and renew its lease.

        Raises RpcError: -32003.
        """
        before = self._twin.control.holder
        self._twin.control.require(self._client.name, what)
        if before != self._twin.control.holder:
            self._twin.feed.changed()


def twin_pages(
    twin: TwinServer,
    server: TcpServer,
    projector: ProjectorPool,
    requests: Requests,
) -> Pages:
    """Make the pages /healthz and /metrics of a running twin server.

    /healthz answers 503 after a part of the twin has failed for good.

    Args:
        twin, server, projector: whose figures they show.
        requests: counts of answered calls.
    """

    def health() -> dict[str, object]:
        """Return the facts of `/healthz`: "server" with its version, "projector"
        ("connected" or "not connected"), "job" with id and phase, or None.
        """
        job = twin.jobs.current
        return {
            "server": f"flexdt {twin.version}",
            "projector": "connected" if projector.connected else "not connected",
            "job": None if job is None else {"job": job.id, "state": job.phase},
        }

    return watching_pages(
        health,
        lambda: _figures(twin, server, projector),
        requests,
        failed=twin.failed.is_set,
    )


def _figures(
    twin: TwinServer, server: TcpServer, projector: ProjectorPool
) -> list[Metric]:
    """List the metrics of the twin server as read now; metrics of requests are not among
    them.

    They are connections, events by topic, jobs by phase, frames, safety state, clock,
    speed, projector and its views, and free disk space [bytes]. Free space is left out
    where the system does not report it; an unknown real-time factor is 0.
    """
    jobs = Counter(job.phase for job in twin.jobs.all())
    phases: dict[str, float] = {phase: jobs[phase] for phase in get_args(JobPhase)}
    events: dict[str, float] = {
        topic: twin.hub.count(topic) for topic in get_args(TopicName)
    }
    in_force = twin.scanner.safety.state
    safety = {state: float(in_force == state) for state in get_args(SafetyName)}
    factor = twin.clock.real_time_factor
    views = projector.views
    free = free_bytes(twin.root)
    if free is not None:
        room = [gauge("flexdt_data_free_bytes", "Room on the data disk.", free)]
    else:
        room = []
    return [
        gauge("flexdt_connections", "Clients connected.", len(server.links)),
        counter(
            "flexdt_connections_total", "Clients that ever connected.", server.opened
        ),
        counter("flexdt_events_total", "Events published, by topic.", events, "topic"),
        gauge("flexdt_jobs", "Jobs known, by state.", phases, "state"),
        counter(
            "flexdt_frames_total", "Projections of scans made.", twin.jobs.frames_made
        ),
        gauge("flexdt_safety", "1 for the safety state in force.", safety, "state"),
        gauge("flexdt_clock_seconds", "The twin's clock.", twin.clock.now()),
        gauge("flexdt_real_time_factor", "Twin seconds a second.", factor or 0.0),
        gauge("flexdt_projector_connected", "Whether there is one.", projector.connected),
        counter(
            "flexdt_projector_views_total", "Views by projector.", views, "projector"
        ),
        *room,
    ]
