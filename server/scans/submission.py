"""From a script or poses to a job: check, name, data set, resume.

All errors are reported before a job exists: the script's problems, collisions, room on
the disk, a name that is taken. When the job's turn comes and the scanner, its sample or
its correction have changed since, the scan is planned and checked again. The conditions
that a resumed scan must repeat (start, sample, seed) are in DATA/jobs. `jobs` runs it.
"""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import partial

from flexdt.protocol import Codec
from flexdt.protocol.messages import Encoded
from flexdt.protocol.rpc_errors import RpcError, busy, invalid_params, problem
from flexdt.runtime.files.dataset_folder import dated_name, read_document
from flexdt.runtime.files.directory import Directory
from flexdt.runtime.files.own_documents import Changes
from flexdt.server.imaging.radiography import Radiography
from flexdt.server.scans.acquisition import Acquisition, FrameListener
from flexdt.server.scans.checking import Checked, CheckInput, Checks
from flexdt.server.scans.jobs import Jobs
from flexdt.server.scans.sample_prediction import (
    Prediction,
    forecast_sample,
    predict_counts,
)
from flexdt.server.scans.scan_job import Job, JobInputs, is_complete
from flexdt.server.scans.scan_record import FOLDER, JobRecord, ScanSource, StartConditions
from flexdt.server.scans.stage import Stage
from flexdt.server.scans.twin_clock import SpeedUp
from flexdt.server.storage.dataset_writer import DatasetWriter
from flexdt.server.storage.disk_room import DiskRoom
from flexdt.server.storage.job_files import JobFiles, number_of
from flexdt.server.storage.memory import Memory, StateStore
from flexdt.twin.collision.convex_solids import Polytope
from flexdt.twin.dataset import dataset_errors as ds
from flexdt.twin.dataset.file_names import (
    DOCUMENT,
    SCAN_SETTINGS,
    SCRIPT,
    XRE_SETTINGS,
    plain_name,
)
from flexdt.twin.dataset.flexdt_json import NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.geometry.cone_vec import check_cone_vec
from flexdt.twin.physics.predicted_beam import PredictedExposure
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import ScanPlan, StartState
from flexdt.twin.script.planning.plan_values import SampleSize
from flexdt.twin.script.planning.sample_findings import SampleForecast

RESERVED = ("corrections", FOLDER, "samples")
"""Folders of the data directory that are not data sets."""


@dataclass(frozen=True, eq=False, repr=False)
class CheckedScan:
    """A scan that may run, as it was checked when it was submitted.

    Attributes:
        record: of the scan.
        name: of its data set.
        resume: whether the data set exists and is continued.
        checked: plan and warnings of the check.
        predicted: counts of its projections.
        warnings: for the user.
    """

    record: JobRecord
    name: str
    resume: bool
    checked: Checked
    predicted: Prediction
    warnings: list[str]


@dataclass(eq=False, repr=False)
class QueueEntry:
    """The change of `StateStore.keep` that puts a checked scan into the queue: its three
    steps, in the order in which they are called.

    Attributes:
        submissions: whose queue, files and folder are meant.
        scan: as it was checked.
        ensure_allowed: raises if the requester has lost control.
        continued: ended job that goes on; None for a new one.
        draft: the job; None before `counted`.
    """

    submissions: Submissions
    scan: CheckedScan
    ensure_allowed: Callable[[], None]
    continued: Job | None
    draft: Job | None = None

    def counted(self, memory: Memory) -> Memory:
        """Draft the job, and return the state's document with its number counted."""
        # Here, because no other job is numbered while the store writes this one.
        own = self.submissions
        scan = self.scan
        self.draft = own.jobs.draft(
            scan.name,
            str(own.root.path / scan.name),
            scan.checked.plan,
            partial(own.prepare, scan),
            scan.record.speed_up,
            scan.warnings,
            self.continued,
            scan.record.begin.sample,
        )
        made = max(memory.jobs_made, number_of(self.draft.id))
        return memory.model_copy(update={"jobs_made": made})

    def put(self, changes: Changes) -> None:
        """Add the records of scan and job to the change."""
        assert self.draft is not None
        self.scan.record.keep(changes, self.submissions.root, self.scan.name)
        self.submissions.job_files.put(changes, self.draft.memory())

    def take(self) -> Job:
        """Put the drafted job into the queue and return it.

        Raises RpcError: the requester has lost control, or a job writes the data set of that
        name.
        """
        assert self.draft is not None
        self.ensure_allowed()
        # Another job may have begun with the name while the records were written.
        if self.submissions.jobs.uses(self.draft.folder):
            raise name_conflict(self.scan.name, "a job is writing it")
        return self.submissions.jobs.enqueue(self.draft)


@dataclass(eq=False, repr=False)
class Submissions:
    """Checks scans and makes jobs of them.

    Attributes:
        scanner, jobs, stage: see their modules.
        radiography: how images are made.
        root: the data directory.
        state_store: writes a job down before it is in the queue.
        job_files: where it is written.
        now: the date.
        shown: called with images for watchers.
        seed: makes the noise's seed of a new scan; None for scans without noise.
        version: of the software, for data sets.
        room: on the disk.
        checks: of submitted scans.
    """

    scanner: ScannerTwin
    jobs: Jobs
    radiography: Radiography
    stage: Stage
    root: Directory
    state_store: StateStore
    job_files: JobFiles
    now: Callable[[], datetime]
    shown: FrameListener
    seed: Callable[[], int | None]
    version: str
    room: DiskRoom
    checks: Checks = field(default_factory=Checks)
    _numbered: tuple[str, int] = field(default=("", 1), init=False)
    """Day, and number of the last scan named on it."""

    async def check(self, source: ScanSource, codec: Codec) -> Encoded:
        """Compute the dry-run report of a scan from the scanner's present state, with a
        prediction behind the sample; nothing moves. `source`: script or poses; `codec`: of the
        connection. Returns the encoded report. Raises RpcError: -32008, it takes too long, too
        much memory, or is too large for an answer."""
        sample = self.scanner.sample
        check_input = await self._check_input(source, self.start(), sample)
        seen = await self._sample_seen(check_input, sample)
        return Encoded(tuple(await self.checks.report(check_input, codec, seen)))

    async def _sample_seen(
        self, check_input: CheckInput, sample: Sample
    ) -> SampleForecast | None:
        """Predict the pixels behind `sample` on rays of the checked scan; None for an
        empty stage.
        """
        if not sample.name:
            return None
        probes = await self.checks.probes(check_input)
        return await forecast_sample(self.radiography, sample, probes)

    def close(self) -> None:
        """End the processes."""
        self.checks.close()

    async def submit(
        self,
        source: ScanSource,
        name: str | None,
        speed_up: SpeedUp | None,
        operator: str = "",
        ensure_allowed: Callable[[], None] = lambda: None,
    ) -> Job:
        """Check a scan completely, write its record, and put it in the queue as a job.

        The seed is the request's, else drawn.

        The name of an interrupted data set of the same script resumes that scan with its
        start conditions and seed.

        Args:
            source: script or poses.
            name: of the data set; None chooses a free one, date and number.
            speed_up: of the twin's clock during the job; None keeps the present one.
            operator: for the data set.
            ensure_allowed: raises if the requester has lost control.

        Returns:
            The queued job, with warnings.

        Raises:
            RpcError: -32005, the script is invalid; -32002, collisions; -32602, the name
                is taken; -32003, the sample of the resumed scan has changed; -32008, the
                sample does not fit into memory.
            LimitError: the name is too long.
            DiskFullError: the images do not fit on the disk.
            DatasetNameError: the name is not a plain one.
        """
        resumed = None
        if name is not None:
            resumed = self._resumable(name, source)
        if resumed is not None:
            begin = resumed
        else:
            if source.seed is None:
                seed = self.seed()
            else:
                seed = source.seed
            begin = StartConditions(
                self.start(),
                self.scanner.sample,
                seed,
                source.moments,
                self.radiography.physics,
                self.radiography.scatter,
                self.radiography.rays,
            )
        if name is not None:
            chosen = name
        else:
            chosen = self._free_name()
        job_record = JobRecord(source, begin, speed_up, operator)
        scan = await self._checked(
            job_record, chosen, resumed is not None, ensure_allowed
        )
        return await self._enqueue(scan, ensure_allowed)

    async def again(
        self, job: Job, ensure_allowed: Callable[[], None] = lambda: None
    ) -> Job:
        """Put a job that ended early into the queue again, and return it; only missing
        images are made.

        The scan is read from its record. Where its data set exists, it goes on under the
        conditions that it began with.

        Args:
            job: that has ended.
            ensure_allowed: raises if the requester has lost control.

        Raises:
            UnknownNameError: it has been forgotten meanwhile.
            RpcError: as `submit`; -32602, its record cannot be read or a job writes the
                data set.
        """
        name = job.name
        refused = partial(name_conflict, job.name)
        if self.jobs.uses(job.folder):
            raise refused("a job is writing it")
        try:
            job_record = await asyncio.to_thread(JobRecord.read, self.root, name)
        except (OSError, KeyError, TypeError, ValueError) as error:
            raise refused(
                f"what it started from is not known any more ({error})"
            ) from None
        begun = self.root.stat(name) is not None
        if begun:
            begin = self._resumable(name, job_record.source)
            assert begin is not None
            job_record = replace(job_record, begin=begin)
        scan = await self._checked(job_record, name, begun, ensure_allowed)
        return await self._enqueue(scan, ensure_allowed, job)

    async def _enqueue(
        self,
        scan: CheckedScan,
        ensure_allowed: Callable[[], None],
        continued: Job | None = None,
    ) -> Job:
        """Write the scan's and the job's records as one change, then put the job into the
        queue.

        If the requester has lost control by then, nothing is queued.

        Args:
            scan: as it was checked.
            ensure_allowed: raises if the requester has lost control.
            continued: ended job that goes on; None for a new one.

        Raises:
            DatasetWriteError: the records cannot be written; nothing is queued.
            RpcError: -32602, another job has taken the name; -32003, too many jobs wait,
                or control is lost.
        """
        entry = QueueEntry(self, scan, ensure_allowed, continued)
        return await self.state_store.keep(entry.take, entry.counted, entry.put)

    async def _checked(
        self,
        job_record: JobRecord,
        name: str,
        resume: bool,
        ensure_allowed: Callable[[], None],
    ) -> CheckedScan:
        """Check a scan completely: text, plan, collisions, disk, memory, counts.

        Warnings are those of the check and of the predicted counts. For a resumed scan the first
        ones say how many images exist, and whether another sample is on the stage.

        Args:
            job_record: record of the scan.
            name: of the data set.
            resume: whether the data set exists and is continued.
            ensure_allowed: raises if the requester has lost control.

        Raises RpcError: as `submit`.
        """
        begin = job_record.begin
        checked = await self.checks.runnable(
            await self._check_input(job_record.source, begin.start, begin.sample)
        )
        self._ensure_same(begin)
        await asyncio.to_thread(self._require_room, checked.plan.bytes, name)
        await self.radiography.require_room(begin.sample)
        predicted = await predict_counts(self.radiography, begin, checked.plan)
        warnings = [*checked.warnings, *(p.placed_text for p in predicted.problems)]
        if resume:
            warnings = [*self._warnings_of_resuming(name, begin.sample), *warnings]
        ensure_allowed()
        return CheckedScan(job_record, name, resume, checked, predicted, warnings)

    def _warnings_of_resuming(self, name: str, shown: Sample) -> Iterator[str]:
        """Yield how many images of a data set exist, and whether they show another sample
        than the one on the stage.
        """
        there = sum(n.endswith(".tif") for n in self.root.folder(name).names())
        yield f"taking up the data set {name}, of which {there} images exist"
        stands = self.scanner.sample
        if shown != stands:
            a, b = shown.name or "nothing", stands.name or "nothing"
            yield f"its images go on showing {a}, although {b} is on the stage"

    async def prepare(self, scan: CheckedScan) -> JobInputs:
        """Check the scan again at its turn, open its data set, and return the inputs of
        the job.

        A scan that is not resumed begins from the motors and the sample of now. Counts
        are predicted again only if plan or sample have changed.

        Args:
            scan: as it was checked at its submission.

        Raises:
            RpcError: it may not run any more.
            DatasetWriteError: the data set cannot be opened.
        """
        begun = scan.record
        if not scan.resume:
            # Others may have moved since, and put something else on the stage.
            begin = replace(begun.begin, start=self.start(), sample=self.scanner.sample)
            begun = replace(begun, begin=begin)
            self.jobs.shows(begin.sample)
        # The sample's file and the correction may be others by now; then it is checked
        # again.
        final = await self.checks.runnable(
            await self._check_input(begun.source, begun.begin.start, begun.begin.sample)
        )
        self._ensure_same(begun.begin)
        shows = begun.begin.revision or self.stage.revision(begun.begin.sample)
        begun = replace(begun, begin=replace(begun.begin, revision=shows))
        same = final is scan.checked and begun.begin.sample == scan.record.begin.sample
        counts = scan.predicted
        if not same:
            counts = await predict_counts(self.radiography, begun.begin, final.plan)
        return await asyncio.to_thread(
            self._open_dataset,
            begun,
            final.plan,
            scan.name,
            scan.resume,
            counts.exposures,
        )

    async def _check_input(
        self, source: ScanSource, start: StartState, shown: Sample
    ) -> CheckInput:
        """Collect the input of a scan's check; shapes are computed in a thread.

        Correction, collision pieces of the sample on the stage, and physics are those of
        now.

        Args:
            source: script or poses.
            start: scanner before the scan.
            shown: sample through which the beam passes, of which the size is taken.
        """
        scanner = self.scanner
        parameters = scanner.parameters
        physics = self.radiography.physics
        size, pieces = await asyncio.to_thread(self._shapes, shown, scanner.sample)
        return CheckInput(
            source,
            scanner.machine,
            scanner.profile,
            start,
            size,
            pieces,
            parameters,
            physics,
            self.jobs.clock_left(),
        )

    def _shapes(
        self, shown: Sample, stands: Sample
    ) -> tuple[SampleSize | None, tuple[Polytope, ...]]:
        """Compute the size of the sample that is shown, and the convex pieces of the one
        that stands there; none for a machine without components to collide with."""
        pieces = self.stage.pieces(stands) if self.scanner.machine.components else ()
        return self.stage.size(shown), pieces

    def start(self) -> StartState:
        """Return the start of a plan: motors at rest at their targets, present rates and
        settings.
        """
        s = self.scanner
        return StartState(
            positions=s.final_positions(),
            speeds={axis: pace[0] for axis, pace in s.paces.items()},
            accelerations={axis: pace[1] for axis, pace in s.paces.items()},
            camera=s.camera,
            kV=s.tube.kV,
            power_W=s.tube.power_W,
            xrays_on=s.tube.on,
        )

    def _open_dataset(
        self,
        job_record: JobRecord,
        plan: ScanPlan,
        name: str,
        resume: bool,
        predicted: tuple[PredictedExposure, ...],
    ) -> JobInputs:
        """Write the scan's record, create its data set or go on with it, and make the
        producer of its frames; in a worker thread.

        Physics, scatter, rays and seed are those of the start conditions. The geometry is
        checked before anything is written.

        Args:
            job_record: record of the scan.
            plan: checked at the job's turn.
            name: of the data set.
            resume: whether the data set exists and is continued.
            predicted: exposures for its document.

        Returns:
            Plan, writer, producer of frames, and the function that removes the record at
            the end.

        Raises:
            DatasetWriteError: the folder cannot be written.
            GeometryError: the geometry is not usable.
        """
        begin = job_record.begin
        radiography = replace(
            self.radiography,
            physics=begin.physics,
            scatter=begin.scatter,
            rays=begin.rays,
        )
        noise = NoiseRecord(begin.seed, radiography.record())
        size = self.stage.size(begin.sample)
        record = ScanRecord.from_plan(
            plan,
            name=name,
            started=self.now(),
            sample=SampleRecord(
                name=begin.sample.name,
                diameter_mm=0.0 if size is None else size.diameter_mm,
                height_mm=0.0 if size is None else size.height_mm,
                material=begin.sample.material,
                revision=begin.revision,
                offset=begin.sample.offset,
            ),
            noise=noise,
            correction=self.scanner.correction,
            operator=job_record.operator,
            version=self.version,
            predicted=predicted,
        )
        for block in record.blocks:
            pixel = block.camera.pixels_mm(plan.machine.detector.pixels)
            check_cone_vec(record.cone_vec([block]), pixel)
        # First the conditions of a resume, then the folder: killed in between, nothing is lost.
        job_record.write(self.root, name)
        writer = DatasetWriter(
            self.root, record, script=job_record.source.script, resume=resume
        )
        acquisition = Acquisition(
            plan,
            radiography,
            begin.sample,
            begin.seed,
            writer.put,
            begin.moments,
            self.shown,
            lambda: self._ensure_same(begin),
        )
        finished = partial(JobRecord.remove, self.root, name)
        return JobInputs(plan, writer, acquisition.produce, finished)

    def _ensure_same(self, begin: StartConditions) -> None:
        """Check that the file of a scan's sample is the one with which the scan began.

        Nothing is checked while the scan's revision is not known.

        Raises:
            RpcError: -32003, another file has come under the sample's name.
        """
        now = self.stage.revision(begin.sample)
        name = begin.sample.name
        if begin.revision not in (None, now):
            raise busy(
                f"the sample {name!r} has been uploaded anew since this scan began, and its "
                "images would show two objects; upload the first file again, or begin another scan",
                {"asked": now, "allowed": begin.revision, "sample": name},
            )

    def _resumable(self, name: str, source: ScanSource) -> StartConditions | None:
        """Read the start conditions of the interrupted data set called `name`, after a
        check that the scan may continue it.

        Script and poses must be equal, and for poses the exposure.

        Args:
            name: of the data set.
            source: scan that is to continue it.

        Returns:
            The conditions under which it began; None if there is no such data set.

        Raises:
            DatasetNameError: the name is not a plain one.
            RpcError: -32602, the name is reserved or in use, or its data set is complete,
                damaged or of another script.
        """
        refused = partial(name_conflict, name)
        plain_name(name, "data set")
        if name in RESERVED:
            raise refused("it is reserved")
        folder = self.root.folder(name)
        if self.jobs.uses(str(folder.path)):
            raise refused("a job is writing it")
        if self.root.stat(name) is None:
            return None
        try:
            if not self.root.is_directory(name):
                raise ValueError("it is no folder")
            kept = JobRecord.read(self.root, name)
            with folder.entries() as entries:
                there = {e.name for e in entries if not e.name.startswith(".")}
            # A server killed while it made the folder leaves no document, and no image either.
            complete = False
            if DOCUMENT in there or there - {
                SCRIPT,
                SCAN_SETTINGS,
                XRE_SETTINGS,
            }:
                complete = read_document(folder).complete
        except FileNotFoundError:
            if is_complete(folder):
                raise refused("that data set is complete") from None
            raise refused(
                "there is something that no scan of this twin has begun"
            ) from None
        except (OSError, ds.DatasetError, ValueError, KeyError, TypeError) as error:
            raise refused(
                f"it holds something that cannot be resumed ({error})"
            ) from None
        if complete:
            raise refused("that data set is complete")
        asked, known = (
            (w.script, w.poses, w.exposure_ms if w.poses is not None else None)
            for w in (source, kept.source)
        )
        if asked != known:
            raise refused("its script is another one")
        return kept.begin

    def _free_name(self) -> str:
        """Choose the first name of today (date and number) that no job has and that is
        not in the data directory.

        The next search of the day begins at that number.
        """
        used = {job.name for job in self.jobs.all()}
        now = self.now()
        if self._numbered[0] != dated_name(now, 0):
            self._numbered = dated_name(now, 0), 1
        day, last = self._numbered
        numbers = ((n, dated_name(now, n)) for n in itertools.count(last))
        free = ((n, name) for n, name in numbers if name not in used)
        number, name = next((n, name) for n, name in free if self.root.stat(name) is None)
        self._numbered = (
            day,
            number,
        )  # the next look does not begin with the first of the day
        return name

    def _require_room(self, size: int, name: str) -> None:
        """Check that the images of a scan that are not there yet fit on the disk.

        Image files of the data set that are there count by their present size.

        `size`: of all images [bytes]; `name`: of the data set.
        Raises DiskFullError: they do not fit.
        """
        there = 0
        with suppress(FileNotFoundError), self.root.folder(name).entries() as entries:
            images = (
                e.stat(follow_symlinks=False) for e in entries if e.name.endswith(".tif")
            )
            there = sum(about.st_size for about in images)
        self.room.require(name, size, there)


def name_conflict(name: str, why: str) -> RpcError:
    """Make the error -32602 for a data set's name that cannot be used; returned, not
    raised.

    It has the name, the reason and what is allowed.
    """
    return invalid_params(
        f"the data set name {name!r} cannot be used: {why}",
        [problem("name", why, name)],
        "another name, or the same script for an incomplete data set",
    )
