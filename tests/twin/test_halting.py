"""What is halted when the stage changes under motion that was free, and what a programme is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin import motion
from flexdt.twin.collision import Polytope, Scene, box, build_scene, clearance, scene_guard
from flexdt.twin.conventions import FloatArray
from flexdt.twin.drives import Drive
from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.machine import builtin_machine, builtin_profile
from flexdt.twin.motion import Trajectory
from flexdt.twin.parameters import Parameters
from flexdt.twin.scanner import ScannerTwin

M = builtin_machine()
P = builtin_profile(M.default_profile)
MARGIN = M.safety_margin_mm
MOMENTS = 400


def scanner(*stage: Polytope) -> ScannerTwin:
    return ScannerTwin(M, P, guard=scene_guard(build_scene(M, P, stage)))


def moments(s: ScannerTwin, now: float) -> FloatArray:
    return np.linspace(now, s.rest_time(now), MOMENTS)


def least(scene: Scene, s: ScannerTwin, now: float) -> float:
    """Least clearance of the poses that the scanner will take, each looked at by itself [mm]."""
    return min(clearance(scene, s.positions(t)).mm for t in moments(s, now).tolist())


def programme(rng: np.random.Generator, s: ScannerTwin, now: float) -> None:
    """A few moves one after the other on each of some motors, with waits between."""
    out: dict[str, tuple[Trajectory, ...]] = {}
    for name in rng.choice(["rot_obj", "mag_det", "tra_obj"], rng.integers(1, 4), replace=False):
        x, time, ways = s.positions(now)[name], now + rng.uniform(0.0, 2.0), []
        middle, width = {"rot_obj": (0, 180), "mag_det": (735, 50), "tra_obj": (0, 20)}[name]
        for _ in range(rng.integers(1, 5)):
            target = middle + rng.uniform(-width, width)
            ways.append(motion.move(x, 0.0, target, *s.settings(name), time))
            x, time = target, ways[-1].end + rng.choice([0.0, 0.5])
        out[str(name)] = tuple(ways)
    s.follow(out, now)


def set_off(rng: np.random.Generator, s: ScannerTwin, now: float) -> None:
    """Something free on the stage as it is."""
    match rng.integers(3):
        case 0:
            s.move({"rot_obj": rng.uniform(-200, 200), "mag_obj": rng.uniform(550, 605)}, now)
        case 1:
            s.jog("rot_obj", rng.choice([-40.0, 10.0, 40.0]), rng.uniform(1, 8), now)
        case _:
            programme(rng, s, now)


@pytest.mark.parametrize("seed", range(60))
def test_whatever_is_under_way_is_free_of_what_comes_or_halted_before_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s = scanner()
    s.place({"mag_obj": 600.0, "mag_det": 710.0}, 0.0)
    set_off(rng, s, 0.0)
    now = rng.uniform(0.0, s.rest_time(0.0))
    before = {name: drive.ahead(now) for name, drive in s._drives.items()}
    bar = box((rng.uniform(150, 320), rng.uniform(10, 40), 30.0))
    shift = Parameters(dD_z=rng.uniform(-20.0, 5.0))
    scene = build_scene(M, P, [bar], shift)
    s.guard = scene_guard(scene)

    outlook = s.look_again(now)
    after = least(scene, s, now)
    if outlook.halted is None:
        assert {name: drive.ahead(now) for name, drive in s._drives.items()} == before
        assert s.safety.blocked_attempts == 0
        assert after >= MARGIN - 1e-6 or outlook.near is not None
        return
    assert s.safety.blocked_attempts == 1
    # No false stop: parts do come to the margin on the way that was programmed.
    met = now + outlook.halted.data["time_s"]
    there = clearance(scene, {n: t.position(met) for n, t in before.items()})
    assert there.mm <= MARGIN + 0.02
    # Halted in time, unless not even an E-stop would have been.
    if after < MARGIN - 1e-6:
        s._drives = {n: Drive(1.0, 1.0, (t,)) for n, t in before.items()}
        s.estop(now)
        assert least(scene, s, now) < MARGIN + 0.02


def test_those_seeds_halt_moves_jogs_and_programmes_and_let_some_go_on() -> None:
    """The cases above are not all of one kind."""
    kinds = set()
    for seed in range(60):
        rng = np.random.default_rng(seed)
        s = scanner()
        s.place({"mag_obj": 600.0, "mag_det": 710.0}, 0.0)
        set_off(rng, s, 0.0)
        longest = max(len(d.trajectories) for d in s._drives.values())
        now = rng.uniform(0.0, s.rest_time(0.0))
        bar = box((rng.uniform(150, 320), rng.uniform(10, 40), 30.0))
        s.guard = scene_guard(build_scene(M, P, [bar], Parameters(dD_z=rng.uniform(-20.0, 5.0))))
        kinds.add((longest > 1, s.look_again(now).halted is not None))
    assert kinds == {(False, False), (False, True), (True, False), (True, True)}


def test_a_programme_is_swept_whole_before_it_is_taken_over() -> None:
    s = scanner(box((300.0, 20.0, 20.0)))
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    away = motion.move(0.0, 0.0, 30.0, 45.0, 22.5, 1.0)
    into = motion.move(30.0, 0.0, 90.0, 45.0, 22.5, 50.0)
    for attempt in (1, 2):
        with pytest.raises(CollisionError, match=r"programme: .* would collide in 5[0-9]") as e:
            s.follow({"rot_obj": (away, into)}, 0.0)
        assert set(e.value.data["pair"]) == {"detector", "sample"}
        assert s.safety.blocked_attempts == attempt
        assert not s.moving(2.0)
    s.follow({"rot_obj": (away,)}, 0.0)
    assert s.positions(60.0)["rot_obj"] == 30.0
    # As if it stood elsewhere: there the same programme is free.
    s.require_free({"rot_obj": (away, into)}, 0.0, {"mag_det": 900.0})


def test_what_stands_too_close_is_said_and_stays() -> None:
    s = scanner()
    s.guard = scene_guard(build_scene(M, P, [box((1000.0, 1000.0, 20.0))]))
    outlook = s.look_again(0.0)
    assert outlook.halted is None
    assert outlook.near is not None
    assert s.safety.blocked_attempts == 0
    assert "are closer than the safety margin" in outlook.warnings[0]


def test_an_estop_stays_one_when_what_it_brakes_would_collide() -> None:
    s = scanner()
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    s.move({"rot_obj": 180.0}, 0.0)
    s.estop(2.0)
    s.guard = scene_guard(build_scene(M, P, [box((300.0, 20.0, 20.0))], Parameters(dD_z=-20.0)))
    for _ in range(4):
        s.look_again(2.0)
    assert (s.safety.state, s.safety.blocked_attempts) == ("estopped", 0)
    with pytest.raises(SafetyError, match="E-stop"):
        s.move({"rot_obj": 0.0}, 9.0)


def test_a_jog_that_is_cut_short_runs_no_faster_than_it_was_asked_to() -> None:
    s = scanner(box((300.0, 20.0, 20.0)))
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    s.jog("rot_obj", 2.0, 100.0, 0.0)
    assert 50.0 < s.targets(0.0)["rot_obj"] < 60.0
    assert max(s.velocities(t)["rot_obj"] for t in np.linspace(0.0, 40.0, 500)) <= 2.0 + 1e-9


@settings(max_examples=200, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 50), st.floats(0.0, 6.0)), min_size=1, max_size=6))
def test_joined_trajectories_do_what_they_do_one_after_the_other(
    legs: list[tuple[float, float]],
) -> None:
    """Waits between them and retargets in flight included; looked up one by one for comparison."""
    x, v, time, ways = 0.0, 0.0, 0.0, []
    for target, later in legs:
        ways.append(motion.move(x, v, target, 10.0, 5.0, time))
        time += later
        x, v = ways[-1].position(time), ways[-1].velocity(time)
    drive = Drive(10.0, 5.0, tuple(ways))
    for since in (0.0, 0.5 * time):
        joined = drive.ahead(since)
        for t in np.linspace(since, ways[-1].end + 1.0, 200):
            assert joined.position(t) == pytest.approx(drive.at(t).position(t), abs=1e-9)
            assert joined.velocity(t) == pytest.approx(drive.at(t).velocity(t), abs=1e-9)
        assert (joined.end, joined.target) == (ways[-1].end, ways[-1].target)
