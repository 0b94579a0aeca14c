"""scene.* and rpc.discover: the whole state, and the wire itself, as documents."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime
from functools import cache
from typing import Any

from flexdt.protocol import state_model as w
from flexdt.protocol.fields import Empty
from flexdt.protocol.methods import document_messages as p
from flexdt.protocol.methods import openrpc_document
from flexdt.server.storage.memory import require_fit, sample_of, save_scene
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, answers, change_stage, ensure_idle
from flexdt.twin.errors import SafetyError


@answers(p.SCENE_SAVE)
def save(twin: TwinServer, client: Client, params: p.SceneSave) -> p.SceneResult:
    """Where motors are bound, settings, sample, correction."""
    scene = save_scene(
        twin.scanner,
        twin.clock.now(),
        name=params.name or "",
        saved=datetime.now(UTC).isoformat(timespec="seconds"),
        version=twin.version,
    )
    return p.SceneResult(document=scene.model_dump(mode="json", by_alias=True))


@answers(p.SCENE_LOAD)
async def load(twin: TwinServer, client: Client, params: p.SceneLoad) -> w.State:
    """Checked whole first, the motion included; then all of it changes and the motors set off."""
    scene, stops = params.document, twin.scanner.stops
    require_fit(scene, twin.scanner)
    sample = sample_of(scene)
    if sample.name:
        async with twin.samples.turn:
            await asyncio.to_thread(twin.samples.load, sample.name, sample.material)

    def ready() -> None:
        if twin.scanner.stops != stops:
            raise SafetyError(
                "the scene is not loaded: motion was stopped meanwhile",
                {"asked": "scene.load", "allowed": "asking again"},
            )
        ensure_idle(twin, client, "scene.load", "a scene")()

    ready()
    async with twin.stage_turn:
        correction, in_force = None, twin.corrections.in_force
        if scene.correction is not None:
            c = scene.correction
            correction = twin.corrections.make(c.parameters, c.name, c.comment)
        history = None if correction == in_force else twin.corrections.after(correction)
        warnings = await change_stage(
            twin, sample, correction, ready, history=history, source="scene", scene=scene
        )
    for warning in warnings:
        twin.tell("warning", f"the scene was loaded: {warning}")
    return twin.state()


@answers(p.RPC_DISCOVER)
def discover(twin: TwinServer, client: Client, params: Empty) -> dict[str, Any]:
    """The wire as an OpenRPC document."""
    return document()


document = cache(openrpc_document)
"""Made once: it takes 0.1 s of the loop."""
