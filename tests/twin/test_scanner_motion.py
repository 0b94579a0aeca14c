"""Motion of the scanner under any commands: continuous, within limits, exact arrival."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flexdt.twin.errors import LimitError, TwinError, UnknownNameError
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_profile,
    parse_machine,
    profile_of,
)
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.braking import braked_apart
from flexdt.twin.motion.drives import Drive, home, plan_jog, plan_move, with_settings
from flexdt.twin.motion.profiles import at_rest
from flexdt.twin.scanner.scanner import ScannerTwin

M = builtin_machine()
P = builtin_profile(M.default_profile)
MOTORS = list(M.axes)
AXES = [*M.axes, *M.virtual_axes]


def scanner() -> ScannerTwin:
    return ScannerTwin(M, P)


times = st.floats(0.0, 8.0, allow_nan=False)
moves = st.tuples(
    st.just("move"),
    st.dictionaries(st.sampled_from(MOTORS), st.floats(0.0, 1.0), min_size=1, max_size=3),
)
relative = st.tuples(
    st.just("relative"),
    st.dictionaries(
        st.sampled_from(AXES), st.floats(-60.0, 60.0), min_size=1, max_size=2
    ),
)
jogs = st.tuples(
    st.just("jog"),
    st.tuples(st.sampled_from(AXES), st.floats(-50.0, 50.0), st.floats(0.01, 20.0)),
)
pace = st.tuples(
    st.just("set"),
    st.tuples(st.sampled_from(AXES), st.floats(0.5, 50.0), st.floats(1.0, 90.0)),
)
stops = st.tuples(st.sampled_from(["stop", "estop", "reset"]), st.none())
commands = st.lists(
    st.tuples(times, st.one_of(moves, relative, jogs, pace, stops)), max_size=14
)


def do(s: ScannerTwin, command, now: float) -> None:
    name, what = command
    match name:
        case "move":
            span = {n: (M.axes[n].lower, M.axes[n].upper) for n in what}
            s.move({n: lo + f * (hi - lo) for (n, f), (lo, hi) in
                    zip(what.items(), span.values(), strict=True)}, now)  # fmt: skip
        case "relative":
            s.move(what, now, relative=True)
        case "jog":
            s.jog(*what, now)
        case "set":
            s.set_axis(what[0], speed=what[1], acceleration=what[2])
        case "stop":
            s.stop(now)
        case "estop":
            s.estop(now)
        case "reset":
            s.reset(99.0)


@settings(max_examples=150, deadline=None)
@given(commands)
@example([(0.0, ("move", {"ver_tube": 0.0})), (1.0, ("stop", None))])
@pytest.mark.slow
def test_any_commands_at_any_times_keep_motion_continuous_and_within_limits(
    script,
) -> None:
    s = scanner()
    now = 0.0
    for gap, command in script:
        # Sampled on the trajectories in force before the next command replaces them.
        for t in np.linspace(now, now + gap, 7):
            for name, axis in M.axes.items():
                x, v = s.positions(t)[name], s.velocities(t)[name]
                assert axis.lower - 1e-9 <= x <= axis.upper + 1e-9
                assert abs(v) <= axis.max_speed + 1e-9
        now += gap
        before = s.positions(now), s.velocities(now)
        try:
            do(s, command, now)
        except TwinError:
            assert s.positions(now) == before[0]
            assert s.velocities(now) == before[1]
        for name in MOTORS:
            assert s.positions(now)[name] == pytest.approx(before[0][name], abs=1e-9)
            assert s.velocities(now)[name] == pytest.approx(before[1][name], abs=1e-6)
    for name, t in s.trajectories(now).items():
        assert math.isfinite(t.end)
        a = M.axes[name]
        assert all(abs(p.acceleration) <= a.max_acceleration + 1e-9 for p in t.pieces)
        # Pieces join: where one ends, the next begins with the same position and velocity.
        for p, q in zip(t.pieces, t.pieces[1:], strict=False):
            dt = q.start - p.start
            assert p.position + dt * (
                p.velocity + p.acceleration * dt / 2
            ) == pytest.approx(q.position, abs=1e-9)
            assert p.velocity + p.acceleration * dt == pytest.approx(q.velocity, abs=1e-9)
    end = s.rest_time(now)
    assert not s.moving(end)
    assert s.positions(end) == s.targets(now)  # arrival is exact
    for name, axis in M.axes.items():
        assert axis.lower <= s.positions(end)[name] <= axis.upper


@settings(max_examples=100, deadline=None)
@given(st.floats(70.0, 996.0), st.floats(70.0, 996.0), st.floats(0.0, 12.0))
def test_retarget_in_flight_arrives_exactly_with_continuous_velocity(a, b, t) -> None:
    s = scanner()
    s.move({"mag_obj": a}, 0.0)
    v = s.velocities(t)["mag_obj"]
    duration = s.move({"mag_obj": b}, t)["mag_obj"]
    end = s.rest_time(t)
    assert end == pytest.approx(t + duration)
    assert s.velocities(t)["mag_obj"] == pytest.approx(v, abs=1e-9)
    assert s.positions(end)["mag_obj"] == b
    assert s.velocities(end)["mag_obj"] == 0.0


def test_position_integrates_velocity() -> None:
    s = scanner()
    s.move({"mag_obj": 300.0, "rot_obj": 90.0}, 0.0)
    s.move({"mag_obj": 800.0}, 2.0)
    t = np.linspace(2.0, 14.0, 20_001)
    x = np.array([s.positions(k)["mag_obj"] for k in t])
    v = np.array([s.velocities(k)["mag_obj"] for k in t])
    travelled = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * np.diff(t))])
    np.testing.assert_allclose(x - x[0], travelled, atol=1e-5)


def test_nothing_moves_if_any_target_is_bad() -> None:
    s = scanner()
    with pytest.raises(LimitError, match=r"ver_det target 3 mm is outside \[4, 350\]"):
        s.move({"mag_obj": 300.0, "ver_det": 3.0}, 0.0)
    with pytest.raises(UnknownNameError, match="mag_objj"):
        s.move({"mag_obj": 300.0, "mag_objj": 3.0}, 0.0)
    with pytest.raises(LimitError):
        s.move({"mag_obj": math.nan}, 0.0)
    assert not s.moving(0.0)


def test_lowering_the_acceleration_in_flight_does_not_carry_a_motor_past_its_limit() -> (
    None
):
    s = scanner()
    s.set_axis("mag_det", acceleration=125.0)
    s.move({"mag_det": 110.0}, 0.0)
    s.move({"mag_det": 1059.0}, 100.0)
    s.set_axis("mag_det", acceleration=0.1)
    t = s.rest_time(100.0) - 0.2  # in its last braking
    s.stop(t)
    assert s.positions(s.rest_time(t))["mag_det"] <= 1059.0
    s.move({"mag_det": 1058.0}, t)
    assert (
        max(s.trajectories(t)["mag_det"].positions(np.linspace(t, t + 5, 2000))) <= 1059.0
    )


def test_jog_ends_with_its_lease_and_renewal_carries_on() -> None:
    s = scanner()
    s.jog("mag_obj", 20.0, 1.0, 0.0)
    assert s.velocities(0.9)["mag_obj"] == 20.0
    s.jog("mag_obj", 20.0, 1.0, 0.9)
    assert s.velocities(1.8)["mag_obj"] == 20.0
    assert not s.moving(1.9 + 20.0 / 50.0 + 1e-9)


def test_jog_brakes_onto_its_limit() -> None:
    s = scanner()
    s.jog("mag_obj", 50.0, 1e4, 0.0)
    assert s.targets(0.0)["mag_obj"] == 996.0
    end = s.rest_time(0.0)
    assert s.velocities(end - 0.5)["mag_obj"] == pytest.approx(25.0, rel=1e-6)


def test_coupled_axis_moves_source_and_detector_in_step() -> None:
    s = scanner()
    s.set_axis("ver_det", speed=10.0, acceleration=20.0)
    before = s.state(0.0).axes["ver_obj"].position
    s.move({"ver_obj": before - 100.0}, 0.0)
    apart = M.axes["ver_det"].home - M.axes["ver_tube"].home
    for t in np.linspace(0.0, 11.0, 40):
        p = s.positions(t)
        assert p["ver_det"] - p["ver_tube"] == pytest.approx(apart, abs=1e-9)
    end = s.rest_time(0.0)
    assert s.state(end).axes["ver_obj"].position == pytest.approx(before - 100.0)
    assert s.positions(end)["ver_tube"] == pytest.approx(M.axes["ver_tube"].home + 100.0)
    with pytest.raises(LimitError, match="twice"):
        s.move({"ver_obj": 300.0, "ver_tube": 50.0}, end)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([-2.0, -0.5, 0.5, 1.0, 2.0]), st.sampled_from([-3.0, -1.0, 0.7]),
    st.floats(-200.0, 200.0), st.floats(100.0, 800.0), st.booleans(),
)  # fmt: skip
def test_limits_of_an_axis_without_a_motor_are_its_own(
    x, z, at_x, at_z, relative
) -> None:
    """What a refusal says is allowed is accepted, and what lies beyond it is refused."""
    text = (
        'base = "xyzr_cabinet"\nname = "v"\n[virtual_axes.W]\nconstant = 5.0\nof = "X"\n'
    )
    machine = parse_machine(f"{text}factor = {1.0 / x}\nmoves = {{ X = {x}, Z = {z} }}\n")
    s = ScannerTwin(machine, profile_of(machine))
    s.move({"X": at_x, "Z": at_z}, 0.0)
    here = 5.0 + at_x / x
    with pytest.raises(LimitError, match=r"^W target 9999 mm is outside") as beyond:
        s.move({"W": 9999.0 - (here if relative else 0.0)}, 99.0, relative=relative)
    found = beyond.value.data
    low, high = found["allowed"]
    assert (found["axis"], found["asked"]) == ("W", pytest.approx(9999.0))
    assert low < here < high
    for end, out in ((low, -1e-3), (high, 1e-3)):
        s.move({"W": end - math.copysign(1e-9, out)}, 99.0)
        s.move({"X": at_x, "Z": at_z}, 99.0)
        with pytest.raises(LimitError, match=r"^W target"):
            s.move({"W": end + out}, 199.0)
    for what in ("speed", "acceleration"):
        with pytest.raises(LimitError, match=f"^W {what} 1000 is outside") as fast:
            s.set_axis("W", **{what: 1000.0})
        low, high = fast.value.data["allowed"]
        s.set_axis("W", **{what: low * 1.0001})
        s.set_axis("W", **{what: high * 0.9999})
        for wrong in (low * 0.999, high * 1.001):
            with pytest.raises(LimitError):
                s.set_axis("W", **{what: wrong})
    with pytest.raises(LimitError) as jog:
        s.jog("W", 1000.0, 1.0, 199.0)
    s.jog("W", jog.value.data["allowed"] * 0.9999, 1e-3, 199.0)
    fastest = min(
        machine.axes["X"].max_speed / abs(x), machine.axes["Z"].max_speed / abs(z)
    )
    assert jog.value.data["allowed"] == pytest.approx(fastest)


@pytest.mark.parametrize(("tube", "panel"), [(-2.0, -0.5), (-0.25, 1.0)])
def test_motors_of_an_axis_get_their_share_of_its_rates(
    tube: float, panel: float
) -> None:
    geared = parse_machine(
        f'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = {1 / tube}\n'
        f"moves = {{ ver_tube = {tube}, ver_det = {panel} }}\n"
    )
    drives = with_settings(
        geared, home(geared, 0.0), "ver_obj", speed=1.5, acceleration=2.5
    )
    for name, share in (("ver_tube", abs(tube)), ("ver_det", abs(panel))):
        assert drives[name].speed == 1.5 * share
        assert drives[name].acceleration == 2.5 * share


@pytest.mark.parametrize(("tube", "panel"), [(-2.0, -0.5), (-0.25, 1.0), (-1.0, 3.0)])
def test_coupled_motors_of_different_gears_run_in_step(tube: float, panel: float) -> None:
    """Each is where the axis has it at every moment, and none is faster than it may be."""
    geared = parse_machine(
        f'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = {1 / tube}\n'
        f"moves = {{ ver_tube = {tube}, ver_det = {panel} }}\n"
    )
    drives = {
        n: replace(d, trajectories=(at_rest(150.0),))
        for n, d in home(geared, 0.0).items()
    }
    drives["ver_tube"] = replace(drives["ver_tube"], speed=7.0, acceleration=5.0)
    ways = plan_move(geared, drives, {"ver_obj": 20.0}, 0.0, relative=True)
    end = max(way.end for way in ways.values())
    for t in np.linspace(0.0, 1.01 * end, 50).tolist():
        gone = {n: way.position(t) - 150.0 for n, way in ways.items()}
        assert gone["ver_tube"] / tube == pytest.approx(gone["ver_det"] / panel, abs=1e-9)
        for name, way in ways.items():
            assert abs(way.velocity(t)) <= drives[name].speed + 1e-9
    times = np.linspace(0.0, 1.01 * end, 400)
    for name, way in ways.items():
        gained = np.abs(np.diff([way.velocity(t) for t in times])) / np.diff(times)
        assert gained.max() <= drives[name].acceleration + 1e-6
    assert gone["ver_det"] == pytest.approx(20.0 * panel)


@pytest.mark.parametrize("when", [0.3, 1.5])
@pytest.mark.parametrize(("tube", "panel"), [(-2.0, -0.5), (-0.25, 1.0), (-1.0, 3.0)])
def test_coupled_motors_of_different_gears_stop_in_step(
    tube: float, panel: float, when: float
) -> None:
    geared = parse_machine(
        f'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = {1 / tube}\n'
        f"moves = {{ ver_tube = {tube}, ver_det = {panel} }}\n"
    )
    drives = {
        n: replace(d, trajectories=(at_rest(150.0),))
        for n, d in home(geared, 0.0).items()
    }
    drives["ver_tube"] = replace(drives["ver_tube"], acceleration=5.0)
    ways = plan_move(geared, drives, {"ver_obj": 30.0}, 0.0, relative=True)
    going = {n: drives[n].following(ways[n]) if n in ways else drives[n] for n in drives}
    most = {n: 100.0 if n == "ver_det" else 5.0 for n in drives}
    stop = braked_apart(geared, going, when, most)
    end = max(t.end for t in stop.values())
    for t in np.linspace(when, end, 30).tolist():
        gone = {n: stop[n].position(t) - 150.0 for n in ways}
        assert gone["ver_tube"] / tube == pytest.approx(gone["ver_det"] / panel, abs=1e-6)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_jog_faster_than_the_motor_is_refused_either_way(sign: float) -> None:
    s = scanner()
    fastest = M.axes["mag_obj"].max_speed
    s.jog("mag_obj", sign * fastest, 0.1, 0.0)
    with pytest.raises(LimitError, match=f"mag_obj allows {fastest:g}"):
        s.jog("mag_obj", sign * fastest * 1.001, 0.1, 1.0)


@pytest.mark.parametrize("lease", [0.0, -1.0, math.inf, math.nan])
def test_a_jog_without_a_finite_time_is_refused(lease: float) -> None:
    with pytest.raises(LimitError, match="must be positive and finite"):
        plan_jog(M, home(M, 0.0), "mag_obj", 1.0, lease, 0.0)


def test_coupled_jog_halts_both_at_the_first_limit() -> None:
    s = scanner()
    s.jog("ver_obj", 10.0, 1e3, 0.0)  # object up = source and detector down
    apart = M.axes["ver_det"].home - M.axes["ver_tube"].home
    for t in np.linspace(0.0, 8.0, 30):
        p = s.positions(t)
        assert p["ver_det"] - p["ver_tube"] == pytest.approx(apart, abs=1e-9)
    assert s.positions(s.rest_time(0.0))["ver_det"] == pytest.approx(4.0, abs=1e-9)


def test_rotation_is_accumulated_unless_shortest_is_asked() -> None:
    s = scanner()
    s.move({"rot_obj": 360.5}, 0.0)
    assert s.targets(0.0)["rot_obj"] == 360.5
    now = s.rest_time(0.0)
    s.move({"rot_obj": -0.5}, now, shortest=True)
    assert s.targets(now)["rot_obj"] == 359.5
    now = s.rest_time(now)
    s.move({"rot_obj": 7200.0}, now)
    now = s.rest_time(now)
    s.move(
        {"rot_obj": 10.0}, now, shortest=True
    )  # 7210 is past the travel: one turn back
    assert s.targets(now)["rot_obj"] == 6850.0


def test_relative_moves_add_to_where_the_motor_is_bound() -> None:
    s = scanner()
    s.move({"tra_obj": 10.0}, 0.0, relative=True)
    s.move({"tra_obj": 10.0}, 0.1, relative=True)
    assert s.targets(0.1)["tra_obj"] == 20.0


def test_a_programme_is_followed_at_its_times_and_stop_ends_it() -> None:
    from flexdt.twin.motion import profiles as motion

    s = scanner()
    first = motion.move(600.0, 0.0, 650.0, 50.0, 50.0, 4.0)
    second = motion.move(650.0, 0.0, 600.0, 50.0, 50.0, 9.0)
    s.follow(s.prepared({"mag_obj": (first, second)}, 1.0).certified(), 1.0)
    assert s.positions(3.0)["mag_obj"] == 600.0
    assert s.positions(8.0)["mag_obj"] == 650.0
    assert s.positions(20.0)["mag_obj"] == 600.0
    s.stop(8.0)
    assert s.positions(20.0)["mag_obj"] == 650.0


def test_a_leg_of_a_programme_on_a_clock_of_its_own_is_shifted_once() -> None:
    """At rest, each of the scanner's motors is read some thirty times a second."""
    legs = (
        motion.move(0.0, 0.0, 10.0, 5.0, 20.0, 0.0),
        motion.move(10.0, 0.0, 0.0, 5.0, 20.0, 4.0),
    )
    drive = Drive(5.0, 20.0, legs, origin=100.0)
    first = drive.at(101.0)
    assert first == legs[0].shifted(100.0)
    assert drive.at(102.0) is first
    assert drive.at(104.5) == legs[1].shifted(100.0)
    assert drive.at(101.0) == first
