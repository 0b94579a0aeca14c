"""The search for the beads that move, which explain most of what a model leaves."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes.columns import coordinates
from flexdt.twin.calibration.diagnose.slipped.free import FreeCourses
from flexdt.twin.calibration.diagnose.slipped.left import Left, Score
from flexdt.twin.calibration.diagnose.slipped.piece import LEAST_SIDE, SHARES, Piece
from flexdt.twin.calibration.diagnose.slipped.residuals import Residuals
from flexdt.twin.geometry.conventions import FloatArray

COARSE_STEPS: Final = 12
"""Number of frames that are tried at first."""
STARTS: Final = 4
"""Number of starts of the search for beads that move."""


class Search:
    """The pieces that explain most of what a model leaves of the residuals."""

    def __init__(self, trial: Residuals, left: Left) -> None:
        """Begin without any piece.

        Args:
            trial: the residuals.
            left: of them by the model.
        """
        self._trial = trial
        self._left = left
        self._products: dict[tuple[int, bool], tuple[FloatArray, FloatArray]] = {}
        self._scores: dict[Piece, Score] = {}

    def _of_all_beads(self, frame: int, slow: bool) -> tuple[FloatArray, FloatArray]:
        """Return products of the columns of all beads, (3 k, 3 k), and with the residuals,
        (3 k,), less what the model takes up.
        """
        key = (frame, slow)
        if key not in self._products:
            every = Piece(tuple(range(self._trial.beads)), frame, slow)
            columns = self._trial.columns(every)
            taken = self._left.basis.T @ columns
            self._products[key] = (
                columns.T @ columns - taken.T @ taken,
                columns.T @ self._left.values - taken.T @ self._left.along,
            )
        return self._products[key]

    def score(self, piece: Piece) -> Score:
        """Judge a piece, once (cached), with the width that its displacements have."""
        if piece not in self._scores:
            gram, push = self._of_all_beads(piece.frame, piece.slow)
            at = coordinates(piece.beads)
            gram = gram[np.ix_(at, at)]
            push = push[at]
            size = self._trial.size
            least = (self._left.noise / size) ** 2 * np.eye(len(at))
            found = np.linalg.solve(gram + least, push)
            width = float(np.sqrt(np.mean(found**2)))
            width = min(max(width, SHARES[0] * size), size)
            score = self._left.score(gram, push, width)
            chance = self._trial.chance(piece)
            self._scores[piece] = score._replace(gain=score.gain + chance)
        return self._scores[piece]

    def _gain(self, piece: Piece) -> float:
        """Return the gain of a piece."""
        return self.score(piece).gain

    def best(self, before: Sequence[Piece], free: bool) -> Piece:
        """Find the most likely piece, from `STARTS` sets of beads and ways to move, each with
        its best frame, by single changes.

        Args:
            before: pieces of the model, whose beads and frames are tried, too.
            free: whether beads may move by no rule, too.
        """
        n = self._trial.frames
        even = np.linspace(LEAST_SIDE, n - LEAST_SIDE, min(COARSE_STEPS, n - 3))
        frames = {*even.round().astype(int).tolist(), *(p.frame for p in before)}
        sets = self._sets() | {piece.beads for piece in before}
        some = [
            Piece(beads, frame, slow)
            for beads, frame, slow in itertools.product(sets, frames, (False, True))
        ]
        starts: dict[tuple[tuple[int, ...], bool], Piece] = {}
        for piece in sorted(some, key=self._gain, reverse=True):
            starts.setdefault((piece.beads, piece.slow), piece)
        likely = itertools.islice(starts.values(), STARTS)
        ruled = max(map(self._climbed, likely), key=self._gain)
        if not free:
            return ruled
        unruled = FreeCourses(self._trial, self._left).best(self._sets())
        self._scores[unruled.piece] = unruled.score
        return max(ruled, unruled.piece, key=self._gain)

    def _sets(self) -> set[tuple[int, ...]]:
        """List sets of beads: each alone, and those on either side of a plane across each
        axis.
        """
        places = self._trial.candidates.problem.model.beads
        k = self._trial.beads
        out: set[tuple[int, ...]] = {(bead,) for bead in range(k)}
        for order in np.argsort(places, axis=0).T.tolist():
            for i in range(1, k):
                out |= {tuple(sorted(order[:i])), tuple(sorted(order[i:]))}
        return out

    def _climbed(self, piece: Piece) -> Piece:
        """Add and leave out beads, move the frame, and change how they move, as long as that
        is more likely.
        """
        n = self._trial.frames
        k = self._trial.beads
        coarse = max(n // COARSE_STEPS // 2, 1)
        reach = sorted({sign * step for sign in (-1, 1) for step in (0, 1, 2, coarse)})
        while True:
            some = [piece]
            for step, slow in itertools.product(reach, (False, True)):
                if LEAST_SIDE <= piece.frame + step <= n - LEAST_SIDE:
                    some.append(Piece(piece.beads, piece.frame + step, slow))
            for bead in range(k):
                beads = tuple(sorted({*piece.beads} ^ {bead}))
                if 0 < len(beads) < k:
                    some.append(piece._replace(beads=beads))
            best = max(some, key=self._gain)
            if best == piece:
                return piece
            piece = best
