"""What must survive a kill at any moment: E-stop, positions, X-rays, in DATA/journal.

It is a small file of its own with a writer of its own (`runtime/files/two_slots.py`):
uploads, jobs, corrections and settings are never ahead of it. An E-stop is written at
once, positions when motors have come to rest, and while they move, or a scan runs, a few
times a second. Until the disk has what was answered, `unsaved` of the state says so.
"""

from __future__ import annotations

import asyncio
import logging
import stat
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from datetime import UTC, datetime
from typing import Final, Literal

from pydantic import BaseModel, ConfigDict, Field

from flexdt.runtime.files import own_documents as documents
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import Keep
from flexdt.runtime.files.two_slots import TwoSlots
from flexdt.runtime.log import log
from flexdt.server.storage.job_files import Count
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import Machine
from flexdt.twin.scanner.scanner import ScannerTwin

FILE: Final = "journal"
MIN_INTERVAL_S: Final = 0.25
"""Shortest time between two writes of positions while motors move or a scan runs [s of
real time]."""
RETRY_S: Final = 1.0
"""Pause after a failed write [s]."""


class Content(BaseModel):
    """What a record says of the scanner.

    Attributes:
        machine: its name.
        estop: whether an E-stop is in force.
        xrays: whether X-rays were on; they are off after a restart.
        positions: motor -> position [mm, deg].
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    machine: str
    estop: bool
    xrays: bool
    positions: dict[str, float]


class Record(Content):
    """A record of the journal.

    Attributes:
        version: counts changes; the largest is the newest.
        saved: moment, ISO 8601.
    """

    model_config = ConfigDict(populate_by_name=True)

    schema_version: Literal[1] = Field(default=1, alias="schema")
    version: Count
    saved: str


def content_of(scanner: ScannerTwin, now: float) -> Content:
    """Make the content of a record of the scanner at twin time `now`."""
    return Content(
        machine=scanner.machine.name,
        estop=scanner.safety.state == "estopped",
        xrays=scanner.tube.on,
        positions=scanner.positions(now),
    )


def record_of(content: Content, version: int) -> Record:
    """Make a record of now with this version."""
    saved = datetime.now(UTC).isoformat(timespec="milliseconds")
    return Record(version=version, saved=saved, **content.model_dump())


def resume(record: Record, scanner: ScannerTwin, now: float) -> None:
    """Put the motors where a record has them, limited to their travel, and keep an E-stop
    in force.

    Positions of another machine, or that this one may not have, are left out; this is
    logged.
    """
    machine = scanner.machine
    if record.machine == machine.name:
        try:
            scanner.place(_within(machine, record.positions), now)
        except TwinError as error:
            log(
                "the motors' last positions do not fit this machine",
                logging.WARNING,
                reason=str(error),
            )
    if record.estop:
        scanner.estop(now)


class Journal:
    """The journal of a running server.

    Args:
        root: the data directory.
        content: makes what is to be written, in the loop's thread.
        at_rest: whether motors rest and no scan runs, so that positions count.
    """

    def __init__(
        self,
        root: Directory,
        content: Callable[[], Content],
        at_rest: Callable[[], bool],
    ) -> None:
        """Read the newest record; nothing is written yet.

        A journal without a whole record is set aside and logged (`damaged`).
        """
        self._content = content
        self._at_rest = at_rest
        self._file = TwoSlots(root, FILE)
        self.damaged = False
        """Whether the last journal could not be read, and so may have had an E-stop."""
        self.last = self._read(root)
        """The record of the server before this one; None without one."""
        self.problem: str | None = None
        """Why the last write failed, or None."""
        self.noticed: Callable[[], None] = lambda: None
        """Called when a problem begins or ends, and when what was said to be owed has
        been written."""
        self._taken: Record | None = self.last
        """Newest record made; its version has been given away."""
        self._on_disk: Content | None = None
        """What the disk has; None where that is not known, as after a failure."""
        self._under_way: Content | None = None
        """What is being written: until its end the disk may have this or the other."""
        self._owed_was_told = False
        self._changed = asyncio.Event()
        self._at_once = asyncio.Event()
        self._tried: set[asyncio.Future[bool]] = set()
        """Waits for the end of the next write, and for whether it went well."""
        # Of its own: the threads of all other work may be taken by slow writes.
        self._thread = ThreadPoolExecutor(1, "journal")
        self._turn = threading.Lock()
        """Orders the writer's thread and the end of the server; nothing else takes it."""
        self._ended = False

    def _read(self, root: Directory) -> Record | None:
        """Read the newest record; set a damaged journal aside."""
        try:
            found = self._file.read()
            if found is None:
                return None
            return Record.model_validate(documents.read_json(found[1]))
        except Exception as error:  # a flipped bit may trip over anything
            about = root.stat(FILE)
            # A link or a folder of that name has never been one.
            self.damaged = about is not None and stat.S_ISREG(about.st_mode)
            self._file = TwoSlots(root, FILE)
            documents.set_aside(
                root,
                FILE,
                error,
                "the journal cannot be read; starting without it",
            )
            return None

    def follow(self, version: int) -> None:
        """Give the next record a number beyond `version`, that of a copy in the state."""
        if self._taken is None or self._taken.version < version:
            self._taken = Record(
                version=version,
                saved="",
                machine="",
                estop=False,
                xrays=False,
                positions={},
            )

    def take(self) -> Record:
        """Make a record of now; its version is that of the last one if nothing has changed."""
        content = self._content()
        taken = self._taken
        if taken is None or not _same(content, taken):
            taken = record_of(content, 1 if taken is None else taken.version + 1)
            self._taken = taken
        return taken

    def begin(self, make: Keep) -> None:
        """Write the first record of this server, in a new file if there is none; a failure
        is the journal's `problem`.

        Args:
            make: makes the file; on a full disk in room that was kept.
        """
        self._try(self.take(), make)

    def changed(self, *, at_once: bool = False) -> None:
        """Schedule a write; `at_once` skips the pause."""
        self._changed.set()
        if at_once:
            self._at_once.set()

    def owed(self) -> str | None:
        """Say what of the scanner's state a kill would lose, because it is still being
        written; None where nothing is.

        Positions count while motors rest and no scan runs.
        """
        now = self._content()
        disk = self._on_disk
        either = [c for c in (disk, self._under_way) if c is not None]
        said = None
        if disk is None or any(content.estop != now.estop for content in either):
            said = f"the {'E-stop' if now.estop else 'reset'} is being written"
        elif any(c.positions != now.positions for c in either) and self._at_rest():
            said = "the motors' positions are being written"
        self._owed_was_told = self._owed_was_told or said is not None
        return said

    async def durable(self, patience_s: float) -> None:
        """Have the state written at once, and wait until nothing is owed, a write has
        failed, or patience has ended; without waiting where the last write failed.

        Args:
            patience_s: longest wait [real s].
        """
        if self.owed() is None:
            return
        self.changed(at_once=True)
        if self.problem is not None:
            return
        loop = asyncio.get_running_loop()
        with suppress(TimeoutError):
            async with asyncio.timeout(patience_s):
                while self.owed() is not None:
                    tried = loop.create_future()
                    self._tried.add(tried)
                    try:
                        done = await tried
                    finally:
                        self._tried.discard(tried)
                    if not done:
                        return

    async def run(self) -> None:
        """Write a record after each change, and while motors move; end only by
        cancellation.

        While motors move or a scan runs, at most once in `MIN_INTERVAL_S`, unless a write
        at once is requested. A failed write is tried again after `RETRY_S`.
        """
        loop = asyncio.get_running_loop()
        while True:
            await self._changed.wait()
            # Before the write: a change that comes meanwhile is for the next one.
            self._changed.clear()
            self._at_once.clear()
            record = self.take()
            if not self._has(record):
                self._under_way = record
                try:
                    await loop.run_in_executor(self._thread, self._put, record)
                except (OSError, ValueError, DatasetError) as error:
                    self._failed(error)
                else:
                    self._wrote(record)
            self._tell_waiting()
            if self.problem is not None:
                self._changed.set()
                await self._pause(RETRY_S)
            elif not self._at_rest():
                self._changed.set()
                await self._pause(MIN_INTERVAL_S)

    async def _pause(self, seconds: float) -> None:
        """Wait, or until a write at once is requested."""
        # Not `wait_for`, which loses a cancellation that comes together with the event.
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                await self._at_once.wait()

    def end(self) -> None:
        """Write the last record and close the file; an error is logged, not raised.

        Later writes, as of a thread under way, are skipped.
        """
        self._try(self.take(), None)
        if self.problem is not None:
            log("the journal was not written", logging.ERROR, reason=self.problem)
        with self._turn:
            self._ended = True
            self._file.close()
        self._thread.shutdown(wait=False)

    def _try(self, record: Record, make: Keep | None) -> None:
        """Write a record and note how it went; blocks."""
        try:
            self._put(record, make)
        except (OSError, ValueError, DatasetError) as error:
            self._failed(error)
        else:
            self._wrote(record)

    def _put(self, record: Record, make: Keep | None = None) -> None:
        """Write a record; blocks.

        Raises DatasetWriteError, ValueError: it cannot be written.
        """
        text = record.model_dump_json(by_alias=True).encode("utf-8")
        with self._turn:
            if not self._ended:
                self._file.write(record.version, text, make)

    def _wrote(self, record: Record) -> None:
        """Note a record as written, and tell whoever was told that it was owed."""
        self._on_disk = record
        self._under_way = None
        told = self._owed_was_told
        self._owed_was_told = False
        if told and self.problem is None and self.owed() is None:
            self.noticed()
        self._note(None)

    def _failed(self, error: Exception) -> None:
        """Note that a write has failed, which may have left anything in its slot."""
        self._on_disk = None
        self._note(str(error))

    def _has(self, record: Record) -> bool:
        """Return whether the disk has what a record says, and nothing else."""
        return self._on_disk is not None and _same(self._on_disk, record)

    def _note(self, problem: str | None) -> None:
        """Set `problem`, and tell when one begins or ends."""
        before = self.problem
        self.problem = problem
        if (before is None) != (problem is None):
            self.noticed()

    def _tell_waiting(self) -> None:
        """Wake those who wait for the end of a write."""
        for tried in self._tried:
            if not tried.done():
                tried.set_result(self.problem is None)


def _same(a: Content, b: Content) -> bool:
    """Return whether two records say the same of the scanner."""
    return (a.machine, a.estop, a.xrays, a.positions) == (
        b.machine,
        b.estop,
        b.xrays,
        b.positions,
    )


def _within(machine: Machine, positions: dict[str, float]) -> dict[str, float]:
    """Limit positions to motors' travel, as of rounding.

    Other motors are left out.
    """
    axes = machine.axes
    return {
        name: min(max(x, axes[name].lower), axes[name].upper)
        for name, x in positions.items()
        if name in axes
    }
