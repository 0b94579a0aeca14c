"""The example scripts do what their names say, and say nothing they should not."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from flexdt.twin.machine.description import Machine, Profile
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.script import CheckReport, SampleSize, check_script

FOLDER = Path(__file__).parents[3] / "examples/scripts"
LEGO = SampleSize(float(np.hypot(24.0, 16.0)), 49.8)
"""The cylinder about the LEGO phantom's bricks of 24 x 16 mm, 49.8 mm high."""


@pytest.fixture
def check(
    flexray: Machine, profile: Profile, request: pytest.FixtureRequest
) -> CheckReport:
    data = (FOLDER / f"{request.param}.txt").read_bytes()
    return check_script(data, flexray, profile, sample=LEGO)


@pytest.mark.parametrize(
    ("check", "frames", "steps"),
    [
        ("lego-fly-360", 360, 360 / 359),
        ("lego-fly-180", 180, 360 / 179),
        ("calibration-two-positions", 146, 5.0),
        ("step-72", 72, 5.0),
        ("tiled-two", 722, 1.0),
        ("helical-three-turns", 541, 2.0),
    ],
    indirect=["check"],
)
def test_examples_check_without_a_word(
    check: CheckReport, frames: int, steps: float
) -> None:
    assert check.problems == ()
    assert check.plan.frames == frames
    angles = check.plan.image_positions["rot_obj"][[e.kind == "projection"
                                                   for e in check.plan.exposures]]  # fmt: skip
    first = angles[: min(frames, 73)]
    assert_allclose(first, np.arange(len(first)) * steps, atol=1e-9)
    kinds = [e.kind for e in check.plan.exposures]
    assert kinds[:2] == ["dark", "flat"]
    # Tiles and helices cut the sample off in single images, and make up for it together.
    cut = [o.truncated for o in check.optics]
    assert cut == [frames in (722, 541)] * len(cut)


@pytest.mark.parametrize("check", ["lego-fly-180"], indirect=True)
def test_the_demo_s_script(
    check: CheckReport, flexray: Machine, profile: Profile
) -> None:
    plan = check.plan
    assert all(e.camera.shape == (760, 956) for e in plan.exposures)
    (optics,) = check.optics
    assert optics.sod_mm == pytest.approx((600.0, 600.0), abs=1e-5)
    assert optics.sdd_mm == pytest.approx((1059.0, 1059.0), abs=1e-5)
    flat = next(e for e in plan.exposures if e.kind == "flat")
    image = next(e for e in plan.exposures if e.kind == "projection")
    assert abs(flat.positions["tra_obj"] - image.positions["tra_obj"]) > 90
    # The rotation axis comes out in the middle of the image.
    p = poses(flexray, profile, image.camera, image.positions)
    column = p.cone_vec().project_points([[0.0, 0.0, 0.0]], image.camera.shape)[0, 0, 0]
    assert column == pytest.approx((956 - 1) / 2, abs=1e-2)
    assert plan.settings is not None
    begun, turn = plan.trajectories["rot_obj"][-1]
    assert plan.settings.positions["rot_obj"] == pytest.approx(turn.position(begun))


def test_scripts_keep_the_scanner_s_line_ends() -> None:
    files = sorted(FOLDER.glob("*.txt"))
    assert len(files) >= 7
    for file in files:
        data = file.read_bytes()
        if file.stem != "listing1":
            assert data.count(b"\n") == data.count(b"\r\n") > 0
            assert all(line.count(b"\t") == 6 for line in data.splitlines())
