"""Beads that move from a frame on, and models of columns with their priors."""

from __future__ import annotations

import math
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
WALK_PARTS: Final = 12
"""Largest number of parts of a random walk."""


class Piece(NamedTuple):
    """Beads that are elsewhere in the phantom from a frame on.

    Attributes:
        beads: their numbers, ascending.
        frame: the first that shows them elsewhere.
        slow: they move on evenly to the last frame.
        free: (frames,) share of the way in each frame, where it follows no such rule.
        toward: (3 beads,) the way of each bead, of root mean square 1, where they move freely.
    """

    beads: tuple[int, ...]
    frame: int
    slow: bool
    free: tuple[float, ...] = ()
    toward: tuple[float, ...] = ()

    def course(self, frames: int) -> FloatArray:
        """Return the share of the way that is gone in each frame, (frames,)."""
        if self.free:
            return np.array(self.free)
        place = np.arange(frames)
        if not self.slow:
            return np.asarray((place >= self.frame) * 1.0)
        last_still = self.frame - 1
        return np.clip((place - last_still) / (frames - 1 - last_still), 0.0, 1.0)

    def displacements(self, frames: int, found: FloatArray) -> FloatArray:
        """Compute where the beads are from their places in each frame, (frames, beads, 3)
        [mm].

        Args:
            frames: their number.
            found: (3 beads,) ways [mm]; behind them factors of the parts of a walk, where
                they move freely.
        """
        own = 3 * len(self.beads)
        moved = np.outer(self.course(frames), found[:own])
        if self.toward:
            moved += np.outer(walk(frames) @ found[own:], self.toward)
        return moved.reshape(frames, len(self.beads), 3)


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


def walk(frames: int) -> FloatArray:
    """Return the parts of a random walk that begins at the first frame, (frames, q): sums
    of them with independent normal factors of one width are such walks, of that standard
    deviation in the last frame (Karhunen and Loeve), but for their quickest parts.
    """
    wave = math.pi * (np.arange(min(WALK_PARTS, frames // 2)) + 0.5)
    place = np.arange(frames) / (frames - 1)
    return np.asarray(math.sqrt(2.0) * np.sin(np.outer(place, wave)) / wave)
