"""The machine as data: shipped files, limits, and errors that name file, path and value."""

from __future__ import annotations

import re
from importlib import resources

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from flexdt.twin.errors import LimitError, MachineFileError, UnknownNameError
from flexdt.twin.machine.camera import (
    CameraSettings,
    PixelGrid,
    Roi,
    binning_of,
    check_roi,
)
from flexdt.twin.machine.description import (
    Axis,
    Component,
    DetectorSpec,
    EStop,
    Profile,
    Spread,
    Timing,
    TubeSpec,
    VirtualAxis,
    builtin_machine,
    builtin_machines,
    builtin_profile,
    builtin_profiles,
    default_profile,
    parse_machine,
)
from flexdt.twin.machine.kinematics import places, poses, resolve_targets
from flexdt.twin.machine.new_machine import Answers, new_machine_text
from flexdt.twin.machine.travel import check_target

X = {"lower": -5.0, "upper": 5.0, "home": 0.0, "speed": 1.0, "max_speed": 2.0, "acceleration": 1.0,
     "max_acceleration": 2.0}  # fmt: skip
TUBE = {"max_kV": 100.0, "max_W": 20.0, "kV": 80.0, "power_W": 8.0}
PANEL = {"model": "a", "columns": 100, "rows": 80, "pitch_mm": 0.2, "bits": 14,
         "mode": "HW2SW1High", "roi": (0, 0, 99, 79)}  # fmt: skip
VIRTUAL = {"constant": 1.0, "of": "a", "factor": -2.0, "moves": {"a": -0.5}}
PART = {"name": "a", "size_mm": (1.0, 1.0, 1.0), "center_mm": (0.0, 0.0, 0.0)}


@pytest.mark.parametrize(
    ("model", "base", "change", "fine"),
    [
        (Axis, X, {"lower": -1e9}, True), (Axis, X, {"lower": -1.01e9}, False),
        (Axis, X, {"upper": 1e9}, True), (Axis, X, {"upper": 1.01e9}, False),
        (Axis, X, {"lower": 0.0, "upper": 0.0}, True), (Axis, X, {"lower": 5.1}, False),
        (Axis, X, {"home": -5.0}, True), (Axis, X, {"home": 5.0}, True),
        (Axis, X, {"home": -5.1}, False), (Axis, X, {"home": 5.1}, False),
        (Axis, X, {"speed": 2.0}, True), (Axis, X, {"speed": 2.1}, False),
        (Axis, X, {"acceleration": 2.0}, True), (Axis, X, {"acceleration": 2.1}, False),
        (Axis, X, {"speed": 1e-6}, True), (Axis, X, {"speed": 0.9e-6}, False),
        (Axis, X, {"max_speed": 1e6}, True), (Axis, X, {"max_speed": 1.1e6}, False),
        (Axis, X, {"arrival_tolerance": 0.0}, True), (Axis, X, {"arrival_tolerance": 0.5}, True),
        (Axis, X, {"arrival_tolerance": -0.1}, False),
        (TubeSpec, TUBE, {"min_kV": 0.5}, True), (TubeSpec, TUBE, {"min_kV": -0.1}, False),
        (TubeSpec, TUBE, {"min_kV": 80.0}, True), (TubeSpec, TUBE, {"min_kV": 80.1}, False),
        (TubeSpec, TUBE, {"max_kV": 80.0}, True), (TubeSpec, TUBE, {"max_kV": 79.9}, False),
        (TubeSpec, TUBE, {"max_kV": 1e4}, True), (TubeSpec, TUBE, {"max_kV": 1.1e4}, False),
        (TubeSpec, TUBE, {"max_W": 1e6}, True), (TubeSpec, TUBE, {"max_W": 1.1e6}, False),
        (TubeSpec, TUBE, {"power_W": 20.0}, True), (TubeSpec, TUBE, {"power_W": 20.1}, False),
        (TubeSpec, TUBE, {"warm_up_s": 0.0, "cold_after_s": 0.0}, True),
        (TubeSpec, TUBE, {"warm_up_s": -0.1}, False), (TubeSpec, TUBE, {"cold_after_s": -1}, False),
        (TubeSpec, TUBE, {"spot_mm_per_W": 0.0, "smallest_spot_mm": 0.0}, True),
        (TubeSpec, TUBE, {"spot_mm_per_W": 1.0, "smallest_spot_mm": 10.0}, True),
        (TubeSpec, TUBE, {"spot_mm_per_W": 1.1}, False),
        (TubeSpec, TUBE, {"smallest_spot_mm": 10.1}, False),
        (TubeSpec, TUBE, {"spot_points": 1}, True), (TubeSpec, TUBE, {"spot_points": 2}, False),
        (TubeSpec, TUBE, {"spot_points": 3}, True), (TubeSpec, TUBE, {"spot_points": 0}, False),
        (DetectorSpec, PANEL, {"response": ((9.0, 5.0), (20.0, 5.0), (20.1, 5.0))}, True),
        (DetectorSpec, PANEL, {"response": ((9.0, 5.0), (20.0, 5.0), (20.0, 5.0))}, False),
        (DetectorSpec, PANEL, {"pitch_mm": 1e6}, True),
        (DetectorSpec, PANEL, {"pitch_mm": 0.0}, False),
        (DetectorSpec, PANEL, {"pitch_mm": 1.1e6}, False), (DetectorSpec, PANEL, {"bits": 8}, True),
        (DetectorSpec, PANEL, {"bits": 7}, False), (DetectorSpec, PANEL, {"bits": 16}, True),
        (DetectorSpec, PANEL, {"min_exposure_ms": 1e-6, "max_exposure_ms": 1e7}, True),
        (DetectorSpec, PANEL, {"max_exposure_ms": 1.1e7}, False),
        (DetectorSpec, PANEL, {"modes": {"a": 1, "b": 64}}, True),
        (DetectorSpec, PANEL, {"modes": {"a": 65}}, False),
        (DetectorSpec, PANEL, {"modes": {"a": 0}}, False),
        (DetectorSpec, PANEL, {"long_lag_fraction": 0.99}, True),
        (DetectorSpec, PANEL, {"long_lag_fraction": 1.0}, False),
        (DetectorSpec, PANEL, {"roi": (1, 2, 2, 3)}, True),
        (DetectorSpec, PANEL, {"roi": (1, 2, 1, 3)}, False),
        (DetectorSpec, PANEL, {"roi": (1, 2, 2, 2)}, False),
        (DetectorSpec, PANEL, {"roi": (0, 0, 100, 79)}, False),
        (VirtualAxis, VIRTUAL, {"moves": {"a": -0.5, "b": 3.0}}, True),
        (VirtualAxis, VIRTUAL, {"moves": {"a": -0.5, "b": 0.0}}, False),
        (VirtualAxis, VIRTUAL, {"moves": {"b": -0.5}}, False),
        (VirtualAxis, VIRTUAL, {"moves": {"a": -0.500002}}, False),
        (VirtualAxis, VIRTUAL, {"factor": 0.0}, False),
        (Spread, {"p5_s": 0.0, "p95_s": 1.0, "n": 1}, {}, True),
        (Spread, {"p5_s": 0.0, "p95_s": 1.0, "n": 1}, {"n": 0}, False),
        (Spread, {"p5_s": 0.0, "p95_s": 1.0, "n": 1}, {"p95_s": 1e6}, True),
        (Spread, {"p5_s": 0.0, "p95_s": 1.0, "n": 1}, {"p95_s": 1.1e6}, False),
        (Spread, {"p5_s": 0.5, "p95_s": 1.0, "n": 1}, {}, True),
        (Spread, {"p5_s": -0.1, "p95_s": 1.0, "n": 1}, {}, False),
        (EStop, {}, {"coasting": {"a": 1e6}}, True), (EStop, {}, {"coasting": {"a": 0.0}}, False),
        (Component, PART, {"center_mm": (-1e6, 1e6, 0.0)}, True),
        (Component, PART, {"center_mm": (-1.1e6, 0.0, 0.0)}, False),
        (Component, PART, {"size_mm": (1.0, 1e6, 1.0)}, True),
        (Component, PART, {"size_mm": (1.0, 2.0, 1.0), "shape": "cylinder"}, False),
        (Component, PART, {"size_mm": (1.0, 1.0, 2.0), "shape": "cylinder"}, True),
        (Component, PART, {"name": "a" * 100}, True), (Component, PART, {"name": "a" * 101}, False),
        (Component, PART, {"name": ""}, False), (Component, PART, {"name": "a b"}, False),
        (Profile, {"name": "a", "machine": "b", "source": "c"}, {"priors": {"dD_x": 0.0}}, True),
        (Profile, {"name": "a", "machine": "b", "source": "c"}, {"priors": {"dD_x": 0.5}}, True),
        (Profile, {"name": "a", "machine": "b", "source": "c"}, {"priors": {"dD_x": -0.1}}, False),
        (Profile, {"name": "a", "machine": "b", "source": "c"}, {"priors": {"dQ": 0.1}}, False),
    ],
)  # fmt: skip
def test_figures_have_bounds(
    model: type[BaseModel], base: dict[str, object], change: dict[str, object], fine: bool
) -> None:
    if fine:
        made = model.model_validate(base | change)
        assert {key: getattr(made, key) for key in change} == change
    else:
        with pytest.raises(ValidationError):
            model.model_validate(base | change)


def test_what_a_file_leaves_out() -> None:
    axis, tube, panel = Axis(**X), TubeSpec(**TUBE), DetectorSpec(**PANEL)  # type: ignore[arg-type]
    assert (axis.kind, axis.settings_sign, axis.arrival_tolerance) == ("linear", 1, 0.0)
    assert (tube.min_kV, tube.cold_after_s, tube.warm_up_s) == (0.0, 8 * 3600.0, 300.0)
    assert (tube.spot_mm_per_W, tube.smallest_spot_mm) == (0.001, 0.007)
    assert [(f.material, f.thickness_mm) for f in tube.filters] == [("Al@2.70", 0.5)]
    assert (panel.exposure_ms, panel.min_exposure_ms, panel.max_exposure_ms) == (
        100.0,
        1.0,
        6e4,
    )
    assert (panel.long_lag_fraction, panel.long_lag_s) == (0.0, 10.0)
    assert panel.pixels.size_mm == pytest.approx((20.0, 16.0))
    oblong = DetectorSpec(**PANEL, row_pitch_mm=0.3)  # type: ignore[arg-type]
    assert oblong.pixels.size_mm == pytest.approx((20.0, 24.0))
    profile = Profile(name="a", machine="b", source="c")
    assert (profile.det_tan, profile.src_ort, profile.axs_tan, profile.c_obj, profile.c_det,
            profile.det_roll_deg) == (0.0,) * 6  # fmt: skip
    bare = parse_machine('base = "xyzr_cabinet"\nname = "bare"')
    assert (bare.max_blocked_attempts, bare.estop.category) == (3, 1)


@pytest.mark.parametrize(
    ("base", "text", "said"),
    [
        ("xyzr_cabinet", "[fixed]\nmount_x = 1.0", "fixed.mount_x: must be left out"),
        ("micro_ct", "[fixed]\nmount_x = 1.0", ""),
        ("xyzr_cabinet", "[estop]\ncategory = 0", "a deceleration for every motor, X, Y, Z, R too"),
        ("xyzr_cabinet", "[estop]\ncategory = 0\ncoasting = { X = 1, Y = 1, Z = 1, R = 1 }", ""),
        ("xyzr_cabinet", "components = [1]", "components must be tables"),
        ("xyzr_cabinet", "components = [{ name = 'panel' }, 1]", "components must be tables"),
        ("xyzr_cabinet", "[priors]\ndQ = 1.0", "known offset, told length or cause: dO_x"),
        # The source is 120 x 200 x 120 mm about (0, -100, 0); its front may be the focal spot.
        ("micro_ct", "[[components]]\nname = 'source'\ncenter_mm = [0.0, -100.0, 60.0]", ""),
        ("micro_ct", "[[components]]\nname = 'source'\ncenter_mm = [0.0, -100.0, 60.1]",
         "components.source.center_mm: must be such that the box"),
        ("micro_ct", "[[components]]\nname = 'source'\ncenter_mm = [60.1, -100.0, 0.0]",
         "holds the focal spot"),
        ("micro_ct", "[[components]]\nname = 'source'\ncenter_mm = [0.0, -100.1, 0.0]", "focal"),
        ("micro_ct", "[[components]]\nname = 'source'\nshape = 'cylinder'\n"
         "size_mm = [200.0, 200.0, 120.0]\ncenter_mm = [60.0, -80.0, 60.0]", ""),
        ("micro_ct", "[[components]]\nname = 'source'\nshape = 'cylinder'\n"
         "size_mm = [200.0, 200.0, 120.0]\ncenter_mm = [60.0, -80.0, 60.1]", "the focal spot"),
        ("micro_ct", "[[components]]\nname = 'source'\nshape = 'cylinder'\n"
         "size_mm = [200.0, 200.0, 120.0]\ncenter_mm = [60.0, -80.1, 60.0]", "the focal spot"),
        # The pin is a cylinder of radius 10 mm: 6 and 8 mm beside the axis it still holds it.
        ("micro_ct", "[[components]]\nname = 'pin'\ncenter_mm = [6.0, -8.0, 0.0]", ""),
        ("micro_ct", "[[components]]\nname = 'pin'\ncenter_mm = [6.1, 8.0, 0.0]",
         "components.pin.center_mm: must be such that the cylinder"),
        ("micro_ct", "[[components]]\nname = 'pin'\nparent = 'turntable'",
         "components.pin.axis: must be carried by every motor that .geometry. gives the object"),
        ("micro_ct", "[[components]]\nname = 'mount'\nparent = 'floor'\nanchor = 'object'",
         "components.mount.axis: must be carried by the turntable .R., as mount_x and mount_y"),
        ("micro_ct", "[[components]]\nname = 'pin'\naxis = 'CX'", "has already|every motor"),
        ("micro_ct", "[[components]]\nname = 'panel'\nanchor = 'source'", "for a panel"),
        ("micro_ct", "[[components]]\nname = 'floor'\nrole = 'tube'", "one component with role"),
        ("micro_ct", "[[components]]\nname = 'floor'\nrole = 'sample_mount'\nanchor = 'world'",
         "components.floor.anchor: must be 'object', for a sample_mount"),
    ],
)  # fmt: skip
def test_parts_stand_where_the_x_ray_geometry_has_them(
    base: str, text: str, said: str
) -> None:
    """What is fine says nothing."""
    file = f'base = "{base}"\n{text}\n'
    if said:
        with pytest.raises(MachineFileError, match=said):
            parse_machine(file)
    else:
        parse_machine(file)


@pytest.mark.parametrize(("less", "fine"), [(0.99, True), (1.01, False)])
@pytest.mark.parametrize("side", [0, 2])
def test_the_panel_s_body_may_be_half_a_millimetre_smaller_on_each_side(
    side: int, less: float, fine: bool
) -> None:
    size = [*builtin_machine("micro_ct").detector.pixels.size_mm, 40.0]
    size[1], size[2] = size[2], size[1]
    size[side] -= less
    part = f"[[components]]\nname = 'panel'\nsize_mm = {size}\n"
    text = f'base = "micro_ct"\nallowed_contacts = []\n{part}'
    if fine:
        parse_machine(text)
    else:
        with pytest.raises(MachineFileError, match="holds the active area"):
            parse_machine(text)


@settings(max_examples=50, deadline=None)
@given(st.data(), st.sampled_from([1, 2, 3, 4]))
def test_the_middle_of_a_region_is_that_of_its_binned_pixels(
    data: st.DataObject, binning: int
) -> None:
    """What is left over at the right and at the bottom makes no pixel."""
    pixels = PixelGrid(1944, 1536, 0.0748, 0.08)
    left, top = data.draw(st.integers(0, 1900)), data.draw(st.integers(0, 1500))
    right = data.draw(st.integers(left + binning - 1, 1943))
    bottom = data.draw(st.integers(top + binning - 1, 1535))
    camera = CameraSettings(f"HW{binning}SW1High", Roi(left, top, right, bottom))
    columns = [left + binning * i for i in range((right + 1 - left) // binning)]
    rows = [top + binning * i for i in range((bottom + 1 - top) // binning)]
    assert camera.shape == (len(rows), len(columns))
    across = ((columns[0] + columns[-1] + binning) / 2 - 972) * 0.0748
    down = ((rows[0] + rows[-1] + binning) / 2 - 768) * 0.08
    assert camera.roi_shift_mm(pixels) == pytest.approx((across, down), abs=1e-9)


FLEXRAY = (resources.files("flexdt.twin") / "data/machines/flexray.toml").read_text(
    "utf-8"
)

TABLE_2_1 = {
    "ver_tube": (0, 379),
    "ver_det": (4, 350),
    "tra_tube": (-359, 419),
    "tra_det": (-459, 404),
    "tra_obj": (-234, 194),
    "mag_det": (100, 1059),
    "mag_obj": (70, 996),
    "rot_obj": (-7200, 7200),
}


@pytest.mark.parametrize("name", builtin_machines())
def test_every_shipped_machine_loads_and_has_its_default_profile(name: str) -> None:
    machine = builtin_machine(name)
    assert default_profile(machine, name).machine == machine.name


def test_flexray_limits_are_table_2_1() -> None:
    machine = builtin_machine()
    assert {n: (a.lower, a.upper) for n, a in machine.axes.items()} == TABLE_2_1


@pytest.mark.parametrize(
    ("name", "det_tan", "src_ort", "axs_tan", "roll", "c_obj", "c_det"),
    [
        ("thesis", 0, 0, 0, 0, 0, 0),
        ("cwi-2024-07-25", 24.0042, -6.2879, -0.5143, 0, 14.9192, 40.0008),
        ("cwi-2023-08-21", 24.1215, -6.2917, -0.5405, 0, 14.9192, 40.0008),
        ("cwi-2022-10-28", 24.0485, -5.7730, -0.5010, 0, 14.02, 39.0005),
        ("cwi-2022-05-31", 24.4203, -6.2281, -0.5010, -0.262, 14.02, 39.0005),
        ("cwi-2020-03-26", 24.300, -6.086, -0.524, -0.175, 14.02, 39.0005),
        ("cwi-2019-04-24", 24, -7, -0.5, 0, 14.02, 39.0005),
    ],
)
def test_profiles_are_pinned(
    name: str, det_tan: float, src_ort: float, axs_tan: float, roll: float, c_obj: float,
    c_det: float,
) -> None:  # fmt: skip
    p = builtin_profile(name)
    assert (p.det_tan, p.src_ort, p.axs_tan, p.det_roll_deg) == (
        det_tan,
        src_ort,
        axs_tan,
        roll,
    )
    assert (p.c_obj, p.c_det) == (c_obj, c_det)
    assert name in builtin_profiles("flexray")


@pytest.mark.parametrize(
    ("old", "new", "path"),
    [
        ("upper = 379.0", "upper = -5.0", "axes.ver_tube"),
        ("upper = 379.0", 'upper = "high"', "axes.ver_tube.upper"),
        ('of = "ver_tube"', 'of = "ver_tub"', "virtual_axes.ver_obj"),
        ('on_limit = "clamp"', 'on_limit = "maybe"', "on_limit"),
        ("roi = [32, 8, 1943, 1527]", "roi = [32, 8, 1944, 1527]", "detector"),
        (
            "[virtual_axes.ver_obj]",
            "[virtual_axes.VER_tube]",
            "axes.VER_tube: must be another name: scripts, which tell no case apart, say it of",
        ),
        ("source_x =", "sauce_x =", "geometry"),
        ("max_kV = 90.0", "max_kv = 90.0", "tube.max_kv"),
        ('"Al@2.70"', '"aluminum"', "tube.filters.0.material: "),
        ('"Al@2.70"', '"Xx@2.70"', "tube.filters.0.material: "),
        ('"Al@2.70"', '"Al@-1"', "tube.filters.0.material: "),
        ("thickness_mm = 0.5", "thickness_mm = 0", "tube.filters.0.thickness_mm: "),
        ("thickness_mm = 0.5", "thickness = 0.5", "tube.filters.0.thickness"),
        ("spot_mm_per_W = 0.001", "spot_mm_per_W = -0.001", "tube.spot_mm_per_W: "),
        ("smallest_spot_mm = 0.007", "smallest_spot_mm = inf", "tube.smallest_spot_mm: "),
    ],
)
def test_an_error_names_file_key_path_and_value(old: str, new: str, path: str) -> None:
    assert old in FLEXRAY
    with pytest.raises(MachineFileError) as caught:
        parse_machine(FLEXRAY.replace(old, new, 1), "mine.toml")
    assert caught.value.message.startswith("mine.toml: ")
    assert path in caught.value.message


VER_OBJ = "moves = { ver_tube = -1.0, ver_det = -1.0 }"


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            "acceleration = 22.5",
            "acceleration = 220.5",
            "axes.rot_obj.acceleration: must be at most max_acceleration, 90.0 (value: 220.5)",
        ),
        (
            "upper = 379.0",
            "upper = -5.0",
            "axes.ver_tube.upper: must be at least lower, 0.0 (value: -5.0)",
        ),
        (
            'mode = "HW2SW1High"',
            'mode = "fast"',
            "detector.mode: must be ",
        ),
        (
            'of = "ver_tube"',
            'of = "ver_tub"',
            "virtual_axes.ver_obj.moves: must be shares of motors, 'ver_tub' (the `of`) among them",
        ),
        (
            "factor = -1.0",
            "factor = 0.0",
            "virtual_axes.ver_obj.factor: must be a number other than 0 (value: 0.0)",
        ),
        (
            VER_OBJ,
            "moves = { ver_tube = -1.0, ver_det = 0.0 }",
            "virtual_axes.ver_obj.moves.ver_det: must be a number other than 0, or left out",
        ),
        (
            VER_OBJ,
            "moves = {}",
            "virtual_axes.ver_obj.moves: must be shares of motors, 'ver_tube'",
        ),
        (VER_OBJ, "moves = { ver_det = -1.0 }", "among them (value: {'ver_det': -1.0})"),
        (
            VER_OBJ,
            "moves = { ver_tube = 1.0 }",
            "virtual_axes.ver_obj.moves.ver_tube: must be 1 / factor, -1, so that the axis gets",
        ),
        (
            VER_OBJ,
            "moves = { ver_tube = -1.0, ver_dot = 1.0 }",
            "virtual_axes.ver_obj.moves: must be a known axis: ver_tube, ",
        ),
        ("source_x =", "sauce_x =", "geometry: must be a known quantity: source_x, "),
        (
            '["detector", "detector_stage"]',
            '["detector", "stage"]',
            "allowed_contacts: must be a known component: ",
        ),
        ('scanner_name = "FleX-ray"\n', "", "scanner_name: is missing"),
    ],
)
def test_keys_that_do_not_fit_each_other_are_told_at_one_of_them(
    old: str, new: str, line: str
) -> None:
    assert old in FLEXRAY
    with pytest.raises(MachineFileError, match=re.escape(line)) as caught:
        parse_machine(FLEXRAY.replace(old, new, 1), "mine.toml")
    assert all(
        text.startswith("mine.toml: ") for text in caught.value.message.splitlines()
    )
    assert "whole file" not in caught.value.message
    assert "'...'" not in caught.value.message


def test_a_default_profile_that_does_not_ship_is_told_with_file_and_key() -> None:
    machine = parse_machine(
        FLEXRAY.replace('default_profile = "cwi-2023-08-21"', 'default_profile = "nix"'),
        "m.toml",
    )
    with pytest.raises(
        MachineFileError, match=r"m\.toml: default_profile: .*'nix'.*thesis"
    ):
        default_profile(machine, "m.toml")
    assert default_profile(builtin_machine(), "").name == "cwi-2023-08-21"


def test_a_motor_moves_itself_and_a_virtual_axis_its_motors() -> None:
    machine = builtin_machine()
    assert machine.moves("mag_obj") == {"mag_obj": 1.0}
    assert machine.moves("ver_obj") == {"ver_tube": -1.0, "ver_det": -1.0}
    with pytest.raises(UnknownNameError, match=r"'ver_objj'.*ver_obj"):
        machine.moves("ver_objj")


def test_broken_toml_is_one_readable_line() -> None:
    with pytest.raises(MachineFileError, match=r"mine\.toml: not valid TOML: .*line 1"):
        parse_machine("schema = \nname = 1\n", "mine.toml")


def test_limit_error_says_asked_and_allowed() -> None:
    with pytest.raises(LimitError) as caught:
        check_target(builtin_machine(), "rot_obj", 10000)
    assert str(caught.value) == "rot_obj target 10000 deg is outside [-7200, 7200] deg"
    assert caught.value.data["allowed"] == [-7200, 7200]


def test_unknown_axis_lists_the_valid_ones() -> None:
    with pytest.raises(UnknownNameError, match="ver_obj"):
        resolve_targets(builtin_machine(), {"ver_objj": 1.0}, {})


def test_default_camera_is_956_by_760_of_0_1496() -> None:
    d = builtin_machine().detector
    assert d.camera.shape == (760, 956)
    assert d.camera.pixel_mm(d.pixels) == pytest.approx(0.1496)
    assert d.camera.roi_shift_mm(d.pixels) == pytest.approx((1.1968, 0.0))


def test_size_follows_mode_and_roi() -> None:
    roi = Roi(32, 8, 1943, 1527)
    assert CameraSettings("HW1SW1High", roi).shape == (1520, 1912)
    assert CameraSettings("HW2SW2High", roi).shape == (380, 478)
    assert binning_of("2_HW2SW1LOW") == 2


@pytest.mark.parametrize("mode", ["", "HW0SW1High", "HW1SW0High", "HW2SW1", "SW1HW1High"])
def test_unknown_mode(mode: str) -> None:
    with pytest.raises(LimitError, match="HWaSWb"):
        binning_of(mode)


def test_roi_outside_the_sensor_names_the_edge() -> None:
    sensor = builtin_machine().detector.pixels
    with pytest.raises(LimitError, match="bottom 1907 is outside the sensor's 1536 rows"):
        check_roi(Roi(0, 12, 1919, 1907), sensor, 2)
    with pytest.raises(LimitError, match="holds no pixel"):
        check_roi(Roi(100, 0, 50, 10), sensor, 1)


def test_the_beam_at_home_goes_through_the_middle_of_the_sample() -> None:
    """The first radiograph of a new twin shows the whole LEGO phantom, 49.8 mm tall."""
    machine = builtin_machine()
    profile = builtin_profile(machine.default_profile)
    camera = machine.detector.camera
    near = poses(machine, profile, camera, {"mag_obj": 500.0, "rot_obj": 30.0}).cone_vec()
    corners = np.array(
        [[x, y, z] for x in (-12, 12) for y in (-8, 8) for z in (-24.9, 24.9)]
    )
    rows = near.project_points(corners, camera.shape)[0, :, 1]
    assert rows.min() > 0
    assert rows.max() < camera.shape[0] - 1
    middle = near.project_points(np.zeros((1, 3)), camera.shape)[0, 0, 1]
    assert middle == pytest.approx((camera.shape[0] - 1) / 2, abs=0.1)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('beam = "parallel"', r"beam: allowed: 'cone'; .* parallel .*limits.md"),
        (
            '[detector]\nshape = "curved"',
            r"detector.shape: allowed: 'flat'; curved .*s.md",
        ),
        (
            "[[tube]]\nmax_kV = 90.0",
            r"tube must be a table, .*one tube and one flat panel.*s.md",
        ),
        (
            "[tube2]\nmax_kV = 90.0",
            r"tube2: there is no such key; .*one tube and .*limits.md",
        ),
        (
            '[axes.X]\nunit = "deg"',
            r"axes.X.unit: there is no such key; linear .*limits.md",
        ),
        (
            "[detector]\nbits = 24",
            "detector.bits: allowed: at most 16",
        ),
        (
            "[geometry]\nsource_angle = { R = 1.0 }",
            "a known quantity: .* not modeled .*C-arms",
        ),
        (
            "[geometry]\nsource_x = { R = 1.0 }",
            "geometry.source_x: .*linear axes.*C-arms",
        ),
        ("[geometry]\nangle = { X = 1.0 }", "geometry.angle: .*driven by rotation axes"),
        (
            "[geometry]\nangle = {}",
            "components.turntable.axis: must be a known motor of anchor",
        ),
        (
            'without = ["R"]\n[geometry]\nangle = {}',
            "geometry.angle: must be motors that turn",
        ),
        (
            "[axes.tilt]\nkind = 'rotation'\nlower = -5\nupper = 5\nhome = 0\nspeed = 1\n"
            "max_speed = 1\nacceleration = 1\nmax_acceleration = 1",
            r"axes.tilt: must be in .geometry. with what it moves; .*stages that tilt",
        ),
        (
            'without = ["nix"]',
            "without: must be axes and components of xyzr_cabinet: X, Y, Z, R",
        ),
        ('[detector]\nmode = "fast"', "mode: must be 1x1, 2x2, 4x4, HWaSWb"),
    ],
)
def test_what_stays_outside_is_refused_in_words(text: str, said: str) -> None:
    with pytest.raises(MachineFileError, match=said) as caught:
        parse_machine(f'base = "xyzr_cabinet"\n{text}\n', "mine.toml")
    assert caught.value.message.startswith("mine.toml: ")


def test_a_base_is_a_machine_that_ships() -> None:
    with pytest.raises(MachineFileError, match=r"m.toml: no machine called 'nix' ships"):
        parse_machine('base = "nix"', "m.toml")
    with pytest.raises(MachineFileError, match="base must be the name of a machine"):
        parse_machine("base = 3", "m.toml")


def test_a_file_says_only_what_is_different_from_its_base() -> None:
    base = builtin_machine("xyzr_cabinet")
    mine = parse_machine(
        'base = "xyzr_cabinet"\nname = "mine"\nwithout = ["Y"]\n'
        "[axes.X]\nupper = 10.0\n[tube]\nmax_kV = 130.0\n"
        '[[components]]\nname = "panel"\nsize_mm = [401.0, 62.0, 403.0]\n'
    )
    assert mine.axes["X"] == base.axes["X"].model_copy(
        update={"upper": 10.0, "source": "upper: this file; else assumed"}
    )
    assert set(mine.axes) == {"X", "Z", "R"}
    assert mine.tube.max_kV == 130.0
    assert mine.tube.max_W == base.tube.max_W
    assert "object_z" not in {q for q, factors in mine.geometry.items() if factors}
    parts = {c.name: c for c in mine.components}
    assert parts["panel"].size_mm == (401.0, 62.0, 403.0)
    assert parts["panel"].role == "panel"
    assert parts["lift"].axis is None
    assert default_profile(mine, "m").name == "zero"
    # A base's zero offsets are those of one machine, and not of another that begins with it.
    assert (
        default_profile(parse_machine('base = "flexray"\nname = "ours"'), "m").det_tan
        == 0.0
    )
    assert default_profile(parse_machine('base = "flexray"'), "m").det_tan == 24.1215


@pytest.mark.parametrize(
    ("base", "gone"),
    [("flexray", "mag_rail_left"), ("flexray", "source_platform"), ("unitom_xl", "main_platform"),
     ("xyzr_cabinet", "floor")],
)  # fmt: skip
def test_a_part_left_out_takes_its_allowed_contacts_with_it(base: str, gone: str) -> None:
    before = [set(pair) for pair in builtin_machine(base).allowed_contacts]
    mine = parse_machine(f'base = "{base}"\nwithout = ["{gone}"]\n')
    after = [set(pair) for pair in mine.allowed_contacts]
    assert after == [pair for pair in before if gone not in pair]
    assert 0 < len(after) < len(before)


@pytest.mark.parametrize("word", ["inf", "-inf", "nan"])
def test_numbers_of_a_machine_are_finite(word: str) -> None:
    for where in (
        "[axes.X]\nhome",
        "[axes.X]\nupper",
        "[detector]\npitch_mm",
        "[tube]\nmax_W",
    ):
        with pytest.raises(MachineFileError, match="finite"):
            parse_machine(f'base = "xyzr_cabinet"\n{where} = {word}\n')


def test_times_that_nobody_measured_are_none() -> None:
    """Zero is what a file leaves out, and what it may say; time does not run backwards."""
    plain = Timing(source="none")
    times = [n for n in Timing.model_fields if n.endswith("_s") or n == "drift"]
    assert len(times) > 10
    for name in times:
        assert getattr(plain, name) in (0.0, None)
        for fine in (0.0, 0.5):
            assert (
                getattr(Timing.model_validate({"source": "a", name: fine}), name) == fine
            )
        with pytest.raises(ValueError, match="greater than or equal to 0"):
            Timing.model_validate({"source": "a", name: -1e-9})


@pytest.mark.parametrize("name", [*builtin_machines(), "drawn"])
def test_what_a_distance_is_the_sum_of_adds_up(name: str) -> None:
    """The words are read again as a sum: a number, motors, factors before them."""
    if name == "drawn":
        extra = "".join(
            f"[axes.{m}]\nlower = -7.0\nupper = 50.0\nhome = 3.0\n"
            "speed = 1.0\nmax_speed = 1.0\n"
            "acceleration = 1.0\nmax_acceleration = 1.0\n" for m in "AB"
        )  # fmt: skip
        machine = parse_machine(
            'base = "xyzr_cabinet"\nname = "mine"\nsample_height_mm = 12.0\nallowed_contacts = []\n'
            'without = ["source", "panel", "turntable", "mount", "lift", "x_carriage", '
            '"z_carriage", "floor"]\n[geometry]\nobject_y = { Z = -1.0, A = 0.5 }\n'
            "detector_y = { A = 2.0, B = -0.25 }\nobject_z = { Y = 1.0 }\n"
            f"[fixed]\nobject_z = 5.0\nobject_y = 900.0\nsource_x = 1.5\n{extra}"
        )
        words = {place.name: place.total for place in places(machine)}
        assert words["SOD"] == "900 - Z + 0.5 A"
        assert words["SDD"] == "1000 + 2 A - 0.25 B"
        assert (words["sample up"], words["source to the right"]) == ("17 + Y", "1.5")
    else:
        machine = builtin_machine(name)
    for place in places(machine):
        least = most = home = 0.0
        terms = re.findall(r"([+-]? ?)(?:(-?[\d.]+)(?: |$))?([A-Za-z]\w*)?", place.total)
        for sign, number, motor in terms:
            if not number and not motor:
                continue
            factor = (-1.0 if sign.strip() == "-" else 1.0) * float(number or 1.0)
            axis = machine.axes[motor] if motor else None
            ends = (
                (1.0, 1.0, 1.0) if axis is None else (axis.lower, axis.upper, axis.home)
            )
            low, high = sorted(factor * end for end in ends[:2])
            least, most, home = least + low, most + high, home + factor * ends[2]
        assert (place.least, place.most, place.home) == pytest.approx(
            (least, most, home), abs=1e-4
        )
        assert place.least <= place.home <= place.most
        assert not place.total.startswith("+")
    names = {place.name for place in places(machine)}
    assert {"SOD", "SDD", "turntable"} <= names
    assert ("source to the right" in names) == (name in ("flexray", "drawn"))


def test_a_short_file_from_a_few_answers() -> None:
    text = new_machine_text(
        Answers("lab", "xyzr_cabinet", columns=1536, rows=1944, pitch_mm=(0.0748, 0.0754), bits=14,
                sod_mm=(60.0, 500.0), sdd_mm=(800.0, 800.0), max_kV=100.0,
                limits={"R": (-720.0, 720.0)}, without=("Y",))
    )  # fmt: skip
    assert len(text.splitlines()) < 45
    made = parse_machine(text)
    assert (made.axes["Z"].lower, made.axes["Z"].upper, made.axes["Z"].home) == (
        60,
        500,
        400,
    )
    assert made.fixed["detector_y"] == 800.0
    assert (made.detector.columns, made.detector.rows) == (1536, 1944)
    assert made.detector.roi == (0, 0, 1535, 1943)
    assert made.detector.camera.pixels_mm(made.detector.pixels) == pytest.approx(
        (0.1496, 0.1508)
    )
    assert made.tube.kV == 100.0
    assert "Y" not in made.axes
    for base in builtin_machines():
        assert parse_machine(new_machine_text(Answers("same", base))).axes == (
            builtin_machine(base).axes
        )
    with pytest.raises(LimitError, match="micro_ct has no motor along the SOD"):
        new_machine_text(Answers("lab", "micro_ct", sod_mm=(10.0, 20.0)))
    with pytest.raises(UnknownNameError, match="tilt"):
        new_machine_text(Answers("lab", "micro_ct", limits={"tilt": (0.0, 1.0)}))


def test_an_axis_that_is_left_out_takes_only_the_virtual_axis_that_is_read_from_it() -> (
    None
):
    def virtual_without(*axes: str) -> dict[str, dict[str, float]]:
        names = ", ".join(f'"{name}"' for name in axes)
        machine = parse_machine(f'base = "flexray"\nwithout = [{names}]\n')
        return {name: dict(axis.moves) for name, axis in machine.virtual_axes.items()}

    assert virtual_without("ver_tube") == {}
    assert set(virtual_without("tra_obj")) == {"ver_obj"}
    assert virtual_without("ver_det")["ver_obj"] == {"ver_tube": -1.0}


def test_a_detector_s_response_reaches_to_the_tube_s_highest_voltage() -> None:
    most = builtin_machine().tube.max_kV

    def with_response_up_to(kV: float) -> object:
        text = f'base = "flexray"\n[detector]\nresponse = [[10.0, 8.0], [{kV}, 30.0]]\n'
        return parse_machine(text).detector.response[-1]

    assert with_response_up_to(most) == (most, 30.0)
    with pytest.raises(MachineFileError, match="measured up to the tube's max_kV"):
        with_response_up_to(most - 0.5)
