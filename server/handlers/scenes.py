"""scene.*: the whole state as one document, and back."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from datetime import UTC, datetime

from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol import state as w
from flexdt.server.core import TwinServer
from flexdt.server.handlers.table import Client, Handler
from flexdt.server.scene import apply_settings, require_fit, sample_of, save_scene


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
    """Checked whole first; then settings change at once and the motors set off."""
    scene = params.document
    require_fit(scene, twin.scanner)
    sample = sample_of(scene)
    if sample.name:
        async with twin.samples.turn:
            await asyncio.to_thread(twin.samples.load, sample.name, sample.material)
    correction = None
    if scene.correction is not None:
        c = scene.correction
        correction = twin.corrections.make(c.parameters, c.name, c.comment)
    twin.control.still(client.name, "scene.load")
    guard = await twin.guard_for(sample)
    twin.control.still(client.name, "scene.load")
    twin.scanner.apply(correction)
    if correction is None:
        twin.corrections.withdraw()
    elif correction != twin.corrections.in_force:
        twin.corrections.put_in_force(correction, "scene")
    twin.scanner.set_sample(sample, guard)
    for warning in twin.look_again():
        twin.tell("warning", f"the scene was loaded: {warning}")
    apply_settings(scene, twin.scanner)
    try:
        twin.scanner.move(scene.positions, twin.clock.now())
    finally:
        twin.changed()
    return twin.state()


TABLE: Mapping[str, Handler] = {"scene.save": save, "scene.load": load}
