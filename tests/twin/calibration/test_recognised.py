"""A phantom that stands or was measured otherwise than it was said to: named, or offered."""

from __future__ import annotations

import re

import numpy as np
import pytest
from constellations import MISTAKES, scan_of, scattered
from constellations_seen import calibrated, pulls

OFFERED = ("leans_a_little", "leans", "leans_far", "on_its_side")
"""Mistakes with which all numbers hold."""


@pytest.mark.parametrize("kind", MISTAKES)
@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(n, marks=pytest.mark.campaign(1)) for n in range(1, 8))]
)
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
