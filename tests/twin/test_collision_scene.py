"""The FleX-ray's bodies: Table 4.1's sizes, free where the thesis scanned, touching where
not."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from swept import sweep

from flexdt.twin.collision.collision_scene import (
    CollisionScene,
    PairStack,
    build_scene,
    scene_of,
)
from flexdt.twin.collision.convex_solids import UprightCylinder, box
from flexdt.twin.collision.first_contact import clearance, touching
from flexdt.twin.collision.relative import Limits
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NAMES, Offsets
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_profile,
    builtin_profiles,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.motion import profiles as motion

M = builtin_machine()

# (width, depth along the beam, height); thesis Table 4.1 prints width, height, depth.
TABLE_4_1 = {
    "main_platform": (2000, 2000, 50), "mag_rail_left": (20, 1500, 40),
    "mag_rail_right": (20, 1500, 40), "source_platform": (300, 300, 50),
    "source_tower": (100, 100, 1000), "xray_source": (10, 100, 10),
    "sample_rail": (400, 400, 50), "sample_base": (200, 200, 40),
    "sample_holder": (150, 150, 20), "detector_platform": (400, 400, 50),
    "detector_tower": (100, 100, 1000), "detector_stage": (145, 10, 114),
    "detector": (145, 10, 114),
}  # fmt: skip

# Source (x, height), detector (x, height, distance), object (x, height, distance).
TABLE_6_1 = {
    "G0": ((0, 45), (0, 0, 674), (0, 20, 570)),
    "G0 start": ((0, 45), (0, 0, 674), (10, 15, 589)),
    "G1": ((8, 50), (-5, 10, 720), (0, 22, 565)),
    "G1 start": ((8, 50), (-5, 10, 720), (6, 28, 577)),
    "G2": ((-10, 55), (8, 20, 760), (0, 30, 560)),
    "G2 start": ((-10, 55), (8, 20, 760), (15, 42, 582)),
    "G3": ((5, 60), (-8, -5, 800), (0, 15, 555)),
    "G3 start": ((5, 60), (-8, -5, 800), (18, 23, 580)),
    "G4": ((-5, 38), (10, 3, 690), (0, 18, 568)),
    "G4 start": ((-5, 38), (10, 3, 690), (7, 20, 576)),
}
TABLE_6_6 = {
    "Scan1": ((0.0, 25.0), (-25.318, 18.687, 1059), (0.541, 20, 600)),
    "Scan2": ((5.0, 29.9), (-25.318, 18.677, 1059), (0.541, 20, 600)),
    "Scan3": ((5.0, 29.9), (-25.318, 18.667, 1059), (0.541, 20, 800)),
    "Scan4": ((-10.0, 30.0), (-20.002, 33.656, 1059), (0.541, 20, 800)),
    "Scan5": ((-10.0, 30.0), (-20.002, 33.656, 959), (0.541, 20, 600)),
    "Scan6": ((0.0, 30.0), (-6.002, 33.656, 959), (0.541, 20, 600)),
}
LISTING_1 = {
    "Listing 1": {
        "tra_tube": 0.0, "ver_tube": 40.0, "tra_det": 25.319824, "ver_det": 33.696938,
        "mag_det": 1059.0, "mag_obj": 660.0, "tra_obj": 0.0,
    },
}  # fmt: skip
LISTING_1["Listing 1, flat"] = LISTING_1["Listing 1"] | {"tra_obj": -150.0}

# Bead phantoms of Table 6.2 (width, depth, height), a 2 mm bead sphere around each corner.
TABLE_6_2 = {
    "normal": (20, 40, 60), "small": (20, 22, 40), "square": (30, 30, 30), "tall": (10, 15, 80),
    "wide": (80, 80, 20), "compact": (10, 15, 20), "coplanar": (40, 60, 10),
}  # fmt: skip


def geometry(
    source: tuple, detector: tuple, obj: tuple
) -> tuple[dict[str, float], float]:
    """Motors for a geometry of the tables without zero offsets, and the sample's height."""
    motors = {
        "tra_tube": source[0], "ver_tube": source[1],
        "tra_det": -detector[0], "ver_det": detector[1], "mag_det": detector[2],
        "tra_obj": obj[0], "mag_obj": obj[2],
    }  # fmt: skip
    return {n: float(v) for n, v in motors.items()}, float(obj[1])


def scene(
    profile: str = "thesis", *samples: object, margin: float | None = None
) -> CollisionScene:
    return build_scene(M, builtin_profile(profile), samples, margin_mm=margin)  # type: ignore[arg-type]


def phantom(name: str, height: float) -> object:
    return box(np.array(TABLE_6_2[name]) + 4.0, (0.0, 0.0, height - M.sample_height_mm))


def full_turn(s: CollisionScene, motors: dict[str, float]) -> FloatArray:
    """Sweep one turn of the stage; returns its least clearance."""
    standing = {n: motion.at_rest(v) for n, v in motors.items()}
    turn = motion.move(0.0, 0.0, 360.0, 45.0, 22.5, 0.0)
    result = sweep(s, {**standing, "rot_obj": turn}, 0.0, turn.end)
    assert result.contact is None, result.contact
    return np.float64(result.min_clearance_mm)


def test_sizes_are_table_4_1() -> None:
    sizes = {c.name: c.size_mm for c in M.components}
    assert {n: sizes[n] for n in TABLE_4_1} == TABLE_4_1
    # The mount is the one part that Table 4.1 does not have; thesis 4.3 speaks of it.
    assert set(sizes) - set(TABLE_4_1) == {"sample_mount"}
    assert all("assumed" in c.source for c in M.components)


@pytest.mark.daily(10)
@pytest.mark.parametrize("size", TABLE_6_2)
@pytest.mark.parametrize("name", TABLE_6_1)
def test_simulated_geometries_are_free_at_every_angle(name: str, size: str) -> None:
    """Table 6.1 as geometry: its detector heights 0, -5 and 3 lie below the travel limit."""
    motors, height = geometry(*TABLE_6_1[name])
    s = scene("thesis", phantom(size, height))
    assert touching(s, motors) == []
    assert full_turn(s, motors) > M.safety_margin_mm
    assert clearance(s, motors).mm > M.safety_margin_mm


@pytest.mark.daily(10)
@pytest.mark.parametrize("size", TABLE_6_2)
@pytest.mark.parametrize("profile", ["thesis", M.default_profile])
@pytest.mark.parametrize("name", TABLE_6_6)
def test_real_scans_are_free_at_every_angle(name: str, profile: str, size: str) -> None:
    motors, height = geometry(*TABLE_6_6[name])
    s = scene(profile, phantom(size, height))
    assert touching(s, motors) == []
    assert full_turn(s, motors) > 100.0


@pytest.mark.parametrize("profile", builtin_profiles("flexray"))
@pytest.mark.parametrize("name", LISTING_1)
def test_listing_1_is_free_with_every_profile(name: str, profile: str) -> None:
    s = scene(profile, box((24, 16, 49.8)))
    assert touching(s, LISTING_1[name]) == []
    assert full_turn(s, LISTING_1[name]) > 100.0


def test_home_and_the_ends_of_the_scans_travel_are_free() -> None:
    s = scene(M.default_profile, box((24, 16, 49.8)))
    assert touching(s, {}) == []
    farthest = {"mag_obj": 996.0, "mag_det": 1059.0}
    nearest = {"mag_obj": 70.0, "mag_det": 1059.0, "ver_tube": 0.0}
    for motors in (farthest, nearest):
        assert touching(s, motors) == []


COLLIDING = {
    "panel into sample": ({"mag_obj": 600.0, "mag_det": 570.0}, "detector", "sample"),
    "panel behind the axis": ({"mag_obj": 900.0, "mag_det": 800.0}, "detector_tower", "sample"),
    "base into platform": (
        {"mag_obj": 600.0, "mag_det": 640.0}, "sample_base", "detector_platform"),
    "base aside into platform": (
        {"mag_obj": 600.0, "mag_det": 640.0, "tra_obj": -234.0}, "sample_base",
        "detector_platform"),
    "holder into tower": (
        {"mag_obj": 600.0, "mag_det": 600.0, "tra_obj": 60.0}, "sample_holder", "detector_tower"),
    "mount into panel": (
        {"mag_obj": 500.0, "mag_det": 475.0, "ver_det": 4.0}, "sample_mount", "detector"),
    "panel at its side limit into sample": (
        {"mag_obj": 500.0, "mag_det": 475.0, "tra_obj": 190.0, "tra_det": -165.0}, "detector",
        "sample"),
    "base inside the platform": (
        {"mag_obj": 996.0, "mag_det": 700.0}, "sample_base", "detector_platform"),
    "holder over platform": (
        {"mag_obj": 700.0, "mag_det": 500.0, "tra_obj": 194.0}, "sample_holder",
        "detector_platform"),
    "mount into stage": (
        {"mag_obj": 400.0, "mag_det": 357.5, "ver_det": 10.0, "tra_det": 300.0}, "sample_mount",
        "detector_stage"),
    "wide sample into source": (
        {"mag_obj": 70.0, "ver_tube": 45.0, "tra_tube": 10.0}, "xray_source", "wide sample"),
    "wide sample into panel": (
        {"mag_obj": 600.0, "mag_det": 660.0, "ver_det": 45.0}, "detector", "wide sample"),
}  # fmt: skip


@pytest.mark.parametrize("name", COLLIDING)
def test_poses_within_the_travel_that_collide(name: str) -> None:
    motors, first, second = COLLIDING[name]
    for axis, value in motors.items():
        assert M.axes[axis].lower <= value <= M.axes[axis].upper
    size = (180, 180, 60) if second == "wide sample" else (24, 16, 49.8)
    s = scene(M.default_profile, box(size))
    pairs = {frozenset(pair) for pair, _ in touching(s, motors)}
    assert frozenset((first, second.removeprefix("wide "))) in pairs
    assert clearance(s, motors).mm <= M.safety_margin_mm + s.limits.tolerance


@pytest.mark.parametrize("profile", ["thesis", M.default_profile, "cwi-2022-05-31"])
def test_bodies_sit_where_the_x_ray_geometry_is(profile: str) -> None:
    """Focal spot, panel and sample of the scene against `kinematics.poses`, from random
    motors."""
    p = builtin_profile(profile)
    rng = np.random.default_rng(3)
    marks = np.array(
        [[3.0, 7.0, -11.0], [-20.0, 1.0, 4.0], [5.0, -6.0, 30.0], [1.0, 2.0, 3.0]]
    )
    s = build_scene(M, p, [box((2, 2, 2), mark) for mark in marks])
    sensor = M.detector.pixels
    for _ in range(20):
        motors = {n: rng.uniform(a.lower, a.upper) for n, a in M.axes.items()}
        seen = poses(M, p, M.detector.camera, motors)
        centres = {}
        for i, body in enumerate(s.bodies):
            lower, upper = body.solid.bounds()
            q = s.vector(motors)
            turn = body.rotation(float(q @ body.turns))
            centres[f"{body.name} {i}"] = (
                body.origin + q @ body.slides + turn @ (0.5 * (lower + upper))
            )
        named = {n.split()[0]: c for n, c in centres.items()}
        # The focal spot is the middle of the source's front face.
        assert_allclose(named["xray_source"] + [0, 50, 0], seen.source[0], atol=1e-9)
        # The panel's front face is centred on the sensor, of which the ROI is a part.
        columns, rows = M.detector.camera.roi_shift_mm(sensor)
        pixel = M.detector.camera.pixel_mm(sensor)
        roi = (columns * seen.u[0] + rows * seen.v[0]) / pixel
        assert_allclose(named["detector"] - [0, 5, 0], seen.detector[0] - roi, atol=1e-9)
        # A mark of the sample: the pose's object frame turns clockwise about the axis.
        a = seen.angle[0]
        clockwise = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0],
                              [0, 0, 1]])  # fmt: skip
        for mark, (name, centre) in zip(
            marks, [c for c in centres.items() if c[0].startswith("sample ")], strict=True
        ):
            assert_allclose(
                centre, seen.axis[0] + clockwise @ mark, atol=1e-9, err_msg=name
            )


@pytest.mark.parametrize("seed", range(6))
def test_bodies_follow_the_correction_in_force(seed: int) -> None:
    """Distances between marks, focal spot and panel corners are those of `Poses.cone_vec`."""
    rng = np.random.default_rng(seed)
    small = {
        n: rng.uniform(-15, 15) if n[0] == "d" and "_" in n and "det" not in n else
        rng.uniform(-4, 4)
        for n in NAMES
    } | {"angle_scale": rng.uniform(0.98, 1.02)}  # fmt: skip
    correction = Offsets.from_edge(small)
    p = builtin_profile(M.default_profile)
    marks = np.array([[3.0, 7.0, -11.0], [-20.0, 1.0, 4.0], [5.0, -6.0, 30.0]])
    s = build_scene(M, p, [box((2, 2, 2), m) for m in marks], correction)
    motors = {n: rng.uniform(a.lower, a.upper) for n, a in M.axes.items()}
    cone = poses(M, p, M.detector.camera, motors).cone_vec(correction)
    sensor, pixel = M.detector.pixels, M.detector.camera.pixel_mm(M.detector.pixels)
    columns, rows = M.detector.camera.roi_shift_mm(sensor)
    u, v = cone.u[0] / pixel, cone.v[0] / pixel
    # The panel tilts about its own centre, the image about the ROI's; they are 1.2 mm apart.
    upright = replace(correction, det_yaw=0.0, det_pitch=0.0, det_roll=0.0)
    flat = poses(M, p, M.detector.camera, motors).cone_vec(upright)
    centre = cone.detector[0] - (columns * flat.u[0] + rows * flat.v[0]) / pixel
    corner = centre + 72.5 * u - 57.0 * v  # top right

    q = s.vector(motors)
    world: dict[str, list[FloatArray]] = {}
    for body in s.bodies:
        points = (
            body.solid.vertices if hasattr(body.solid, "vertices") else np.zeros((1, 3))
        )
        turned = points @ body.rotation(float(q @ body.turns)).T
        world.setdefault(body.name, []).append(body.origin + q @ body.slides + turned)
    tip = world["xray_source"][0].mean(axis=0) + [0, 50, 0]
    seen = [points.mean(axis=0) for points in world["sample"]]
    for mark, place in zip(marks, seen, strict=True):
        assert np.linalg.norm(place - tip) == pytest.approx(
            np.linalg.norm(mark - cone.source[0]), abs=1e-9
        )
        # The front corner of the panel at the end of its first row.
        panel = world["detector"][0]
        distances = np.linalg.norm(panel - place, axis=1)
        assert np.abs(distances - np.linalg.norm(mark - corner)).min() < 1e-9
    np.testing.assert_allclose(
        [np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)],
        [np.linalg.norm(a - b) for a, b in itertools.combinations(marks, 2)],
    )


def test_a_cylinder_sample_off_the_axis_is_held_by_its_prism() -> None:
    correction = Offsets.from_edge({"tau_x": 5.0, "axis_tilt_x": 2.0})
    s = build_scene(
        M, builtin_profile("thesis"), [UprightCylinder((0, 0, 0), 30.0, 40.0)], correction
    )
    plain = build_scene(
        M, builtin_profile("thesis"), [UprightCylinder((0, 0, 0), 30.0, 40.0)]
    )
    moved, upright = (
        next(b for b in x.bodies if b.name == "sample").solid for x in (s, plain)
    )
    angle = math.radians(2.0)
    for x, y, z in np.random.default_rng(0).normal(size=(50, 3)):
        # The tilt turns about x, after the shift by -tau along x.
        back = np.array([x, math.cos(angle) * y + math.sin(angle) * z,
                         -math.sin(angle) * y + math.cos(angle) * z])  # fmt: skip
        exact = upright.support(back) - 5.0 * x
        got = moved.support(np.array([x, y, z]))
        assert exact - 1e-9 <= got <= exact + 0.0022 * 30.0 * math.hypot(x, y, z)


def test_a_rolled_panel_is_rolled_as_its_pixels_are() -> None:
    p = builtin_profile("cwi-2022-05-31")
    s = build_scene(M, p)
    panel = next(b for b in s.bodies if b.name == "detector")
    seen = poses(M, p, M.detector.camera, {})
    u, v = seen.u[0] / np.linalg.norm(seen.u[0]), seen.v[0] / np.linalg.norm(seen.v[0])
    for direction, half in ((u, 72.5), (v, 57.0)):
        assert panel.solid.support(direction) == pytest.approx(half, abs=1e-9)


def test_pairs_are_neither_fixed_to_each_other_nor_allowed() -> None:
    s = scene(M.default_profile, box((10, 10, 10)))
    pairs = {frozenset(s.names(p)) for p in (*s.pairs, *s.distant)}
    assert len(pairs) == len(s.pairs) + len(s.distant)
    assert frozenset(("sample", "sample_holder")) not in pairs
    assert frozenset(("sample_mount", "sample_holder")) not in pairs
    assert frozenset(("detector_tower", "detector_platform")) not in pairs
    assert not pairs & {frozenset(p) for p in M.allowed_contacts}


@pytest.mark.slow
def test_pairs_set_aside_cannot_touch_anywhere_in_the_travel() -> None:
    s = scene(M.default_profile, box((40, 60, 80)))
    rng = np.random.default_rng(0)
    corners = itertools.product(*((a.lower, a.upper) for a in M.axes.values()))
    some = [dict(zip(M.axes, c, strict=True)) for c in corners]
    some += [
        {n: rng.uniform(a.lower, a.upper) for n, a in M.axes.items()} for _ in range(100)
    ]
    for motors in some:
        q = s.vector(motors)
        for i, j in s.distant:
            a, b = s.bodies[i], s.bodies[j]
            offset = q @ (a.slides - b.slides) + a.origin - b.origin
            turns = [x.rotation(float(q @ x.turns)) for x in (a, b)]
            gap, _ = s.separation((i, j))(offset, *turns)
            assert gap > s.limits.margin, s.names((i, j))


@settings(max_examples=50, deadline=None)
@given(
    st.tuples(*[st.floats(0.1, 500.0)] * 3), st.tuples(*[st.floats(-900.0, 900.0)] * 3)
)
def test_the_triangles_of_a_box_are_its_surface_seen_from_outside(
    size: tuple[float, float, float], centre: tuple[float, float, float]
) -> None:
    solid = box(size, centre)
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    areas = np.cross(b - a, c - a) / 2.0
    outward = (areas * ((a + b + c) / 3.0 - centre)).sum(axis=1)
    x, y, z = size
    assert (outward > 0.0).all()
    assert outward.sum() / 3.0 == pytest.approx(x * y * z)
    assert np.abs(areas).sum() == pytest.approx(2.0 * (x * y + y * z + z * x))
    edges = {(f[i], f[i - 1]) for f in solid.faces.tolist() for i in range(3)}
    assert len(edges) == 36  # each once: closed, nothing twice
    assert edges == {(end, start) for start, end in edges}


def drawn_bodies(rng: np.random.Generator, axes: int) -> list[Body]:
    """Boxes that slide along x, y and z with drawn shares of the motors, or not at all."""
    return [
        Body(str(i), box(rng.uniform(1, 30, 3), rng.uniform(-9, 9, 3)), rng.uniform(-40, 40, 3),
             rng.normal(size=(axes, 3)) * (rng.random((axes, 3)) < 0.4), np.zeros(axes), str(i),
             ("world", "object", "object", "detector")[i % 4])
        for i in range(9)
    ]  # fmt: skip


def apart_along(a: Body, b: Body, reach: FloatArray) -> FloatArray:
    """(3,) gaps along x, y and z that no position within reach closes: those of all its
    corners."""
    corners = np.array(list(itertools.product(*reach)))
    (low_a, high_a), (low_b, high_b) = (
        [x.origin + corners @ x.slides + end for end in x.solid.bounds()] for x in (a, b)
    )
    return np.maximum((low_a - high_b).min(axis=0), (low_b - high_a).min(axis=0))


@pytest.mark.parametrize("seed", range(12))
def test_bounds_of_boxes_that_slide_are_what_their_corners_keep(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bodies = drawn_bodies(rng, 3)
    reach = np.sort(rng.uniform(-6, 6, (3, 2)), axis=1)
    for size in (1, 5, 36):
        pairs = list(itertools.combinations(range(9), 2))[-size:]
        got = PairStack.of(3, bodies, pairs).clearances(reach[:, 0], reach[:, 1])
        kept = np.array([apart_along(bodies[i], bodies[j], reach) for i, j in pairs])
        assert_allclose(got, np.linalg.norm(np.maximum(kept, 0.0), axis=1), atol=1e-9)


@pytest.mark.parametrize("seed", range(12))
def test_pairs_of_one_stage_or_at_different_levels_are_set_aside_where_they_stay_apart(
    seed: int,
) -> None:
    rng = np.random.default_rng(seed)
    bodies, limits = drawn_bodies(rng, 2), Limits(0.1, 0.01, (0.1, 0.02))
    reach = np.sort(rng.uniform(-6, 6, (2, 2)), axis=1)
    made = scene_of(("p", "q"), bodies, (), reach=reach, home=np.zeros(2), limits=limits)
    wanted = set()
    for i, j in itertools.combinations(range(9), 2):
        a, b = bodies[i], bodies[j]
        gaps = apart_along(a, b, reach)
        still = (a.slides == b.slides).all(axis=0)
        built_in = (
            a.stage == b.stage
            or "world" in (a.stage, b.stage)
            or (gaps[still] > 0.0).any()
        )
        if built_in and np.linalg.norm(np.maximum(gaps, 0.0)) > 0.11:
            wanted.add((i, j))
    assert set(made.distant) == wanted
    assert sorted((*made.pairs, *made.distant)) == list(
        itertools.combinations(range(9), 2)
    )


def test_the_least_clearance_of_a_machine_is_right_to_a_tenth_or_two_percent() -> None:
    assert [scene().limits.slack(mm) for mm in (1.0, 5.0, 50.0)] == [0.1, 0.1, 1.0]
