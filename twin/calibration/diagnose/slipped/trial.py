"""The trial of beads that move: which are found, and how likely they are."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.causes.cause import (
    REPEATING,
)
from flexdt.twin.calibration.diagnose.causes.columns import LEAST_VISIBLE, coordinates
from flexdt.twin.calibration.diagnose.causes.every_cause import (
    MOTION_WIDTHS,
    PRIOR_FACTORS,
)
from flexdt.twin.calibration.diagnose.slipped.contest import Contest
from flexdt.twin.calibration.diagnose.slipped.left import Left, Score
from flexdt.twin.calibration.diagnose.slipped.piece import SHARES, Model, Piece
from flexdt.twin.calibration.diagnose.slipped.residuals import Residuals
from flexdt.twin.calibration.diagnose.slipped.search import Search
from flexdt.twin.calibration.fit.evidence import LOG_CHANCE, NAMED_LOG_ODDS, Judged
from flexdt.twin.findings import Finding, error
from flexdt.twin.geometry.conventions import FloatArray

MOST_PIECES: Final = 4
"""Largest number of sets of beads that move, each from a frame of its own."""
LEAST_TOLD: Final = 0.05
"""Part of the largest displacement from which others are told."""
SLOW_ERRORS: Final = tuple(itertools.product((0.7, 0.9, 0.97), (1.0, 3.0, 10.0, 30.0)))
"""Correlations of slow errors of spots from frame to frame, and their sizes in units of errors
that are not correlated."""

Searches = dict[tuple[Piece, ...], Search]
"""Searches by the pieces that are there already."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What is judged of pieces.

    Attributes:
        pieces: beads that move.
        odds: logarithm of the odds that they do.
        moved: the most likely model with them.
        sizes: largest displacement of a bead of each piece [mm].
        rest: root mean square of the whitened residuals with them.
    """

    pieces: tuple[Piece, ...]
    odds: float
    moved: Judged
    sizes: tuple[float, ...]
    rest: float

    @property
    def named(self) -> bool:
        """They move beyond doubt."""
        return self.odds > NAMED_LOG_ODDS

    def finding(self, group: npt.NDArray[np.int64]) -> Finding:
        """Make the error that beads move against the others.

        Args:
            group: (n,) scan of each frame.
        """
        parts = []
        for piece, size in zip(self.pieces, self.sizes, strict=True):
            if size < LEAST_TOLD * max(self.sizes):
                continue
            scan = int(group[piece.frame])
            frame = piece.frame - int(np.flatnonzero(group == scan)[0])
            place = f"frame {frame}" + (f" of scan {scan + 1}" if group.max() > 0 else "")
            one = len(piece.beads) == 1
            how = "slowly, beginning at" if piece.slow else "from"
            on = "" if piece.slow else " on"
            when = "unevenly" if piece.free else f"{how} {place}{on}"
            parts.append(
                f"bead{'s' * (not one)} {', '.join(map(str, piece.beads))} "
                f"move{'s' * one} by {size:.2g} mm {when}"
            )
        return error(
            CalibrationCode.BEADS_MOVED,
            "beads move against the others during the scan: "
            f"{'; '.join(parts)}. Something is loose or slips in the phantom: fix its beads, "
            "and measure again",
        )


class Trial(Residuals):
    """The judgement of beads that move, beside everything else that may explain the residuals."""

    def found(self) -> Iterator[tuple[Piece, ...]]:
        """Yield the pieces that explain most of what is left without causes, and with the
        most likely ones, where they are likely at all; each once: at first those that move
        by a rule, then with those that move freely.
        """
        before: list[tuple[Piece, ...]] = [()]
        bases: tuple[tuple[Model, Searches], ...] = ((self.nothing, {}), (self.rival, {}))
        for free, (base, searches) in itertools.product((False, True), bases):
            pieces = self._explaining(base, searches, free)
            if pieces not in before:
                yield pieces
            before.append(pieces)

    def _explaining(
        self, base: Model, searches: Searches, free: bool
    ) -> tuple[Piece, ...]:
        """Find pieces that explain what a model leaves, step by step, `MOST_PIECES` at
        most, each further one beyond doubt; in the order of their frames.

        One that moves freely takes up nearly anything, so none is added to it.

        Args:
            base: the model.
            searches: beside that model and pieces; those that are not there are added.
            free: whether beads may move by no rule, too.
        """
        rows, widths, values = self.rows_of(base)
        noise = self.candidates.noise
        out: list[Piece] = []
        while len(out) < MOST_PIECES:
            beside = tuple(out)
            if beside not in searches:
                searches[beside] = Search(self, Left(rows, widths, values, noise))
            search = searches[beside]
            piece = search.best(out, free)
            gain, width, noise = search.score(piece)
            if gain < (NAMED_LOG_ODDS if out else 0.0) or piece in out:
                break
            out.append(piece)
            if piece.free:
                break
            more = self.columns(piece)
            rows = np.concatenate([rows, more], axis=1)
            widths = np.append(widths, np.full(more.shape[1], width))
        return tuple(sorted(out, key=lambda piece: piece.frame))

    def judged(self, pieces: tuple[Piece, ...]) -> Verdict:
        """Judge pieces beside all rivals, with every kind of errors of spots.

        The slow errors are judged beside those rivals alone that are the most likely with
        other errors, and only where these do not exclude the pieces.
        """
        c = self.candidates
        motions = self.motions(pieces)
        each = [self.columns(piece) for piece in pieces]
        own = np.concatenate(each, axis=1)
        walks = self.walks() if any(piece.free for piece in pieces) else None
        every = [c.rows, motions]
        if walks is not None:
            every.append(walks.reshape(len(walks), -1))
        first = sum(part.shape[1] for part in every)
        ways = range(first, first + own.shape[1])
        rows = np.concatenate([*every, own], axis=1)
        contest = Contest(self, rows, ways, pieces)
        moving = sorted({bead for piece in pieces for bead in piece.beads})
        begin = c.rows.shape[1]
        behind = begin + motions.shape[1]
        rivals = self._rivals(moving, range(begin, behind))
        bases = self.nothing, self.rival
        single = motions[:, :, None]
        rivals += [self._step_by_step(base, single, begin, _largest) for base in bases]
        if walks is not None:
            rivals += [
                self._step_by_step(base, walks, behind, _likeliest) for base in bases
            ]
        contest.compare(rivals)
        if contest.odds > LOG_CHANCE:
            likely = [rivals[i] for i in contest.likely()]
            beads = {tuple(moving), tuple(range(self.beads))}
            for (part, size), some in itertools.product(SLOW_ERRORS, beads):
                contest.compare(likely, (part, size, some))
        moved = contest.moved
        left = (c.values - rows[:, moved.columns] @ moved.mean) / self.share
        found = dict(zip(moved.columns.tolist(), moved.mean.tolist(), strict=True))
        ends = list(itertools.accumulate(part.shape[1] for part in each))
        parts = np.split(np.array([found[way] for way in ways]), ends[:-1])
        return Verdict(
            pieces,
            contest.odds,
            moved,
            tuple(map(self._largest, pieces, parts)),
            float(np.sqrt(np.mean(left**2))),
        )

    def _largest(self, piece: Piece, found: FloatArray) -> float:
        """Return the largest displacement of a bead in any frame [mm]."""
        moved = piece.displacements(self.frames, found)
        return float(np.linalg.norm(moved, axis=2).max())

    def _rivals(self, moving: Sequence[int], motions: range) -> list[Model]:
        """List the rivals of beads that move: nothing, the most likely causes, these with wide
        priors, with errors that repeat, with those beads elsewhere in all frames, and with
        all motions of everything.
        """
        c = self.candidates
        likely = self.rival
        out = [self.nothing, likely, likely.wider(c.count, max(PRIOR_FACTORS))]
        for cause in c.causes:
            if cause.name == REPEATING:
                out += [likely.beside(cause.columns, width) for width in cause.widths]
        own = (c.count + coordinates(moving)).tolist()
        out += [likely.beside(own, share * self.size) for share in SHARES]
        out += [likely.beside(motions, width * c.noise) for width in MOTION_WIDTHS]
        return out

    def _step_by_step(
        self, base: Model, motions: FloatArray, first: int, chosen: Chooser
    ) -> Model:
        """Add motions of everything to a model, the one that explains most after the other,
        as long as that is more likely, `MOST_PIECES` at most.

        Args:
            base: the model.
            motions: (m, count, q) columns of each.
            first: number of the first of them.
            chosen: finds the motion that explains most, and its width.
        """
        m, count, q = motions.shape
        every = motions.reshape(m, -1)
        products = np.einsum("mpq,mpr->pqr", motions, motions)
        rows, widths, values = self.rows_of(base)
        noise = self.candidates.noise
        out = base
        for _ in range(MOST_PIECES):
            left = Left(rows, widths, values, noise)
            taken = (left.basis.T @ every).reshape(-1, count, q)
            push = (every.T @ left.values).reshape(count, q)
            push -= np.einsum("cpq,c->pq", taken, left.along)
            gram = products - np.einsum("cpq,cpr->pqr", taken, taken)
            power = np.einsum("pqq->pq", gram)
            np.maximum(power, LEAST_VISIBLE**2, out=power)
            best, score, choices = chosen(left, gram, push)
            chance = LOG_CHANCE - math.log(choices)
            if score.gain + chance < 0.0:
                break
            noise = score.noise
            own = range(first + best * q, first + (best + 1) * q)
            out = out.beside(own, score.width, chance)
            rows = np.concatenate([rows, motions[:, best]], axis=1)
            widths = np.append(widths, np.full(q, score.width))
        return out


Chooser = Callable[[Left, FloatArray, FloatArray], tuple[int, Score, int]]
"""Finds one of some motions from what a model leaves and their products, (count, q, q), and with
the residuals, (count, q). Returns its number, what it explains, and among how many it was
chosen."""


def _largest(left: Left, gram: FloatArray, push: FloatArray) -> tuple[int, Score, int]:
    """Find the motion of one column that explains most; its width is its size."""
    power = gram[:, 0, 0]
    best = int(np.argmax(push[:, 0] ** 2 / power))
    width = max(abs(float(push[best, 0] / power[best])), left.noise)
    return best, left.score(gram[best], push[best], width), len(push)


def _likeliest(left: Left, gram: FloatArray, push: FloatArray) -> tuple[int, Score, int]:
    """Find the motion that is most likely with one of MOTION_WIDTHS."""
    scores = [
        (i, left.score(gram[i], push[i], width * left.noise))
        for i in range(len(push))
        for width in MOTION_WIDTHS
    ]
    best, score = max(scores, key=lambda one: one[1].gain)
    return best, score, len(scores)
