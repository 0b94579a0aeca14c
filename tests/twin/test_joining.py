"""How motion joins what is under way, on a stage that may change: one swept programme,
always."""

from __future__ import annotations

import math
from collections.abc import Mapping
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin.collision.collision_scene import CollisionScene, build_scene
from flexdt.twin.collision.convex_solids import Polytope, box, hull
from flexdt.twin.collision.first_contact import clearance
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.errors import CollisionError, SafetyError
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.drives import Drive
from flexdt.twin.motion.profiles import Piece, Trajectory
from flexdt.twin.scanner.joining import StageChange
from flexdt.twin.scanner.safety import Contact, Guard
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import NamedCorrection, Sample

M = builtin_machine()
P = builtin_profile(M.default_profile)
MARGIN = M.safety_margin_mm
MOMENTS = 400


def scanner(*stage: Polytope) -> ScannerTwin:
    return ScannerTwin(M, P, guard=SceneGuard(build_scene(M, P, stage)))


def moments(s: ScannerTwin, now: float) -> FloatArray:
    return np.linspace(now, s.rest_time(now), MOMENTS)


def least(scene: CollisionScene, s: ScannerTwin, now: float) -> float:
    """Least clearance of the poses that the scanner will take, each looked at by itself
    [mm]."""
    return min(clearance(scene, s.positions(t)).mm for t in moments(s, now).tolist())


def programme(rng: np.random.Generator, s: ScannerTwin, now: float) -> None:
    """A few moves one after the other on each of some motors, with waits between."""
    out: dict[str, tuple[Trajectory, ...]] = {}
    for name in rng.choice(
        ["rot_obj", "mag_det", "tra_obj"], rng.integers(1, 4), replace=False
    ):
        x, time, ways = s.positions(now)[name], rng.uniform(0.0, 2.0), []
        middle, width = {"rot_obj": (0, 180), "mag_det": (735, 50), "tra_obj": (0, 20)}[
            name
        ]
        for _ in range(rng.integers(1, 5)):
            target = middle + rng.uniform(-width, width)
            ways.append(motion.move(x, 0.0, target, *s.settings(name), time))
            x, time = target, ways[-1].end + rng.choice([0.0, 0.5])
        out[str(name)] = tuple(ways)
    s.follow(s.prepared(out, now).certified(), now)


def set_off(rng: np.random.Generator, s: ScannerTwin, now: float) -> None:
    """Something free on the stage as it is."""
    match rng.integers(3):
        case 0:
            s.move(
                {"rot_obj": rng.uniform(-200, 200), "mag_obj": rng.uniform(550, 605)}, now
            )
        case 1:
            s.jog("rot_obj", rng.choice([-40.0, 10.0, 40.0]), rng.uniform(1, 8), now)
        case _:
            programme(rng, s, now)


def changed(
    seed: int,
) -> tuple[ScannerTwin, CollisionScene, float, str, dict[str, Trajectory], bool]:
    """A scanner under way, a bar put on its stage: what came of it, and what was programmed."""
    rng = np.random.default_rng(seed)
    s = scanner()
    s.place({"mag_obj": 600.0, "mag_det": 710.0}, 0.0)
    set_off(rng, s, 0.0)
    longest = max(len(d.trajectories) for d in s._drives.values())
    now = rng.uniform(0.0, s.rest_time(0.0))
    before = {name: drive.ahead(now) for name, drive in s._drives.items()}
    bar = box((rng.uniform(150, 320), rng.uniform(10, 40), 30.0))
    shift = NamedCorrection("moved", "2026-01-01", Offsets(dD_z=rng.uniform(-20.0, 5.0)))
    scene = build_scene(M, P, [bar], shift.parameters)
    try:
        change = s.stage_change(Sample("bar"), shift, SceneGuard(scene), now).certified()
        halted = s.take_stage(change, now)
    except CollisionError:
        return s, scene, now, "refused", before, longest > 2
    return s, scene, now, "free" if halted is None else "halted", before, longest > 2


@pytest.mark.daily(4)
@pytest.mark.parametrize("seed", range(60))
@pytest.mark.campaign(10)
def test_what_is_under_way_is_free_of_a_new_stage_or_halted_or_the_stage_refused(
    seed: int,
) -> None:
    s, scene, now, outcome, before, _ = changed(seed)
    after = {name: drive.ahead(now) for name, drive in s._drives.items()}
    if outcome == "refused":
        assert (after, s.sample, s.correction) == (before, Sample(), None)
        return
    assert least(scene, s, now) >= MARGIN - 1e-6
    assert (s.sample, s.safety.blocked_attempts) == (
        Sample("bar"),
        int(outcome == "halted"),
    )
    if outcome == "free":
        assert after == before
        return
    # No false stop: parts do come to the margin on the way that was programmed.
    ends = max(t.end for t in before.values())
    ways = [{n: t.position(time) for n, t in before.items()} for time in
            np.linspace(now, ends, 4000)]  # fmt: skip
    assert min(clearance(scene, way).mm for way in ways) <= MARGIN + 0.5


def test_those_seeds_halt_refuse_and_let_go_on_moves_jogs_and_programmes() -> None:
    """The cases above are not all of one kind."""
    kinds = {(c[3], c[5]) for c in map(changed, range(60))}
    moves = {("free", False), ("halted", False), ("refused", False)}
    assert kinds >= moves | {("free", True), ("halted", True)}


def test_a_programme_is_swept_whole_before_it_is_taken_over() -> None:
    s = scanner(box((300.0, 20.0, 20.0)))
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    away = motion.move(0.0, 0.0, 30.0, 45.0, 22.5, 1.0)
    into = motion.move(30.0, 0.0, 90.0, 45.0, 22.5, 50.0)
    for attempt in (1, 2):
        with pytest.raises(
            CollisionError, match=r"programme: .* would collide in 5[0-9]"
        ) as e:
            s.follow(s.prepared({"rot_obj": (away, into)}, 0.0).certified(), 0.0)
        assert set(e.value.data["pair"]) == {"detector", "sample"}
        assert s.safety.blocked_attempts == attempt
        assert not s.moving(2.0)
    s.follow(s.prepared({"rot_obj": (away,)}, 0.0).certified(), 0.0)
    assert s.positions(60.0)["rot_obj"] == 30.0
    # As if it stood elsewhere: there the same programme is free.
    elsewhere = s.prepared(
        {"rot_obj": (away, into)}, 0.0, {"rot_obj": 0.0, "mag_det": 900.0}
    )
    assert elsewhere.certified().contact is None


def test_a_programme_is_not_taken_over_where_the_world_has_changed_since_its_sweep() -> (
    None
):
    turn = {"rot_obj": (motion.move(0.0, 0.0, 90.0, 45.0, 22.5, 0.0),)}

    def stop(s: ScannerTwin) -> None:
        s.stop(0.0)

    def stage(s: ScannerTwin) -> None:
        s.take_stage(s.stage_change(Sample("x"), None, s.guard, 0.0).certified(), 0.0)

    def elsewhere(s: ScannerTwin) -> None:
        s.place({"mag_det": 900.0}, 0.0)

    def under_way(s: ScannerTwin) -> None:
        s.move({"mag_det": 900.0}, 0.0)

    for change in (stop, stage, elsewhere, under_way):
        s = scanner()
        certificate = s.prepared(turn, 0.0).certified()
        assert s.may_follow(certificate, 0.0)
        change(s)
        with pytest.raises(SafetyError, match="another stage or another start"):
            s.follow(certificate, 0.0)
        assert s.targets(0.0)["rot_obj"] == 0.0


def test_a_start_that_touches_is_blocked_until_motion_has_brought_it_apart() -> None:
    s = ScannerTwin(M, P)
    guard = SceneGuard(build_scene(M, P, [box((1000.0, 1000.0, 20.0))]))
    (warning,) = s.initialise_stage(Sample("slab"), None, guard, 0.0)
    assert "closer than the margin" in warning
    state = s.state(0.0).safety
    assert (state.state, "sample" in (state.contact or ())) == ("blocked", True)
    s.reset(0.0)
    assert s.state(0.0).safety.state == "blocked"
    free = s.stage_change(
        Sample(), None, SceneGuard(build_scene(M, P, ())), 0.0
    ).certified()
    assert s.take_stage(free, 0.0) is None
    with pytest.raises(SafetyError, match="come apart"):
        s.move({"mag_det": 900.0}, 0.0)
    s.reset(0.0)
    assert s.state(0.0).safety.state == "ready"


def test_a_retarget_of_one_of_two_that_are_free_only_together_stays_free() -> None:
    """The first finding of the strangers: the others went on into what the new one left."""
    s = scanner()
    scene = build_scene(M, P, ())
    s.place({"mag_obj": 950.0, "mag_det": 1059.0}, 0.0)
    s.move({"mag_obj": 450.0, "mag_det": 559.0}, 0.0)
    with pytest.raises(CollisionError) as error:
        s.move({"mag_obj": 996.0}, 5.0)
    halts = error.value.data["halts_at"]
    assert isinstance(halts, dict)
    assert set(halts) == {"mag_obj", "mag_det"}  # all halt along the new path
    rest = s.positions(s.rest_time(5.0))
    assert {name: rest[name] for name in halts} == halts
    assert least(scene, s, 5.0) >= MARGIN


@pytest.mark.parametrize("at", [0.3, 2.0, 5.0, 8.0, 10.5])
@pytest.mark.parametrize("slow", ["mag_obj", "mag_det"])
def test_a_stop_of_two_that_are_free_only_together_stays_free(
    slow: str, at: float
) -> None:
    """The second: each braked by itself, and what was free together met."""
    s = scanner()
    scene = build_scene(M, P, ())
    s.place({"mag_obj": 720.0, "mag_det": 820.0}, 0.0)
    s.set_axis(slow, acceleration=5.0)
    with suppress(CollisionError):  # it halts before, and that is stopped as well
        s.move({"mag_obj": 300.0, "mag_det": 400.0}, 0.0)
    stopping = s.stop(at)
    assert least(scene, s, at) >= MARGIN - 1e-6
    assert stopping.duration_s == pytest.approx(s.rest_time(at) - at, abs=1e-9)
    assert not s.moving(s.rest_time(at))


def test_motors_of_one_virtual_axis_brake_in_step() -> None:
    machine = M.model_copy(
        update={
            "axes": {
                **M.axes,
                "ver_det": M.axes["ver_det"].model_copy(
                    update={"max_acceleration": 60.0}
                ),
            }
        }
    )
    for stop in ("stop", "estop"):
        s = ScannerTwin(machine, P)
        s.place({"ver_tube": 300.0, "ver_det": 300.0}, 0.0)
        s.move({"ver_obj": 250.0}, 0.0)
        getattr(s, stop)(2.0)
        for t in np.linspace(2.0, s.rest_time(2.0), 50):
            there = s.positions(t)
            assert there["ver_tube"] == pytest.approx(there["ver_det"], abs=1e-9)


def test_an_estop_of_category_0_coasts_says_what_it_hits_and_is_blocked_then() -> None:
    coasting = dict.fromkeys(M.axes, 20.0)
    estop = M.estop.model_copy(update={"category": 0, "coasting": coasting})
    machine = M.model_copy(update={"estop": estop})
    s = ScannerTwin(machine, P, guard=SceneGuard(build_scene(M, P, ())))
    s.place({"mag_obj": 600.0, "mag_det": 760.0}, 0.0)
    with pytest.raises(CollisionError):
        s.move({"mag_det": 500.0}, 0.0)  # halts before the sample's base
    free = s.targets(0.0)["mag_det"]
    stopping = s.estop(s.rest_time(0.0) - 1.2)
    assert (stopping.path, stopping.would_hit is not None) == ("coasting", True)
    end = s.rest_time(0.0)
    assert s.targets(end)["mag_det"] < free
    assert s.state(end).safety.state == "estopped"
    s.reset(end)
    assert s.state(end).safety.state == "blocked"
    s.move({"mag_det": 900.0}, end)
    s.reset(s.rest_time(end))
    assert s.safety.state == "ready"


def test_an_estop_that_coasts_acts_whatever_its_sweep_meets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it would hit is said where it can be computed; the motors coast in any case, and
    nothing moves off where contacts cannot be judged."""
    estop = M.estop.model_copy(
        update={"category": 0, "coasting": dict.fromkeys(M.axes, 20.0)}
    )
    guard = SceneGuard(build_scene(M, P, ()))
    s = ScannerTwin(M.model_copy(update={"estop": estop}), P, guard=guard)
    s.move({"mag_obj": 600.0}, 0.0)

    def fail(*_: object, **__: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(SceneGuard, "__call__", fail)
    monkeypatch.setattr(SceneGuard, "touching", fail)
    stopping = s.estop(3.0)
    assert (stopping.path, stopping.would_hit) == ("coasting", None)
    end = s.rest_time(3.0)
    assert s.state(end).safety.state == "estopped"
    s.reset(end)
    assert s.state(end).safety.state == "ready"
    with pytest.raises(ZeroDivisionError):
        s.move({"mag_obj": 500.0}, end)
    assert s.rest_time(end) == end


def test_coasting_ends_at_the_end_of_the_travel() -> None:
    coasting = dict.fromkeys(M.axes, 1.0)
    estop = M.estop.model_copy(update={"category": 0, "coasting": coasting})
    s = ScannerTwin(M.model_copy(update={"estop": estop}), P)
    s.move({"tra_obj": 194.0}, 0.0)
    s.estop(2.0)
    end = s.rest_time(2.0)
    assert s.positions(end)["tra_obj"] == 194.0
    assert (
        max(s.positions(t)["tra_obj"] for t in np.linspace(2.0, end + 1.0, 200)) <= 194.0
    )


def test_a_jog_that_is_cut_short_runs_no_faster_than_it_was_asked_to() -> None:
    s = scanner(box((300.0, 20.0, 20.0)))
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    s.jog("rot_obj", 2.0, 100.0, 0.0)
    assert 50.0 < s.targets(0.0)["rot_obj"] < 60.0
    assert (
        max(s.velocities(t)["rot_obj"] for t in np.linspace(0.0, 40.0, 500)) <= 2.0 + 1e-9
    )


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-50, 50), st.floats(0.0, 6.0)), min_size=1, max_size=6)
)
@pytest.mark.slow
def test_joined_trajectories_do_what_they_do_one_after_the_other(
    legs: list[tuple[float, float]],
) -> None:
    """Waits between them and retargets in flight included; looked up one by one for
    comparison."""
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


def test_a_renewal_that_is_not_free_leaves_the_old_end_in_force() -> None:
    s = scanner()
    s.place({"mag_obj": 600.0, "mag_det": 800.0}, 0.0)
    s.jog("mag_obj", 50.0, 1.5, 0.0)
    with suppress(CollisionError):
        s.move({"mag_det": 500.0}, 0.5)  # halts as near as it can beside the jog
    before = s.trajectories(0.6)
    halted = s.targets(0.6)["mag_det"]
    assert halted < 800.0
    now = s.rest_time(0.6)
    s.jog("mag_det", -50.0, 1.0, now)  # runs as far as it is free, if at all
    with pytest.raises(CollisionError, match="nothing changes"):
        s.jog("mag_obj", 50.0, 5.0, s.rest_time(now))
    assert before["mag_obj"].target == s.targets(s.rest_time(now))["mag_obj"]


def test_a_second_jog_is_swept_with_the_first() -> None:
    s = scanner()
    scene = build_scene(M, P, ())
    s.place({"mag_obj": 500.0, "mag_det": 1000.0}, 0.0)
    assert s.jog("mag_obj", 50.0, 6.0, 0.0).cut_short is None
    second = s.jog("mag_det", -50.0, 6.0, 1.0)  # free by itself, not beside the first
    assert second.cut_short is not None
    assert second.warnings
    assert s.targets(1.0)["mag_obj"] == pytest.approx(800.0, abs=30.0)
    assert least(scene, s, 1.0) >= MARGIN - 1e-6


def test_a_stage_change_that_is_one_halt_too_many_takes_the_halt_that_is_free() -> None:
    """A stop along the old path, at the last blocked attempt, was never swept on the new
    stage."""
    turned = 0
    for seed in range(30):
        rng = np.random.default_rng(seed)
        s = scanner()
        s.place({"mag_obj": 600.0, "mag_det": 710.0}, 0.0)
        for _ in range(2):
            with pytest.raises(CollisionError):
                s.follow(
                    s.prepared(
                        {"mag_det": (motion.move(710.0, 0.0, 300.0, 50.0, 50.0, 0.0),)},
                        0.0,
                    ).certified(),
                    0.0,
                )
        s._drives = plan_rotation(s, rng)
        now = rng.uniform(0.5, 4.0)
        scene = build_scene(M, P, [box((rng.uniform(250, 320), 20.0, 30.0))])
        with suppress(CollisionError):
            change = s.stage_change(
                Sample("bar"), None, SceneGuard(scene), now
            ).certified()
            if s.take_stage(change, now) is not None:
                turned += 1
                assert s.safety.state == "blocked"
                assert least(scene, s, now) >= MARGIN - 1e-6
    assert turned >= 5


def plan_rotation(s: ScannerTwin, rng: np.random.Generator) -> dict[str, Drive]:
    """The drives with a turn under way that has cleared no count of attempts."""
    way = motion.move(0.0, 0.0, rng.uniform(100, 300), 45.0, 22.5, 0.0)
    return {**s._drives, "rot_obj": s._drives["rot_obj"].following(way)}


def test_a_reset_waits_until_coasting_motors_rest() -> None:
    """Reset in motion, the state was ready when parts met, and a move passed its travel's
    end."""
    estop = M.estop.model_copy(
        update={"category": 0, "coasting": dict.fromkeys(M.axes, 10.0)}
    )
    machine = M.model_copy(update={"estop": estop})
    s = ScannerTwin(machine, P, guard=SceneGuard(build_scene(M, P, ())))
    s.move({"mag_obj": 996.0}, 0.0)
    now = s.rest_time(0.0) - 1.0
    s.estop(now)
    rest = s.rest_time(now)
    for refused in (s.reset, lambda t: s.stage_change(Sample("x"), None, None, t)):
        with pytest.raises(SafetyError, match="coast"):
            refused(now + 0.01)
    assert s.stop(now + 0.1).path == "coasting"
    assert s.rest_time(now) == rest
    s.reset(rest)
    assert s.safety.state == "ready"


def test_a_certificate_of_another_stage_says_nothing_of_this_one() -> None:
    s = scanner(box((300.0, 20.0, 20.0)))
    s.place({"mag_det": 700.0}, 0.0)
    turn = {"rot_obj": (motion.move(0.0, 0.0, 90.0, 45.0, 22.5, 0.0),)}
    certificate = s.prepared(turn, 0.0).certified()
    assert certificate.contact is not None
    empty = SceneGuard(build_scene(M, P, ()))
    s.take_stage(s.stage_change(Sample(), None, empty, 0.0).certified(), 0.0)
    with pytest.raises(SafetyError, match="another stage"):
        s.follow(certificate, 0.0)
    assert s.safety.blocked_attempts == 0
    s.follow(s.prepared(turn, 0.0).certified(), 0.0)


def test_a_motor_that_passes_from_one_leg_to_the_next_never_shows_rest() -> None:
    """At the very moment at which one leg ends in motion the next has begun, whatever
    rounding."""
    rng = np.random.default_rng(5)
    for _ in range(2000):
        end, origin = float(rng.uniform(0.1, 3.0)), float(10.0 ** rng.uniform(-2.0, 5.0))
        first = Trajectory((Piece(0.0, 0.0, 0.0, 15.0),), end, 7.5 * end * end)
        after = Trajectory(
            (Piece(end, first.target, 15.0 * end, -15.0),), 2 * end, 2 * first.target
        )
        drive = Drive(50.0, 15.0, (first, after), origin)
        moment = first.shifted(origin).end
        assert drive.next_start(math.nextafter(moment, 0.0)) == moment
        assert drive.at(moment).velocity(moment) == 15.0 * end


def test_a_stage_that_overlaps_may_change_into_one_that_overlaps_less_and_no_deeper() -> (
    None
):
    """Overlaps had no depth: any other sample, or a correction, could go any deeper."""

    def bar(length: float) -> tuple[Sample, None, Guard]:
        return (
            Sample(f"{length}"),
            None,
            SceneGuard(build_scene(M, P, [box((20, length, 20))])),
        )

    s = ScannerTwin(M, P)
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    s.initialise_stage(*bar(300.0), 0.0)
    assert s.safety.contact is not None
    with pytest.raises(CollisionError, match="nothing changes"):
        s.stage_change(*bar(301.0), 0.0).certified()
    for length in (300.0, 299.0):
        assert s.take_stage(s.stage_change(*bar(length), 0.0).certified(), 0.0) is None


def test_a_retreat_of_a_sample_with_thousands_of_corners_is_judged_soon() -> None:
    """All directions of all pairs of corners took minutes, in which no E-stop was served."""
    rng = np.random.default_rng(5)
    points = rng.normal(size=(4000, 3))
    ball = hull(150.0 * points / np.linalg.norm(points, axis=1)[:, None])
    s = ScannerTwin(M, P)
    s.place({"mag_obj": 600.0, "mag_det": 700.0}, 0.0)
    s.initialise_stage(Sample("ball"), None, SceneGuard(build_scene(M, P, [ball])), 0.0)
    with pytest.raises(CollisionError, match="nothing changes"):
        s.move({"mag_det": 690.0, "ver_det": 21.0}, 0.0)
    with pytest.raises(CollisionError, match="nothing changes"):
        s.move({"mag_det": 699.0, "rot_obj": 90.0}, 0.0)
    s.move({"mag_det": 900.0, "rot_obj": 90.0}, 0.0)
    assert s.estop(1.0).distances


def test_a_long_programme_is_not_swept_again_where_a_stage_takes_over() -> None:
    """20 000 steps took a second of the loop, between the certificate and the takeover."""
    ways, x, time = [], 0.0, 0.0
    for _ in range(600):
        ways.append(motion.move(x, 0.0, x + 0.3, 45.0, 22.5, time))
        x, time = x + 0.3, ways[-1].end + 0.1
    asked = 0

    class Counted(SceneGuard):
        def __call__(
            self, trajectories: Mapping[str, Trajectory], now: float
        ) -> Contact | None:
            nonlocal asked
            asked += 1
            return super().__call__(trajectories, now)

    def changing(s: ScannerTwin) -> StageChange:
        scene = build_scene(M, P, [box((290.0, 20.0, 20.0))])
        return s.stage_change(Sample("bar"), None, Counted(scene), 1.0).certified()

    s = scanner()
    s.place({"mag_obj": 600.0, "mag_det": 715.0}, 0.0)
    turn = {"rot_obj": tuple(ways)}
    idle = changing(s)
    s.follow(s.prepared(turn, 0.0).certified(), 0.0)
    with pytest.raises(SafetyError, match="changed meanwhile"):
        s.take_stage(idle, 1.0)
    change = changing(s)
    asked = 0
    halted = s.take_stage(change, 1.5)
    assert halted is not None
    assert asked == 0
    assert least(build_scene(M, P, [box((290.0, 20.0, 20.0))]), s, 1.5) >= MARGIN - 1e-6


def test_what_was_stopped_by_a_late_clock_is_swept() -> None:
    """After 62 years the steps of a slowed programme's time were taken for jumps of the
    motor."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        now = 1.975e9 + rng.uniform(0.0, 1e6)
        s = ScannerTwin(M, P, now=now, guard=SceneGuard(build_scene(M, P, ())))
        s.move({"tra_obj": 15.0, "tra_det": 5.0}, now)
        now += rng.uniform(0.05, 0.6)
        s.estop(now)
        s.stage_change(Sample(), None, s.guard, now).certified()
        s.reset(now)
        s.move({"rot_obj": 5.0}, now)
