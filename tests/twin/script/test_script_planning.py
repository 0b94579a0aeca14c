"""The plan against times and positions worked out by hand, and its rules of waiting."""

from __future__ import annotations

import itertools
import math
import random
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from flexdt.twin.errors import UnknownNameError
from flexdt.twin.geometry.conventions import rotation_about
from flexdt.twin.machine.description import (
    Machine,
    Profile,
    Timing,
    builtin_machine,
    builtin_machine_text,
    parse_machine,
    profile_of,
)
from flexdt.twin.scanner.state import StagePlacement
from flexdt.twin.script import (
    ScanPlan,
    StartState,
    parse_script,
    plan_poses,
    plan_script,
)
from flexdt.twin.script.planning.plan_values import SampleSize
from tests.twin.script.conftest import Planner

# FleX-ray, linear axes: 50 mm/s, 50 mm/s2; so a move of d >= 50 mm takes d / 50 + 1 s, a
# shorter one 2 sqrt(d / 50) s. Homes: tra_obj 0, mag_obj 600, ver_tube 26.2917, ver_det 20,
# rot_obj 0.
QUIET = [
    "tube set kV 90 ACK",
    "tube set power 50 ACK",
    "camera set mode HW2SW1High ACK",
    "camera set exposure 100 ACK",
    "camera set ROI 32 8 1943 1527 ACK",
    "camera set number of frames 1 ACK",
    "camera set number of averages 1 ACK",
]


def codes(plan: ScanPlan) -> list[tuple[str, str, int]]:
    return [(p.severity, p.code, p.line) for p in plan.problems]


def test_moves_take_the_trapezoid_s_time(planned: Planner) -> None:
    plan = planned("tra_obj move absolute 100 ACK", "mag_obj move absolute 608 ACK")
    long, short = plan.steps
    assert (long.start_s, long.duration_s, long.holds_s) == pytest.approx((0.0, 3.0, 3.0))
    assert (short.start_s, short.duration_s) == pytest.approx(
        (3.0, 2 * math.sqrt(8 / 50))
    )
    assert plan.duration_s == pytest.approx(3.0 + 0.8)
    assert plan.assumed_s == 0.0
    # Accelerating for 1 s covers 25 mm; at 1.5 s the axis has cruised half a second.
    at = plan.positions([-1.0, 0.0, 1.0, 1.5, 3.0, 99.0])
    assert_allclose(at["tra_obj"], [0, 0, 25, 50, 100, 100], atol=1e-12)
    assert_allclose(at["mag_obj"], [600, 600, 600, 600, 600, 608], atol=1e-12)
    assert at["tra_obj"][-1] == 100.0


@settings(max_examples=20, deadline=None)
@given(
    st.randoms(use_true_random=False), st.sampled_from(["tra_obj", "X", "Mag_x", "Rot"])
)
def test_an_axis_may_be_written_in_any_case(rng: random.Random, name: str) -> None:
    text = builtin_machine_text("flexray").replace("tra_obj", name)
    asked = "".join(rng.choice((letter.upper(), letter.lower())) for letter in name)
    lines = f"{asked} set speed 25 ACK\n{asked} move absolute 50 ACK"
    machine = parse_machine(text)
    plan = plan_script(parse_script(lines), machine, profile_of(machine))
    assert plan.problems == ()
    assert plan.steps[1].duration_s == pytest.approx(50 / 25 + 25 / 50)
    assert plan.positions([99.0])[name] == 50.0


def test_a_plan_without_motion_has_nothing_that_moves(planned: Planner) -> None:
    plan = planned("scanner pause 100 ACK", "camera take image ACK")
    assert [e.moving for e in plan.exposures] == [False]
    assert plan.steps[1].start_s == pytest.approx(0.1)
    assert plan.duration_s == pytest.approx(0.1 + plan.steps[1].duration_s)
    assert planned("scanner pause 100 ACK").duration_s == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("line", "what"),
    [
        ("rot_obj move absolute 10 5 POS", "rot_obj to 10, goes on at 5"),
        ("rot_obj move absolute 10 ACK", "rot_obj to 10"),
        ("rot_obj move absolute 10 5 no wait", "rot_obj to 10, goes on at once"),
    ],
)
def test_a_move_in_words(planned: Planner, line: str, what: str) -> None:
    assert planned(line).steps[0].what == what


def test_batches_without_wait_start_together_and_ack_waits_for_its_own_move(
    planned: Planner,
) -> None:
    plan = planned(
        "tra_obj move absolute 100 no wait",
        "mag_obj move absolute 608 no wait",
        "ver_tube move absolute 34.2917 ACK",
        "scanner pause 100 ACK",
        "tra_obj move absolute 100 ACK",
        "mag_obj move absolute 608 ACK",
    )
    assert [s.start_s for s in plan.steps] == pytest.approx([0, 0, 0, 0.8, 0.9, 3.0])
    assert [s.holds_s for s in plan.steps] == pytest.approx([0, 0, 0.8, 0.1, 2.1, 0.0])
    assert plan.duration_s == pytest.approx(3.0)


@pytest.mark.parametrize("word", ["no wait", "RCV"])
def test_what_is_not_waited_for_still_ends_the_plan(planned: Planner, word: str) -> None:
    plan = planned(f"tra_obj move absolute 100 {word}", "scanner pause 10 ACK")
    assert plan.steps[1].start_s == 0.0
    assert plan.duration_s == pytest.approx(3.0)


def test_a_retarget_in_flight_keeps_velocity_continuous(planned: Planner) -> None:
    plan = planned(
        "tra_obj move absolute 100 no wait",
        "scanner pause 1500 ACK",
        "tra_obj move absolute 0 ACK",
    )
    # At 1.5 s it is at 50 mm with 50 mm/s: 1 s to stop at 75 mm, then 75 mm back in 2.5 s.
    assert plan.steps[2].duration_s == pytest.approx(3.5)
    times = np.linspace(0, 5.2, 5201)
    x = plan.positions(times)["tra_obj"]
    assert x.max() == pytest.approx(75.0)
    assert np.abs(np.diff(x)).max() <= 50.0 * 1e-3 + 1e-9
    assert np.abs(np.diff(x, 2)).max() <= 50.0 * 1e-6 + 1e-9
    assert plan.positions(5.0)["tra_obj"] == 0.0


def test_pos_goes_on_exactly_when_the_motor_passes_the_trigger(planned: Planner) -> None:
    plan = planned(
        "rot_obj set speed 10 ACK",
        "rot_obj set acceleration 20 ACK",
        "rot_obj move absolute -5 ACK",
        "rot_obj move absolute 100 0 POS",
        "scanner pause 1 ACK",
    )
    move, after = plan.steps[3:]
    # 0.5 s of speeding up covers 2.5 deg; the other 2.5 deg take 0.25 s.
    assert after.start_s - move.start_s == pytest.approx(0.75, abs=1e-12)
    assert move.holds_s == pytest.approx(0.75)
    assert move.duration_s == pytest.approx(105 / 10 + 0.5)
    assert plan.positions(after.start_s)["rot_obj"] == pytest.approx(0.0, abs=1e-12)


def test_unreachable_trigger_is_an_error(planned: Planner) -> None:
    plan = planned("rot_obj move absolute 10 20 POS", "scanner pause 1 ACK")
    assert codes(plan) == [("error", "unreachable_trigger", 1)]
    assert not plan.ok
    assert plan.steps[1].start_s == pytest.approx(2 * math.sqrt(10 / 22.5))


def test_virtual_axis_moves_source_and_detector_in_step(planned: Planner) -> None:
    plan = planned("ver_tube set speed 10 ACK", "ver_obj move absolute 320 ACK")
    # ver_obj = 379.998 - ver_tube; from 353.7063 down to 320, both motors up by as much.
    up = 353.7063 - 320
    end = plan.positions(plan.duration_s)
    assert end["ver_tube"] == pytest.approx(59.998)
    assert end["ver_det"] == pytest.approx(20.0 + up)
    begin = plan.steps[1].start_s
    mid = plan.positions(np.linspace(begin, plan.duration_s, 50))
    assert_allclose(mid["ver_tube"] - 26.2917, mid["ver_det"] - 20.0, atol=1e-12)
    assert plan.steps[1].duration_s == pytest.approx(up / 10 + 10 / 50)


def test_limits_clamp_with_a_warning_or_reject(
    flexray: Machine, profile: Profile
) -> None:
    script = parse_script(
        "mag_det move absolute 1000 ACK\nmag_det move absolute 1060 ACK"
    )
    plan = plan_script(script, flexray, profile)
    assert codes(plan) == [("warning", "limit_clamped", 2)]
    assert "1060" in plan.warnings[0].message
    assert "1059" in plan.warnings[0].message
    assert plan.positions(1e6)["mag_det"] == 1059.0
    strict = flexray.model_copy(update={"on_limit": "reject"})
    plan = plan_script(
        script, strict, profile
    )  # 1 mm beyond is within the arrival tolerance
    assert codes(plan) == [("warning", "limit_clamped", 2)]
    beyond = parse_script(
        "mag_det move absolute 1000 ACK\nmag_det move absolute 1060.1 ACK"
    )
    plan = plan_script(beyond, strict, profile)
    assert codes(plan) == [("error", "limit", 2)]
    assert len(plan.steps) == 2
    assert codes(plan_script(beyond, flexray, profile)) == [
        ("warning", "limit_clamped", 2)
    ]


def test_a_clamped_virtual_axis_keeps_its_motors_in_step(planned: Planner) -> None:
    plan = planned(
        "ver_obj move absolute 400 ACK"
    )  # asks ver_tube for -20, ver_det for as much
    end = plan.positions(plan.duration_s)
    # ver_det may go down to 4: 16 mm, and ver_tube no farther.
    assert end["ver_det"] == pytest.approx(4.0)
    assert end["ver_tube"] == pytest.approx(10.2917)
    assert {c[1] for c in codes(plan)} == {"limit_clamped"}


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("rot_obj set speed 90.1 ACK", "limit_clamped"),
        ("rot_obj set acceleration 91 ACK", "limit_clamped"),
        ("tube set kV 91 ACK", "limit"),
        ("tube set power 91 ACK", "limit"),
        ("camera set exposure 0.5 ACK", "limit"),
        ("camera set mode HW9 ACK", "mode"),
        ("camera set ROI 32 8 1944 1527 ACK", "roi"),
        ("camera set ROI 32 8 1943 1536 ACK", "roi"),
        ("rot_det move absolute 5 ACK", "unknown_component"),
        ("tube REPEAT UNTIL TRUE status_XReady_get ACK", "xray_never_ready"),
        ("camera save image a.tif ACK", "nothing_to_save"),
        ("turret move absolute 5 ACK", "custom_component"),
    ],
)
def test_what_the_machine_does_not_allow(planned: Planner, line: str, code: str) -> None:
    assert [c[1] for c in codes(planned(line))] == [code]


def test_speeds_over_the_limit_are_set_to_it(planned: Planner) -> None:
    plan = planned("rot_obj set speed 1000 ACK", "rot_obj move absolute 360 ACK")
    assert plan.steps[1].duration_s == pytest.approx(360 / 90 + 90 / 22.5)


def test_assumed_times_come_from_the_machine_and_not_from_the_bound_in_column_7(
    flexray: Machine, planned: Planner
) -> None:
    timing = flexray.timing
    plan = planned(
        "tube xrayon ACK",
        "tube REPEAT UNTIL TRUE status_XReady_get ACK",
        "camera set mode HW2SW1High ACK 20000 3000",
        "scanner pause 1000 ACK 0 2000",
        "tube xrayoff ACK",
        "tube xrayoff ACK",
    )
    assert [s.assumed_s for s in plan.steps] == pytest.approx(
        [
            timing.xrayon_s,
            timing.xray_ready_s,
            timing.set_camera_s,
            0.0,
            timing.xrayoff_s,
            0.0,
        ]
    )
    assert plan.steps[2].assumed_from == "flexray timing"
    assert plan.steps[0].assumed_from == "flexray timing"
    assert plan.computed_s == pytest.approx(1.0)
    assert plan.duration_s == pytest.approx(plan.computed_s + plan.assumed_s)
    on = plan.beam[0]
    assert on.start_s == pytest.approx(timing.xrayon_s)
    assert on.end_s == pytest.approx(plan.steps[4].start_s)


def test_settings_of_a_tube_that_is_on_part_its_time(
    flexray: Machine, planned: Planner
) -> None:
    """Two settings at one moment make no interval between them."""
    still = Timing(source="none", xrayon_s=2.0)
    plan = plan_script(
        parse_script("tube xrayon ACK\nscanner pause 1000 ACK\ntube set kV 80 ACK\n"
                     "tube set power 40 ACK\nscanner pause 500 ACK\ntube xrayoff ACK"),
        flexray.model_copy(update={"timing": still}),
    )  # fmt: skip
    assert [(b.start_s, b.end_s, b.kV, b.power_W) for b in plan.beam] == [
        (2.0, 3.0, 90.0, 50.0), (3.0, 3.5, 80.0, 40.0),
    ]  # fmt: skip


def test_x_rays_are_ready_without_waiting_when_a_pause_has_passed(
    planned: Planner,
) -> None:
    plan = planned(
        "tube xrayon ACK",
        "scanner pause 60000 ACK",
        "tube REPEAT UNTIL TRUE status_XReady_get ACK",
    )
    assert plan.steps[2].holds_s == 0.0


def test_images_kinds_names_and_settings(planned: Planner) -> None:
    plan = planned(
        *QUIET,
        "camera set number of averages 4 ACK",
        "camera take image ACK",
        "camera take image ACK",
        "camera save image E:\\x\\di000000.tif ACK",
        "tube xrayon ACK",
        "tra_obj move absolute 150 ACK",
        "camera take image ACK",
        "camera save image /data/io000000 ACK",
        "tra_obj move absolute 0 ACK",
        "rot_obj move absolute 90 ACK",
        "camera take image ACK",
        "camera save image ..\\..\\etc\\scan_000000.tif ACK",
    )
    assert codes(plan) == []
    preview, dark, flat, projection = plan.exposures
    assert [e.kind for e in plan.exposures] == ["preview", "dark", "flat", "projection"]
    assert [e.file for e in plan.exposures] == [
        None, "di000000.tif", "io000000.tif", "scan_000000.tif",
    ]  # fmt: skip
    assert (dark.xrays_on, flat.xrays_on) == (False, True)
    assert dark.start_s == pytest.approx(preview.start_s + 0.4 + 0.1)
    assert (dark.exposure_ms, dark.averages, dark.duration_s) == (100.0, 4, 0.4)
    assert flat.positions["tra_obj"] == 150.0
    assert projection.positions["rot_obj"] == 90.0
    assert projection.positions["mag_obj"] == 600.0
    assert (projection.kV, projection.power_W) == (90.0, 50.0)
    assert plan.steps[projection.step].line == projection.line == 18
    assert (plan.frames, plan.bytes) == (1, 3 * 956 * 760 * 2)


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("E:\\a\\scan_000001.tif", "scan_000001.tif"),
        ("../../../etc/passwd", "passwd.tif"),
        ("E:\\a\\x:y*?.tif", "x_y__.tif"),
        ("C:\\con.tif", "_con.tif"),
        ("C:\\A.TIF", "A.TIF"),
        ("C:\\a.tifx", "a.tifx.tif"),
        ("E:\\.hidden.tif", "hidden.tif"),
        ("\\\\server\\share\\a.tiff", "a.tiff"),
    ],
)
def test_files_stay_in_the_data_set_s_folder(
    planned: Planner, path: str, name: str
) -> None:
    plan = planned("camera take image ACK", f"camera save image {path} ACK")
    assert plan.exposures[0].file == name


@pytest.mark.parametrize("path", ["E:\\a\\", "..", "/"])
def test_a_path_without_a_name_is_an_error(planned: Planner, path: str) -> None:
    plan = planned("camera take image ACK", f"camera save image {path} ACK")
    assert ("error", "path", 2) in codes(plan)


def test_warnings_about_images(planned: Planner) -> None:
    plan = planned(
        *QUIET,
        "tube xrayon ACK",
        "tra_obj move absolute 150 ACK",
        "camera take image ACK",
        "camera save image di000000.tif ACK",
        "tube xrayoff ACK",
        "camera take image ACK",
        "camera save image io000000.tif ACK",
        "tra_obj move absolute 0 no wait",
        "camera take image ACK",
        "camera save image io000000.tif ACK",
    )
    assert codes(plan) == [
        ("warning", "xrays_on", 11),
        ("warning", "xrays_off", 14),
        ("warning", "overwrites", 17),
        ("warning", "xrays_off", 17),
        ("warning", "moving", 17),
    ]


def test_settings_left_unsaid_are_named(planned: Planner) -> None:
    plan = planned(
        "tube xrayon ACK", "camera take image ACK", "camera save image scan_0.tif ACK"
    )
    assert [c[1] for c in codes(plan)] == ["default_assumed"] * 3 + [
        "averages_unsaid"
    ] + ["default_assumed"] * 2
    text = " ".join(p.message for p in plan.problems)
    for what in ("mode", "exposure", "ROI", "averages", "voltage", "power"):
        assert what in text


def test_step_and_shoot_images_are_where_the_stage_stopped(planned: Planner) -> None:
    dark = [
        "camera take image ACK",
        "camera take image ACK",
        "camera save image di0.tif ACK",
    ]
    lines = [*QUIET, "rot_obj move absolute 7 ACK", *dark, "tube xrayon ACK"]
    for i in range(24):
        lines += [
            f"rot_obj move absolute {i * 15} ACK",
            "camera take image ACK",
            f"camera save image E:\\s\\scan_{i:06d}.tif ACK",
        ]
    plan = planned(*lines)
    assert codes(plan) == []
    assert plan.frames == 24
    assert [e.positions["rot_obj"] for e in plan.exposures] == [
        7,
        7,
        *(15.0 * i for i in range(24)),
    ]
    assert np.degrees(plan.poses.angle) == pytest.approx(np.arange(24) * 15.0)
    assert plan.geometry.shape == (24, 760, 956)
    assert not any(e.moving for e in plan.exposures)
    assert np.all(np.diff(plan.starts) > 0.1)


def test_sequence_over_nothing_and_without_trigger(planned: Planner) -> None:
    quiet = [*QUIET, "camera set number of frames 5 ACK", "tube xrayon ACK"]
    plan = planned(*quiet, "camera take and save image sequence scan_ 0 ACK")
    assert codes(plan) == [("warning", "static_sequence", 10)]
    plan = planned(
        *quiet,
        "rot_obj move absolute 45 no wait",
        "camera take and save image sequence scan_ 3 ACK",
    )
    assert codes(plan) == [("warning", "no_trigger", 11)]
    assert plan.exposures[0].file == "scan_000003.tif"
    # 22.5 deg/s2: image i at 0.1 i s.
    angles = [e.positions["rot_obj"] for e in plan.exposures]
    assert_allclose(angles, 0.5 * 22.5 * (0.1 * np.arange(5)) ** 2, atol=1e-9)


def test_settings_file_has_the_moment_s_readings(planned: Planner) -> None:
    plan = planned(
        "rot_obj set speed 9.5 ACK",
        "rot_obj move absolute -3 ACK",
        "scanner write settings file ACK",
        "rot_obj move absolute 90 ACK",
    )
    assert plan.settings is not None
    assert plan.settings.positions["rot_obj"] == -3.0
    assert plan.settings.speeds["rot_obj"] == 9.5
    assert plan.settings.time_s == plan.steps[2].start_s


@pytest.mark.parametrize(
    ("before", "on"), [([], None), (["on"], True), (["on", "off"], False)]
)
def test_settings_file_says_whether_x_rays_are_on_once_that_is_known(
    planned: Planner, before: list[str], on: bool | None
) -> None:
    plan = planned(
        *(f"tube xray{k} ACK" for k in before), "scanner write settings file ACK"
    )
    assert plan.settings is not None
    assert plan.settings.xrays_on is on


def test_start_state_is_where_the_plan_begins(flexray: Machine, profile: Profile) -> None:
    home = StartState.of(flexray)
    start = StartState(
        {**home.positions, "tra_obj": 100.0}, home.speeds, home.accelerations, home.camera, 60.0,
        20.0, True,
    )  # fmt: skip
    plan = plan_script(
        parse_script("tra_obj move absolute 0 ACK\ntube xrayon ACK"),
        flexray,
        profile,
        start=start,
    )
    assert plan.steps[0].duration_s == pytest.approx(3.0)
    assert plan.steps[1].holds_s == 0.0
    assert plan.beam[0].kV == 60.0
    assert plan.positions(0.0)["tra_obj"] == 100.0


def test_streamed_poses(flexray: Machine, profile: Profile) -> None:
    poses = [{"rot_obj": 30.0 * i, "tra_obj": float(i)} for i in range(4)] + [
        {"rot_obj": 0.0}
    ]
    plan = plan_poses(poses, flexray, profile, 250.0)
    assert codes(plan) == []
    dark, flat, *images = plan.exposures
    assert (dark.kind, flat.kind) == ("dark", "flat")
    assert [e.file for e in images] == [f"scan_{i:06d}.tif" for i in range(5)]
    assert [e.positions["rot_obj"] for e in images] == [0, 30, 60, 90, 0]
    assert [e.positions["tra_obj"] for e in images] == [0, 1, 2, 3, 3]
    assert all(e.exposure_ms == 250.0 and e.xrays_on for e in images)
    assert [e.line for e in images] == [1, 2, 3, 4, 5]
    with pytest.raises(UnknownNameError, match="rot_obj"):
        plan_poses([{"rotation": 1.0}], flexray, profile)
    assert (
        codes(plan_poses([{"mag_obj": 2000.0}], flexray, profile))[0][1]
        == "limit_clamped"
    )


def test_a_script_without_projections_has_no_poses(planned: Planner) -> None:
    plan = planned("tra_obj move absolute 10 ACK")
    assert plan.frames == len(plan.poses.angle) == 0


def test_the_sample_out_of_the_beam_and_in_the_flat(planned: Planner) -> None:
    lines = [
        *QUIET,
        "tube xrayon ACK",
        "camera take image ACK",
        "camera save image io000000.tif ACK",
        "tra_obj move absolute -150 ACK",
        "camera take image ACK",
        "camera save image scan_000000.tif ACK",
    ]
    plan = planned(*lines)
    assert codes(plan) == [
        ("warning", "sample_in_flat", 9),
        ("warning", "sample_out_of_beam", 12),
    ]
    [said] = [p.message for p in plan.problems if p.code == "sample_in_flat"]
    assert "the shadow of its axis lies at column" in said
    sized = planned(*lines, sample=SampleSize(10.0, 10.0))
    [said] = [p.message for p in sized.problems if p.code == "sample_in_flat"]
    found = re.search(r"its shadow spans columns (\d+) to (\d+)", said)
    assert found is not None
    # By hand: 10 mm at SOD, enlarged, over pixels of 0.1496 mm.
    [flat] = [e for e in sized.exposures if e.kind == "flat"]
    sod = flat.positions["mag_obj"] + sized.profile.c_obj
    sdd = flat.positions["mag_det"] + sized.profile.c_det
    width = 10.0 * sdd / math.sqrt(sod**2 - 25.0) / 0.1496
    assert int(found[2]) - int(found[1]) == pytest.approx(width, abs=2.0)


def test_x_rays_that_are_on_at_the_start_light_the_first_image(
    planned: Planner, flexray: Machine
) -> None:
    start = replace(StartState.of(flexray), xrays_on=True)
    shot = ["camera take image ACK", "camera save image scan_000000.tif ACK"]
    [image] = planned(*shot, start=start).exposures
    assert image.start_s < 1.0
    assert (image.kind, image.xrays_on) == ("projection", True)


def test_another_scanner_is_another_file(profile: Profile) -> None:
    unitom = builtin_machine("unitom_xl")
    plan = plan_script(parse_script("tra_tube move absolute 1 ACK"), unitom, profile)
    assert codes(plan) == [("error", "unknown_component", 1)]


@pytest.mark.parametrize(("tube", "panel"), [(-2.0, -0.5), (-0.25, 1.0), (-1.0, 3.0)])
def test_a_geared_virtual_axis_moves_at_the_pace_of_its_slowest_motor(
    tube: float, panel: float
) -> None:
    """By hand: the axis goes as fast, and speeds up as fast, as each motor's gear lets it."""
    geared = parse_machine(
        f'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = {1 / tube}\n'
        f"moves = {{ ver_tube = {tube}, ver_det = {panel} }}\n"
    )
    text = (
        "ver_tube move absolute 150 no wait\nver_det move absolute 150 ACK\n"
        "ver_tube set speed 7 ACK\nver_tube set acceleration 5 ACK\nver_obj move "
        "absolute {} ACK"
    )
    there = 379.998  # any reading; the way is what counts
    plan = plan_script(parse_script(text.format(there)), geared, profile_of(geared))
    last = plan.steps[-1]
    begin, end = (plan.positions(t) for t in (last.start_s, plan.duration_s))
    way = (end["ver_tube"] - begin["ver_tube"]) / tube
    start = plan.start
    pace = min(7.0 / abs(tube), start.speeds["ver_det"] / abs(panel))
    rate = min(5.0 / abs(tube), start.accelerations["ver_det"] / abs(panel))
    d = abs(way)
    expected = d / pace + pace / rate if d > pace**2 / rate else 2 * math.sqrt(d / rate)
    assert d > 1.0
    assert last.duration_s == pytest.approx(expected)
    for t in np.linspace(last.start_s, plan.duration_s, 30).tolist():
        now = plan.positions(t)
        gone = [
            (now[n] - begin[n]) / f for n, f in (("ver_tube", tube), ("ver_det", panel))
        ]
        assert gone[0] == pytest.approx(gone[1], abs=1e-9)


def test_a_rate_of_a_geared_virtual_axis_is_shared_out() -> None:
    """Speeds in mm of the axis; the tube goes twice as far, the panel half as far."""
    geared = parse_machine(
        'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = -0.5\n'
        "moves = { ver_tube = -2.0, ver_det = -0.5 }\n"
    )
    text = (
        "ver_obj set speed 3 ACK\nver_obj set acceleration 4 ACK\n"
        "scanner write settings file ACK"
    )
    plan = plan_script(parse_script(text), geared, profile_of(geared))
    assert plan.settings is not None
    assert [plan.settings.speeds[n] for n in ("ver_tube", "ver_det")] == [6.0, 1.5]
    assert [plan.settings.accelerations[n] for n in ("ver_tube", "ver_det")] == [8.0, 2.0]


@pytest.mark.parametrize("at", [(0.0, 0.0, 0.0), (3.0, -4.0, -2.0), (-6.0, 2.5, 7.0)])
@pytest.mark.parametrize("tilted", [False, True])
def test_the_cylinder_about_a_box_holds_its_corners_at_every_angle(
    at: tuple[float, float, float], tilted: bool
) -> None:
    """Corners of the box, turned about its own middle, shifted, and turned with the stage."""
    size = np.array([8.0, 5.0, 12.0])
    tilts = (40.0, 25.0) if tilted else (0.0, 0.0)
    placed = StagePlacement(*at, rx=tilts[0], ry=tilts[1])
    found = SampleSize.around(size.tolist(), "mesh", placed)
    corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * size
    widest = highest = 0.0
    for rz in np.radians(np.arange(0.0, 360.0, 0.5)):
        turned = corners
        for axis, angle in (
            (0, math.radians(tilts[0])),
            (1, math.radians(tilts[1])),
            (2, rz),
        ):
            turned = turned @ rotation_about(np.eye(3)[axis], float(angle)).T
        turned = turned + at
        widest = max(widest, float(np.hypot(turned[:, 0], turned[:, 1]).max()))
        highest = max(highest, float(np.abs(turned[:, 2]).max()))
    assert found.source == "mesh"
    assert found.diameter_mm >= 2 * widest - 1e-9
    assert found.height_mm >= 2 * highest - 1e-9
    if tilted:  # then it holds the ball about the box
        assert found.diameter_mm == pytest.approx(
            np.linalg.norm(size) + 2 * math.hypot(*at[:2])
        )
        assert found.height_mm == pytest.approx(np.linalg.norm(size) + 2 * abs(at[2]))
    else:
        assert found.diameter_mm == pytest.approx(2 * widest, rel=1e-4)
        assert found.height_mm == pytest.approx(2 * highest)
