"""The dry run: its document, its figures against hand computation, and its two renderings."""

from __future__ import annotations

import json
import math
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from smooth_rule import smooth_scan

from flexdt.twin.machine.description import (
    Machine,
    Profile,
    builtin_machine,
    builtin_profile,
)
from flexdt.twin.script import (
    CheckReport,
    Clearance,
    Collision,
    SampleSize,
    ScanPlan,
    StartState,
    check_plan,
    check_script,
    html_report,
    plan_poses,
)
from flexdt.twin.script.dry_run_report import summary
from tests.twin.script.conftest import Planner, blob, tabbed

LINES = [
    "tube set kV 80 ACK",
    "tube set power 40 ACK",
    "camera set mode HW2SW1High ACK",
    "camera set exposure 200 ACK",
    "camera set ROI 32 8 1943 1527 ACK",
    "camera set number of frames 1 ACK",
    "camera set number of averages 2 ACK",
    "tra_det move absolute 25.3183 ACK",
    "tra_obj move absolute 0.5405 ACK",
    "mag_obj move absolute 485.0808 ACK",  # SOD 500
    "mag_det move absolute 959.9992 ACK",  # SDD 1000
    "tube xrayon ACK",
    "scanner pause 1000 ACK",
    "camera take image ACK",
    "camera save image scan_000000.tif ACK",
    "tube xrayoff ACK",
]


def report(flexray: Machine, profile: Profile, **options: object) -> CheckReport:
    """A dry run that knows where the scanner stands."""
    known = {"start": StartState.of(flexray), **options}
    return check_script("\n".join(LINES), flexray, profile, **known)  # type: ignore[arg-type]


def test_document_has_the_interface_s_shape(flexray: Machine, profile: Profile) -> None:
    document = json.loads(json.dumps(report(flexray, profile).to_dict()))
    assert document["ok"] is True
    assert document["problems"] == []
    assert (document["frames"], document["bytes"]) == (1, 956 * 760 * 2)
    assert document["collisions"] == []
    assert document["min_clearance_mm"] is None
    assert len(document["steps"]) == len(LINES)
    starts = [s["start_s"] for s in document["steps"]]
    assert starts == sorted(starts)
    assert {"line", "start_s", "duration_s", "what"} <= set(document["steps"][0])
    assert document["duration_s"] == pytest.approx(
        document["computed_s"] + document["assumed_s"]
    )


def test_optics_and_dose_by_hand(flexray: Machine, profile: Profile) -> None:
    made = report(flexray, profile)
    (optics,) = made.optics
    assert optics.magnification == pytest.approx((2.0, 2.0))
    assert optics.voxel_um == pytest.approx((74.8, 74.8))
    assert optics.field_mm == pytest.approx((956 * 0.0748, 760 * 0.0748))
    # Half the detector seen from the focal spot, on a centred axis.
    half = math.atan(956 * 0.1496 / 2 / 1000)
    assert optics.turn_field_mm == pytest.approx(2 * 500 * math.sin(half), rel=1e-6)
    assert optics.truncation is None
    timing = flexray.timing
    on = 1.0 + 0.4 + timing.take_image_overhead_s + timing.save_image_s
    assert made.dose.beam_on_s == pytest.approx(on)
    assert made.dose.charge_mAs == pytest.approx(on * 40 / 80)
    assert made.dose.exposing_s == pytest.approx(0.4)


def test_truncation_over_the_full_rotation(flexray: Machine, profile: Profile) -> None:
    whole = report(flexray, profile, sample=SampleSize(70.0, 20.0))
    assert whole.optics[0].truncation == pytest.approx(
        {"left": 0, "right": 0, "top": 0, "bottom": 0}
    )
    assert whole.problems == ()
    # A cylinder of radius 40 at 500 mm: its tangents meet the panel at 1000 tan(asin(40 /
    # 500)).
    wide = report(flexray, profile, sample=SampleSize(80.0, 20.0))
    edge = 1000 * math.tan(math.asin(40 / 500)) / 0.1496
    cut = wide.optics[0].truncation
    assert cut is not None
    assert cut["left"] == pytest.approx(edge - 478, abs=1e-3)
    assert cut["right"] == pytest.approx(edge - 478, abs=1e-3)
    assert [p.code for p in wide.problems] == ["truncated"]
    # Height: the near rim of the cylinder stands at 460 mm, its middle 20 above the origin.
    tall = report(flexray, profile, sample=SampleSize(80.0, 60.0))
    cut = tall.optics[0].truncation
    assert cut is not None
    source, panel = 20.0, 20.0
    bottom = source + (20.0 - 30.0 - source) * 1000 / 460
    assert cut["bottom"] == pytest.approx(
        (panel - 380 * 0.1496 - bottom) / 0.1496, abs=1e-3
    )
    assert cut["top"] == pytest.approx(cut["bottom"])  # at home the beam meets the middle


def corners_of(kind: int, rng: np.random.Generator) -> np.ndarray:
    """Corners of a drawn sample (k, 3) [mm]: a ball, a disc on edge, a gear, a cloud."""
    cloud = rng.normal(size=(400, 3))
    ball = cloud / np.linalg.norm(cloud, axis=1, keepdims=True)
    around = 2.0 * np.pi * np.arange(40) / 40
    teeth = np.where(np.arange(40) % 4 < 2, 1.0, 0.8)[:, None]
    ring = teeth * np.stack([np.cos(around), np.sin(around)], axis=1)
    gear = np.concatenate([np.column_stack([ring, np.full(40, z)]) for z in (-0.7, 0.7)])
    drawn = [ball, ball * [1.0, 0.1, 1.0], gear, 0.3 * cloud]
    shift = rng.uniform(-3.0, 3.0, 3)
    return np.asarray(rng.uniform(30.0, 48.0) * drawn[kind] + shift)


@pytest.mark.parametrize("seed", range(12))
def test_what_a_sample_loses_over_a_turn_follows_from_its_corners(
    flexray: Machine, profile: Profile, seed: int
) -> None:
    """Each corner is projected at every quarter of a degree, by similar triangles."""
    corners = corners_of(seed % 4, np.random.default_rng(seed))
    made = report(flexray, profile, sample=SampleSize.of_points(corners, "drawn"))
    turn = np.radians(np.arange(0.0, 360.0, 0.25))[:, None]
    x, y, z = corners.T
    depth = 500.0 + x * np.cos(turn) + y * np.sin(turn)
    columns = 1000.0 * (y * np.cos(turn) - x * np.sin(turn)) / depth / 0.1496
    rows = 1000.0 * z / depth / 0.1496
    beyond = {
        "left": -columns.min() - 478,
        "right": columns.max() - 478,
        "top": rows.max() - 380,
        "bottom": -rows.min() - 380,
    }
    cut = made.optics[0].truncation
    assert cut is not None
    for edge, px in beyond.items():
        assert cut[edge] == pytest.approx(max(px, 0.0), abs=1.0), edge
    assert bool(made.problems) == (max(beyond.values()) > 0.5)


PLACES = st.fixed_dictionaries({
    "mag_obj": st.floats(100, 700), "mag_det": st.floats(800, 1050), "tra_obj": st.floats(-4, 4),
    "tra_det": st.floats(-200, 200), "ver_tube": st.floats(0, 100), "ver_det": st.floats(4, 100),
})  # fmt: skip
WHOLLY_ABOVE_THE_BEAM = {
    "mag_obj": 400.0, "mag_det": 1000.0, "tra_obj": 0.0,
    "tra_det": 0.0, "ver_tube": 0.0, "ver_det": 100.0,
}  # fmt: skip
"""The lower edge of its projection is that of the far rim."""


@settings(max_examples=60, deadline=None)
@given(
    st.lists(PLACES, min_size=1, max_size=3),
    st.floats(1, 60),
    st.none() | st.floats(0.2, 90),
)
@example([WHOLLY_ABOVE_THE_BEAM], 60.0, 20.0)
def test_the_sample_s_projection_is_that_of_its_cylinder(
    places: list[dict[str, float]], radius: float, high: float | None
) -> None:
    """Points of a cylinder through a pinhole, with the zero offsets of the published
    profile."""
    flexray = builtin_machine()
    profile = builtin_profile("cwi-2023-08-21")
    lines = [
        "camera take image ACK",
        "camera take image ACK",
        "camera save image di0.tif ACK",
    ]
    for i, place in enumerate(places):
        lines += [f"{motor} move absolute {x:.6f} ACK" for motor, x in place.items()]
        lines += ["camera take image ACK", f"camera save image s_{i}.tif ACK"]
    sample = SampleSize(2 * radius, high or 0.0)
    made = check_script("\n".join(lines), flexray, profile, sample=sample)
    [optics] = made.optics
    turns = np.linspace(0, 2 * np.pi, 20_001)
    cut, fields, shown, axes, sides = [], [], [], [], []
    for place in places:
        sod, sdd = place["mag_obj"] + 14.9192, place["mag_det"] + 40.0008
        beam, panel = place["ver_tube"] - 6.2917, place["ver_det"]
        x = place["tra_obj"] - 0.5405 + radius * np.cos(turns)
        t = sdd / (sod + radius * np.sin(turns))
        columns = (x * t + place["tra_det"] - 24.1215 - 16 * 0.0748) / 0.1496 + 477.5
        depth = sdd / (sod + radius * np.array([1.0, -1.0]))
        above = 20.0 + np.array([[0.5], [-0.5]]) * (high or 0.0) - beam
        rows = (panel - beam - above * depth) / 0.1496 + 379.5
        if high is None:
            rows = (panel - beam - above * sdd / sod) / 0.1496 + 379.5
        left, right, top, bottom = columns.min(), columns.max(), rows.min(), rows.max()
        cut.append([-0.5 - left, right - 955.5, -0.5 - top, bottom - 759.5])
        shown.append(right > -0.5 and left < 955.5 and bottom > -0.5 and top < 759.5)
        middle = (
            (place["tra_obj"] - 0.5405) * sdd / sod
            + place["tra_det"]
            - 24.1215
            - 16 * 0.0748
        )
        half = 956 / 2 * 0.1496 - abs(middle)
        axes.append(middle / 0.1496 + 477.5)
        sides.append(
            "left of"
            if right < -0.5
            else "right of"
            if left > 955.5
            else "above or below"
        )
        fields.append(2 * sod * math.sin(math.atan(max(half, 0.0) / sdd)))
    names = ("left", "right", "top", "bottom")[: 2 if high is None else 4]
    worst = np.maximum(np.max(cut, axis=0), 0.0)
    assert optics.truncation is not None
    assert dict(optics.truncation) == {
        name: pytest.approx(px, abs=0.3, rel=1e-3)
        for name, px in zip(names, worst, strict=False)
    }
    assert optics.turn_field_mm == pytest.approx(min(fields), abs=1e-5)
    everywhere = np.min(cut, axis=0)[: len(names)]
    if np.abs(np.abs(cut) - 956).min() < 2 or np.abs(cut).min() < 2:
        return  # at an edge, where the two ways need not agree
    said = {p.code: p for p in made.problems}
    assert ("sample_out_of_beam" in said) == (not all(shown))
    assert ("truncated" in said) == (any(shown) and bool((everywhere > 0.5).any()))
    if "truncated" in said:
        parts = [name for name, px in zip(names, everywhere, strict=True) if px > 0.5]
        assert [
            name for name in names if f"{name} by" in said["truncated"].message
        ] == parts
    if not all(shown):
        first, more = shown.index(False), shown.count(False) - 1
        message = said["sample_out_of_beam"].message
        assert f"column {axes[first]:.0f}, {sides[first]} the image's" in message
        assert (f"(and at {more} more lines)" in message) == (more > 0)


def test_a_source_within_the_sample_has_a_report_too(
    flexray: Machine, profile: Profile
) -> None:
    made = report(flexray, profile, sample=SampleSize(1200.0, 50.0))
    json.dumps(made.to_dict(), allow_nan=False)


def test_sample_size_is_taken_from_the_script(flexray: Machine, profile: Profile) -> None:
    text = tabbed("scanner", "set sample info", blob("x", 80.0), "", "ACK")
    text += "\r\n".join(LINES).encode()
    start = StartState.of(flexray)
    made = check_script(text, flexray, profile, start=start)
    assert made.plan.sample == SampleSize(80.0, 0.0, "set sample info")
    assert [p.code for p in made.problems] == ["truncated"]
    told = check_script(text, flexray, profile, start=start, sample=SampleSize(20.0))
    assert told.problems == ()


def test_tiles_make_up_for_each_other(flexray: Machine, profile: Profile) -> None:
    sample = SampleSize(100.0)
    head, tail = LINES[:7], LINES[8:]
    shot = ["camera take image ACK", "camera save image scan_000001.tif ACK"]
    left, right = ("tra_det move absolute 75 ACK", "tra_det move absolute -25 ACK")
    tiled = "\n".join([*head, left, *tail[:-1], right, *shot])
    start = StartState.of(flexray)
    assert (
        check_script(tiled, flexray, profile, start=start, sample=sample).problems == ()
    )
    single = "\n".join([*head, left, *tail])
    made = check_script(single, flexray, profile, start=start, sample=sample)
    assert [p.code for p in made.problems] == ["truncated"]


def test_syntax_and_plan_errors_come_together(flexray: Machine, profile: Profile) -> None:
    text = "rot_obj move absolute\ncamera set ROI 0 12 1919 1907 ACK\nnonsense\ntube set kV 95 ACK"
    made = check_script(text, flexray, profile)
    assert [(p.line, p.code) for p in made.problems] == [
        (1, "value"),
        (1, "wait_missing"),
        (2, "roi"),
        (3, "syntax"),
        (4, "limit"),
    ]
    assert "bottom 1907 is outside the sensor's 1536 rows" in made.problems[2].message
    assert not made.ok
    assert [s.line for s in made.plan.steps] == [2, 4]


def test_collisions_come_from_the_function_handed_in(
    flexray: Machine, profile: Profile
) -> None:
    seen: list[object] = []
    hit = Collision(10, 4.5, ("sample", "source"), {"mag_obj": 80.0})

    def find(
        plan: ScanPlan, m: Machine, p: Profile, sample: SampleSize | None
    ) -> Clearance:
        seen.extend([plan, m, p, sample])
        return Clearance((hit,), 0.5, ("sample", "source"), ((0.0, 30.0), (4.5, 0.5)))

    made = report(flexray, profile, collision=find, sample=SampleSize(20.0))
    assert seen == [made.plan, flexray, profile, SampleSize(20.0)]
    assert not made.ok
    assert [(p.line, p.column, p.code, p.severity) for p in made.problems] == [
        (10, 1, "collision", "error")
    ]
    document = made.to_dict()
    assert document["collisions"] == [
        {
            "line": 10,
            "time_s": 4.5,
            "pair": ["sample", "source"],
            "last_free": {"mag_obj": 80.0},
        }
    ]
    assert document["min_clearance_mm"] == 0.5
    page = html_report(made, "a<b>.txt")
    assert "<svg" in page
    assert "sample and source" in page


@pytest.mark.parametrize("beyond", [-0.02, 0.02])
@pytest.mark.parametrize(
    ("across", "sense"), [(True, 1), (True, -1), (False, 1), (False, -1)]
)
def test_an_axis_is_in_the_beam_as_far_as_the_edge_of_the_last_pixel(
    flexray: Machine, profile: Profile, across: bool, sense: int, beyond: float
) -> None:
    """SOD 500 and SDD 1000: from a spot at height 0, the middle at 20 mm is seen at 40 mm."""
    off = sense * ((956 if across else 160) / 2 + beyond) * 0.1496
    panel = (25.3183 - off, 40.0) if across else (25.3183, 40.0 + off)
    moves = zip(("tra_det", "ver_det", "ver_tube"), (*panel, 6.2917), strict=True)
    lines = [
        *LINES[:-5],
        *(f"{name} move absolute {at:.6f} ACK" for name, at in moves),
        *LINES[-5:],
    ]
    lines[4] = "camera set ROI 32 608 1943 927 ACK"
    made = check_script("\n".join(lines), flexray, profile, start=StartState.of(flexray))
    said = [p.message for p in made.problems if p.code == "sample_out_of_beam"]
    assert len(said) == (beyond > 0)


_SHOT = (
    "rot_obj move absolute 90 ACK\ncamera take image ACK\ncamera save image s.tif ACK\n"
)


def test_figures_of_the_report_in_words(flexray: Machine, profile: Profile) -> None:
    pause = "scanner pause 3724000 ACK"
    made = check_script(
        "\n".join([*LINES, pause]), flexray, profile, sample=SampleSize(20.0)
    )
    facts = dict(summary(made))
    seconds = round(made.plan.duration_s) - 3600
    assert facts["duration"].startswith(f"1 h {seconds // 60} min {seconds % 60} s (")
    assert facts["  truncation"] == "none"
    assert (
        f"({made.plan.assumed_s:.2f} s assumed; flexray timing: " in facts["  commands"]
    )
    idle = dict(summary(check_script(pause, flexray, profile)))
    assert idle["  commands"].startswith("0.00 s (none; flexray timing: ")
    assert "projections, line 14" in facts
    again = [*LINES[:-1], LINES[13], "camera save image scan_000001.tif ACK"]
    two = check_script("\n".join(again), flexray, profile)
    assert "projections, lines 14-16" in dict(summary(two))
    assert facts["collisions"] == "not checked"
    assert repr(made).startswith(
        "<CheckReport: ok, 0 collisions, of <ScanPlan on flexray: "
    )
    assert "<details>" in html_report(made)
    wide = report(flexray, profile, sample=SampleSize(80.0))
    assert dict(summary(wide))["  truncation"] == (
        "in the worst image left by 58 columns, right by 58 columns"
    )
    assert dict(summary(wide))["duration"].startswith("0 min ")
    free = Clearance((), 12.5, ("sample", "source"), ((0.0, 12.5),))
    hit = Clearance(
        (Collision(10, 4.5, ("sample", "source"), {}),), 0.5, ("sample", "source")
    )
    stay = "none; parts in relative motion stay 12.50 mm apart (sample and source)"
    for found, text, ok in ((free, stay, True), (hit, "1", False)):
        checked = report(flexray, profile, collision=lambda *_, found=found: found)
        assert dict(summary(checked))["collisions"] == text
        assert (checked.ok, repr(checked).split(",")[1]) == (ok, f" {1 - ok} collisions")


@pytest.mark.parametrize("known", [True, False])
def test_a_range_of_the_duration_holds_where_the_start_is_known(known: bool) -> None:
    """The times of the UniTOM XL are measured."""
    start = StartState.of(builtin_machine("unitom_xl")) if known else None
    made = check_script(_SHOT, builtin_machine("unitom_xl"), start=start)
    said = dict(summary(made))["  90 % range"]
    assert said.split(" s", 1)[1] == (
        "" if known else ", if axes and X-rays start as assumed below"
    )


class _Tags(HTMLParser):
    """Every element is closed, and nothing comes from elsewhere."""

    VOID = ("meta", "line", "path", "polyline")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.links += [v or "" for k, v in attrs if k in ("src", "href")]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_html_is_one_well_formed_page_that_needs_nothing_else(
    flexray: Machine, profile: Profile
) -> None:
    text = "\n".join([*LINES, "odd<script>alert(1)</script> x ACK"])
    page = html_report(check_script(text, flexray, profile), "a<b>&.txt")
    tags = _Tags()
    tags.feed(page)
    assert tags.open == []
    assert tags.links == []
    assert "<script" not in page
    assert "url(" not in page
    assert "a&lt;b&gt;&amp;.txt" in page
    assert page.count("<tr>") >= len(LINES)


def test_what_nothing_moves_before_the_first_projection_is_said_to_be_assumed(
    flexray: Machine, profile: Profile
) -> None:
    made = check_script("\n".join(LINES), flexray, profile)
    (problem,) = made.problems
    assert (problem.severity, problem.code) == ("warning", "default_assumed")
    assert LINES[problem.line - 1] == "camera take image ACK"
    assert "nothing moves ver_tube, ver_det, tra_tube, rot_obj before" in problem.message
    assert "ver_tube=26.2917" in problem.message
    assert made.ok
    # A virtual axis moves its motors; a motor that only moves later is still where it was.
    more = ["ver_obj move absolute 340 ACK", "tra_tube move absolute 0 ACK", *LINES]
    late = [*more, "rot_obj move absolute 5 ACK"]
    (problem,) = check_script("\n".join(late), flexray, profile).problems
    assert problem.message == (
        "nothing moves rot_obj before this image; home is assumed: rot_obj=0"
    )
    all_moved = ["rot_obj move absolute 0 ACK", *more]
    assert check_script("\n".join(all_moved), flexray, profile).problems == ()
    # A dark says nothing about where anything stands.
    dark = ["camera take image ACK", "camera save image di000000.tif ACK"]
    first_dark = [*LINES[:7], *dark, *all_moved]
    assert check_script("\n".join(first_dark), flexray, profile).problems == ()


@pytest.mark.parametrize("known", [False, True])
def test_start_and_stage_are_told_in_every_form(
    flexray: Machine, profile: Profile, known: bool
) -> None:
    start = StartState.of(flexray) if known else None
    made = check_script("\n".join(LINES), flexray, profile, start=start)
    document = made.to_dict()
    facts = dict(summary(made))
    assert facts["sample"] == ("none" if known else "none (empty stage assumed)")
    told = (
        "ver_tube=26.2917, "
        if known
        else "the machine's home, assumed: ver_tube=26.2917, "
    )
    assert facts["start"].startswith(told)
    assert document["summary"] == {"sample": facts["sample"], "start": facts["start"]}
    assert document["start"] == {
        "known": known, "positions": {n: a.home for n, a in flexray.axes.items()},
    }  # fmt: skip
    page = html_report(made)
    assert f"<dt>sample</dt><dd>{facts['sample']}</dd>" in page
    assert "<dt>start</dt><dd>" in page
    stage = check_script(
        "\n".join(LINES), flexray, profile, sample=SampleSize(20.0, 30.0, "mine")
    )
    assert dict(summary(stage))["sample"] == "20 mm across, 30 mm high (mine)"
    corners = np.array(
        [[x, y, z] for x in (-3, 4) for y in (0, 3) for z in (-3, 37)], float
    )
    part = check_script("\n".join(LINES), flexray, profile,
                        sample=SampleSize.of_points(corners, "part"))  # fmt: skip
    said = "10 mm across, 40 mm high from -3 to 37 mm (part)"
    assert dict(summary(part))["sample"] == said


def test_poses_are_checked_alike(flexray: Machine, profile: Profile) -> None:
    poses, start = [{"rot_obj": 0.0}, {"mag_obj": 1500.0}], StartState.of(flexray)
    made = check_plan(plan_poses(poses, flexray, profile, 50.0, start=start))
    assert [(p.line, p.code) for p in made.problems] == [(2, "limit_clamped")]
    assert made.plan.frames == 2


# A scan of 1440 frames on a UniTOM XL, in the scanner's own form: our own script with the
# figures of a published one whose settings file says when it was written (9:35:51) and when the
# scan stopped (9:36:42.7): 51.2 s, to half a second.
def unitom_lines() -> list[bytes]:
    rule = smooth_scan(1440, 0.025018499, 1, 22.5)
    rows = [
        ("camera", "set mode", "2_HW2SW1LOW", "", "ACK", "20000", "20000"),
        ("camera", "set exposure", "25.018499", "", "ACK", "20000", "200"),
        ("camera", "set ROI", "0 12 1919 1907", "", "ACK", "20000", "200"),
        ("tube", "set kV", "80", "", "ACK"),
        ("tube", "set power", "38", "", "ACK"),
        ("tube", "xrayon", "", "", "ACK"),
        ("rot_obj", "move absolute", f"{rule.start:.6f}", "", "ACK"),
        ("rot_obj", "set speed", f"{rule.speed:.10f}", "", "ACK"),
        ("rot_obj", "set acceleration", "22.500000", "", "ACK"),
        ("camera", "set number of frames", "1440", "", "ACK"),
        ("camera", "set number of averages", "1", "", "ACK"),
        ("scanner", "write settings file", "", "", "ACK"),
        ("rot_obj", "move absolute", f"{rule.end:.6f}", "0.000000", "POS"),
        (
            "camera",
            "take and save image sequence",
            "E:\\x\\scan_",
            "0",
            "ACK",
            "",
            "36027",
        ),
        ("rot_obj", "set speed", "45.0000000000", "", "ACK", "180000"),
        ("rot_obj", "set acceleration", "45.000000", "", "ACK"),
        ("tube", "xrayoff", "", "", "ACK"),
        ("camera", "set number of frames", "1", "", "ACK"),
        ("tube", "xrayoff", "", "", "ACK"),
        ("rot_obj", "move absolute", "0.000000", "", "ACK", "", "12000"),
    ]
    return [tabbed(*row) for row in rows]


def test_unitom_timing_from_the_settings_file_to_the_end() -> None:
    machine = builtin_machine("unitom_xl")
    profile, start = builtin_profile(machine.default_profile), StartState.of(machine)
    made = check_script(b"".join(unitom_lines()), machine, profile, start=start)
    assert made.problems == ()
    plan = made.plan
    assert plan.frames == 1440
    written = plan.settings
    assert written is not None
    predicted = plan.duration_s - written.time_s
    assert abs(predicted - 51.2) < 0.12 * 51.2
    # Most of it is motion and exposures.
    commands = sum(s.assumed_s for s in plan.steps[written.step :])
    assert commands < 0.12 * predicted
    sequence = next(s for s in plan.steps if "sequence" in s.what)
    assert sequence.computed_s == pytest.approx(
        36.027, abs=2e-3
    )  # as the scanner expected


def test_unitom_geometry_is_the_published_scan_s() -> None:
    machine = builtin_machine("unitom_xl")
    made = check_script(
        b"".join(unitom_lines()), machine, builtin_profile(machine.default_profile)
    )
    (optics,) = made.optics
    assert optics.shape == (948, 960)
    assert optics.sod_mm[0] == pytest.approx(149.99997, abs=1e-6)
    assert optics.sdd_mm[0] == pytest.approx(599.999432, abs=1e-6)
    assert optics.magnification[0] == pytest.approx(3.999997, abs=1e-6)
    assert optics.voxel_um[0] == pytest.approx(75.000056, abs=1e-5)


def test_the_unitom_script_on_the_flexray_is_a_roi_error_and_planned_all_the_same(
    flexray: Machine, profile: Profile
) -> None:
    made = check_script(b"".join(unitom_lines()), flexray, profile)
    assert [p.code for p in made.errors] == ["roi"]
    assert made.plan.frames == 1440
    assert len(made.plan.steps) == 20


@pytest.mark.parametrize(("last", "said"), [(1, 1), (3, 0)])
def test_a_region_without_a_binned_pixel_is_said_once(
    planned: Planner, last: int, said: int
) -> None:
    """On the line that makes it so, and not again for each image."""
    region = f"camera set ROI 0 0 {last} {last} ACK"
    images = ["camera take image ACK", "camera save image a%d ACK"] * 3
    plan = planned(region, "camera set mode HW4SW1High ACK", *images)
    found = [p for p in plan.problems if p.severity == "error"]
    assert [(p.code, p.line) for p in found] == [("roi", 2)] * said
    assert all("holds no pixel" in p.message for p in found)
