"""calibration.* and dataset.*: corrections, and recorded scans by their folders."""

from __future__ import annotations

from pathlib import Path

from flexdt.protocol.fields import Empty, Params
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import calibration_messages as p
from flexdt.protocol.methods.calibration_messages import (
    DATASET_FRAME,
    DATASET_GET,
    DATASET_LIST,
)
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.storage.memory import Memory
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers import handler as h


@h.answers(p.CALIBRATION_APPLY)
async def apply(
    twin: TwinServer, client: h.Client, params: p.CalibrationApply
) -> p.CorrectionResult:
    """Make a correction, put it in force instead of the last one, save it and the
    history, and log it.

    A known name with the same values is put in force again.

    Returns:
        The correction, and a warning of motion that was halted because it would collide
        now.

    Raises:
        RpcError: -32602, the name is taken; -32003, the client has lost control.
        CollisionError: bodies would be too close; nothing changes.
    """
    async with twin.stage_turn:
        correction = twin.corrections.make(
            params.parameters,
            params.name,
            params.comment,
            sides_known=params.sides_known,
        )
        history = twin.corrections.after(correction)
        ready = h.ensure_allowed(twin, client, "calibration.apply")
        warnings = await h.change_stage(
            twin,
            twin.scanner.sample,
            correction,
            ready,
            history=history,
            source=params.source,
        )
    return _in_force(twin, f"correction {correction.name!r} is in force", warnings)


@h.answers(p.CALIBRATION_GET)
def get(
    twin: TwinServer, client: h.Client, params: p.CalibrationGet
) -> p.CorrectionResult:
    """Return a correction: the named one, which need not be in force, or without a name
    the one in force (None if there is none).

    Raises:
        UnknownNameError: as `Corrections.get`.
    """
    if params.name is None:
        return p.CorrectionResult(
            correction=twin.correction_state(twin.scanner.correction)
        )
    return p.CorrectionResult(
        correction=twin.correction_state(twin.corrections.get(params.name))
    )


@h.answers(p.CALIBRATION_LIST)
async def list_all(
    twin: TwinServer, client: h.Client, params: Empty
) -> p.CorrectionListResult | Encoded:
    """List all corrections, oldest first, and the name of the one in force (or None).

    The list is made in several turns of the loop. More than `ITEMS_A_TURN` are encoded in
    a thread; then the result is the encoded answer.
    """
    current = twin.scanner.correction
    views = await h.in_turns(twin.corrections.all(), twin.correction_state)
    result = p.CorrectionListResult(
        corrections=[view for view in views if view is not None],
        current=None if current is None else current.name,
    )
    return await h.encoded_apart(client, result, len(views))


@h.answers(p.CALIBRATION_REVERT)
async def revert(twin: TwinServer, client: h.Client, params: Empty) -> p.CorrectionResult:
    """Put the correction in force again that was before the last one in the history, save that,
    and log it.

    Where none was before, none is in force afterwards; an empty history is no error.
    Returns the correction (or None), and a warning of motion that was halted because it would
    collide now.
    Raises RpcError: -32003, the client has lost control; CollisionError: bodies would be too
    close; nothing changes."""
    async with twin.stage_turn:
        history = twin.corrections.history[:-1]
        before = twin.corrections.last(history)
        ready = h.ensure_allowed(twin, client, "calibration.revert")
        warnings = await h.change_stage(
            twin, twin.scanner.sample, before, ready, history=history
        )
    return _in_force(twin, "the correction was reverted", warnings)


@h.answers(p.CALIBRATION_DELETE)
async def delete(
    twin: TwinServer, client: h.Client, params: p.CalibrationDelete
) -> p.CorrectionDeleted:
    """Delete a correction, its file and its entries in the history of `revert`, and log
    it; data sets keep their copy.

    The client must still be allowed to move when it is done.

    Returns:
        The name.

    Raises:
        UnknownNameError: there is no such correction.
        LimitError: it is in force.
        RpcError: -32003, the client has lost control.
    """
    async with twin.stage_turn:
        history = twin.corrections.without(params.name)
        ready = h.ensure_allowed(twin, client, "calibration.delete")

        def after(memory: Memory) -> Memory:
            """Return the state's document with the history that lacks the correction."""
            return memory.model_copy(
                update={"corrections": twin.corrections.in_state(history)}
            )

        def files(changes: Changes) -> None:
            """Add the new history and the removal of the correction's file to the changes
            on the disk.
            """
            twin.corrections.store_history(changes, history)
            twin.corrections.remove(changes, params.name)

        def take() -> None:
            """Remove the correction from memory; raise first if the client has lost control."""
            ready()
            twin.corrections.forget(params.name, history)

        await twin.state_store.keep(take, after, files)
    twin.tell("info", f"correction {params.name!r} was deleted")
    return p.CorrectionDeleted(name=params.name)


def _in_force(twin: TwinServer, message: str, warnings: list[str]) -> p.CorrectionResult:
    """Log a message and each of its warnings for all clients, and return the answer: the
    correction in force (or None) and the warnings.
    """
    twin.tell("info", message)
    for warning in warnings:
        twin.tell("warning", f"{message}: {warning}")
    correction = twin.correction_state(twin.scanner.correction)
    return p.CorrectionResult(correction=correction, warnings=warnings)


@h.answers(
    DATASET_LIST, DATASET_GET, DATASET_FRAME, p.CALIBRATION_FIT, p.CALIBRATION_ALIGN
)
async def from_data_sets(twin: TwinServer, client: h.Client, params: Params) -> Encoded:
    """Run a method that reads the data directory in a worker process, and return its
    encoded result.

    The worker gets the folder name of the current job's data set ("" without a job),
    which is still being written."""
    job = twin.jobs.current
    running = ""
    if job is not None:
        running = Path(job.folder).name
    return await twin.past_scans.ask(params, running, client.peer.codec)
