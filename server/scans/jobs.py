"""Scans as jobs: a queue, one at a time, each a plan run into a data set that can be resumed.

A job outlives the client that submitted it. A job that cannot continue (projector gone,
disk full, E-stop) pauses it with the reason; a job that ends early leaves its data set
marked incomplete, and the same script submitted under the same name takes up where it
stopped, with the same noise. Who may command is decided in `handlers`.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from flexdt.protocol.rpc_errors import RpcError, busy
from flexdt.protocol.state_model import JobPhase, JobStatus
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.log import log, traced
from flexdt.runtime.wire_errors import explain, is_user_error
from flexdt.server.scans.job_retries import Retry, transient
from flexdt.server.scans.runner import JobAborted, Produce, ScanRunner
from flexdt.server.scans.scan_job import ENDED_PHASES, Job, JobInputs, Prepare, recalled
from flexdt.server.scans.twin_clock import SpeedUp, TwinClock
from flexdt.server.storage.job_files import JobMemory, number_of
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.motion.drives import clock_left, require_time
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import Exposure, ScanPlan

PUBLISH_INTERVAL_S = 0.1
MAX_NAMED_JOBS = 20
"""Number of the newest jobs that an error lists."""


class Jobs:
    """The queue.

    Args:
        scanner, clock: the twin's.
        changed: called with a job whenever its status has changed.
        max_waiting: jobs in the queue at a time.
        projectors: that make frames at the same time.
        root: the data directory, to name the paths of files in errors.
        max_ended: ended jobs that are known; beyond them the oldest is forgotten.
        max_age: of an ended job that is known.
        today: the date.
    """

    def __init__(
        self,
        scanner: ScannerTwin,
        clock: TwinClock,
        changed: Callable[[Job], None],
        *,
        max_waiting: int = 1000,
        projectors: int = 1,
        root: Path | None = None,
        max_ended: int = 1000,
        max_age: timedelta = timedelta(days=365),
        today: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        """Make an empty queue of scans; nothing runs before `work`.

        Args:
            scanner: on which scans run.
            clock: the twin's time.
            changed: called after each change of a job.
            max_waiting: number of jobs that may wait.
            projectors: scales how many frames are made at a time.
            root: data directory, to which paths in jobs' errors become relative; None:
                they stay.
            max_ended, max_age: how many ended jobs are kept, and for how long.
            today: the time now.
        """
        self._root = root
        self._max_ended = max_ended
        self._max_age = max_age
        self._today = today
        self._projectors = projectors
        self._scanner = scanner
        self._clock = clock
        self._notify = changed
        self._all: dict[str, Job] = {}
        self._changed: set[str] = set()
        """Names of jobs changed or forgotten since the last call of `changed`."""
        self._queue: asyncio.Queue[Job] = asyncio.Queue()
        self._count = 0
        self.current: Job | None = None
        self.retry = Retry()
        self.max_waiting = max_waiting
        self.frames_made = 0
        self._preparing = False
        """True while the current job is being opened: its checked conditions must not
        change."""
        self._manual = False
        """True if only `resume` continues the current job, whatever stopped it."""
        self._interrupted: Exception | None = None
        """Last stop from outside since the current job's turn."""

    # Asking -------------------------------------------------------------------------------------

    def all(self) -> list[Job]:
        """List every job, oldest first."""
        return list(self._all.values())

    def get(self, job: str | None) -> Job:
        """Return the job with id `job`, or for None the current or else the last one.

        An ended job is returned, too, while it is kept. The last one is no job that was taken
        off the queue before its turn, unless there are no others.

        Raises:
            UnknownNameError: no such job, or no job at all; lists the last
                `MAX_NAMED_JOBS` jobs and the number of older ones.
        """
        if job is None and self.current is not None:
            return self.current
        if job is None and self._all:
            newest = next(reversed(self._all.values()))
            ran = (j for j in reversed(self._all.values()) if not j.never_began)
            return next(ran, newest)
        if job is None or job not in self._all:
            asked = "" if job is None else f"no job {job!r}; "
            last = list(self._all)[-MAX_NAMED_JOBS:]
            older = len(self._all) - len(last)
            more = ""
            if older:
                more = f"{older} older ones and "
            there = "there are no jobs yet"
            if last:
                there = f"there are: {more}{', '.join(last)}"
            raise UnknownNameError(asked + there, {"asked": job, "allowed": last})
        return self._all[job]

    @property
    def running(self) -> bool:
        """True while a job moves the scanner (not while it is paused)."""
        return self.current is not None and self.current.phase == "running"

    @property
    def busy(self) -> bool:
        """Whether the current job makes frames or opens, or runs at "max".

        Not if it is paused, or waits between frames.
        """
        job = self.current
        if job is None or job.phase != "running":
            return False
        runner = job.runner
        return runner is None or not runner.idle or self._clock.speed_up == "max"

    def require_idle(self, what: str) -> None:
        """Refuse a command that would disturb the current job.

        A job is disturbed while it runs, is being opened, or is being resumed. A paused
        job is not, nor one that was aborted while it was opened.

        Args:
            what: command, for the message.

        Raises:
            RpcError: -32003, names the job.
        """
        # One that was aborted while it was being opened will not run.
        job = self.current
        opening = self._preparing and job is not None and not job.aborting
        # While its remainder is swept it is paused still, with its settings back in force.
        going_on = job is not None and job.runner is not None and not job.runner.paused
        if self.current is not None and (going_on or opening):
            how = "begins"
            if going_on:
                how = "runs; pause it first"
            raise busy(
                f"{what} is refused while {self.current.id} {how}",
                {"asked": what, "job": self.current.id, "allowed": "job.pause"},
            )

    @contextmanager
    def manual_control(self) -> Iterator[None]:
        """Run a manual command inside the context, and cancel the automatic resume of a
        paused job.

        Afterwards only `resume` continues that job. If the command fails before anything
        has moved, the automatic resume is scheduled again.
        """
        by_hand = self._manual
        programmes = self._scanner.programmes
        self._manual = True
        try:
            yield
        except Exception:
            # The number of programmes of motion tells whether the command has moved anything.
            if self._scanner.programmes == programmes:
                self._manual = by_hand
                self._schedule_resume()
            else:
                self.retry.cancel()
            raise
        self.retry.cancel()

    def uses(self, folder: str) -> bool:
        """Return whether a job that has not ended writes into `folder`."""
        return any(
            j.folder == folder and j.phase not in ENDED_PHASES for j in self._all.values()
        )

    def showing(self, sample: str) -> Job | None:
        """Return the first job that has not ended and uses the sample of that name, or None."""
        unended = (j for j in self._all.values() if j.phase not in ENDED_PHASES)
        return next(
            (j for j in unended if j.sample is not None and j.sample.name == sample), None
        )

    def shows(self, sample: Sample) -> None:
        """Set the sample of the current job; nothing without one."""
        if self.current is not None:
            self.current.sample = sample

    def samples(self) -> list[Sample]:
        """List the samples of jobs that have not ended, one for each job that has one."""
        unended = (j for j in self._all.values() if j.phase not in ENDED_PHASES)
        return [j.sample for j in unended if j.sample is not None]

    def clock_left(self) -> float:
        """Return how long a scan that began now might take [s]."""
        return clock_left(self._clock.now())

    def status(self, job: Job) -> JobStatus:
        """Make the wire form of a job: its phase, progress, times [s], error and
        warnings.

        An ended job has 0 s left and no present command. The speed-up is the job's, else
        the clock's; `retry_s` is None but for the current job.
        """
        p = job.where
        step = None if p is None else p.step
        return JobStatus(
            job=job.id,
            state=job.phase,
            name=job.name,
            dataset=job.folder,
            frames_done=job.frames_done,
            frames_total=job.frames_total,
            elapsed_s=job.elapsed_s,
            remaining_s=0.0
            if job.phase in ENDED_PHASES
            else max(0.0, job.duration_s - job.elapsed_s),
            time=self._clock.now(),
            speed_up=self._clock.speed_up if job.speed_up is None else job.speed_up,
            real_time_factor=self._clock.real_time_factor,
            error=job.error,
            retry_s=self.retry.waits_s if job is self.current else None,
            warnings=job.warnings,
            step=None if step is None else step.index,
            line=None if step is None else step.line,
            what="" if p is None or job.phase in ENDED_PHASES else p.what,
            ended_by=job.ended_by,
            start=job.start,
        )

    # Commanding ---------------------------------------------------------------------------------

    def draft(
        self,
        name: str,
        folder: str,
        plan: ScanPlan,
        prepare: Prepare,
        speed_up: SpeedUp | None = None,
        warnings: list[str] | None = None,
        job: Job | None = None,
        sample: Sample | None = None,
    ) -> Job:
        """Make a queued job, new or as the next state of an ended one; neither list nor
        queue knows it before `enqueue`.

        A new job gets the next number, a continued one keeps its own and loses its error
        and end.

        Args:
            name, folder: of the data set.
            plan, prepare, speed_up, warnings: of the scan; `prepare` makes the job's
                inputs at its turn.
            job: ended job to continue, whose name and folder it keeps; None for a new
                one.
            sample: sample of the scan.

        Raises:
            UnknownNameError: the job has been forgotten.
            RpcError: -32003, `max_waiting` jobs wait, or the job has not ended.
            LimitError: the scan would end after the twin's clock.
        """
        if job is not None:
            job = self.get(job.id)
        waiting = sum(each.phase == "queued" for each in self._all.values())
        if waiting >= self.max_waiting:
            data = {"asked": waiting + 1, "allowed": self.max_waiting}
            raise busy(f"{waiting} jobs wait already", data)
        if job is not None and job.phase not in ENDED_PHASES:
            raise self._phase_error("resume", job, ENDED_PHASES)
        self._require_time(plan.duration_s)
        return replace(
            job or Job(f"job-{self._count + 1}", name, folder),
            prepare=prepare,
            phase="queued",
            error=None,
            ended=None,
            ended_by=None,
            aborting=False,
            aborted_for=None,
            speed_up=speed_up,
            frames_total=plan.frames,
            duration_s=plan.duration_s,
            warnings=warnings or [],
            sample=sample,
        )

    def _require_time(self, duration_s: float) -> None:
        """Check that a scan that begins now ends before the clock does; raise LimitError."""
        now = self._clock.now()
        require_time("the scan", now + duration_s, now)

    def enqueue(self, draft: Job) -> Job:
        """Put a drafted job into the list and at the end of the queue, and publish it;
        old ended jobs are forgotten.

        Returns:
            The job of the list: for a continued job the same object as before, with the
            draft's fields.
        """
        self._forget_old(but=draft.id)
        self._count += draft.id not in self._all
        job = self._all.setdefault(draft.id, draft)
        # Into the same object: who holds the job, such as a wait for its end, follows it.
        vars(job).update(vars(draft))
        self._queue.put_nowait(job)
        self._tell(job)
        return job

    def pause(self, job: Job) -> None:
        """Pause a running job, and cancel a planned retry.

        Raises RpcError: -32003, it does not run.
        """
        runner = self._runner(job, "pause", ("running", "paused"))
        self._take_over()
        runner.pause()
        self._tell(job)

    def resume(self, job: Job) -> None:
        """Let a paused job go on, and cancel a planned retry.

        Raises RpcError: -32003, it does not run.
        """
        runner = self._runner(job, "resume", ("running", "paused"))
        self.retry.cancel()
        self._manual = False
        runner.resume()

    def step(self, job: Job) -> None:
        """Run a paused job for one step; a planned retry is canceled.

        Raises RpcError: it is not paused."""
        runner = self._runner(job, "step", ("paused",))
        self._take_over()
        runner.step()

    def abort(self, job: Job, reason: str | None = None, by: str | None = None) -> None:
        """End a job; its data set stays, incomplete, with the reason.

        A waiting job ends at once, a running one at its next wait. One being opened stays
        queued until its data set is marked, and does not run. `by`: connection of the
        request; the first one stays `ended_by`.
        """
        if job.phase in ENDED_PHASES:
            return
        job.ended_by = job.ended_by or by
        if job.runner is not None:
            job.runner.abort(reason)
        elif job is self.current and self._preparing:
            # Its data set is being written: "aborted" would be a promise that it is at rest.
            job.aborting = True
            job.aborted_for = reason
            self._tell(job)
        else:
            job.phase = "aborted"
            job.ended = self._today()
            self._tell(job)

    def interrupt(self, reason: Exception) -> None:
        """Pause the current job after a stop from outside, also while it is opened or
        resumed.

        A retry is canceled. A paused job keeps its reason. `reason`: shown as the job's
        error.
        """
        self._take_over()
        self._interrupted = reason
        runner = None
        if self.current is not None:
            runner = self.current.runner
        # A paused job that is just being resumed is paused as well.
        if runner is not None and not runner.paused:
            runner.pause(reason)

    def _take_over(self) -> None:
        """Cancel a planned retry; only `resume` continues the current job from now on."""
        self.retry.cancel()
        self._manual = True

    # Remembering and forgetting -----------------------------------------------------------------

    @property
    def made(self) -> int:
        """Number of jobs."""
        return self._count

    def changed(self) -> dict[str, JobMemory | None]:
        """Return the jobs changed since the last call, as name -> record, by number, and
        empty the list of changes.

        The record is None for a forgotten job.
        """
        # Taken whole: what changes from now on is for the next write.
        names = self._changed
        self._changed = set()
        known = {name: self._all.get(name) for name in sorted(names, key=number_of)}
        return {
            name: None if job is None else job.memory() for name, job in known.items()
        }

    def kept_of(self, jobs: Sequence[JobMemory]) -> list[JobMemory]:
        """Select the jobs of an earlier server that are not forgotten at once, oldest
        first.
        """
        ended = [job.id for job in jobs if job.phase in ENDED_PHASES]
        forgotten = set(ended[: max(0, len(ended) - self._max_ended)])
        return [job for job in jobs if job.id not in forgotten]

    def recall(self, jobs: Sequence[JobMemory], made: int, root: Directory) -> list[Job]:
        """Restore the jobs of an earlier server; return those that had not ended.

        These are incomplete now, and none runs by itself. Changes are noted, and the
        oldest beyond the limits forgotten. `made`: jobs ever made, from which ids
        continue.
        """
        self._count = max(self._count, made, *(number_of(memory.id) for memory in jobs))
        left = []
        for memory in jobs:
            job = self._all[memory.id] = recalled(memory, root, self._today())
            if memory.phase not in ENDED_PHASES:
                left.append(job)
            if job.memory() != memory:
                self._changed.add(job.id)
        self._forget_old()
        return left

    def ended(self, job: str | None, min_age: timedelta) -> list[Job]:
        """Select the ended jobs to be forgotten: one, or all that ended `min_age` ago.

        Raises UnknownNameError: no such job; RpcError: -32003, it has not ended.
        """
        if job is None:
            return self._ended_for(min_age)
        found = self.get(job)
        if found.phase not in ENDED_PHASES or found is self.current:
            raise self._phase_error("forget", found, ENDED_PHASES)
        return [found]

    def forget(self, jobs: Iterable[Job]) -> None:
        """Remove these jobs from the list; their data sets stay."""
        for job in jobs:
            if self._all.get(job.id) is job:
                del self._all[job.id]
                self._changed.add(job.id)

    def _forget_old(self, but: str | None = None) -> None:
        """Forget the oldest ended jobs beyond `max_ended`, and those that ended over
        `max_age` ago.

        The current job stays in the list, and the job `but`.
        """
        ended = [
            j
            for j in self._all.values()
            if j.phase in ENDED_PHASES and j is not self.current and j.id != but
        ]
        self.forget(ended[: max(0, len(ended) - self._max_ended)])
        self.forget(j for j in self._ended_for(self._max_age) if j.id != but)

    def _ended_for(self, age: timedelta) -> list[Job]:
        """List the ended jobs, except the current one, that ended at least so long ago.

        A job without an end time counts as old.
        """
        # Ages are compared, not dates: no calendar has the date of a million days ago.
        today = self._today()
        return [
            job
            for job in self._all.values()
            if job.phase in ENDED_PHASES
            and job is not self.current
            and (job.ended is None or today - job.ended >= age)
        ]

    def _tell(self, job: Job) -> None:
        self._changed.add(job.id)
        self._notify(job)

    # Running ------------------------------------------------------------------------------------

    async def work(self) -> None:
        """Run queued jobs one after the other; end only by cancellation.

        Jobs aborted while they waited are skipped. Each job runs at its own speed of the
        clock; afterwards the speed from before is restored, unless somebody changed it
        meanwhile. A job's error ends that job alone.
        """
        while True:
            job = await self._queue.get()
            if job.phase != "queued":
                continue
            self.current = job
            before = self._clock.speed_up
            wanted = before
            if job.speed_up is not None:
                wanted = job.speed_up
            phase: JobPhase = "incomplete"
            try:
                self._clock.set_speed_up(wanted)
                phase = await self._run(job)
            except (
                Exception
            ) as error:  # whatever it is, it is this job's, and the next one runs
                phase = self._store_failure(job, error)
            finally:
                job.phase = phase
                job.ended = self._today()
                self.retry.cancel()
                self.current = None
                # The plan of a long scan is large, and ended jobs are kept for a while.
                job.last = None if job.runner is None else job.runner.progress
                job.runner = job.prepare = None
                if self._clock.speed_up == wanted:
                    self._clock.set_speed_up(before)
                self._forget_old()
                self._tell(job)

    async def _run(self, job: Job) -> JobPhase:
        """Wait for the motors' rest, prepare one job, run it, and finish its data set or
        mark it incomplete. A job aborted while it waits for the rest has no data set.

        A stop from outside that came since its turn pauses it at once. An aborted job
        that has begun switches X-rays off. Errors are stored in the job, and logged
        unless a user caused them. The data set's writer is closed in any case.

        Args:
            job: at its turn.

        Returns:
            The job's last phase: done, aborted or failed.

        Raises:
            CancelledError: the server ends; the data set is marked incomplete first.
        """
        # Stops from before its turn do not concern this job.
        self._interrupted = None
        self._manual = False
        try:
            await self._clock.at_rest(
                self._scanner.rest_time
            )  # of motion from before the job
            if job.phase != "queued":  # aborted while it waited
                return "aborted"
            assert job.prepare is not None
            self._preparing = True
            if job.start is None:
                job.start = self._scanner.final_positions()
            scan = await job.prepare()
            self._require_time(scan.plan.duration_s)
        except Exception as error:
            return self._store_failure(job, error)
        finally:
            self._preparing = False
        job.frames_total = scan.plan.frames
        job.duration_s = scan.plan.duration_s
        try:
            runner = await self._make_runner(job, scan)
            # Looked at again after each await: an abort may have come while a thread worked.
            if job.aborting:
                raise JobAborted(job.aborted_for)
            job.runner = runner
            job.phase = "running"
            job.frames_seen = job.runner.progress.frames_done
            if (stopped := self._stopped()) is not None:
                job.runner.pause(stopped)
            self._tell(job)
            await job.runner.run()
            await asyncio.to_thread(scan.store.finish, duration_s=scan.plan.duration_s)
            # The record goes when the data set is complete: killed in between, the job is found
            # done.
            await asyncio.to_thread(scan.finished)
        except JobAborted as ended:
            if job.runner is not None:
                self._scanner.set_tube(on=False, now=self._clock.now())
            await asyncio.to_thread(self._mark_incomplete, job, scan, str(ended))
            return "aborted"
        except asyncio.CancelledError:
            # The loop is being closed: nothing can be awaited any more.
            self._mark_incomplete(job, scan, "the server was stopped")
            raise
        except Exception as error:
            await asyncio.to_thread(self._mark_incomplete, job, scan, str(error))
            return self._store_failure(job, error)
        finally:
            if job.runner is not None:
                job.runner.recount(scan.store.present)
            scan.store.close()
        return "done"

    async def _make_runner(self, job: Job, scan: JobInputs) -> ScanRunner:
        """Create the runner of a job in a thread, as it sorts the events of a long plan.

        Frames that the data set has count as done.

        Args:
            job: whose progress the runner reports.
            scan: plan, data set and producer of frames.
        """
        # While the thread works, nobody may move what has been checked.
        self._preparing = True
        try:
            return await asyncio.to_thread(
                ScanRunner,
                scan.plan,
                self._scanner,
                self._clock,
                _logged(scan.produce, job.id),
                done=scan.store.present,
                notify=lambda: self._copy_progress(job),
                projectors=self._projectors,
            )
        finally:
            self._preparing = False

    def _stopped(self) -> Exception | None:
        return self._interrupted  # a call: it may change while others run

    def _mark_incomplete(self, job: Job, scan: JobInputs, reason: str) -> None:
        """Mark the data set of a job as incomplete, with the reason and the time reached;
        log a failure.

        Without a runner the time is 0 s. Errors other than TwinError are raised.
        """
        elapsed = 0.0
        if job.runner is not None:
            elapsed = job.runner.progress.tau
        try:
            scan.store.mark_incomplete(reason, duration_s=elapsed)
        except (
            TwinError
        ) as error:  # the disk may be full: the data set says incomplete anyway
            log("data set not marked", logging.ERROR, job=job.id, reason=str(error))

    def _store_failure(self, job: Job, error: Exception) -> JobPhase:
        """Store an error in its job, log it unless a user caused it, and return the phase
        "failed".

        The error is stored in the wire's form."""
        if not is_user_error(error):
            log("job failed", logging.ERROR, error=True, job=job.id)
        job.error = self._error(error)
        return "failed"

    def _error(self, error: Exception) -> dict[str, object]:
        """Convert an error to the wire's form {code, message, data}, paths relative to the
        data directory."""
        e = explain(error, self._root)
        return {"code": e.code, "message": e.message, "data": e.data}

    def _runner(self, job: Job, what: str, phases: tuple[JobPhase, ...]) -> ScanRunner:
        """Return a job's runner; raise RpcError if it has none or its phase is not among
        `phases`.
        """
        if job.runner is None or job.phase not in phases:
            raise self._phase_error(what, job, phases)
        return job.runner

    def _phase_error(self, what: str, job: Job, phases: tuple[JobPhase, ...]) -> RpcError:
        """Make (do not raise) the error -32003: a job's phase does not allow `what`."""
        return busy(
            f"cannot {what} {job.id}: it is {job.phase}",
            {"asked": what, "state": job.phase, "allowed": list(phases)},
        )

    def _copy_progress(self, job: Job) -> None:
        """Copy the runner's phase, frames and error into the job, and publish it if due.

        A change of phase or error is published at once, progress every
        `PUBLISH_INTERVAL_S`. New frames are counted and reset the delay of automatic
        retries. A job that a passing error has paused is scheduled to resume. The phase
        is copied only between running and paused.
        """
        assert job.runner is not None
        p = job.runner.progress
        phase = job.phase
        # Queued and the ended phases are the queue's to set, not the runner's.
        if p.phase in ("running", "paused") and phase in ("running", "paused"):
            job.phase = p.phase
        error = None
        if p.error is not None:
            error = self._error(p.error)
        important = job.phase != phase or error != job.error
        job.error = error
        if p.frames_done > job.frames_seen:
            self.frames_made += p.frames_done - job.frames_seen
            job.frames_seen = p.frames_done
            self.retry.progressed()
        self._schedule_resume()
        now = asyncio.get_running_loop().time()
        if important or now - job.published_at >= PUBLISH_INTERVAL_S:
            job.published_at = now
            self._tell(job)

    def _schedule_resume(self) -> None:
        """Schedule a retry if the current job is paused by an error that may pass, such
        as a full disk or a lost projector, and no user took over.

        A retry that is planned stays as it is.
        """
        job = self.current
        if job is None or job.runner is None or self._manual:
            return
        p = job.runner.progress
        if p.phase == "paused" and p.error is not None and transient(p.error):
            self.retry.schedule(p.error, lambda: self._try_again(job))

    def _try_again(self, job: Job) -> None:
        """Resume a job that is still paused, unless a user has taken over."""
        if job.phase == "paused" and job.runner is not None and not self._manual:
            job.runner.resume()


def _logged(produce: Produce, job: str) -> Produce:
    """Wrap a producer of frames: log its programming errors, and give log lines the
    frames' trace.

    Args:
        produce: makes and stores a batch of frames.
        job: id of the job.

    Returns:
        A function like `produce`, which raises the same errors.
    """

    async def work(batch: Sequence[Exposure]) -> None:
        """Produce a batch of frames under its trace; log a programming error and raise
        it.

        Errors that users can cause are raised without a log line.
        """
        try:
            with traced(f"{job}.{batch[0].file}"):
                await produce(batch)
        except Exception as error:
            if not is_user_error(error):
                log("frames failed", logging.ERROR, error=True, job=job)
            raise

    return work


def fresh_seed() -> int:
    """Draw a scan's seed."""
    return secrets.randbits(32)
