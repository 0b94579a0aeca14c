"""The smooth-scan rule: published figures, images at i * 360 / (N - 1), and what is
inferred."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from smooth_rule import smooth_scan

from flexdt.twin.machine.description import (
    Machine,
    Profile,
    parse_machine,
    profile_of,
)
from flexdt.twin.script import ScanPlan, parse_script, plan_script
from flexdt.twin.script.planning.planned_images import run_up
from tests.twin.script.conftest import Planner

LISTING_1 = Path(__file__).parents[3] / "examples/scripts/listing1.txt"


@pytest.fixture(scope="module")
def listing(flexray: Machine, profile: Profile) -> ScanPlan:
    return plan_script(parse_script(LISTING_1.read_bytes()), flexray, profile)


def test_published_run_ups() -> None:
    # Listing 1: ten averages, 22.5 deg/s2, its own speed.
    assert -run_up(0.12566897, 22.5, 10 * 0.099998199) == pytest.approx(
        -0.503018, abs=1e-4
    )
    # The UniTOM sample: 1440 frames of 25.018499 ms; start and end as in its script.
    sample = smooth_scan(1440, 0.025018499, 1, 22.5)
    assert sample.start == pytest.approx(-3.222728, abs=1e-4)
    assert sample.end == pytest.approx(363.222717, abs=1e-4)
    assert sample.speed == pytest.approx(9.9995696504, abs=1e-4)
    assert sample.increment == pytest.approx(360 / 1439)


def test_listing_1_warnings_are_the_right_ones(listing: ScanPlan) -> None:
    assert [(p.severity, p.code, p.line) for p in listing.problems] == [
        ("warning", "limit_clamped", 11),
        ("warning", "sample_out_of_beam", 23),
        ("warning", "averages_unsaid", 23),
        ("warning", "frames_unsaid", 23),
    ]
    averages, frames = listing.problems[2:]
    assert "10 inferred" in averages.message
    assert "2864.72 steps" in frames.message
    assert "2866 frames" in frames.message


def test_listing_1_plan(listing: ScanPlan) -> None:
    assert listing.ok
    assert listing.frames == 2866
    assert listing.exposures[-1].averages == 10
    begun, turn = listing.trajectories["rot_obj"][-1]
    assert turn.position(begun) == pytest.approx(-0.503017)
    dark, flat, *projections = listing.exposures
    # What was set before the script holds for its first images too.
    assert dark.averages == flat.averages == 10
    assert projections[0].positions["rot_obj"] == 0.0
    assert projections[-1].positions["rot_obj"] == pytest.approx(360.0, abs=1e-12)
    assert projections[0].positions["mag_det"] == 1059.0
    assert listing.duration_s == pytest.approx(2887, abs=5)


@pytest.mark.parametrize("frames", [2, 73, 360, 1441])
def test_image_i_lies_at_i_360_over_n_minus_1_exactly_when_the_motor_is_there(
    planned: Planner, frames: int
) -> None:
    rule = (
        smooth_scan(frames, 0.05, 2, 22.5)
        if frames > 10
        else smooth_scan(frames, 5.0, 2, 22.5)
    )
    exposure = rule.period_s / 2 * 1000
    plan = planned(
        *fly_lines(exposure, 2, frames),
        f"rot_obj set speed {rule.speed:.10f} ACK",
        f"rot_obj move absolute {rule.start:.6f} ACK",
        f"rot_obj set speed {rule.speed:.10f} ACK",
        f"rot_obj move absolute {rule.end:.6f} 0.000000 POS",
        "camera take and save image sequence E:\\scan_ 0 ACK",
    )
    assert [p.code for p in plan.problems] == []
    projections = [e for e in plan.exposures if e.kind == "projection"]
    angles = np.array([e.positions["rot_obj"] for e in projections])
    assert_allclose(angles, np.arange(frames) * 360.0 / (frames - 1), rtol=0, atol=1e-11)
    starts = np.array([e.start_s for e in projections])
    # The axis really is there then, and the images follow each other without a gap.
    assert_allclose(plan.positions(starts)["rot_obj"], angles, atol=1e-7)
    assert_allclose(np.diff(starts), rule.period_s, rtol=1e-6)
    assert all(e.moving for e in projections)


@pytest.mark.parametrize("gear", [-2.0, -0.4])
def test_a_trigger_of_an_axis_without_a_motor_is_at_its_own_position(gear: float) -> None:
    machine = parse_machine(
        f'base = "flexray"\n[virtual_axes.ver_obj]\nfactor = {1 / gear}\n'
        f"moves = {{ ver_tube = {gear}, ver_det = {gear} }}\n"
    )
    script = parse_script(
        "tube xrayon ACK\nver_obj move absolute 250 ACK\n"
        "ver_obj move absolute 280 261 POS\ncamera take image ACK\n"
        "camera save image scan_0.tif ACK\n"
    )
    plan = plan_script(script, machine, profile_of(machine))
    assert not [p for p in plan.problems if p.severity == "error"]
    [image] = plan.exposures
    axis = machine.virtual_axes["ver_obj"]
    motor = float(plan.positions(image.start_s)["ver_tube"])
    assert axis.constant + motor / gear == pytest.approx(261.0)


def fly_lines(exposure_ms: float, averages: int, frames: int) -> list[str]:
    return [
        "tube set kV 90 ACK",
        "tube set power 50 ACK",
        "camera set mode HW2SW1High ACK",
        f"camera set exposure {exposure_ms:.6f} ACK",
        "camera set ROI 32 8 1943 1527 ACK",
        f"camera set number of frames {frames} ACK",
        f"camera set number of averages {averages} ACK",
        "tube xrayon ACK",
        "rot_obj set acceleration 22.5 ACK",
    ]


def fly(
    planned: Planner, lines: list[str], speed: float, start: float, end: float
) -> ScanPlan:
    return planned(
        *lines,
        f"rot_obj move absolute {start:.6f} ACK",
        f"rot_obj set speed {speed:.10f} ACK",
        f"rot_obj move absolute {end:.6f} 0.000000 POS",
        "camera take and save image sequence scan_ 0 ACK",
    )


@pytest.mark.parametrize(("averages", "frames"), [(1, 361), (3, 721), (7, 101)])
@pytest.mark.parametrize("unsaid", [{"averages"}, {"frames"}, {"averages", "frames"}])
def test_what_is_unsaid_is_inferred(
    planned: Planner, averages: int, frames: int, unsaid: set[str]
) -> None:
    rule = smooth_scan(frames, 0.1, averages, 22.5)
    lines = [
        x for x in fly_lines(100, averages, frames) if not any(u in x for u in unsaid)
    ]
    plan = fly(planned, lines, rule.speed, rule.start, rule.end)
    last = plan.exposures[-1]
    assert (plan.frames, last.averages) == (frames, averages)
    assert {p.code for p in plan.problems} == {f"{u}_unsaid" for u in unsaid}
    assert last.positions["rot_obj"] == pytest.approx(360.0)


@pytest.mark.parametrize(("longer", "frames"), [(0.9, 1441), (-0.9, 1441), (1.1, 1445)])
def test_a_scan_within_a_degree_of_whole_turns_is_one_of_them(
    planned: Planner, longer: float, frames: int
) -> None:
    rule = smooth_scan(1441, 0.1, 1, 22.5)
    lines = [x for x in fly_lines(100, 1, 1441) if "frames" not in x]
    plan = fly(planned, lines, rule.speed, rule.start, rule.end + longer)
    assert plan.frames == frames


def test_without_a_rule_to_infer_from_the_documented_default_is_taken(
    planned: Planner,
) -> None:
    lines = [x for x in fly_lines(100, 1, 1) if "number" not in x]
    plan = planned(*lines, "camera take and save image sequence scan_ 0 ACK")
    assert [(p.code, p.severity) for p in plan.problems] == [
        ("frames_unsaid", "warning"),
        ("averages_unsaid", "warning"),
    ]
    assert all("1 is assumed" in p.message for p in plan.problems)
    assert plan.frames == 1


@pytest.mark.parametrize("frames", [181, 361, 1441])
@pytest.mark.parametrize(
    ("miss", "said"), [(0.045, 0), (0.055, 1), (-0.055, 1), (0.3, 1), (0.45, 1)]
)
def test_frames_that_miss_a_turn_are_named(
    planned: Planner, frames: int, miss: float, said: int
) -> None:
    """By part of a step; less than half of one, so the images are meant to make a turn."""
    rule = smooth_scan(frames, 0.1, 1, 22.5)
    speed = rule.speed * (1 + miss / (frames - 1))
    plan = fly(planned, fly_lines(100, 1, frames), speed, -60, 420)
    assert [p.code for p in plan.problems] == ["frame_angles"] * said
    assert plan.exposures[-1].positions["rot_obj"] == pytest.approx(360.0)


def test_averages_follow_from_the_frames_before_the_run_up(planned: Planner) -> None:
    """A run-up of 10 degrees more says nothing about the averages."""
    rule = smooth_scan(361, 0.1, 3, 22.5)
    lines = [x for x in fly_lines(100, 3, 361) if "averages" not in x]
    plan = fly(planned, lines, rule.speed, rule.start - 10.0, rule.end + 10.0)
    assert {e.averages for e in plan.exposures if e.kind == "projection"} == {3}


@pytest.mark.parametrize(
    ("ratio", "averages"),
    [(3.05, 3), (2.95, 3), (3.07, 1), (2.93, 1), (0.99, 1), (0.4, 1)],
)
def test_averages_are_a_whole_number_within_two_percent_or_not_inferred(
    planned: Planner, ratio: float, averages: int
) -> None:
    rule = smooth_scan(361, 0.1 * ratio, 1, 22.5)
    lines = [x for x in fly_lines(100, 1, 361) if "number" not in x]
    plan = fly(planned, lines, rule.speed, rule.start, rule.end)
    assert {e.averages for e in plan.exposures if e.kind == "projection"} == {averages}


def test_averages_that_are_inferred_hold_for_previews_too(planned: Planner) -> None:
    rule = smooth_scan(361, 0.1, 3, 22.5)
    lines = [x for x in fly_lines(100, 3, 361) if "averages" not in x]
    plan = fly(
        planned, [*lines, "camera take image ACK"], rule.speed, rule.start, rule.end
    )
    assert [(g.kind, g.camera.averages) for g in plan.groups] == [
        ("preview", 3),
        ("projection", 3),
    ]


def test_half_a_turn_lies_where_the_motor_is(planned: Planner) -> None:
    plan = fly(planned, fly_lines(100, 1, 181), 10.0, -10, 200)
    assert [p.code for p in plan.problems] == []
    angles = [e.positions["rot_obj"] for e in plan.exposures]
    assert_allclose(angles, np.arange(181) * 1.0, atol=1e-9)


def test_a_short_run_up_and_an_early_end_are_named(planned: Planner) -> None:
    rule = smooth_scan(361, 0.1, 1, 22.5)
    short = fly(planned, fly_lines(100, 1, 361), rule.speed, -0.5, rule.end)
    assert [p.code for p in short.problems] == ["run_up"]
    # Images lie where the motor is: slower at first.
    angles = [e.positions["rot_obj"] for e in short.exposures]
    assert 0 < angles[1] < 1.0
    early = fly(planned, fly_lines(100, 1, 361), rule.speed, rule.start, 355.0)
    assert [p.code for p in early.problems] == ["scan_overrun"]
    assert early.exposures[-1].positions["rot_obj"] == 355.0


@pytest.mark.parametrize(
    ("pause", "late"), [("50", 1), ("0.0000011", 1), ("0.0000009", 0)]
)
def test_commands_between_trigger_and_sequence_delay_it(
    planned: Planner, pause: str, late: int
) -> None:
    """A delay below a nanosecond is none."""
    rule = smooth_scan(361, 0.1, 1, 22.5)
    plan = planned(
        *fly_lines(100, 1, 361),
        f"rot_obj move absolute {rule.start} ACK",
        f"rot_obj set speed {rule.speed} ACK",
        f"rot_obj move absolute {rule.end} 0 POS",
        f"scanner pause {pause} ACK",
        "camera take and save image sequence scan_ 0 ACK",
    )
    assert [p.code for p in plan.problems] == ["late_start"] * late
    expected = float(pause) / 1000 * rule.speed
    assert plan.exposures[0].positions["rot_obj"] == pytest.approx(expected, abs=1e-8)


def test_turning_backwards(planned: Planner) -> None:
    rule = smooth_scan(361, 0.1, 1, 22.5)
    plan = fly(planned, fly_lines(100, 1, 361), rule.speed, -rule.start, -rule.end)
    assert [p.code for p in plan.problems] == []
    assert plan.exposures[360].positions["rot_obj"] == pytest.approx(-360.0)


def test_three_turns_in_one_sequence(planned: Planner) -> None:
    rule = smooth_scan(541, 0.1, 1, 22.5, turn=1080.0)
    plan = fly(planned, fly_lines(100, 1, 541), rule.speed, rule.start, rule.end)
    assert [p.code for p in plan.problems] == []
    assert plan.exposures[-1].positions["rot_obj"] == pytest.approx(1080.0)


def test_subframe_samples_spread_evenly_about_the_nominal_pose(listing: ScanPlan) -> None:
    samples = listing.subframe_positions(5)["rot_obj"]
    assert samples.shape == (2868, 5)
    centre = np.array([e.positions["rot_obj"] for e in listing.exposures])
    assert_allclose(samples.mean(axis=1), centre, atol=1e-9)
    first, second = listing.exposures[2:4]
    speed = (second.positions["rot_obj"] - first.positions["rot_obj"]) / (
        second.start_s - first.start_s
    )
    assert_allclose(np.ptp(samples[2:], axis=1), speed * first.duration_s * 4 / 5)
    assert_allclose(np.ptp(samples[:2], axis=1), 0.0)
