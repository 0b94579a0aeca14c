"""Vibration and drift as hidden truth: they reach the projection, and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexdt.server.imaging.truth import HiddenMotion, TrueGeometry, load_truth
from flexdt.twin.errors import MachineFileError
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt.twin.machine.description import builtin_machine, builtin_profile
from flexdt.twin.machine.kinematics import poses
from flexdt.twin.scanner.state import StagePlacement

M = builtin_machine()
P = builtin_profile(M.default_profile)
SHAPE = M.detector.camera.shape
AXIS = np.zeros((1, 3))


def turn(n: int):
    return poses(M, P, M.detector.camera, {"rot_obj": np.arange(n) * 360.0 / n})


def shadow(truth: TrueGeometry, n: int, times: object = None) -> np.ndarray:
    """Where the object's origin is seen, (n, 2) [pixels]."""
    return truth.cone_vec(turn(n), StagePlacement(), times).project_points(AXIS, SHAPE)[:, 0]  # type: ignore[arg-type]


def test_vibration_has_the_size_asked_for_and_repeats() -> None:
    still = shadow(TrueGeometry(), 2000)
    truth = TrueGeometry(NOMINAL, HiddenMotion(vibration_mm=0.01, seed=3))
    off = shadow(truth, 2000) - still
    cone = turn(1).cone_vec()
    magnified = (
        0.01 * float(cone.source_detector_distance[0]) / float(np.linalg.norm(cone.source[0, :2]))
    )
    pixels = magnified / M.detector.camera.pixel_mm(M.detector.pixels)
    np.testing.assert_allclose(off.std(axis=0), pixels, rtol=0.07)
    np.testing.assert_allclose(off.mean(axis=0), 0.0, atol=0.1 * pixels)
    np.testing.assert_array_equal(shadow(truth, 2000) - still, off)
    other = TrueGeometry(NOMINAL, HiddenMotion(vibration_mm=0.01, seed=4))
    assert not np.allclose(shadow(other, 2000) - still, off)


def test_the_spot_wanders_while_the_tube_warms_up() -> None:
    unrest = HiddenMotion(spot_drift_mm=(0.02, -0.01), spot_drift_s=100.0)
    truth = TrueGeometry(NOMINAL, unrest)
    nominal = turn(3).cone_vec()
    moved = truth.cone_vec(turn(3), StagePlacement(), [0.0, 100.0, 1e6])
    steps = np.linalg.norm(moved.source - nominal.source, axis=1)
    full = np.hypot(0.02, 0.01)
    np.testing.assert_allclose(steps, [0.0, full * (1 - np.exp(-1)), full], atol=1e-9)
    np.testing.assert_allclose(moved.detector, nominal.detector)
    up = moved.source[2] - nominal.source[2]
    assert up[2] == pytest.approx(-0.01)
    at_start = truth.cone_vec(turn(3), StagePlacement())
    np.testing.assert_allclose(at_start.rows, nominal.rows)


def test_truth_files_may_hold_unrest(tmp_path: Path) -> None:
    data, file = tmp_path / "data", tmp_path / "truth.toml"
    data.mkdir()
    file.write_text("dO_x = 0.1\n[unrest]\nvibration_mm = 0.02\nspot_drift_mm = [0.1, 0.0]\n")
    truth = load_truth(file, data)
    assert repr(truth) == "TrueGeometry(hidden)"
    plain = tmp_path / "plain.toml"
    plain.write_text("dO_x = 0.1\n")
    assert not np.allclose(shadow(truth, 4), shadow(load_truth(plain, data), 4))
    for wrong in (
        "vibration_mm = nan",
        "spot_drift_mm = [inf, 0.0]",
        "spot_drift_s = nan",
        "seed = inf",
        "vibration_mm = -1",
        "spot_drift_mm = 3",
        "speed = 1",
        'seed = "x"',
    ):
        file.write_text(f"[unrest]\n{wrong}\n")
        with pytest.raises(MachineFileError, match="unrest"):
            load_truth(file, data)


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e300", "1" + 400 * "0", "true", '"x"'])
def test_a_value_that_no_geometry_can_have_is_refused_with_its_key(
    tmp_path: Path, value: str
) -> None:
    file = tmp_path / "truth.toml"
    file.write_text(f"alpha = 0.1\ndO_x = {value}\n")
    with pytest.raises(MachineFileError, match=r"truth\.toml: dO_x: ") as caught:
        load_truth(file, tmp_path / "data")
    assert value not in caught.value.message.partition("dO_x: ")[2]
