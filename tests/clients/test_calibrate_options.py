"""A calibration has the same options in Python and on the command line, and each has its
effect."""

from __future__ import annotations

import inspect
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

import flexdt as fx
from flexdt.clients.cli.command_settings import CalibrateSettings
from flexdt.clients.cli.command_tree import run
from flexdt.clients.cli.commands import calibrate_commands
from flexdt.library.calibration.calibration_options import (
    CONDITIONS,
    ON_THE_WIRE,
    RULES,
    CalibrationOptions,
)
from flexdt.library.calibration.calibration_request import detection_of, request_of
from flexdt.protocol.methods.calibration_messages import CalibrationFit
from flexdt.twin.errors import TwinError

OF_FILES = {"datasets", "geometry", "frames", "shape", "pixel", "report", "tracks"}
"""Arguments of the command that name what is read and written: a `DataSet` has been read."""
OF_THE_TWIN = {"twin", "push"}
RENAMED = {"prior": "priors"}
"""An option that is given several times has a name in the singular."""
VALUES: dict[str, Any] = {
    "free": ["dO_x", "dO_y"],
    "per_scan": ["alpha"],
    "per_frame": ["dO_z"],
    "reading": "mount",
    "bead_tolerance": 0.05,
    "priors": "none",
    "exclude": ["gap"],
    "start": {"dO_x": 1.0},
    "bound": 2.0,
    "markers": "marks.csv",
    "scale": "0-1=10",
    "radius": 4.0,
}


def named(function: Any) -> set[str]:
    return set(inspect.signature(function).parameters)


def test_python_and_the_command_have_the_same_options() -> None:
    declared = set(CalibrationOptions.__annotations__)
    assert named(fx.calibrate) == declared | {"data", "phantom", "geometry", "progress"}
    assert named(fx.DataSet.calibrate) == declared | {
        "self",
        "phantom",
        "geometry",
        "progress",
    }
    # Exclusions are values of --prior on the command line.
    declared = declared - {"exclude"}
    command = {RENAMED.get(n, n) for n in named(calibrate_commands.calibrate)}
    settings = {f.name for f in fields(CalibrateSettings)} - {"command"}
    assert (command | settings) - OF_FILES - OF_THE_TWIN == declared | {"phantom"}


@pytest.mark.parametrize("name", sorted(CalibrationOptions.__annotations__))
def test_every_option_has_an_effect(name: str) -> None:
    options: Any = {name: VALUES[name]}
    plain: Any = {}
    assert (request_of("lego", options), detection_of(options)) != (
        request_of("lego", plain),
        detection_of(plain),
    )


def test_an_option_that_is_none_has_its_default() -> None:
    nothing: Any = dict.fromkeys(CalibrationOptions.__annotations__)
    assert request_of("lego", nothing) == request_of("lego", {})
    assert request_of("unknown", nothing).free == ("dO_x",)


def test_the_options_reach_the_calibration() -> None:
    scan = fx.ConeVec.circular(sod=100, sdd=200, angles=3, shape=(4, 5), pixel=1)
    data = fx.DataSet.from_arrays(
        np.full((3, 4, 5), 500), scan, flat=np.full((4, 5), 1000)
    )
    for calibrate in (data.calibrate, lambda *a, **o: fx.calibrate(data, *a, **o)):
        with pytest.raises(TwinError, match="dO_w"):
            calibrate("lego", per_scan=["dO_w"])


def test_an_option_that_does_not_exist_is_named_with_its_neighbour() -> None:
    with pytest.raises(TypeError, match="did you mean 'bead_tolerance'"):
        fx.calibrate([], "lego", bead_tolerence=0.1)  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="allowed: a number or None"):
        fx.calibrate([], "lego", bead_tolerance="wide")  # type: ignore[arg-type]


SCAN = {"sod": 600, "sdd": 1059, "angles": 12, "shape": (190, 239), "pixel": 0.5984}
SEEN_WITH: dict[str, Any] = {
    "free": ["dO_x", "dO_y"],
    "per_frame": ["dO_y"],
    "reading": "mount",
    "bead_tolerance": 0.05,
    "priors": {"dD_x": 0.01},
    "exclude": ["beads", "shape", "motion", "distortion"],
    "start": {"det_roll": 1.5},
    "bound": 1e-6,
    "scale": "0-1=41.5",
    "radius": 4.0,
    "per_scan": ["dO_x"],
}
"""Values that show in a result, if the option has an effect."""
MARKS: Any = {}


def result(phantom: str, **options: Any) -> dict[str, Any]:
    """The document of a calibration from marks, of a scan whose panel stands aside and whose
    beads are not where the phantom has them."""
    if not MARKS:
        rng = np.random.default_rng(3)
        beads = fx.phantoms.lego().beads + rng.normal(0.0, 0.05, (5, 3))
        really = fx.ConeVec.circular(**SCAN, offset=(0.8, 0.3), tilts=(0.4, 0, 0))
        spots = really.project_points(beads, SCAN["shape"])
        spots = spots + rng.normal(0.0, 0.05, spots.shape)
        MARKS["marks"] = [
            (i, str(k), *map(float, spots[i, k]), 0.05)
            for i in range(12)
            for k in range(5)
        ]
    found = fx.calibrate(
        None,
        phantom,
        geometry=fx.ConeVec.circular(**SCAN),
        markers=MARKS["marks"],
        **options,
    )
    left_out = {"seconds", "next", "geometry"}
    return {key: value for key, value in found.document.items() if key not in left_out}


@pytest.mark.slow
@pytest.mark.parametrize("phantom", ["lego", "unknown"])
def test_what_is_taken_shows_in_the_result_and_the_rest_is_refused(phantom: str) -> None:
    """No option is dropped in silence. The result is the witness, not the table."""
    plain = result(phantom)
    refused = {}
    for name, value in SEEN_WITH.items():
        try:
            other = result(phantom, **{name: value})
        except TwinError as error:
            refused[name] = error.message
            continue
        assert other != plain, f"{name} has no effect with {phantom}, and is taken"
    assert all("has no effect" in said for said in refused.values()), refused
    more = {"scale"} if phantom == "lego" else {"bead_tolerance"}
    assert set(refused) == {"radius", "per_scan"} | more


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.option)
def test_the_command_refuses_by_the_rules_before_it_reads_anything(
    rule: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    words: dict[str, list[str]] = {
        "unknown": ["a", "b", "--phantom", "unknown"],
        "markers": ["a", "b", "--markers", "m.csv", "--phantom", "lego"],
        "scale": ["a", "--scale", "0-1=4", "--phantom", "lego"],
        "radius": [
            "--markers",
            "m.csv",
            "--geometry",
            "g",
            "--radius",
            "4",
            "--phantom",
            "lego",
        ],
        "bead_tolerance": ["a", "--bead-tolerance", "0.1", "--phantom", "unknown"],
        "per_scan": ["a", "--per-scan", "dO_x", "--phantom", "lego"],
        "shape": ["a", "--shape", "4,5", "--phantom", "lego"],
        "pixel": ["a", "--pixel", "0.1", "--phantom", "lego"],
        "push": ["a", "b", "--per-scan", "dO_x", "--push", "--phantom", "lego"],
    }
    assert run(["calibrate", *words[rule.option]]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert rule.meaning in said
    assert "allowed with: " in said
    assert "{" not in said
    if rule.option != "unknown":
        assert f"--{rule.option.replace('_', '-')}: has no effect" in said


def test_every_option_of_a_rule_is_one_of_a_door() -> None:
    declared = set(CalibrationOptions.__annotations__)
    assert {rule.option for rule in RULES} <= declared | OF_FILES | {"unknown", "push"}
    assert {rule.needs for rule in RULES} <= set(CONDITIONS)
    wire = set(CalibrationFit.model_fields)
    assert set(ON_THE_WIRE) == declared & wire
    assert {rule.option for rule in RULES} & wire <= set(ON_THE_WIRE)
