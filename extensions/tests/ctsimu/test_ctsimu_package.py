"""Scenarios beside the real ctsimu package: it reads ours, and ours reads what it reads."""

from __future__ import annotations

import copy
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import CHIRAL, SHAPE, some_parameters, some_poses, worst

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL
from flexdt_extensions.ctsimu.ctsimu_read import read_ctsimu
from flexdt_extensions.ctsimu.ctsimu_write import Scenario, scenario_document

ctsimu = pytest.importorskip("ctsimu.scenario")


def frames(document: Any, real: bool) -> list[Any]:
    """ctsimu's geometry of every frame, as it is or as reconstruction knows it."""
    scenario = ctsimu.Scenario(json_dict=copy.deepcopy(document))
    out = []
    for i in range(scenario.n_frames()):
        scenario.set_frame(i, reconstruction=not real)
        out.append(scenario.current_geometry())
    return out


def vector(v: Any) -> FloatArray:
    return np.array([v.x(), v.y(), v.z()])


def rows_by_ctsimu(document: Any, real: bool = False) -> FloatArray:
    """cone_vec from ctsimu's coordinate systems alone: everything as the stage's u, v, w see
    it."""
    out = []
    for geometry in frames(document, real):
        stage, detector = geometry.stage, geometry.detector
        axes = np.stack([vector(a) for a in (stage.u, stage.v, stage.w)])
        center = vector(stage.center)
        u, v = (
            vector(detector.u) * detector.pitch_u,
            vector(detector.v) * detector.pitch_v,
        )
        parts = (
            vector(geometry.source.center) - center,
            vector(detector.center) - center,
            u,
            v,
        )
        out.append(np.concatenate([axes @ p for p in parts]))
    return np.array(out)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), even=st.booleans(), still=st.booleans())
def test_ctsimu_sees_the_geometry_we_export(seed: int, even: bool, still: bool) -> None:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, 5, even=even, still=still)
    known, real = some_parameters(rng), some_parameters(rng)
    document = scenario_document(
        Scenario(poses, SHAPE, known, real, kV=90.0, power_W=50.0)
    )
    assert worst(rows_by_ctsimu(document), poses.cone_vec(known).rows) < 1e-9
    assert worst(rows_by_ctsimu(document, real=True), poses.cone_vec(real).rows) < 1e-9


def test_its_projection_matrices_put_a_chiral_phantom_where_we_do() -> None:
    """ctsimu's matrix takes a point of the stage as its negative; its scene does not."""
    rng = np.random.default_rng(1)
    poses, known = some_poses(rng, 9), some_parameters(rng)
    document = scenario_document(Scenario(poses, SHAPE, known))
    points = np.concatenate([-CHIRAL.T, np.ones((1, len(CHIRAL)))])
    middle = np.array([(SHAPE[1] - 1) / 2, (SHAPE[0] - 1) / 2])
    for i, geometry in enumerate(frames(document, real=False)):
        image = np.asarray(geometry.projection_matrix().value) @ points
        pixels = (image[:2] / image[2]).T / geometry.detector.pitch_u + middle
        assert worst(
            pixels, poses[i : i + 1].cone_vec(known).project_points(CHIRAL, SHAPE)[0]
        ) < (1e-9)


def test_the_scenario_says_what_a_simulator_needs() -> None:
    poses = some_poses(np.random.default_rng(2))
    document = scenario_document(
        Scenario(poses, SHAPE, kV=90.0, power_W=45.0, exposure_s=0.1, averages=3, bits=14)
    )
    scenario = ctsimu.Scenario(json_dict=document)
    assert scenario.file.get(["file_format_version", "minor"]) == 2
    assert scenario.n_frames() == len(poses)
    assert scenario.acquisition.get("frame_average") == 3
    assert (scenario.detector.get("rows"), scenario.detector.get("columns")) == SHAPE
    assert scenario.detector.get("integration_time") == 0.1
    assert scenario.source.get("voltage") == 90.0
    assert abs(scenario.source.get("current") - 0.5) < 1e-12
    # Its own idea of the stage: what stood at the origin of our world stands at its source.
    assert np.abs(vector(scenario.source.coordinate_system.center)).max() < 1e-12


def other_scenario() -> dict[str, Any]:
    """Everything ours never writes: free axes, pivots, other units, wobble, unknown drifts."""
    document = scenario_document(Scenario(some_poses(np.random.default_rng(6), 8), SHAPE))
    geometry = document["geometry"]
    geometry["stage"]["deviations"] = [
        {"type": "rotation", "axis": {"u": 1, "v": {"value": 2}, "w": 0.5},
         "amount": {"value": 4, "unit": "deg"}},
        {"type": "rotation", "axis": {"x": 2.0, "y": -3.0, "z": 5.3},
         "pivot": {"u": {"value": 0.1, "unit": "cm"}, "v": {"value": -2.0, "unit": "mm"},
                   "w": {"value": 2.5, "unit": "mm"}},
         "amount": {"value": 0.02, "unit": "rad",
                    "drifts": [{"value": [0, 1, 3], "unit": "deg",
                                "known_to_reconstruction": False}]},
         "known_to_reconstruction": True},
    ]  # fmt: skip
    geometry["stage"]["center"]["z"]["drifts"] = [
        {"value": [0, 500, 200], "unit": "um", "known_to_reconstruction": True},
        {"value": [0.2], "unit": "mm", "known_to_reconstruction": False},
    ]
    geometry["detector"]["deviations"] = [
        {"type": "translation", "axis": {"x": 1, "y": 1, "z": 0},
         "amount": {"value": 0.5, "unit": "mm"}, "known_to_reconstruction": False},
        {"type": "rotation", "axis": "w", "amount": {"value": 2.3e-2, "unit": "rad"},
         "pivot": {"x": 30, "y": -2, "z": 1}},
    ]  # fmt: skip
    geometry["source"]["deviations"] = [
        {"type": "translation", "axis": "z",
         "amount": {"value": 0, "unit": "mm", "drifts": [{"value": [-1, 1], "unit": "mm"}]}},
    ]  # fmt: skip
    document["acquisition"] |= {
        "start_angle": {"value": 10, "unit": "deg"},
        "stop_angle": {"value": 5.0, "unit": "rad"},
        "direction": "CCW",
        "include_final_angle": False,
    }
    return document


def test_ours_reads_what_ctsimu_reads() -> None:
    document = other_scenario()
    back = read_ctsimu(json.dumps(document))
    assert back.real is not None
    assert worst(back.cone_vec.rows, rows_by_ctsimu(document)) < 1e-9
    assert worst(back.real.rows, rows_by_ctsimu(document, real=True)) < 1e-9
    assert np.abs(back.real.rows - back.cone_vec.rows).max() > 0.1
    assert back.notes == ("some deviations or drifts are unknown to reconstruction",)


def test_what_ctsimu_writes_again_is_the_same() -> None:
    """ctsimu reads our file and writes its own: nothing geometric is lost on the way."""
    rng = np.random.default_rng(7)
    poses, known, real = (
        some_poses(rng, still=False),
        some_parameters(rng),
        some_parameters(rng),
    )
    document = scenario_document(Scenario(poses, SHAPE, known, real))
    scenario = ctsimu.Scenario(json_dict=document)
    scenario.set_frame(0)
    back = read_ctsimu(json.dumps(scenario.json_dict()))
    assert back.real is not None
    assert worst(back.cone_vec.rows, poses.cone_vec(known).rows) < 1e-9
    assert worst(back.real.rows, poses.cone_vec(real).rows) < 1e-9


def test_a_mirror_would_be_noticed() -> None:
    poses = some_poses(np.random.default_rng(9))
    rows = poses.cone_vec(NOMINAL).rows
    mirrored = ConeVec(rows * np.tile([1.0, -1.0, 1.0], 4))
    a = ConeVec(rows).project_points(CHIRAL, SHAPE)
    b = mirrored.project_points(CHIRAL, SHAPE)
    assert np.abs(a - b).max() > 5.0
