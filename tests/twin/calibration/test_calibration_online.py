"""Frame by frame: same answer as all at once, and adaptive sampling that needs fewer frames."""

from __future__ import annotations

import numpy as np
import pytest

from flexdt.twin.calibration import SIX, estimate_geometry
from flexdt.twin.calibration.online import begin, feed, next_angle
from flexdt.twin.errors import TwinError

from .scenarios import SHAPE, exact_tracks, scenario, spiral
from .test_calibration_identify import shadows

MODEL = spiral((20, 40, 60), 4)


def test_fed_frame_by_frame_the_estimate_is_that_of_all_frames() -> None:
    poses, truth = scenario("G0", 24)
    tracks = exact_tracks(poses, truth, MODEL)
    detections = shadows(tracks, 1, noise=0.05, false=1)
    state = begin(MODEL)
    sigmas = []
    for i in range(24):
        state = feed(state, poses[slice(i, i + 1)], detections[i])
        sigmas.append(state.sigmas()["dO_z"])
    assert np.isinf(sigmas[0])
    assert sigmas[-1] < 0.5 * sigmas[3]
    assert state.fit is not None
    together = estimate_geometry(state.tracks, MODEL, poses, shape=SHAPE, noise_px=0.1)
    for name in SIX:
        assert state.fit.values[name] == pytest.approx(together.values[name], abs=2e-4)
        off = state.fit.values[name] - truth.to_edge()[name]
        assert abs(off) < 4.5 * state.fit.sigmas[name]
    assert state.updates >= 20


def test_it_stops_when_the_tolerance_is_met() -> None:
    poses, truth = scenario("G0", 60)
    detections = shadows(exact_tracks(poses, truth, MODEL), 2, noise=0.05)
    tolerance = {"dO_z": 0.03, "alpha": 0.01}
    state = begin(MODEL)
    used = 0
    for i in np.random.default_rng(0).permutation(60):
        state = feed(state, poses[slice(i, i + 1)], detections[i])
        used += 1
        if state.done(tolerance):
            break
    assert 3 < used < 60
    assert state.sigmas()["dO_z"] <= 0.03


def test_the_next_angle_is_no_worse_than_the_next_in_line() -> None:
    """Greedy angles reach a smaller worst sigma than a slow sweep of as many frames."""
    poses, truth = scenario("G0", 90)
    tracks = exact_tracks(poses, truth, MODEL)
    detections = shadows(tracks, 3, noise=0.05)
    tolerance = {"dO_x": 0.01, "dO_z": 0.05, "alpha": 0.02, "tau_x": 0.01, "tau_z": 0.01}

    def run(adaptive: bool) -> float:
        state = begin(MODEL)
        left = list(range(90))
        for i in (0, 1, 2):
            state = feed(state, poses[slice(i, i + 1)], detections[i])
            left.remove(i)
        for _ in range(6):
            if adaptive and state.fit is not None:
                chosen = next_angle(state, poses[0:1], poses.angle[left], tolerance)
                i = left[int(np.argmin(np.abs(poses.angle[left] - chosen.angle)))]
            else:
                i = left[0]
            left.remove(i)
            state = feed(state, poses[slice(i, i + 1)], detections[i])
        now = state.sigmas()
        return max(now[n] / limit for n, limit in tolerance.items())

    assert run(True) < 0.6 * run(False)


def test_no_angle_without_an_estimate() -> None:
    poses, _ = scenario("G0", 3)
    with pytest.raises(TwinError, match="no estimate yet"):
        next_angle(begin(MODEL), poses[0:1], [0.0, 1.0], {"dO_z": 0.1})
    with pytest.raises(TwinError, match="one frame at a time"):
        feed(begin(MODEL), poses, shadows(np.zeros((1, 4, 2)), 0)[0])
