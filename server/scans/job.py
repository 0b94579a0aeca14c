"""One scan as a job: what it needs, where it stands, what is remembered of it, when it goes on.

A job that a full disk or an absent projector has paused goes on by itself, with back-off. Each
attempt waits twice as long as the one before, up to half a minute; for a disk also until there is
room for what could not be written. Whoever pauses, steps or moves by hand takes over: then only
`job.resume` goes on. What a person has to decide is not retried. `jobs` decides when a job runs.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from flexdt.protocol.rpc_errors import Code
from flexdt.protocol.state_model import JobPhase
from flexdt.runtime.files.dataset_folder import read_document
from flexdt.runtime.files.directory import Directory, free_bytes
from flexdt.runtime.wire_errors import ProjectorUnavailable
from flexdt.server.scans.runner import Produce, Progress, ScanRunner
from flexdt.server.scans.twin_clock import SpeedUp
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.storage.memory import JobMemory
from flexdt.twin.dataset.dataset_errors import DatasetError, DiskFullError
from flexdt.twin.script import ScanPlan

FIRST_S, LONGEST_S = 1.0, 30.0
"""Between attempts, the first and the longest [real s]."""
ENDED: tuple[JobPhase, ...] = ("done", "failed", "aborted", "incomplete")


@dataclass(frozen=True)
class JobInputs:
    """What a job needs to run; made when its turn comes."""

    plan: ScanPlan
    store: DatasetWriter
    produce: Produce


Prepare = Callable[[], Awaitable[JobInputs]]


@dataclass
class Job:
    """One scan, from submission to its end."""

    id: str
    name: str
    folder: str
    prepare: Prepare | None = None
    frames_total: int = 0
    duration_s: float = 0.0
    speed_up: SpeedUp | None = None
    warnings: list[str] = field(default_factory=list)
    phase: JobPhase = "queued"
    error: dict[str, object] | None = None
    runner: ScanRunner | None = None
    last: Progress | None = None
    published_at: float = 0.0
    frames_seen: int = 0
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


def recalled(memory: JobMemory, root: Directory) -> Job:
    """A job of the server before this one; one that was not ended is incomplete and says so."""
    folder = root.folder(memory.folder)
    job = Job(
        memory.id,
        memory.name,
        str(folder.path),
        None,
        memory.frames_total,
        memory.duration_s,
        memory.speed_up,
        list(memory.warnings),
        memory.phase,
        memory.error,
        last=Progress("done", memory.elapsed_s, memory.frames_done),
    )
    if job.phase in ENDED:
        return job
    if _complete(folder):  # it was killed between the last file and telling of it
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


def _complete(folder: Directory) -> bool:
    """Whether a data set lies there that says that it is complete."""
    try:
        return read_document(folder).complete
    except (OSError, DatasetError):
        return False


def transient(error: Exception | None) -> bool:
    """Whether waiting may help."""
    return isinstance(error, (DiskFullError, ProjectorUnavailable))


class Retry:
    """The next attempt of the job that runs; one at a time.

    Args:
        first_s, longest_s: pauses between attempts [real s].
    """

    def __init__(self, first_s: float = FIRST_S, longest_s: float = LONGEST_S) -> None:
        self._first, self._longest = first_s, longest_s
        self._attempts = 0
        self._task: asyncio.Task[None] | None = None
        self._at = 0.0

    @property
    def waits_s(self) -> float | None:
        """Seconds until the next attempt, None when there will be none by itself."""
        if self._task is None or self._task.done():
            return None
        return max(0.0, self._at - asyncio.get_running_loop().time())

    def schedule(self, error: Exception, go: Callable[[], None]) -> None:
        """Call `go` after a while; a call that is pending already is kept."""
        if self.waits_s is None:
            pause = min(self._longest, self._first * 2.0**self._attempts)
            self._attempts += 1
            self._at = asyncio.get_running_loop().time() + pause
            self._task = asyncio.create_task(self._wait(error, go, pause))

    def progressed(self) -> None:
        """Work was done: the next trouble begins with the shortest pause again."""
        if self.waits_s is None:
            self._attempts = 0

    def cancel(self) -> None:
        """Somebody takes over, or the job has ended."""
        if self._task is not None:
            self._task.cancel()
            self._task = None
        self._attempts = 0

    async def _wait(self, error: Exception, go: Callable[[], None], pause: float) -> None:
        while True:
            await asyncio.sleep(pause)
            if not isinstance(error, DiskFullError) or _has_room(error):
                break
            self._at = asyncio.get_running_loop().time() + pause
        self._task = None
        go()


def _has_room(error: DiskFullError) -> bool:
    """Whether what could not be written would fit now, where the system tells."""
    data = error.data if isinstance(error.data, Mapping) else {}
    path, need = data.get("path"), data.get("bytes")
    if not isinstance(path, str) or not isinstance(need, int):
        return True
    free = free_bytes(Path(path).parent)
    return free is None or free > need
