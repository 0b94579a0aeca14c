"""Scripts written for a wish: read back, planned, and measured in the geometry they lead to."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexdt.twin.collision.plan_report import collision_check
from flexdt.twin.errors import LimitError
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.machine.camera import CameraSettings, Roi
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    builtin_profile,
    parse_machine,
    profile_of,
)
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.script import ScanPlan, check_script, parse_script, plan_script
from flexdt.twin.script.compose import compose_script
from flexdt.twin.script.planning.open_beam_findings import OPEN_BEAM_CODES
from flexdt.twin.script.scan_request import KINDS, Kind, ScanPosition, ScanRequest

MACHINE = builtin_machine()
PROFILE = builtin_profile(MACHINE.default_profile)


def planned(
    wish: ScanRequest, machine: Machine = MACHINE, profile: Profile = PROFILE
) -> ScanPlan:
    return plan_script(
        parse_script(compose_script(wish, machine, profile)), machine, profile
    )


def geometry(plan: ScanPlan) -> tuple[ConeVec, CameraSettings]:
    """Nominal cone_vec of every projection."""
    images = [e for e in plan.exposures if e.kind == "projection"]
    camera = images[0].camera
    positions = {
        a: np.array([e.positions[a] for e in images]) for a in images[0].positions
    }
    return poses(MACHINE, PROFILE, camera, positions).cone_vec(), camera


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_plans_without_a_word(kind: Kind) -> None:
    plan = planned(ScanRequest(kind=kind, frames=25, exposure_ms=1000))
    assert plan.problems == ()
    kinds = [e.kind for e in plan.exposures if e.file is not None]
    assert kinds[:2] == ["dark", "flat"]
    assert set(kinds[2:]) == {"projection"}
    files = [e.file for e in plan.exposures if e.kind == "projection"]
    assert files == [f"scan_{i:06d}.tif" for i in range(len(files))]
    assert not next(e for e in plan.exposures if e.kind == "dark").xrays_on
    assert all(e.xrays_on for e in plan.exposures if e.kind != "dark")


@pytest.mark.parametrize("kind", KINDS)
def test_what_a_request_leaves_out_is_what_its_description_says(kind: Kind) -> None:
    stated = ScanRequest(
        kind, 600.0, 1059.0, 361, 100.0, 1, 20.0, 3.0, 20.0, 2,
        (ScanPosition(600.0), ScanPosition(800.0)), "HW2SW1High", Roi(32, 8, 1943, 1527), 90.0,
        50.0, 10, 10,
    )  # fmt: skip
    text = compose_script(stated, MACHINE, PROFILE)
    assert compose_script(ScanRequest(kind), MACHINE, PROFILE) == text
    changed = replace(stated, exposure_ms=120.0, averages=3, mode="HW4SW1High", kV=70.0,
                      power_W=30.0, roi=Roi(0, 400, 999, 1199), darks=7, flats=8)  # fmt: skip
    at = compose_script(changed, MACHINE, PROFILE).splitlines()
    said = [line.split("\t")[1:3] for line in at]
    for words in (["set exposure", "120.000000"], ["set mode", "HW4SW1High"],
                  ["set kV", "70.000000"], ["set power", "30.000000"],
                  ["set ROI", str(changed.roi)]):  # fmt: skip
        assert said.count(words) == 1
    averages = [value for command, value in said if command == "set number of averages"]
    assert averages == ["7", "8", *["3"] * (len(averages) - 2)]


@pytest.mark.parametrize(
    ("field", "least", "most"),
    [
        ("frames", 2, 100_000), ("averages", 1, 10_000), ("darks", 1, 10_000),
        ("flats", 1, 10_000), ("tiles", 1, 100), ("exposure_ms", 1.0, 60_000.0),
        ("turns", 1e-3, 40.0), ("rise_mm", 1e-3, 1e6), ("height_mm", -1e6, 1e6),
        ("sdd_mm", 1e-3, 1e6), ("sod_mm", 1e-3, 1000.0), ("placements", 1, 100),
        ("lateral", -1e6, 1e6),
    ],
)  # fmt: skip
def test_figures_of_a_request_have_bounds(field: str, least: float, most: float) -> None:
    """At a bound another limit may be met, but not this one."""
    step = 1 if isinstance(least, int) else 0.01
    for value, fine in (
        (least, True), (most, True), (least - abs(step * least), False),
        (most + abs(step * most), False), (most + 1, False), (math.inf, False), (math.nan, False),
    ):  # fmt: skip
        name, asked = field, value
        if field == "placements" and math.isfinite(value):
            asked = [ScanPosition(600.0)] * int(value)  # type: ignore[assignment]
        elif field in ("placements", "lateral"):
            name, asked = "placements", (ScanPosition(600.0, value),)  # type: ignore[assignment]
        whole = dict.fromkeys((name,), asked) | (
            {} if field == "sdd_mm" else {"sdd_mm": 1000.0}
        )
        found: object = None
        try:
            compose_script(ScanRequest(**whole), MACHINE, PROFILE)  # type: ignore[arg-type]
        except LimitError as error:
            found = error.data.get("setting")
        assert (found != name) == fine, value


def test_moves_begin_together_and_are_waited_for_one_by_one() -> None:
    rows = [
        line.split("\t")
        for line in compose_script(ScanRequest(), MACHINE, PROFILE).splitlines()
    ]
    moves = [(row[0], row[2], row[4]) for row in rows if row[1] == "move absolute"]
    names = {
        "mag_obj",
        "mag_det",
        "tra_obj",
        "tra_det",
        "tra_tube",
        "ver_tube",
        "ver_det",
    }
    begun = [move[:2] for move in moves[:7]]
    assert {name for name, _ in begun} == names
    assert moves[:14] == [(*move, "no wait") for move in begun] + [
        (*move, "ACK") for move in begun
    ]
    # Then the sample alone goes into the beam, and the turntable turns.
    assert [(name, wait) for name, _, wait in moves[14:]] == [
        ("tra_obj", "ACK"), ("rot_obj", "ACK"), ("rot_obj", "POS"),
    ]  # fmt: skip


CABINET_AXIS = "[axes.{name}]\nlower = {lower}\nupper = {upper}\nhome = {home}\n"


@pytest.mark.parametrize("factor", [-2.0, -1.0, -0.5, 0.5, 1.0, 2.0])
@pytest.mark.parametrize("motor", ["X", "Y"])
@pytest.mark.parametrize("room", [(-40.0, 600.0), (-600.0, 40.0), (-20.0, 30.0)])
def test_the_sample_leaves_the_beam_by_the_freer_side(
    factor: float, motor: str, room: tuple[float, float]
) -> None:
    """By hand: 300 of 1000 mm, 2000 pixels of 0.2 mm, and 60 mm more; or what room there is."""
    gone = "" if motor == "X" else 'without = ["X"]\n'
    quantity = "object_x" if motor == "X" else "object_z"
    machine = parse_machine(
        f'base = "xyzr_cabinet"\nname = "mine"\n{gone}[geometry]\n'
        f"{quantity} = {{ {motor} = {factor} }}\n"
        + CABINET_AXIS.format(name=motor, lower=room[0], upper=room[1], home=0.0)
    )
    request = ScanRequest(
        frames=41, exposure_ms=500, sod_mm=300, sdd_mm=1000, height_mm=0.0
    )
    rows = [line.split("\t") for line in compose_script(
        request, machine, profile_of(machine)).splitlines()]  # fmt: skip
    first, *_, last = [
        float(row[2])
        for row in rows
        if row[:2] == [motor, "move absolute"] and row[4] == "ACK"
    ]
    away = (2000 * 0.2 * 300 / 1000 / 2 + 60) / abs(factor)
    freer = room[0] if -room[0] > room[1] else room[1]
    assert first == pytest.approx(math.copysign(min(away, abs(freer)), freer), abs=1e-5)
    assert last == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("beside", [0.099, 0.101])
@pytest.mark.parametrize(
    ("quantity", "mm"),
    [
        ("source_x", 400.0),
        ("detector_x", 400.0),
        ("source_z", 400.0),
        ("object_x", 120.0),
    ],
)
def test_what_no_motor_moves_may_stand_a_tenth_of_the_view_beside(
    quantity: str, mm: float, beside: float
) -> None:
    """2000 pixels of 0.2 mm; at the sample, 300 of 1000 mm, less."""
    gone = 'without = ["X"]\n' if quantity == "object_x" else ""
    heights = f"\ndetector_z = {mm * beside}" if quantity == "source_z" else ""
    machine = parse_machine(
        f'base = "xyzr_cabinet"\nname = "mine"\n{gone}[fixed]\n'
        f"{quantity} = {mm * beside}{heights}\n"
    )
    request = ScanRequest(
        frames=41, exposure_ms=500, sod_mm=300, sdd_mm=1000, height_mm=0.0
    )
    if beside < 0.1:
        assert compose_script(request, machine, profile_of(machine))
    else:
        with pytest.raises(LimitError, match="no motor for"):
            compose_script(request, machine, profile_of(machine))


def test_the_form_is_the_scanners_own() -> None:
    text = compose_script(ScanRequest(), MACHINE, PROFILE)
    lines = text.split("\r\n")
    assert lines.pop() == ""
    assert all(line.count("\t") == 6 for line in lines)


@settings(max_examples=25, deadline=None)
@given(
    sod=st.floats(200.0, 900.0),
    extra=st.floats(100.0, 400.0),
    height=st.floats(20.0, 60.0),
    left=st.integers(0, 300),
    top=st.integers(0, 300),
)
def test_everything_comes_out_centred(
    sod: float, extra: float, height: float, left: int, top: int
) -> None:
    sdd = min(sod + extra, 1099.0)
    wish = ScanRequest(frames=5, exposure_ms=1000, averages=2, sod_mm=sod, sdd_mm=sdd,
                       height_mm=height, roi=Roi(left, top, 1899, 1499))  # fmt: skip
    cone_vec, camera = geometry(planned(wish))
    rows, cols = camera.shape
    at_height = [[0.0, 0.0, height - MACHINE.sample_height_mm]]
    centre = cone_vec.project_points(at_height, (rows, cols))
    middle = [[(cols - 1) / 2, (rows - 1) / 2]] * 5
    np.testing.assert_allclose(centre[:, 0], middle, atol=1e-3)
    np.testing.assert_allclose(cone_vec.source_detector_distance, sdd, atol=1e-5)
    np.testing.assert_allclose(
        np.linalg.norm(cone_vec.source[:, :2], axis=1), sod, atol=1e-5
    )


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 750).map(lambda k: 2 * k), st.integers(150, 249).map(lambda k: 2 * k + 1),
    st.integers(0, 850).map(lambda k: 2 * k), st.integers(50, 149).map(lambda k: 2 * k + 1),
)  # fmt: skip
def test_the_sample_goes_to_a_region_of_a_panel_that_stands_still(
    left, wide, top, high
) -> None:
    cabinet = builtin_machine("xyzr_cabinet")
    wish = ScanRequest(frames=41, exposure_ms=500, sod_mm=300, sdd_mm=1000,
                       roi=Roi(left, top, left + wide, top + high))  # fmt: skip
    rows = [line.split("\t") for line in compose_script(
        wish, cabinet, profile_of(cabinet)).splitlines()]  # fmt: skip
    at = {
        row[0]: float(row[2])
        for row in rows
        if row[1] == "move absolute" and row[0] in "XYZ"
    }
    # By hand: the middle of 2000 pixels of 0.2 mm is 999.5, a magnification of 1000 / 300.
    assert 999.5 + at["X"] * (1000 / 300) / 0.2 == pytest.approx(
        left + wide / 2, abs=1e-3
    )
    assert 999.5 - at["Y"] * (1000 / 300) / 0.2 == pytest.approx(top + high / 2, abs=1e-3)
    assert at["Z"] == 300.0


def test_fly_images_follow_the_smooth_scan_rule() -> None:
    plan = planned(ScanRequest(frames=37, exposure_ms=200))
    angles = [e.positions["rot_obj"] for e in plan.exposures if e.kind == "projection"]
    np.testing.assert_allclose(angles, 10.0 * np.arange(37), atol=1e-6)


def test_step_images_do_not_repeat_the_first_angle() -> None:
    plan = planned(ScanRequest(kind="step", frames=36))
    images = [e for e in plan.exposures if e.kind == "projection"]
    np.testing.assert_allclose(
        [e.positions["rot_obj"] for e in images], 10.0 * np.arange(36), atol=1e-9
    )
    assert not any(e.moving for e in images)


def test_helix_rises_evenly_and_symmetrically() -> None:
    plan = planned(
        ScanRequest(kind="helical", frames=241, turns=4.0, rise_mm=16.0, height_mm=25.0)
    )
    images = [e for e in plan.exposures if e.kind == "projection"]
    angle = np.array([e.positions["rot_obj"] for e in images])
    for axis, offset in (("ver_tube", PROFILE.src_ort), ("ver_det", 0.0)):
        height = np.array([e.positions[axis] for e in images]) + offset
        expected = 25.0 + 16.0 * (angle / 1440.0 - 0.5)
        np.testing.assert_allclose(height, expected, atol=1e-5)
    np.testing.assert_allclose(angle, 6.0 * np.arange(241), atol=1e-6)


def test_where_nothing_else_rises_the_sample_sinks_through_the_helix() -> None:
    cabinet = builtin_machine("xyzr_cabinet")
    wish = ScanRequest(kind="helical", frames=481, turns=4.0, rise_mm=16.0)
    plan = planned(wish, cabinet, profile_of(cabinet))
    images = [e.positions for e in plan.exposures if e.kind == "projection"]
    heights = np.array([at["Y"] for at in images])
    expected = -16.0 * (np.array([at["R"] for at in images]) / 1440.0 - 0.5)
    np.testing.assert_allclose(heights, expected, atol=1e-5)


def test_tiles_lie_side_by_side_with_a_tenth_shared() -> None:
    plan = planned(ScanRequest(kind="tiled", frames=9, exposure_ms=1000, tiles=3))
    cone_vec, camera = geometry(plan)
    centre = cone_vec.project_points([[0.0, 0.0, 0.0]], camera.shape)[::9, 0, 0]
    np.testing.assert_allclose(np.diff(centre), -0.9 * camera.shape[1], atol=1e-3)


def test_placements_are_where_they_were_asked() -> None:
    wish = ScanRequest(
        kind="calibration",
        frames=9,
        exposure_ms=1000,
        placements=(ScanPosition(500, 5), ScanPosition(800, -7)),
    )
    plan = planned(wish)
    images = [e for e in plan.exposures if e.kind == "projection"]
    for k, (sod, lateral) in enumerate(((500, 5), (800, -7))):
        p = images[9 * k].positions
        assert p["mag_obj"] + PROFILE.c_obj == pytest.approx(sod)
        assert p["tra_obj"] + PROFILE.axs_tan == pytest.approx(lateral)


def test_the_sample_is_out_of_the_beam_for_the_flat() -> None:
    plan = planned(ScanRequest(sod_mm=600))
    flat = next(e for e in plan.exposures if e.kind == "flat")
    first = next(e for e in plan.exposures if e.kind == "projection")
    half_view = 956 * 0.1496 * 600 / 1059 / 2
    assert abs(flat.positions["tra_obj"] - first.positions["tra_obj"]) > half_view + 50


@pytest.mark.parametrize(
    ("wish", "says"),
    [
        (ScanRequest(frames=1), "frames is 1; allowed: 2 to"),
        (ScanRequest(averages=0), "averages"),
        (ScanRequest(sod_mm=1200), "sod_mm is 1200; allowed"),
        (ScanRequest(sdd_mm=2000), "mag_det target"),
        (ScanRequest(frames=5, exposure_ms=10), "turns at most 90 deg/s"),
        (ScanRequest(kind="helical", rise_mm=200), "ver_tube target"),
        (
            ScanRequest(kind="helical", rise_mm=3000, turns=1),
            "raise frames, exposure or averages",
        ),
        (
            ScanRequest(kind="helical", turns=30, frames=20_000),
            "rot_obj target .* fewer degrees .* more time",
        ),
        (ScanRequest(exposure_ms=float("nan")), "exposure_ms"),
    ],
)
def test_impossible_wishes_say_why(wish: ScanRequest, says: str) -> None:
    with pytest.raises(LimitError, match=says):
        compose_script(wish, MACHINE, PROFILE)


def test_a_turntable_of_one_turn_has_no_room_for_the_run_up() -> None:
    text = 'base = "flexray"\nname = "one"\n[axes.rot_obj]\nlower = 0.0\nupper = 360.0\n'
    machine = parse_machine(text, "one.toml")
    with pytest.raises(
        LimitError, match=r"rot_obj target -.* step scan has no run-up.* more time"
    ) as refused:
        compose_script(ScanRequest(kind="fly"), machine, PROFILE)
    assert refused.value.data["allowed"] == [0.0, 360.0]


def shared_machine(rng: np.random.Generator) -> Machine:
    """A machine without bodies whose distances and heights are drawn sums of shared motors."""
    base = 'base = "xyzr_cabinet"\nname = "shared"\nwithout = ["X", "Y", "Z", "floor", "source", '
    text = base + '"z_carriage", "x_carriage", "lift", "turntable", "mount", "panel"]\n'
    text += "allowed_contacts = []\n[geometry]\n"
    quantities = (
        "object_y",
        "detector_y",
        "object_x",
        "source_z",
        "detector_x",
        "detector_z",
    )
    signs = {q: float(rng.choice([-2.0, -1.0, 0.5, 1.0])) for q in quantities}
    for q in quantities:
        own = {f"own_{q}": signs[q]}
        others = [other for other in quantities if other != q and rng.random() < 0.25]
        shared = {
            f"own_{other}": float(rng.choice([-0.5, 0.25, 0.5])) for other in others
        }
        text += (
            f"{q} = {{ {', '.join(f'{m} = {f}' for m, f in (shared | own).items())} }}\n"
        )
    text += "[fixed]\nobject_y = 300.0\ndetector_y = 900.0\n"
    for q in quantities:
        text += (
            f"[axes.own_{q}]\nlower = -3000.0\nupper = 3000.0\nhome = 0.0\nspeed = 50.0\n"
            "max_speed = 50.0\nacceleration = 50.0\nmax_acceleration = 50.0\n"
        )
    return parse_machine(text)


@pytest.mark.daily(10)
@pytest.mark.parametrize("seed", range(60))
def test_motors_that_share_a_distance_come_out_right_or_are_said(seed: int) -> None:
    """The witness adds up what the script's own moves say; it does not plan them."""
    rng = np.random.default_rng(seed)
    machine = shared_machine(rng)
    sod, sdd, height = (float(v) for v in rng.uniform((100, 600, -20), (400, 1000, 20)))
    kind: Kind = ("fly", "step", "tiled", "calibration")[seed % 4]  # type: ignore[assignment]
    wish = ScanRequest(kind=kind, sod_mm=sod, sdd_mm=sdd, height_mm=height, frames=3,
                       exposure_ms=20_000, roi=Roi(100, 40, 1899, 1999), tiles=3,
                       placements=(ScanPosition(sod, 4.0),
                                   ScanPosition(sod + 30, -6.0)))  # fmt: skip
    try:
        text, said = compose_script(wish, machine, profile_of(machine)), ""
    except LimitError as error:
        said = error.message
    if said:
        assert "has no motor of its own for" in said
        assert any(len(factors) > 1 for factors in machine.geometry.values())
        return
    at = {name: axis.home for name, axis in machine.axes.items()}
    seen = []
    for line in text.splitlines():
        name, command, value, *_ = line.split("\t")
        if command == "move absolute":
            at[name] = float(value)
        if command in ("take image", "take and save image sequence"):
            seen.append(
                {q: machine.fixed.get(q, 0.0) + sum(f * at[m] for m, f in factors.items())
                 for q, factors in machine.geometry.items() if q != "angle"}
            )  # fmt: skip
    _, flat, *images = seen
    places = [(4.0, 0.0), (-6.0, 30.0)] if kind == "calibration" else [(0.0, 0.0)]
    shifts = [-1, 0, 1] if kind == "tiled" else [0]
    wanted = [(across, further, shift) for across, further in places for shift in shifts]
    wanted = wanted * (len(images) // len(wanted))
    for place, (across, further, shift) in zip(images, wanted, strict=True):
        assert place["object_y"] == pytest.approx(sod + further, abs=1e-4)
        assert place["detector_y"] == pytest.approx(sdd, abs=1e-4)
        assert place["object_x"] == pytest.approx(across, abs=1e-4)
        assert place["source_z"] == pytest.approx(height, abs=1e-4)
        # The region's middle is (100 - 100) / 2 columns and (40 - 0) / 2 rows off the panel's.
        assert place["detector_x"] == pytest.approx(shift * 0.9 * 900 * 0.4, abs=1e-4)
        assert place["detector_z"] == pytest.approx(height + 20 * 0.2, abs=1e-4)
    assert abs(flat["object_x"]) > 1000 * 0.2 * 900 / 1000 * sod / sdd / 2
    assert flat["detector_y"] == pytest.approx(sdd, abs=1e-4)


def test_the_beam_is_at_the_height_of_the_sample() -> None:
    machine = builtin_machine("unitom_xl")
    profile = builtin_profile(machine.default_profile)
    plan = plan_script(
        parse_script(
            compose_script(ScanRequest(frames=5, exposure_ms=2000), machine, profile)
        ),
        machine,
        profile,
    )
    last = next(e for e in plan.exposures if e.kind == "projection")
    assert last.positions["ver_tube"] + profile.src_ort == pytest.approx(
        169.604412, abs=1e-5
    )


def test_one_motor_for_two_distances_is_said() -> None:
    text = (
        'base = "xyzr_cabinet"\nname = "carriage"\nwithout = ["source", "panel", "turntable", '
        '"mount", "lift", "x_carriage", "z_carriage", "floor"]\nallowed_contacts = []\n'
        "[geometry]\ndetector_y = { Z = 1.0 }\n[fixed]\ndetector_y = 500.0\n"
    )
    machine = parse_machine(text)
    with pytest.raises(
        LimitError, match=r"no motor of its own for .*: 700 mm .* it is 600 mm"
    ):
        compose_script(
            ScanRequest(sod_mm=100.0, sdd_mm=700.0, frames=3, exposure_ms=20_000),
            machine,
            profile_of(machine),
        )


AXIS = (
    "lower = -500.0\nupper = 500.0\nspeed = 50.0\nmax_speed = 50.0\nacceleration = 50.0\n"
    "max_acceleration = 50.0\n"
)
BARE = (
    'base = "xyzr_cabinet"\nname = "bare"\nwithout = ["source", "panel", "turntable", "mount", '
    '"lift", "x_carriage", "z_carriage", "floor"{more}]\nallowed_contacts = []\n'
)


@pytest.mark.parametrize(
    ("more", "text", "kind", "says"),
    [
        ("", "[geometry]\nangle = { R = 0.5 }", "fly", "turns the sample by"),
        ("", f"[axes.T]\nkind = 'rotation'\n{AXIS}home = 0.0\n[geometry]\n"
         "angle = { R = 1.0, T = 1.0 }", "fly", "turns the sample by"),
        ("", "[fixed]\nsource_z = 80.0", "fly", "no motor for the height of the detector"),
        (', "X"', "[fixed]\nobject_x = 50.0", "fly", "no motor for the sample sideways"),
        ("", "[fixed]\ndetector_x = 80.0", "fly", "no motor for the detector sideways"),
        ("", "[fixed]\nsource_x = -80.0", "fly", "no motor for the source sideways"),
        (', "Y"', "sample_height_mm = 90.0", "fly", "no motor for the height of the sample"),
        ("", f"[axes.S]\n{AXIS}home = 0.0\n[geometry]\nsource_z = {{ S = 1.0 }}\n"
         "detector_z = { S = 1.0 }\n[fixed]\ndetector_z = 30.0", "fly",
         "no motor of its own for the height of the detector"),
        ("", f"[axes.S]\n{AXIS}home = 0.0\n[geometry]\nsource_z = {{ S = 1.0 }}\n"
         "detector_z = { S = 1.0 }", "helical", "move something else too"),
        ("", f"[axes.S]\n{AXIS}home = 0.0\n[geometry]\nsource_z = {{ S = 1.0 }}\n"
         "detector_z = { Y = -1.0 }", "helical", "move something else too|of its own"),
        ("", "[geometry]\ndetector_x = { X = 1.0 }", "tiled", "of its own for the (det|sam)"),
        ("", f"[axes.S]\n{AXIS}home = 0.0\n[geometry]\ndetector_x = {{ S = 1.0 }}\n"
         "source_x = { S = 1.0 }", "tiled", "of its own for the source sideways"),
    ],
)  # fmt: skip
def test_what_cannot_be_centred_is_said(
    more: str, text: str, kind: Kind, says: str
) -> None:
    head = BARE.replace("{more}", more)
    if text.startswith("sample_height_mm"):
        head, text = head + text + "\n", ""
    machine = parse_machine(head + text)
    with pytest.raises(LimitError, match=says) as caught:
        compose_script(
            ScanRequest(kind=kind, frames=61, exposure_ms=1000),
            machine,
            profile_of(machine),
        )
    if says == "turns the sample by":
        assert caught.value.data["allowed"] == [1.0, -1.0]


@pytest.mark.parametrize(("upper", "second"), [(700.0, False), (800.0, True)])
def test_a_second_place_is_chosen_where_there_is_room(upper: float, second: bool) -> None:
    """SOD 600 and 800; or 600 and as at home, which is the first here."""
    machine = parse_machine(
        'base = "xyzr_cabinet"\nname = "mine"\n[fixed]\ndetector_y = 1059.0\n'
        f"[axes.X]\nupper = 0.0\nhome = 0.0\n[axes.Z]\nupper = {upper}\nhome = 600.0\n"
    )
    text = compose_script(
        ScanRequest("calibration", frames=41, exposure_ms=500),
        machine,
        profile_of(machine),
    )
    rows = [line.split("\t") for line in text.splitlines()]
    at = [
        float(row[2])
        for row in rows
        if row[:2] == ["Z", "move absolute"] and row[4] == "ACK"
    ]
    assert at == [600.0, 600.0, *([800.0] if second else [])]


def test_a_second_motor_of_a_distance_is_sent_home() -> None:
    text = (
        f"[axes.ZF]\n{AXIS}home = 5.0\n[geometry]\nobject_y = {{ Z = 1.0, ZF = 1.0 }}\n"
    )
    machine = parse_machine(BARE.replace("{more}", "") + text)
    request = ScanRequest(frames=61, exposure_ms=1000, sod_mm=300.0)
    rows = [
        line.split("\t")
        for line in compose_script(request, machine, profile_of(machine)).splitlines()
    ]
    moves = {row[0]: float(row[2]) for row in rows if row[1] == "move absolute"}
    assert (moves["Z"], moves["ZF"]) == (295.0, 5.0)


@pytest.mark.parametrize("roll", [3.0, 90.0, -40.0])
def test_a_region_of_a_rolled_panel_is_centred(roll: float) -> None:
    profile = PROFILE.model_copy(update={"det_roll_deg": roll})
    wish = ScanRequest(frames=3, exposure_ms=5000, roi=Roi(400, 0, 1399, 1135))
    text = compose_script(wish, MACHINE, profile)
    plan = plan_script(parse_script(text), MACHINE, profile)
    image = next(e for e in plan.exposures if e.kind == "projection")
    place = {axis: np.array([value]) for axis, value in image.positions.items()}
    cone = poses(MACHINE, profile, image.camera, place).cone_vec()
    rows, cols = image.camera.shape
    [[centre]] = cone.project_points([[0.0, 0.0, 0.0]], (rows, cols))
    np.testing.assert_allclose(centre, [(cols - 1) / 2, (rows - 1) / 2], atol=1e-3)


def drawn_machine(rng: np.random.Generator) -> Machine:
    """One that ships, with other ends of travel, speeds and exposures."""
    name = str(rng.choice(["flexray", "unitom_xl", "xyzr_cabinet", "micro_ct"]))
    text = f'base = "{name}"\nname = "drawn"\n'
    for axis, a in builtin_machine(name).axes.items():
        if rng.random() < 0.6:
            continue
        if a.kind == "rotation":
            pace, acceleration = (
                float(rng.choice([5, 20, 45])),
                float(rng.choice([5, 20])),
            )
            ends = (
                -float(rng.choice([0, 10, 400])),
                float(rng.choice([200, 360, 400, 7200])),
            )
            text += f"[axes.{axis}]\nspeed = {pace}\nmax_speed = {pace}\n"
            text += f"acceleration = {acceleration}\n"
        else:
            down, up = (float(x) for x in rng.uniform(0, 0.9, 2))
            ends = a.lower + down * (a.home - a.lower), a.upper - up * (a.upper - a.home)
            text += f"[axes.{axis}]\n"
        text += f"lower = {ends[0]}\nupper = {ends[1]}\n"
    least, most = [(1.0, 60.0), (60.0, 900.0), (400.0, 60_000.0)][int(rng.integers(3))]
    text += f"[detector]\nmin_exposure_ms = {least}\nmax_exposure_ms = {most}\n"
    return parse_machine(f"{text}exposure_ms = {min(most, 500.0)}\n")


@pytest.mark.daily(1)
@pytest.mark.parametrize("block", range(3))
def test_no_machine_is_proposed_what_its_own_check_refuses(block: int) -> None:
    """With collisions; what a machine cannot do is refused before there is a script."""
    made = 0
    for seed in range(10 * block, 10 * block + 10):
        machine = drawn_machine(np.random.default_rng(8000 + seed))
        profile = profile_of(machine)
        for kind in KINDS:
            try:
                text = compose_script(ScanRequest(kind=kind), machine, profile)
            except LimitError:
                continue
            made += 1
            sweep = collision_check() if machine.components else None
            report = check_script(text, machine, profile, collision=sweep)
            assert report.ok, (seed, kind, [p.placed_text for p in report.problems])
            codes = {p.code for p in report.problems}
            assert codes <= {"default_assumed", "sample_in_flat", *OPEN_BEAM_CODES}
    assert made > 5


@pytest.mark.parametrize(
    ("wish", "says"),
    [
        (ScanRequest(exposure_ms=0.5), "exposure_ms 0.5 is outside"),
        (ScanRequest(kV=500.0), "kV 500 is outside"),
        (ScanRequest(power_W=500.0), "power_W 500 is outside"),
        (ScanRequest(mode="HW3SW1High"), "does not exist; allowed: HW"),
        (ScanRequest(roi=Roi(0, 0, 0, 99)), "holds no pixel"),
    ],
)
def test_settings_beyond_the_machine_s_are_refused(wish: ScanRequest, says: str) -> None:
    machine = builtin_machine()
    with pytest.raises(LimitError, match=says):
        compose_script(wish, machine, profile_of(machine))
