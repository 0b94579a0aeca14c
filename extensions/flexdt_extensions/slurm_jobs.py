"""Jobs of a SLURM queue that run dask workers: submitted, watched, submitted again,
canceled.

A job that has left the queue, as one whose walltime is over, is submitted again while the
work goes on. Messages of sbatch, squeue and sacct are passed on unchanged. Jobs that end
repeatedly before one of their workers has come are an error.
"""

from __future__ import annotations

import re
import subprocess
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from flexdt.extending import CommandError, reason_of

REFUSED: Final = 4
"""Exit code where no workers can be had."""
MAX_BARREN: Final = 3
"""Number of jobs in a row that end before a worker of theirs has come, after which no
more are submitted."""
TIMEOUT_S: Final = 60.0
"""Time limit of one of SLURM's commands [s]."""
SHOWN_JOBS: Final = 4
"""Largest number of jobs that a line names."""
PLACEHOLDER: Final = "dummy-name"
"""Name of the workers in a script that dask-jobqueue writes."""


@dataclass
class Job:
    """One job.

    Attributes:
        id: SLURM's.
        name: of its workers, which have a number behind it where there are several.
        seen: whether a worker of it has come.
    """

    id: str
    name: str
    seen: bool = False

    def has(self, worker: str) -> bool:
        """Check whether a worker of that name belongs to the job."""
        return worker == self.name or worker.startswith(f"{self.name}-")


class SlurmJobs:
    """The jobs of one run.

    Args:
        script: that each runs, with `PLACEHOLDER` for the name of its workers.
        count: of jobs that are to be in the queue.
    """

    def __init__(self, script: str, count: int) -> None:
        """Prepare `count` jobs of a script; none is submitted yet."""
        self._script = script
        self._count = count
        self.jobs: list[Job] = []
        self._made = self._barren = 0

    def submit(self) -> None:
        """Submit the missing jobs with sbatch, each with a name of its own for its
        workers.

        Jobs submitted before an error stay.

        Raises:
            CommandError: sbatch refuses, in its own words.
        """
        while len(self.jobs) < self._count:
            name = f"flexdt-{self._made}"
            with tempfile.TemporaryDirectory() as folder:
                file = Path(folder) / "job.sh"
                file.write_text(self._script.replace(PLACEHOLDER, name), encoding="utf-8")
                said = _run("sbatch", str(file))
            found = re.search(r"\d+", said.stdout)
            if said.returncode or found is None:
                raise CommandError(f"sbatch refuses the job: {_words(said)}", REFUSED)
            self._made += 1
            self.jobs.append(Job(found[0], name))

    def tend(self, workers: Collection[str]) -> list[str]:
        """Note which jobs have workers, and replace jobs that have left the queue.

        Nothing is replaced if the queue cannot be read. Without a connected worker, a
        line names the jobs that are waited for.

        Args:
            workers: names of those that are connected.

        Returns:
            Lines of progress: states of the queue, ended jobs and errors.

        Raises:
            CommandError: `MAX_BARREN` jobs in a row ended before a worker of theirs came.
        """
        for job in self.jobs:
            job.seen = job.seen or any(map(job.has, workers))
        queue, lines = self._queue()
        if queue is not None:
            lines += self._replace([j for j in self.jobs if j.id not in queue], workers)
        if not workers:
            lines.append(self._waiting(queue or {}))
        return lines

    def close(self) -> None:
        """Remove all jobs from the queue."""
        if self.jobs:
            _run("scancel", *(job.id for job in self.jobs))
        self.jobs = []

    def _queue(self) -> tuple[dict[str, str] | None, list[str]]:
        """Read this user's jobs from squeue.

        Returns:
            Job id -> state and reason, and []; if squeue fails None, and its message.
        """
        said = _run("squeue", "--noheader", "--me", "--format=%i %T (%r)")
        if said.returncode:
            return None, [f"squeue: {_words(said)}"]
        rows = [
            line.split(maxsplit=1) for line in said.stdout.splitlines() if line.strip()
        ]
        return {row[0]: row[-1] for row in rows}, []

    def _replace(self, gone: Sequence[Job], workers: Collection[str]) -> list[str]:
        """Replace ended jobs by new ones, unless their workers are still connected.

        A job that has left the queue while its worker is connected stays listed; each
        other one is removed and named in a line. A job whose worker had come resets the
        count of barren ones. Then new jobs are submitted.

        Args:
            gone: jobs that have left the queue.
            workers: names of those that are connected.

        Returns:
            Lines about ended jobs, and an error of sbatch.

        Raises:
            CommandError: `MAX_BARREN` jobs in a row ended before a worker of theirs came.
        """
        lines = []
        for job in gone:
            if any(map(job.has, workers)):
                continue  # it is about to end
            self.jobs.remove(job)
            if job.seen:
                self._barren = 0
            else:
                self._barren = self._barren + 1
            why = _outcome(job.id)
            if self._barren >= MAX_BARREN:
                raise CommandError(
                    f"{MAX_BARREN} jobs have ended before a worker of theirs came, "
                    f"the last one, {job.id}: {why}; slurm-{job.id}.out may say more",
                    REFUSED,
                )
            lines.append(f"job {job.id} has ended ({why}); another one is submitted")
        try:
            self.submit()
        except CommandError as error:
            lines.append(str(error))
        return lines

    def _waiting(self, queue: Mapping[str, str]) -> str:
        """Describe in words which jobs are waited for, with their states in the queue (id
        -> state); the first `SHOWN_JOBS`, the number of the others.

        A job missing in the queue is UNKNOWN.
        """
        shown = [
            f"{job.id} {queue.get(job.id, 'UNKNOWN')}" for job in self.jobs[:SHOWN_JOBS]
        ]
        more = len(self.jobs) - len(shown)
        if not shown:
            return "waits for workers: no job is in the queue"
        return f"waits for workers of jobs {', '.join(shown)}{f' and {more} more' if more else ''}"


def lifetime_s(walltime: str) -> int | None:
    """Compute when workers end by themselves, so that their tasks go on elsewhere in time
    [s].

    Args:
        walltime: as SLURM reads it: minutes, MM:SS, HH:MM:SS, D-HH, D-HH:MM or D-HH:MM:SS.

    Returns:
        A minute, or a twentieth, before the walltime is over; None for 180 s or less, or
        another form.

    Example:
        >>> lifetime_s("01:00:00"), lifetime_s("2-00:00:00"), lifetime_s("UNLIMITED")
        (3420, 164160, None)
    """
    found = re.fullmatch(r"(?:(\d+)-)?(\d+)(?::(\d+))?(?::(\d+))?", walltime.strip())
    if found is None:
        return None
    days, *rest = (None if part is None else int(part) for part in found.groups())
    given = [part for part in rest if part is not None]
    if days is not None or len(given) == 3:
        hours, minutes, seconds = (*given, 0, 0)[:3]
    else:
        hours = 0
        (minutes, seconds) = (*given, 0)[:2]
    total = ((days or 0) * 24 + hours) * 3600 + minutes * 60 + seconds
    if total > 180:
        return total - max(60, total // 20)
    return None


def _outcome(job: str) -> str:
    """Read from sacct how a job ended, e.g. "FAILED, exit code 1:0"; "left the queue" if
    it is unknown or sacct fails.
    """
    said = _run(
        "sacct", "--noheader", "--parsable2", "--format=State,ExitCode", f"--jobs={job}"
    )
    lines = said.stdout.split()
    if not said.returncode and lines:
        return lines[0].replace("|", ", exit code ")
    return "left the queue"


def _words(said: subprocess.CompletedProcess[str]) -> str:
    """Format a command's output as one line."""
    text = said.stderr.strip() or said.stdout.strip() or f"exit code {said.returncode}"
    return " ".join(text.split())


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    """Run one of SLURM's commands and return its result; never raises.

    A command that is not installed or does not answer within `TIMEOUT_S` returns exit
    status 1 and the reason as its error text.
    """
    try:
        return subprocess.run(
            words,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=TIMEOUT_S,
            check=False,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        return subprocess.CompletedProcess(
            words, 1, "", f"no answer within {TIMEOUT_S:g} s"
        )
    except OSError as error:
        return subprocess.CompletedProcess(
            words, 1, "", f"{words[0]}: {reason_of(error)}"
        )


Tend = Callable[[Collection[str]], list[str]]
"""Acts on a cluster from the names of its connected workers, and returns lines of
progress."""
