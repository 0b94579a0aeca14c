"""The field's own phantoms: two rings, ball plates, a helix and a ball bar, told apart or not."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from constellations import (
    Array,
    Drawn,
    bar,
    helix,
    odd_ball,
    odd_material,
    plate,
    rings,
    scan_of,
)
from constellations_seen import calibrated, pulls

from flexdt.library.calibration.proposed_commands import Typed, angle_commands
from flexdt.twin.calibration.diagnose import CalibrationCode

UPRIGHT = np.outer(9.0 * np.arange(-2, 3), [0, 0, 1.0])
PLATE = plate()
SHAPES: dict[str, Array] = {
    "two rings": rings(), "plate": PLATE, "rings of four": rings(4),
    "ring and foot": np.concatenate([rings(5)[:5], [[0, 0, 12.0]]]), "upright bar": UPRIGHT,
}  # fmt: skip
"""Phantoms that look alike in several ways."""
TOLD: dict[str, Array] = {"helix": helix(), "bar": bar()}
"""Those that do not."""


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("seed", range(12))
@pytest.mark.daily(1)
@pytest.mark.campaign(4)
def test_axis_and_magnification_of_a_symmetric_phantom_are_offered_without_its_angle(
    shape: str, seed: int
) -> None:
    rng = np.random.default_rng([seed, 5])
    drawn = scan_of(SHAPES[shape], rng)
    result = calibrated(drawn, rng)
    assert result.identifiable, result.findings.texts
    assert result.findings.of(CalibrationCode.AMBIGUOUS).warnings
    off = pulls(result, drawn)
    assert "alpha" not in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("odd", [odd_ball, odd_material])
@pytest.mark.parametrize("shape", ["two rings", "rings of four", "plate"])
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.daily(1)
@pytest.mark.campaign(4)
def test_one_odd_ball_tells_everything(
    shape: str, seed: int, odd: Callable[[Drawn, np.random.Generator], Drawn]
) -> None:
    rng = np.random.default_rng([seed, 6])
    drawn = scan_of(SHAPES[shape], rng)
    while True:  # A ball on the line about which a phantom is turned tells nothing.
        marked = odd(drawn, rng)
        which = (marked.radii != drawn.radii) | (marked.mu != drawn.mu)
        if np.hypot(*drawn.beads[which][0, :2]) > 1.0:
            break
    result = calibrated(marked, rng)
    assert result.identifiable, result.findings.texts
    assert not result.findings.of(CalibrationCode.AMBIGUOUS)
    off = pulls(result, marked)
    assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("shape", TOLD)
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.daily(1)
@pytest.mark.campaign(4)
def test_a_helix_and_a_leaning_bar_have_every_number(shape: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 7])
    drawn = scan_of(TOLD[shape], rng)
    result = calibrated(drawn, rng)
    assert result.identifiable, result.findings.texts
    off = pulls(result, drawn)
    if shape == "helix":
        assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


@pytest.mark.parametrize("shape", ["two rings", "plate"])
def test_a_stated_angle_tells_all(shape: str) -> None:
    rng = np.random.default_rng([3, 8])
    drawn = scan_of(SHAPES[shape], rng)
    stated = {"alpha": round(drawn.truth["alpha"]) + 2.0}
    result = calibrated(drawn, rng, stated)
    assert result.identifiable, result.findings.texts
    assert not result.findings.of(CalibrationCode.AMBIGUOUS)
    off = pulls(result, drawn)
    assert "alpha" in off
    assert max(map(abs, off.values())) < 4.0


def test_every_angle_of_a_symmetric_phantom_is_listed() -> None:
    rng = np.random.default_rng(1)
    drawn = scan_of(rings(), rng)
    (told,) = calibrated(drawn, rng).findings.of(CalibrationCode.AMBIGUOUS)
    angles = [
        float(w.strip(","))
        for w in told.text.split("angles, ")[1].split(" deg")[0].split()
    ]
    assert len(angles) == 12
    true = drawn.truth["alpha"] % 30.0
    apart = np.abs((np.array(angles) - true + 15.0) % 30.0 - 15.0)
    assert apart.max() < 1.0


def test_the_next_command_states_an_angle_beside_what_was_typed() -> None:
    rng = np.random.default_rng(1)
    drawn = scan_of(rings(), rng)
    (told,) = calibrated(drawn, rng).findings.of(CalibrationCode.AMBIGUOUS)
    typed = Typed(("SCAN",), "two-rings", options={"start": "dO_x=1,alpha=7"})
    (command,) = angle_commands(told, typed)
    words = command.split()
    assert words[:5] == ["flexdt", "calibrate", "SCAN", "--phantom", "two-rings"]
    assert words[words.index("--prior") + 1] == "alpha=5"
    start, angle = words[words.index("--start") + 1].split(",alpha=")
    assert start == "dO_x=1"
    assert abs((float(angle) - drawn.truth["alpha"] + 15.0) % 30.0 - 15.0) < 1.0
