"""Frames, signs and the nominal geometry of Listing 1, against hand computation."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.twin.geometry.cone_vec import ConeVec, check_cone_vec
from flexdt.twin.geometry.conventions import from_unity, stage_rotation
from flexdt.twin.geometry.offsets import NAMES, Offsets
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses, resolve_targets, virtual_reading

to_unity = from_unity  # a swap

LISTING_1 = {
    "tra_tube": 0.0,
    "ver_tube": 40.0,
    "tra_det": 25.319824,
    "ver_det": 33.696938,
    "mag_det": 1059.0,
    "mag_obj": 660.0,
    "tra_obj": 0.0,
}


def test_listing_1_default_profile_is_centred_and_magnifies_by_1_628() -> None:
    m = builtin_machine()
    p = poses(m, builtin_profile(m.default_profile), m.detector.camera, LISTING_1)
    assert p.sdd[0] / p.sod[0] == pytest.approx(1.628, abs=5e-4)
    assert abs(p.detector[0, 0] - p.source[0, 0]) < 0.01
    assert abs(p.detector[0, 2] - p.source[0, 2]) < 0.02


def test_listing_1_thesis_profile_magnifies_by_1_605_clamped() -> None:
    m = builtin_machine()
    p = poses(m, builtin_profile("thesis"), m.detector.camera, LISTING_1)
    assert p.sdd[0] / p.sod[0] == pytest.approx(1059 / 660)
    assert p.source[0] == pytest.approx([0.0, 0.0, 40.0])


def test_object_turns_clockwise_seen_from_above() -> None:
    # A quarter turn: what pointed away from the source (+y) points to the right (+x).
    assert_allclose(stage_rotation(math.pi / 2) @ [0, 1, 0], [1, 0, 0], atol=1e-15)


def test_growing_rot_obj_turns_the_source_counter_clockwise_in_the_object_frame() -> None:
    m = builtin_machine()
    p = poses(m, builtin_profile("thesis"), m.detector.camera, {"rot_obj": [0.0, 90.0]})
    source = p.cone_vec().source
    assert source[0, 1] < 0
    assert source[1, 0] > 0  # ASTRA's cone: (sin, -cos) * SOD
    assert_allclose(source[1, 0], p.sod[0])


def test_unity_swap_changes_handedness_and_is_its_own_inverse() -> None:
    swap = np.stack([from_unity(e) for e in np.eye(3)], axis=1)
    assert np.linalg.det(swap) == pytest.approx(-1)
    assert_allclose(to_unity(from_unity([1.0, 2.0, 3.0])), [1, 2, 3])


def test_correction_moves_points_as_equation_5_4_says() -> None:
    """Equation 5.4 written out in Unity's axes, projected by hand, against ConeVec."""
    m = builtin_machine()
    nominal = poses(
        m, builtin_profile("thesis"), m.detector.camera, {"rot_obj": [0, 40, 200]}
    )
    edge = {
        "dO_x": -10.0, "dO_y": 5.0, "dO_z": -19.0, "alpha": 10.0, "tau_x": 1.5, "tau_z": -2.5,
        "dD_x": 3.0, "dD_y": -4.0, "dD_z": 6.0, "dS_x": 0.5, "dS_y": -0.25, "angle_scale": 1.01,
    }  # fmt: skip
    cone = nominal.cone_vec(Offsets.from_edge(edge))
    b = np.array([3.0, 7.0, -4.0])  # Unity axes
    rows, cols = 760, 956
    seen = cone.project_points(from_unity(b)[None], (rows, cols))[:, 0]
    for i, phi in enumerate(np.radians([0, 40, 200])):
        a = math.radians(10.0) + 1.01 * phi
        r_y = np.array(
            [[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]
        )
        tau = np.array([1.5, 0, -2.5])
        o = to_unity(nominal.axis[i]) + [-10, 5, -19]
        q = tau + r_y @ (b - tau) + o
        s = to_unity(nominal.source[i]) + [0.5, -0.25, 0]
        d = to_unity(nominal.detector[i]) + [3, -4, 6]
        scale = (d[2] - s[2]) / (q[2] - s[2])
        x, y = s[:2] + scale * (q[:2] - s[:2]) - d[:2]
        expected = [x / 0.1496 + (cols - 1) / 2, -y / 0.1496 + (rows - 1) / 2]
        assert_allclose(seen[i], expected, atol=1e-9)


def test_cone_vec_is_a_value() -> None:
    m = builtin_machine()
    cone = poses(
        m, builtin_profile("thesis"), m.detector.camera, {"rot_obj": [0, 33.0]}
    ).cone_vec()
    assert eval(repr(cone), {"ConeVec": ConeVec}) == cone
    assert hash(ConeVec(cone.rows.copy())) == hash(cone)
    assert ConeVec.concatenate([cone[0:1], cone[1]]) == cone
    with pytest.raises(ValueError, match="read-only"):
        cone.rows[0, 0] = 1.0
    check_cone_vec(cone, 0.1496)


def test_parameters_round_trip_in_edge_units() -> None:
    edge = {name: 0.25 * (i + 1) for i, name in enumerate(NAMES)}
    assert Offsets.from_edge(edge).to_edge() == pytest.approx(edge)


def test_ver_obj_moves_source_and_detector_together() -> None:
    m = builtin_machine()
    now = {n: a.home for n, a in m.axes.items()}
    reading = virtual_reading(m, "ver_obj", now)
    targets = resolve_targets(m, {"ver_obj": reading - 10.0}, now)
    assert targets == pytest.approx({n: now[n] + 10.0 for n in ("ver_tube", "ver_det")})


@pytest.mark.parametrize(
    ("name", "u_expected", "v_expected"),
    [
        # Small right-handed turns of u = +x, v = -z written out by hand, to first order in e.
        ("det_yaw", (1, -1, 0), (0, 0, -1)),  # about v = -z: x -> -y
        ("det_pitch", (1, 0, 0), (0, 1, -1)),  # about u = +x: -z -> +y
        ("det_roll", (1, 0, -1), (-1, 0, -1)),  # about u x v = +y: x -> -z, -z -> -x
    ],
)
def test_detector_tilts_are_right_handed(
    name: str, u_expected: tuple[int, int, int], v_expected: tuple[int, int, int]
) -> None:
    m = builtin_machine()
    e = 1e-6
    nominal = poses(m, builtin_profile("thesis"), m.detector.camera, {"rot_obj": 0.0})
    cone = nominal.cone_vec(Offsets.from_edge({name: math.degrees(e)}))
    scale = np.array([1, e, 1]) if name != "det_roll" else np.array([1, 1, e])
    u, v = np.array(u_expected, float), np.array(v_expected, float)
    if name == "det_roll":
        u, v = u * scale, v * np.array([e, 1, 1])
    else:
        u, v = u * scale, v * scale
    assert_allclose(cone.u[0] / 0.1496, u, atol=1e-11)
    assert_allclose(cone.v[0] / 0.1496, v, atol=1e-11)


def test_axis_tilts_turn_the_object_right_handed_about_world_x_then_y() -> None:
    m = builtin_machine()
    nominal = poses(m, builtin_profile("thesis"), m.detector.camera, {"rot_obj": 0.0})
    top = np.array([[0.0, 0.0, 10.0]])
    shape = (760, 956)
    before = nominal.cone_vec().project_points(top, shape)[0, 0]
    # About +x the top of the object goes to -y, towards the source: no sideways motion.
    x = nominal.cone_vec(Offsets.from_edge({"axis_tilt_x": 2.0}))
    assert x.project_points(top, shape)[0, 0, 0] == pytest.approx(before[0], abs=1e-9)
    # About +y the top goes to +x, to the right: a larger column.
    y = nominal.cone_vec(Offsets.from_edge({"axis_tilt_z": 2.0}))
    assert y.project_points(top, shape)[0, 0, 0] > before[0] + 1
