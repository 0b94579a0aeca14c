"""The twin's clock with a wall clock that the test moves."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest

from flexdt.server.scans.twin_clock import TwinClock
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion.profiles import LATE_S, LATEST_MOTION_S, move
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample


class Wall:
    def __init__(self) -> None:
        self.time = 100.0

    def __call__(self) -> float:
        return self.time


def test_time_flows_at_the_speed_up_and_changes_without_a_jump() -> None:
    async def main() -> None:
        wall = Wall()
        clock = TwinClock(2.0, wall)
        wall.time += 3.0
        assert clock.now() == 6.0
        clock.set_speed_up(10.0)
        assert clock.now() == 6.0
        wall.time += 1.0
        assert clock.now() == 16.0
        with clock.held():
            wall.time += 50.0
            with clock.held():
                wall.time += 50.0
            assert clock.now() == 16.0
        assert clock.now() == 16.0
        wall.time += 0.5
        assert clock.now() == 21.0

    asyncio.run(main())


def test_max_jumps_from_one_awaited_moment_to_the_next_in_order() -> None:
    async def main() -> None:
        clock = TwinClock("max")
        seen: list[tuple[str, float]] = []

        async def walker(name: str, moments: list[float]) -> None:
            for moment in moments:
                await clock.sleep_until(moment)
                seen.append((name, clock.now()))

        await asyncio.gather(
            walker("a", [10.0, 30.0, 1e6]), walker("b", [20.0, 25.0, 40.0])
        )
        assert seen == [
            ("a", 10.0), ("b", 20.0), ("b", 25.0), ("a", 30.0), ("b", 40.0), ("a", 1e6),
        ]  # fmt: skip

    asyncio.run(main())


def test_max_stands_still_while_held_or_nobody_waits() -> None:
    async def main() -> None:
        clock = TwinClock("max")
        await asyncio.sleep(0.01)
        assert clock.now() == 0.0
        with clock.held():
            waiting = clock.at(5.0)
            for _ in range(10):
                await asyncio.sleep(0)
            assert not waiting.done()
        await waiting
        assert clock.now() == 5.0

    asyncio.run(main())


def test_sleeping_in_real_time_reaches_the_moment_and_a_faster_clock_wakes_earlier() -> (
    None
):
    async def main() -> None:
        clock = TwinClock(1.0)
        await clock.sleep_until(0.02)
        assert clock.now() >= 0.02
        long = asyncio.create_task(clock.sleep_until(3000.0))
        await asyncio.sleep(0)
        clock.set_speed_up("max")
        await asyncio.wait_for(long, 60.0)
        assert clock.now() == 3000.0
        early = clock.at(1e9)
        early.cancel()
        await clock.sleep_until(4000.0)
        assert clock.now() == 4000.0

    asyncio.run(main())


def test_the_real_time_factor_is_what_was_reached_and_not_what_was_asked() -> None:
    async def main() -> None:
        wall = Wall()
        clock = TwinClock(4.0, wall)
        assert clock.real_time_factor is None
        wall.time += 1.0
        with clock.held():
            wall.time += 1.0
        assert clock.real_time_factor == pytest.approx(2.0)
        for _ in range(100):
            wall.time += 0.3
            clock.now()
        assert clock.real_time_factor == pytest.approx(4.0)

    asyncio.run(main())


@pytest.mark.parametrize("bad", [0, -1.0, float("nan"), float("inf"), "fast", True])
def test_speed_up_is_checked(bad: object) -> None:
    with pytest.raises(LimitError, match="speed-up"):
        TwinClock(bad)  # type: ignore[arg-type]


def test_a_clock_that_is_late_runs_in_real_time_and_motion_on_it_is_swept() -> None:
    """At a million times real time it is a thousand real seconds to where steps get coarse."""
    wall = [0.0]
    clock = TwinClock(1e6, wall=lambda: wall[0])
    wall[0] = 1000.0
    assert clock.now() == LATE_S
    wall[0] = 1010.0
    assert clock.now() == LATE_S + 10.0
    clock.set_speed_up(0.5)
    wall[0] = 1020.0
    assert clock.now() == LATE_S + 15.0
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    guard = SceneGuard(build_scene(machine, profile))
    scanner = ScannerTwin(machine, profile, LATE_S, guard)
    rng = np.random.default_rng(1)
    now = LATE_S
    for _ in range(40):
        scanner.move(
            {"rot_obj": rng.uniform(-400, 400), "mag_obj": rng.uniform(300, 700)}, now
        )
        now += rng.uniform(0.0, 9.0)
        scanner.stop(now)
    assert scanner.rest_time(now) >= now


def test_a_clock_at_full_speed_jumps_no_farther_than_its_end() -> None:
    """Issue 80: moves of 1e9 s each were accepted one after the other, to 4.2e11 s; from 1e14
    s on positions jumped."""

    async def main() -> None:
        wall = [0.0]
        clock = TwinClock("max", wall=lambda: wall[0])
        await clock.sleep_until(LATE_S - 5.0)
        assert clock.now() == LATE_S - 5.0
        late = clock.at(LATE_S + 3.0)
        for _ in range(20):
            await asyncio.sleep(0.0)
        assert (clock.now(), late.done()) == (LATE_S, False)
        wall[0] = 2.0
        assert clock.now() == LATE_S + 2.0
        with clock.held():
            wall[0] = 5.0
            assert clock.now() == LATE_S + 2.0
        wall[0] = 6.0
        await asyncio.wait_for(clock.sleep_until(LATE_S + 3.0), 60.0)
        assert clock.now() == LATE_S + 3.0
        clock.set_speed_up(1e6)
        wall[0] = 7.0
        assert clock.now() == LATE_S + 4.0

    asyncio.run(main())


def test_motion_that_would_end_after_the_clock_is_refused_by_every_command() -> None:
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    for now in (0.9 * LATE_S, LATE_S, 3.0 * LATE_S):
        s = ScannerTwin(machine, profile, now)
        for setting in ("speed", "acceleration"):
            s.set_axis("mag_obj", **{setting: 1e-6})
        here = s.positions(now)
        far = {"mag_obj": 900.0}
        programme = {"mag_obj": [move(here["mag_obj"], 0.0, 5000.0, 1e-6, 1e-6, 0.0)]}
        start = s.prepared(programme, now, here).certified()
        for command in (
            lambda s=s, now=now, far=far: s.move(far, now),
            lambda s=s, now=now: s.jog("mag_obj", 1e-6, 1e12, now),
            lambda s=s, now=now, far=far: s.stage_change(
                Sample(), None, None, now, targets=far
            ),
            lambda s=s, now=now, start=start: s.follow(start, now),
        ):
            with pytest.raises(LimitError, match="of the twin's clock"):
                command()
        assert s.rest_time(now) == now
        s.set_axis("mag_obj", speed=1.0, acceleration=1.0)
        assert max(s.move(far, now).values()) < LATEST_MOTION_S
