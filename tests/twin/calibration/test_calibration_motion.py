"""Motion during a scan. Tracks and images are those of the study's own rays and planes."""

from __future__ import annotations

import math
from typing import Any

import motion_during_scan as study
import numpy as np
import pytest
from calibration_scenarios import scenario
from scipy import linalg

from flexdt.twin.calibration.fit.motion_model import Course, MotionModel, Waves
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
    assert np.sqrt(np.mean([r["pulls"][place] ** 2 for r in rows])) < 2.0
    assert 0.3 < np.sqrt(np.mean(np.square([r["deviation_pulls"] for r in rows]))) < 1.5


@pytest.mark.slow
@pytest.mark.campaign
def test_a_runout_is_found_in_radiographs() -> None:
    found = study.one(3, "runout", images=True)
    assert found["before_px"] > 0.05
    assert found["after_px"] < 0.01
    assert found["error_um"] < 2.0
    assert np.abs(found["pulls"]).max() < 4.5


@pytest.mark.parametrize("seed", range(4))
def test_bands_and_means_equal_a_dense_model(seed: int) -> None:
    """Likelihood, deviations and sigmas beside full matrices of second differences, and of
    jumps and ramps as columns."""
    rng = np.random.default_rng(seed)
    sizes, g, p, each = (7, 9), 3, 2, 6
    n = sum(sizes)
    frame = np.repeat(np.arange(n), each)
    rows, slopes = rng.normal(size=(n * each, g)), rng.normal(size=(n * each, p))
    y = rng.normal(size=n * each) + 3 * slopes[:, 0] * np.linspace(-1, 1, n)[frame]
    weight, off = np.array([0.0, 0.5, 0.0]), np.array([0.0, 0.3, 0.0])
    column = np.stack([np.full(n, 2), np.repeat([0, -1], sizes)], axis=1)
    model = MotionModel(rows, y, slopes, frame, sizes, column, weight, off)
    prior = np.array([[0.0, np.sqrt(0.5), 0.0]])
    x, y1 = np.vstack([rows, prior]), np.r_[y, np.sqrt(0.5) * 0.3]

    def dense(choice: Any) -> tuple[float, Any, Any, Any]:
        parts, precision, into = [x], [np.zeros((g, g))], [np.eye(g)]
        variance = np.eye(len(y1))
        for i, pick in enumerate(choice):
            z = np.zeros((len(y1), n))
            z[np.arange(n * each), frame] = slopes[:, i]
            if isinstance(pick, Course):
                height = model.courses[:, list(pick.shapes)].copy()
                for label in np.unique(column[:, i]):
                    own = column[:, i] == label
                    height[own] -= height[own].mean(axis=0)
                height /= np.sqrt(np.square(slopes[:, i]).sum() / n)
                variance += pick.width**2 * (z @ height) @ (z @ height).T
                parts.append(z @ height)
                precision.append(np.eye(len(pick.shapes)) / pick.width**2)
                into.append(height)
                continue
            into.append(np.eye(n))
            blocks = []
            for size, amplitudes in zip(sizes, model.spectrum(i, pick), strict=True):
                bends = np.diff(np.eye(size), 2, axis=0)
                waves = pick[1]
                stiff = (
                    (2 * np.sin(np.pi * waves / (2 * size))) ** 2
                    if waves < size
                    else np.inf
                )
                blocks.append(
                    amplitudes[0]
                    * linalg.inv(np.eye(size) + (bends.T @ bends) / stiff**2)
                )
            k = linalg.block_diag(*blocks)
            variance += z @ k @ z.T
            parts.append(z)
            precision.append(np.linalg.inv(k))
        inverse = np.linalg.inv(variance)
        normal = x.T @ inverse @ x
        b = np.linalg.solve(normal, x.T @ inverse @ y1)
        rest = y1 @ inverse @ y1 - b @ normal @ b
        freedom = len(y1) - g
        value = -0.5 * (np.linalg.slogdet(variance)[1] + np.linalg.slogdet(normal)[1])
        whole = np.hstack(parts)
        joint = np.linalg.inv(whole.T @ whole + linalg.block_diag(*precision))
        both = linalg.block_diag(*into)
        found = both @ joint @ whole.T @ y1
        joint = both @ joint @ both.T
        # From (x, d) to (x + mean of d, d - mean of d).
        change = np.eye(g + p * n)
        for i in range(p):
            for label in np.unique(column[:, i]):
                here = g + i * n + np.flatnonzero(column[:, i] == label)
                change[np.ix_(here, here)] -= 1.0 / len(here)
                if label >= 0:
                    change[label, here] += 1.0 / len(here)
        covariance = rest / freedom * change @ joint @ change.T
        return (
            value - 0.5 * freedom * np.log(rest),
            change @ found,
            covariance,
            rest / freedom,
        )

    choices = [
        (Waves(1.0, 1.0), Waves(0.1, 4.0)),
        (Waves(10.0, 4.0), Waves(0.3, math.inf)),
        (Waves(3.0, 16.0), Waves(30.0, 4.0)),
        (Course((0,), 10.0), Waves(3.0, 4.0)),
        (Course((1, 3), 100.0), Course((1,), 3.0)),
    ]
    ours = [model.likelihood(choice) for choice in choices]
    theirs = [dense(choice)[0] for choice in choices]
    np.testing.assert_allclose(np.diff(ours), np.diff(theirs), atol=1e-6)
    for choice in choices:
        values, spread, added, _, moved = model.solved(choice)
        _, found, covariance, noise2 = dense(choice)
        np.testing.assert_allclose(values.T.ravel(), found[g:], atol=1e-8)
        sigma = np.sqrt(np.maximum(np.diag(covariance)[g:], 0.0))
        np.testing.assert_allclose(spread.T.ravel(), sigma, rtol=1e-6, atol=1e-8)
        plain = noise2 * np.linalg.inv(x.T @ x)
        np.testing.assert_allclose(added + plain, covariance[:g, :g], atol=1e-8)
        np.testing.assert_allclose(moved, found[:g], atol=1e-8)
    shapes = range(model.courses.shape[1])
    for beside in (None, Waves(3.0, 4.0), Course((4,), 10.0)):
        tried = [(Course((s,), w), beside) for s in shapes for w in (1.0, 30.0)]
        found = model.best_course((None, beside), 0, (1.0, 30.0))
        assert found == max(tried, key=model.likelihood)[0]
        tried = [(found.beside(s), beside) for s in shapes if s not in found.shapes]
        second = model.best_course((found, beside), 0, (1.0, 30.0))
        assert second == max(tried, key=model.likelihood)[0]


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
