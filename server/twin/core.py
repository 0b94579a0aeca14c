"""Everything of one twin server but its sockets: built once, owned by one event loop.

`TwinServer` holds the parts and the few operations that concern several of them; handlers
translate to it. Framing is in `server/network`, the process in `main`.
"""

from __future__ import annotations

import asyncio
import logging
import math
import secrets
import time
from collections import deque
from collections.abc import Awaitable, Callable, Collection, Coroutine
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

from flexdt.protocol import state_model as w
from flexdt.protocol.rpc_errors import RpcError, busy
from flexdt.runtime.access import TwinLimits
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import settle
from flexdt.runtime.log import LEVELS, log
from flexdt.runtime.wire_errors import from_root
from flexdt.server.imaging.projections import Imaging, Projector, TrueGeometry
from flexdt.server.imaging.projector_watch import ProjectorWatch
from flexdt.server.imaging.radiography import Radiography, predictors, with_spectra
from flexdt.server.scans.jobs import Jobs, fresh_seed
from flexdt.server.scans.scan_job import Job
from flexdt.server.scans.stage import ObstacleMoves, Shapes, Stage
from flexdt.server.scans.submission import RESERVED, Submissions
from flexdt.server.scans.twin_clock import SpeedUp, TwinClock
from flexdt.server.storage import corrections
from flexdt.server.storage import memory as kept
from flexdt.server.storage.disk_room import DiskRoom
from flexdt.server.storage.job_files import JobFiles, JobMemory, number_of
from flexdt.server.storage.journal import Content, Journal, Record, content_of, resume
from flexdt.server.storage.past_scans import PastScans
from flexdt.server.storage.stored_samples import (
    ReceivedSample,
    SampleStore,
    sample_material,
)
from flexdt.server.twin import state_views
from flexdt.server.twin.hub import Hub
from flexdt.server.twin.live import LiveView, SavedImage, StateFeed
from flexdt.twin.collision.first_contact import NearestPair, clearance
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.dataset.dataset_errors import DatasetWriteError
from flexdt.twin.errors import GeometryError, SafetyError
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.physics.chain import Radiograph
from flexdt.twin.physics.predicted_beam import Physics
from flexdt.twin.physics.scatter import Scatter
from flexdt.twin.rays_a_pixel import Rays
from flexdt.twin.scanner.safety import Guard
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample, ScannerState, TubeSettings
from flexdt.twin.script import Exposure

MAX_KEPT_LOG_ENTRIES = 50
"""Number of entries of the topic `log` that a late subscriber gets."""
FEED_PATIENCE_S = 0.05
"""Longest time for which subscribers do not get a state that is just being written [real s]."""
MAX_FAILURES = 5
"""Number of failures within `FAILURE_WINDOW_S` after which a service is not restarted."""
FAILURE_WINDOW_S = 60.0
"""Time within which a service's failures count [real s]."""
END_PATIENCE_S = 1.0
"""Time after which a service is told again to end [s]."""
SERVICE_PAUSE_S = 0.1


# Who may move: one controller at a time, everyone may watch.
#
# Control belongs to a connection. While nobody holds it, a request that moves takes it; the end of
# the connection gives it back, and so does a long silence once somebody else asks; `force` takes it
# from whoever has it. The caller says which requests move.


class ControlLease:
    """The controller's lease; `holder` is a connection's name or None.

    Args:
        idle_s: silence after which a controller gives way to another client [s].
        clock: real time [s].
    """

    def __init__(
        self, idle_s: float = math.inf, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Begin without a holder; one that is silent for `idle_s` seconds of `clock` may
        lose control.
        """
        self.holder: str | None = None
        self._idle_s = idle_s
        self._clock = clock
        self._heard = clock()

    def heard(self, who: str) -> None:
        """Renew the lease after a request of `who`; nothing if another holds control."""
        if who == self.holder:
            self._heard = self._clock()

    def require(self, who: str, what: str) -> None:
        """Check that `who` may move, or give it control if that is free (unheard for
        `idle_s`).

        Renews the lease. Raises RpcError: -32003, another client is the controller.
        """
        expired = self._clock() - self._heard > self._idle_s
        if self.holder is None or expired:
            self.holder = who
        self.heard(who)
        if self.holder != who:
            raise self._control_error(what)

    def is_observer(self, who: str) -> bool:
        """Return whether another has control."""
        return self.holder not in (None, who)

    def ensure_allowed(self, who: str, what: str) -> None:
        """Check after a wait that `who` may still move: no other client has taken control.
        Raises RpcError: -32003, another client is the controller."""
        if self.is_observer(who):
            raise self._control_error(what)

    def release(self, who: str) -> None:
        """Give control back if `who` holds it."""
        if self.holder == who:
            self.holder = None

    def rename(self, before: str, now: str) -> None:
        """Let control follow a client's new name."""
        if self.holder == before:
            self.holder = now

    def force(self, who: str) -> str | None:
        """Give control to `who` and renew its lease; return the holder who loses it, or None."""
        loser = None
        if self.holder != who:
            loser = self.holder
        self.holder = who
        self.heard(who)
        return loser

    def _control_error(self, what: str) -> RpcError:
        """Make the error -32003 that names the controller and how to take over; returned,
        not raised.
        """
        return busy(
            f"{what}: {self.holder} is the controller; "
            "session.control with action force takes control over",
            {
                "asked": what,
                "controller": self.holder,
                "allowed": "session.control force",
            },
        )


class TwinServer:
    """One twin with all its services.

    Args:
        machine, profile: the scanner.
        projector: a projector server's client.
        root: the data directory.
        truth: hidden misalignment.
        speed_up: of the clock at start.
        seed: makes the noise's seed of each scan; a function that returns None switches
            noise off.
        limits: of jobs, uploads, disk, control.
        physics, scatter, rays: how images are made, see `radiography`.
        projectors: servers behind `projector`.
        wall: real time [s], monotonic; a simulation has its own.
        memory_limit: of the samples in memory [bytes]; None for any.
        projector_room: bytes that a projector can have for a sample; None if not known.
        projector_watch: gives the reason why no image can be computed; None without a
            watch.
    """

    in_service = 0
    """Number of calls that are being worked at."""

    def __init__(
        self,
        machine: Machine,
        profile: Profile,
        projector: Projector,
        root: Directory,
        *,
        truth: TrueGeometry | None = None,
        speed_up: SpeedUp = 1.0,
        seed: Callable[[], int | None] = fresh_seed,
        limits: TwinLimits | None = None,
        physics: Physics = "ideal",
        scatter: Scatter = "off",
        rays: Rays = "auto",
        projectors: int = 1,
        wall: Callable[[], float] = time.monotonic,
        memory_limit: int | None = None,
        projector_room: Callable[[], Awaitable[int | None]] | None = None,
        projector_watch: ProjectorWatch | None = None,
    ) -> None:
        """Build all parts of a server, and restore corrections and state from the folder `root`.

        Files that killed writers left in `root` are deleted, damaged ones set aside.
        Nothing runs and no job is restored before `start`. `wall` gives real seconds,
        `seed` the noise's seed of a scan, `truth` the scanner's true geometry (None: it
        is nominal).
        """
        self.limits = TwinLimits() if limits is None else limits
        self.version = version("flexdt")
        self.instance = secrets.token_hex(8)
        """Random name of this run of the server."""
        machine = with_spectra(machine, physics)
        self.machine = machine
        self.profile = profile
        self.directory = root
        self.root = root.path
        self.clock = TwinClock(speed_up, wall)
        self.scanner = ScannerTwin(
            machine, profile, self.clock.now(), last_stop=secrets.randbits(48)
        )  # numbers of a server before this one release nothing here
        self.hub = Hub(
            self.clock.now,
            {"log": MAX_KEPT_LOG_ENTRIES},
            self.limits.max_subscriptions,
            self.limits.max_views,
        )
        self.control = ControlLease(self.limits.control_idle_s, wall)
        settle(root, RESERVED)
        room = DiskRoom(root, self.limits.disk_quota)
        self.samples = SampleStore(
            root.folder("samples"),
            self.limits.max_upload,
            self.limits.max_samples,
            room,
            memory_limit,
            (
                self.limits.max_observer_samples,
                self.limits.max_observer_bytes,
            ),
        )
        self.samples.standing = lambda: (
            self.scanner.sample.name,
            self.scanner.sample.material,
        )
        self.shapes = Shapes()
        self.past_scans = PastScans(self.root, machine, profile)
        self.predictors = predictors()
        self.remembered = kept.read_memory(root)
        if self.remembered is not None:
            known = self.remembered.corrections
        else:
            known = []
        self.corrections = corrections.Corrections(
            root.folder("corrections"), known, self.limits.max_corrections
        )
        self._apply_last()
        self.stage_turn = asyncio.Lock()
        """Held while the stage is changed, so that changes are made one by one."""
        self.stage = Stage(machine, profile, self.samples)
        self.detours = ObstacleMoves(self.scanner, self.clock, self.stage, self.changed)
        true_geometry = truth or TrueGeometry()
        true_geometry.require_applicable(machine, profile)
        self.imaging = Imaging(
            projector,
            true_geometry,
            self.samples,
            machine.detector.pixels,
            memory_limit,
            self._in_use,
            projector_room,
        )
        self.jobs = Jobs(
            self.scanner,
            self.clock,
            self._job_changed,
            max_waiting=self.limits.max_jobs,
            projectors=projectors,
            root=self.root,
            max_ended=self.limits.max_ended_jobs,
            max_age=timedelta(days=self.limits.ended_job_days),
        )
        self.radiography = Radiography.of(self.imaging, machine, physics, scatter, rays)
        self.live = LiveView(
            self.scanner,
            self.clock,
            self.hub,
            self.radiography,
            lambda: self.jobs.busy,
            self.stage.revision,
        )
        self.journal = Journal(root, self._content, self._at_rest)
        self.journal.noticed = self._noticed_disk
        self.feed = StateFeed(
            self.scanner,
            self.clock,
            self.hub,
            self.state,
            lambda: self.jobs.running,
            lambda: self.journal.durable(FEED_PATIENCE_S),
        )
        self.job_files = JobFiles(root)
        self.job_files.settle()
        self.state_store = kept.StateStore(
            root, self._memory, self.job_files, self.jobs.changed
        )
        self.state_store.noticed = self._noticed_disk
        self._unsaved_was_told = False
        self._unfiled: list[JobMemory] = []
        """Jobs that an earlier server kept in its state and that have no files."""
        self._recalled = False
        self.submissions = Submissions(
            self.scanner,
            self.jobs,
            self.radiography,
            self.stage,
            root,
            self.state_store,
            self.job_files,
            now=lambda: datetime.now(UTC),
            shown=self._scan_image,
            seed=seed,
            version=self.version,
            room=room,
        )
        self.projector_watch = projector_watch
        if projector_watch is not None:
            projector_watch.asks = lambda: self.in_service > 0 or self.hub.wanted("state")
            projector_watch.changed = self.feed.changed
        self.failed = asyncio.Event()
        """Set when a part of the twin has failed for good; the process should end."""
        self._tasks: list[asyncio.Task[None]] = []
        self._awaited: set[asyncio.Future[None]] = set()
        """Awaited ends of motions."""

    async def start(self, sample: Sample | None = None) -> None:
        """Put `sample` on the stage at the motors' present positions, publish it, and
        start the services.

        Files of earlier jobs are removed unless `recall` was called. The services are
        jobs, live view, state feed, state store and, if there is one, the projector's
        watch.

        Contacts at the start are warnings in the log.

        Args:
            sample: None for an empty stage.
        """
        shown = sample or Sample()
        correction = self.scanner.correction
        guard = await self.guard(shown, correction)
        for warning in self.scanner.initialise_stage(
            shown, correction, guard, self.clock.now()
        ):
            self.tell(
                "warning",
                f"at the start {warning}; motion that brings them apart is free",
            )
        if not self._recalled:
            await asyncio.to_thread(self.job_files.clear)
        # Before anybody is served: what an earlier server left is in the journal from now on.
        self.journal.begin(self.state_store.spares.keep)
        self.changed()
        work: list[Callable[[], Coroutine[Any, Any, None]]] = [
            self.jobs.work,
            self.live.run,
            lambda: self.feed.run(self._settled),
            self.journal.run,
            self.state_store.run,
        ]
        if self.projector_watch is not None:
            work.append(self.projector_watch.run)
        self._tasks = [asyncio.create_task(self._run_service(w)) for w in work]

    async def stop(self) -> None:
        """Cancel all services, end the workers, and write the state as that of a server
        that ended.

        A running scan's data set is marked incomplete. Before `start` no state is
        written.
        """
        # One that takes its end for an error of its own is told again.
        while not all(task.done() for task in self._tasks):
            for task in self._tasks:
                task.cancel()
            await asyncio.wait(self._tasks, timeout=END_PATIENCE_S)
        self.submissions.close()
        self.past_scans.close()
        self.predictors.close()
        if self._tasks:
            self.journal.end()
            self.state_store.end()

    def recall(self) -> Sample | None:
        """Restore scanner and jobs of the previous server, before `start`; log a warning
        if it was killed.

        There is a warning, too, if jobs are to be resumed. Jobs, positions and E-stop are
        restored even where no state is stored; after a journal that cannot be read an
        E-stop is in force. A sample that cannot be read gives the empty stage.

        Returns:
            The sample for the stage; None if nothing is stored, or nothing that fits this
            machine.
        """
        memory = self.remembered
        left = self._recall_jobs(memory)
        record = self._recall_motion(memory)
        if memory is None:
            return None
        sample = kept.restore(memory, self.scanner)
        if not memory.ended or left:
            names = [job.id for job in left]
            self.tell(
                "warning",
                "restored what was known when the server ended"
                + ("" if memory.ended else " without having been stopped"),
                saved=memory.saved if record is None else max(memory.saved, record.saved),
                jobs_to_resume=names,
                estop=self.scanner.safety.state == "estopped",
            )
        if sample is None:
            return None
        return self._readable_sample(sample)

    def _recall_motion(self, memory: kept.Memory | None) -> Record | None:
        """Restore positions and E-stop from the newest record: the journal's, or its copy
        in the state, as of a server without a journal.

        Args:
            memory: state of the previous server.

        Returns:
            The record; None without any.
        """
        record = self.journal.last
        if memory is not None:
            copied = kept.copied_record(memory)
            self.journal.follow(copied.version)
            if record is None or record.version < copied.version:
                record = copied
        now = self.clock.now()
        if record is not None:
            resume(record, self.scanner, now)
        if self.journal.damaged:
            self.tell("warning", "an E-stop is in force: a lost journal may have had one")
            self.scanner.estop(now)
        return record

    def _recall_jobs(self, memory: kept.Memory | None) -> list[Job]:
        """Restore the jobs of earlier servers, and write files for those that have none.

        Where files cannot be written, the state keeps those jobs and writing is tried
        again.

        Args:
            memory: state of the previous server, in which older ones kept their jobs.

        Returns:
            The jobs that had not ended.
        """
        self._recalled = True
        jobs = self.job_files.read()
        if memory is None:
            left = self.jobs.recall(jobs, 0, self.directory)
            self.state_store.gather()
            return left
        there = {job.id for job in jobs}
        unfiled = self.jobs.kept_of([job for job in memory.jobs if job.id not in there])
        try:
            for job in unfiled:
                self.job_files.write(job)
        except (
            DatasetWriteError
        ):  # tried again with each change; until then the state has them
            self._unfiled = unfiled
            self.state_store.owe(unfiled)
        known = sorted([*jobs, *unfiled], key=lambda job: number_of(job.id))
        left = self.jobs.recall(known, memory.jobs_made, self.directory)
        self.state_store.gather()
        return left

    def _apply_last(self) -> None:
        """Put the previous server's correction in force at the start.

        The stage is initialized empty and without a guard, also if there is no
        correction.

        One that is lost or does not fit leaves none in force, with a warning in the log.

        Raises:
            GeometryError: machine and profile themselves put axis or panel behind the
                source.
        """
        self.scanner.require_applicable(None)
        last = self.corrections.in_force
        lost = self.corrections.lost
        if lost is not None:
            self.tell(
                "warning", f"the correction in force, {lost!r}, is lost: none is in force"
            )
        try:
            self.scanner.initialise_stage(Sample(), last, None, self.clock.now())
        except GeometryError as error:
            self.corrections.history = self.corrections.after(None)
            self.tell(
                "warning",
                "the correction in force does not fit this machine: none is",
                reason=str(error),
            )

    def _readable_sample(self, sample: Sample) -> Sample:
        """Return the stored sample if its guard can be built, else the empty stage with a
        warning in the log.

        Any error of reading counts. The material of uploaded voxels is dropped first.
        """
        head = self.samples.head(sample.name)
        if head is not None and head.kind == "voxels":
            sample = replace(sample, material=None)
        try:
            self.stage.guard(sample, self.scanner.parameters)
        except Exception as error:  # whatever its file holds: the twin starts
            self.tell(
                "warning",
                f"the sample {sample.name!r}, which stood on the stage, cannot be "
                "read: the stage is empty",
                reason=str(error)[:500],
            )
            return Sample()
        return sample

    async def _run_service(self, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Run a service until it returns; after an exception log it, pause for
        `SERVICE_PAUSE_S`, and run it again.

        After `MAX_FAILURES` failures within `FAILURE_WINDOW_S` it sets `failed`, which
        ends all such loops and the process; the supervisor restarts that. Without the
        service the server would answer without acting.

        Args:
            work: makes the service's coroutine, once for each run.
        """
        ends: deque[float] = deque(maxlen=MAX_FAILURES)
        while not self.failed.is_set():
            try:
                await work()
                return
            except Exception:
                log("a service of the twin failed", logging.CRITICAL, error=True)
                ends.append(asyncio.get_running_loop().time())
                if len(ends) == MAX_FAILURES and ends[-1] - ends[0] < FAILURE_WINDOW_S:
                    self.failed.set()
                await asyncio.sleep(SERVICE_PAUSE_S)

    # Reading ------------------------------------------------------------------------------------

    def state(self) -> w.State:
        """Compute the complete state for the wire; it raises nothing.

        Job, correction, controller, image, unsaved problem and projector problem are None
        where there is none. What is derived from the pose, the sample or files is None,
        too, where it cannot be computed; `missing` then has the reason. So a stop, an
        E-stop and a reset are always answered.
        """
        snapshot = self.scanner.state(self.clock.now())
        job = self.jobs.current
        missing: dict[str, str] = {}
        part = partial(state_views.derived, missing)
        unsaved = self.unsaved()
        watch = self.projector_watch
        return w.State(
            time=snapshot.time,
            axes={
                name: w.AxisState(**vars(axis)) for name, axis in snapshot.axes.items()
            },
            tube=state_views.tube_view(snapshot.tube, snapshot.time),
            camera=state_views.camera_view(snapshot.camera, self.machine),
            sample=part("sample", self.sample_state) or self._placed_sample(),
            geometry=part(
                "geometry", lambda: state_views.geometry_view(snapshot.readout)
            ),
            safety=state_views.safety_view(
                snapshot.safety,
                part("clearance", lambda: self._clearance(snapshot)),
                self.machine.safety_margin_mm,
            ),
            job=None if job is None else part("job", lambda: self.jobs.status(job)),
            correction=part(
                "correction", lambda: self.correction_state(snapshot.correction)
            ),
            clock=state_views.clock_view(self.clock),
            controller=self.control.holder,
            image=part("image", lambda: self.live.seen),
            missing=missing,
            unsaved=unsaved,
            projector=None if watch is None else watch.problem,
        )

    def _clearance(self, snapshot: ScannerState) -> NearestPair | None:
        """Compute the smallest clearance [mm] and its pair at a state's motor positions,
        in the scene of the guard in force.

        Returns:
            The pair; None without a guard, as for a machine without components.
        """
        guard = self.scanner.guard  # its scene is the one in force, and has been made
        motors = {
            name: axis.position
            for name, axis in snapshot.axes.items()
            if not axis.virtual
        }
        if isinstance(guard, SceneGuard):
            return clearance(guard.scene, motors)
        return None

    def sample_state(self) -> w.SampleState:
        """Describe the sample on the stage for the wire; the name is None for an empty
        stage.

        An empty stage has no size, description or revision. The material is that in
        force: voxels have none.
        """
        sample = self.scanner.sample
        placed = self._placed_sample()
        phantom = self.stage.phantom(sample)
        if phantom is None:
            return placed
        return w.SampleState(
            name=sample.name,
            material=sample_material(self.samples.head(sample.name), sample.material),
            offset=placed.offset,
            size_mm=phantom.size_mm,
            description=phantom.description,
            revision=self.samples.revision(sample.name),
        )

    def _placed_sample(self) -> w.SampleState:
        """Describe the sample by its name, material and placement alone, which the
        scanner itself knows.
        """
        sample = self.scanner.sample
        offset = w.SamplePlacement(**asdict(sample.offset))
        return w.SampleState(
            name=sample.name or None, material=sample.material, offset=offset
        )

    def correction_state(self, correction: NamedCorrection | None) -> w.Correction | None:
        """Describe a correction and the data set or file it came from, for the wire; None
        for None.
        """
        source = None
        if correction is not None:
            source = self.corrections.source(correction.name)
        return state_views.correction_view(correction, source)

    # Changing -----------------------------------------------------------------------------------

    def changed(self) -> None:
        """Notify state feed, live view and state store of a change, and let each
        `motion_ended` look again at when motors rest.
        """
        self.feed.changed()
        self.live.changed()
        self.journal.changed(at_once=self._at_rest())
        self.state_store.changed()
        for end in self._awaited:  # a stop brings the end forward: look again
            if not end.done():
                end.set_result(None)

    def _in_use(self) -> list[Sample]:
        return [self.scanner.sample, *self.jobs.samples()]

    def _settled(self) -> None:
        self.live.changed()
        self.journal.changed(at_once=True)

    def _moving(self) -> bool:
        """Return whether any motor is under way now."""
        now = self.clock.now()
        return self.scanner.rest_time(now) > now

    def _at_rest(self) -> bool:
        return not self._moving() and not self.jobs.running

    def _content(self) -> Content:
        """Record what the journal has of the scanner now."""
        return content_of(self.scanner, self.clock.now())

    def unsaved(self) -> str | None:
        """Say why the state is not on the disk, paths relative to the data directory; None
        where it is.
        """
        problem = self.journal.problem or self.state_store.problem
        if problem is None:
            return self.journal.owed()
        return str(from_root(problem, self.root))

    def _memory(self, ended: bool) -> kept.Memory:
        """Record the twin's state for the file that a restarted server reads.

        Jobs that have files are not in it, only those that could not be written and how
        many were ever made.

        Args:
            ended: whether the server ends now.
        """
        history = self.corrections.in_state(self.corrections.history)
        self._unfiled = [
            job for job in self._unfiled if self.state_store.is_unwritten(job.id)
        ]
        return kept.remember(
            self.scanner,
            self.clock.now(),
            self.journal.take(),
            self.jobs.made,
            history,
            unfiled=self._unfiled,
            ended=ended,
        )

    async def guard(
        self,
        sample: Sample,
        correction: NamedCorrection | None,
        upload: ReceivedSample | None = None,
    ) -> Guard | None:
        """Build, in a thread, the guard that finds contacts with a sample and a correction.

        `sample`: on the stage. `correction`: in force; None for none. `upload`: as for
        `Stage.pieces`. Returns the guard; None for a machine without components."""
        parameters = NOMINAL
        if correction is not None:
            parameters = correction.parameters
        return await asyncio.to_thread(self.stage.guard, sample, parameters, upload)

    async def motion_ended(self, motors: Collection[str]) -> None:
        """Wait until `motors` are at rest, at any position, also after stops and further
        moves.

        It returns at once if none of them moves or `motors` is empty. The time is the
        twin's.
        """
        while True:
            now = self.clock.now()
            trajectories = self.scanner.trajectories(now)
            last = max((trajectories[m].end for m in motors), default=now)
            if last <= now:
                return
            end = self.clock.at(last)
            self._awaited.add(end)
            try:
                await end
            finally:
                self._awaited.discard(end)

    def interrupt(self, what: str) -> None:
        """Pause the job that runs or begins, after a stop from outside; `what` names the
        command.
        """
        self.jobs.interrupt(
            SafetyError(f"{what} was commanded; resume goes on", {"asked": what})
        )

    def tell(self, level: w.LogLevel, message: str, **data: object) -> None:
        """Publish a message on the topic `log` and in the server's log."""
        log(message, LEVELS[level], error=False, **data)
        self._publish_log(level, message, data)

    def _noticed_disk(self) -> None:
        """Log for all clients that changes cannot be saved (an error) or that they can be
        saved again (info), once for each, and publish the state.
        """
        problem = self.journal.problem or self.state_store.problem
        told = self._unsaved_was_told
        self._unsaved_was_told = problem is not None
        if problem is not None and not told:
            self.tell(
                "error",
                "the state is not on the disk, and a kill would lose it",
                reason=str(from_root(problem, self.root)),
            )
        if problem is None and told:
            self.tell("info", "the state is on the disk again")
        self.feed.changed()

    def _publish_log(
        self, level: w.LogLevel, message: str, data: dict[str, object]
    ) -> None:
        """Publish a log entry to all subscribers of `log`; it is not in the process's log."""
        entry = w.LogEntry(level=level, message=message, data=data)
        self.hub.publish("log", entry, slot=None)

    def _job_changed(self, job: Job) -> None:
        """Publish a job's status, log a new phase, and notify all watchers of the twin.

        The phases "running" and the one logged last are not logged. A job with an error
        is logged as an error. A status that cannot be computed is left out: a stop that
        pauses the job goes on.
        """
        status = state_views.derived({}, "job", lambda: self.jobs.status(job))
        if status is None:
            self.changed()
            return
        self.hub.publish("job", status, slot=job.id)
        if status.state not in ("running", job.logged):
            data: dict[str, object] = {"job": job.id, "error": status.error}
            level: w.LogLevel = "error" if status.error else "info"
            self._publish_log(level, f"{job.id} is {status.state}", data)
        job.logged = status.state
        self.changed()

    def _scan_image(self, frame: Exposure, radiograph: Radiograph) -> None:
        """Judge the latest image of the running scan, and publish it with its public
        geometry.

        Only a projection is judged, also without subscribers. An image of any kind is
        published if there are subscribers. It has the sample of the running job and the
        frame's positions, camera, tube, moment and file.

        Args:
            frame: of the scan.
            radiograph: its image, without noise.
        """
        wanted = self.hub.wanted("projection")
        if not wanted and frame.kind != "projection":
            return
        job = self.jobs.current
        now = self.live.now()
        if job is None or job.sample is None:
            shown = now.sample
        else:
            shown = job.sample
        runner = saved = None
        if job is not None and job.runner is not None and frame.file is not None:
            runner = job.runner
            folder = Path(job.folder).name
            saved = SavedImage(folder, runner.number_of(frame), frame.file)
        shot = replace(
            now,
            time=now.time if runner is None else runner.moment_of(frame),
            saved=saved,
            sample=shown,
            revision=self.stage.revision(shown),
            positions=tuple(sorted(frame.positions.items())),
            camera=frame.camera,
            tube=TubeSettings(frame.kV, frame.power_W, frame.xrays_on),
        )
        if frame.kind == "projection":
            self.live.judge(radiograph, shot)
        if not wanted:
            return
        poses = self.scanner.poses_at(frame.positions, frame.camera)
        cone = self.scanner.corrected(poses, frame.camera, shot.correction)
        self.live.publish(radiograph, cone, shot)
