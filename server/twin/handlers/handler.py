"""Common parts of handlers: their type, the client connection, changes that are saved.

A change of the scanner that survives a restart is checked, certified, written, and only then
made. One that is refused or cannot be written leaves everything as it is, in the scanner and on
the disk.
"""

from __future__ import annotations

import asyncio
import copy
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, TypeVar

from flexdt.protocol import Method
from flexdt.protocol.connection import encoded
from flexdt.protocol.fields import Params, Result
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods.document_messages import Scene
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.network.shell_parts import Peer
from flexdt.server.storage.corrections import History
from flexdt.server.storage.memory import Memory, with_scanner_state
from flexdt.server.storage.scene_document import apply_settings, paces_of
from flexdt.server.storage.stored_samples import ReceivedSample
from flexdt.server.twin.core import TwinServer
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample

Item = TypeVar("Item")
View = TypeVar("View")
_P = TypeVar("_P", bound=Params)
_R = TypeVar("_R", bound=Result)
ITEMS_A_TURN = 20
"""Items of a list processed in one turn of the loop, well below a millisecond."""
HANDLERS: dict[str, Handler] = {}
"""Method name -> handler; filled as the modules of `handlers` are imported."""
Answer: TypeAlias = _R | Encoded | Mapping[str, Any]
"""Result of a method: its model, or bytes or plain data made of it."""


@dataclass
class Client:
    """One client connection.

    Attributes:
        peer: where events go; its name is the connection's.
        program: the client's own name.
        serving: methods that it has called and that are being worked at.
    """

    peer: Peer
    program: str = ""
    serving: list[str] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name in `controller`: the client's own name with the connection's number."""
        number = self.peer.name.rpartition("#")[2]
        return f"{self.program[:40]} #{number}" if self.program else self.peer.name


Handler = Callable[[TwinServer, Client, Any], object | Awaitable[object]]
"""Handles (twin, client, parameters) and returns the result."""
_Handler: TypeAlias = Callable[
    [TwinServer, Client, _P], Answer[_R] | Awaitable[Answer[_R]]
]


def answers(*methods: Method[_P, _R]) -> Callable[[_Handler[_P, _R]], _Handler[_P, _R]]:
    """Return a decorator that registers a function as the handler of `methods` in
    `HANDLERS`.

    The function is returned unchanged. A method that has a handler already raises
    AssertionError.
    """

    def mark(handler: _Handler[_P, _R]) -> _Handler[_P, _R]:
        """Register the handler for all the methods, and return it unchanged.

        A method that has one already raises AssertionError.
        """
        for method in methods:
            assert method.name not in HANDLERS, f"{method.name} has a handler"
            HANDLERS[method.name] = handler
        return handler

    return mark


def ensure_allowed(twin: TwinServer, client: Client, what: str) -> Callable[[], None]:
    """Return a check that control is as at the request."""
    return lambda: twin.control.ensure_allowed(client.name, what)


def ensure_idle(
    twin: TwinServer, client: Client, method: str, what: str
) -> Callable[[], None]:
    """Return a check that raises RpcError -32003 if another client has control.

    Or if a job would be disturbed. `method` and `what` are for the errors.
    """

    def check() -> None:
        """Raise RpcError -32003 if another has control, or a job would be disturbed."""
        twin.control.ensure_allowed(client.name, method)
        twin.jobs.require_idle(what)

    return check


async def in_turns(items: Sequence[Item], view: Callable[[Item], View]) -> list[View]:
    """Apply `view` to each item and return the results in order; after every
    `ITEMS_A_TURN` items other requests have a turn.
    """
    views = []
    for at, item in enumerate(items, start=1):
        views.append(view(item))
        if at % ITEMS_A_TURN == 0 and at < len(items):
            await asyncio.sleep(0.0)
    return views


def page(items: Sequence[Item], start: int, count: int | None) -> Sequence[Item]:
    """Return the part of a list that is wanted; None: all from `start` on."""
    return items[start:] if count is None else items[start : start + count]


async def encoded_apart(client: Client, result: _R, count: int) -> _R | Encoded:
    """Return a result of `count` items; a long one is encoded in a thread."""
    if count <= ITEMS_A_TURN:
        return result
    return await asyncio.to_thread(encoded, result, client.peer.codec)


async def change_settings(
    twin: TwinServer, change: Callable[[ScannerTwin], None], ready: Callable[[], None]
) -> None:
    """Try a change of settings on a copy of the scanner, write the state, then change the
    scanner and notify watchers.

    Args:
        twin: whose scanner.
        change: sets it; it is called on a copy first, and its errors are raised before
            anything has changed.
        ready: raises if the client has lost control; called before the scanner is
            changed.

    Raises:
        DatasetWriteError: the state cannot be written; nothing has changed.
    """

    def after(memory: Memory) -> Memory:
        """Try the change on a copy of the scanner, and return the state's document with it."""
        trial = copy.copy(twin.scanner)
        change(trial)
        return with_scanner_state(memory, trial)

    def take() -> None:
        """Change the scanner and notify watchers; `ready` raises first if the client has
        lost control.
        """
        ready()
        change(twin.scanner)
        twin.changed()  # here: the client may be gone when this is saved

    await twin.state_store.keep(take, after)


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
    """Put a sample on the stage and a correction in force: check, write, then change all
    at once.

    A correction that cannot be applied is refused before anything is built. The sweep
    runs in a thread. Motion that is not free of the new stage is halted, or refused where
    a `scene` brings moves of its own; a halt also interrupts a running job and ends a way
    around obstacles. The caller must hold `stage_turn`.

    Args:
        twin: whose stage.
        sample, correction: the new ones; either may be the present one.
        ready: raises if the client has lost control; called last before the change.
        history: of corrections, with this one; None leaves it.
        source: origin of a new correction.
        upload: new content under the sample's name.
        scene: settings and positions that come with it; its motion starts.

    Returns:
        The reason of a halt as the one warning, or [].

    Raises:
        UnknownNameError, LimitError, PhantomError: there is no such sample.
        GeometryError: a correction that no scanner can have.
        CollisionError, SafetyError: present poses or motion touch the new stage; nothing
            has changed (see `ScannerTwin.take_stage`).
        DatasetWriteError: it cannot be written; nothing has changed.
    """
    if history is None:
        names = twin.corrections.history
    else:
        names = history
    scanner = twin.scanner
    scanner.require_applicable(correction)  # before anything is built of it
    guard = await twin.guard(sample, correction, upload)
    change = scanner.stage_change(
        sample,
        correction,
        guard,
        twin.clock.now(),
        targets=None if scene is None else scene.positions,
        paces=None if scene is None else paces_of(scene, scanner),
    )
    change = await asyncio.to_thread(change.certified)

    def files(changes: Changes) -> None:
        """Add to the changes on the disk: an upload's files, the correction, and the
        history, each if there is one.
        """
        if upload is not None:
            twin.samples.store(changes, upload)
        if correction is not None:
            twin.corrections.store(changes, correction, source)
        if history is not None:
            twin.corrections.store_history(changes, history)

    def after(memory: Memory) -> Memory:
        """Return the state's document as it will be: sample, correction, and a scene's settings.

        The scanner itself is not changed.
        """
        trial = copy.copy(scanner)
        trial.sample = sample
        trial.correction = correction
        if scene is not None:
            apply_settings(scene, trial)
        return with_scanner_state(memory, trial, twin.corrections.in_state(names))

    def take() -> list[str]:
        """Change stage, correction, history and settings together, halt motion that would
        collide, and notify watchers.

        `ready` raises first if the client has lost control. A halt also cancels a way
        around obstacles and interrupts a running job.

        Returns:
            The reason of the halt as the one warning, or [].
        """
        ready()
        halted = scanner.take_stage(change, twin.clock.now())
        if halted is not None:  # motion that is not free of it
            twin.detours.cancel()
            if twin.jobs.running:
                twin.jobs.interrupt(halted)
        if upload is not None:
            twin.samples.know(upload)
        if correction is not None:
            twin.corrections.know(correction, source)
        twin.corrections.history = names
        if scene is not None:
            apply_settings(scene, scanner)
        twin.changed()
        return [] if halted is None else [halted.message]

    return await twin.state_store.keep(take, after, files)
