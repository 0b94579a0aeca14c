"""Beads that move from a frame on, and models of columns with their priors."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray

LEAST_SIDE: Final = 2
"""Least number of frames before a bead moves, and after."""
SHARES: Final = tuple(2e-4 * 4.0**k for k in range(5))
"""Widths of a displacement, as parts of the phantom's size."""


class Piece(NamedTuple):
    """Beads that are elsewhere in the phantom from a frame on.

    Attributes:
        beads: their numbers, ascending.
        frame: the first that shows them elsewhere.
        slow: they move on evenly to the last frame.
    """

    beads: tuple[int, ...]
    frame: int
    slow: bool

    def course(self, frames: int) -> FloatArray:
        """Return the share of the way that is gone in each frame, (frames,)."""
        place = np.arange(frames)
        if not self.slow:
            return np.asarray((place >= self.frame) * 1.0)
        last_still = self.frame - 1
        return np.clip((place - last_still) / (frames - 1 - last_still), 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class Model:
    """Columns of a table with their priors.

    Attributes:
        columns: (c,).
        widths: (c,) of the priors; inf without one.
        chance: logarithm of its probability before the scan is seen, where it is one of many.
    """

    columns: npt.NDArray[np.intp]
    widths: FloatArray
    chance: float = 0.0

    def beside(self, columns: Iterable[int], width: float, chance: float = 0.0) -> Model:
        """Add columns of one width; those that are there get the larger of both."""
        there = dict(zip(self.columns.tolist(), self.widths.tolist(), strict=True))
        for column in columns:
            there[column] = max(there.get(column, 0.0), width)
        widths = np.array(list(there.values()))
        return Model(np.array(list(there), np.intp), widths, self.chance + chance)

    def wider(self, count: int, factor: float) -> Model:
        """Multiply the widths of the first columns by a factor."""
        widths = self.widths.copy()
        widths[:count] *= factor
        return Model(self.columns, widths)
