"""A phantom that stands or was measured otherwise than it was said to: named, or offered."""

from __future__ import annotations

import re

import numpy as np
import pytest
from constellations import MISTAKES, scan_of, scattered
from constellations_seen import calibrated, pulls

from flexdt.twin.calibration.diagnose.usual_factors import OF_RADII, usual_reason
from flexdt.twin.calibration.recognise.constellation import likeness

OFFERED = ("leans_a_little", "leans", "leans_far", "on_its_side")
"""Mistakes with which all numbers hold."""


@pytest.mark.parametrize("kind", MISTAKES)
@pytest.mark.parametrize("seed", range(8))
@pytest.mark.daily(1)
@pytest.mark.campaign(4)
def test_a_mistake_has_its_name_and_no_wrong_number(kind: str, seed: int) -> None:
    rng = np.random.default_rng([seed, 9])
    drawn = MISTAKES[kind](scan_of(scattered(rng), rng), rng)
    result = calibrated(drawn, rng)
    said = " ".join(f"{f.code}: {f.text}" for f in result.findings)
    assert re.search(drawn.names, said), said
    if kind in OFFERED:
        assert result.identifiable, said
    if result.identifiable:
        off = pulls(result, drawn)
        assert max(map(abs, off.values())) < 4.0, off


def test_a_model_is_found_among_balls_turned_mirrored_and_scaled() -> None:
    rng = np.random.default_rng(4)
    beads = scattered(rng, 9)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    for sign in (1.0, -1.0):
        rotation = turn * np.array([1.0, 1.0, sign])
        balls = 2.54 * beads[2:] @ rotation.T + [3.0, -1.0, 2.0]
        strays = rng.uniform(-60, 60, (4, 3))
        found = likeness(beads, rng.permutation(np.concatenate([balls, strays])))
        assert found is not None
        assert len(found.beads) == 7
        assert found.scale == pytest.approx(2.54, rel=1e-6)
        assert found.mirrored == (np.linalg.det(rotation) < 0)
        assert np.allclose(found.rotation, rotation, atol=1e-6)


def test_other_balls_are_like_none() -> None:
    rng = np.random.default_rng(5)
    for _ in range(10):
        assert likeness(scattered(rng, 9), scattered(rng, 9)) is None


@pytest.mark.parametrize(
    ("ratio", "said"), [(0.5, "diameters"), (2.1, "half the radii"), (1.0, ""), (6.0, "")]
)
def test_radii_that_are_wrong_by_a_usual_factor_have_its_name(
    ratio: float, said: str
) -> None:
    reason = usual_reason(ratio, OF_RADII)
    assert said in reason
    assert bool(said) == bool(reason)
