"""`flexdt run` and `flexdt job`: scripts run on a twin, and the jobs that they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from flexdt.clients.cli import value_completion
from flexdt.clients.cli.boundary import (
    INTERRUPTED,
    INVALID,
    REFUSED,
    WIRE_EXIT_CODES,
    positions,
    wire_code,
)
from flexdt.clients.cli.commands.scanner_commands import put_on_stage, warn_of_exposure
from flexdt.clients.cli.commands.script_files import ScriptFile
from flexdt.clients.cli.console import duration, note, table, warn
from flexdt.clients.cli.options import Answer, Twin, option
from flexdt.library.failure import CommandError
from flexdt.runtime import process_settings
from flexdt.runtime.files.limited_files import limited_bytes
from flexdt.twin import long_work

if TYPE_CHECKING:
    from flexdt.clients.client.client import TwinClient
    from flexdt.protocol.state_model import JobStatus

ALL: Final = "all"
"""Word for every job that has ended."""
Job = Annotated[
    str | None,
    typer.Argument(metavar="JOB", help="As in `job list`; the current one if left out."),
]


def run(
    twin: Twin,
    script: ScriptFile,
    out: str | None = option(None, metavar="NAME"),
    sample: str | None = option(
        None, metavar="NAME or FILE", proposes=value_completion.sample_names
    ),
    speed_up: Any = option(None, metavar="X or max", parser=process_settings.speed_up),
    detach: bool = option(False, "--detach"),
) -> Answer:
    """Run a script on the twin and wait for the data set.

    Ctrl-C leaves the scan running; `flexdt job` steers it.

    Args:
        out: Give the data set this name.
        sample: Put this sample on the stage first; a file is sent (mesh: ABS, in mm).
        speed_up: Let the twin's time run X times as fast as yours.
        detach: Return once the script is submitted.

    Yields:
        With --detach the submitted job as document and line; else the job's last status,
        both ways. Raises CommandError for a refused script (its places are printed first)
        and for a job that did not end as done.
    """
    from flexdt.protocol.rpc_errors import RpcError

    data = limited_bytes(script, "script")
    with twin() as client:
        if sample is not None:
            warn(put_on_stage(client, sample).warnings)
        began = client.state().time
        try:
            made = client.submit_script(data, name=out, speed_up=speed_up)
        except RpcError as error:
            places = positions(error.data, str(script))
            if not places:
                raise
            for place in places:
                note(place)
            raise CommandError(
                f"{script} was refused; nothing was started", wire_code(error)
            ) from None
        warn(made.warnings, script)
        if detach:
            yield made
            yield f"{made.job} submitted; `flexdt job status {made.job}`"
            return
        last = follow(client, made.job)
        seen = client.state().image
    if seen is not None and (seen.time or 0.0) >= began:
        warn_of_exposure(seen)
    yield last
    yield describe(last)
    if last.state != "done":
        message = (last.error or {}).get("message", "the data set is incomplete")
        raise CommandError(f"{last.job} {last.state}: {message}", failure_code(last))


def failure_code(status: JobStatus) -> int:
    """Determine the exit code of a job that did not end well."""
    return WIRE_EXIT_CODES.get((status.error or {}).get("code"), INVALID)


def follow(client: TwinClient, job: str, *, own: bool = False) -> JobStatus:
    """Show a job's progress as a bar on standard error until it ends.

    A pause because of an error is reported once with its reason, and waited for unless
    the job is an own one.

    Args:
        client: connected to the twin.
        job: which one.
        own: no other client steers the job, so Ctrl-C and a pause because of an error end
            the wait.

    Returns:
        Its last status.

    Raises:
        CommandError: Ctrl-C; the job goes on, and the message explains how to steer it. Of an
            own job: it is paused because of an error.
        KeyboardInterrupt: Ctrl-C, of an own job.
    """
    shown = ""

    def show(status: JobStatus) -> None:
        """Update the progress bar, and report why a job is paused.

        A reason is shown once; only an own job raises. Any state but running is named
        beside the bar.

        Raises:
            CommandError: the job is paused, and only this command could resume it.
        """
        nonlocal shown
        state = "" if status.state == "running" else status.state
        counted(status.frames_done, status.frames_total, state)
        if status.error:
            reason = str(status.error.get("message", ""))
        else:
            reason = ""
        if status.state == "paused" and reason and reason != shown:
            shown = reason
            if own:
                raise CommandError(f"{job} is paused: {reason}", failure_code(status))
            note(f"{job} is paused: {reason}; `flexdt job resume {job}` goes on")

    try:
        with long_work.during(job) as report:
            counted = long_work.in_units(report, "frames")
            return client.wait_job(job, show)
    except KeyboardInterrupt:
        if own:
            raise
        raise CommandError(
            f"detached; {job} goes on: `flexdt job status {job}`, `flexdt job abort {job}`",
            INTERRUPTED,
        ) from None


def list_jobs(twin: Twin) -> Answer:
    """List all jobs, oldest first.

    Yields:
        The jobs as document of --json, then a table, or "no jobs yet".
    """
    with twin() as client:
        found = client.jobs()
    yield found
    rows = [
        (j.job, j.state, f"{j.frames_done}/{j.frames_total}", j.dataset or j.name)
        for j in found.jobs
    ]
    yield table(rows, ("job", "state", "frames", "data set")) if rows else "no jobs yet"


def _on_job(does: str, method: str, steers: str | None = None) -> Callable[..., Answer]:
    """Make a command that acts on one job and shows its new status.

    A job that is left out is the current one; with `steers` that has to exist.

    Args:
        does: help of the command.
        method: of the client, called with the job.
        steers: verb of a command that needs a job that has not ended; None: any job.
    """

    def command(twin: Twin, job: Job = None) -> Answer:
        """Call the twin's method for a job (None: the current one); print its warnings.

        With `steers` a missing current job raises CommandError.
        """
        with twin() as client:
            if job is None and steers is not None:
                _require_current(client, steers)
            status: JobStatus = getattr(client, method)(job)
        warn(status.warnings)
        yield status
        yield describe(status)

    command.__doc__ = does
    return command


def _require_current(client: TwinClient, verb: str) -> None:
    """Check that there is a current job, for a command that names none.

    Raises CommandError: nothing to `verb`; exit code REFUSED.
    """
    from flexdt.clients.client.twin_methods import FINAL_STATES

    if all(job.state in FINAL_STATES for job in client.jobs().jobs):
        raise CommandError(
            f"nothing to {verb}: no job is queued, running or paused", REFUSED
        )


def forget(
    twin: Twin,
    job: str = typer.Argument(
        metavar="JOB", help="As in `job list`; `all` that have ended."
    ),
) -> Answer:
    """Forget an ended job; its data set stays.

    Yields:
        The forgotten jobs as document of --json, then a line with their names.
    """
    with twin() as client:
        if job == ALL:
            gone = client.forget_job(days=0.0)
        else:
            gone = client.forget_job(job)
    yield gone
    yield f"forgotten: {', '.join(gone.jobs) or 'none'}"


def describe(status: JobStatus) -> str:
    """Format a job as one line: name, state, frames done of all.

    Then, where known: script line, present command, time left on the twin's clock (only while
    queued, running or paused), the error's message, and the data set. An error without
    message is shown whole.
    """
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


JOB_COMMANDS: Final = {
    "list": list_jobs,
    "status": _on_job("Show how far a job is.", "job_status"),
    "pause": _on_job(
        "Pause a job; a frame under exposure is taken again.", "pause_job", "pause"
    ),
    "resume": _on_job("Return to the pose of the pause and go on.", "resume_job"),
    "step": _on_job("Run a paused job for one step.", "step_job"),
    "abort": _on_job(
        "End a job; its data set stays, marked incomplete.", "abort_job", "abort"
    ),
    "forget": forget,
}
"""Commands of the group by name."""
