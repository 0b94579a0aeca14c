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
from flexdt.clients.cli.commands import calibrate_commands
from flexdt.library.calibration.calibration_options import CalibrationOptions
from flexdt.library.calibration.calibration_request import detection_of, request_of
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
