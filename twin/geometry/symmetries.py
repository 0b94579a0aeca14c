"""Turns about the vertical after which the beads of a phantom look as before."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray, from_unity, stage_rotation
from flexdt.twin.geometry.offsets import Offsets

NEAR: Final = 0.25
"""Difference of radius or height up to which a turn brings a bead near another, as a share of
the largest radius."""
FAR_OUT: Final = 0.5
"""Share of the largest distance from the middle from which a bead tells turns apart."""


@dataclass(frozen=True, eq=False)
class Symmetry:
    """Turns about a vertical line that put beads on beads.

    Attributes:
        centre: (2,) place of the line, x and y in the object's frame [mm].
        turns: (m,) angles, 0 left out, as `stage_rotation` counts them [rad].
        free: every turn does: all beads are on the line.
    """

    centre: FloatArray
    turns: FloatArray
    free: bool = False

    @property
    def period(self) -> float:
        """Turn after which the phantom looks as before, a whole one without symmetry [rad]."""
        return 2.0 * math.pi / (len(self.turns) + 1)

    def turned(self, offsets: Offsets, turn: float) -> Offsets:
        """Return the offsets at which the beads, turned by an angle, are seen where they are
        seen at `offsets`: the axis stays where it is, the phantom's place on it turns.

        Args:
            offsets: of the scan [mm, rad].
            turn: [rad].
        """
        tau = np.array([offsets.tau_x, offsets.tau_z])
        back = stage_rotation(-turn)[:2, :2]
        other = self.centre - back @ (self.centre - tau)
        moved = from_unity([*(tau - other), 0.0])
        return replace(
            offsets,
            alpha=offsets.alpha + turn,
            tau_x=float(other[0]),
            tau_z=float(other[1]),
            dO_x=offsets.dO_x + float(moved[0]),
            dO_z=offsets.dO_z + float(moved[2]),
        )


def symmetry(beads: FloatArray, tolerance_mm: float) -> Symmetry:
    """Find the turns about the vertical through the beads' middle that put each bead within
    a tolerance of another's place, one to one. Sizes are not compared.

    Args:
        beads: (k, 3) [mm].
        tolerance_mm: distance up to which places are one [mm].

    Example:
        >>> square = [[1, 1, 0], [1, -1, 0], [-1, -1, 0], [-1, 1, 0]]
        >>> found = symmetry(9.0 * np.array(square), 0.1)
        >>> np.degrees(found.turns).round(), found.free
        (array([ 90., 180., 270.]), False)
    """
    centre = beads[:, :2].mean(axis=0)
    across = beads[:, :2] - centre
    far = np.linalg.norm(across, axis=1)
    if len(beads) < 2 or far.max() < tolerance_mm:
        return Symmetry(centre, np.zeros(0), free=len(beads) > 1)
    # The bead with fewest others at its distance and height leaves fewest turns to try.
    mates = (np.abs(far[:, None] - far) < tolerance_mm) & (
        np.abs(beads[:, None, 2] - beads[:, 2]) < tolerance_mm
    )
    number = np.where(far >= FAR_OUT * far.max(), mates.sum(axis=1), len(beads) + 1)
    pivot = int(np.argmin(number))
    way = np.arctan2(across[:, 1], across[:, 0])
    # The stage turns clockwise seen from above.
    turns = np.mod(way[pivot] - way[mates[pivot]], 2.0 * math.pi)
    out = []
    for turn in np.sort(turns).tolist():
        turned = across @ stage_rotation(turn)[:2, :2].T
        gap = np.linalg.norm(turned[:, None] - across, axis=2)
        gap = np.hypot(gap, beads[:, None, 2] - beads[:, 2])
        whose = gap.argmin(axis=1)
        same = bool((gap.min(axis=1) < tolerance_mm).all())
        one_to_one = len(np.unique(whose)) == len(beads)
        itself = bool((whose == np.arange(len(beads))).all())
        if same and one_to_one and not itself:
            out.append(turn)
    return Symmetry(centre, np.array(out))


def spacing(beads: FloatArray) -> float:
    """Compute the angle between neighbors that a turn about the beads' middle may mistake for
    each other: the median, over the beads, of the least turn that brings one near another's
    place; pi where no two are alike [rad].

    Args:
        beads: (k, 3) [mm].
    """
    across = beads[:, :2] - beads[:, :2].mean(axis=0)
    far = np.linalg.norm(across, axis=1)
    near = NEAR * max(float(far.max(initial=0.0)), 1e-12)
    way = np.arctan2(across[:, 1], across[:, 0])
    apart = np.abs(np.mod(way[:, None] - way + math.pi, 2.0 * math.pi) - math.pi)
    mates = (np.abs(far[:, None] - far) < near) & (
        np.abs(beads[:, None, 2] - beads[:, 2]) < near
    )
    apart[~mates | np.eye(len(beads), dtype=bool) | (far < near)] = math.pi
    return float(np.median(apart.min(axis=1)))
