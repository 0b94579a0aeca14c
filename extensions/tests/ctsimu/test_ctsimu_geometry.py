"""The geometry of scenarios: what is written is read back, and what cannot be is an error."""

from __future__ import annotations

import contextlib
import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_scans import SHAPE, some_parameters, some_poses, worst

from flexdt.twin.exchange import ExchangeError
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt_extensions.ctsimu.ctsimu_read import read_ctsimu
from flexdt_extensions.ctsimu.ctsimu_write import Scenario, scenario_document

SEEDS = st.integers(0, 2**32 - 1)
SAME = 1e-9
"""mm, as promised."""


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS, still=st.booleans(), even=st.booleans())
def test_ctsimu_keeps_any_motion_and_tells_known_from_real(
    seed: int, still: bool, even: bool
) -> None:
    rng = np.random.default_rng(seed)
    poses = some_poses(rng, int(rng.integers(1, 9)), even=even, still=still)
    known, real = some_parameters(rng), some_parameters(rng)
    text = json.dumps(scenario_document(Scenario(poses, SHAPE, known, real, name="x")))
    back = read_ctsimu(text)
    assert back.real is not None
    assert worst(back.cone_vec.rows, poses.cone_vec(known).rows) < SAME
    assert worst(back.real.rows, poses.cone_vec(real).rows) < SAME
    assert (back.shape, back.name) == (SHAPE, "x")


@pytest.mark.parametrize("name", Offsets().to_edge())
def test_ctsimu_each_parameter_alone(name: str) -> None:
    poses = some_poses(np.random.default_rng(5))
    value = 1.01 if name == "angle_scale" else 0.8
    known = Offsets.from_edge({name: value})
    document = scenario_document(Scenario(poses, SHAPE, known))
    assert name in json.dumps(document["geometry"])
    back = read_ctsimu(json.dumps(document))
    assert back.real is None
    assert worst(back.cone_vec.rows, poses.cone_vec(known).rows) < SAME
    hidden = read_ctsimu(
        json.dumps(scenario_document(Scenario(poses, SHAPE, NOMINAL, known)))
    )
    assert hidden.real is not None
    assert worst(hidden.cone_vec.rows, poses.cone_vec().rows) < SAME
    assert worst(hidden.real.rows, poses.cone_vec(known).rows) < SAME
    assert np.abs(hidden.real.rows - hidden.cone_vec.rows).max() > 1e-3


def test_ctsimu_refuses_a_panel_that_turns() -> None:
    poses = some_poses(np.random.default_rng(3))
    v = np.array(poses.v)
    v[4] = -v[4]
    turned = Poses(poses.source, poses.axis, poses.detector, poses.u, v, poses.angle)
    with pytest.raises(ExchangeError, match="frame 4"):
        scenario_document(Scenario(turned, SHAPE))


def scenario() -> dict[str, Any]:
    return scenario_document(Scenario(some_poses(np.random.default_rng(4)), SHAPE))


def put(document: Any, path: str, value: object) -> Any:
    at = document
    *keys, last = path.split(".")
    for key in keys:
        at = at[key]
    at[last] = value
    return document


@pytest.mark.parametrize(
    ("path", "value", "says"),
    [
        ("file.file_type", "other", "CTSimU Scenario, 1.0 to 1.2"),
        ("file.file_format_version", {"major": 0, "minor": 9}, "format 0.9"),
        ("acquisition.number_of_projections", 0, "from 1"),
        ("acquisition.direction", "left", "CW or CCW"),
        (
            "acquisition.start_angle",
            {"value": 1e4, "unit": "deg"},
            "not below start_angle",
        ),
        ("acquisition.stop_angle", {"value": 1, "unit": "mm"}, "allowed: rad, deg"),
        ("geometry.source.type", "parallel", "allowed: cone"),
        ("geometry.stage.center", {"x": 1}, "geometry.stage.center"),
        ("geometry.stage.vector_u", {"x": 0, "y": 0, "z": 1}, "right angles"),
        ("geometry.detector.deviations", [{"type": "bend"}], r"deviations\[0\]"),
        ("detector.rows", {"value": 1.5}, "whole number"),
        ("detector.pixel_pitch", None, "detector.pixel_pitch"),
        (
            "geometry.source.center.x",
            {"value": 0, "unit": "mm", "drifts": [{"file": "drift.csv"}]},
            "values in this file",
        ),
    ],
)
def test_bad_scenarios(path: str, value: object, says: str) -> None:
    text = json.dumps(put(scenario(), path, value))
    with pytest.raises(ExchangeError, match=says):
        read_ctsimu(text)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-9, 9) | st.floats() | st.text(max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner)
    ),
    max_leaves=6,
)
PATHS = ["file", "acquisition", "geometry", "geometry.stage", "geometry.stage.center.x",
         "geometry.detector.deviations", "geometry.detector.vector_u", "detector",
         "detector.columns", "detector.pixel_pitch.u", "acquisition.pixel_binning",
         "acquisition.include_final_angle", "geometry.source.center"]  # fmt: skip


@settings(max_examples=40, deadline=None)
@given(path=st.sampled_from(PATHS), value=JSON)
def test_whatever_stands_in_a_scenario_is_read_or_refused(
    path: str, value: object
) -> None:
    text = json.dumps(put(scenario(), path, value))
    with contextlib.suppress(ExchangeError):
        assert len(read_ctsimu(text)) >= 1


@settings(max_examples=40, deadline=None)
@given(st.binary(max_size=80).map(lambda b: b.decode("latin-1")))
def test_noise_is_refused(text: str) -> None:
    with pytest.raises(ExchangeError):
        read_ctsimu(text)
