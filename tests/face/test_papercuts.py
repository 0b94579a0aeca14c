"""Small things that once failed in silence or in other people's words, each with its answer."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli import main
from flexdt.clients.cli.commands.calibrate_commands import show
from flexdt.clients.reconstruction.reconstruct import VolumeRequest, reconstruct_dataset
from flexdt.twin.dataset.flexdt_json import parse_document
from flexdt.twin.errors import LimitError
from flexdt.twin.machine.description import builtin_machine, builtin_profile, parse_machine
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.physics.chain import Expected, read_out
from flexdt.twin.physics.detector import detector_of
from flexdt.twin.physics.exposure import ExposureSettings
from flexdt.twin.script import ScanPlan

SCAN = fx.ConeVec.circular(sod=60, sdd=100, angles=16, shape=(16, 16), pixel=1.0)


def test_fdk_and_iterative_algorithms_take_a_grid() -> None:
    volume = fx.Volume(np.ones((6, 6, 6)), 0.5)
    images = fx.forward(volume, SCAN)
    grid = fx.Grid((6, 6, 6), 0.5)
    for algorithm, options in ((fx.fdk, {}), (fx.back, {}), (fx.sirt, {"iterations": 2})):
        one, two = (algorithm(images, SCAN, like, **options) for like in (grid, volume))
        assert np.array_equal(one.data, two.data)


BALL = {"kind": "sphere", "center": [0, 0, 0], "radius": 5, "material": "pmma"}


@pytest.mark.parametrize(
    ("call", "told"),
    [
        *((lambda size=size, f=f: f(np.ones((4, 4, 4)), voxel_mm=size), "one or three above 0")
          for size in ((), (1, 1), (1, 1, 1, 1))
          for f in (lambda *a, **b: fx.simulate(*a, SCAN, **b), fx.expose)),
        (lambda: fx.calibrate([], "lego"), "no data sets; allowed: one or more"),
        *((lambda f=f: f(np.zeros((0, 4, 4)), np.zeros((0, 12)), fx.Grid((4, 4, 4), 1)), "views")
          for f in (fx.fdk, fx.sirt, fx.cgls, fx.tv)),
        *((lambda n=n: fx.reconstruct(fx.simulate(BALL, SCAN), every=n), f"every {n} frames; all")
          for n in (0, -2, 1.5)),
    ],
)  # fmt: skip
def test_nothing_at_all_is_refused(call: Callable[[], object], told: str) -> None:
    with pytest.raises(fx.TwinError, match=told):
        call()


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: fx.simulate(SCAN, BALL), "cone_vec: a dict; allowed: an array of numbers"),
        (lambda: fx.Tube(kV="90"), "kV is '90', no number; allowed: 20 to 240 kV"),
        (lambda: fx.Detector(bits="14"), "bits is '14', no number"),
        (lambda: fx.Tube(filters="Al 0.5mm"), "filter 'A'; allowed: .FORMULA@DENSITY, thickness"),
        (lambda: fx.Tube(filters=[("Al@2.70", "0.5")]), "filter Al@2.70 is '0.5', no number"),
        (lambda: fx.simulate(BALL, SCAN, exposure_ms="9"), "exposure_ms is '9', no number"),
        (lambda: fx.Volume("part.stl", 1.0), "volume data: a str; allowed: an array of numbers"),
        (lambda: fx.sirt(np.zeros((16, 16, 16)), SCAN, fx.Grid((4, 4, 4), 1.0), iterations="9"),
         "iterations is '9'; allowed: a whole number from 1"),
    ],
)  # fmt: skip
def test_values_of_another_kind_get_a_sentence(call: Callable[[], object], told: str) -> None:
    with pytest.raises(fx.TwinError, match=told):
        call()


def test_positions_outside_the_travel_are_not_a_pose() -> None:
    machine = builtin_machine()
    profile, camera = builtin_profile("thesis"), machine.detector.camera
    with pytest.raises(LimitError, match=r"mag_obj target 5000 mm is outside \["):
        poses(machine, profile, camera, {"mag_obj": 5000.0})
    with pytest.raises(LimitError, match="mag_obj"):
        poses(machine, profile, camera, {"mag_obj": [500.0, 600.0, 5000.0]})
    assert len(poses(machine, profile, camera, {"mag_obj": [500.0, 600.0]})) == 2


def test_a_signal_of_another_panel_is_not_read_out() -> None:
    machine = builtin_machine()
    signal = np.ones((40, 50), np.float32)
    exposure = ExposureSettings(90.0, 50.0, 100.0)
    with pytest.raises(LimitError, match=r"\(40, 50\) pixels and a camera of \(760, 956\)"):
        read_out(
            detector_of(machine.detector),
            Expected(signal, signal),
            machine.detector.camera,
            exposure,
        )


def test_messages_are_ours_and_not_a_librarys() -> None:
    with pytest.raises(fx.TwinError) as wrong:
        ScanPlan.from_dict({"machine": 1})
    assert "Value error" not in str(wrong.value)
    assert "ScanPlan: profile: Field required" in str(wrong.value)
    text = json.dumps({"schema": 1, "frames": [{"file": "../x.tif"}]})
    with pytest.raises(fx.TwinError, match=r"file name '\.\./x\.tif' contains") as wrong:
        parse_document(text)
    assert "Value error" not in str(wrong.value)
    assert "Value error" not in str(wrong.value.data)
    with pytest.raises(fx.TwinError) as wrong:
        parse_machine("name = 3")
    assert "Value error" not in str(wrong.value)


def test_a_calibration_without_a_fit_prints_no_figures() -> None:
    out = "\n".join(show(
        {"parameters": {}, "frames": 12, "detections": 3, "rms_px": None, "outliers": None,
         "seconds": 0.5, "weak": []}
    ))  # fmt: skip
    assert "None" not in out
    assert "12 frames, 3 beads seen: no fit" in out


def test_calibrate_without_a_phantom_lists_them(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["calibrate", "nowhere"])
    assert ended.value.code == 2
    err = capsys.readouterr().err
    assert "--phantom" in err
    assert "lego" in err


def test_a_volume_file_may_be_named_by_text(tmp_path: Path) -> None:
    data = fx.DataSet.from_arrays(
        np.full((16, 16, 16), 500), SCAN, dark=np.zeros((16, 16)), flat=np.full((16, 16), 900)
    )
    out = str(tmp_path / "v.mha")
    assert reconstruct_dataset(data, out, VolumeRequest(shape=(4, 4, 4)))["file"] == out
    assert fx.Volume.load(out).shape == (4, 4, 4)


@pytest.mark.parametrize("name", ["torch", "odl", "cil"])
def test_a_framework_that_is_not_there_is_named_with_its_command(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    operator = fx.Operator(SCAN, fx.Grid((4, 4, 4), 1.0))
    monkeypatch.setitem(sys.modules, name, None)  # type: ignore[arg-type]
    with pytest.raises(fx.TwinError, match=rf"{name} is not installed .*: (pip|conda) install"):
        getattr(operator, name)()


def test_what_a_notebook_prints_is_short() -> None:
    plan = fx.plan("rot_obj move absolute 90 ACK")
    forecast = fx.expose("normal-5", kV=90, images=10)
    shown = (
        fx.machine(),
        plan,
        plan.check(),
        forecast,
        fx.phantoms.lego(),
        fx.phantoms.shepp_logan(),
    )
    for value in shown:
        for text in (repr(value), str(value)):
            assert len(text) < 200
            assert "\n" not in text
    assert "'flexray'" in repr(shown[0])
    assert "ok, 0 collisions" in repr(shown[2])


def test_completion_behind_phantoms_offers_what_is_public() -> None:
    names = dir(fx.phantoms)
    assert {"lego", "shepp_logan", "beads", "from_mesh"} <= set(names)
    assert all(callable(getattr(fx.phantoms, name)) for name in names)


def test_a_volume_is_given_to_other_libraries_by_dlpack() -> None:
    volume = fx.Volume(np.arange(24.0).reshape(2, 3, 4), 0.5)
    given = np.from_dlpack(volume)
    assert np.shares_memory(given, volume.data)
    assert np.array_equal(given, volume.data)


@pytest.mark.parametrize("seed", [-1, 1.5, "1"])
def test_a_seed_is_a_whole_number(seed: object) -> None:
    with pytest.raises(fx.TwinError, match="allowed: a seed >= 0, or None"):
        fx.simulate("lego", SCAN, noise=seed)  # type: ignore[arg-type]
