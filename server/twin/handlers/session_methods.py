"""session.* and state.*."""

from __future__ import annotations

from flexdt.protocol import PROTOCOL, require_compatible
from flexdt.protocol import state_model as w
from flexdt.protocol.fields import Empty, Nothing
from flexdt.protocol.methods import session_messages as p
from flexdt.server.scans.job import ENDED
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers
from flexdt.server.twin.hub import ImageWish


@answers(p.SESSION_HELLO)
def hello(twin: TwinServer, client: Client, params: p.Hello) -> p.HelloResult:
    """Greet a client whose token `network.shell_parts.TokenCheck` has found right."""
    require_compatible(params.protocol)
    client.program = client.program or params.client  # control goes by the name
    return p.HelloResult(
        protocol=PROTOCOL,
        server=f"flexdt {twin.version}",
        machine=twin.machine.name,
        profile=twin.profile.name,
        session=client.name,
        physics=twin.radiography.physics,
    )


@answers(p.SESSION_CONTROL)
def control(twin: TwinServer, client: Client, params: p.Control) -> p.ControlResult:
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
    return p.ControlResult(controller=holder, yours=holder == client.name)


@answers(p.SESSION_PING)
def ping(twin: TwinServer, client: Client, params: Empty) -> p.Pong:
    """A sign of life."""
    return p.Pong(time=twin.clock.now())


@answers(p.STATE_GET)
def get_state(twin: TwinServer, client: Client, params: Empty) -> w.State:
    """Everything."""
    return twin.state()


@answers(p.STATE_SUBSCRIBE)
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


@answers(p.STATE_UNSUBSCRIBE)
def unsubscribe(twin: TwinServer, client: Client, params: p.Unsubscribe) -> Nothing:
    """No more of these."""
    twin.hub.unsubscribe(client.peer, params.topics)
    return Nothing()
