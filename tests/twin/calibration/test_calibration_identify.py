"""Identification at any angle, with missing and false shadows; ambiguity; the thesis's
matching."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from calibration_scenarios import exact_tracks, scenario, shadows, spiral
from numpy.testing import assert_array_equal

from flexdt.twin.calibration import BeadModel
from flexdt.twin.calibration.frame_source import nothing
from flexdt.twin.calibration.identify import Search, assign, identify, identify_beads
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.offsets import NOMINAL


@pytest.mark.daily(1)
@pytest.mark.parametrize(
    ("beads", "frames", "missing", "false"),
    [(5, 36, 0.0, 0), (3, 3, 0.0, 0), (2, 12, 0.0, 0), (5, 36, 0.4, 3), (3, 5, 0.0, 1)],
)
@pytest.mark.campaign(2)
def test_beads_are_told_apart_at_any_start_angle(
    beads: int, frames: int, missing: float, false: int
) -> None:
    model = spiral((20, 40, 60), beads)
    for seed in range(12):
        poses, truth = scenario(f"G{seed % 5}", frames)
        truth = replace(
            truth, alpha=float(np.random.default_rng(seed).uniform(-3.1, 3.1))
        )
        tracks = exact_tracks(poses, truth, model)
        found = identify(
            shadows(tracks, seed, missing=missing, false=false), model, poses
        )
        error = np.linalg.norm(found.tracks - tracks, axis=2)
        seen = np.isfinite(error)
        assert seen.mean() > 0.9 * (1 - missing) - 0.1
        assert np.mean(error[seen] < 0.5) > 0.98, (
            seed
        )  # a false shadow may lie within the gate
        assert not found.ambiguous
        assert abs(found.parameters.alpha) <= np.pi + 1e-9


def test_a_symmetric_phantom_is_reported_not_guessed() -> None:
    """Four beads in two antipodal pairs: half a turn maps the phantom onto itself."""
    model = BeadModel(
        np.array([[12.0, 0, -15], [-12, 0, -15], [0, 9, 15], [0, -9, 15]]), np.array(2.0)
    )
    poses, truth = scenario("G0", 24)
    detections = shadows(exact_tracks(poses, truth, model), 1)
    found = identify(detections, model, poses)
    assert found.ambiguous
    assert abs(abs(found.rivals[0].alpha - found.parameters.alpha) - np.pi) < 0.05
    with pytest.raises(TwinError, match="cannot be told apart"):
        identify_beads(detections, model, poses)


@pytest.mark.parametrize("turned", [0.0, np.pi])
def test_a_stated_turn_tells_the_sides_of_a_symmetric_phantom(turned: float) -> None:
    """Either start finds its own of two solutions; one that fits neither hides nothing."""
    model = BeadModel(
        np.array([[12.0, 0, -15], [-12, 0, -15], [0, 9, 15], [0, -9, 15]]), np.array(2.0)
    )
    poses, truth = scenario("G0", 24)
    detections = shadows(exact_tracks(poses, truth, model), 1)
    near = Search(turn=np.radians(20.0))
    start = replace(NOMINAL, alpha=truth.alpha + turned + 0.1)
    found = identify(detections, model, poses, start=start, search=near)
    assert not found.ambiguous
    assert abs(found.parameters.alpha - truth.alpha - turned) < 0.05
    across = replace(NOMINAL, alpha=truth.alpha + 0.5 * np.pi)
    assert identify(detections, model, poses, start=across, search=near).ambiguous


def test_identify_beads_returns_tracks_with_nan_where_unseen() -> None:
    model = spiral((20, 40, 60), 4)
    poses, truth = scenario("G1", 12)
    tracks = exact_tracks(poses, truth, model)
    detections = shadows(tracks, 3)
    detections[5] = nothing(detections[5].shape)
    result = identify_beads(detections, model, poses.cone_vec())
    assert result.shape == (12, 4, 2)
    assert np.isnan(result[5]).all()
    assert np.abs(np.delete(result, 5, axis=0) - np.delete(tracks, 5, axis=0)).max() < 0.5


def test_no_shadow_at_all_is_an_error() -> None:
    model = spiral((20, 40, 60), 3)
    poses, _ = scenario("G0", 2)
    empty = shadows(np.full((2, 3, 2), -100.0), 0)
    with pytest.raises(TwinError, match="no bead shadow"):
        identify(empty, model, poses)


@pytest.mark.parametrize("seed", range(40))
def test_an_assignment_has_the_least_sum_of_all(seed: int) -> None:
    """Of all ways to pair beads and spots, an unpaired one counting as a pair at the gate."""
    rng = np.random.default_rng(seed)
    beads, spots = rng.integers(1, 5, 2).tolist()
    predicted = rng.uniform(0.0, 10.0, (3, beads, 2))
    points = rng.uniform(0.0, 10.0, (3, spots, 2))
    counts = rng.integers(0, spots + 1, 3)
    points[np.arange(spots) >= counts[:, None]] = np.inf
    gate = rng.uniform(1.0, 12.0)
    for f, index in enumerate(assign(predicted, points, counts, gate)):
        d2 = np.sum((predicted[f, :, None] - points[f, None, : counts[f]]) ** 2, axis=2)
        pairs = [(bead, spot) for bead, spot in enumerate(index.tolist()) if spot >= 0]
        assert len({spot for _, spot in pairs}) == len(pairs)
        assert all(d2[pair] < gate**2 for pair in pairs)
        ours = sum(d2[pair] - gate**2 for pair in pairs)
        places = [*range(counts[f]), *[-1] * beads]
        least = min(
            sum(
                min(d2[bead, spot] - gate**2, 0.0)
                for bead, spot in enumerate(way)
                if spot >= 0
            )
            for way in itertools.permutations(places, beads)
        )
        assert ours == pytest.approx(least, abs=1e-9)


def test_assignment_is_one_to_one_and_gated() -> None:
    predicted = np.array([[[0.0, 0], [10, 0], [100, 0]]])
    points = np.array([[[9.0, 0], [1, 0], [np.inf, np.inf]]])
    assert_array_equal(assign(predicted, points, np.array([2]), 5.0), [[1, 0, -1]])
    assert_array_equal(assign(predicted, points, np.array([2]), 0.5), [[-1, -1, -1]])
