"""The search for beads that move by no rule in time: by a random walk along one way."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from typing import Final, NamedTuple

import numpy as np

from flexdt.twin.calibration.diagnose.causes.columns import coordinates
from flexdt.twin.calibration.diagnose.slipped.left import Left, Score
from flexdt.twin.calibration.diagnose.slipped.piece import SHARES, Piece, walk
from flexdt.twin.calibration.diagnose.slipped.residuals import Residuals
from flexdt.twin.geometry.conventions import FloatArray

ROUNDS: Final = 4
"""Number of turns in which the way and the course are fitted to each other."""
STARTS: Final = 3
"""Number of sets of beads from which the search begins."""


class Scored(NamedTuple):
    """A piece and what it explains."""

    piece: Piece
    score: Score


class FreeCourses:
    """Beads that move along one way by one course, which is a random walk."""

    def __init__(self, residuals: Residuals, left: Left) -> None:
        """Sum up the products of all beads' columns with each part of the walk.

        Args:
            residuals: the residuals.
            left: of them by the model.
        """
        self._residuals = residuals
        self._left = left
        self._walk = walk(residuals.frames)
        k = residuals.beads
        q = self._walk.shape[1]
        c = residuals.candidates
        own = c.rows[:, c.count : c.count + 3 * k]
        rows = (own[:, :, None] * self._walk[residuals.frame][:, None]).reshape(
            -1, 3 * k * q
        )
        taken = left.basis.T @ rows
        gram = rows.T @ rows - taken.T @ taken
        push = rows.T @ left.values - taken.T @ left.along
        self._gram = gram.reshape(3 * k, q, 3 * k, q)
        self._push = push.reshape(3 * k, q)
        self._scored: dict[tuple[int, ...], Scored] = {}

    def best(self, sets: Iterable[tuple[int, ...]]) -> Scored:
        """Find the most likely beads with their course, by single changes of some sets.

        Args:
            sets: of beads that are tried at first.
        """
        courses = self._courses()
        for beads, course in itertools.product(sets, courses):
            self._try(beads, course)
        starts = sorted(self._scored.values(), key=_gain, reverse=True)[:STARTS]
        for start in starts:
            self._climb(start)
        return max(self._scored.values(), key=_gain)

    def _climb(self, scored: Scored) -> None:
        """Add and leave out beads as long as that is more likely."""
        k = self._residuals.beads
        while True:
            some = [scored]
            course = np.linalg.lstsq(self._walk, np.array(scored.piece.free), rcond=None)[
                0
            ]
            for bead in range(k):
                beads = tuple(sorted({*scored.piece.beads} ^ {bead}))
                if 0 < len(beads) < k:
                    some.append(self._try(beads, course))
            best = max(some, key=_gain)
            if best.piece.beads == scored.piece.beads:
                return
            scored = best

    def _courses(self) -> list[FloatArray]:
        """Return the courses, (q,), that explain most of each bead's residuals and of all."""
        k = self._residuals.beads
        q = self._walk.shape[1]
        out = []
        for beads in (*((bead,) for bead in range(k)), tuple(range(k))):
            at = coordinates(beads)
            gram = self._gram[at][:, :, at].reshape(len(at) * q, -1)
            push = self._push[at].ravel()
            widths = [share * self._residuals.size for share in SHARES]
            width = max(widths, key=lambda w: self._left.score(gram, push, w).gain)
            least = (self._left.noise / width) ** 2 * np.eye(len(push))
            ways = np.linalg.solve(gram + least, push).reshape(-1, q)
            out.append(np.linalg.svd(ways, full_matrices=False)[2][0])
        return out

    def _try(self, beads: tuple[int, ...], course: FloatArray) -> Scored:
        """Fit the way and the course of beads to each other, judge them, and keep them if no
        other course of these beads is more likely.

        Args:
            beads: their numbers, ascending.
            course: (q,) at which the fit begins.

        Returns:
            The most likely course of these beads so far.
        """
        at = coordinates(beads)
        gram = self._gram[at][:, :, at]
        push = self._push[at]
        noise = self._left.noise
        size = self._residuals.size
        width = size * SHARES[len(SHARES) // 2]
        for _ in range(ROUNDS):
            course = course / np.abs(self._walk @ course).max()
            half = np.einsum("atbu,u->atb", gram, course)
            across = np.einsum("atb,t->ab", half, course)
            least = (noise / width) ** 2 * np.eye(len(at))
            way = np.linalg.solve(across + least, push @ course)
            width = float(np.clip(np.sqrt(np.mean(way**2)), SHARES[0] * size, size))
            toward = way / width
            both = np.einsum("atbu,b->atu", gram, toward)
            along = np.einsum("atu,a->tu", both, toward)
            least = (noise / width) ** 2 * np.eye(len(course))
            fresh = np.linalg.solve(along + least, toward @ push)
            if not np.any(fresh):
                break
            course = fresh
        course = course / np.abs(self._walk @ course).max()
        across = np.einsum("atbu,t,u->ab", gram, course, course)
        mixed = np.einsum("atbu,t,b->au", gram, course, toward)
        whole = np.block([[across, mixed], [mixed.T, along]])
        score = self._left.score(
            whole, np.concatenate([push @ course, toward @ push]), width
        )
        free = tuple((self._walk @ course).tolist())
        piece = Piece(beads, 1, False, free, tuple(toward.tolist()))
        score = score._replace(gain=score.gain + self._residuals.chance(piece))
        scored = Scored(piece, score)
        before = self._scored.get(beads, scored)
        self._scored[beads] = max(before, scored, key=_gain)
        return self._scored[beads]


def _gain(scored: Scored) -> float:
    """Return the logarithm of the odds of a piece against none."""
    return scored.score.gain
