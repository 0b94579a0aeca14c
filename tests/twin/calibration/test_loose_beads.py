"""Beads that move against each other during a scan, drawn with the shadows of `faults_drawn`.

What really moves, from which frame and how far is taken from the drawn laboratory, which shares
no code with the fit.
"""

from __future__ import annotations

import re

import numpy as np
import pytest
from causes_named import calibrated, scored, worst_error
from faults_drawn import DRAWS, Array, drawn, right_draft

from flexdt.twin.calibration.diagnose import fitted
from flexdt.twin.calibration.diagnose.slipped import Piece, Verdict, trial
from flexdt.twin.calibration.diagnose.slipped.piece import walk
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
    kind: str, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of beads explain much of them; without these rivals odds are e^63 and e^109, and
    e^12 where the source jumps and frames jitter: all beads but one moved freely."""
    odds = []
    judged = trial.Trial.judged

    def kept(one: trial.Trial, pieces: tuple[Piece, ...]) -> Verdict:
        odds.append(judged(one, pieces))
        return odds[-1]

    monkeypatch.setattr(trial.Trial, "judged", kept)
    found = scored(kind, seed)
    assert odds
    assert max(one.odds for one in odds) < 0.0
    assert found.verdict == "right", found.said


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_four_tiles_are_no_beads_that_move() -> None:
    """A free course with steps beside it has an answer to any remainder."""
    found = scored("four_tiles", 99_000)
    assert (found.verdict, found.offered) == ("right", True), found
    assert found.worst < 4.0


def test_what_is_open_is_in_the_sigmas(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is named here, as where the images show less of the same slip."""
    scan = drawn("part_slips", 2)
    monkeypatch.setattr(trial, "NAMED_LOG_ODDS", np.inf)
    wide = calibrated(scan)
    monkeypatch.setattr(fitted, "with_loose_beads", lambda plain, fit, known: (fit, None))
    narrow = calibrated(scan)
    assert wide.fit is not None
    assert narrow.fit is not None
    assert wide.identifiable
    assert worst_error(wide, scan)[0] < 4.0
    ratio = [
        wide.fit.certificate.estimates[name].sigma / estimate.sigma
        for name, estimate in narrow.fit.certificate.estimates.items()
    ]
    assert min(ratio) > 0.999
    assert max(ratio) > 1.2


@pytest.mark.parametrize(
    ("piece", "course"),
    [
        (Piece((0,), 3, False), [0, 0, 0, 1, 1, 1]),
        (Piece((0,), 3, True), [0, 0, 0, 1 / 3, 2 / 3, 1]),
        (Piece((0,), 1, True), [0, 0.2, 0.4, 0.6, 0.8, 1]),
    ],
)
def test_a_way_is_gone_at_once_or_evenly(piece: Piece, course: list[float]) -> None:
    assert piece.course(6) == pytest.approx(course)


@pytest.mark.parametrize("frames", [24, 60])
def test_parts_of_a_walk_add_up_to_a_random_walk(frames: int) -> None:
    """Two places of a walk have the covariance of the earlier one's time."""
    parts = walk(frames)
    time = np.arange(frames) / (frames - 1)
    assert parts @ parts.T == pytest.approx(np.minimum.outer(time, time), abs=0.05)


def test_a_free_displacement_is_by_the_course_and_by_the_walk() -> None:
    """Bead 5 goes along y by its course, and both along x by the first part of a walk."""
    piece = Piece((2, 5), 1, False, (0.0, 0.5, -1.0, 0.0), (1.0, 0, 0, 2.0, 0, 0))
    moved = piece.displacements(4, np.array([0, 0, 0, 0, 4.0, 0, 3.0, 0]))
    quarter = (
        3.0 * np.sqrt(2.0) * np.sin([0, np.pi / 6, np.pi / 3, np.pi / 2]) / (np.pi / 2)
    )
    assert moved[:, 0] == pytest.approx(np.outer(quarter, [1, 0, 0]))
    expected = np.outer(quarter, [2, 0, 0]) + np.outer([0, 2.0, -4.0, 0], [0, 1, 0])
    assert moved[:, 1] == pytest.approx(expected)
