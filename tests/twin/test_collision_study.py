"""The random aimed sweeps of tests/studies/collision_study.py: nothing missed, no false stop."""

from __future__ import annotations

import json
from pathlib import Path

import collision_study as study
import numpy as np
import pytest


def check(total: dict) -> None:
    assert total["missed"] == 0
    assert total["missed_touches"] == 0
    assert total["false_stops"] == 0
    assert total["least_clearance_beyond_accuracy"] == 0
    # The aims are such that all outcomes occur.
    assert 0 < total["reference_touches"] < total["sweeps"]
    assert total["stops_short_of_touching"] > 0


@pytest.mark.slow
@pytest.mark.campaign
def test_short_study(tmp_path: Path) -> None:
    file = tmp_path / "study.json"
    assert study.main(["--sweeps", "200", "--moves", "80", "--json", str(file)]) == 0
    document = json.loads(file.read_text())
    check(document["pairs"]["all"])
    assert document["flexray"]["stops"] > 0


def test_the_reference_itself() -> None:
    """Its separating axis test: cubes of 2 mm at 1.9 and 2.1 mm, and one turned by 45
    degrees."""
    cube = np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
    )
    places = np.array([[1.9, 0, 0], [2.1, 0, 0], [2.3, 0, 0], [2.5, 0, 0]])
    c = np.sqrt(0.5)
    turn = np.array([[c, -c, 0], [c, c, 0], [0, 0, 1.0]])
    still = (np.tile(np.eye(3), (4, 1, 1)), np.zeros((4, 3)))
    upright = study.separated([cube, cube], [still, (still[0], places)])
    turned = study.separated([cube, cube], [still, (np.tile(turn, (4, 1, 1)), places)])
    assert upright.tolist() == [False, True, True, True]
    assert turned.tolist() == [False, False, False, True]
