"""Sweeps against hand computation: exact contact times, thin walls, grazing, turns, halts."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.optimize import lsq_linear
from scipy.spatial import ConvexHull
from swept import sweep

from flexdt.twin.collision.collision_scene import CollisionScene, build_scene, scene_of
from flexdt.twin.collision.convex_solids import (
    ConvexSolid,
    Polytope,
    UprightCylinder,
    box,
    hull,
)
from flexdt.twin.collision.first_contact import (
    SweepResult,
    clearance,
    clearance_trace,
    first_contact,
)
from flexdt.twin.collision.guard import SceneGuard
from flexdt.twin.collision.plan_report import _trace_times
from flexdt.twin.collision.relative import (
    Limits,
    Moment,
    Path,
    RelativeMotion,
    _Bound,
    path_of,
    refine_pair,
    sweep_pair,
)
from flexdt.twin.collision.retreat import _Overlap
from flexdt.twin.collision.separation import separation_of
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray, rotation_about
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.motion import profiles as motion
from flexdt.twin.motion.profiles import AxisPath, Piece, Trajectory, at_rest

AXES = ("x", "y", "turn")
MARGIN, TOLERANCE = 1.0, 0.01
KEPT = 0.0049
"""What is free keeps so much more than the margin: one rung of the floors less rounding
[mm]."""
RUNG = 0.0052
"""What all that is accepted may take from a gap within the margin [mm]."""


def one_against(
    moving: ConvexSolid,
    fixed: Sequence[ConvexSolid],
    *,
    spin: Sequence[float] = (0.0, 0.0, 1.0),
    margin: float = MARGIN,
) -> CollisionScene:
    """`moving` on x, y and turn (right-handed about `spin`); `fixed` around it."""
    slides = np.array([[1.0, 0, 0], [0, 1.0, 0], [0, 0, 0]])
    turns = np.array([0.0, 0.0, math.radians(1.0)])
    carried = Body(
        "thing", moving, np.zeros(3), slides, turns, "thing", "object", np.array(spin)
    )
    still = [
        Body(f"wall {i}", s, np.zeros(3), np.zeros((3, 3)), np.zeros(3), "", "detector")
        for i, s in enumerate(fixed)
    ]
    return scene_of(
        AXES,
        [carried, *still],
        (),
        reach=np.tile([-1e6, 1e6], (3, 1)),
        home=np.zeros(3),
        limits=Limits(margin, TOLERANCE, (0.1, 0.02)),
    )


def go(scene: CollisionScene, targets: Mapping[str, float],
       start: Mapping[str, float] | None = None, speed: float = 50.0) -> SweepResult:  # fmt: skip
    begin = start or {}
    trajectories = {
        n: motion.move(
            begin.get(n, 0.0), 0.0, targets.get(n, begin.get(n, 0.0)), speed, 50.0, 0.0
        )
        for n in AXES
    }
    return sweep(scene, trajectories, 0.0, max(t.end for t in trajectories.values()))


@pytest.mark.parametrize("thickness", [0.1, 1e-3, 1e-6, 10.0])
def test_a_wall_of_any_thickness_stops_the_box_at_the_margin(thickness: float) -> None:
    """A 100 mm box, 600 mm on: the wall's face at 300 mm is reached 249 mm on, at cruise."""
    scene = one_against(
        box((100, 100, 100)), [box((thickness, 400, 400), (300 + thickness / 2, 0, 0))]
    )
    result = go(scene, {"x": 600.0})
    assert result.contact is not None
    # 1 s to cruise over 25 mm, the other 224 mm at 50 mm/s.
    assert result.contact.time == pytest.approx(1.0 + (224.0 - KEPT) / 50.0, abs=1e-9)
    assert result.contact.positions["x"] == pytest.approx(249.0 - KEPT, abs=1e-6)
    assert result.contact.last_free["x"] == pytest.approx(249.0 - 2 * TOLERANCE, abs=1e-6)
    assert result.contact.pair == ("thing", "wall 0")
    assert result.min_clearance_mm == pytest.approx(1.0 + KEPT, abs=1e-6)
    assert result.looks <= 3


def test_contact_during_speeding_up_and_braking() -> None:
    """The margin is reached after 16 mm (0.8 s at 50 mm/s2), and 16 mm before the end."""
    near = one_against(box((2, 2, 2)), [box((1, 9, 9), (18.5 + KEPT, 0, 0))])
    result = go(near, {"x": 100.0})
    assert result.contact is not None
    assert result.contact.time == pytest.approx(0.8, abs=1e-9)
    far = one_against(box((2, 2, 2)), [box((1, 9, 9), (86.5 + KEPT, 0, 0))])
    result = go(far, {"x": 100.0})
    assert result.contact is not None
    assert result.contact.time == pytest.approx(
        3.0 - 0.8, abs=1e-9
    )  # 84 of 100 mm in 3 s
    assert result.contact.positions["x"] == pytest.approx(84.0, abs=1e-6)


@pytest.mark.parametrize("gap", [1.0101, 1.02, 1.5, 5.0])
def test_grazing_costs_hardly_anything_and_is_free(gap: float) -> None:
    scene = one_against(box((100, 100, 100)), [box((2000, 10, 400), (0, 55 + gap, 0))])
    result = go(scene, {"x": 1000.0})
    assert result.contact is None
    assert result.min_clearance_mm == pytest.approx(gap, abs=1e-9)
    assert result.looks <= 4


def test_passing_by_finds_the_least_clearance_in_the_middle() -> None:
    """A cube passes a cube's edge: nearest in mid-way, 7 mm apart along y."""
    scene = one_against(box((10, 10, 10)), [box((10, 10, 10), (500, 17, 0))])
    result = go(scene, {"x": 1000.0})
    assert result.contact is None
    assert 7.0 <= result.min_clearance_mm <= 7.0 + 0.14


def test_two_motors_at_once_meet_only_because_of_their_timing() -> None:
    """Along x then y the corner is cut; the sweep follows the real paths, not their ends."""
    post = [UprightCylinder((60.0, 60.0, 0.0), 5.0, 50.0)]
    scene = one_against(box((10, 10, 10)), post)
    together = go(scene, {"x": 120.0, "y": 120.0})
    assert together.contact is not None
    for first, second in (("x", "y"), ("y", "x")):
        half = {first: 120.0}
        assert go(scene, half).contact is None
        assert go(scene, {**half, second: 120.0}, half).contact is None
    # By hand: corner (p+5, p+5) to the post's centre, sqrt(2) (55 - p) = 5 + 1.
    assert together.contact.positions["x"] == pytest.approx(
        55 - 6 / math.sqrt(2), abs=0.02
    )


def test_a_turning_bar_meets_a_wall_at_the_angle_of_trigonometry() -> None:
    """Half length 150, half width 5, wall at 100 mm: its corner comes to 99 mm from the
    axis."""
    bar, wall = box((300, 10, 10)), box((500, 1, 50), (0, 100.5, 0))
    scene = one_against(bar, [wall])
    result = go(scene, {"turn": 720.0}, speed=45.0)
    assert result.contact is not None
    corner = math.hypot(150, 5)
    expected = math.degrees(math.asin(99.0 / corner) - math.atan2(5, 150))
    angle = result.contact.positions["turn"]
    # Within the tolerance of the clearance, at the corner's speed towards the wall.
    assert expected - math.degrees(TOLERANCE / (corner * math.cos(math.asin(99 / corner)))) - 1e-6 \
        <= angle <= expected + 1e-6  # fmt: skip
    assert result.contact.last_free["turn"] < angle
    free = one_against(bar, [box((500, 1, 50), (0, corner + 1.6, 0))])
    assert go(free, {"turn": 720.0}, speed=45.0).contact is None


def test_a_cylinder_turns_on_the_spot() -> None:
    scene = one_against(
        UprightCylinder((0, 0, 0), 50.0, 20.0), [box((10, 100, 100), (56.2, 0, 0))]
    )
    result = go(scene, {"turn": 7200.0}, speed=90.0)
    assert result.contact is None
    assert result.looks <= 3


def test_turning_close_to_a_wall_stays_affordable() -> None:
    """A 24-cornered drum with 1.02 mm to spare, ten turns."""
    angles = np.radians(np.arange(24) * 15.0)
    rim = np.stack([40 * np.cos(angles), 40 * np.sin(angles)], axis=1)
    drum = hull(np.concatenate([np.c_[rim, np.full(24, z)] for z in (-10.0, 10.0)]))
    scene = one_against(drum, [box((10, 100, 100), (46.02, 0, 0))])
    result = go(scene, {"turn": 3600.0}, speed=45.0)
    assert result.contact is None
    assert result.min_clearance_mm == pytest.approx(1.02, abs=0.1)
    assert result.looks < 3000


def test_after_a_halt_the_motion_may_go_back_but_not_on() -> None:
    scene = one_against(box((100, 100, 100)), [box((1, 400, 400), (300.5, 0, 0))])
    first = go(scene, {"x": 600.0})
    assert first.contact is not None
    for halted in (first.contact.last_free, first.contact.positions):
        assert go(scene, {"x": 0.0}, halted).contact is None
        assert go(scene, {"x": 600.0}, halted).contact is not None
        assert go(scene, {"y": 150.0}, halted).contact is None
    position = first.contact.last_free["x"]
    for _ in range(10):  # repeated attempts do not creep
        again = go(scene, {"x": 600.0}, {"x": position})
        assert again.contact is not None
        position = again.contact.last_free["x"]
    assert position == pytest.approx(first.contact.last_free["x"], abs=1e-6)


def test_within_the_margin_only_away() -> None:
    """A sample put on the stage 0.4 mm from a wall may leave, turn away, not come nearer."""
    scene = one_against(box((20, 20, 20)), [box((1, 100, 100), (10.9, 0, 0))])
    assert clearance(scene, {}).mm == pytest.approx(0.4, abs=1e-9)
    assert go(scene, {"x": -50.0}).contact is None
    assert go(scene, {"y": 30.0}).contact is None
    nearer = go(scene, {"x": 0.3})
    assert nearer.contact is not None
    assert nearer.contact.positions["x"] < 0.01
    turned = go(scene, {"turn": 45.0})  # a corner comes out
    assert turned.contact is not None


def test_overlapping_at_the_start_is_a_contact_at_once() -> None:
    scene = one_against(box((20, 20, 20)), [box((20, 20, 20), (5, 0, 0))])
    result = go(scene, {"x": -100.0})
    assert result.contact is not None
    assert result.contact.time == 0.0
    assert not result.contact.free_before


def test_a_solid_inside_a_solid_is_a_contact() -> None:
    """A mesh inside a mesh has a distance; a convex body inside another has none."""
    scene = one_against(box((10, 10, 10)), [box((100, 100, 100))])
    assert clearance(scene, {}).mm == 0.0


def test_margin_zero_stops_at_touching() -> None:
    scene = one_against(box((10, 10, 10)), [box((10, 10, 10), (60, 0, 0))], margin=0.0)
    result = go(scene, {"x": 100.0})
    assert result.contact is not None
    assert 50.0 - TOLERANCE <= result.contact.positions["x"] <= 50.0 + 1e-9


def test_the_first_of_several_contacts_counts() -> None:
    walls = [box((1, 50, 50), (x, 0, 0)) for x in (300.0, 100.0, 200.0)]
    result = go(one_against(box((10, 10, 10)), walls), {"x": 600.0})
    assert result.contact is not None
    assert result.contact.pair == ("thing", "wall 1")


def test_a_path_that_turns_round_in_mid_piece_is_cut_there() -> None:
    """One piece of constant acceleration that goes out 25 mm and comes back."""
    thrown = Trajectory((Piece(0.0, 0.0, 50.0, -50.0),), 2.0, 0.0)
    path = path_of(("x",), {"x": AxisPath.along(thrown)}, 0.0, 2.0)
    assert path.times.tolist() == [0.0, 1.0, 2.0]
    scene = one_against(box((10, 10, 10)), [box((1, 50, 50), (30.5, 0, 0))])
    for top, expected in ((25.0, True), (23.5, False)):
        v = math.sqrt(2 * 50.0 * top)
        t = Trajectory((Piece(0.0, 0.0, v, -50.0),), 2 * v / 50.0, 0.0)
        assert (sweep(scene, {"x": t}, 0.0, t.end).contact is not None) is expected


def test_a_motor_that_jumps_is_refused() -> None:
    jump = Trajectory(
        (Piece(0.0, 0.0, 10.0, 0.0), Piece(1.0, 50.0, 10.0, 0.0)), 2.0, 60.0
    )
    with pytest.raises(ValueError, match="x jumps from 10 to 50 at 1 s"):
        path_of(("x",), {"x": AxisPath.along(jump)}, 0.0, 2.0)
    rests = Trajectory((Piece(0.0, 0.0, 0.0, 0.0), Piece(1.0, 5.0, 0.0, 0.0)), 2.0, 5.0)
    with pytest.raises(ValueError, match="jumps from 0 to 5"):
        path_of(("x",), {"x": AxisPath.along(rests)}, 0.0, 2.0)


def test_pauses_cost_nothing() -> None:
    """Two moves with an hour between, as one path."""
    out, back = (
        motion.move(a, 0.0, b, 50.0, 50.0, s) for a, b, s in ((0, 90, 0), (90, 0, 3600))
    )
    both = Trajectory(
        (*out.pieces, Piece(out.end, 90.0, 0.0, 0.0), *back.pieces), back.end, 0.0
    )
    scene = one_against(box((10, 10, 10)), [box((1, 50, 50), (120, 0, 0))])
    result = sweep(scene, {"x": both}, 0.0, both.end)
    assert result.contact is None
    assert result.min_clearance_mm == pytest.approx(120 - 0.5 - 95, abs=1e-9)
    assert result.looks < 8
    path = scene.path({"x": both}, 0.0, both.end)
    trace = clearance_trace(scene, path, np.linspace(0.0, both.end, 5))
    assert [round(mm, 9) for _, mm, _ in trace][1:4] == [24.5, 24.5, 24.5]


# Certificates -----------------------------------------------------------------------------------


def solid_points(solid: ConvexSolid) -> FloatArray:
    """Points whose hull is (for a cylinder: lies inside) the solid."""
    if isinstance(solid, Polytope):
        return solid.vertices
    assert isinstance(solid, UprightCylinder)
    a = np.linspace(0, 2 * math.pi, 48)
    rim = np.stack([solid.radius * np.cos(a), solid.radius * np.sin(a)], axis=1)
    ends = [np.c_[rim, np.full(48, z)] for z in (-solid.height / 2, solid.height / 2)]
    return np.concatenate(ends) + np.array(solid.center)


def true_distance(a: FloatArray, b: FloatArray) -> float:
    """Distance of two hulls of points, by least squares with bounds.

    The nearest point to the origin of the hull of all differences d_i: minimise
    |sum w_i d_i|^2 + (1 - sum w_i)^2 over w >= 0; its w, divided by its sum, is that point's.
    Where several corners are equally near, scipy 1.17's `nnls` may end millimetres before it.
    """
    differences = (a[:, None] - b[None, :]).reshape(-1, 3)
    scale = float(np.abs(differences).max())
    system = np.concatenate([differences.T / scale, np.ones((1, len(differences)))])
    rhs = np.array([0.0, 0.0, 0.0, 1.0])
    weights = lsq_linear(system, rhs, (0.0, np.inf), method="bvls", tol=1e-15).x
    return float(np.linalg.norm(weights @ differences) / weights.sum())


def random_solid(rng: np.random.Generator) -> ConvexSolid:
    kind = rng.integers(3)
    if kind == 0:
        return box(rng.uniform(0.1, 40, 3), rng.uniform(-20, 20, 3))
    if kind == 1:
        return hull(rng.normal(size=(rng.integers(4, 12), 3)) * rng.uniform(1, 20, 3))
    return UprightCylinder(
        (0.0, 0.0, float(rng.uniform(-9, 9))), rng.uniform(1, 20), rng.uniform(1, 30)
    )


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_certified_clearance_is_the_distance_and_never_more(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_solid(rng), random_solid(rng)
    turns = [rotation_about(rng.normal(size=3), rng.uniform(0, 6)) for _ in range(2)]
    offset = rng.normal(size=3) * 50.0
    gap, normal = separation_of(a, b)(offset, *turns)
    points_a = solid_points(a) @ turns[0].T + offset
    points_b = solid_points(b) @ turns[1].T
    distance = true_distance(points_a, points_b)
    # The 47-gon lies up to r (1 - cos(pi / 47)) inside a cylinder's rim.
    polygon = 0.0023 * sum(s.radius for s in (a, b) if isinstance(s, UprightCylinder))
    assert gap <= distance + 1e-5
    assert gap >= distance - polygon - 2e-5
    if gap > 0:
        # The certificate itself: a slab of that width without points, whatever fcl thinks.
        assert (points_a @ normal).min() - (points_b @ normal).max() >= gap - 1e-9


@settings(max_examples=100, deadline=None)
@given(
    st.integers(0, 2**32 - 1), st.floats(0.01, 20.0), st.sampled_from([-1.0, 0.0, 1.0])
)
def test_a_turn_within_its_bound_never_comes_nearer(
    seed: int, allowance: float, sense: float
) -> None:
    rng = np.random.default_rng(seed)
    spin = rng.normal(size=3)
    spin /= np.linalg.norm(spin)
    solid = hull(rng.normal(size=(8, 3)) * 20 + rng.normal(size=3) * 20)
    body = Body(
        "b", solid, np.zeros(3), np.zeros((1, 3)), np.ones(1), "b", "object", spin
    )
    toward = rng.normal(size=3)
    toward /= np.linalg.norm(toward)
    turn = min(body.turn_until(toward, allowance, sense), 20.0)
    before = solid.support(toward)
    for share in np.linspace(-1 if sense == 0 else 0, 1, 41):
        turned = body.rotation((sense or 1.0) * share * turn)
        assert solid.support(toward @ turned) - before <= allowance * abs(share) + 1e-9


def test_bounds_of_many_pairs_are_lower_bounds() -> None:
    rng = np.random.default_rng(5)
    for _ in range(50):
        scene = one_against(random_solid(rng), [random_solid(rng) for _ in range(3)])
        ends = rng.uniform(-60, 60, (2, 3))
        lower, upper = ends.min(axis=0), ends.max(axis=0)
        bounds = scene.all.clearances(lower, upper)
        for _ in range(10):
            q = dict(zip(AXES, rng.uniform(lower, upper), strict=True))
            near = scene.vector(q)
            for pair, bound in zip(scene.all.pairs, bounds, strict=True):
                a, b = (scene.bodies[i] for i in pair)
                offset = near @ (a.slides - b.slides) + a.origin - b.origin
                turns = [x.rotation(float(near @ x.turns)) for x in (a, b)]
                assert bound <= scene.separation(pair)(offset, *turns)[0] + 2e-3


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.daily(2)
def test_a_turn_that_begins_the_other_way_meets_what_it_turns_into(seed: int) -> None:
    """What rounding leaves of the velocity where a motor turns round pointed the old way, and
    the rest of the turn counted as turning back: a contact was passed unseen."""
    rng = np.random.default_rng(seed)
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    scene = build_scene(machine, profile, [box((300.0, 20.0, 20.0))])
    missed = 0
    for _ in range(100):
        begin, velocity = 10.0 ** rng.uniform(-1.0, 8.5), rng.uniform(1.0, 40.0)
        stand = {n: motion.at_rest(a.home, begin) for n, a in machine.axes.items()}
        stand["mag_det"] = motion.at_rest(700.0, begin)
        turn = motion.jog(0.0, velocity, -45.0, 4.0, rng.uniform(20.0, 80.0), begin)
        tables = {n: AxisPath.along(t) for n, t in {**stand, "rot_obj": turn}.items()}
        contact = first_contact(scene, path_of(scene.axes, tables, begin, turn.end))
        missed += contact is None or not -60.0 < contact.positions["rot_obj"] < -45.0
    assert missed == 0


@pytest.mark.parametrize("gap", [0.00005, 0.0004, 0.0008])
def test_a_hair_s_breadth_before_touching_it_never_overlaps(gap: float) -> None:
    """Below the last floor the level to stop at is touching, not beyond it."""
    scene = one_against(box((20, 20, 20)), [box((1, 100, 100), (10.5 + gap, 0, 0))])
    nearer = go(scene, {"x": 0.3})
    assert nearer.contact is not None
    assert nearer.contact.positions["x"] <= gap + 1e-9
    assert go(scene, {"x": -30.0}).contact is None


def test_a_contact_s_clearance_is_never_reported_below_what_the_bound_proves() -> None:
    """A distance that comes out 0.004 mm short at the contact does not lower the least
    clearance: the bound from the look before proves the margin itself."""
    looks = []

    def short(
        offset: FloatArray, a: FloatArray | None, b: FloatArray | None
    ) -> tuple[float, FloatArray]:
        looks.append(offset)
        return -offset[0] - (0.004 if len(looks) > 1 else 0.0), np.array([-1.0, 0.0, 0.0])

    a, b = (
        Body(n, box((1, 1, 1)), np.zeros(3), s, np.zeros(1), n, "object")
        for n, s in (("a", np.array([[1.0, 0.0, 0.0]])), ("b", np.zeros((1, 3))))
    )
    move = motion.move(-50.0, 0.0, 0.0, 50.0, 50.0, 0.0)
    path = path_of(("x",), {"x": AxisPath.along(move)}, 0.0, move.end)
    result = sweep_pair(
        RelativeMotion(a, b, path), short, Limits(MARGIN, TOLERANCE, (0.1, 0.02))
    )
    assert result.contact is not None
    assert result.looks == 2
    assert result.least == pytest.approx(MARGIN + KEPT, abs=1e-9)
    assert float(looks[-1][0]) == pytest.approx(-MARGIN - KEPT, abs=1e-9)


@settings(max_examples=50, deadline=None)
@given(
    st.floats(-500.0, 500.0),
    st.floats(1.0, 15.0),
    st.floats(0.0, 1e4),
    st.floats(0.01, 0.99),
)
def test_what_is_left_of_a_path_ends_exactly_where_it_did(
    start: float, distance: float, time: float, share: float
) -> None:
    target = start + distance
    way = motion.move(start, 0.0, target, 7.0, 3.0, time)
    path = path_of(("x",), {"x": AxisPath.along(way)}, time, way.end)
    left = path.after(time + share * way.duration)
    there = left.vectors(np.array([way.end, way.end + 1.0]))
    assert there.tolist() == [path.q[-1].tolist()] * 2
    assert there[0, 0] == pytest.approx(target, abs=1e-6)


@settings(max_examples=50, deadline=None)
@given(st.floats(1e-3, 15.0), st.floats(0.1, 0.9), st.booleans())
def test_an_overlap_is_measured_where_that_is_asked(
    depth: float, gap: float, deep: bool
) -> None:
    scene = one_against(box((20, 20, 20)), [box((20, 200, 200), (60, 0, 0))])
    touching = SceneGuard(scene).touching
    pair = ("thing", "wall 0")
    assert touching({"x": 40.0 + depth}, deep=deep) == {
        pair: pytest.approx(-depth if deep else 0.0, abs=1e-6)
    }
    assert touching({"x": 40.0 - gap}, deep=deep) == {pair: pytest.approx(gap, abs=1e-3)}
    assert touching({"x": 38.0}, deep=deep) == {}


def drawn_motion(rng: np.random.Generator, reach: float) -> Trajectory:
    """To and fro within `reach`, faster or slower, retargeted on the way."""
    legs = [motion.at_rest(float(rng.uniform(-reach, reach)), 0.0)]
    for now in np.cumsum(rng.uniform(0.2, 2.0, 4)).tolist():
        last = legs[-1]
        target, speed = float(rng.uniform(-reach, reach)), float(rng.uniform(5.0, reach))
        at = last.position(now), last.velocity(now)
        legs.append(motion.move(*at, target, speed, float(rng.uniform(20.0, 90.0)), now))
    return motion.joined(legs)


@pytest.mark.daily(1)
@pytest.mark.parametrize("seed", range(24))
@pytest.mark.campaign(2)
def test_drawn_motions_against_distances_at_many_times(seed: int) -> None:
    """Where they touch first, and how near they come: least squares at 1200 times say the same.

    Of three motions one turns many times round, and one of those on the spot.
    """
    rng = np.random.default_rng(seed)
    # All at one height: a pair that a gap keeps apart wherever the motors go is not looked at.
    moving = box(rng.uniform(2, 12, 3), (*rng.uniform(-4, 4, 2), 0.0))
    ways = {name: drawn_motion(rng, 40.0) for name in AXES}
    quick = 40.0
    if seed % 3 == 0:
        quick = 1500.0
        ways["turn"] = drawn_motion(rng, quick)
    if seed % 6 == 0:
        ways |= {name: motion.at_rest(ways[name].target) for name in "xy"}

    def apart(time: float, walls: Sequence[Polytope]) -> float:
        x, y, turn = (ways[n].position(time) for n in AXES)
        c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
        points = moving.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        return min(true_distance(points + (x, y, 0.0), w.vertices) for w in walls)

    walls: list[Polytope] = []
    while len(walls) < 2:
        wall = box(rng.uniform(4, 20, 3), rng.normal(size=3) * (25.0, 25.0, 0.0))
        walls += [wall] if apart(0.0, [wall]) > 2 * MARGIN else []
    times = np.linspace(0.0, max(t.end for t in ways.values()), 1200)
    gaps = np.array([apart(time, walls) for time in times])
    fastest = (
        60.0 + math.radians(quick) * 12.0
    )  # two motors at 40 mm/s, and corners 12 mm out
    exact = Limits(MARGIN, TOLERANCE, (1e-3, 0.0))
    scene = dataclasses.replace(one_against(moving, walls), limits=exact)
    found = sweep(scene, ways, 0.0, times[-1])
    if found.contact is None:
        low = gaps.min() - fastest * (times[1] - times[0]) / 2
        assert gaps.min() >= MARGIN
        assert low - 1e-3 <= found.min_clearance_mm <= gaps.min() + 2e-3
    else:
        assert gaps[times <= found.contact.time].min() > MARGIN - 1e-3
        assert (
            MARGIN - 1e-3 <= apart(found.contact.time, walls) <= MARGIN + TOLERANCE + 1e-3
        )
        assert found.contact.last_free_time <= found.contact.time
        assert apart(found.contact.last_free_time, walls) >= MARGIN + TOLERANCE
        assert MARGIN <= found.min_clearance_mm <= MARGIN + TOLERANCE


def test_the_error_allowed_in_a_clearance_is_absolute_or_a_share_of_it() -> None:
    limits = Limits(MARGIN, TOLERANCE, (0.1, 0.02))
    assert [limits.slack(mm) for mm in (0.0, 2.0, 5.0, 50.0)] == [0.1, 0.1, 0.1, 1.0]


def centred_solid(rng: np.random.Generator) -> ConvexSolid:
    kind = rng.integers(3)
    if kind == 0:
        return box(rng.uniform(2, 40, 3))
    if kind == 1:
        corners = rng.normal(size=(rng.integers(5, 12), 3)) * rng.uniform(4, 20, 3)
        return hull(corners - corners.mean(axis=0))
    return UprightCylinder((0.0, 0.0, 0.0), rng.uniform(2, 20), rng.uniform(2, 30))


def signed_distance(a: FloatArray, b: FloatArray) -> float:
    """Distance of two hulls of points, or minus the least shift that parts them: how far the
    origin lies inside the hull of all differences."""
    differences = (a[:, None] - b[None, :]).reshape(-1, 3)
    inside = float(ConvexHull(differences).equations[:, 3].max())
    return inside if inside < 0.0 else true_distance(a, b)


@pytest.mark.daily(10)
@pytest.mark.parametrize("seed", range(40))
def test_depth_of_an_overlap_and_what_is_left_of_it_on_the_way_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = one_against(centred_solid(rng), [centred_solid(rng)])
    [pair] = scene.all.pairs
    a, b = (scene.bodies[i] for i in pair)
    polygon = 0.0023 * sum(
        s.solid.radius for s in (a, b) if isinstance(s.solid, UprightCylinder)
    )

    def truth(q: FloatArray) -> float:
        points = [solid_points(x.solid) @ x.rotation(float(q @ x.turns)).T + q @ x.slides
                  for x in (a, b)]  # fmt: skip
        return signed_distance(*points)

    begin = np.array([*rng.uniform(-3, 3, 2), rng.uniform(-400, 400)])
    assert truth(begin) < 0.0
    at = dict(zip(AXES, begin.tolist(), strict=True))
    [(names, depth)] = SceneGuard(scene).touching(at, deep=True).items()
    assert set(names) == {"thing", "wall 0"}
    assert depth <= truth(begin) + 1e-6
    assert depth >= truth(begin) - polygon - (0.02 if polygon else 1e-6)
    overlap, swapped = _Overlap.at(a, b, begin), _Overlap.at(b, a, begin)
    for turn in (0.0, 25.0, -170.0):
        for share in np.linspace(-6.0, 6.0, 5):
            q = begin + (share, -0.7 * share, turn)
            assert overlap.separation(q) <= truth(q) + 1e-6
            if turn == 0.0 and truth(q) < 0.0:
                assert overlap.separation(q) >= truth(q) - polygon - (
                    1.0 if polygon else 1e-6
                )
            if not polygon:
                assert overlap.separation(q) == pytest.approx(
                    swapped.separation(q), abs=1e-6
                )


def flat_gaps(a: FloatArray, b: FloatArray) -> FloatArray:
    """How far convex polygons (n, k, 2) are from the polygon (m, 2), both counter-clockwise; an
    overlap is negative, the least shift that parts them."""
    b = np.broadcast_to(b, (len(a), *b.shape))
    slabs, squared = [], []
    for p, q in ((a, b), (b, a)):
        along = np.roll(p, -1, axis=1) - p
        outward = np.stack([along[..., 1], -along[..., 0]], axis=-1)
        outward /= np.linalg.norm(outward, axis=-1)[..., None]
        from_edge = q[:, None] - p[:, :, None]
        slabs.append(
            np.einsum("nekc,nec->nek", from_edge, outward).min(axis=2).max(axis=1)
        )
        share = (
            np.einsum("nekc,nec->nek", from_edge, along)
            / (along**2).sum(axis=2)[..., None]
        )
        to = from_edge - np.clip(share, 0.0, 1.0)[..., None] * along[:, :, None]
        squared.append((to**2).sum(axis=3).min(axis=(1, 2)))
    widest = np.maximum(*slabs)
    return np.where(widest < 0.0, widest, np.sqrt(np.minimum(*squared)))


def regular(corners: int, radius: float) -> FloatArray:
    """The corners of a regular polygon (corners, 2), counter-clockwise."""
    angle = 2.0 * math.pi * np.arange(corners) / corners
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def upright(outline: FloatArray) -> Polytope:
    return hull(np.vstack([np.column_stack([outline, np.full(len(outline), z)])
                           for z in (-50.0, 50.0)]))  # fmt: skip


WALL = np.array([[0.0, -300.0], [400.0, -300.0], [400.0, 300.0], [0.0, 300.0]])


def gaps_along(
    outline: FloatArray, ways: Mapping[str, Trajectory], times: FloatArray
) -> FloatArray:
    """Of a polygon on x, y and turn from `WALL`, at each of `times`."""
    x, y, turn = (np.array([ways[n].position(t) for t in times.tolist()]) for n in AXES)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    turned = np.einsum(
        "nij,kj->nki", np.array([[c, -s], [s, c]]).transpose(2, 0, 1), outline
    )
    return flat_gaps(turned + np.stack([x, y], axis=1)[:, None], WALL)


@settings(max_examples=40, deadline=None)
@given(
    corners=st.integers(3, 12),
    off=st.floats(0.0, 20.0),
    depth=st.floats(1e-3, 3.0),
    turn=st.sampled_from([0.0, 1.0, 10.0, 300.0, 7000.0]),
    slide=st.sampled_from([-3.0, 0.0, 0.5, 3.0, 30.0]),
    seed=st.integers(0, 2**31),
)
@pytest.mark.slow
def test_an_overlap_never_deepens_and_once_free_keeps_the_margin(
    corners: int, off: float, depth: float, turn: float, slide: float, seed: int
) -> None:
    """Whatever the motion: edges and corners of polygons, looked at 4 000 times, say the
    same."""
    rng = np.random.default_rng(seed)
    outline = regular(corners, float(rng.uniform(5.0, 60.0))) + (off, 0.0)
    begin = {
        "x": 0.0,
        "y": float(rng.uniform(-9, 9)),
        "turn": float(rng.uniform(-360, 360)),
    }
    toward = [
        math.cos(math.radians(begin["turn"])),
        -math.sin(math.radians(begin["turn"])),
    ]
    begin["x"] = depth - float((outline @ toward).max())
    ways = {}
    for name, reach in (("x", -slide), ("y", slide), ("turn", turn)):
        far = begin[name] + reach * float(rng.uniform(0.5, 1.0))
        speed, pace = 10.0 ** rng.uniform(0.0, 2.0, 2)
        first = motion.move(begin[name], 0.0, far, float(speed), float(pace), 0.0)
        now = float(rng.uniform(0.0, 1.0)) * first.end
        back = motion.move(first.position(now), first.velocity(now), begin[name], float(speed),
                           float(pace), now)  # fmt: skip
        ways[name] = motion.joined([first, back]) if rng.random() < 0.5 else first
    times = np.linspace(0.0, max(way.end for way in ways.values()), 4_000)
    gaps = gaps_along(outline, ways, times)
    found = SceneGuard(one_against(upright(outline), [upright(WALL)]))(ways, 0.0)
    end = math.inf if found is None else found.time
    free = int(np.argmax(gaps > MARGIN + 2.0 * TOLERANCE)) or len(gaps)
    assert gaps[0] == pytest.approx(-depth, abs=1e-6)
    assert gaps[:free][times[:free] <= end].min() >= gaps[0] - RUNG
    assert gaps[free:][times[free:] <= end].min(initial=math.inf) >= MARGIN - 1e-6
    if found is not None:  # and nothing else is refused
        at = float(gaps_along(outline, ways, np.array([found.time]))[0])
        assert at <= (gaps[0] if times[free - 1] >= end else MARGIN + TOLERANCE) + 1e-4


def test_a_turn_of_one_corner_a_look_is_no_way_past_the_corners() -> None:
    """At 400 even moments of it no corner of a decagon seems nearer to the wall than at
    first."""
    outline, begin = regular(10, 125.0), -8.9995
    x = 0.3 - 125.0 * math.cos(math.radians(begin))
    way = motion.move(begin, 0.0, begin + 398 * 36.0, 45.0, 45.0**2 / 36.0, 0.0)
    ways = {"x": motion.at_rest(x), "y": motion.at_rest(0.0), "turn": way}
    every, densely = (np.linspace(0.0, way.end, n) for n in (400, 20_000))
    assert gaps_along(outline, ways, every).min() > -0.3 - RUNG
    assert gaps_along(outline, ways, densely).min() < -1.8
    found = SceneGuard(one_against(upright(outline), [upright(WALL)]))(ways, 0.0)
    assert found is not None
    assert gaps_along(outline, ways, np.array([found.time]))[0] == pytest.approx(
        -0.3, abs=RUNG
    )


@pytest.mark.parametrize(
    "corners", [np.zeros(3), np.zeros((4, 2)), np.full((4, 3), np.nan)]
)
def test_corners_that_are_none_are_refused(corners: FloatArray) -> None:
    with pytest.raises(ValueError, match=r"allowed: k x 3, finite"):
        Polytope(corners, np.zeros((1, 3), dtype=np.intp))


@pytest.mark.parametrize("seed", range(12))
def test_a_solid_reaches_as_far_from_an_axis_as_its_farthest_point(seed: int) -> None:
    rng = np.random.default_rng(seed)
    for axis in (np.array([0.0, 0.0, 1.0]), rng.normal(size=3)):
        way = axis / np.linalg.norm(axis)
        for solid in (
            random_solid(rng),
            UprightCylinder(tuple(rng.uniform(-9, 9, 3)), 5.0, 8.0),
        ):
            points = solid_points(solid)
            rounding = (
                0.0023 * solid.radius if isinstance(solid, UprightCylinder) else 1e-9
            )
            held = points
            if isinstance(solid, UprightCylinder) and way[2] != 1.0:  # the box around it
                half = np.array([solid.radius, solid.radius, solid.height / 2])
                signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
                held, rounding = np.array(solid.center) + signs * half, 1e-9
            far = float(np.linalg.norm(np.cross(held, way), axis=1).max())
            assert far - 1e-9 <= solid.radius_about(way) <= far + rounding
            lower, upper = solid.bounds()
            assert (points.min(axis=0) >= lower - 1e-9).all()
            assert (points.max(axis=0) <= upper + 1e-9).all()
            middle = (points.min(axis=0) + points.max(axis=0)) / 2
            assert_allclose((lower + upper) / 2, middle, atol=0.2)


@pytest.mark.parametrize("seed", range(6))
def test_every_distance_that_is_evaluated_counts_as_a_look(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = (Body(n, box(rng.uniform(1, 9, 3), at), np.zeros(3), s, np.zeros(1), n, "object")
            for n, s, at in (("a", np.array([[1.0, 0.0, 0.0]]), (0, 0, 0)),
                             ("b", np.zeros((1, 3)), (0, 30, 0))))  # fmt: skip
    move = motion.move(-50.0, 0.0, float(rng.uniform(5, 50)), 50.0, 50.0, 0.0)
    path = path_of(("x",), {"x": AxisPath.along(move)}, 0.0, move.end)
    looked, separate = [], separation_of(a.solid, b.solid)

    def counted(*at: FloatArray | None) -> tuple[float, FloatArray]:
        looked.append(at)
        return separate(*at)  # type: ignore[arg-type]

    way, limits = RelativeMotion(a, b, path), Limits(MARGIN, TOLERANCE, (0.1, 0.0))
    assert sweep_pair(way, counted, limits).looks == len(looked) > 0
    looked.clear()
    least, looks = refine_pair(way, counted, limits, math.inf)
    assert looks == len(looked) > 0
    begin, end = (true_distance(a.solid.vertices + (x, 0, 0), b.solid.vertices)
                  for x in (-50.0, move.target))  # fmt: skip
    lowest = true_distance(a.solid.vertices, b.solid.vertices)
    assert least <= min(begin, end)
    assert lowest - 1e-4 <= least <= lowest + 0.1


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize(("axis", "mm"), [("x", 1.0), ("turn", math.radians(6.0208))])
def test_the_moment_after_a_travel_is_that_of_the_motor(
    axis: str, mm: float, seed: int
) -> None:
    """With one motor the bound is the motion itself; a corner of the box is 6.0208 mm from
    the turntable's axis."""
    rng = np.random.default_rng(seed)
    a, b = one_against(box((9, 8, 7)), [box((5, 5, 5), (70, 70, 0))]).bodies
    begin, end = rng.uniform(-50, 50, 2)
    move = motion.move(begin, 0.0, end, float(rng.uniform(5, 50)), 30.0, 0.0)
    still = at_rest(0.0)
    ways = dict.fromkeys(AXES, still) | {axis: move}
    path = path_of(AXES, {n: AxisPath.along(t) for n, t in ways.items()}, 0.0, move.end)
    moves = RelativeMotion(a, b, path)
    for share in rng.uniform(0.05, 0.99, 4):
        distance = float(share * abs(end - begin)) * mm
        found = moves.after_travel(Moment(0, 0.0), distance)
        assert found is not None
        gone = abs(move.position(moves.time(found)) - begin)
        assert gone * mm == pytest.approx(distance, rel=1e-5)
    assert moves.after_travel(Moment(0, 0.0), 1.01 * mm * abs(end - begin)) is None


@pytest.mark.parametrize("count", [2, 8, 9])
def test_a_trace_has_times_even_in_travel_and_times_even_in_time(count: int) -> None:
    """A motor goes 6 mm in one second, rests for eight, and goes 2 mm in the last."""
    path = Path(
        ("x",), np.array([1.0, 2.0, 10.0, 11.0]), np.array([[0.0], [6.0], [6.0], [8.0]]),
        np.array([[6.0], [0.0], [2.0]]), np.zeros((3, 1)),
    )  # fmt: skip
    even = 1.0 + 10.0 * np.arange(count - count // 2) / max(1, count - count // 2 - 1)
    by_travel = {1: [1.0], 4: [1.0, 1.0 + 8.0 / 18.0, 1.0 + 16.0 / 18.0, 11.0]}[
        count // 2
    ]
    assert_allclose(_trace_times(path, count), np.unique([*by_travel, *even]))
    assert_allclose(_trace_times(path, 1), [1.0, 11.0])


def drawn_path(rng: np.random.Generator) -> tuple[dict[str, Trajectory], Path]:
    """A motion of each axis, and their path until the last has ended."""
    ways = {name: drawn_motion(rng, 40.0) for name in AXES}
    end = max(way.end for way in ways.values())
    return ways, path_of(AXES, {n: AxisPath.along(t) for n, t in ways.items()}, 0.0, end)


@pytest.mark.parametrize("seed", range(12))
def test_what_is_left_of_a_path_is_the_same_motion(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ways, path = drawn_path(rng)
    end = max(way.end for way in ways.values())
    times = np.sort(rng.uniform(0.0, end, 300))
    truth = np.array([[ways[n].position(t) for n in AXES] for t in times])
    left = path.after(float(times[100]))
    assert (left.times[0], left.times[-1]) == (times[100], end)
    assert_allclose(path.vectors(times), truth, atol=1e-8)
    assert_allclose(left.vectors(times[100:]), truth[100:], atol=1e-8)
    for one in (path, left):
        here = one.q[:-1] + np.diff(one.times)[:, None] * (
            one.v + 0.5 * np.diff(one.times)[:, None] * one.a
        )
        assert_allclose(here, one.q[1:], atol=1e-7)
    assert path.positions(float(times[7])) == pytest.approx(
        dict(zip(AXES, truth[7], strict=True))
    )


@pytest.mark.parametrize("seed", range(6))
def test_upright_boxes_are_as_far_apart_as_their_corners_say(seed: int) -> None:
    """Both turned alike about the vertical, where fcl's nearest points were millimetres off; as
    seen from the boxes' own axes the distance is that of three intervals."""
    rng = np.random.default_rng(seed)
    for _ in range(60):
        sizes, off = rng.uniform(1, 60, (2, 3)), rng.normal(size=3) * 60
        distance = np.linalg.norm(np.maximum(np.abs(off) - sizes.sum(axis=0) / 2, 0.0))
        turn = rotation_about(np.array([0.0, 0.0, 1.0]), rng.uniform(0, 6))
        away = separation_of(box(sizes[0]), box(sizes[1], -off))
        gap, normal = away(np.zeros(3), turn, turn)
        assert gap == pytest.approx(distance, abs=2e-5)
        assert np.linalg.norm(normal) == pytest.approx(1.0)
        middle = separation_of(box(sizes[0]), box(sizes[1]))(turn @ off, turn, turn)[0]
        assert middle == pytest.approx(distance, abs=2e-5)


@pytest.mark.parametrize("seed", range(20))
def test_two_turntables_on_each_other_meet_a_wall_where_trigonometry_says(
    seed: int,
) -> None:
    """The farthest of a bar's corners, as high above the axis as sine and cosine of both
    turns."""
    rng = np.random.default_rng(seed)
    half, wide = rng.uniform(40, 90), rng.uniform(2, 20)
    ways = {name: drawn_motion(rng, 60.0) for name in ("first", "second")}
    end = max(way.end for way in ways.values())
    times = np.linspace(0.0, end, 20_001)
    turn = np.radians(sum(way.positions(times) for way in ways.values()))
    high = np.abs(np.sin(turn)) * half + np.abs(np.cos(turn)) * wide
    meets = high.max() - high[0] > 3.0 and seed % 2 == 0
    wall = float(high.max() + MARGIN + (-1.0 if meets else 0.1))
    none = np.zeros((2, 3))
    bodies = [
        Body("bar", box((2 * half, 2 * wide, 9)), np.zeros(3), none, np.radians([1.0, 1.0]), "bar",
             "object", np.array([0.0, 0.0, 1.0])),
        Body("wall", box((500, 9, 9), (0, wall + 4.5, 0)), np.zeros(3), none, np.zeros(2), "",
             "detector"),
    ]  # fmt: skip
    limits = Limits(MARGIN, TOLERANCE, (0.1, 0.02))
    scene = scene_of(tuple(ways), bodies, (), reach=np.tile([-1e6, 1e6], (2, 1)),
                     home=np.zeros(2), limits=limits)  # fmt: skip
    found = sweep(scene, ways, 0.0, end)
    assert (found.contact is not None) == meets
    if found.contact is not None:
        first = times[np.argmax(wall - high <= MARGIN + TOLERANCE)]
        last = times[np.argmax(wall - high <= MARGIN)]
        assert first - 1e-3 <= found.contact.time <= last + 1e-3


@pytest.mark.parametrize("seed", range(20))
def test_a_bound_in_pieces_falls_first_where_it_has_the_level_and_had_more_before(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    for _ in range(20):
        count = int(rng.integers(1, 14))
        rate, growth = rng.normal(size=(2, count)) * (3.0, 6.0)[seed % 2] + seed % 3
        lengths = rng.uniform(0.1, 2.0, count)
        at = Moment(int(rng.integers(count)), 0.0)
        at = Moment(at.segment, float(rng.uniform(0.0, lengths[at.segment])))

        value, level = 5.0, float(rng.uniform(0.0, 4.9))
        found = _Bound(rate, growth).first_fall(at, lengths, value, level)
        height, since, seen = value, at.dt, []
        for j in range(at.segment, count):
            here = found is not None and found.segment == j
            stop = found.dt if found is not None and here else lengths[j]
            dt = np.linspace(since, stop, 500)
            seen.append(
                height + rate[j] * (dt - since) + growth[j] * (dt**2 - since**2) / 2.0
            )
            height, since = float(seen[-1][-1]), 0.0
            if here:
                assert height == pytest.approx(level, abs=1e-9)
                break
        assert np.concatenate(seen).min() >= level - 1e-9


@pytest.mark.parametrize("seed", range(20))
def test_a_bound_that_only_dips_below_the_level_falls_there(seed: int) -> None:
    """Each piece ends as high as it began, but one late piece is lower in its middle."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(8, 14))
    lengths, depths = rng.uniform(0.3, 3.0, count), rng.uniform(0.1, 0.4, count)
    dip = int(rng.integers(6, count))
    depths[dip] = rng.uniform(0.6, 0.9)
    growth = (
        8.0 * depths / lengths**2
    )  # a parabola that starts and ends at the same height
    found = _Bound(-growth * lengths / 2.0, growth).first_fall(
        Moment(0, 0.0), lengths, 1.0, 0.5
    )
    assert found is not None
    assert found.segment == dip
    down = lengths[dip] / 2.0 * (1.0 - np.sqrt(1.0 - 0.5 / depths[dip]))
    assert found.dt == pytest.approx(down)


@pytest.mark.parametrize("seed", range(12))
def test_the_end_that_is_nearest_along_a_direction_is_found(seed: int) -> None:
    rng = np.random.default_rng(seed)
    ways, path = drawn_path(rng)
    thing, wall = one_against(box((9, 8, 7)), [box((5, 5, 5), (70, 70, 0))]).bodies
    moves = RelativeMotion(thing, wall, path)
    begin = int(rng.integers(len(moves)))
    at = Moment(begin, float(rng.uniform(0.0, moves.lengths[begin])))
    look = moves.look(at, separation_of(thing.solid, wall.solid))
    ends = (moves.times + moves.lengths).tolist()

    def along(time: float) -> float:
        where = np.array([ways["x"].position(time), ways["y"].position(time), 0.0])
        return float(where @ look.normal)

    found = moves.nearest_end(look)
    assert moves.time(found) in [pytest.approx(t) for t in ends[begin:]]
    assert along(moves.time(found)) <= min(along(t) for t in ends[begin:]) + 1e-7


@pytest.mark.parametrize("seed", range(12))
def test_the_farthest_point_along_a_direction_is_one_of_the_solid(seed: int) -> None:
    rng = np.random.default_rng(seed)
    round_one = UprightCylinder(tuple(rng.uniform(-9, 9, 3)), 5.0, 8.0)
    for direction in (
        np.array([0.0, 0.0, 1.0]),
        np.array([0.0, -1.0, 0.0]),
        rng.normal(size=3),
    ):
        for solid in (random_solid(rng), round_one):
            point = solid.farthest(direction)
            assert point @ direction >= (solid_points(solid) @ direction).max() - 1e-9
            if isinstance(solid, UprightCylinder):
                across, along = (point - solid.center)[:2], (point - solid.center)[2]
                assert math.hypot(*across) <= solid.radius + 1e-9
                assert abs(along) <= solid.height / 2 + 1e-9
            else:
                assert (solid_points(solid) == point).all(axis=1).any()


@pytest.mark.parametrize("seed", range(12))
def test_a_path_begun_before_or_during_its_motions_is_where_they_are(seed: int) -> None:
    """Jogs that turn round within a piece, each begun at a time of its own."""
    rng = np.random.default_rng(seed)
    ways = {}
    for name in AXES:
        begin = float(rng.uniform(0.5, 4.0))
        legs = [motion.at_rest(float(rng.uniform(-9, 9)), begin)]
        for now in (begin + np.cumsum([0.0, *rng.uniform(0.3, 2.0, 3)])).tolist():
            here = legs[-1].position(now), legs[-1].velocity(now)
            wanted, lease, pace = (
                rng.uniform(-30, 30),
                rng.uniform(0.5, 4),
                rng.uniform(5, 40),
            )
            legs.append(motion.jog(*here, float(wanted), float(lease), float(pace), now))
        ways[name] = motion.joined(legs)
    end = max(way.end for way in ways.values())
    tables = {n: AxisPath.along(t) for n, t in ways.items()}
    for start in (-1.0, float(rng.uniform(1.0, 3.0)), float(rng.uniform(3.0, 5.0))):
        path = path_of(AXES, tables, start, end)
        times = np.sort(rng.uniform(start, end, 200))
        truth = np.array([[ways[n].position(t) for n in AXES] for t in times])
        assert_allclose(path.vectors(times), truth, atol=1e-7)
        later = path.v + np.diff(path.times)[:, None] * path.a
        assert (path.v * later >= -1e-6).all()  # none turns round within a segment


def test_a_solid_that_turns_about_a_direction_never_comes_nearer_along_it() -> None:
    rng = np.random.default_rng(2)
    for sense in (-1.0, 0.0, 1.0):
        solid = hull(rng.normal(size=(8, 3)) * 20)
        up = np.array([0.0, 0.0, 1.0])
        body = Body(
            "b", solid, np.zeros(3), np.zeros((1, 3)), np.ones(1), "b", "object", up
        )
        assert body.turn_until(up, 0.5, sense) >= (1e3 if sense == 0.0 else math.pi)


@pytest.mark.parametrize("seed", range(12))
def test_the_clearance_of_a_pose_is_that_of_the_turned_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, wall = (
        box(rng.uniform(5, 30, 3)),
        box(rng.uniform(5, 30, 3), (45.0, 0.0, 0.0)),
    )
    x, y, turn = rng.uniform(-20, 5), rng.uniform(-9, 9), rng.uniform(10, 80)
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    points = moving.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + (
        x,
        y,
        0,
    )
    near = clearance(one_against(moving, [wall]), {"x": x, "y": y, "turn": turn})
    assert near.mm == pytest.approx(true_distance(points, wall.vertices), abs=1e-4)


def test_a_motion_without_an_end_is_looked_at_ahead() -> None:
    """A held jog of 2 mm/s from 100 mm away: the margin is reached after 99 mm."""
    scene = one_against(box((20, 20, 20)), [box((20, 200, 200), (120, 0, 0))])
    held = Trajectory((Piece(7.0, 0.0, 2.0, 0.0),), math.inf, math.inf)
    contact = SceneGuard(scene)({"x": held}, 7.0)
    assert contact is not None
    assert contact.time == pytest.approx(7.0 + (99.0 - KEPT) / 2.0, abs=1e-9)
