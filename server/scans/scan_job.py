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

ENDED_PHASES: tuple[JobPhase, ...] = get_args(EndedPhase)


@dataclass(frozen=True)
class JobInputs:
    """The inputs of a running job, made when its turn comes."""

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
    """Sample of the scan, if known before its turn."""
    frames_total: int = 0
    duration_s: float = 0.0
    speed_up: SpeedUp | None = None
    warnings: list[str] = field(default_factory=list)
    phase: JobPhase = "queued"
    error: dict[str, object] | None = None
    runner: ScanRunner | None = None
    aborting: bool = False
    """Whether it was aborted while it was being opened, and has not ended yet."""
    aborted_for: str | None = None
    """Reason of that abort."""
    last: Progress | None = None
    published_at: float = 0.0
    frames_seen: int = 0
    ended: datetime | None = None
    """End by the server's calendar."""
    ended_by: str | None = None
    """Connection that aborted the job."""
    start: dict[str, float] | None = None
    """Motor positions at its beginning [mm, deg]."""
    logged: str = ""
    """State last sent to the topic `log`."""

    @property
    def where(self) -> Progress | None:
        """Progress of its run now, or (ended) at its end; None before it runs."""
        if self.runner is None:
            return self.last
        return self.runner.progress

    @property
    def never_began(self) -> bool:
        """Whether it was aborted before its turn: there is no data set."""
        return self.phase == "aborted" and self.start is None and not self.frames_done

    @property
    def frames_done(self) -> int:
        """Number of finished frames; 0 before it runs."""
        if self.where is None:
            return 0
        return self.where.frames_done

    @property
    def elapsed_s(self) -> float:
        """Time reached on the plan's clock [s]; 0 before it runs."""
        if self.where is None:
            return 0.0
        return max(0.0, self.where.tau)

    def memory(self) -> JobMemory:
        """Return the record of the job that is kept for a restart."""
        known = {name: getattr(self, name) for name in JobMemory.model_fields}
        return JobMemory(**known | {"folder": Path(self.folder).name})


def recalled(memory: JobMemory, root: Directory, now: datetime) -> Job:
    """Restore a job of an earlier server from its record; nothing starts by itself.

    A job that had ended keeps its phase. Another one is done if its data set is complete,
    else incomplete, with an error that counts the images and names the way to go on.

    Args:
        memory: its record.
        root: the data directory.
        now: its end if that is unknown.
    """
    folder = root.folder(memory.folder)
    known = memory.model_dump(exclude={"folder", "elapsed_s", "frames_done"})
    last = Progress("done", memory.elapsed_s, memory.frames_done)
    job = Job(folder=str(folder.path), last=last, **known)
    job.ended = job.ended or now
    if job.phase in ENDED_PHASES:
        return job
    if is_complete(folder):  # it was killed between the last file and telling of it
        job.phase = "done"
        job.error = None
        job.last = Progress("done", memory.duration_s, memory.frames_total)
        return job
    was = job.phase
    job.phase = "incomplete"
    job.last = Progress("done", memory.elapsed_s, stored_projections(folder))
    there = sum(name.endswith(".tif") for name in folder.names())
    job.error = {
        "code": int(Code.BUSY),
        "message": f"the server ended while this job was {was}; {there} images are on disk; "
        "job.resume makes the others",
        "data": {
            "was": was,
            "images": there,
            "before": memory.error,
            "allowed": "job.resume",
        },
    }
    return job


def stored_projections(folder: Directory) -> int:
    """Count the projections that a data set has on the disk; 0 if it cannot be read."""
    try:
        planned = read_document(folder).files("projection")
        return len(folder.names().intersection(planned))
    except (OSError, DatasetError):
        return 0


def is_complete(folder: Directory) -> bool:
    """Return whether a folder's data set is marked complete; False if it cannot be read."""
    try:
        return read_document(folder).complete
    except (OSError, DatasetError):
        return False
