"""From a script or poses to a job: check, name, data set, resume.

Everything that can be wrong is said before a job exists: the script's problems, collisions, room on
the disk, a name that is taken. When the job's turn comes it is planned anew from where the scanner
then stands. What a resumed scan must repeat (start, sample, seed) lies in DATA/jobs. It refuses to
run anything itself (see `jobs`).
"""

from __future__ import annotations

import asyncio
import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path

from flexdt.protocol.errors import RpcError, collision, invalid_params, script_invalid
from flexdt.server.acquisition import Acquisition, Shown
from flexdt.server.atomic import free_bytes
from flexdt.server.clock import SpeedUp
from flexdt.server.dataset_writer import RESERVE_BYTES, DatasetWriter, dated_name
from flexdt.server.files import file_stem, put_json
from flexdt.server.imaging import Imaging
from flexdt.server.jobs import Job, Jobs, Scan, fresh_seed
from flexdt.server.stage import Stage
from flexdt.twin.camera import CameraSettings, Roi
from flexdt.twin.collision.report import collision_check
from flexdt.twin.dataset.document import parse_document
from flexdt.twin.dataset.errors import DatasetError, DiskFullError
from flexdt.twin.dataset.names import DOCUMENT, SCRIPT, plain_name
from flexdt.twin.dataset.record import NoiseRecord, SampleRecord, ScanRecord
from flexdt.twin.exposure import DetectorModel
from flexdt.twin.geometry import check_cone_vec
from flexdt.twin.scanner import ScannerTwin
from flexdt.twin.script import Problem, StartState
from flexdt.twin.script.check import CheckReport, check_poses, check_script
from flexdt.twin.state import Offset, Sample

RESERVED = ("corrections", "jobs", "samples")
"""Folders of the data directory that are no data sets."""
SCHEMA = 1

Poses = Sequence[Mapping[str, float]]


@dataclass(frozen=True)
class Wish:
    """What somebody wants scanned: a script's bytes, or poses.

    Attributes:
        script: byte for byte, for a script; for poses a text that lists them.
        poses: for a trajectory.
        exposure_ms: of a trajectory's images.
        moments: poses averaged within the exposure of an image taken in motion.
        seed: of the noise; None for a fresh one.
    """

    script: bytes
    poses: Poses | None = None
    exposure_ms: float | None = None
    moments: int = 1
    seed: int | None = None

    @classmethod
    def of_poses(
        cls,
        poses: Poses,
        exposure_ms: float | None,
        moments: int = 1,
        seed: int | None = None,
    ) -> Wish:
        """A trajectory; its `script.txt` is a comment for each pose."""
        lines = [f"# pose {i}: {json.dumps(dict(p))}" for i, p in enumerate(poses)]
        text = "\r\n".join([f"# trajectory, exposure_ms {exposure_ms}", *lines, ""])
        return cls(text.encode(), poses, exposure_ms, moments, seed)


@dataclass(frozen=True)
class Beginning:
    """What a scan starts from, kept so that it can be resumed."""

    start: StartState
    sample: Sample
    seed: int | None
    moments: int

    def to_json(self) -> dict[str, object]:
        """As a document."""
        camera = asdict(self.start.camera)
        return {
            "schema": SCHEMA,
            "start": {**asdict(self.start), "camera": camera},
            "sample": asdict(self.sample),
            "seed": self.seed,
            "moments": self.moments,
        }

    @classmethod
    def from_json(cls, document: Mapping[str, object]) -> Beginning:
        """The one that `to_json` made; raises KeyError, TypeError or ValueError if it did not."""
        if document["schema"] != SCHEMA:
            raise ValueError(f"schema {document['schema']}")
        start = dict(document["start"])  # type: ignore[call-overload]
        camera = dict(start.pop("camera"))
        roi = Roi(**camera.pop("roi"))
        sample = dict(document["sample"])  # type: ignore[call-overload]
        offset = Offset(**sample.pop("offset"))
        seed, moments = document["seed"], document["moments"]
        if not (seed is None or isinstance(seed, int)) or not isinstance(moments, int):
            raise ValueError("seed and moments must be whole numbers")
        return cls(
            StartState(camera=CameraSettings(roi=roi, **camera), **start),
            Sample(offset=offset, **sample),
            seed,
            moments,
        )


class Submissions:
    """Makes jobs.

    Args:
        scanner, jobs, imaging, stage, model: see their modules.
        root: the data directory.
        now: the date.
        shown: told of images for watchers.
        seed: makes the noise's seed of a new scan; None for scans without noise.
        version: of the software, for data sets.
    """

    def __init__(
        self,
        scanner: ScannerTwin,
        jobs: Jobs,
        imaging: Imaging,
        stage: Stage,
        model: DetectorModel,
        root: Path,
        *,
        now: Callable[[], datetime],
        shown: Shown | None = None,
        seed: Callable[[], int | None] = fresh_seed,
        version: str = "",
    ) -> None:
        self._scanner, self._jobs, self._imaging = scanner, jobs, imaging
        self._stage, self._model, self._root = stage, model, root
        self._now, self._shown, self._seed, self._version = now, shown, seed, version

    async def check(self, wish: Wish) -> CheckReport:
        """The dry-run report from where the scanner stands; nothing moves."""
        return await self._check(wish, self._start(), self._scanner.sample)

    async def submit(
        self, wish: Wish, name: str | None, speed_up: SpeedUp | None, operator: str = ""
    ) -> Job:
        """Put a scan in the queue.

        Raises:
            RpcError: -32005 script invalid, -32002 collisions, -32602 the name is taken.
            LimitError, DiskFullError, DatasetNameError.
        """
        resumed = self._resumable(name, wish) if name is not None else None
        if resumed is not None:
            begin = resumed
        else:
            seed = self._seed() if wish.seed is None else wish.seed
            begin = Beginning(self._start(), self._scanner.sample, seed, wish.moments)
        report = await self._check(wish, begin.start, begin.sample)
        require_sound(report)
        chosen = name if name is not None else self._free_name()
        self._require_room(report, chosen)
        folder = self._root / chosen
        warnings = [str(p) for p in report.warnings]
        if resumed is not None:
            there = len(list(folder.glob("*.tif")))
            warnings.insert(0, f"taking up the data set {chosen}, of which {there} images exist")

        async def prepare() -> Scan:
            start = begin
            if resumed is None:  # others may have moved since
                start = replace(begin, start=self._start())
            final = report
            if start != begin:
                final = await self._check(wish, start.start, start.sample)
                require_sound(final)
            return await asyncio.to_thread(
                self._open, wish, final, start, chosen, resumed is not None, operator
            )

        return self._jobs.submit(chosen, str(folder), report.plan, prepare, speed_up, warnings)

    async def _check(self, wish: Wish, start: StartState, sample: Sample) -> CheckReport:
        def work() -> CheckReport:
            machine, profile = self._scanner.machine, self._scanner.profile
            collisions = collision_check(self._stage.pieces(sample), self._scanner.parameters)
            size = self._stage.size(sample)
            if wish.poses is None:
                return check_script(
                    wish.script, machine, profile, start=start, sample=size, collision=collisions
                )
            return check_poses(
                wish.poses,
                machine,
                profile,
                wish.exposure_ms,
                start=start,
                sample=size,
                collision=collisions,
            )

        return await asyncio.to_thread(work)

    def _start(self) -> StartState:
        """The scanner at rest where its motors are bound."""
        s = self._scanner
        paces = {axis: s.settings(axis) for axis in s.machine.axes}
        return StartState(
            positions=s.final_positions(),
            speeds={axis: pace[0] for axis, pace in paces.items()},
            accelerations={axis: pace[1] for axis, pace in paces.items()},
            camera=s.camera,
            kV=s.tube.kV,
            power_W=s.tube.power_W,
            xrays_on=s.tube.on,
        )

    def _open(
        self,
        wish: Wish,
        report: CheckReport,
        begin: Beginning,
        name: str,
        resume: bool,
        operator: str,
    ) -> Scan:
        """Make (or take up) the data set and all that runs the plan; in a worker thread."""
        plan = report.plan
        noise = NoiseRecord(
            begin.seed, {k: float(v) for k, v in asdict(self._model).items() if k != "reference"}
        )
        size = self._stage.size(begin.sample)
        record = ScanRecord.from_plan(
            plan,
            name=name,
            started=self._now(),
            sample=SampleRecord(
                name=begin.sample.name,
                diameter_mm=0.0 if size is None else size.diameter_mm,
                height_mm=0.0 if size is None else size.height_mm,
            ),
            noise=noise,
            correction=self._scanner.correction,
            operator=operator,
            version=self._version,
        )
        for block in record.blocks:
            pixel = block.camera.pixel_mm(plan.machine.detector.sensor)
            check_cone_vec(record.cone_vec([block]), pixel)
        writer = DatasetWriter(self._root, record, script=wish.script, resume=resume, sync=False)
        put_json(self._root / "jobs", f"{file_stem(name)}.json", begin.to_json())
        acquisition = Acquisition(
            plan,
            self._imaging,
            begin.sample,
            self._model,
            begin.seed,
            writer.put,
            begin.moments,
            self._shown,
        )
        return Scan(plan, writer, acquisition.produce)

    def _resumable(self, name: str, wish: Wish) -> Beginning | None:
        """What an interrupted data set of that name started from; None if there is none.

        Raises:
            DatasetNameError: no plain name.
            RpcError: -32602, the name is taken by something that cannot be resumed.
        """
        plain_name(name, "data set")
        if name in RESERVED:
            raise taken(name, "it is reserved")
        folder = self._root / name
        if self._jobs.uses(str(folder)):
            raise taken(name, "a job is writing it")
        if not folder.exists():
            return None
        try:
            document = parse_document((folder / DOCUMENT).read_text(encoding="utf-8"))
            script = (folder / SCRIPT).read_bytes()
            sidecar = self._root / "jobs" / f"{file_stem(name)}.json"
            begin = Beginning.from_json(json.loads(sidecar.read_text(encoding="utf-8")))
        except (OSError, DatasetError, ValueError, KeyError, TypeError) as error:
            raise taken(name, f"it holds something that cannot be resumed ({error})") from None
        if document.complete:
            raise taken(name, "that data set is complete")
        if script != wish.script:
            raise taken(name, "its script is another one")
        return begin

    def _free_name(self) -> str:
        """As the scanner names its scans: date and number."""
        used = {job.name for job in self._jobs.all()}
        names = (dated_name(self._now(), n) for n in itertools.count(1))
        return next(n for n in names if n not in used and not (self._root / n).exists())

    def _require_room(self, report: CheckReport, name: str) -> None:
        """Refuse a scan that the disk cannot hold."""
        self._root.mkdir(parents=True, exist_ok=True)
        need, free = report.plan.bytes + RESERVE_BYTES, free_bytes(self._root)
        folder = self._root / name
        if folder.is_dir():
            need -= sum(f.stat().st_size for f in folder.glob("*.tif"))
        if 0 < free < need:
            raise DiskFullError(
                f"{name} needs {need} bytes, {free} bytes are free in {self._root}",
                {"asked": need, "allowed": free, "path": str(self._root)},
            )


def require_sound(report: CheckReport) -> None:
    """Raise unless the plan may run.

    Raises:
        RpcError: -32005 with every problem; -32002 where collisions are all that is wrong.
    """
    if report.ok:
        return
    problems: list[Problem] = list(report.problems)
    errors = [p for p in problems if p.severity == "error"]
    other = [p for p in errors if p.code != "collision"]
    if other:
        first = other[0]
        more = f" (and {len(errors) - 1} more)" if len(errors) > 1 else ""
        raise script_invalid(
            f"the script does not hold: line {first.line}: {first.message}{more}",
            [p.to_dict() for p in problems],
        )
    hits = [] if report.clearance is None else list(report.clearance.collisions)
    first_hit = hits[0]
    raise collision(
        f"line {first_hit.line}: {' and '.join(first_hit.pair)} would collide after "
        f"{first_hit.time_s:.3f} s",
        {
            "asked": "a scan",
            "collisions": [x.to_dict() for x in hits],
            "problems": [p.to_dict() for p in problems],
            "allowed": "a path without contact",
        },
    )


def taken(name: str, why: str) -> RpcError:
    """The error for a data set's name that cannot be used."""
    return invalid_params(
        f"the data set name {name!r} cannot be used: {why}",
        [{"path": "name", "message": why, "asked": name}],
        "another name, or the same script for an incomplete data set",
    )
