"""session.*, state.*, scene.* and rpc.discover: clients, complete state, the wire itself."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from functools import cache
from typing import Any, assert_never

from flexdt.protocol import PROTOCOL, require_compatible
from flexdt.protocol import state_model as w
from flexdt.protocol.fields import Empty, Nothing
from flexdt.protocol.methods import document_messages as d
from flexdt.protocol.methods import openrpc_document
from flexdt.protocol.methods import session_messages as p
from flexdt.server.scans.scan_job import ENDED_PHASES
from flexdt.server.storage.scene_document import require_fit, sample_of, save_scene
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers, change_stage, ensure_idle
from flexdt.server.twin.hub import ImageRequest
from flexdt.twin.errors import SafetyError

document = cache(openrpc_document)
"""OpenRPC document, made once: it takes 0.1 s of the loop."""


@answers(p.SESSION_HELLO)
def hello(twin: TwinServer, client: Client, params: p.Hello) -> p.HelloResult:
    """Check the protocol's version, note the client's program name, and return the facts
    of the server.

    A later hello may bring another name, and control goes along with it. The token has been
    checked before, by `network.shell_parts.TokenCheck`.

    Returns:
        Protocol, server's version, machine, profile, session (the client's name),
        physics, and instance of this run.

    Raises:
        RpcError: another version of the protocol.
    """
    require_compatible(params.protocol)
    before = client.name
    client.program = params.client
    if client.name != before:
        twin.control.rename(before, client.name)
        twin.feed.changed()
    return p.HelloResult(
        protocol=PROTOCOL,
        server=f"flexdt {twin.version}",
        machine=twin.machine.name,
        profile=twin.profile.name,
        session=client.name,
        physics=twin.radiography.physics,
        rays=twin.radiography.rays,
        instance=twin.instance,
    )


@answers(p.SESSION_CONTROL)
def control(twin: TwinServer, client: Client, params: p.Control) -> p.ControlResult:
    """Acquire, release or force control, and publish the state; there is one controller
    at a time.

    Acquire renews the controller's own lease. Release by another than the controller
    changes nothing. Force takes control from a controller and logs that. When a
    controller loses or releases control, its way around obstacles is canceled.

    Returns:
        The controller (None: nobody), and whether it is the client.

    Raises:
        RpcError: -32003, acquire while another client is the controller.
    """
    before = twin.control.holder
    match params.action:
        case "acquire":
            twin.control.require(client.name, "session.control acquire")
        case "release":
            twin.control.release(client.name)
        case "force":
            loser = twin.control.force(client.name)
            if loser is not None:
                told = f"{client.name} took control from {loser}"
                twin.tell("warning", told, about="control")
        case _:
            assert_never(params.action)
    twin.feed.changed()
    holder = twin.control.holder
    if before is not None and holder != before:
        twin.detours.cancel()  # the last controller's way ends with the present leg
    return p.ControlResult(controller=holder, yours=holder == client.name)


@answers(p.SESSION_PING)
def ping(twin: TwinServer, client: Client, params: Empty) -> p.Pong:
    """Return a sign of life, and what is being worked at for the client."""
    watch = twin.projector_watch
    return p.Pong(
        time=twin.clock.now(),
        serving=[name for name in client.serving if name != p.SESSION_PING.name],
        working=None if watch is None else watch.working,
    )


@answers(p.STATE_GET)
def get_state(twin: TwinServer, client: Client, params: Empty) -> w.State:
    """Return the state."""
    return twin.state()


@answers(p.STATE_SUBSCRIBE)
def subscribe(twin: TwinServer, client: Client, params: p.Subscribe) -> Nothing:
    """Subscribe the client to topics, and send at once the state, an image and jobs,
    where they are among the topics.

    Of the jobs those are sent that have not ended, and the current or last one. A second
    call changes rate and view.
    """
    view = ImageRequest(params.projection_kind, params.projection_binning)
    twin.hub.subscribe(client.peer, params.topics, params.max_rate_hz, view)
    if "state" in params.topics:
        twin.hub.snapshot(client.peer, "state", twin.state())
    if "projection" in params.topics:
        twin.live.changed(again=True)
    if "job" in params.topics:
        for job in twin.jobs.all():
            if job.phase not in ENDED_PHASES or job is twin.jobs.get(None):
                twin.hub.snapshot(client.peer, "job", twin.jobs.status(job), slot=job.id)
    return Nothing()


@answers(p.STATE_UNSUBSCRIBE)
def unsubscribe(twin: TwinServer, client: Client, params: p.Unsubscribe) -> Nothing:
    """End subscriptions to these topics; others are ignored."""
    twin.hub.unsubscribe(client.peer, params.topics)
    return Nothing()


@answers(d.SCENE_SAVE)
def save(twin: TwinServer, client: Client, params: d.SceneSave) -> d.SceneResult:
    """Return a scene of the present: motors' targets, settings, sample and correction;
    the server stores nothing.
    """
    scene = save_scene(
        twin.scanner,
        twin.clock.now(),
        name=params.name or "",
        saved=datetime.now(UTC).isoformat(timespec="seconds"),
        version=twin.version,
    )
    return d.SceneResult(document=scene.model_dump(mode="json", by_alias=True))


@answers(d.SCENE_LOAD)
async def load(twin: TwinServer, client: Client, params: d.SceneLoad) -> d.SceneLoaded:
    """Load a scene: check all of it, the motion included, then change stage, correction
    and settings and start the motors.

    A scene without a correction ends the one in force. It needs control and an idle twin,
    after the sample is read and when it is done. Positions beyond the travel have the
    rule of a request by itself (`limit_messages`). Its warnings are in the log, too.

    Returns:
        The complete state afterwards, and the warnings: positions set to the limit, and
        motion that was halted.

    Raises:
        RpcError: -32602, another machine's; -32003, a job runs or the client has no
            control.
        SafetyError: motion was stopped meanwhile.
    """
    scene = params.document
    stops = twin.scanner.stops
    require_fit(scene, twin.scanner)
    sample = sample_of(scene)
    if sample.name:
        async with twin.samples.turn:
            await asyncio.to_thread(twin.samples.load, sample.name, sample.material)

    def ready() -> None:
        """Raise if motion was stopped since the request, another client has control, or a
        job runs; in that order.
        """
        if twin.scanner.stops != stops:
            raise SafetyError(
                "the scene is not loaded: motion was stopped meanwhile",
                {"asked": "scene.load", "allowed": "asking again"},
            )
        ensure_idle(twin, client, "scene.load", "a scene")()

    ready()
    async with twin.stage_turn:
        correction = None
        in_force = twin.corrections.in_force
        if scene.correction is not None:
            c = scene.correction
            correction = twin.corrections.make(
                c.parameters, c.name, c.comment, sides_known=c.sides_known
            )
        history = None
        if correction != in_force:
            history = twin.corrections.after(correction)
        limits = twin.scanner.limit_messages(scene.positions, twin.clock.now())
        halted = await change_stage(
            twin, sample, correction, ready, history=history, source="scene", scene=scene
        )
    warnings = [*limits, *halted]
    for warning in warnings:
        twin.tell("warning", f"the scene was loaded: {warning}")
    return d.SceneLoaded(**dict(twin.state()), warnings=warnings)


@answers(d.RPC_DISCOVER)
def discover(twin: TwinServer, client: Client, params: Empty) -> dict[str, Any]:
    """Return the wire as an OpenRPC document."""
    return document()
