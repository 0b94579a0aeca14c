"""Changes of the scanner that survive a restart: checked, certified, written, and only then made.

What the handlers of sample, correction, scene and settings have in common. A change that is refused
or cannot be written leaves everything as it is, in the scanner and on the disk.
"""

from __future__ import annotations

import copy
from collections.abc import Callable

from flexdt.protocol.scene_document import Scene
from flexdt.server.files.own_documents import Changes
from flexdt.server.storage.corrections import History
from flexdt.server.storage.memory import Memory, as_of
from flexdt.server.storage.scene import apply_settings, paces_of
from flexdt.server.storage.stored_samples import ReceivedSample
from flexdt.server.twin.core import TwinServer
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample


async def change_settings(
    twin: TwinServer, change: Callable[[ScannerTwin], None], ready: Callable[[], None]
) -> None:
    """Change what the scanner is set to.

    Args:
        twin: whose scanner.
        change: sets it; it is tried on a copy first.
        ready: raises if who asked may not any more.

    Raises:
        DatasetWriteError: it cannot be written; nothing has changed.
    """

    def after(memory: Memory) -> Memory:
        trial = copy.copy(twin.scanner)
        change(trial)
        return as_of(memory, trial)

    def take() -> None:
        ready()
        change(twin.scanner)

    await twin.keeper.keep(take, after)
    twin.changed()


async def change_stage(
    twin: TwinServer,
    sample: Sample,
    correction: NamedCorrection | None,
    ready: Callable[[], None],
    *,
    history: History | None = None,
    source: str | None = None,
    upload: ReceivedSample | None = None,
    scene: Scene | None = None,
) -> list[str]:
    """Put a sample on the stage and a correction in force; hold `stage_turn` meanwhile.

    Args:
        twin: whose stage.
        sample, correction: what is to be there; either may be what is there already.
        ready: raises if who asked may not any more.
        history: of corrections, with this one; None leaves it.
        source: what a new correction came from.
        upload: what is to stand under the sample's name from now on.
        scene: settings and positions that come with it.

    Returns:
        Warnings: motion that was halted.

    Raises:
        UnknownNameError, LimitError, PhantomError: there is no such sample.
        GeometryError, CollisionError: see `TwinServer.certified_stage`; nothing has changed.
        DatasetWriteError: it cannot be written; nothing has changed.
    """
    names = twin.corrections.history if history is None else history
    change = await twin.certified_stage(
        sample,
        correction,
        stage=None if upload is None else twin.stage.beside(twin.samples.with_upload(upload)),
        targets=None if scene is None else scene.positions,
        paces=None if scene is None else paces_of(scene, twin.scanner),
    )

    def files(changes: Changes) -> None:
        if upload is not None:
            twin.samples.store(changes, upload)
        if correction is not None:
            twin.corrections.store(changes, correction, source)

    def after(memory: Memory) -> Memory:
        trial = copy.copy(twin.scanner)
        trial.sample, trial.correction = sample, correction
        if scene is not None:
            apply_settings(scene, trial)
        return as_of(memory, trial, names)

    def take() -> list[str]:
        ready()
        warnings = twin.take_stage(change)
        if upload is not None:
            twin.samples.know(upload)
        if correction is not None:
            twin.corrections.know(correction, source)
        twin.corrections.history = names
        if scene is not None:
            apply_settings(scene, twin.scanner)
        return warnings

    warnings = await twin.keeper.keep(take, after, files)
    twin.changed()
    return warnings
