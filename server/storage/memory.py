"""The state that a twin server restores after it was killed: DATA/state.json.

Settings, tube, camera, sample and the corrections in force are one document, so that a
change of several of them is atomic. E-stop, positions and X-rays have a file and a writer
of their own (`journal`); the document has a copy with its version, of which the newer
counts. Its size does not depend on the number of jobs: jobs have files of their own
(`job_files`), of which those that have changed are written. A client's change that must
survive is written first and takes effect afterwards (see `StateStore.keep`): if it cannot
be written, nothing has changed. The progress of a scan is written as it changes, at most
a few times a second, and when the server stops. After a restart X-rays are off, motors
are where they were last recorded, and interrupted scans are marked so and can be resumed.
A damaged document is set aside, and the server starts without it.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from itertools import islice
from typing import Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from flexdt.protocol.methods import document_messages as p
from flexdt.protocol.rpc_errors import RpcError
from flexdt.runtime.files import own_documents as documents
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.spare_files import SpareFiles
from flexdt.runtime.log import log
from flexdt.server.storage.job_files import Count, JobFiles, JobMemory
from flexdt.server.storage.journal import Record
from flexdt.server.storage.scene_document import (
    apply_settings,
    require_fit,
    sample_of,
    save_scene,
)
from flexdt.twin.dataset.dataset_errors import DatasetError, DatasetWriteError
from flexdt.twin.errors import LimitError, TwinError
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample, changed_tube

FILE = "state.json"
MIN_INTERVAL_S = 0.25
"""Shortest time between two writes [s of real time]."""
ChangedJobs = dict[str, JobMemory | None]
MAX_JOBS_PER_TURN = 20
"""Largest number of jobs that are written while other changes wait."""
MAX_FORGOTTEN_PER_TURN = 200
"""Largest number of jobs whose files are deleted while other changes wait."""
FAR_S = 60.0
"""Pause after a failed write (a full disk) [s]."""

T = TypeVar("T")


class _Part(BaseModel):
    model_config = ConfigDict(
        frozen=True, extra="forbid", populate_by_name=True, allow_inf_nan=False
    )


class Memory(_Part):
    """The document.

    Attributes:
        version: of the journal's record of which positions and E-stop are a copy; 0 of
            servers without a journal.
        jobs: as earlier servers kept them; those that have no file yet.
        jobs_made: jobs there ever were.
        corrections: the name in force, None for nominal; several where their history has
            no file.
    """

    schema_version: Literal[1] = Field(alias="schema")
    saved: str
    ended: bool = False
    scene: p.Scene
    estop: bool = False
    version: Count = 0
    jobs: list[JobMemory] = Field(default_factory=list)
    jobs_made: Count = 0
    corrections: list[str | None] = Field(default_factory=list)


def remember(
    scanner: ScannerTwin,
    now: float,
    record: Record,
    made: int,
    corrections: list[str | None],
    *,
    unfiled: Sequence[JobMemory] = (),
    ended: bool = False,
) -> Memory:
    """Make the document of the scanner at twin time `now`.

    `record`: of the journal; `made`: jobs there ever were; `corrections`: as `Memory` has
    them; `unfiled`: jobs of an earlier server that have no files yet; `ended`: the server
    has ended.
    """
    scene = save_scene(scanner, now).model_copy(update={"positions": record.positions})
    return Memory(
        schema=1,
        saved=datetime.now(UTC).isoformat(timespec="milliseconds"),
        ended=ended,
        scene=scene,
        estop=record.estop,
        version=record.version,
        jobs=list(unfiled),
        jobs_made=made,
        corrections=corrections,
    )


def with_scanner_state(
    memory: Memory, scanner: ScannerTwin, corrections: list[str | None] | None = None
) -> Memory:
    """Replace settings, rates, sample and correction of the document by those of `scanner`.

    Positions, jobs and E-stop stay.

    `memory`: the document; not changed. `scanner`: as it will be. `corrections`: as `Memory` has
    them; None leaves them.
    """
    scene = save_scene(scanner, 0.0).model_copy(
        update={"positions": memory.scene.positions}
    )
    if corrections is None:
        names = memory.corrections
    else:
        names = corrections
    return memory.model_copy(update={"scene": scene, "corrections": names})


def read_memory(root: Directory) -> Memory | None:
    """Read the state of data directory `root`.

    Returns:
        The state; None if there is none, or a damaged file, which is renamed and logged.
    """
    return documents.read_or_set_aside(
        root,
        FILE,
        lambda data: Memory.model_validate(documents.read_json(data)),
        "the last state cannot be read; starting anew",
    )


def copied_record(memory: Memory) -> Record:
    """Return the record of which the document has a copy; of a server without a journal
    it is the first one.
    """
    scene = memory.scene
    return Record(
        version=memory.version,
        saved=memory.saved,
        machine=scene.machine,
        estop=memory.estop,
        xrays=scene.tube.on,
        positions=scene.positions,
    )


def restore(memory: Memory, scanner: ScannerTwin) -> Sample | None:
    """Set the scanner to the settings in `memory`, X-rays off.

    A voltage that the tube may not have is replaced by the present one, with a warning in
    the log. The correction is not restored here, nor are positions and E-stop (see
    `journal.resume`).

    Args:
        memory: the state.
        scanner: to be set.

    Returns:
        The sample to put on the stage; None if the state is of another machine or not
        allowed any more, so that nothing is restored.
    """
    known = memory.scene
    # The correction in force comes from the history.
    known = known.model_copy(update={"correction": None})
    known = known.model_copy(update={"tube": _allowed_tube(known.tube, scanner)})
    try:
        require_fit(known, scanner)
        apply_settings(known, scanner)
    except (TwinError, RpcError) as error:
        log(
            "the last state does not fit this machine; starting anew",
            logging.WARNING,
            reason=str(error),
        )
        return None
    return sample_of(known)


def _allowed_tube(known: p.TubePart, scanner: ScannerTwin) -> p.TubePart:
    """Return tube settings as remembered, or with the scanner's present voltage if its tube
    may not have them, as with another physics; this is logged.
    """
    try:
        changed_tube(scanner.machine.tube, scanner.tube, known.kV, known.power_W)
    except LimitError as error:
        log(
            "the tube starts anew: it may not have its last settings",
            logging.WARNING,
            reason=error.message,
        )
        return known.model_copy(update={"kV": scanner.tube.kV})
    return known


class JobsNotWrittenError(DatasetWriteError):
    """The state has been written, but not every job that has changed."""


class StateStore:
    """Writes the state while the server runs.

    Args:
        root: the data directory.
        make: makes the document; its argument is true when the server ends.
        job_files: writes jobs.
        changed_jobs: returns the jobs that have changed since its last call, None for one
            that is forgotten.
    """

    def __init__(
        self,
        root: Directory,
        make: Callable[[bool], Memory],
        job_files: JobFiles,
        changed_jobs: Callable[[], ChangedJobs],
    ) -> None:
        """Name where the state is written and what makes it; nothing is read or written
        yet.

        Args:
            root: the data directory.
            make: returns the state to write; its argument is whether the server has
                ended.
            job_files: files of the jobs.
            changed_jobs: returns the jobs changed since its last call.
        """
        self._root = root
        self._make = make
        self._job_files = job_files
        self._changed_jobs = changed_jobs
        self._unwritten: dict[str, JobMemory] = {}
        self._forgotten: dict[str, None] = {}
        """Jobs whose files are to be deleted, oldest first."""
        self.spares = SpareFiles(root)
        self.problem: str | None = None
        """Why the last change that did not wait for the disk is not on it, or None."""
        self.noticed: Callable[[], None] = lambda: None
        """Called when a problem begins or ends."""
        self._changed = asyncio.Event()
        self._on_disk: Memory | None = None
        """The document that was written last; None where that is not certain."""
        # Lock order: `_writing` is held by tasks over awaits, and within it `_file` by threads
        # over system calls. `_file` alone orders threads whose tasks have been cancelled.
        self._writing = asyncio.Lock()
        self._file = threading.Lock()
        self._ended = False

    def changed(self) -> None:
        """Schedule a write."""
        self._changed.set()

    async def run(self) -> None:
        """Write the state after each change; end only by cancellation.

        It is written at most once in `MIN_INTERVAL_S`. A failure is logged and tried
        again after `FAR_S`; if only jobs failed, further changes are written meanwhile.
        """
        while True:
            await self._changed.wait()
            # Before the write: a change that comes meanwhile is for the next one.
            self._changed.clear()
            pause = MIN_INTERVAL_S
            try:
                await self.flush()
            except JobsNotWrittenError as error:
                # The document is on the disk, so that its further changes need not wait for the
                # jobs.
                log("jobs were not written", logging.ERROR, reason=str(error))
                asyncio.get_running_loop().call_later(FAR_S, self._changed.set)
            except (OSError, DatasetError) as error:
                log("the state was not written", logging.ERROR, reason=str(error))
                self._changed.set()  # the change is still pending
                pause = FAR_S
            await asyncio.sleep(pause)

    async def flush(self, job: str | None = None) -> None:
        """Write the state and some changed jobs now, so that everything answered later
        survives a kill.

        If more jobs are left, another write is scheduled: however many have changed, as
        when thousands are forgotten at once, requests are served between turns. The
        outcome is kept in `problem`, and `noticed` is called if it is new.

        Args:
            job: that is among the jobs written now, if it has changed.

        Raises:
            DatasetWriteError, OSError: the system cannot write.
        """
        async with self._writing:
            # The document is made here: only the loop's thread may look at the scanner.
            document = self._make(False)
            jobs = self._jobs_of_a_turn(job)
            if (
                not jobs
                and self.problem is None
                and _says_the_same(document, self._on_disk)
            ):
                return
            try:
                await asyncio.to_thread(self._put, document, jobs)
            except (OSError, DatasetError) as error:
                self._note(str(error))
                raise
            self._note(None)
            if self._unwritten or self._forgotten:
                self._changed.set()

    async def keep(
        self,
        take: Callable[[], T],
        after: Callable[[Memory], Memory] | None = None,
        files: Callable[[documents.Changes], None] | None = None,
        choose: Callable[[], None] | None = None,
    ) -> T:
        """Write a change that must survive, then apply it: the one place where jobs,
        samples, corrections and settings change, one change at a time.

        Args:
            choose: decides what is changed, when no other change is under way; an
                exception leaves everything unchanged.
            take: makes the change, once it is on the disk; if it raises, the written
                files are restored.
            after: the document with the change, from the one without; an exception leaves
                everything unchanged. None where the document has nothing of it.
            files: writes the other files of the change, before the document.

        Raises:
            DatasetWriteError: the system cannot write; nothing has changed, here or on
                the disk.
        """
        # A requester that disconnects does not interrupt a write: it succeeds or is undone.
        change = self._keep(take, after, files, choose)
        return await asyncio.shield(asyncio.ensure_future(change))

    async def _keep(
        self,
        take: Callable[[], T],
        after: Callable[[Memory], Memory] | None,
        files: Callable[[documents.Changes], None] | None,
        choose: Callable[[], None] | None,
    ) -> T:
        """Write a change to the disk, then apply it; restore the disk if either fails.

        No other write comes in between.

        Args:
            take: applies the change in memory; may raise before it does.
            choose: decides what is changed; called first.
            after: makes the state's document with the change from the present one; None
                leaves the document.
            files: adds further files to the change.

        Returns:
            The value of `take`.

        Raises:
            Exception: of writing or of `take`; nothing has changed.
        """
        async with self._writing:
            if choose is not None:
                choose()
            document = None
            if after is not None:
                # Within the lock: of two changes the second document contains the first change.
                document = after(self._make(False))
            changes = documents.Changes()
            try:
                await asyncio.to_thread(self._put_all, changes, document, files)
                # The disk comes first: a kill in between leaves a change that nobody was told
                # of, never one that was answered and is lost.
                taken = take()
                if document is not None:
                    self._on_disk = document
            # Of a cancellation too: `shield` in `keep` stops a requester's, not that of a
            # closing loop.
            except BaseException:
                await asyncio.to_thread(self._undo, changes)
                # The document of before is back, and owes what has changed since.
                self._on_disk = None
                self.changed()
                raise
            await asyncio.to_thread(changes.done)
            return taken

    def _note(self, problem: str | None) -> None:
        """Set `problem`; call `noticed` only when a problem begins or ends."""
        before = self.problem
        self.problem = problem
        if (before is None) != (problem is None):
            self.noticed()

    def end(self) -> None:
        """Write the state as that of an ended server, and all changed jobs; an error is
        logged, not raised.

        Later writes, as of threads still under way, are skipped.
        """
        try:
            self.gather()
            self._put(self._make(True), self._unwritten | self._forgotten)
        except (OSError, DatasetError) as error:
            log("the state was not written", logging.ERROR, reason=str(error))

    def owe(self, jobs: Sequence[JobMemory]) -> None:
        """Add jobs to those that are to be written."""
        self._unwritten |= {job.id: job for job in jobs}

    def is_unwritten(self, job: str) -> bool:
        """Return whether a change of a job is still to be written."""
        return job in self._unwritten

    def gather(self) -> None:
        """Take over the jobs that have changed, and those that are forgotten."""
        for name, job in self._changed_jobs().items():
            if job is None:
                self._unwritten.pop(name, None)
                self._forgotten[name] = None
            else:
                self._forgotten.pop(name, None)
                self._unwritten[name] = job

    def _jobs_of_a_turn(self, first: str | None) -> ChangedJobs:
        """List the jobs of one turn: `first` if it has changed, then others up to the
        limits of a turn; None for those whose files are deleted.
        """
        self.gather()
        jobs: ChangedJobs = dict(islice(self._unwritten.items(), MAX_JOBS_PER_TURN))
        if first is not None and first in self._unwritten:
            jobs[first] = self._unwritten[first]
        return jobs | dict(islice(self._forgotten.items(), MAX_FORGOTTEN_PER_TURN))

    def _put(self, memory: Memory, jobs: ChangedJobs) -> None:
        """Write the document and then the jobs to the disk, one write at a time; blocks.

        Nothing is written after the document of an ended server has been.

        Args:
            memory: the document.
            jobs: id -> job; None deletes its file.

        Raises:
            DatasetWriteError: the document cannot be written.
            JobsNotWrittenError: a job cannot be written.
        """
        # Ending cancels the task that waits for a worker thread, but not the thread.
        with self._file:
            if self._ended and not memory.ended:
                return
            # Before the write, which may fail: threads that come later must not write either.
            self._ended = memory.ended
            self._on_disk = None
            self.spares.keep(FILE, _text(memory))
            self._on_disk = memory
            try:
                self._put_jobs(jobs)
            except DatasetWriteError as error:
                raise JobsNotWrittenError(error.message, error.data) from None

    def _put_jobs(self, jobs: ChangedJobs) -> None:
        """Write jobs, then delete the files of forgotten ones, and note what is done
        unless it has changed again meanwhile.

        Raises:
            DatasetWriteError: the disk does not take it.
        """
        forgotten = [name for name, job in jobs.items() if job is None]
        for name, job in jobs.items():
            if job is not None:
                self._job_files.write(job)
                # The loop may have noted a newer state of the job while this thread wrote.
                if self._unwritten.get(name) == job:
                    del self._unwritten[name]
        self._job_files.delete(forgotten)
        for name in forgotten:
            self._forgotten.pop(name, None)

    def _put_all(
        self,
        changes: documents.Changes,
        document: Memory | None,
        files: Callable[[documents.Changes], None] | None,
    ) -> None:
        """Write files, then the document, as changes that the caller confirms or undoes; blocks.

        Args:
            changes: gets all that is written.
            document: of the state; None leaves it.
            files: adds files; None for none.

        Raises DatasetWriteError: the disk does not take them, or the server is ending.
        """
        with self._file:
            if self._ended:
                raise DatasetWriteError("the server is ending; nothing has changed")
            # The document last, because it names the files: a kill in between leaves files that
            # nothing names, never a name without its file.
            if files is not None:
                files(changes)
            if document is not None:
                changes.put(self._root, FILE, _text(document), self.spares.keep)

    def _undo(self, changes: documents.Changes) -> None:
        with self._file:
            changes.undo()


def _says_the_same(document: Memory, other: Memory | None) -> bool:
    """Return whether two documents differ in nothing but their date and their copy of the
    journal's record.
    """
    if other is None:
        return False
    scene = other.scene.model_copy(update={"positions": document.scene.positions})
    copied = {"saved": document.saved, "version": document.version}
    return document == other.model_copy(
        update={"scene": scene, "estop": document.estop, **copied}
    )


def _text(memory: Memory) -> bytes:
    """Encode the state as JSON; an empty list of jobs is left out."""
    without = set() if memory.jobs else {"jobs"}
    return memory.model_dump_json(by_alias=True, exclude=without).encode("utf-8")
