"""Runs a scan plan on the twin's clock: motion, settings and frames, with pause, step and
abort.

The plan says everything: the runner waits for each moment, applies what the command sets, and
puts each frame into the pipeline, which computes and stores it. Positions, times and noise of a
frame come from the plan and not from when the runner got there, so the bytes are the same at
any speed-up and with any pauses. The clock is held while the pipeline is full.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal, assert_never

from flexdt.protocol.rpc_errors import Code, RpcError
from flexdt.server.scans.frame_pipeline import FramePipeline
from flexdt.server.scans.rejoin_plan import rejoin
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.twin.errors import GeometryError, LimitError, TwinError
from flexdt.twin.machine.camera import CameraSettings
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import TubeSettings
from flexdt.twin.script import Exposure, PlanStep, ScanPlan
from flexdt.twin.script import commands as c

MAX_BATCH_FRAMES = 4
WORKERS_PER_PROJECTOR = 2
MAX_SWEEPS = 3
"""Sweeps of the rest of a plan before a run gives up because others move the scanner."""
WAITING_FRAMES_PER_PROJECTOR = 16
Produce = Callable[[Sequence[Exposure]], Awaitable[None]]
Phase = Literal["running", "paused", "done"]


# Effects of a script's commands on the scanner, one case for each type that sets something.
#
# Moves and images are the plan's business and have no effect here.


def apply_command(scanner: ScannerTwin, command: c.Command, now: float) -> None:
    """Set tube, camera or an axis's rates as `command` has them; other commands, such as
    motion and images, do nothing.

    X-rays come on without the warm-up after a long rest. Rates are limited to those that
    the axis allows now. Rates of axes that the machine does not have are skipped.

    Args:
        scanner: to set.
        command: of the plan, which has checked that it may.
        now: the twin's time [s].

    Raises:
        SafetyError: X-rays on during an E-stop.
    """
    match command:
        case c.XrayOn():
            scanner.set_tube(on=True, now=now, warm=True)
        case c.XrayOff():
            scanner.set_tube(on=False, now=now)
        case c.TubeSetting():
            scanner.set_tube(**command.arguments)
        case c.CameraSetting():
            scanner.set_camera(**command.arguments)
        case c.MotorCommand(component=axis) if not scanner.machine.has(axis):
            pass  # a component of another package
        case c.SetSpeed(component=axis, speed=speed):
            scanner.set_axis(axis, speed=_allowed(scanner, axis, speed, "max_speed"))
        case c.SetAcceleration(component=axis, acceleration=rate):
            scanner.set_axis(
                axis, acceleration=_allowed(scanner, axis, rate, "max_acceleration")
            )


def _allowed(scanner: ScannerTwin, axis: str, value: float, limit: str) -> float:
    """Limit a rate as the plan did (it has warned, or refused the script)."""
    moves = scanner.machine.moves(axis)
    limits = [getattr(scanner.machine.axes[m], limit) / abs(f) for m, f in moves.items()]
    return min([value, *map(float, limits)])


def hopeless(error: Exception) -> bool:
    """Return whether a repetition would fail as well, by a limit of the computation."""
    if isinstance(error, RpcError):  # a sample that no projector can hold
        return error.code == Code.TOO_LARGE
    return isinstance(error, (LimitError, GeometryError)) or type(error) is TwinError


class JobAborted(Exception):
    """A user ended the job, for the reason given."""

    def __init__(self, reason: str | None = None) -> None:
        super().__init__(f"aborted: {reason}" if reason else "aborted")


@dataclass(frozen=True)
class Progress:
    """State of a run; `tau` is the plan's clock [s]."""

    phase: Phase = "running"
    tau: float = 0.0
    frames_done: int = 0
    step: PlanStep | None = None
    what: str = ""
    error: Exception | None = None


@dataclass(eq=False, repr=False)
class ScanRunner:
    """One run of one plan.

    Attributes:
        plan: the checked plan to run.
        scanner: moved and set by the plan.
        clock: the twin's.
        produce: computes and stores a batch of frames.
        done: names of frames that exist already; they are not made again.
        notify: called whenever `progress` has changed.
        projectors: that make frames at the same time.
    """

    plan: ScanPlan
    scanner: ScannerTwin
    clock: TwinClock
    produce: Produce
    done: Collection[str] = ()
    notify: Callable[[], None] = lambda: None
    projectors: int = 1

    def __post_init__(self) -> None:
        """Prepare the run: events of the frames not in `done`, progress from those that are."""
        plan = self.plan
        done = frozenset(self.done)
        self._frames = [e for e in plan.exposures if e.file is not None]
        self._numbers = {e.index: number for number, e in enumerate(self._frames)}
        self._events = _events(
            plan.steps, [e for e in self._frames if e.file not in done]
        )
        self._quick = {e.step for e in self._frames}
        counted = [e for e in self._frames if e.kind == "projection" and e.file in done]
        self.progress = Progress(frames_done=len(counted))
        self.origin = 0.0
        """Twin time of the plan's zero [s]; a pause moves it."""
        self._pause = self._abort = False
        self._stop_due = False
        """True from the request of a pause until the run obeys, even if it was resumed
        since."""
        self._end: Exception = JobAborted()
        """Exception raised when the run must end."""
        self._single_step = False
        self._steps = 0
        """Number of requested steps."""
        self._saved_settings: _Settings | None = None
        self._started_motors = False
        """True if the run has started motors since the last resume."""
        self._signal = asyncio.Event()
        self._waiting: asyncio.Future[None] | None = None
        self._pipeline: FramePipeline[Exposure] = FramePipeline(
            self._make,
            self._not_made,
            kind=lambda e: (e.camera, e.xrays_on),
            batch=MAX_BATCH_FRAMES,
            workers=WORKERS_PER_PROJECTOR * self.projectors,
            room=WAITING_FRAMES_PER_PROJECTOR * self.projectors,
        )

    # Control ------------------------------------------------------------------------------------

    def pause(self, error: Exception | None = None) -> None:
        """Request a pause: the run stops motion at its next wait, and waits for `resume`,
        `step` or `abort`.

        The settings in force are saved, to be restored then; a second pause keeps those
        saved first. A single step is given up.

        `error`: reason, shown in `progress` at once; None if a user requested it.
        """
        if error is not None:
            self._set_progress(error=error)
        if self._saved_settings is None:
            self._saved_settings = _Settings.of(self.scanner)
        # The run stops before any further command: the motors may be at rest by now.
        self._pause = True
        self._stop_due = True
        self._single_step = False
        self._wake()

    def resume(self) -> None:
        """Return to the pose of the pause and continue; later errors count as new."""
        self._pause = self._single_step = False
        self._set_progress(error=None)
        self._wake()

    def step(self) -> None:
        """Request one frame or lasting command, then a pause.

        Requests before the run obeys are one.
        """
        self._pause = False
        self._single_step = True
        self._steps += 1
        self._set_progress(error=None)
        self._wake()

    def abort(self, reason: str | None = None) -> None:
        """Request the end of the run: it raises `JobAborted` at its next wait."""
        if reason is not None:
            self._end = JobAborted(reason)
        self._abort = True
        self._set_progress(error=None)
        self._wake()

    @property
    def paused(self) -> bool:
        """True from the request of a pause until the resume."""
        return self._pause

    @property
    def stepping(self) -> bool:
        """Whether a step goes on."""
        return self._single_step

    @property
    def idle(self) -> bool:
        """True if no frame is made."""
        return self._pipeline.idle

    # Running ------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Run the plan on the clock: settings, motion and frames, with pauses, steps and
        retries.

        It begins at the first frame that is missing, after all settings from before it,
        and frames that exist are skipped. A frame that a pause falls into is exposed
        again. After a single step it pauses. Motors are stopped if the run ends by an
        error.

        Raises:
            JobAborted: it was ended before the end.
            TwinError: a frame cannot be made, at any attempt.
        """
        self._pipeline.open()
        try:
            first = self._first_moment()
            await self._begin()
            for moment, event in self._events:
                if isinstance(event, PlanStep) and moment < first:
                    await self._apply_step(event)
            await self._rejoin_or_pause(first)
            for moment, event in self._events:
                match event:
                    case PlanStep() if moment < first:
                        continue
                    case PlanStep():
                        await self._wait_until(moment)
                        await self._apply_step(event)
                        length = 0.0
                        if event.index not in self._quick:
                            length = event.holds_s
                    case Exposure():
                        await self._wait_until(moment)
                        # A frame that a pause falls into is discarded: the run goes back before
                        # it and exposes it completely, at the speed of the scan.
                        await self._wait_until(
                            moment + event.duration_s, exposing_since=moment
                        )
                        steps = self._steps
                        await self._put(event)
                        # A step requested while the frame waited for room is for the next
                        # frame.
                        length = 0.0
                        if steps == self._steps:
                            length = event.duration_s
                    case _:
                        assert_never(event)
                if self._single_step and length > 0.0:
                    await self._wait_until(moment + length)
                    self.pause()
            await self._wait_until(self.plan.duration_s)
            # The last frames are still being made when the plan's time is over.
            await self._drain()
            self._set_progress(phase="done", tau=self.plan.duration_s, what="")
        except Exception:
            self.scanner.stop(self.clock.now())
            raise
        finally:
            await self._pipeline.close()

    def _first_moment(self) -> float:
        """Return the plan time at which to begin [s]: 0 without existing frames, else the
        start of the first missing frame.

        With no frame missing it is the plan's end.
        """
        if not self.done:
            return 0.0
        frames = [moment for moment, event in self._events if isinstance(event, Exposure)]
        if frames:
            return frames[0]
        return self.plan.duration_s

    def _not_made(self, error: Exception) -> None:
        """Pause after a failed batch, or end the run if it is hopeless."""
        if hopeless(error):
            self._end = error
            self.abort()
        else:
            self.pause(error)

    async def _make(self, batch: Sequence[Exposure]) -> None:
        """Produce a batch of frames, then count its projections as done."""
        await self.produce(batch)
        made = sum(e.kind == "projection" for e in batch)
        self._set_progress(frames_done=self.progress.frames_done + made)

    def moment_of(self, frame: Exposure) -> float:
        """Return the twin time of a frame's pose [s], now at the latest.

        After a pause it is that of the plan as it goes on, for frames from before the pause, too.
        """
        return min(self.origin + frame.start_s, self.clock.now())

    def number_of(self, frame: Exposure) -> int:
        """Return a saved frame's number among all images of the data set."""
        return self._numbers[frame.index]

    def recount(self, present: Collection[str]) -> None:
        """Set the number of finished projections to those in the data set."""
        stored = [e for e in self._frames if e.kind == "projection" and e.file in present]
        self._set_progress(frames_done=len(stored))

    async def _apply_step(self, step: PlanStep) -> None:
        """Apply a command of the plan and show it in `progress`; after a TwinError pause,
        and try again on resume.

        Raises:
            JobAborted: the run was ended while it was paused.
        """
        self._set_progress(step=step, what=step.what)
        while True:
            try:
                apply_command(self.scanner, step.command, self.clock.now())
            except (
                TwinError
            ) as error:  # an E-stop refuses X-rays on: wait for reset and resume
                self.pause(error)
                await self._obey_requests(self.progress.tau)
            else:
                return

    async def _wait_until(
        self, moment: float, exposing_since: float | None = None
    ) -> None:
        """Wait until plan time `moment`, obeying pause and abort; set the progress to it.

        It returns at once if that has passed, but obeys requests first.

        Args:
            moment: on the plan's clock [s].
            exposing_since: plan time [s] to which a run that is paused meanwhile goes
                back; None: it goes on from where it was.

        Raises:
            Exception: the run is to end (`JobAborted`).
        """
        while True:
            if self._has_request():
                reached = max(
                    self.progress.tau, min(self.clock.now() - self.origin, moment)
                )
                await self._obey_requests(
                    reached if exposing_since is None else exposing_since
                )
                continue
            until = self.origin + moment
            if self.clock.now() >= until:
                break
            await self._sleep(until)
        self._set_progress(tau=moment)

    async def _sleep(self, until: float) -> None:
        """Wait until the twin's clock has reached `until` [s], or a request wakes the run."""
        self._waiting = self.clock.at(until)
        await self._waiting
        self._waiting = None

    def _wake(self) -> None:
        """Wake the run, wherever it waits, to look at its requests."""
        # It waits for a request or for the clock, and only one of the two is there.
        self._signal.set()
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(None)

    async def _obey_requests(self, tau: float) -> None:
        """Obey waiting requests: raise if the run is to end, else stop, wait for
        `resume`, and rejoin the plan.

        Without a request it returns at once. After `resume` the settings of before the
        pause are restored and failed frames are tried again. A TwinError on the way back
        pauses again.

        Args:
            tau: plan time at which the run goes on [s].

        Raises:
            Exception: the run is to end (`JobAborted`).
        """
        if self._abort:
            raise self._end
        if not self._has_request():
            return
        self._stop()
        while True:
            await self._wait_for_request(tau)
            self._started_motors = False
            try:
                if self._saved_settings is not None:
                    self._saved_settings.restore(self.scanner)
                await self._rejoin(tau)
            except TwinError as error:
                self.pause(error)
            if not self._has_request():
                self._saved_settings = None
                self._pipeline.retry()
                return
            self._stop()

    def _stop(self) -> None:
        """Stop the run's motion; motion by hand during a run that cannot continue is not
        stopped."""
        if self._started_motors:
            self.scanner.stop(self.clock.now())

    async def _begin(self) -> None:
        """Wait out a pause that was requested before the run began; nothing is set before it may
        go on. Settings saved by that pause are dropped. Raises Exception: the run is to end
        (`JobAborted`)."""
        while self._has_request():
            await self._wait_for_request(0.0)
            self._set_progress(phase="running", error=None)
        self._saved_settings = None

    async def _wait_for_request(self, tau: float) -> None:
        """Show the run as paused and wait for resume, step or abort.

        It returns at once if it is no longer paused.

        `tau`: plan time at which it pauses [s].
        Raises Exception: the run is to end (`JobAborted`).
        """
        self._stop_due = False
        if self._pause:
            self._set_progress(phase="paused", tau=tau)
        while self._pause and not self._abort:
            self._signal.clear()
            await self._signal.wait()
        if self._abort:
            raise self._end

    async def _rejoin_or_pause(self, tau: float) -> None:
        """Move to where the plan is at `tau` [s], then obey requests; a TwinError of the motion
        pauses the run.

        With a request waiting (pause, abort) it does not move before that is obeyed.

        Raises Exception: the run is to end (`JobAborted`).
        """
        if not self._has_request():
            try:
                await self._rejoin(tau)
            except TwinError as error:
                self.pause(error)
        if self._has_request():
            await self._obey_requests(tau)

    async def _rejoin(self, tau: float) -> None:
        """Move to the plan's pose at `tau` and start the swept motion from there; return
        early on a pause or an abort.

        A certificate that a change of stage or motors has outdated is made again, up to
        `MAX_SWEEPS` times; the last one is tried in any case. The plan's zero on the
        twin's clock is set anew.

        Args:
            tau: time on the plan's clock [s].

        Raises:
            CollisionError: on the way there, or in the rest of the plan.
            SafetyError: the last certificate is outdated.
        """
        paces = {axis: pace[1] for axis, pace in self.scanner.paces.items()}
        way = rejoin(self.plan, tau, paces)
        for _ in range(MAX_SWEEPS):
            # The stage may change and motors may be moved while all of it is swept in a thread.
            programme = await asyncio.to_thread(way.programme)
            prepared = self.scanner.prepared(programme, self.clock.now(), way.start)
            certificate = await asyncio.to_thread(prepared.certified)
            if self._has_request():
                return
            now = self.clock.now()
            # Stage or motors have changed since it was swept: sweep again.
            if not self.scanner.holds(certificate):
                continue
            if certificate.contact is not None:
                break
            self._set_progress(phase="running", error=None)
            await self._return_to(way.start)
            if self._has_request():
                return
            now = self.clock.now()
            if self.scanner.may_follow(certificate, now):
                break
        self.scanner.follow(certificate, now)
        self._started_motors = True
        self.origin = now + way.run_up_s - tau
        self._set_progress(tau=tau)

    async def _return_to(self, start: Mapping[str, float]) -> None:
        """Move the motors to where a programme begins and wait for their rest; return early on a
        pause or an abort.

        Nothing moves if they rest there already. The move is shown in `progress`.

        `start`: axis -> position [mm, deg].
        Raises CollisionError: on the way there.
        """
        now = self.clock.now()
        if self.scanner.positions(now) == start and not self.scanner.moving(now):
            return
        self._set_progress(what="returning to the pose of the scan")
        self._started_motors = True
        self.scanner.move(start, now)
        rest = self.scanner.rest_time(now)
        while self.clock.now() < rest and not self._has_request():
            await self._sleep(rest)

    def _has_request(self) -> bool:
        # A call: all three may change while others run.
        return self._pause or self._stop_due or self._abort

    # Frames -------------------------------------------------------------------------------------

    async def _put(self, frame: Exposure) -> None:
        """Hand a frame to the pipeline; while that is full the twin's clock is held, and
        requests are obeyed.
        """
        if not self._pipeline.full:
            await self._pipeline.put(frame)
            return
        await self._await_clock_held(
            self._pipeline.put(frame), frame.start_s + frame.duration_s
        )

    async def _drain(self) -> None:
        """Wait for the last frames with the clock held, obeying requests meanwhile."""
        self._set_progress(what="finishing the last frames")
        while not self._pipeline.idle:
            await self._await_clock_held(self._pipeline.drained(), self.plan.duration_s)

    async def _await_clock_held(self, work: Awaitable[None], moment: float) -> None:
        """Await `work` with the twin's clock held, and obey pause and abort meanwhile.

        While the run is paused the work goes on, with the clock running.

        Args:
            work: that takes real but no twin time; canceled if the run ends.
            moment: plan time at which a paused run goes on [s].

        Raises:
            Exception: of `work`, or the run is to end.
        """
        task = asyncio.ensure_future(work)
        try:
            while not task.done():
                if self._has_request():
                    await self._obey_requests(moment)
                self._signal.clear()
                signal = asyncio.ensure_future(self._signal.wait())
                # Making frames takes no twin time: the run would fall behind its plan.
                with self.clock.held():
                    await asyncio.wait(
                        {task, signal}, return_when=asyncio.FIRST_COMPLETED
                    )
                signal.cancel()
            task.result()
        finally:
            task.cancel()

    def _set_progress(self, **changes: object) -> None:
        """Change fields of `progress`; call `notify` only if a value differs."""
        new = replace(self.progress, **changes)  # type: ignore[arg-type]
        if new != self.progress:
            self.progress = new
            self.notify()


@dataclass(frozen=True)
class _Settings:
    """The settings that an operator may change while a run is paused."""

    tube: TubeSettings
    camera: CameraSettings
    paces: Mapping[str, tuple[float, float]]

    @classmethod
    def of(cls, scanner: ScannerTwin) -> _Settings:
        """Record tube, camera and rates of a scanner."""
        return cls(scanner.tube, scanner.camera, scanner.paces)

    def restore(self, scanner: ScannerTwin) -> None:
        """Restore rates, camera and tube, in that order; those set before an error stay set.

        Raises SafetyError: X-rays were on, and an E-stop is in force.
        """
        for axis, (speed, acceleration) in self.paces.items():
            scanner.set_axis(axis, speed=speed, acceleration=acceleration)
        scanner.camera = self.camera
        scanner.set_tube(kV=self.tube.kV, power_W=self.tube.power_W, on=self.tube.on)


def _events(
    steps: Sequence[PlanStep], frames: Sequence[Exposure]
) -> list[tuple[float, PlanStep | Exposure]]:
    """Sort commands and frames by time; at equal times by their place in the plan, a command
    before its own frames.

    Returns pairs of plan time [s] and command or frame."""
    keyed: list[tuple[tuple[float, int, int], PlanStep | Exposure]] = []
    keyed += [((s.start_s, s.index, 0), s) for s in steps]
    keyed += [((e.start_s, e.step, 1), e) for e in frames]
    return [(key[0], event) for key, event in sorted(keyed, key=lambda k: k[0])]
