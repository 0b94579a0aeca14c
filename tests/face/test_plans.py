"""Plans through the public face: from text, path and Script, checked, drawn, as geometry."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import flexdt as fx
from flexdt.clients.cli import main
from flexdt.twin.machine.description import builtin_profile
from flexdt.twin.script import ScanPlan, ScriptError, check_script, parse_script

EXAMPLES = Path(__file__).parents[2] / "examples" / "scripts"
LISTING = EXAMPLES / "listing1.txt"
FLY = EXAMPLES / "lego-fly-360.txt"


def test_text_path_and_script_give_equal_plans() -> None:
    text = FLY.read_text()
    plan = fx.plan(text)
    assert plan == fx.plan(FLY) == fx.plan(str(FLY)) == fx.plan(parse_script(text))
    assert (
        plan
        == fx.plan(FLY, machine=fx.machine("flexray"))
        == fx.plan(FLY, machine="flexray")
    )
    flexray = fx.machine("flexray")
    assert plan == fx.plan(FLY, profile=builtin_profile(flexray.default_profile))
    thesis = builtin_profile("thesis")
    assert fx.plan(FLY, profile=thesis) == fx.plan(FLY, profile="thesis") != plan
    assert plan != fx.plan("rot_obj move absolute 90 ACK")
    assert ScanPlan.from_dict(json.loads(json.dumps(plan.to_dict()))) == plan
    with pytest.raises(FileNotFoundError):
        fx.plan("no-such-script.txt")
    with pytest.raises(ScriptError, match="does not know"):
        fx.plan("rot_obj fly 90 ACK")


def test_geometry_of_a_fly_scan_is_a_circle_with_the_scripts_distances() -> None:
    """The example: 360 frames over a turn; distances as its own comment states them."""
    plan = fx.plan(FLY)
    assert plan.geometry.shape == (360, 760, 956)
    assert len(plan.poses) == 360
    steps = np.diff(np.degrees(plan.poses.angle))
    assert_allclose(steps, steps[0], atol=1e-9)
    assert_allclose(plan.poses.sdd, plan.geometry.source_detector_distance, atol=1e-6)
    assert_allclose(np.linalg.norm(plan.geometry.u, axis=1), 0.1496, atol=1e-9)


def test_check_is_the_commands_report(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["check", str(LISTING), "--json"])
    told = json.loads(capsys.readouterr().out)
    report = fx.plan(LISTING).check()
    ours = report.to_dict()
    assert report.ok == (ended.value.code == 0)
    for key in ("steps", "duration_s", "frames", "bytes", "collisions", "min_clearance_mm",
                "clearance", "dose"):  # fmt: skip
        assert json.loads(json.dumps(ours[key])) == told[key], key


def test_check_script_takes_paths_and_scripts() -> None:
    text = FLY.read_bytes()
    expected = check_script(text).to_dict()
    assert check_script(FLY).to_dict() == expected
    assert check_script(parse_script(text)).to_dict() == expected
    assert parse_script(FLY) == parse_script(text)


def test_a_plot_shows_motors_images_and_clearance() -> None:
    pytest.importorskip("matplotlib", reason="the extra `plots`").use("Agg")
    figure = fx.plan("rot_obj move absolute 90 ACK").plot()
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert any(label.startswith("rot_obj") for label in labels)
    assert figure.axes[2].get_ylabel() == "clearance [mm]"
