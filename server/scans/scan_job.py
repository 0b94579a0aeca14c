"""One scan as a job, from submission to its end."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import get_args

from flexdt.protocol.rpc_errors import Code
from flexdt.protocol.state_model import EndedPhase, JobPhase
from flexdt.runtime.files.dataset_folder import read_document
from flexdt.runtime.files.directory import Directory
from flexdt.server.scans.runner import Produce, Progress, ScanRunner
from flexdt.server.scans.twin_clock import SpeedUp
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.storage.job_files import JobMemory
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import ScanPlan

ENDED: tuple[JobPhase, ...] = get_args(EndedPhase)


@dataclass(frozen=True)
class JobInputs:
    """What a job needs to run; made when its turn comes."""

    plan: ScanPlan
    store: DatasetWriter
    produce: Produce
    finished: Callable[[], None] = lambda: None
    """Called in a thread once the data set is complete."""


Prepare = Callable[[], Awaitable[JobInputs]]


@dataclass
class Job:
    """One scan, from submission to its end."""

    id: str
    name: str
    folder: str
    prepare: Prepare | None = None
    sample: Sample | None = None
    """What it shows, as far as that is known before its turn."""
    frames_total: int = 0
    duration_s: float = 0.0
    speed_up: SpeedUp | None = None
    warnings: list[str] = field(default_factory=list)
    phase: JobPhase = "queued"
    error: dict[str, object] | None = None
    runner: ScanRunner | None = None
    aborted_for: str | None = None
    last: Progress | None = None
    published_at: float = 0.0
    frames_seen: int = 0
    ended: datetime | None = None
    """When it ended, by the server's calendar."""
    ended_by: str | None = None
    """The connection that aborted it."""
    start: dict[str, float] | None = None
    """Where the motors stood when it began [mm, deg]."""
    logged: str = ""
    """The state that the topic `log` was last told."""

    @property
    def where(self) -> Progress | None:
        """How far it is, or was when it ended."""
        return self.last if self.runner is None else self.runner.progress

    @property
    def frames_done(self) -> int:
        """Frames that are there."""
        return 0 if self.where is None else self.where.frames_done

    @property
    def elapsed_s(self) -> float:
        """Of the plan's time [s]."""
        return 0.0 if self.where is None else max(0.0, self.where.tau)

    def memory(self) -> JobMemory:
        """What to know of it after a restart."""
        known = {name: getattr(self, name) for name in JobMemory.model_fields}
        return JobMemory(**known | {"folder": Path(self.folder).name})


def recalled(memory: JobMemory, root: Directory, now: datetime) -> Job:
    """A job of the server before this one; one that was not ended is incomplete and says so.

    Args:
        memory: as it was.
        root: the data directory.
        now: taken for its end where that is not known.
    """
    folder = root.folder(memory.folder)
    known = memory.model_dump(exclude={"folder", "elapsed_s", "frames_done"})
    last = Progress("done", memory.elapsed_s, memory.frames_done)
    job = Job(folder=str(folder.path), last=last, **known)
    job.ended = job.ended or now
    if job.phase in ENDED:
        return job
    if is_complete(folder):  # it was killed between the last file and telling of it
        job.phase, job.error = "done", None
        job.last = Progress("done", memory.duration_s, memory.frames_total)
        return job
    was, job.phase = job.phase, "incomplete"
    there = sum(name.endswith(".tif") for name in folder.names())
    job.error = {
        "code": int(Code.BUSY),
        "message": f"the server ended while this job was {was}; {there} images are on disk; "
        "job.resume makes the others",
        "data": {"was": was, "images": there, "before": memory.error, "allowed": "job.resume"},
    }
    return job


def is_complete(folder: Directory) -> bool:
    """Whether a data set lies there that says that it is complete."""
    try:
        return read_document(folder).complete
    except (OSError, DatasetError):
        return False
