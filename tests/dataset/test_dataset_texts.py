"""The scanner's texts: hand-made files in the real format, round trips, hostile content."""

from __future__ import annotations

import math
import re
import string
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from flexdt.twin.dataset.dataset_errors import DatasetFormatError
from flexdt.twin.dataset.flexdt_json import DatasetDocument, SampleRecord, ScanRecord
from flexdt.twin.dataset.rebuild import angles_deg, rebuild
from flexdt.twin.dataset.scan_settings import MotorLine, ScanSettings, settings_of
from flexdt.twin.dataset.scan_settings_text import (
    format_scan_settings,
    parse_scan_settings,
)
from flexdt.twin.dataset.stated_geometry import Figures, figures_of, poses_of
from flexdt.twin.dataset.xre import format_sections, format_settings, format_xre
from flexdt.twin.dataset.xre_reading import parse_xre
from flexdt.twin.machine.camera import Roi
from flexdt.twin.machine.description import (
    builtin_machine,
    builtin_machines,
    builtin_profile,
    builtin_profiles,
)
from flexdt.twin.script import plan_script


def read(path: Path) -> str:
    return path.read_bytes().decode("utf-8")


def test_every_line_of_a_file_in_the_real_format_is_read(data: Path) -> None:
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    assert (s.scan_id, s.project, s.operator) == ("260314_002", "Phantoms", "Ada")
    assert s.started == datetime(2026, 3, 14, 13, 5, 9)
    assert s.stopped == datetime(2026, 3, 14, 13, 23, 40)
    assert (s.duration_minutes, s.comment) == (18.0, "second try; axis re-aligned")
    assert (s.sod_mm, s.sdd_mm) == (600.000003, 1058.999997)
    assert (s.hc_px, s.vc_px, s.cor_px) == (477.989305, 380.0, 478.150939)
    assert (s.voxel_um, s.magnification) == (84.759207, 1.765)
    assert (s.scanner_name, s.scanner_type, s.serial) == (
        "FleX-ray",
        "FleX-ray",
        "042_0001",
    )
    assert (s.kV, s.power_W, s.vacuum) == (90.0, 49.5, "512.000000E-9")
    assert (s.exposure_ms, s.averages, s.mode) == (99.998, 3.0, "HW2SW1High")
    assert (s.original_pixel_mm, s.binning, s.binned_pixel_mm) == (0.0748, 2, 0.1496)
    assert s.roi == Roi(32, 8, 1943, 1527)
    assert list(s.motors) == ["ver_obj", "mag_obj", "mag_det", "rot_obj", "tra_obj", "tra_det",
                              "tra_tube", "ver_tube", "ver_det"]  # fmt: skip
    assert s.motors["rot_obj"] == MotorLine(-4.222728, 3.3334, 22.5)
    assert (s.scan_type, s.projections, s.cancelled) == ("smooth scan", 361, False)
    assert (s.start_angle_deg, s.last_angle_deg) == (0.0, 360.0)
    assert (s.pre_flats, s.post_flats, s.darks) == (20, 20, 10)
    assert (s.reference_every, s.preheating_minutes, s.flat_axis) == (0, 5, "tra_obj")


def test_writing_what_was_read_gives_the_same_bytes(data: Path) -> None:
    text = read(data / "flexray_scan_settings.txt")
    assert format_scan_settings(parse_scan_settings(text)) == text


def test_the_other_text_says_the_same(data: Path) -> None:
    xre = parse_xre(read(data / "flexray_data_settings_XRE.txt"))
    assert xre.text("sample INFO", "comment") == 'she said "again" in E:\\data'
    assert xre.number("Camera settings", "Rows") == 760.0
    a, b = xre.settings, parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    assert a.figures is not None
    assert b.figures is not None
    assert vars(a.figures) == pytest.approx(vars(b.figures), abs=1e-5)
    assert {n: m.value for n, m in a.motors.items()} == {
        n: m.value for n, m in b.motors.items()
    }
    for name in ("projections", "start_angle_deg", "last_angle_deg", "roi", "mode", "exposure_ms",
                 "averages", "kV", "power_W", "darks", "pre_flats", "post_flats", "scan_type",
                 "scanner_name", "serial", "flat_axis"):  # fmt: skip
        assert getattr(a, name) == getattr(b, name), name


def test_the_printed_figures_pick_the_profile_and_the_rule_the_angles(data: Path) -> None:
    """Hand arithmetic: SOD 585.0808 + 14.9192, source height 26.2917 - 6.2917 and so on."""
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    machines = [builtin_machine(n) for n in builtin_machines()]
    profiles = [builtin_profile(n) for n in builtin_profiles()]
    r = rebuild(s, 361, (760, 956), machines, profiles)
    assert r.profile is not None
    assert r.profile.name == "cwi-2023-08-21"
    assert r.poses.source[0] == pytest.approx([0.0, 0.0, 20.0])
    assert r.poses.axis[0] == pytest.approx([0.0137, 600.000003, 20.0])
    assert r.poses.detector[0] == pytest.approx([0.0016, 1058.999997, 20.0])
    assert np.degrees(r.poses.angle) == pytest.approx(np.arange(361.0))
    assert r.positions["tra_det"][0] == pytest.approx(25.3167)


def test_unknown_scanners_get_the_printed_figures(data: Path) -> None:
    s = replace(
        parse_scan_settings(read(data / "flexray_scan_settings.txt")),
        scanner_name="Other", scanner_type="Other",
    )  # fmt: skip
    r = rebuild(s, 361, (760, 956), [builtin_machine()], [])
    assert r.machine is not None  # one machine alone is taken as it is
    r = rebuild(s, 361, (760, 956), [], [])
    assert r.machine is None
    assert "not known" in r.notes[0]
    p = r.poses
    assert p.sod[0] == pytest.approx(600.000003)
    assert p.axis[0, 0] - p.source[0, 0] == pytest.approx(0.0137, abs=1e-6)
    assert p.detector[0, 0] - p.source[0, 0] == pytest.approx(0.0016, abs=1e-6)
    known = replace(s, scanner_name="FleX-ray", motors={})
    r = rebuild(known, 361, (760, 956), [builtin_machine()], [])
    assert "no motor positions" in r.notes[0]
    assert r.poses.sdd[0] == pytest.approx(1058.999997)
    with pytest.raises(DatasetFormatError, match="not all of SOD"):
        rebuild(replace(s, hc_px=None), 361, (760, 956), [], [])


def test_without_a_region_the_figures_count_and_heights_come_from_the_motors(
    data: Path,
) -> None:
    """Older texts do not state the region; a shifted figure is believed, not the profile."""
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    profiles = [builtin_profile(n) for n in builtin_profiles()]
    for changed in (replace(s, roi=None), replace(s, hc_px=481.0, cor_px=481.0)):
        r = rebuild(changed, 361, (760, 956), [builtin_machine()], profiles)
        assert r.profile is None
        reason = "no ROI and mode" if changed.roi is None else "no profile reproduces"
        assert r.notes[-1].startswith(reason)
        assert "heights come from the motors and cwi-2023-08-21" in r.notes[-1]
        assert r.poses.source[0, 2] == pytest.approx(20.0)
        assert r.poses.axis[0, 2] == 20.0
        hc = r.poses.cone_vec().piercing_points((760, 956))[0, 0] + 0.5
        assert hc == pytest.approx(changed.hc_px)


VARIANT = """scanid = 1\n  SOD: 600,5 mm\nsdd = 1059.0;\nsod : 1\nhc:478.5;\nVC : 380\nCOR= 478
Binned pixel size : 0.1496
ROI (ltrb) = 32 8 1943 1527
tra_obj : 0.5;
tra_det : -25.3 ; Speed : 50 ; acceleration : 100
Sample name : a : b = c
SCRIPT CANCELLED! by somebody
#  projections
# PROJECTIONS: 12
scan type: smooth scan
"""


def test_reading_bears_the_variations_of_real_files() -> None:
    s = parse_scan_settings(VARIANT)
    assert (s.scan_id, s.sod_mm, s.sdd_mm, s.hc_px) == ("1", 600.5, 1059.0, 478.5)
    assert s.roi == Roi(32, 8, 1943, 1527)
    assert s.motors == {
        "tra_obj": MotorLine(0.5),
        "tra_det": MotorLine(-25.3, 50.0, 100.0),
    }
    assert s.sample_name == "a : b = c"
    assert s.cancelled
    assert s.projections == 12
    assert s.scan_type == "smooth scan"
    assert s.kV is None
    assert s.figures is not None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("HC : 478\nSOD : about 600", r"my\.txt, line 2: cannot read 'SOD : about 600'"),
        ("SOD : nan", "line 1"),
        ("SOD : inf", "line 1"),
        ("# projections: 1.5", "line 1"),
        ("# projections: 1_000", "line 1"),
        ("ROI (LTRB) : 1,2,3", "line 1"),
        ("mag_obj : x ; speed : 1 ; acceleration : 2", "line 1"),
        ("", "holds no line"),
        ("\x00\x01\x02", "holds no line"),
        ("lorem ipsum\n" * 5, "holds no line"),
    ],
)
def test_wrong_figures_are_named_with_their_line(text: str, message: str) -> None:
    with pytest.raises(DatasetFormatError, match=message) as caught:
        parse_scan_settings(text, "my.txt")
    assert caught.value.data["path"] == "my.txt"


def test_a_cancelled_scan_says_so_before_the_summary(
    record: Callable[..., ScanRecord],
) -> None:
    text = format_scan_settings(record(complete=False, reason="aborted"))
    assert text.index("SCRIPT CANCELLED!") < text.index("Script summary:")
    assert parse_scan_settings(text).cancelled
    assert "SCRIPT CANCELLED!" not in format_scan_settings(record(complete=True))
    xre = parse_xre(format_xre(record(complete=False, reason="aborted")))
    assert xre.text("Scan info", "Succeeded") == "FALSE"
    assert xre.text("Scan info", "Error") == "aborted"


def test_names_cannot_smuggle_lines_into_the_texts(
    record: Callable[..., ScanRecord],
) -> None:
    evil = 'x"\r\nSOD : 1\r\n[motor positions]\r\ntra_obj = 5'
    r = record()
    r = replace(
        r, name="n", operator=evil, sample=replace(r.sample, name=evil, comment=evil)
    )
    s = parse_scan_settings(format_scan_settings(r))
    assert s.sod_mm == pytest.approx(514.9192)
    x = parse_xre(format_xre(r))
    assert x.number("motor positions", "tra_obj") == 2.5
    assert x.text("Sample info", "Sample name") == evil.replace("\r\n", " ")


def test_the_document_ignores_nothing_that_is_said_of_an_image(
    record: Callable[..., ScanRecord],
) -> None:
    scan = record()
    document = DatasetDocument.of(scan)
    cameras = [
        scan.camera,
        *(block.camera for block in scan.blocks for _ in range(len(block))),
    ]
    for entry, camera in zip((document.detector, *document.frames), cameras, strict=True):
        said = camera.of_image
        assert {name: getattr(entry, name) for name in said} == said


@pytest.mark.parametrize("side", ["rows", "cols"])
def test_an_image_has_at_least_one_pixel(
    record: Callable[..., ScanRecord], side: str
) -> None:
    document = DatasetDocument.of(record()).model_dump(mode="json", by_alias=True)
    for pixels in (1, 0):
        document["detector"][side] = pixels
        if pixels:
            assert getattr(DatasetDocument.model_validate(document).detector, side) == 1
        else:
            with pytest.raises(ValidationError, match=side):
                DatasetDocument.model_validate(document)


def test_both_texts_of_a_scan_agree(record: Callable[..., ScanRecord]) -> None:
    a = parse_scan_settings(format_scan_settings(record()))
    b = parse_xre(format_xre(record())).settings
    for f in fields(ScanSettings):
        ours, theirs = getattr(a, f.name), getattr(b, f.name)
        if theirs is not None and f.name != "motors":
            assert ours == theirs, f.name
    assert {n: m.value for n, m in a.motors.items()} == {
        n: m.value for n, m in b.motors.items()
    }


def test_the_xre_has_voxels_in_mm_and_the_turntable_s_rates(
    record: Callable[..., ScanRecord],
) -> None:
    """In the other text they are in um."""
    um = parse_scan_settings(format_scan_settings(record())).voxel_um
    assert um
    for rates in (20.0, 0.0):
        rated = dict.fromkeys(record().positions, rates)
        xre = parse_xre(format_xre(record(speeds=rated, accelerations=rated)))
        assert float(
            xre.sections["CT-parameters IN"]["Voxel size"]
        ) * 1e3 == pytest.approx(um, 1e-3)
        last = xre.sections["Acquisition settings"]
        assert [float(last[f"rotation {key}"]) for key in ("speed", "acc")] == [rates] * 2


def test_dates_with_a_zone_are_written_in_universal_time(
    record: Callable[..., ScanRecord],
) -> None:
    zone = timezone(timedelta(hours=2))
    xre = parse_xre(format_xre(record(started=datetime(2026, 3, 14, 1, 5, 9, 250, zone))))
    assert xre.text("Scan info", "Start") == "2026-03-13 23:05:09.0002500 UTC"


def test_the_flat_s_place_is_that_of_the_flats_not_of_the_darks(
    record: Callable[..., ScanRecord],
) -> None:
    r = record()
    dark, *others = r.blocks
    aside = replace(dark, positions={**dark.positions, "tra_obj": np.array([7.0])})
    for blocks, expected in (
        ((aside, *others), "-100.000000"),
        ((aside, others[1]), None),
    ):
        sections = parse_xre(format_xre(replace(r, blocks=blocks))).sections
        assert sections["Acquisition settings"].get("Flat Field position") == expected


def test_settings_of_the_xre_come_back_and_those_not_known_are_left_out(
    record: Callable[..., ScanRecord],
) -> None:
    settings = parse_xre(format_xre(record())).settings
    back = parse_xre(format_settings(settings)).settings
    for name in ("kV", "power_W", "exposure_ms", "averages", "sample_name", "flat_axis"):
        assert getattr(back, name) == getattr(settings, name) is not None
    bare = parse_xre(format_settings(ScanSettings(kV=90.0))).sections
    assert [len(entries) for entries in bare.values()] == [1]


@pytest.mark.parametrize(
    ("seconds", "minutes"), [(29.0, 0.0), (147.4, 2.0), (3600.0, 60.0)]
)
def test_the_duration_is_in_whole_minutes(
    record: Callable[..., ScanRecord], seconds: float, minutes: float
) -> None:
    assert settings_of(record(duration_s=seconds)).duration_minutes == minutes


def test_sections_tell_scans_that_the_texts_cannot_describe(
    record: Callable[..., ScanRecord],
) -> None:
    r = record()
    assert r.sections() == 1
    assert parse_xre(format_xre(r)).one_circle
    block = r.blocks[2]
    moved = {**block.positions, "ver_det": block.positions["ver_det"] + 5.0}
    tiled = replace(r, blocks=(*r.blocks, replace(block, positions=moved)))
    assert tiled.sections() == 2
    assert not parse_xre(format_xre(tiled)).one_circle
    rising = {**block.positions, "ver_tube": np.linspace(20, 30, len(block))}
    helical = replace(r, blocks=(replace(block, positions=rising),))
    assert not parse_xre(format_xre(helical)).one_circle


FIGURES = st.builds(
    Figures, st.floats(50, 900), st.floats(900, 2000), st.floats(-100, 1100), st.floats(-100, 900),
    st.floats(-100, 1100), st.floats(0.01, 1.0),
)  # fmt: skip


@given(
    FIGURES, st.floats(-50, 50), st.floats(-50, 50), st.floats(-50, 50), st.floats(-7, 7),
    st.floats(-0.1, 0.1),
)  # fmt: skip
def test_figures_are_edges_and_poses_have_them(
    f: Figures, across: float, up: float, axis_up: float, angle: float, roll: float
) -> None:
    """A pinhole by hand: columns to the right, rows down, from the edge of the first pixel.

    COR is the axis's column at the source's height, also on a rolled panel.
    """
    rows, cols = 760, 956
    p = poses_of(f, (rows, cols), np.array([angle, 0.3]), source_x=across, source_z=up,
                 axis_z=axis_up)  # fmt: skip
    [sx, sy, sz], [ax, ay, az], [dx, dy, dz] = p.source[0], p.axis[0], p.detector[0]
    assert (sx, sy, sz, az) == (across, 0.0, up, axis_up)
    assert (ay, dy) == pytest.approx((f.sod_mm, f.sdd_mm))
    assert (sx - dx) / f.pixel_mm + cols / 2 == pytest.approx(f.hc_px, abs=1e-6)
    assert (dz - sz) / f.pixel_mm + rows / 2 == pytest.approx(f.vc_px, abs=1e-6)
    shadow = sx + (ax - sx) * f.sdd_mm / f.sod_mm
    assert (shadow - dx) / f.pixel_mm + cols / 2 == pytest.approx(f.cor_px, abs=1e-6)
    assert vars(figures_of(p[:1], (rows, cols))) == pytest.approx(vars(f), abs=1e-6)
    c, s = math.cos(roll), math.sin(roll)
    pixel = f.pixel_mm * np.ones((2, 1))
    rolled = replace(p, u=-pixel * [c, 0.0, s], v=pixel * [s, 0.0, -c])
    level = ((dx - shadow) * c + (dz - sz) * s) / f.pixel_mm + cols / 2
    assert figures_of(rolled[:1], (rows, cols)).cor_px == pytest.approx(level, abs=1e-6)
    assert f.magnification == f.sdd_mm / f.sod_mm
    assert f.voxel_um * f.magnification == pytest.approx(1000 * f.pixel_mm)


@pytest.mark.parametrize(
    ("field", "close"),
    [("sod_mm", 0.01), ("sdd_mm", 0.01), ("hc_px", 0.05), ("vc_px", 0.05), ("cor_px", 0.05),
     ("binned_pixel_mm", 1e-5)],
)  # fmt: skip
def test_a_profile_reproduces_every_printed_figure_or_is_not_taken(
    data: Path, field: str, close: float
) -> None:
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    profiles = [builtin_profile(n) for n in builtin_profiles()]
    for off, taken in ((0.9, True), (-0.9, True), (1.1, False), (-1.1, False)):
        value = getattr(s, field) + off * close
        near = replace(s, **{field: value})
        profile = rebuild(near, 361, (760, 956), [builtin_machine()], profiles).profile
        assert (profile is not None) == taken, off


def test_machines_are_found_by_name_or_by_their_motors(data: Path) -> None:
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    machines = [builtin_machine(n) for n in builtin_machines()]
    assert rebuild(s, 361, (760, 956), [builtin_machine()], []).profile is None
    nameless = replace(s, scanner_name=None, scanner_type="")
    found = rebuild(nameless, 361, (760, 956), machines, []).machine
    assert found is not None
    assert found.name == "flexray"
    twice = [builtin_machine(), builtin_machine().model_copy(update={"name": "other"})]
    other = replace(s, scanner_name="Nix", scanner_type=None)
    for known, said in (
        (nameless, "'(unnamed)' is not known"),
        (other, "'Nix' is not known"),
    ):
        r = rebuild(known, 361, (760, 956), twice, [])
        assert r.machine is None
        assert said in r.notes[0]


def test_without_a_profile_places_are_those_of_the_motors(data: Path) -> None:
    s = parse_scan_settings(read(data / "flexray_scan_settings.txt"))
    motors = {**s.motors, "tra_tube": MotorLine(1.25), "ver_tube": MotorLine(30.0)}
    for count in (1, 3):
        r = rebuild(
            replace(s, roi=None, motors=motors),
            count,
            (760, 956),
            [builtin_machine()],
            [],
        )
        assert r.profile is None
        assert r.poses.source[0] == pytest.approx([1.25, 0.0, 30.0])
        assert r.poses.axis[:, 2] == pytest.approx([20.0] * count)


@pytest.mark.parametrize(
    ("projections", "count", "angles"),
    [
        (5, 3, [10, 100, 190]),
        (None, 3, [10, 190, 370]),
        (1, 2, [10, 10]),
        (2, 2, [10, 370]),
    ],
)
def test_angles_follow_the_rule_of_the_stated_number(
    projections: int | None, count: int, angles: list[float]
) -> None:
    s = ScanSettings(projections=projections, start_angle_deg=10.0, last_angle_deg=370.0)
    assert angles_deg(s, count, "a.txt") == pytest.approx(angles)
    for gone in ("start_angle_deg", "last_angle_deg"):
        with pytest.raises(DatasetFormatError, match="angles cannot be known"):
            angles_deg(replace(s, **{gone: None}), count, "a.txt")


def test_exposures_before_and_after_are_counted(
    record: Callable[..., ScanRecord],
) -> None:
    """Darks and flats of ten averages; three flats of four more at the end."""
    r = record()
    dark, flat, scan, _ = r.blocks
    few = replace(flat.camera, averages=4)
    after = replace(flat, camera=few, files=("a", "b", "c"), times_s=np.zeros(3),
                    positions={n: np.repeat(v, 3) for n, v in flat.positions.items()})  # fmt: skip
    s = settings_of(replace(r, blocks=(dark, dark, flat, scan, after)))
    assert (s.pre_flats, s.post_flats, s.darks, s.projections) == (10, 12, 20, 5)
    assert (s.start_angle_deg, s.last_angle_deg) == pytest.approx((0.0, 360.0))
    assert (s.reference_every, s.preheating_minutes) == (0, 0)
    assert (s.filament_status, s.target_current_uA) == ("OK", 500.0)
    none = settings_of(replace(r, blocks=(dark, flat)))
    assert (none.start_angle_deg, none.last_angle_deg, none.projections) == (0.0, 0.0, 0)
    off = parse_xre(format_xre(replace(r, kV=0.0))).sections["Tube settings"]
    assert (off["Current set value"], off["Target current actual value"]) == (
        "0.000000",
    ) * 2
    assert off["Filament status"] == "OK"


@pytest.mark.parametrize(
    ("turns", "projections"),
    [([0, 90, 180, 270, 360], 5), ([360, 270, 180, 90, 0], 5), ([0, 45, 90], 9),
     ([90, 45, 0], 9), ([7], 1), ([7, 7], 2), ([-180, 0, 180], 3)],
)  # fmt: skip
def test_what_the_xre_says_of_turn_and_volume(
    record: Callable[..., ScanRecord], turns: list[float], projections: int
) -> None:
    r = record(frames=len(turns))
    dark, flat, scan, _ = r.blocks
    moved = replace(
        scan, positions={**scan.positions, "rot_obj": np.array(turns, dtype=float)}
    )
    sections = parse_xre(format_xre(replace(r, blocks=(dark, flat, moved)))).sections
    acquisition, ct = sections["Acquisition settings"], sections["CT-parameters IN"]
    assert acquisition["projs_per_360"] == str(projections)
    assert [float(acquisition[f"CT {end} angle"]) for end in ("start", "stop")] == [
        turns[0], turns[-1],
    ]  # fmt: skip
    assert [float(ct[key]) for key in ("x_end", "y_end", "z_end", "zmax")] == [
        29,
        29,
        23,
        23,
    ]


def test_places_of_the_scan_by_hand(record: Callable[..., ScanRecord]) -> None:
    """Zero offsets of 2023-08-21; a panel of 30 x 24 pixels of 0.1496 mm in its middle."""
    points = parse_xre(format_xre(record())).sections["POIs"]
    found = {
        name: {key: [float(x) for x in values.split(";")]
               for key, values in re.findall(r"(WC|dir[XYZ])\[([^\]]*)\]", entry)}
        for name, entry in points.items()
    }  # fmt: skip
    source, axis = [1.25, 0.0, 26.5 - 6.2917], [2.5 - 0.5405, 514.9192, 20.0]
    panel = [24.1215 - 24.0, 1040.0008, 21.0]
    c, s = math.cos(math.radians(6.25)), -math.sin(math.radians(6.25))
    beam = [axis[0], axis[1], source[2]]
    stretch = panel[1] / axis[1]
    pitch = 1 / 0.1496
    expected = {
        "COT": (beam, [c, -s, 0], [-s, -c, 0], [0, 0, 1]),
        "HCVC": ([source[0], panel[1], source[2]], *[[0, 0, 0]] * 3),
        "image": ([panel[0] - 15 * 0.1496, panel[1], panel[2] + 12 * 0.1496], [pitch, 0, 0],
                  [0, 0, -pitch], [0, -1, 0]),
        "object": (axis, [c, -s, 0], [s, c, 0], [0, 0, 1]),
        "TMV": (beam, [1, 0, 0], [0, 1, 0], [0, 0, 1]),
        "bricks$ample": (beam, [c, -s, 0], [s, c, 0], [0, 0, 1]),
        "projCOT": ([1.25 + (axis[0] - 1.25) * stretch, panel[1], source[2]], *[[0, 0, 0]] * 3),
        "world": ([0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]),
    }  # fmt: skip
    for name, values in expected.items():
        for key, value in zip(("WC", "dirX", "dirY", "dirZ"), values, strict=True):
            assert found[name][key] == pytest.approx(value, abs=6e-5), (name, key)
    for name, entry in points.items():
        height = {"TMV": 0.0, "bricks$ample": 2000.0}.get(name, -1.0)
        assert (
            f"height[{height:f}]track[{'TRUE' if 'ample' in name else 'FALSE'}]" in entry
        )


def test_the_axis_of_the_flat_field_is_the_linear_one_that_moved_most() -> None:
    text = (
        "tube xrayon ACK\nmag_obj move absolute 500 ACK\ntra_obj move absolute -150 ACK\n"
        "rot_obj move absolute 300 ACK\ncamera take image ACK\ncamera save image io0.tif ACK\n"
        "{}rot_obj move absolute 0 ACK\ncamera take image ACK\ncamera save image s0.tif ACK\n"
    )
    for moves, axis in (("tra_obj move absolute 0 ACK\n", "tra_obj"), ("", ""),
                        ("tra_obj move absolute -150.9 ACK\n", ""),
                        ("mag_obj move absolute 502 ACK\n", "mag_obj")):  # fmt: skip
        plan = plan_script(text.format(moves))
        r = ScanRecord.from_plan(plan, name="a", started=datetime(2026, 3, 14))
        assert r.flat_axis == axis
        assert (r.sample.diameter_mm, r.sample.height_mm) == (0.0, 0.0)
        assert (r.count("flat"), r.count("projection"), r.smooth) == (1, 1, False)
        first = plan.exposures[-1]
        assert r.positions == pytest.approx(first.positions)


@pytest.mark.parametrize("projections", [0, 1, 2])
def test_a_scan_s_settings_are_those_of_its_first_projection_or_of_the_start(
    projections: int,
) -> None:
    shot = "camera take image ACK\ncamera save image {}.tif ACK\n"
    text = "tube xrayon ACK\n" + shot.format("io0")
    for i in range(projections):
        text += f"tube set kV {60 + i} ACK\ncamera set exposure {200 + i} ACK\n"
        text += f"rot_obj move absolute {90 + i} ACK\n" + shot.format(f"s{i}")
    plan = plan_script(text)
    r = ScanRecord.from_plan(plan, name="a", started=datetime(2026, 3, 14))
    found = (r.kV, r.camera.exposure_ms, r.positions["rot_obj"])
    at_start = (plan.start.kV, plan.start.camera.exposure_ms, 0.0)
    assert found == (at_start if projections == 0 else (60.0, 200.0, 90.0))


@pytest.mark.parametrize("moving", ["flat", "projection"])
def test_a_scan_is_smooth_where_its_projections_are(moving: str) -> None:
    go = {moving: "rot_obj move absolute {} no wait\n"}
    shot = "camera take image\ncamera save image {}.tif\n"
    text = go.get("flat", "").format(90) + shot.format("io0")
    text += (
        "rot_obj move absolute 90 ACK\n"
        + go.get("projection", "").format(180)
        + shot.format("s0")
    )
    r = ScanRecord.from_plan(plan_script(text), name="a", started=datetime(2026, 3, 14))
    assert r.smooth == (moving == "projection")


def test_every_place_of_the_panel_is_a_section(record: Callable[..., ScanRecord]) -> None:
    r = record()
    block = r.blocks[2]
    places = [
        {**block.positions, "ver_det": block.positions["ver_det"] + k} for k in range(4)
    ]
    for n in range(1, 5):
        tiles = tuple(replace(block, positions=place) for place in places[:n])
        assert replace(r, blocks=tiles).sections() == n
    uneven = {**block.positions, "rot_obj": np.array([0.0, 90.0, 180.0, 271.0, 360.0])}
    assert replace(r, blocks=(replace(block, positions=uneven),)).sections() == 2
    tail = {
        **block.positions,
        "ver_tube": block.positions["ver_tube"] + [0, 0, 0, 0, 1.0],
    }
    assert replace(r, blocks=(replace(block, positions=tail),)).sections() == 2


@pytest.mark.parametrize(
    "line",
    ["1abc : 5 ; speed : 3", "(x) : 5", "plain : 5", "tra_obj : about 5", "a_b : 5 mm"],
)
def test_lines_that_are_no_motors_are_left_out(line: str) -> None:
    assert parse_scan_settings(f"SOD : 1\n{line}").motors == {}


@pytest.mark.parametrize(
    ("text", "kind"),
    [("scan type:\nsmooth scan", "smooth scan"), ("scan type:\n# projections: 12", None),
     ("scan type: step scan", "step scan"), ("SOD : 1\nscan type:\n\n\nsmooth scan", "smooth scan"),
     ("SOD : 1\nscan type:", "")],
)  # fmt: skip
def test_the_scan_s_type_stands_on_its_line_or_on_the_next(
    text: str, kind: str | None
) -> None:
    assert parse_scan_settings(text).scan_type == kind


TEXT = st.text(
    alphabet=string.ascii_letters + string.digits + " -_:=.,()/\\\"'äé", max_size=20
).map(str.strip)
NUMBER = st.floats(-1e6, 1e6).map(lambda v: round(v, 6) + 0.0)
COUNT = st.integers(0, 10**6)
MOMENT = st.datetimes(datetime(1990, 1, 1), datetime(2090, 1, 1)).map(
    lambda d: d.replace(microsecond=0)
)
ROI = st.builds(Roi, *[st.integers(0, 9999)] * 4)
MOTORS = st.dictionaries(
    st.from_regex(r"(mag|rot|tra|ver)_[a-z]{3,6}", fullmatch=True),
    st.builds(MotorLine, NUMBER, NUMBER, NUMBER)
    | st.builds(MotorLine, NUMBER, st.none() | NUMBER),
    max_size=9,
)


def strategy_of(field: str) -> st.SearchStrategy[object]:
    kinds = {
        "str | None": st.none() | TEXT,
        "float | None": st.none() | NUMBER,
        "int | None": st.none() | COUNT,
        "datetime | None": st.none() | MOMENT,
        "Roi | None": st.none() | ROI,
        "bool": st.booleans(),
        "Mapping[str, MotorLine]": MOTORS,
    }
    (kind,) = [f.type for f in fields(ScanSettings) if f.name == field]
    special = {
        "duration_minutes": st.none() | COUNT.map(float),
        # A type alone on its line would otherwise be read as the next key.
        "scan_type": st.none() | st.sampled_from(["smooth scan", "step scan"]),
        "scanner_type": TEXT,
        "scan_id": TEXT,
    }
    return special.get(field, kinds[str(kind)])  # type: ignore[return-value]


@given(st.fixed_dictionaries({f.name: strategy_of(f.name) for f in fields(ScanSettings)}))
@pytest.mark.slow
def test_settings_come_back_equal(values: dict[str, object]) -> None:
    settings = ScanSettings(**values)  # type: ignore[arg-type]
    assert parse_scan_settings(format_scan_settings(settings)) == settings


@given(st.text(max_size=400))
def test_no_text_breaks_the_parsers(text: str) -> None:
    for parse in (parse_scan_settings, parse_xre):
        with suppress(DatasetFormatError):
            parse(text)


VALUE = st.booleans() | st.integers(-(10**9), 10**9) | NUMBER | TEXT
KEY = st.from_regex(r"[A-Za-z][A-Za-z0-9_()#. ]{0,20}[a-z]", fullmatch=True)


@given(
    st.dictionaries(KEY, st.dictionaries(KEY, VALUE, max_size=5), min_size=1, max_size=4)
)
@pytest.mark.slow
def test_sections_come_back_equal(
    sections: dict[str, dict[str, bool | int | float | str]],
) -> None:
    back = parse_xre(format_sections(sections)).sections
    assert set(back) == set(sections)
    for name, entries in sections.items():
        assert set(back[name]) == set(entries)
        for key, value in entries.items():
            match value:
                case bool():
                    assert back[name][key] == ("TRUE" if value else "FALSE")
                case str():
                    assert back[name][key] == value
                case _:
                    assert float(back[name][key]) == value


def test_a_detector_that_physically_stands_elsewhere(data: Path) -> None:
    """`mag_det_phys` 10 mm behind `mag_det`: 10 mm more SDD, 0.94 % more magnification."""
    text = read(data / "flexray_scan_settings.txt")
    plain = parse_scan_settings(text)
    line = next(entry for entry in text.splitlines() if entry.startswith("mag_det :"))
    real = line.replace("mag_det", "mag_det_phys").replace(
        f"{plain.motors['mag_det'].value:f}", f"{plain.motors['mag_det'].value + 10.0:f}"
    )
    s = parse_scan_settings(text.replace(line, f"{line}\r\n{real}"))
    profiles = [builtin_profile(n) for n in builtin_profiles()]
    known = rebuild(s, 361, (760, 956), [builtin_machine()], profiles)
    figures = rebuild(s, 361, (760, 956), [], [])
    assert known.profile is not None
    assert known.profile.name == "cwi-2023-08-21"
    assert known.positions["mag_det"][0] == pytest.approx(
        plain.motors["mag_det"].value + 10.0
    )
    for r in (known, figures):
        assert r.poses.sdd[0] == pytest.approx(1068.999997, abs=1e-5)
        longer = r.poses.sdd[0] / r.poses.sod[0] / plain.magnification
        assert longer == pytest.approx(1.00944, abs=1e-5)
        assert r.poses.axis[0, 0] - r.poses.source[0, 0] == pytest.approx(
            0.0137, abs=1e-6
        )
        assert any("mag_det_phys" in note and "+10 mm" in note for note in r.notes)
    assert rebuild(plain, 361, (760, 956), [builtin_machine()], profiles).notes == tuple(
        note for note in known.notes if "mag_det_phys" not in note
    )
    motors = {**plain.motors, "mag_det_phys": MotorLine(-90.0)}
    with pytest.raises(DatasetFormatError, match="behind the source"):
        rebuild(
            replace(plain, motors=motors), 361, (760, 956), [builtin_machine()], profiles
        )


def test_places_of_sample_and_turntable_are_written(
    record: Callable[..., ScanRecord],
) -> None:
    """Names and members as in the published file of a UniTOM XL; there 15 is half of 30 mm."""
    text = format_xre(record(sample=SampleRecord('b[r]i="cks', diameter_mm=30.0)))
    points = parse_xre(text).sections["POIs"]
    assert "radius[15.000000]height[2000.000000]track[TRUE]" in points["bricks$ample"]
    assert points["TMV"].endswith(
        "safe range?[FALSE]minimal[-Inf;-Inf;-Inf]maximal[Inf;Inf;Inf]"
    )
    assert "height[0.000000]" in points["TMV"]
    assert points["TMV"].split("dirX")[0] == points["COT"].split("dirX")[0]
    settings = parse_xre(text).sections["Acquisition settings"]
    assert (settings["mag_tube"], settings["tra_tube"]) == ("0.000000", "1.250000")
