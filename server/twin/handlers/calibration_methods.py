"""calibration.*: applying, listing and reverting corrections."""

from __future__ import annotations

from flexdt.protocol import params as p
from flexdt.protocol import results as r
from flexdt.protocol.fields import Empty
from flexdt.server.twin.changes import change_stage
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers.handler import Client, encoded_apart, in_turns, still


async def apply(twin: TwinServer, client: Client, params: p.CalibrationApply) -> r.CorrectionResult:
    """A new correction in force, instead of the last."""
    async with twin.stage_turn:
        correction = twin.corrections.make(params.parameters, params.name, params.comment)
        history = twin.corrections.after(correction)
        ready = still(twin, client, "calibration.apply")
        warnings = await change_stage(
            twin, twin.scanner.sample, correction, ready, history=history, source=params.source
        )
    return _in_force(twin, f"correction {correction.name!r} is in force", warnings)


def get(twin: TwinServer, client: Client, params: p.CalibrationGet) -> r.CorrectionResult:
    """The one in force, or the one named."""
    if params.name is None:
        return r.CorrectionResult(correction=twin.correction_state(twin.scanner.correction))
    return r.CorrectionResult(correction=twin.correction_state(twin.corrections.get(params.name)))


async def list_all(twin: TwinServer, client: Client, params: Empty) -> object:
    """All, oldest first."""
    current = twin.scanner.correction
    views = await in_turns(twin.corrections.all(), twin.correction_state)
    result = r.CorrectionListResult(
        corrections=[view for view in views if view is not None],
        current=None if current is None else current.name,
    )
    return await encoded_apart(client, result, len(views))


async def revert(twin: TwinServer, client: Client, params: Empty) -> r.CorrectionResult:
    """The one before, or none."""
    async with twin.stage_turn:
        history = twin.corrections.history[:-1]
        before = twin.corrections.last(history)
        ready = still(twin, client, "calibration.revert")
        warnings = await change_stage(twin, twin.scanner.sample, before, ready, history=history)
    return _in_force(twin, "the correction was reverted", warnings)


def _in_force(twin: TwinServer, message: str, warnings: list[str]) -> r.CorrectionResult:
    """Notify subscribers; motion that would collide in the new geometry has been halted."""
    twin.tell("info", message)
    for warning in warnings:
        twin.tell("warning", f"{message}: {warning}")
    correction = twin.correction_state(twin.scanner.correction)
    return r.CorrectionResult(correction=correction, warnings=warnings)
