"""A collision body: a convex solid carried by motors, as one linear map and at most one turn.

The origin of its frame slides linearly with the motors; the solid turns about a line through that
origin. A body's pose is therefore a closed form of the motor positions, however long the kinematic
chain is. Motors are columns of arrays, in the scene's order and the script's units (mm, deg).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from flexdt.twin.collision.convex_solids import Polytope, Solid
from flexdt.twin.geometry.conventions import FloatArray

DOWN = np.array([0.0, 0.0, -1.0])
"""The stage's axis, so that growing angles turn clockwise seen from above."""
TINY = 1e-300
"""Keeps a quotient finite."""


@dataclass(frozen=True, eq=False)
class Body:
    """A named convex solid on its kinematic chain.

    Attributes:
        name: the component's; pieces of one sample share a name.
        solid: its shape, in the body's frame.
        origin: (3,) world position of the frame's origin with every motor at zero [mm].
        slides: (axes, 3) displacement of the origin per unit of each motor [mm].
        turns: (axes,) turn per unit of each motor [rad].
        spin_axis: (3,) unit direction of the turn.
        group: bodies with the same group are fixed to each other.
        stage: source, object or detector: bodies of different stages are of interest to each
            other even where no travel can bring them together.
    """

    name: str
    solid: Solid
    origin: FloatArray
    slides: FloatArray
    turns: FloatArray
    group: str
    stage: str
    spin_axis: FloatArray = field(default_factory=DOWN.copy)

    @cached_property
    def reach(self) -> float:
        """Farthest point from the line it turns about [mm]; 0 where turning changes nothing."""
        if not self.turns.any() or self.solid.is_round(self.spin_axis):
            return 0.0
        return self.solid.radius_about(self.spin_axis)

    @cached_property
    def spins(self) -> bool:
        """Whether its orientation ever matters."""
        return self.reach > 0.0

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Corners of a box about the origin that holds the solid at every angle, (3,) each."""
        lower, upper = self.solid.bounds()
        if not self.spins:
            return lower, upper
        k = self.spin_axis
        along = sorted((-self.solid.support(-k), self.solid.support(k)))
        # A disc of radius `reach` across the axis, swept along it.
        across = self.reach * np.sqrt(np.maximum(0.0, 1.0 - k * k))
        ends = np.outer(along, k)
        return ends.min(axis=0) - across, ends.max(axis=0) + across

    def turn_until(self, toward: FloatArray, allowance: float, sense: float) -> float:
        """How far it may turn before its support along `toward` grows by `allowance` [rad].

        Args:
            toward: (3,) unit direction in the body's turned frame.
            allowance: [mm], > 0.
            sense: of the turn, +1 or -1; 0 for both ways.

        Returns:
            A lower bound of that turn; huge if it never grows so much.
        """
        if not isinstance(self.solid, Polytope):
            return allowance / self.reach
        # A point moves by sin(d) swing - (1 - cos(d)) inner, so by at most |swing| d + ... d^2 / 2.
        value, side, inner = (self._levers @ toward).reshape(3, -1)
        ahead = np.abs(side) if sense == 0.0 else np.maximum(sense * side, 0.0)
        curve = np.maximum(-inner, 0.0)
        room = (allowance + value.max()) - value
        root = ahead + np.sqrt(ahead * ahead + 2.0 * curve * room)
        turn = float((2.0 * room / (root + TINY)).min())
        # A point that moves away comes back after half a turn.
        return turn if sense == 0.0 else min(turn, math.pi)

    @cached_property
    def _levers(self) -> FloatArray:
        """Points, their swings about the axis, and their distances from it, stacked (3 k, 3)."""
        points = self.solid.vertices if isinstance(self.solid, Polytope) else np.empty((0, 3))
        inner = points - np.outer(points @ self.spin_axis, self.spin_axis)
        return np.concatenate([points, np.cross(self.spin_axis, points), inner])

    @cached_property
    def _rodrigues(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        x, y, z = self.spin_axis
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        along = np.outer(self.spin_axis, self.spin_axis)
        return along, np.eye(3) - along, cross

    def rotation(self, angle: float) -> FloatArray:
        """Orientation at spin angle `angle` [rad], (3, 3)."""
        along, across, cross = self._rodrigues
        turned: FloatArray = along + math.cos(angle) * across + math.sin(angle) * cross
        return turned
