"""Jobs as they were, one small file each under DATA/jobs/status.

A change of a job writes that job's file alone, so it costs the same however many jobs
there are. The start of a scan is in DATA/jobs, one file a data set
(`server/scans/scan_record.py`).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Annotated, Literal

from annotated_types import Ge, Le
from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from flexdt.protocol.fields import SpeedUp
from flexdt.protocol.state_model import JobPhase
from flexdt.runtime.files import own_documents as documents
from flexdt.runtime.files.directory import Directory
from flexdt.twin.dataset.file_names import plain_name

RECORDS = "jobs"
"""Name of the folder of the records from which scans start."""
FOLDER = "status"
"""Name of the folder of these files in it."""
NUMBERED = re.compile(r"job-(\d{1,15})")

Seconds = Annotated[float, Ge(0), Le(1e12)]
Count = Annotated[int, Ge(0), Le(2**53)]


class JobMemory(BaseModel):
    """Stored state of a job.

    Attributes:
        ended: when it ended, by the server's calendar; None while it has not.
        ended_by: connection that aborted it; None where nobody did.
        start: where the motors stood when it began [mm, deg]; None before that.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", populate_by_name=True, allow_inf_nan=False
    )

    id: str
    name: str
    folder: Annotated[str, AfterValidator(plain_name)]
    phase: JobPhase
    frames_total: Count
    frames_done: Count
    duration_s: Seconds
    elapsed_s: Seconds = 0.0
    speed_up: SpeedUp | None = None
    warnings: list[str] = Field(default_factory=list)
    error: dict[str, object] | None = None
    ended: datetime | None = None
    ended_by: str | None = None
    start: dict[str, float] | None = None


class JobFile(JobMemory):
    """A job as a document."""

    schema_version: Literal[1] = Field(alias="schema")


class JobFiles:
    """The files of all jobs; any thread may call.

    Args:
        root: the data directory.
    """

    def __init__(self, root: Directory) -> None:
        """Name the folder of the jobs' files; it is made at the first write."""
        self._records = root.folder(RECORDS)
        self._folder = self._records.folder(FOLDER)

    def read(self) -> list[JobMemory]:
        """Read every job, ordered by number; files that cannot be read are renamed and
        logged.
        """
        found = []
        for file in documents.ours(self._folder):
            without = "a job cannot be read; without it (its data set stays)"
            job = documents.read_or_set_aside(self._folder, file, _reader(file), without)
            if job is not None:
                found.append(job)
        return sorted(found, key=lambda job: number_of(job.id))

    def put(self, changes: documents.Changes, job: JobMemory) -> None:
        """Write a job. Raises DatasetWriteError: the system refuses."""
        self._records.make()
        changes.put(self._folder, _file(job.id), _text(job))

    def remove(self, changes: documents.Changes, jobs: Sequence[str]) -> None:
        """Delete the files of jobs, among other changes; none there is no error."""
        changes.remove(self._folder, *map(_file, jobs))

    def write(self, job: JobMemory) -> None:
        """Write a job that has changed; the folder is made if it is missing. Raises
        DatasetWriteError: the system refuses."""
        self._records.make()
        self._folder.keep(_file(job.id), _text(job))

    def delete(self, jobs: Sequence[str]) -> None:
        """Delete the files of jobs, and wait for the disk once; a missing file is no
        error.

        Raises:
            DatasetWriteError: the system refuses.
        """
        self._folder.discard(*map(_file, jobs))

    def clear(self) -> None:
        """Delete the file of every job; one that cannot be deleted stays."""
        for file in documents.ours(self._folder):
            with suppress(OSError):
                self._folder.unlink(file)

    def settle(self) -> None:
        """Delete what killed writers left; set aside other entries in place of folders."""
        documents.settle(self._records, [FOLDER])


def number_of(job: str) -> int:
    """Return the number in a job's name; 0 for a name of another form."""
    match = NUMBERED.fullmatch(job)
    return 0 if match is None else int(match[1])


def _file(job: str) -> str:
    """Return the file name of a job."""
    return f"{documents.file_stem(job)}.json"


def _text(job: JobMemory) -> bytes:
    """Encode a job as indented JSON with its schema."""
    document = JobFile(schema=1, **job.model_dump())
    return document.model_dump_json(by_alias=True, indent=1).encode("utf-8")


def _reader(file: str) -> Callable[[bytes], JobMemory]:
    """Make the parser of a job's file; it raises ValueError if the job has another name."""

    def read(data: bytes) -> JobMemory:
        """Parse a job; raise ValueError if it is not the one in the file's name, or invalid."""
        found = JobFile.model_validate(documents.read_json(data))
        if file != _file(found.id):
            raise ValueError(f"it is about {found.id!r}")
        return JobMemory.model_validate(found.model_dump(exclude={"schema_version"}))

    return read
