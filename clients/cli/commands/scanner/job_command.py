"""`flexdt job ...`: list, status, pause, resume, step, abort."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Final

import typer

from flexdt.clients.cli.console import duration, table, warn
from flexdt.clients.cli.options import Answer, Twin

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient
    from flexdt.protocol.state_model import JobStatus

Job = Annotated[
    str | None, typer.Argument(metavar="JOB", help="As in `job list`; the current one if left out.")
]


def list_jobs(twin: Twin) -> Answer:
    """List all jobs, oldest first."""
    with twin() as client:
        found = client.jobs()
    yield found
    rows = [(j.job, j.state, f"{j.frames_done}/{j.frames_total}", j.dataset or j.name)
            for j in found.jobs]  # fmt: skip
    yield table(rows, ("job", "state", "frames", "data set")) if rows else "no jobs yet"


def _on_job(does: str, act: Callable[[TwinClient, str | None], JobStatus]) -> Callable[..., Answer]:
    """A command that does something with one job and shows how the job is then."""

    def command(twin: Twin, job: Job = None) -> Answer:
        with twin() as client:
            status = act(client, job)
        warn(status.warnings)
        yield status
        yield describe(status)

    command.__doc__ = does
    return command


def describe(status: JobStatus) -> str:
    """A job in one line."""
    text = f"{status.job}: {status.state}, {status.frames_done} of {status.frames_total} frames"
    if status.line is not None:
        text += f", line {status.line}"
    if status.what:
        text += f" ({status.what})"
    if status.remaining_s is not None and status.state in ("queued", "running", "paused"):
        text += f", {duration(status.remaining_s)} left on the twin's clock"
    if status.error:
        text += f"; {status.error.get('message', status.error)}"
    if status.dataset:
        text += f"; data set {status.dataset}"
    return text


COMMANDS: Final = {
    "list": list_jobs,
    "status": _on_job("Show how far a job is.", lambda client, job: client.job_status(job)),
    "pause": _on_job(
        "Pause a job; a frame under exposure is taken again.",
        lambda client, job: client.pause_job(job),
    ),
    "resume": _on_job(
        "Return to the pose of the pause and go on.", lambda client, job: client.resume_job(job)
    ),
    "step": _on_job("Run a paused job for one step.", lambda client, job: client.step_job(job)),
    "abort": _on_job(
        "End a job; its data set stays, marked incomplete.",
        lambda client, job: client.abort_job(job),
    ),
}
"""Commands of the group by name."""
