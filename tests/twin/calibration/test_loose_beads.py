"""Beads that move against each other during a scan, drawn with the shadows of `faults_drawn`.

What really moves, from which frame and how far is taken from the drawn laboratory, which shares
no code with the fit.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from causes_named import calibrated, scored
from faults_drawn import DRAWS, Array, drawn, right_draft

from flexdt.twin.calibration.pipeline import Calibration


def ways(kind: str, seed: int) -> Array:
    """Displacements of the balls of a drawn scan, (n, k, 3) [mm]."""
    rng = np.random.default_rng([seed, *kind.encode()])
    moved = DRAWS[kind](right_draft(rng), rng).world.loose
    assert moved is not None
    return moved


def said(result: Calibration) -> str:
    """The error that beads move; "" without it."""
    return "".join(f.text for f in result.errors if f.code == "beads_moved")


@pytest.mark.parametrize(
    "seed",
    [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)],
)
def test_a_part_that_slips_is_named_with_its_beads_frame_and_way(seed: int) -> None:
    """All were offered: with displaced beads, as a drift, with a panel that distorts."""
    moved = np.linalg.norm(ways("part_slips", seed), axis=2)
    result = calibrated(drawn("part_slips", seed))
    assert not result.identifiable
    found = re.search(
        r"beads ([\d, ]+) move by ([\d.]+) mm from frame (\d+) on", said(result)
    )
    assert found is not None, result.findings
    assert ";" not in said(result)
    assert [int(b) for b in found[1].split(", ")] == np.flatnonzero(moved[-1]).tolist()
    assert float(found[2]) == pytest.approx(moved.max(), rel=0.1)
    assert int(found[3]) == np.flatnonzero(moved.any(axis=1))[0]


def test_two_loose_beads_are_named_by_their_frames() -> None:
    moved = np.linalg.norm(ways("two_loose", 1), axis=2)
    text = said(calibrated(drawn("two_loose", 1)))
    assert text
    for bead in np.flatnonzero(moved[-1]).tolist():
        first = int(np.flatnonzero(moved[:, bead])[0])
        assert re.search(rf"\b{bead}\b[^;]* from frame {first} on", text), text


@pytest.mark.parametrize(
    ("kind", "seed"),
    [
        ("one_swings", 1),
        pytest.param("upper_swings", 1, marks=pytest.mark.slow),
        pytest.param("upper_relaxes", 2, marks=pytest.mark.slow),
    ],
)
def test_beads_that_swing_or_creep_ever_slower_are_named(kind: str, seed: int) -> None:
    """None was: a bead that swings was offered as displaced, parts were a misfit."""
    moved = np.linalg.norm(ways(kind, seed), axis=2)
    result = calibrated(drawn(kind, seed))
    assert not result.identifiable
    found = re.search(r"beads? ([\d, ]+) moves? by ([\d.]+) mm unevenly", said(result))
    assert found is not None, result.findings
    assert [int(b) for b in found[1].split(", ")] == np.flatnonzero(moved.max(0)).tolist()
    assert float(found[2]) == pytest.approx(moved.max(), rel=0.15)


@pytest.mark.parametrize(
    ("kind", "seed"),
    [("slow_errors", 9001), ("drift_along", 700), ("source_jumps", 120_036)],
)
def test_slow_errors_and_motion_of_everything_are_no_beads_that_move(
    kind: str, seed: int
) -> None:
    """Steps of beads explain much of them."""
    found = scored(kind, seed)
    assert found.verdict == "right", found.said


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_four_tiles_are_no_beads_that_move() -> None:
    """A free course with steps beside it has an answer to any remainder."""
    found = scored("four_tiles", 99_000)
    assert (found.verdict, found.offered) == ("right", True), found
    assert found.worst < 4.0
