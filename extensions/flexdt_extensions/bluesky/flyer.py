"""A flyer for smooth scans: the twin runs a script as a job and writes the data set itself.

`prepare` composes or takes the script and has all of it checked before anything moves;
`kickoff` submits it; `complete` follows the job; each finished TIFF is announced as a stream
datum. The script's images must form one series numbered from 0.

The plans for Bluesky's RunEngine that belong to this scanner touch no device themselves.
"""

from __future__ import annotations

import asyncio
import hashlib
import re
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
from bluesky.protocols import (
    Collectable,
    EventCollectable,
    Flyable,
    Pausable,
    Preparable,
    Reading,
    Stoppable,
    StreamAsset,
    WritesStreamAssets,
)
from bluesky.utils import Msg, MsgGenerator
from event_model import DataKey, Dtype, PartialEvent
from ophyd_async.core import (
    AsyncConfigurable,
    AsyncStageable,
    AsyncStatus,
    Device,
    WatchableAsyncStatus,
    WatcherUpdate,
    soft_signal_r_and_setter,
)

from flexdt.clients import FINAL_STATES, CheckResult, JobStatus, RpcError
from flexdt.twin.errors import TwinError
from flexdt.twin.machine.description import Machine, Profile, builtin_machine, profile_of
from flexdt.twin.script import ScanRequest, compose_script, parse_script, plan_script
from flexdt_extensions.bluesky.camera_device import Announcements, tiff_stream
from flexdt_extensions.bluesky.lab_connection import LabConnection, LimitsExceeded


@dataclass(frozen=True)
class FlyScan:
    """Scan that a flyer is prepared for.

    Attributes:
        script: a request that the script is composed from, or a script's text or bytes.
        name: of the data set; made up if left out.
        speed_up: for this job.
        seed: of the noise.
        motion_samples: moments averaged within an exposure.
    """

    script: ScanRequest | str | bytes
    name: str | None = None
    speed_up: float | None = None
    seed: int | None = None
    motion_samples: int = 1


@dataclass(frozen=True)
class _Prepared:
    scan: FlyScan
    text: bytes
    report: CheckResult
    shape: tuple[int, int]
    template: str
    angles_deg: tuple[float, ...]
    times_s: tuple[float, ...]
    exposure_ms: float


class FrameEvents(Device, EventCollectable):
    """Pose of each image of a fly scan: one event an image, in the order of the images.

    Streams of images have no events of their own, so `fly_scan` collects these in a
    second stream.
    """

    def __init__(self, flyer: TwinFlyer) -> None:
        # A device that is kept as a member would become a child.
        self._flyer: Callable[[], TwinFlyer] = lambda: flyer
        super().__init__()

    async def describe_collect(self) -> dict[str, DataKey]:
        """Describe an event: angle of the stage in mid-exposure [deg], and planned start
        of the exposure [s].
        """
        flyer = self._flyer()
        source = flyer.source("script.check")
        return {
            f"{flyer.name}-{key}": DataKey(
                source=source, shape=[], dtype="number", dtype_numpy="<f8", units=units
            )
            for key, units in (("angle_deg", "deg"), ("time_s", "s"))
        }

    def collect(self) -> Iterator[PartialEvent]:
        """Yield one event for each image completed so far, with its angle [deg] and start
        [s]; stamped with the present time. A further call yields them all again.
        """
        flyer = self._flyer()
        name = flyer.name
        for angle, start in flyer.taken():
            now = time.time()
            data = {f"{name}-angle_deg": angle, f"{name}-time_s": start}
            yield PartialEvent(data=data, timestamps=dict.fromkeys(data, now), time=now)


class TwinFlyer(
    Device,
    AsyncStageable,
    AsyncConfigurable,
    Preparable,
    Flyable,
    Collectable,
    WritesStreamAssets,
    Stoppable,
    Pausable,
):
    """Smooth scans.

    Args:
        link: to the twin.
        name: of the device and of its images in a plan's data.
        machine, profile: for composing and planning scripts; the server's, if they ship.
    """

    def __init__(
        self,
        link: LabConnection,
        name: str = "",
        *,
        machine: Machine | None = None,
        profile: Profile | None = None,
    ) -> None:
        """Make the device without a scan: it is prepared later, no job runs, no frame is
        written; arguments: see the class.
        """
        self._link = link
        self._machine = machine
        self._profile = profile
        self._prepared: _Prepared | None = None
        self._images: Announcements | None = None
        self._written, self._set_written = soft_signal_r_and_setter(int, 0)
        self.job: JobStatus | None = None
        # A pause or stop in the middle of a submission waits for the job that it is for, and a
        # preparation that is replayed after a pause comes after the first.
        self._submitting = asyncio.Lock()
        self.frames = FrameEvents(self)
        super().__init__(name=name)

    # -- verbs ---------------------------------------------------------------------------------

    @AsyncStatus.wrap
    async def stage(self) -> None:
        """Connect to the twin, and forget an earlier scan with its images and job."""
        await self._link.connect()
        self._prepared = None
        self._images = None
        self.job = None

    @AsyncStatus.wrap
    async def unstage(self) -> None:
        """Abort a scan that has not ended."""
        await self.stop()

    @AsyncStatus.wrap
    async def prepare(self, value: FlyScan) -> None:
        """Check a complete scan and keep it for `kickoff`; nothing moves.

        A former job and its images are forgotten. A request is composed to a script for
        the machine.

        Args:
            value: the scan; it is kept for `kickoff`.

        Raises:
            LimitsExceeded: the twin would not run it; lists the lines.
            TwinError: the request cannot be composed, or the images are not one series.
        """
        async with self._submitting:
            await self._link.connect()
            machine, profile = self._scanner()
            script = value.script
            if isinstance(script, ScanRequest):
                script = compose_script(script, machine, profile)
            if isinstance(script, str):
                text = script.encode("utf-8")
            else:
                text = script
            report = await self._link.client.check_script(text)
            if not report.ok:
                raise _script_error(report)
            self._prepared = _plan_scan(value, text, report, machine, profile)
            self._images = None
            self.job = None
            self._set_written(0)

    @AsyncStatus.wrap
    async def kickoff(self) -> None:
        """Submit the prepared scan as a job, and announce the images of its data set;
        return without waiting for the scan.

        Raises:
            RuntimeError: nothing is prepared.
            RpcError: the twin refuses the scan.
        """
        ready = self._ready()
        client = self._link.client
        scan = ready.scan
        async with self._submitting:
            submitted = await client.submit_script(
                ready.text,
                scan.name,
                scan.speed_up,
                seed=scan.seed,
                motion_samples=scan.motion_samples,
            )
            self.job = await client.job_status(submitted.job)
        folder = PurePosixPath(self.job.dataset or submitted.dataset or "/")
        self._images = tiff_stream(
            self.name, folder, ready.template, ready.shape, self._written
        )
        self._set_written(self.job.frames_done)

    @WatchableAsyncStatus.wrap
    async def complete(self) -> AsyncIterator[WatcherUpdate[int]]:
        """Wait for the job's end, and count its written images.

        Yields:
            Progress: frames done and in all, time remaining [s].

        Raises:
            RuntimeError: the scan was not started, or did not end well (its data set is
                then marked incomplete).
        """
        if self.job is None:
            raise RuntimeError(f"{self.name}: kickoff() must be called before complete()")
        start = time.monotonic()
        job = self.job.job
        async for _ in self._link.states():
            self.job = status = await self._link.client.job_status(job)
            self._set_written(status.frames_done)
            yield WatcherUpdate(
                name=self.name,
                current=status.frames_done,
                initial=0,
                target=status.frames_total,
                unit="frames",
                precision=0,
                time_elapsed=time.monotonic() - start,
                time_remaining=status.remaining_s,
            )
            if status.state in FINAL_STATES:
                break
        if self.job.state != "done":
            why = (self.job.error or {}).get("message", "")
            raise RuntimeError(
                f"{self.name}: the scan {self.job.name} ended {self.job.state} {why}"
            )

    async def pause(self) -> None:
        """Pause the job after its current frame; one in the queue as soon as it has
        begun.

        Does nothing if no job runs or it ends meanwhile; raises RpcError if the job
        refuses while it runs.
        """
        async with self._submitting:
            waiting = self._running()
        if not waiting:
            return
        async for _ in self._link.states():
            self.job = await self._link.client.job_status(self._job())
            if self.job.state != "queued":
                break
        if self._running():
            try:
                await self._link.client.pause_job(self._job())
            except RpcError:
                self.job = await self._link.client.job_status(self._job())
                if self._running():
                    raise  # else it has ended meanwhile, and nothing is left to pause

    async def resume(self) -> None:
        """Let it go on."""
        if self._running():
            await self._link.client.resume_job(self._job())

    async def stop(self, success: bool = True) -> None:
        """Abort the scan's job if it has not ended, once a submission under way is done;
        `success` is ignored.
        """
        async with self._submitting:
            if self._running():
                self.job = await self._link.client.job_status(self._job())
                if self._running():
                    self.job = await self._link.client.abort_job(self._job())

    # -- documents -----------------------------------------------------------------------------

    async def describe_collect(self) -> dict[str, DataKey]:
        """Describe the images: 16 bit, (1, rows, cols), in external files. Raises if no
        scan is prepared.
        """
        ready = self._ready()
        return {
            self.name: DataKey(
                source=self.source("script.submit"),
                shape=[1, *ready.shape],
                dtype="array",
                dtype_numpy="<u2",
                external="STREAM:",
            )
        }

    def source(self, method: str) -> str:
        """Return the address of values of a method of the twin."""
        return f"flexdt://{self._link.address}/{method}"

    def taken(self) -> Iterator[tuple[float, float]]:
        """Yield angle [deg] and planned start [s of the scan's clock] of each image
        completed so far; raises if no scan is prepared.
        """
        ready = self._ready()
        if self.job is None:
            done = 0
        else:
            done = self.job.frames_done
        yield from list(zip(ready.angles_deg, ready.times_s, strict=True))[:done]

    async def get_index(self) -> int:
        """Count the complete frames."""
        written: int = await self._written.get_value()
        return written

    async def collect_asset_docs(
        self, index: int | None = None
    ) -> AsyncIterator[StreamAsset]:
        """Yield the documents of the files up to `index` (None: all written); nothing
        before the scan starts.
        """
        if self._images is None:
            return
        if index is None:
            count = await self.get_index()
        else:
            count = index
        async for document in self._images.make_stream_docs(count, 1):
            yield document

    async def describe_configuration(self) -> dict[str, DataKey]:
        """Describe the values of `read_configuration`: data type, shape ([] for a number,
        [n] for a list), and units where they have any.
        """
        source = self.source("script.check")
        keys = dict[str, DataKey]()
        for name, (value, dtype, numpy, units) in self._settings().items():
            shape: list[int | None]
            if isinstance(value, list):
                shape = [len(value)]
            else:
                shape = []
            key = DataKey(dtype=dtype, shape=shape, source=source, dtype_numpy=numpy)
            keys[f"{self.name}-{name}"] = (
                key if units is None else {**key, "units": units}
            )
        return keys

    async def read_configuration(self) -> dict[str, Reading[Any]]:
        """Read the scan's settings, by names with the device's name before: frames,
        exposure, expected duration, angle of each image, script; stamped with the
        present time.
        """
        now = time.time()
        return {
            f"{self.name}-{name}": Reading(value=setting[0], timestamp=now)
            for name, setting in self._settings().items()
        }

    def _settings(self) -> dict[str, tuple[Any, Dtype, str, str | None]]:
        """Return the scan's settings for `read_configuration`: frames, exposure_ms, duration_s,
        angles_deg and script_sha256.

        Returns:
            Name -> value, type, NumPy's type and unit.
        """
        ready = self._ready()
        return {
            "frames": (ready.report.frames, "integer", "<i8", None),
            "exposure_ms": (ready.exposure_ms, "number", "<f8", "ms"),
            "duration_s": (ready.report.duration_s, "number", "<f8", "s"),
            "angles_deg": (list(ready.angles_deg), "array", "<f8", "deg"),
            "script_sha256": (
                hashlib.sha256(ready.text).hexdigest(),
                "string",
                "|S64",
                None,
            ),
        }

    # -- helpers -------------------------------------------------------------------------------

    def _ready(self) -> _Prepared:
        if self._prepared is None:
            raise RuntimeError(f"{self.name}: prepare() must be called first")
        return self._prepared

    def _job(self) -> str:
        assert self.job is not None
        return self.job.job

    def _running(self) -> bool:
        return self.job is not None and self.job.state not in FINAL_STATES

    def _scanner(self) -> tuple[Machine, Profile]:
        """Return machine and profile: those given, else those that the twin names.

        Raises:
            UnknownNameError: the twin's do not ship.
        """
        server = self._link.client.server
        if self._machine is None:
            machine = builtin_machine(server.machine)
        else:
            machine = self._machine
        return machine, self._profile or profile_of(machine, server.profile)


def _plan_scan(
    scan: FlyScan, text: bytes, report: CheckResult, machine: Machine, profile: Profile
) -> _Prepared:
    """Plan a script and check that its projections are one numbered series.

    Other images are not looked at.

    Args:
        scan: of the flyer.
        text: the script.
        report: the twin's check of it.
        machine, profile: to plan it with.

    Returns:
        The scan with shape, file template, angles [deg] and start times [s] of its
        images.

    Raises:
        TwinError: images that are not one series numbered from 0.
    """
    plan = plan_script(parse_script(text), machine, profile)
    images = [e for e in plan.exposures if e.kind == "projection"]
    names = [e.file for e in images]
    if names:
        numbered = re.fullmatch(r"(.*?)(0+)(\.tiff?)", names[0] or "")
    else:
        numbered = None
    if numbered is None:
        raise TwinError(
            f"a fly scan has images numbered from 0; this one has {names[:2]}"
        )
    template = f"{numbered[1]}{{:0{len(numbered[2])}d}}{numbered[3]}"
    wrong = [n for i, n in enumerate(names) if n != template.format(i)]
    if wrong:
        raise TwinError(
            f"a fly scan's images are one series numbered from 0; {wrong[0]} is not",
            {"asked": wrong[0], "allowed": template},
        )
    shape = images[0].camera.shape
    turning = machine.geometry["angle"]
    angles = tuple(
        sum(f * float(e.positions[n]) for n, f in turning.items()) for e in images
    )
    times = tuple(float(e.start_s) for e in images)
    return _Prepared(
        scan, text, report, shape, template, angles, times, images[0].exposure_ms
    )


def _script_error(report: CheckResult) -> LimitsExceeded:
    """Make (not raise) the error on a script with errors: the message has the first five
    and the number of the others; its data all errors and collisions.
    """
    errors = [p for p in report.problems if p.severity == "error"]
    lines = [f"line {p.line}: {p.message}" for p in errors[:5]]
    if len(errors) > 5:
        more = f" (and {len(errors) - 5} more)"
    else:
        more = ""
    return LimitsExceeded(
        "the scan was refused: " + "; ".join(lines) + more,
        {
            "problems": [p.model_dump() for p in errors],
            "collisions": [c.model_dump() for c in report.collisions],
        },
    )


STREAM = "primary"
FRAMES = "frames"
"""Stream of a fly scan's events: pose of each image."""


def fly_scan(
    flyer: TwinFlyer,
    scan: FlyScan,
    *,
    md: Mapping[str, Any] | None = None,
    flush_s: float = 0.5,
) -> MsgGenerator[str]:
    """Run one smooth scan, as a plan of bluesky; its images are announced while it goes
    on.

    The flyer is staged and unstaged. The stream `frames` then has an event for each image
    with the stage's angle, in their order, also where the scan did not end well.

    Args:
        flyer: `lab.scan`.
        scan: to run.
        md: for the start document.
        flush_s: interval between announcements [real s].

    Returns:
        The run's uid.
    """
    start = {"plan_name": "fly_scan", "detectors": [flyer.name], **(md or {})}

    def inner() -> MsgGenerator[None]:
        """Prepare the scan, then carry it out; that part is not replayed after an
        interruption.
        """
        prepared = yield from bps.prepare(flyer, scan, wait=True)
        # A replay would begin the scan again, and number images as those before. Without one,
        # the message that was interrupted is lost: what follows asks again where it may have
        # been.
        yield from bpp.rewindable_wrapper(flight(prepared is not None), False)  # type: ignore[no-untyped-call]

    def flight(live: bool) -> MsgGenerator[None]:
        """Declare the streams, start the scan, wait until it has started, and collect its
        images, with the frame events at the end, also after an error.

        `live` is False in a simulator, which answers nothing.
        """
        for device, name in ((flyer, STREAM), (flyer.frames, FRAMES)):
            declared = None
            while declared is None:
                declared = yield from bps.declare_stream(device, name=name, collect=True)
                if not live:
                    break  # nothing answers a simulator
        started = yield from bps.kickoff(flyer)
        while not (yield from _done(started)):
            pass
        yield from bpp.finalize_wrapper(  # type: ignore[no-untyped-call]
            images(), lambda: bps.collect(flyer.frames, name=FRAMES, return_payload=False)
        )

    def images() -> MsgGenerator[None]:
        """Collect images every `flush_s` until the scan is done, with a checkpoint before
        each time.
        """
        ending = yield from bps.complete(flyer)
        done = False
        while not done:
            yield from bps.checkpoint()  # where a deferred pause begins
            done = yield from _done(ending, flush_s)
            yield from bps.collect(flyer, name=STREAM)

    run = bpp.run_wrapper(inner(), md=start)  # type: ignore[no-untyped-call]
    uid: str = yield from bpp.stage_wrapper(run, [flyer])  # type: ignore[no-untyped-call]
    return uid


def checkpoint_before_close(plan: MsgGenerator[Any]) -> MsgGenerator[Any]:
    """Set a checkpoint before each run's end in a plan, so that a later interruption
    repeats nothing of it.

    It is for `RunEngine.preprocessors`. The RunEngine sets none itself, and would measure
    the last point again.
    """

    def close(message: Msg) -> tuple[MsgGenerator[Any] | None, None]:
        return (both(message) if message.command == "close_run" else None), None

    def both(message: Msg) -> MsgGenerator[Any]:
        yield from bps.checkpoint()
        return (yield message)

    return bpp.plan_mutator(plan, close)  # type: ignore[no-any-return, no-untyped-call]


def _done(status: Any, seconds: float | None = None) -> MsgGenerator[bool]:
    """Wait for a status, at most `seconds` (None: for ever), or until an interruption.

    `bps.wait` cannot be repeated: its status is forgotten when it is interrupted.

    Returns:
        Whether the status is done; True for None, as in a simulator.
    """
    if status is None:
        return True
    yield from bps.wait_for([lambda: asyncio.wait([status.task], timeout=seconds)])
    return bool(status.done)
