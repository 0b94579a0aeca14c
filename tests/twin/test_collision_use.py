"""Collisions in use: samples as convex pieces, the scanner's guard, reports of scripts,
detours."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from swept import sweep

from flexdt.phantoms import load_phantom
from flexdt.twin.collision.collision_scene import build_scene
from flexdt.twin.collision.convex_pieces import Mesh, _clip, convex_pieces
from flexdt.twin.collision.convex_solids import box
from flexdt.twin.collision.first_contact import clearance, touching
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.obstacle_path import _Planner, free_moves
from flexdt.twin.collision.plan_report import _from_size, collision_check
from flexdt.twin.collision.stages import _placed
from flexdt.twin.errors import CollisionError, GeometryError, SafetyError
from flexdt.twin.geometry.conventions import FloatArray, rotation_x, rotation_z
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.scanner.scanner import ScannerTwin
from flexdt.twin.scanner.state import Sample
from flexdt.twin.script import parse_script, plan_script
from flexdt.twin.script.commands import MoveAbsolute
from flexdt.twin.script.dry_run import check_script
from flexdt.twin.script.planning.plan_values import SampleSize

M = builtin_machine()
P = builtin_profile(M.default_profile)
LEGO = box((24, 16, 49.8))
BAR = box((300, 20, 40))


# Samples ----------------------------------------------------------------------------------------


def angle_bracket() -> trimesh.Trimesh:
    """An L of two bars, 12 cm3 where its hull has 23.5."""
    foot = trimesh.creation.box((60, 10, 10))
    post = trimesh.creation.box((10, 10, 60))
    post.apply_translation((25, 0, 25))
    return trimesh.util.concatenate([foot, post])


def inside_l(rng: np.random.Generator) -> FloatArray:
    foot = rng.uniform((-30, -5, -5), (30, 5, 5), (500, 3))
    return np.concatenate([foot, rng.uniform((20, -5, -5), (30, 5, 55), (500, 3))])


def inside_torus(rng: np.random.Generator) -> FloatArray:
    around, r = rng.uniform(0, 2 * math.pi, (2, 500)), 4.9 * np.sqrt(rng.random(500))
    radius = 30 + r * np.cos(around[1])
    return np.stack(
        [radius * np.cos(around[0]), radius * np.sin(around[0]), r * np.sin(around[1])],
        axis=1,
    )


def inside_ball(rng: np.random.Generator) -> FloatArray:
    v = rng.normal(size=(500, 3))
    return (
        19.7
        * v
        / np.linalg.norm(v, axis=1, keepdims=True)
        * rng.random((500, 1)) ** (1 / 3)
    )


@pytest.mark.parametrize(
    ("mesh", "inside"),
    [
        (angle_bracket(), inside_l),
        (
            trimesh.creation.torus(30, 5, major_sections=64, minor_sections=32),
            inside_torus,
        ),
        (trimesh.creation.icosphere(4, 20), inside_ball),
        (load_phantom("lego").mesh(), lambda rng: np.empty((0, 3))),
    ],
    ids=["L", "torus", "ball", "lego"],
)
@pytest.mark.daily(2)
def test_pieces_hold_the_whole_solid(
    mesh: Mesh, inside: Callable[[np.random.Generator], FloatArray]
) -> None:
    """Points on the surface and inside lie in a piece; without that, free would mean
    nothing."""
    pieces = convex_pieces(mesh)
    rng = np.random.default_rng(0)
    corners = np.asarray(mesh.vertices)[np.asarray(mesh.faces)]
    on = np.einsum("nk,nki->ni", rng.dirichlet(np.ones(3), len(corners)), corners)
    points = np.concatenate([on, inside(rng)])
    held = np.zeros(len(points), dtype=bool)
    for piece in pieces:
        planes = ConvexHull(piece.vertices).equations
        held |= (points @ planes[:, :3].T + planes[:, 3] <= 1e-6).all(axis=1)
    assert held.all()


def test_a_concave_sample_is_cut_where_that_pays_and_a_convex_one_is_not() -> None:
    pieces = convex_pieces(angle_bracket())
    assert sum(ConvexHull(p.vertices).volume for p in pieces) < 12500.0
    assert len(convex_pieces(trimesh.creation.icosphere(2, 20))) == 1
    assert len(convex_pieces(trimesh.creation.box((3, 4, 5)))) == 1
    assert len(convex_pieces(angle_bracket(), max_pieces=1)) == 1
    cavity = convex_pieces(angle_bracket())
    scene = build_scene(M, P, cavity)
    assert {scene.bodies[i].name for pair in scene.pairs for i in pair} >= {"sample"}


@pytest.mark.parametrize("seed", range(8))
def test_a_plane_cuts_a_convex_solid_into_two_that_fill_it(seed: int) -> None:
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(9, 3)) * (20.0, 9.0, 14.0) + rng.uniform(-30, 30, 3)
    whole = trimesh.convex.convex_hull(corners)
    for axis in range(3):
        low, high = corners[:, axis].min(), corners[:, axis].max()
        at = float(rng.uniform(low + 0.2 * (high - low), high - 0.2 * (high - low)))
        volume = 0.0
        for side in (-1.0, 1.0):
            half = _clip(np.asarray(whole.triangles), axis, at, side)
            assert (side * (half[:, :, axis] - at) >= -1e-9).all()
            points = half.reshape(-1, 3)
            volume += ConvexHull(points).volume
        assert volume == pytest.approx(float(whole.volume), rel=1e-9)
        beside = [
            _clip(np.asarray(whole.triangles), axis, low - 1.0, side)
            for side in (-1.0, 1.0)
        ]
        assert [len(half) for half in beside] == [0, len(whole.triangles)]


@pytest.mark.parametrize("seed", range(12))
def test_three_planes_cut_a_convex_solid_into_eight_that_fill_it(seed: int) -> None:
    """Where the planes meet inside it, only the caps over the cuts hold the eighths' corner."""
    rng = np.random.default_rng(seed)
    corners = rng.normal(size=(60, 3))
    corners *= 20.0 / np.linalg.norm(corners, axis=1, keepdims=True)
    whole = trimesh.convex.convex_hull(corners)
    parts = [np.asarray(whole.triangles)]
    for axis, at in enumerate(rng.uniform(-9.0, 9.0, 3).tolist()):
        parts = [_clip(part, axis, at, side) for part in parts for side in (-1.0, 1.0)]
    volume = sum(ConvexHull(part.reshape(-1, 3)).volume for part in parts)
    assert volume == pytest.approx(float(whole.volume), rel=1e-9)


def test_a_sample_is_turned_first_and_then_shifted() -> None:
    mesh = trimesh.creation.box((2, 4, 6))
    (piece,) = convex_pieces(
        mesh,
        rotation=rotation_z(math.pi / 2) @ rotation_x(math.pi / 2),
        offset=(10, 0, 0),
    )
    lower, upper = piece.bounds()
    np.testing.assert_allclose(upper - lower, (6, 2, 4), atol=1e-9)
    np.testing.assert_allclose(0.5 * (lower + upper), (10, 0, 0), atol=1e-9)


def test_flat_and_bad_meshes() -> None:
    sheet = trimesh.Trimesh(
        [[0, 0, 0], [10, 0, 0], [0, 10, 0]], [[0, 1, 2]], process=False
    )
    (piece,) = convex_pieces(sheet)
    assert ConvexHull(piece.vertices).volume > 0
    with pytest.raises(GeometryError, match="0 faces"):
        convex_pieces(trimesh.Trimesh())
    broken = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, math.nan, 0]], [[0, 1, 2]], process=False
    )
    with pytest.raises(GeometryError, match="finite"):
        convex_pieces(broken)


# The scanner's guard ----------------------------------------------------------------------------


def scanner(sample: object = LEGO) -> ScannerTwin:
    return ScannerTwin(M, P, guard=SceneGuard(build_scene(M, P, [sample])))  # type: ignore[list-item]


def test_a_move_into_the_detector_halts_free_and_blocks_the_third_time() -> None:
    s, scene = scanner(), build_scene(M, P, [LEGO])
    now = 0.0
    for attempt in (1, 2, 3):
        with pytest.raises(
            CollisionError, match=f"blocked attempt {attempt} of 3"
        ) as error:
            s.move({"mag_det": 500.0}, now)
        assert error.value.data["pair"] == ["sample_base", "detector_platform"]
        now = s.rest_time(now)
        assert touching(scene, s.positions(now)) == []
    # Base ends 100 mm behind the axis, the platform begins 20 mm behind the panel; 1 mm stays
    # free.
    halted = s.positions(now)["mag_det"] + P.c_det + 20.0 - (600.0 + P.c_obj + 100.0)
    assert 1.0 <= halted <= 1.05
    assert s.safety.state == "blocked"
    s.reset(99.0)
    s.move({"mag_det": 1059.0}, now)  # away from the contact
    assert s.targets(now)["mag_det"] == 1059.0


def test_several_motors_and_a_retarget_in_flight_stay_free() -> None:
    s, scene = scanner(), build_scene(M, P, [LEGO])
    s.move({"mag_obj": 900.0, "tra_obj": 50.0}, 0.0)
    with pytest.raises(CollisionError):
        s.move({"mag_det": 300.0, "rot_obj": 90.0}, 3.0)
    end = s.rest_time(3.0)
    result = sweep(scene, s.trajectories(3.0), 3.0, end)
    assert result.contact is None
    assert result.min_clearance_mm < 20.0  # it went as far as it could


def test_a_jog_stops_short_of_contact() -> None:
    s, scene = scanner(), build_scene(M, P, [LEGO])
    s.jog("mag_det", -50.0, 60.0, 0.0)
    end = s.rest_time(0.0)
    assert touching(scene, s.positions(end)) == []
    assert 1.0 <= clearance(scene, s.positions(end)).mm < 1.5


def test_a_guard_at_rest_tells_what_touches_already() -> None:
    free = SceneGuard(build_scene(M, P, [LEGO]))
    rest = {n: motion.at_rest(a.home) for n, a in M.axes.items()}
    assert free(rest, 5.0) is None
    huge = SceneGuard(build_scene(M, P, [box((1000, 1000, 20))]))
    contact = huge(rest, 5.0)
    assert contact is not None
    assert "sample" in contact.pair
    assert contact.time == contact.last_free_time == 5.0


def test_what_overlaps_already_may_come_apart_and_nothing_else() -> None:
    """A sample placed so that it stands in the detector tower: only a retreat gets it out."""
    long = box((40.0, 500.0, 40.0))
    s = ScannerTwin(M, P, guard=SceneGuard(build_scene(M, P, [long])))
    s.guard, guard = None, s.guard
    s.move({"mag_obj": 400.0, "mag_det": 560.0, "ver_tube": 100.0}, 0.0)
    now = s.rest_time(0.0)
    s.initialise_stage(Sample("long"), None, guard, now)
    scene = build_scene(M, P, [long])
    stuck = touching(scene, s.positions(now))
    assert ("detector_tower", "sample") in [pair for pair, _ in stuck]
    assert stuck[0][1] == 0.0
    with pytest.raises(CollisionError):
        s.move({"mag_det": 550.0}, now)  # deeper
    s.reset(now)
    assert s.state(now).safety.state == "blocked"  # a reset does not end a contact
    with pytest.raises(CollisionError):
        s.move({"mag_det": 100.0}, now)  # through it and out on the other side
    assert s.move({"mag_det": 900.0}, now)["mag_det"] > 0.0
    now = s.rest_time(now)
    assert touching(scene, s.positions(now)) == []
    with pytest.raises(SafetyError, match="have come apart"):
        s.move({"mag_det": 800.0}, now)
    s.reset(now)
    assert s.state(now).safety.state == "ready"
    with pytest.raises(CollisionError):  # once free, the margin holds again
        s.move({"mag_det": 560.0}, now)


# Reports ----------------------------------------------------------------------------------------


def script(*moves: str) -> str:
    lines = ["scanner\tpause\t0.0\t\tACK\t\t"]
    for move in moves:
        axis, target, wait = (*move.split(), "ACK")[:3]
        lines.append(f"{axis}\tmove absolute\t{target}\t\t{wait.replace('_', ' ')}\t\t")
    return "\r\n".join(lines) + "\r\n"


def test_every_collision_of_a_script_with_its_line_and_time() -> None:
    text = script(
        "mag_det 500", "mag_det 900", "tra_obj 100", "mag_obj 900", "mag_obj 600"
    )
    plan = plan_script(parse_script(text), M, P)
    found = collision_check([LEGO])(plan, M, P, None)
    assert {(c.line, *sorted(c.pair)) for c in found.collisions} >= {
        (2, "detector_platform", "sample_base"),
        (2, "detector", "sample"),
        (5, "detector_platform", "sample_base"),
    }
    # The panel has gone through the sample by then, so the way back (line 3) meets it again.
    assert {c.line for c in found.collisions} == {2, 3, 5}
    first = found.collisions[0]
    scene = build_scene(M, P, [LEGO])
    path = {n: float(x[0]) for n, x in plan.positions(np.array([first.time_s])).items()}
    assert clearance(scene, path).mm == pytest.approx(1.0, abs=0.011)
    assert touching(scene, first.last_free) == []
    assert found.min_clearance_mm == pytest.approx(1.0, abs=0.011)
    times = [t for t, _ in found.trace]
    assert times == sorted(times)
    assert min(mm for _, mm in found.trace) == 0.0
    report = check_script(text, M, P, collision=collision_check([LEGO]))
    assert not report.ok
    assert {p.line for p in report.problems if p.code == "collision"} == {2, 3, 5}


@pytest.mark.parametrize("other", ["rot_obj 3600", "ver_tube 320"])
def test_the_line_of_a_collision_is_the_one_that_moves_its_parts(other: str) -> None:
    """Turntable and tube are under way then too, and do not move base, holder and panel."""
    slow = "".join(
        f"{axis}\tset speed\t3\t\tACK\t\t\r\n" for axis in ("mag_obj", "ver_tube")
    )
    text = slow + script("mag_det 700", "mag_obj 500", "mag_obj 690 no_wait", other)
    found = collision_check()(
        plan_script(parse_script(text), M, P), M, P, None
    ).collisions
    assert found
    assert {c.line for c in found} == {6}, found
    report = check_script(text, M, P, collision=collision_check())
    assert "relative motion" not in report.text


def test_moves_without_wait_are_swept_together() -> None:
    """Alone each is free; together they meet because they start together."""
    apart = script("mag_obj 300", "mag_det 500")
    together = script("mag_obj 300 no_wait", "mag_det 500 ACK", "mag_obj 300")
    slow = together.replace(
        "scanner\t", "mag_obj\tset speed\t5.0\t\tACK\t\t\r\nscanner\t"
    )
    check = collision_check([LEGO])
    for text, count in ((apart, 0), (together, 0), (slow, 1)):
        plan = plan_script(parse_script(text), M, P)
        pairs = {c.pair for c in check(plan, M, P, None).collisions}
        assert bool(pairs) == bool(count), text


def test_least_clearance_of_a_free_script_is_that_of_dense_sampling() -> None:
    text = script(
        "mag_obj 300", "mag_det 440", "rot_obj 360", "tra_obj 150", "tra_obj -100"
    )
    plan = plan_script(parse_script(text), M, P)
    found = collision_check([BAR])(plan, M, P, None)
    assert found.collisions == ()
    scene = build_scene(M, P, [BAR])
    times = np.linspace(0.0, plan.duration_s, 3000)
    at = plan.positions(times)
    dense = min(
        clearance(scene, {n: float(x[i]) for n, x in at.items()}).mm
        for i in range(len(times))
    )
    assert found.min_clearance_mm is not None
    assert dense - 1e-2 <= found.min_clearance_mm <= dense + max(0.1, 0.02 * dense)


def test_the_stated_size_stands_in_for_a_mesh() -> None:
    text = script("mag_det 780")
    plan = plan_script(parse_script(text), M, P)
    check = collision_check()
    assert check(plan, M, P, None).collisions == ()
    wide = check(plan, M, P, SampleSize(420.0, 30.0))
    assert {c.pair for c in wide.collisions} >= {("detector", "sample")}
    unknown_height = check(plan, M, P, SampleSize(420.0))
    assert unknown_height.collisions


def test_the_sample_of_a_stated_size_is_about_its_origin() -> None:
    for size, height in ((SampleSize(12.0, 30.0), 30.0), (SampleSize(12.0), 12.0)):
        [solid] = _from_size(size)
        half = np.array([6.0, 6.0, height / 2.0])
        np.testing.assert_allclose(solid.bounds(), (-half, half))


def test_a_sample_that_is_only_shifted_is_where_it_was_shifted_to() -> None:
    """A cylinder is exact where it stays, and a prism around it where it goes."""
    [solid] = _from_size(SampleSize(12.0, 30.0))
    assert _placed(solid, np.eye(3), np.zeros(3)) is solid
    shift = np.array([3.0, -7.0, 11.0])
    before, after = solid.bounds(), _placed(solid, np.eye(3), shift).bounds()
    np.testing.assert_allclose(after, np.array(before) - shift, atol=0.05)


def test_a_size_of_nothing_is_no_sample() -> None:
    text = script("mag_det 780")
    plan = plan_script(parse_script(text), M, P)
    check = collision_check()
    empty = check(plan, M, P, None)
    for height in (0.0, 30.0, 5000.0):
        assert check(plan, M, P, SampleSize(0.0, height)) == empty


def test_the_trace_of_a_script_that_does_not_move_is_its_beginning_and_end() -> None:
    still = "scanner\tpause\t5000.0\t\tACK\t\t\r\n"
    plan = plan_script(parse_script(still), M, P)
    found = collision_check([LEGO])(plan, M, P, None)
    assert [t for t, _ in found.trace] == [0.0, plan.duration_s]
    assert found.trace[0][1] == found.trace[1][1] > 1.0
    moved = plan_script(parse_script(still + script("mag_det 900", "tra_obj 30")), M, P)
    times = [t for t, _ in collision_check([LEGO])(moved, M, P, None).trace]
    assert (times[0], times[-1]) == (0.0, moved.duration_s)
    assert 110 <= len(times) <= 120
    moving = [s for s in moved.steps if s.command.line in (3, 4)]
    along = [
        t for t in times for s in moving if s.start_s <= t <= s.start_s + s.duration_s
    ]
    shares = [s.duration_s / moved.duration_s for s in moving]
    assert len(along) >= 60 + 55 * sum(
        shares
    )  # half of them follow the way, half the time


def test_a_machine_without_components_has_nothing_to_touch() -> None:
    bare = M.model_copy(update={"components": (), "allowed_contacts": ()})
    plan = plan_script(parse_script(script("mag_det 500")), bare, P)
    found = collision_check([LEGO])(plan, bare, P, None)
    assert (found.collisions, found.min_clearance_mm, found.trace) == ((), None, ())


def test_a_scan_of_1440_steps_is_swept_step_by_step() -> None:
    """A bar that clears the panel at 0 and hits it on the way round, found at its step."""
    lines = ["scanner\tpause\t0.0\t\tACK\t\t", "mag_det\tmove absolute\t715.0\t\tACK\t\t"]
    for i in range(1440):
        lines.append(f"rot_obj\tmove absolute\t{0.25 * i:.2f}\t\tACK\t\t")
    plan = plan_script(parse_script("\r\n".join(lines) + "\r\n"), M, P)
    found = collision_check([BAR])(plan, M, P, None)
    panel = [c for c in found.collisions if set(c.pair) == {"detector", "sample"}]
    # The panel's face is 140.08 mm from the axis; a corner of the bar comes to 139.08 mm.
    reach = math.hypot(150, 10)
    angle = math.degrees(math.asin((715 + P.c_det - 600 - P.c_obj - 1) / reach))
    angle -= math.degrees(math.atan2(10, 150))
    assert panel[0].line == 3 + math.ceil(angle / 0.25)
    assert len(panel) == 2  # once on each half turn
    assert panel[0].last_free["rot_obj"] == pytest.approx(angle, abs=0.04)


def test_a_pair_that_comes_free_for_a_moment_counts_anew() -> None:
    """At cruise through the panel and out, then into it again while braking: two contacts."""
    plan = plan_script(parse_script(script("mag_det 715", "rot_obj 275")), M, P)
    found = collision_check([BAR])(plan, M, P, None)
    reach = math.hypot(150, 10)
    first = math.degrees(math.asin((715 + P.c_det - 600 - P.c_obj - 1) / reach))
    first -= math.degrees(math.atan2(10, 150))
    panel = [c for c in found.collisions if set(c.pair) == {"detector", "sample"}]
    turns = [c.last_free["rot_obj"] for c in panel]
    assert turns == [
        pytest.approx(first, abs=0.04),
        pytest.approx(first + 180.0, abs=0.04),
    ]


# Planning ---------------------------------------------------------------------------------------


def walk(scene: object, start: dict[str, float], moves: list[dict[str, float]],
         paces: dict[str, tuple[float, float]]) -> dict[str, float]:  # fmt: skip
    """Execute moves one after the other; every one must be free."""
    at = {n: start.get(n, a.home) for n, a in M.axes.items()}
    for step in moves:
        trajectories = {
            n: motion.move(at[n], 0.0, step.get(n, at[n]),
                           *paces.get(n, (a.speed, a.acceleration)), 0.0)
            for n, a in M.axes.items()
        }  # fmt: skip
        result = sweep(
            scene, trajectories, 0.0, max(t.end for t in trajectories.values())
        )  # type: ignore[arg-type]
        assert result.contact is None
        at |= step
    return at


@pytest.mark.parametrize(
    ("sample", "start", "targets", "paces"),
    [
        (LEGO, {}, {"mag_obj": 700.0}, {}),
        (LEGO, {"mag_obj": 600.0, "mag_det": 700.0}, {"mag_obj": 300.0, "mag_det": 400.0},
         {"mag_obj": (5.0, 50.0)}),
        (BAR, {"mag_obj": 600.0, "mag_det": 700.0}, {"rot_obj": 180.0}, {}),
        (BAR, {"mag_obj": 105.0, "ver_tube": 20.0}, {"rot_obj": 180.0}, {}),
        (BAR, {"mag_obj": 105.0, "rot_obj": 90.0, "ver_tube": 20.0, "tra_tube": -300.0},
         {"tra_tube": 300.0}, {}),
    ],
    ids=["direct", "other order", "retreat to turn", "lower the source", "under the bar"],
)  # fmt: skip
def test_a_free_way_is_found_and_is_free(sample, start, targets, paces) -> None:
    scene = build_scene(M, P, [sample])
    moves, blocked = free_moves(scene, M, start, targets, paces)
    assert moves is not None
    assert (len(moves) == 1) == (blocked is None)
    end = walk(scene, start, moves, paces)
    expected = {n: start.get(n, a.home) for n, a in M.axes.items()} | targets
    assert end == expected
    for step in moves:
        for axis, value in step.items():
            assert M.axes[axis].lower <= value <= M.axes[axis].upper


def test_no_way_where_there_is_none() -> None:
    scene = build_scene(M, P, [LEGO])
    # The detector cannot jump over the sample, nor stand inside it.
    moves, blocked = free_moves(scene, M, {"mag_obj": 600.0, "mag_det": 700.0},
                                {"mag_obj": 900.0, "mag_det": 300.0})  # fmt: skip
    assert moves is None
    assert blocked is not None
    assert free_moves(scene, M, {}, {"mag_det": 570.0})[0] is None
    assert free_moves(scene, M, {}, {"mag_obj": 600.0}) == ([], None)


def test_an_excursion_is_shortened_by_halves_where_nothing_is_in_the_way() -> None:
    search = _Planner(build_scene(M, P), M, {"mag_det": 700.0}, {})
    way = [("mag_det", 900.0), ("tra_det", 8.0), ("mag_det", 700.0)]
    shorter = [("mag_det", 712.5), ("tra_det", 8.0), ("mag_det", 700.0)]
    assert search.shortened(way, {"tra_det": 8.0}) == shorter


@pytest.mark.parametrize(
    ("blocker", "motors"),
    [("main_platform", set()), ("source_tower", {"tra_tube"}), ("detector_tower", {"mag_det"}),
     ("xray_source", {"tra_tube", "ver_tube"}), ("sample_base", {"mag_obj", "tra_obj"}),
     ("sample_holder", {"mag_obj", "tra_obj", "rot_obj"})],
)  # fmt: skip
def test_a_detour_stops_motors_that_carry_what_was_in_the_way(
    blocker: str, motors: set[str]
) -> None:
    search = _Planner(build_scene(M, P, [LEGO]), M, {}, {}, blockers={blocker: None})
    assert set(search.stations({})) == motors
    found = search.stations({"ver_det": 5.0})
    assert set(found) == motors | {"ver_det"}
    assert 5.0 in found["ver_det"]


def random_script(rng: np.random.Generator) -> str:
    lines = ["scanner\tpause\t100\t\tACK\t\t"]
    for _ in range(rng.integers(1, 14)):
        axis = str(rng.choice([*M.axes, "ver_obj"]))
        if rng.random() < 0.15:
            lines.append(f"{axis}\tset speed\t{rng.uniform(1, 45):.3f}\t\tACK\t\t")
            continue
        low, high = (
            (M.axes[axis].lower, M.axes[axis].upper) if axis in M.axes else (100, 300)
        )
        low, high = (-400, 800) if axis == "rot_obj" else (low, high)
        wait = str(rng.choice(["ACK", "no wait", "no wait", "POS"]))
        trigger = f"{rng.uniform(low, high):.3f}" if wait == "POS" else ""
        lines.append(
            f"{axis}\tmove absolute\t{rng.uniform(low, high):.4f}\t{trigger}\t{wait}\t\t"
        )
    return "\r\n".join(lines) + "\r\n"


@pytest.mark.parametrize("seed", range(40))
@pytest.mark.daily(26)
def test_random_scripts_against_dense_sampling(seed: int) -> None:
    """Whatever starts while what else still runs: no pose of a passed plan is within the
    margin."""
    plan = plan_script(parse_script(random_script(np.random.default_rng(seed))), M, P)
    sample = box((60, 40, 50))
    found = collision_check([sample])(plan, M, P, None)
    scene = build_scene(M, P, [sample])
    times = np.linspace(0.0, plan.duration_s, 150)
    at = plan.positions(times)
    dense = min(
        clearance(scene, {n: float(x[i]) for n, x in at.items()}).mm
        for i in range(len(times))
    )
    if dense < M.safety_margin_mm - 1e-6:
        assert found.collisions
    if not found.collisions:
        assert (
            found.min_clearance_mm is None or found.min_clearance_mm >= M.safety_margin_mm
        )
    for contact in found.collisions:
        (step,) = (s for s in plan.steps if s.line == contact.line)
        assert isinstance(step.command, MoveAbsolute)
        assert step.start_s <= contact.time_s <= step.start_s + step.duration_s + 1e-9
