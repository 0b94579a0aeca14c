"""session.*, state.* and rpc.discover."""

from __future__ import annotations

from functools import cache
from typing import Any

from flexdt.protocol import PROTOCOL, openrpc, require_compatible
from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state_model as w
from flexdt.protocol.fields import Empty, Nothing
from flexdt.server.scans.job import ENDED
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client
from flexdt.server.twin.hub import ImageWish


def hello(twin: TwinServer, client: Client, params: p.Hello) -> r.HelloResult:
    """Greet a client whose token `network.shell_parts.TokenCheck` has found right."""
    require_compatible(params.protocol)
    client.program = params.client
    return r.HelloResult(
        protocol=PROTOCOL,
        server=f"flexdt {twin.version}",
        machine=twin.machine.name,
        profile=twin.profile.name,
        session=client.name,
        physics=twin.radiography.physics,
    )


def control(twin: TwinServer, client: Client, params: p.Control) -> r.ControlResult:
    """One controller at a time."""
    before = twin.control.holder
    match params.action:
        case "acquire":
            twin.control.require(client.name, "session.control acquire")
        case "release":
            twin.control.release(client.name)
        case "force":
            loser = twin.control.force(client.name)
            if loser is not None:
                twin.tell("warning", f"{client.name} took control from {loser}")
    twin.feed.changed()
    holder = twin.control.holder
    if before is not None and holder != before:
        twin.detours.cancel()  # what the last controller planned ends with the present leg
    return r.ControlResult(controller=holder, yours=holder == client.name)


def ping(twin: TwinServer, client: Client, params: Empty) -> r.Pong:
    """A sign of life."""
    return r.Pong(time=twin.clock.now())


def get_state(twin: TwinServer, client: Client, params: Empty) -> w.State:
    """Everything."""
    return twin.state()


def subscribe(twin: TwinServer, client: Client, params: p.Subscribe) -> Nothing:
    """Events from now on; the present state, image and jobs come at once."""
    view = ImageWish(params.projection_kind, params.projection_binning)
    twin.hub.subscribe(client.peer, params.topics, params.max_rate_hz, view)
    if "state" in params.topics:
        twin.hub.snapshot(client.peer, "state", twin.state())
    if "projection" in params.topics:
        twin.live.changed(again=True)
    if "job" in params.topics:
        for job in twin.jobs.all():
            if job.phase not in ENDED or job is twin.jobs.get(None):
                twin.hub.snapshot(client.peer, "job", twin.jobs.status(job), slot=job.id)
    return Nothing()


def unsubscribe(twin: TwinServer, client: Client, params: p.Unsubscribe) -> Nothing:
    """No more of these."""
    twin.hub.unsubscribe(client.peer, params.topics)
    return Nothing()


def discover(twin: TwinServer, client: Client, params: Empty) -> dict[str, Any]:
    """The wire as an OpenRPC document."""
    return document()


document = cache(openrpc.document)
"""Made once: it takes 0.1 s of the loop."""
