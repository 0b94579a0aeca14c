"""The odds that beads move, with the same rivals beside them as without."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.special import logsumexp

from flexdt.twin.calibration.diagnose.slipped.piece import SHARES, Model, Piece
from flexdt.twin.calibration.diagnose.slipped.residuals import Residuals
from flexdt.twin.calibration.fit.evidence import Judged, Table
from flexdt.twin.geometry.conventions import FloatArray


class Contest:
    """Models without and with beads that move, each beside the same rivals."""

    def __init__(
        self,
        trial: Residuals,
        rows: FloatArray,
        ways: range,
        pieces: Sequence[Piece],
    ) -> None:
        """Begin without any model.

        Args:
            trial: the residuals.
            rows: (m, q) of all columns.
            ways: columns of the displacements.
            pieces: that are judged.
        """
        self._trial = trial
        self._rows = rows
        self._ways = ways
        self._chance = sum(trial.chance(piece) for piece in pieces)
        self._widths = [share * trial.size for share in SHARES]
        self._still: list[tuple[float, int]] = []
        self._moved: list[tuple[float, int, Judged, float]] = []

    def compare(
        self,
        rivals: Sequence[Model],
        slow: tuple[float, float, Sequence[int]] | None = None,
    ) -> None:
        """Judge rivals alone, and with beads that move beside them.

        Args:
            rivals: models.
            slow: part, size and beads of slow errors; None: errors are uncorrelated.
        """
        trial = self._trial
        c = trial.candidates
        used = sorted({*self._ways, *(i for r in rivals for i in r.columns.tolist())})
        both = np.column_stack([self._rows[:, used], c.values])
        volume = 0.0
        if slow is not None:
            both, volume = trial.uncorrelated(both, *slow)
        table = Table(both[:, :-1], both[:, -1], c.known.floor)
        place = {column: i for i, column in enumerate(used)}
        means = np.zeros(len(used))
        for column, i in place.items():
            means[i] = c.means[column] if column < len(c.means) else 0.0

        def judged(model: Model) -> Judged | None:
            """Judge a model by the table of the columns that are used."""
            at = [place[column] for column in model.columns.tolist()]
            found = table.judged(at, model.widths, c.noise, means[at])
            if found is None:
                return None
            return replace(found, columns=model.columns, evidence=found.evidence - volume)

        for i, rival in enumerate(rivals):
            still = judged(rival)
            if still is not None:
                self._still.append((still.evidence, i))
            for width in self._widths:
                moved = judged(rival.beside(self._ways, width))
                if moved is not None:
                    odds = moved.evidence + self._chance - math.log(len(SHARES))
                    self._moved.append((odds, i, moved, width))
        if slow is None and self._moved:
            # The width hardly depends on the errors.
            self._widths = [max(self._moved, key=lambda one: one[0])[3]]

    @property
    def odds(self) -> float:
        """Logarithm of the odds that beads move; -inf where that cannot be judged."""
        if not self._moved or not self._still:
            return -math.inf
        moved = logsumexp([evidence for evidence, *_ in self._moved])
        return float(moved - logsumexp([evidence for evidence, _ in self._still]))

    @property
    def moved(self) -> Judged:
        """The most likely model with beads that move."""
        return max(self._moved, key=lambda one: one[0])[2]

    def likely(self) -> list[int]:
        """Return the numbers of the first two rivals and of the two most likely ones of
        each side.
        """
        out = {0, 1}
        moved = [(evidence, i) for evidence, i, _, _ in self._moved]
        for side in (self._still, moved):
            out |= {i for _, i in sorted(side, reverse=True)[:2]}
        return sorted(out)
