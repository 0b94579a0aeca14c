"""Stops of several motors: along the path they are on together, within what each may use."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin.machine.description import builtin_machine
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.braking import PATH_TOLERANCE, braked_along, braked_apart
from flexdt.twin.motion.drives import Drive
from flexdt.twin.motion.profiles import Piece, Trajectory

M = builtin_machine()
MOTORS = ("mag_obj", "mag_det", "rot_obj")
legs = st.lists(
    st.tuples(
        st.floats(-200.0, 200.0),  # target
        st.floats(5.0, 50.0),  # speed
        st.floats(5.0, 100.0),  # acceleration
        st.floats(0.0, 8.0),  # when the next leg begins
        st.booleans(),  # or once this one has ended
    ),
    min_size=1,
    max_size=4,
)


def programme(given: list[tuple[float, float, float, float, bool]]) -> Drive:
    """Legs one after the other, the next begun in flight or after a wait."""
    x, v, time, fastest, ways = 0.0, 0.0, 0.0, 0.0, []
    for target, speed, acceleration, later, waits in given:
        fastest = max(fastest if v else 0.0, acceleration)
        ways.append(motion.move(x, v, target, speed, fastest, time))
        time = (ways[-1].end if waits else time) + later
        x, v = ways[-1].position(time), ways[-1].velocity(time)
    return Drive(50.0, 50.0, tuple(ways))


def distance_to_path(
    drives: Mapping[str, Drive], stop: Mapping[str, Trajectory], now: float
) -> float:
    """How far the stop strays from the path, seen by itself: programme time is found by a
    search.

    For each moment of the stop the pose is compared with the poses that the programme passes,
    first on a grid, then between the neighbours of the nearest.
    """
    end = max(t.end for t in stop.values())
    names = sorted(stop)
    grid = np.linspace(now, end, 4001)
    path = np.array([[drives[n].at(s).position(s) for n in names] for s in grid])
    worst = 0.0
    for t in np.linspace(now, end, 60):
        pose = np.array([stop[n].position(t) for n in names])
        nearest = int(np.argmin(np.abs(path - pose).max(axis=1)))
        low, high = grid[max(0, nearest - 1)], grid[min(len(grid) - 1, nearest + 1)]
        for _ in range(60):  # golden section
            a, b = low + 0.382 * (high - low), low + 0.618 * (high - low)
            away = [
                max(
                    abs(drives[n].at(s).position(s) - x)
                    for n, x in zip(names, pose, strict=True)
                )
                for s in (a, b)
            ]
            low, high = (low, b) if away[0] < away[1] else (a, high)
        worst = max(worst, min(away))
    return worst


@settings(max_examples=60, deadline=None)
@given(st.lists(legs, min_size=2, max_size=3), st.floats(0.0, 1.0), st.booleans())
@pytest.mark.slow
def test_a_stop_along_the_path_stays_on_it_and_within_each_motors_limits(
    motors: list[list[tuple[float, float, float, float, bool]]], when: float, hard: bool
) -> None:
    drives = {name: programme(given) for name, given in zip(MOTORS, motors, strict=False)}
    now = when * max(d.end for d in drives.values())
    most = dict.fromkeys(drives, 120.0) if hard else None
    stop = braked_along(drives, now, most)
    if not stop:
        return
    assert distance_to_path(drives, stop, now) <= 2.0 * PATH_TOLERANCE + 1e-6
    for name, way in stop.items():
        before = drives[name].at(now)
        assert way.position(now) == pytest.approx(before.position(now), abs=1e-7)
        assert way.velocity(now) == pytest.approx(before.velocity(now), abs=1e-5)
        legs_ahead = drives[name].trajectories
        allowed = 120.0 if hard else max(t.acceleration(0.0) for t in legs_ahead)
        assert (
            max(abs(p.acceleration) for p in way.pieces) <= allowed * (1.0 + 1e-4) + 1e-6
        )
        times = np.linspace(now, way.end, 200)
        fastest = max(t.top_speed for t in legs_ahead)
        assert max(abs(way.velocity(t)) for t in times) <= fastest + 1e-6
        for one, other in zip(way.pieces, way.pieces[1:], strict=False):
            dt = other.start - one.start
            reached = one.position + dt * (one.velocity + 0.5 * one.acceleration * dt)
            assert reached == pytest.approx(other.position, abs=1e-6)
            gained = one.velocity + one.acceleration * dt
            assert gained == pytest.approx(other.velocity, abs=1e-4)


def test_motors_that_cruise_stop_together_in_the_time_of_the_slowest() -> None:
    """By hand: 50 mm/s with 50 and with 10 mm/s2 are 5 s and, in step, 125 mm each."""
    drives = {
        "mag_obj": Drive(50.0, 50.0, (motion.move(0.0, 0.0, 5000.0, 50.0, 50.0, 0.0),)),
        "mag_det": Drive(50.0, 10.0, (motion.move(0.0, 0.0, 5000.0, 50.0, 10.0, 0.0),)),
    }
    stop = braked_along(drives, 20.0)
    for name, drive in drives.items():
        here = drive.at(20.0).position(20.0)
        assert stop[name].end == pytest.approx(25.0, abs=1e-9)
        assert stop[name].target - here == pytest.approx(125.0, abs=1e-6)
    apart = braked_apart(M, drives, 20.0)
    assert apart["mag_obj"].end == pytest.approx(21.0, abs=1e-9)
    assert apart["mag_det"].end == pytest.approx(25.0, abs=1e-9)


def test_while_a_motor_brakes_at_its_limit_the_others_go_on_along_the_path() -> None:
    """The reason why stops along the path can be long; harder braking shortens them."""
    drives = {
        "mag_obj": Drive(50.0, 50.0, (motion.move(0.0, 0.0, 2000.0, 50.0, 50.0, 0.0),)),
        "mag_det": Drive(50.0, 5.0, (motion.move(0.0, 0.0, 600.0, 50.0, 5.0, 0.0),)),
    }
    now = 13.0  # mag_det has begun to brake at 12 s, for 10 s
    stop = braked_along(drives, now)
    assert stop["mag_det"].end == pytest.approx(22.0, abs=1e-6)
    assert (
        stop["mag_det"].pieces[-1].acceleration != 0.0
    )  # no piece for the rest that follows
    assert stop["mag_obj"].end == pytest.approx(23.0, abs=1e-6)
    assert (
        braked_along(drives, now, {"mag_obj": 125.0, "mag_det": 125.0})["mag_obj"].end
        < 14.0
    )


def test_a_stop_while_all_stand_in_a_programme_is_at_once() -> None:
    first = motion.move(0.0, 0.0, 10.0, 50.0, 50.0, 0.0)
    later = motion.move(10.0, 0.0, 0.0, 50.0, 50.0, 5.0)
    drives = {"mag_obj": Drive(50.0, 50.0, (first, later))}
    stop = braked_along(drives, 3.0)["mag_obj"]
    assert (stop.end, stop.target) == (3.0, 10.0)


@pytest.mark.parametrize("hair", [0.0, 1e-10, 5e-10, 1e-9, 3e-9, 1e-8])
def test_a_motor_that_pauses_during_a_stop_stands_until_it_goes_on(hair: float) -> None:
    """Two motors whose legs end a hair apart: rounding must not swallow the pause of one."""
    there = motion.move(0.0, 0.0, 90.0, 60.0, 30.0, 0.0)
    back = motion.move(90.0, 0.0, 0.0, 60.0, 30.0, there.end + 0.3)
    knot = there.end + hair
    pieces = Piece(0.0, 0.0, 0.0, 5.0), Piece(knot, 2.5 * knot * knot, 5.0 * knot, 0.0)
    slow = Trajectory(pieces, knot + 30.0, 2.5 * knot * knot + 150.0 * knot)
    drives = {
        "rot_obj": Drive(60.0, 30.0, (there, back)),
        "mag_obj": Drive(50.0, 5.0, (slow,)),
    }
    for now in np.linspace(0.5 * there.end, there.end, 23).tolist():
        way = braked_along(drives, now, {"rot_obj": 30.0, "mag_obj": 5.0})["rot_obj"]
        for one, following in pairwise(way.pieces):
            dt = following.start - one.start
            end = one.position + dt * (one.velocity + 0.5 * one.acceleration * dt)
            assert end == pytest.approx(following.position, abs=1e-6)
        rests = [p.velocity == 0.0 == p.acceleration for p in way.pieces]
        assert any(rests)
        assert not any(one and following for one, following in pairwise(rests))


def drawn_programme(rng: np.random.Generator) -> Drive:
    legs = rng.integers(1, 4)
    return programme([
        (float(rng.uniform(-200, 200)), float(rng.uniform(5, 50)), float(rng.uniform(5, 100)),
         float(rng.uniform(0, 4)), bool(rng.integers(2))) for _ in range(legs)
    ])  # fmt: skip


def soonest(
    drives: Mapping[str, Drive], now: float, most: Mapping[str, float] | None
) -> float:
    """When all rest, by small steps: programme time slows as fast as some motor can brake."""
    s, rate, time, step = now, 1.0, now, 5e-4
    while rate > 0.0:
        slowing = 1e9
        for name, drive in drives.items():
            leg = drive.at(s)
            v = leg.velocity(s)
            if abs(v) < 1e-6:
                continue
            along = (leg.velocity(s + 1e-7) - v) / 1e-7 * np.sign(v)
            may = max(leg.acceleration(s), most[name] if most else 0.0)
            slowing = min(slowing, max(0.0, may + along * rate * rate) / abs(v))
        if slowing == 1e9:
            return time
        s, rate, time = s + rate * step, rate - slowing * step, time + step
    return time


@pytest.mark.parametrize("hard", [False, True])
@pytest.mark.parametrize("seed", range(15))
def test_a_stop_is_as_short_as_the_weakest_motor_allows(seed: int, hard: bool) -> None:
    rng = np.random.default_rng(seed)
    drives = {name: drawn_programme(rng) for name in MOTORS[: 2 + seed % 2]}
    now = float(rng.uniform(0.0, 0.9)) * max(d.end for d in drives.values())
    most = dict.fromkeys(drives, 120.0) if hard else None
    stop = braked_along(drives, now, most)
    end = max(way.end for way in stop.values())
    least = soonest(drives, now, most) - now
    assert (
        0.99 * least - 0.005 <= end - now <= 1.08 * least + 0.01
    )  # in cells of even slowing
    for name, way in stop.items():
        times = np.linspace(now, end, 400)
        at, step = way.positions(times), times[1] - times[0]
        fastest = max(t.top_speed for t in drives[name].trajectories) + 1e-3
        assert np.abs(np.diff(at)).max() <= fastest * step + 1e-6
        assert way.position(now) == pytest.approx(
            drives[name].at(now).position(now), abs=1e-7
        )
        assert way.position(end) == way.target
        low, high = (
            f([t.target for t in drives[name].trajectories] + [0.0]) for f in (min, max)
        )
        assert low - 1e-6 <= at.min() <= at.max() <= high + 1e-6


@pytest.mark.parametrize("hair", [5e-10, 3e-7, 1e-5, 5e-5, 9e-5])
def test_a_stop_begun_just_before_a_motor_has_sped_up_is_smooth(hair: float) -> None:
    """The cell up to the end of the ramp is too short for two halves."""
    way = motion.move(0.0, 0.0, 400.0, 50.0, 25.0, 0.0)
    stop = braked_along({"mag_obj": Drive(50.0, 25.0, (way,))}, 2.0 - hair)["mag_obj"]
    assert stop.end == pytest.approx(4.0, abs=1e-3)
    assert stop.start == 2.0 - hair
    if hair < 1e-9:  # begun where the ramp ends, as far as anybody can tell
        return
    for one, following in pairwise(stop.pieces):
        dt = following.start - one.start
        gained = one.velocity + one.acceleration * dt
        assert gained == pytest.approx(following.velocity, abs=1e-6)


@pytest.mark.parametrize("acceleration", [20.0, 50.0, 90.0])
@pytest.mark.parametrize("most", [90.0, 120.0, 300.0])
def test_a_stop_while_motors_speed_up_is_cut_no_finer_than_its_error_asks(
    acceleration: float, most: float
) -> None:
    drives = {
        "mag_obj": Drive(
            50.0, 50.0, (motion.move(0.0, 0.0, 4000.0, 400.0, acceleration, 0.0),)
        ),
        "mag_det": Drive(50.0, 50.0, (motion.move(0.0, 0.0, -3000.0, 30.0, 50.0, 0.0),)),
    }
    stop = braked_along(drives, 2.0, {"mag_obj": most, "mag_det": most})
    assert 0.1 * PATH_TOLERANCE < distance_to_path(drives, stop, 2.0) <= PATH_TOLERANCE


def test_a_stop_shorter_than_the_clock_tells_is_a_rest() -> None:
    """Thirty years on, a time has steps of 0.1 us; half of one is left of the way."""
    way = motion.move(0.0, 0.0, 100.0, 50.0, 50.0, 1e9)
    now = float(np.nextafter(way.end, 0.0))
    stop = braked_along({"mag_obj": Drive(50.0, 50.0, (way,))}, now, {"mag_obj": 500.0})[
        "mag_obj"
    ]
    assert (stop.start, stop.end, stop.top_speed) == (now, now, 0.0)
    assert stop.target == pytest.approx(100.0, abs=1e-6)
