"""Evaluations that `ctsimu` ships, of images of ours, by their own criteria.

`tests/studies/ctsimu_scenarios.py` simulates and evaluates; 2D-WE-1 and 2D-WE-2,
which take a quarter of an hour, and 2D-SW-1 and 2D-SW-2 are run there only.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from ctsimu_scenarios import case

pytestmark = [
    pytest.mark.slow,
    # Of ctsimu's own fits, files and figures.
    pytest.mark.filterwarnings("ignore"),
    pytest.mark.timeout(600),
]


def numbers(pattern: str, text: str) -> list[float]:
    return [float(one) for one in re.findall(pattern, text)]


def test_noise_has_the_ratios_asked_for(tmp_path: Path) -> None:
    found = numbers(r"projection SNR: +(\S+)", case(tmp_path, "2D-FB-1"))
    assert found == pytest.approx(
        [100.0, 250.0], rel=3e-3
    )  # a million pixels: 7e-4 a sigma


def test_the_open_beam_falls_off_as_it_should(tmp_path: Path) -> None:
    assert (
        numbers(r"Max Absolute GV Difference: (\S+)", case(tmp_path, "2D-FB-2"))[0] < 2.0
    )


@pytest.mark.slow
@pytest.mark.campaign
def test_duplex_wires_show_the_resolution_asked_for(tmp_path: Path) -> None:
    found = numbers(r"iSRb: (\S+)", case(tmp_path, "2D-DW-1", "SR75"))
    assert found == pytest.approx([0.075], rel=0.05)


def test_a_foil_and_a_panel_that_lean_are_where_the_scenario_says(tmp_path: Path) -> None:
    text = case(tmp_path, "2D-HS-1")
    assert abs(numbers(r"Mean scale deviation: +(\S+)", text)[0]) < 5e-5
    assert abs(numbers(r"Mean rotation angle:.*= +(\S+) deg", text)[0]) < 1e-3
    shift = re.search(r"Mean translation vector \[px\]: \[(.*)\]", text)
    assert shift is not None
    # The evaluation counts found places from pixels' centres and nominal ones from their edges.
    found = np.array(shift[1].split(), dtype=float)[:2]
    np.testing.assert_allclose(found, -0.5, atol=0.01)


def test_parts_touch_and_replace_one_another(tmp_path: Path) -> None:
    text = case(tmp_path, "2D-SW-3")
    assert numbers(r"treated pixels: (\d+)", text) == [1043, 2690]
    assert numbers(r"value anomalies: (\d+)", text) == [0, 0]
