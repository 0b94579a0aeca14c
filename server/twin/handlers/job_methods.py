"""script.*, trajectory.* and job.*: scans."""

from __future__ import annotations

import asyncio
import base64
import binascii
from collections.abc import Callable
from datetime import timedelta
from typing import TypeAlias

from flexdt.protocol import Method
from flexdt.protocol import state_model as w
from flexdt.protocol.messages import Encoded
from flexdt.protocol.methods import job_messages as p
from flexdt.protocol.rpc_errors import invalid_params, too_large
from flexdt.runtime.files.own_documents import Changes
from flexdt.runtime.wire_errors import from_root
from flexdt.server.scans.scan_job import ENDED_PHASES, Job
from flexdt.server.scans.scan_record import JobRecord, ScanSource
from flexdt.server.twin.core import TwinServer
from flexdt.server.twin.handlers import handler as h
from flexdt.twin.dataset.dataset_errors import DatasetError
from flexdt.twin.errors import CollisionError

MAX_SCRIPT_BYTES = 8 << 20
PATIENCE_S = 2.0
"""Longest wait of an answer for a job to reach the requested state [s]."""
ScanInput: TypeAlias = p.ScriptInput | p.TrajectoryInput
CHECK: tuple[Method[ScanInput, p.CheckResult], ...] = (p.SCRIPT_CHECK, p.TRAJECTORY_CHECK)
SUBMIT: tuple[Method[ScanInput, p.SubmitResult], ...] = (
    p.SCRIPT_SUBMIT,
    p.TRAJECTORY_SUBMIT,
)


@h.answers(*CHECK)
async def check(twin: TwinServer, client: h.Client, params: ScanInput) -> Encoded:
    """Compute the dry-run report; nothing moves."""
    return await twin.submissions.check(_source(params), client.peer.codec)


@h.answers(*SUBMIT)
async def submit(twin: TwinServer, client: h.Client, params: ScanInput) -> p.SubmitResult:
    """Check a script or poses, and put the scan into the queue; the client's control is checked
    again when it is queued.

    Returns the job's id, its data set's folder, and warnings.
    Raises RpcError, TwinError: as `Submissions.submit`."""
    ready = h.ensure_allowed(twin, client, "a scan")
    job = await twin.submissions.submit(
        _source(params), params.name, params.speed_up, client.program, ready
    )
    return p.SubmitResult(job=job.id, dataset=job.folder, warnings=job.warnings)


@h.answers(p.JOB_STATUS)
def status(twin: TwinServer, client: h.Client, params: p.JobRef) -> w.JobStatus:
    """Return the progress of a job."""
    return twin.jobs.status(twin.jobs.get(params.job))


@h.answers(p.JOB_PAUSE)
async def pause(twin: TwinServer, client: h.Client, params: p.JobRef) -> w.JobStatus:
    """Pause a job: motion stops, and frames being made are finished."""
    job = twin.jobs.get(params.job)
    twin.jobs.pause(job)
    return await _when(twin, job, lambda: job.phase != "running")


@h.answers(p.JOB_RESUME)
async def resume(twin: TwinServer, client: h.Client, params: p.JobRef) -> w.JobStatus:
    """Continue a paused job after its return to its pose; queue a job that ended early, aborted
    or failed, once more.

    For a paused job the answer waits until it runs or is refused, at most `PATIENCE_S`. A done
    job raises as `Jobs.resume`.

    Returns the job's status.
    Raises RpcError: -32003, the client may not move; CollisionError: a contact is ahead; the job
    stays paused.
    """
    job = twin.jobs.get(params.job)
    if job.phase in ENDED_PHASES and job.phase != "done":
        queued = await twin.submissions.again(
            job, h.ensure_allowed(twin, client, "a scan")
        )
        return twin.jobs.status(queued)
    twin.jobs.resume(job)
    status = await _when(
        twin, job, lambda: job.phase != "paused" or job.error is not None
    )
    return _unless_obstructed(job, status)


@h.answers(p.JOB_STEP)
async def step(twin: TwinServer, client: h.Client, params: p.JobRef) -> w.JobStatus:
    """Run one frame or command of a paused job, wait for its end at most `PATIENCE_S`,
    and return the job's status.

    Raises CollisionError: an obstacle stopped it; the job stays paused.
    """
    job = twin.jobs.get(params.job)
    twin.jobs.step(job)
    runner = job.runner
    return _unless_obstructed(
        job, await _when(twin, job, lambda: runner is None or not runner.stepping)
    )


@h.answers(p.JOB_ABORT)
async def abort(twin: TwinServer, client: h.Client, params: p.JobAbort) -> w.JobStatus:
    """End a job with X-rays off; its data set stays, marked incomplete with the reason.

    Without `job` it is the current or last one. The answer waits at most
    `PATIENCE_S` for the job's end, and then until that is on the disk.

    Returns:
        The job's status; a disk that fails is a warning in it, no error.
    """
    job = twin.jobs.get(params.job)
    twin.jobs.abort(job, params.reason, client.name)
    unsaved = ""
    # The end first, then the disk: what the answer says is what a restart finds.
    await _when(twin, job, lambda: job.phase in ENDED_PHASES)
    try:
        await twin.state_store.flush(job.id)
    except (OSError, DatasetError) as error:  # an abort does not fail because of the disk
        reason = from_root(str(error), twin.root)
        unsaved = f"the abort is not on the disk, and a killed server would not know it: {reason}"
    status = twin.jobs.status(job)
    if unsaved:
        warnings = [*status.warnings, unsaved]
    else:
        warnings = status.warnings
    return status.model_copy(update={"warnings": warnings})


@h.answers(p.JOB_LIST)
async def list_jobs(
    twin: TwinServer, client: h.Client, params: p.JobList
) -> p.JobListResult | Encoded:
    """List the jobs that are kept, or a part of them, oldest first, in several turns of the
    loop if there are many.
    """
    known = twin.jobs.all()
    jobs = await h.in_turns(h.page(known, params.start, params.count), twin.jobs.status)
    result = p.JobListResult(jobs=jobs, total=len(known))
    return await h.encoded_apart(client, result, len(jobs))


@h.answers(p.JOB_FORGET)
async def forget(
    twin: TwinServer, client: h.Client, params: p.JobForget
) -> p.JobForgetResult:
    """Remove ended jobs and their files from the list; data sets stay.

    They are the job named, whenever it ended, or else all that ended at least `days` ago;
    without `days` all ended ones. A scan whose data
    set exists keeps its record, so submitting it again resumes it.

    Returns:
        The ids of the removed jobs.

    Raises:
        UnknownNameError: there is no such job.
        RpcError: -32003, the named one has not ended.
        DatasetWriteError: the system cannot write; nothing is removed.
    """
    jobs: list[Job] = []

    def choose() -> None:
        """Decide which jobs go: none of them is resumed before the change is made."""
        jobs.extend(twin.jobs.ended(params.job, timedelta(days=params.days or 0.0)))

    def files(changes: Changes) -> None:
        """Add to the changes on the disk: the removal of the jobs' files, and of the scan
        records where the data set's folder does not exist.
        """
        twin.job_files.remove(changes, [job.id for job in jobs])
        # Of these nothing is left to go on with.
        lost = [job.name for job in jobs if twin.directory.stat(job.name) is None]
        JobRecord.forget(changes, twin.directory, lost)

    def take() -> None:
        """Remove the jobs from the list and mark the state as changed."""
        twin.jobs.forget(jobs)
        twin.changed()

    await twin.state_store.keep(take, files=files, choose=choose)
    return p.JobForgetResult(jobs=[job.id for job in jobs])


async def _when(twin: TwinServer, job: Job, condition: Callable[[], bool]) -> w.JobStatus:
    """Wait until `condition` holds, at most `PATIENCE_S` of real time, and return the
    job's status either way.

    The condition is tested every 5 ms.
    """
    loop = asyncio.get_running_loop()
    deadline = loop.time() + PATIENCE_S
    while not condition() and loop.time() < deadline:
        await asyncio.sleep(0.005)
    return twin.jobs.status(job)


def _unless_obstructed(job: Job, status: w.JobStatus) -> w.JobStatus:
    """Return `status`, unless the job is paused by an obstacle: then raise its
    CollisionError.

    Other errors of a paused job stay in the status.
    """
    error = None
    if job.runner is not None:
        error = job.runner.progress.error
    if status.state == "paused" and isinstance(error, CollisionError):
        raise error
    return status


def _source(params: ScanInput) -> ScanSource:
    """Make the requested scan from a script's text or its bytes in base64, or from a list
    of poses.

    Exposure and flat frames are taken from the request for poses only; motion samples and
    seed for both.

    Raises:
        RpcError: -32602, `data_base64` is not base64; -32008, the script has more than
            `MAX_SCRIPT_BYTES`.
    """
    if isinstance(params, p.TrajectoryInput):
        return ScanSource.of_poses(
            params.poses,
            params.exposure_ms,
            params.motion_samples,
            params.seed,
            params.flat,
        )
    if params.text is not None:
        script = params.text.encode("utf-8")
    else:
        try:
            script = base64.b64decode(params.data_base64 or "", validate=True)
        except (binascii.Error, ValueError):
            raise invalid_params(
                "data_base64 is not base64",
                [{"path": "data_base64", "message": "not base64"}],
            ) from None
    if len(script) > MAX_SCRIPT_BYTES:
        raise too_large("a script", len(script), MAX_SCRIPT_BYTES)
    return ScanSource(script, moments=params.motion_samples, seed=params.seed)
