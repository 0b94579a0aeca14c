"""The scan runner with a fake projector and sink: the same frames whatever happens on the
way."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Sequence
from functools import partial

import numpy as np
import pytest

from flexdt.server.scans.rejoin_plan import rejoin
from flexdt.server.scans.runner import JobAborted, ScanRunner
from flexdt.server.scans.twin_clock import TwinClock
from flexdt.testing.in_process import SimulatedLoop
from flexdt.twin.errors import CollisionError, LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.physics.exposure import (
    ExposureSettings,
    IdealResponse,
    expose,
    frame_rng,
)
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.script import Exposure, ScanPlan
from flexdt.twin.script.parse import parse_script
from flexdt.twin.script.planning.planner import plan_script
from flexdt.twin.script.planning.pose_plan import plan_poses

M = builtin_machine()
P = builtin_profile(M.default_profile)

# Nine frames, 45 degrees and 2 s apart: 22.5 deg/s; the run-up follows the smooth-scan rule.
FLY = "\r\n".join(
    [
        "tube\tset kV\t90.0\t\tACK\t\t",
        "tube\tset power\t50.0\t\tACK\t\t",
        "camera\tset mode\tHW2SW1High\t\tACK\t\t",
        "camera\tset exposure\t2000.0\t\tACK\t\t",
        "camera\tset number of averages\t1\t\tACK\t\t",
        "camera\tset number of frames\t9\t\tACK\t\t",
        "camera\tset ROI\t900 700 963 731\t\tACK\t\t",
        "mag_obj\tmove absolute\t500.0\t\tACK\t\t",
        "rot_obj\tset speed\t22.5\t\tACK\t\t",
        "rot_obj\tset acceleration\t22.5\t\tACK\t\t",
        "rot_obj\tmove absolute\t-191.25\t\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "camera\ttake image\t\t\tACK\t\t",
        "camera\tsave image\tdi000000.tif\t\tACK\t\t",
        "tube\txrayon\t\t\tACK\t\t",
        "rot_obj\tmove absolute\t551.25\t0.0\tPOS\t\t",
        "camera\ttake and save image sequence\tscan_\t0\tACK\t\t",
        "tube\txrayoff\t\t\tACK\t\t",
        "",
    ]
)


def fly_plan() -> ScanPlan:
    plan = plan_script(parse_script(FLY), M, P)
    assert not plan.errors, plan.errors
    assert plan.frames == 9
    return plan


class Lab:
    """A scanner, a clock and a sink in memory."""

    def __init__(
        self, plan: ScanPlan, speed_up: float | str = "max", **options: object
    ) -> None:
        self.plan = plan
        wall = asyncio.get_running_loop().time
        self.clock = TwinClock(speed_up, wall=wall)  # type: ignore[arg-type]
        self.scanner = ScannerTwin(M, P)
        self.made: dict[str, bytes] = {}
        self.before: Callable[[Sequence[Exposure]], Awaitable[None]] | None = None
        self.seen: list[str] = []
        self.runner = ScanRunner(
            plan, self.scanner, self.clock, self.produce, notify=self.look, **options
        )  # type: ignore[arg-type]

    def look(self) -> None:
        phase = self.runner.progress.phase
        if not self.seen or self.seen[-1] != phase:
            self.seen.append(phase)

    async def produce(self, batch: Sequence[Exposure]) -> None:
        assert len({(e.camera, e.xrays_on) for e in batch}) == 1
        if self.before is not None:
            await self.before(batch)
        for e in batch:
            assert e.file is not None
            assert e.file not in self.made
            thickness = sum(e.positions.values()) % 3.0
            image = np.full((8, 8), thickness, dtype=np.float32)
            tube = ExposureSettings(
                e.kV, e.power_W, e.exposure_ms, e.averages, e.xrays_on
            )
            counts = expose(IdealResponse(), image, tube, frame_rng(4, e.index))
            self.made[e.file] = counts.tobytes()

    def pause_at(self, file: str, error: Exception | None = None) -> None:
        """Pause from where `file` is made, however far the run is ahead of it."""

        async def before(batch: Sequence[Exposure]) -> None:
            if any(e.file == file for e in batch):
                self.runner.pause(error)

        self.before = before

    async def until(self, condition: Callable[[], bool]) -> None:
        until = asyncio.get_running_loop().time() + 60.0
        while not condition():
            assert asyncio.get_running_loop().time() < until, self.runner.progress
            await asyncio.sleep(0.0005)


def run(body: Callable[[], Awaitable[None]]) -> None:
    """Run `body` on virtual time: nobody waits for a scan at the speed of the machine."""
    with asyncio.Runner(loop_factory=partial(SimulatedLoop, random.Random(0))) as runner:
        runner.run(asyncio.wait_for(body(), 3600))


def reference() -> dict[str, bytes]:
    frames: dict[str, bytes] = {}

    async def body() -> None:
        lab = Lab(fly_plan())
        await lab.runner.run()
        frames.update(lab.made)
        assert lab.runner.progress.phase == "done"
        assert lab.runner.progress.frames_done == 9
        assert lab.clock.now() == pytest.approx(lab.plan.duration_s)

    run(body)
    assert sorted(frames) == ["di000000.tif", *(f"scan_{i:06d}.tif" for i in range(9))]
    return frames


def test_the_same_bytes_at_any_speed_up() -> None:
    expected = reference()
    for speed_up in (400.0, 3000.0):

        async def body(speed_up: float = speed_up) -> None:
            lab = Lab(fly_plan(), speed_up)
            await lab.runner.run()
            assert lab.made == expected

        run(body)


def test_motion_follows_the_plan_and_frames_are_where_the_motor_is() -> None:
    async def body() -> None:
        lab = Lab(fly_plan(), 500.0)
        await lab.runner.run()
        origin = lab.runner.origin
        for tau in np.linspace(0.0, lab.plan.duration_s, 3000):
            actual = lab.scanner.positions(
                origin + tau
            )  # the programme is still in force
            for axis, x in lab.plan.positions(tau).items():
                assert actual[axis] == pytest.approx(float(x), abs=1e-9)
        assert origin > 0.0
        # Exposures' positions are the trajectory's, to what the smooth-scan rule rounds to.
        for e in lab.plan.exposures:
            assert lab.plan.positions(e.start_s)["rot_obj"] == pytest.approx(
                e.positions["rot_obj"], abs=0.01
            )

    run(body)


@pytest.mark.parametrize("share", [0.05, 0.5, 0.95])
def test_a_frame_that_a_pause_falls_into_is_exposed_again_at_the_speed_of_the_scan(
    share: float,
) -> None:
    """What the motor did while each frame was exposed is what the plan says, pauses or not."""
    expected = reference()

    async def body() -> None:
        lab = Lab(fly_plan(), 20.0)
        frame = next(e for e in lab.plan.exposures if e.file == "scan_000004.tif")
        exposed: dict[str, list[float]] = {}

        async def before(batch: Sequence[Exposure]) -> None:
            for e in batch:
                ends = lab.runner.origin + e.start_s + e.duration_s
                assert lab.clock.now() >= ends - 1e-6, (
                    "handed on before its exposure has ended"
                )
                times = lab.runner.origin + e.start_s + np.linspace(0.0, e.duration_s, 50)
                exposed[str(e.file)] = [
                    lab.scanner.velocities(t)["rot_obj"] for t in times
                ]

        lab.before = before
        task = asyncio.create_task(lab.runner.run())
        within = frame.start_s + share * frame.duration_s
        await lab.until(lambda: lab.runner.progress.tau >= frame.start_s)
        lab.clock.set_speed_up(
            1.0
        )  # so that the pause comes within the frame on any machine
        await lab.clock.sleep_until(lab.runner.origin + within)
        lab.runner.pause()
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        lab.clock.set_speed_up(20.0)
        assert frame.file not in lab.made
        assert lab.runner.progress.tau == pytest.approx(frame.start_s)
        lab.runner.resume()
        await task
        assert lab.made == expected
        for e in lab.plan.exposures:
            if e.moving and e.file == frame.file:
                assert exposed[str(e.file)] == pytest.approx([22.5] * 50, abs=1e-6)

    run(body)


def test_pausing_moving_by_hand_and_resuming_gives_the_same_bytes() -> None:
    expected = reference()

    async def body() -> None:
        lab = Lab(fly_plan(), 300.0)
        lab.pause_at("scan_000002.tif")
        task = asyncio.create_task(lab.runner.run())
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        await lab.clock.sleep_until(lab.scanner.rest_time(lab.clock.now()))
        assert not lab.scanner.moving(lab.clock.now())
        lab.scanner.move({"tra_obj": 40.0, "rot_obj": 33.0}, lab.clock.now())
        lab.scanner.set_tube(kV=20.0)
        lab.runner.resume()
        await task
        assert lab.made == expected
        assert lab.seen == ["running", "paused", "running", "done"]
        assert lab.scanner.tube.kV == 90.0
        end = lab.clock.now()
        assert lab.scanner.positions(end) == {
            n: float(x) for n, x in lab.plan.positions(lab.plan.duration_s).items()
        }

    run(body)


def test_resume_first_returns_and_then_passes_the_pose_of_the_pause_at_scan_speed() -> (
    None
):
    plan = fly_plan()
    moment = plan.exposures[4].start_s + 0.3
    way = rejoin(plan, moment, {n: a.acceleration for n, a in M.axes.items()})
    scanner = ScannerTwin(M, P)
    scanner.set_axis("rot_obj", speed=90.0)
    scanner.move(way.start, 0.0)
    now = scanner.rest_time(0.0)
    scanner.follow(scanner.prepared(way.programme(), now).certified(), now)
    join = now + way.run_up_s
    assert way.run_up_s == pytest.approx(1.0)  # 22.5 deg/s at 22.5 deg/s2
    for dt in (0.0, 0.5, 3.0, 8.0, 100.0):
        planned = plan.positions(moment + dt)
        for axis, x in scanner.positions(join + dt).items():
            assert x == pytest.approx(float(planned[axis]), abs=1e-9)
    assert scanner.velocities(join)["rot_obj"] == pytest.approx(22.5)
    times = np.linspace(now, join + 20.0, 4000)
    x = np.array([scanner.positions(t)["rot_obj"] for t in times])
    assert np.abs(np.diff(x)).max() <= 22.5 * (times[1] - times[0]) + 1e-9  # no jump


def test_step_runs_one_frame_or_command_at_a_time() -> None:
    expected = reference()

    async def body() -> None:
        lab = Lab(fly_plan())
        lab.runner.pause()
        task = asyncio.create_task(lab.runner.run())
        counts: list[int] = []
        while not task.done():
            stops = lab.seen.count("paused")
            await lab.until(lambda n=stops: lab.seen.count("paused") > n or task.done())
            for _ in range(50):  # what was under way comes out, however late a timer is
                await asyncio.sleep(0)
            counts.append(len(lab.made))
            lab.runner.step()
        await task
        assert lab.made == expected
        assert counts[0] == 0
        assert max(np.diff(counts)) == 1
        assert counts[-1] >= 9

    run(body)


def test_each_step_runs_something_where_the_pause_met_a_frame_that_waited_for_room() -> (
    None
):
    async def body() -> None:
        lab = Lab(plan_poses([{"rot_obj": float(i)} for i in range(60)], M, P, 10.0))
        go = asyncio.Event()
        lab.before = lambda batch: go.wait()
        task = asyncio.create_task(lab.runner.run())
        await lab.until(lambda: lab.clock._hold_count > 0)
        lab.runner.pause()
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        go.set()
        await lab.until(lambda: lab.runner.idle)
        begun = len(lab.made)
        for _ in range(6):
            before = lab.runner.progress.step, len(lab.made)
            stops = lab.seen.count("paused")
            lab.runner.step()
            await lab.until(lambda n=stops: lab.seen.count("paused") > n)
            await lab.until(lambda: lab.runner.idle)
            assert (lab.runner.progress.step, len(lab.made)) != before
            assert len(lab.made) <= before[1] + 1
        assert len(lab.made) > begun
        lab.runner.abort()
        with pytest.raises(JobAborted):
            await task

    run(body)


def test_a_resume_that_is_refused_leaves_what_is_moved_by_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def body() -> None:
        lab = Lab(fly_plan(), 50.0)
        task = asyncio.create_task(lab.runner.run())
        await lab.until(lambda: lab.scanner.moving(lab.clock.now()))
        lab.runner.pause()
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        await lab.until(lambda: not lab.scanner.moving(lab.clock.now()))

        def refused(*_: object) -> None:
            raise CollisionError("something is in the way", {"halts_at": {}})

        monkeypatch.setattr(lab.scanner, "may_follow", lambda *_: True)
        monkeypatch.setattr(lab.scanner, "follow", refused)
        monkeypatch.setattr(lab.runner, "_return_to", lambda start: asyncio.sleep(0))
        lab.scanner.jog("mag_obj", 1.0, 300.0, lab.clock.now())
        end = lab.scanner.rest_time(lab.clock.now())
        lab.runner.resume()
        await lab.until(lambda: lab.runner.progress.error is not None)
        for _ in range(50):
            await asyncio.sleep(0)
        assert lab.runner.progress.phase == "paused"
        assert lab.scanner.rest_time(lab.clock.now()) == end
        lab.runner.abort()
        with pytest.raises(JobAborted):
            await task

    run(body)


def test_a_projector_that_fails_pauses_the_job_and_nothing_is_lost_or_done_twice() -> (
    None
):
    expected = reference()

    async def body() -> None:
        lab = Lab(fly_plan())
        broken = True

        async def before(batch: Sequence[Exposure]) -> None:
            if broken and any(e.file == "scan_000004.tif" for e in batch):
                raise ConnectionError("projector gone")

        lab.before = before
        task = asyncio.create_task(lab.runner.run())
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        assert str(lab.runner.progress.error) == "projector gone"
        lab.runner.resume()
        await lab.until(lambda: lab.runner.progress.error is not None)
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        broken = False
        lab.runner.resume()
        await task
        assert lab.made == expected
        assert lab.runner.progress.error is None

    run(body)


@pytest.mark.parametrize("paused", [False, True])
def test_frames_that_nobody_can_make_end_the_run_and_do_not_pause_it(
    paused: bool,
) -> None:
    async def body() -> None:
        lab = Lab(fly_plan())

        async def before(batch: Sequence[Exposure]) -> None:
            if any(e.file == "scan_000002.tif" for e in batch):
                if paused:
                    lab.runner.pause()
                    await lab.until(lambda: lab.runner.progress.phase == "paused")
                raise LimitError(
                    "no spectrum for 15 kV", {"asked": 15.0, "allowed": [20.0, 240.0]}
                )

        lab.before = before
        with pytest.raises(LimitError, match="no spectrum"):
            await lab.runner.run()
        assert paused or "paused" not in lab.seen
        assert not lab.scanner.moving(lab.scanner.rest_time(lab.clock.now()))

    run(body)


def test_a_slow_projector_holds_the_clock_and_not_the_scan() -> None:
    async def body() -> None:
        plan = plan_poses([{"rot_obj": float(i)} for i in range(60)], M, P, 10.0)
        lab = Lab(plan, 1e5)
        waiting: list[int] = []

        async def before(batch: Sequence[Exposure]) -> None:
            waiting.append(len(batch))
            await asyncio.sleep(0.01)

        lab.before = before
        await lab.runner.run()
        assert len(lab.made) == 62
        assert max(waiting) == 4
        factor = lab.clock.real_time_factor
        assert factor is None or factor < 1e5

    run(body)


def test_abort_stops_motion_and_ends_at_once_in_any_phase() -> None:
    async def body() -> None:
        for phase in ("running", "paused"):
            lab = Lab(fly_plan(), 1.0)
            task = asyncio.create_task(lab.runner.run())
            await asyncio.sleep(0.05)
            if phase == "paused":
                lab.runner.pause()
                await lab.until(lambda lab=lab: lab.runner.progress.phase == "paused")
            lab.runner.abort()
            with pytest.raises(JobAborted):
                await asyncio.wait_for(task, 60)
            assert len(lab.made) == 0

    run(body)


def test_an_estop_pauses_and_the_run_goes_on_only_after_reset_and_resume() -> None:
    expected = reference()

    async def body() -> None:
        lab = Lab(fly_plan(), 20.0)  # the scan must not be over before the pause
        lab.pause_at("scan_000003.tif", RuntimeError("E-stop"))
        task = asyncio.create_task(lab.runner.run())
        await lab.until(lambda: lab.runner.progress.phase == "paused")
        lab.scanner.estop(lab.clock.now())
        lab.runner.resume()
        await lab.until(lambda: "reset is needed" in str(lab.runner.progress.error))
        lab.scanner.reset(lab.clock.now())
        lab.runner.resume()
        await task
        assert lab.made == expected

    run(body)


def test_frames_that_exist_are_not_made_again_and_the_wait_for_them_is_skipped() -> None:
    expected = reference()

    async def body() -> None:
        done = [n for n in expected if n not in ("scan_000006.tif", "scan_000008.tif")]
        lab = Lab(fly_plan(), "max", done=done)
        await lab.runner.run()
        assert set(lab.made) == {"scan_000006.tif", "scan_000008.tif"}
        assert all(lab.made[n] == expected[n] for n in lab.made)
        assert lab.runner.progress.frames_done == 9
        assert lab.scanner.tube.kV == 90.0
        assert lab.scanner.camera.exposure_ms == 2000.0
        lab = Lab(fly_plan(), "max", done=list(expected))
        await lab.runner.run()
        assert lab.made == {}

    run(body)
