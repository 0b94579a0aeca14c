"""scene.*: the whole state as one document, and back."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime

from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state_model as w
from flexdt.server.storage.scene import require_fit, sample_of, save_scene
from flexdt.server.twin.changes import change_stage
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client
from flexdt.twin.errors import SafetyError


def save(twin: TwinServer, client: Client, params: p.SceneSave) -> r.SceneResult:
    """Where motors are bound, settings, sample, correction."""
    scene = save_scene(
        twin.scanner,
        twin.clock.now(),
        name=params.name or "",
        saved=datetime.now(UTC).isoformat(timespec="seconds"),
        version=twin.version,
    )
    return r.SceneResult(document=scene.model_dump(mode="json", by_alias=True))


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
        twin.control.still(client.name, "scene.load")
        twin.jobs.require_free("a scene")

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
