"""Motion during a scan. Tracks and images are those of the study's own rays and planes."""

from __future__ import annotations

import math

import motion_during_scan as study
import numpy as np
import pytest
from calibration_scenarios import scenario

from flexdt.twin.calibration.pipeline import CalibrationRequest
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt.twin.geometry.motion import MOVABLE, Motion


@pytest.mark.parametrize("kind", sorted(study.ASKED))
@pytest.mark.daily(3)
def test_what_moves_is_found_and_what_does_not_is_not(kind: str) -> None:
    found = study.one(7, kind, images=False)
    assert found["missed"] == found["false"] == 0
    assert found["after_px"] < 0.01
    assert found["error_um"] < 2.0
    assert np.abs(found["pulls"]).max() < 4.5
    if kind != "nothing":
        assert found["before_px"] > 1.5 * study.NOISE_PX
        assert np.sqrt(np.mean(np.square(found["deviation_pulls"]))) < 3.0


@pytest.mark.slow
def test_a_drift_that_breaks_off_is_no_turn_of_the_table() -> None:
    """Errors over sigmas of tau_z, of deviations: drifts level at the ends made them 2.6,
    1.9."""
    rows = [study.one(seed, "spot", images=False) for seed in range(1, 6)]
    place = study.SIX.index("tau_z")
    pulls = [np.ravel(r["deviation_pulls"]) for r in rows]
    assert np.sqrt(np.mean([r["pulls"][place] ** 2 for r in rows])) < 2.0
    assert 0.3 < np.sqrt(np.mean(np.square(np.concatenate(pulls)))) < 1.5


@pytest.mark.slow
@pytest.mark.campaign
def test_a_runout_is_found_in_radiographs() -> None:
    found = study.one(3, "runout", images=True)
    assert found["before_px"] > 0.05
    assert found["after_px"] < 0.01
    assert found["error_um"] < 2.0
    assert np.abs(found["pulls"]).max() < 4.5


def test_a_motion_goes_into_poses_and_documents() -> None:
    rng = np.random.default_rng(4)
    poses = scenario("G1", 9)[0]
    values = rng.normal(size=(9, len(MOVABLE)))
    motion = Motion(
        MOVABLE, values, np.abs(values), tuple(rng.random(len(MOVABLE)).tolist())
    )
    moved = motion.applied(poses)
    d = dict(zip(MOVABLE, values.T, strict=True))
    # The thesis's x is across, y upwards, z along the beam.
    for part, name in (("axis", "dO"), ("detector", "dD"), ("source", "dS")):
        off = getattr(moved, part) - getattr(poses, part)
        along = d.get(f"{name}_z", np.zeros(9))
        np.testing.assert_allclose(
            off, np.stack([d[f"{name}_x"], along, d[f"{name}_y"]], 1)
        )
    np.testing.assert_allclose(moved.angle - poses.angle, d["alpha"])
    back = motion.applied(moved, -1.0)
    np.testing.assert_allclose(back.axis, poses.axis)
    again = Motion.from_dict(motion.to_dict())
    assert again.names == motion.names
    np.testing.assert_allclose(again.values, motion.values)
    np.testing.assert_allclose(again.sigma, motion.sigma)
    alpha = motion.to_dict()["alpha"]
    assert alpha["values"][0] == pytest.approx(math.degrees(d["alpha"][0]))  # type: ignore[index]
    assert repr(motion).startswith("<Motion: 9 frames, dO_x ")


def test_what_is_no_motion_is_refused() -> None:
    with pytest.raises(
        UnknownNameError, match="'tau_x' cannot differ from frame to frame"
    ):
        CalibrationRequest(per_frame=("tau_x",))
    values = np.ones((3, 1))
    motion = Motion(("dO_x",), values, values, (9.0,))
    with pytest.raises(TwinError, match="motion of 3 frames for a scan of 9"):
        motion.applied(scenario("G1", 9)[0])
    good = motion.to_dict()["dO_x"]
    for bad, said in (
        ({}, "there is none"),
        ({"dO_q": good}, "'dO_q' cannot differ"),
        ({"dO_x": {**good, "values": [1, None, 2]}}, "not a number a frame"),
        ({"dO_x": {**good, "values": ["a"]}}, "motion of dO_x"),
        ({"dO_x": {"values": [1]}}, "motion of dO_x"),
        (
            {"dO_x": good, "dO_y": {**good, "values": [1], "sigmas": [1]}},
            "different numbers",
        ),
    ):
        with pytest.raises(TwinError, match=said):
            Motion.from_dict(bad)
