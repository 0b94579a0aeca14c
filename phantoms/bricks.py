"""Stacks of hollow LEGO bricks, and the LEGO bead phantom of thesis 6.5.1.

The phantom is five hollow 3 x 2 bricks with one 2 mm bead in each. Dimensions come from
`data/lego.toml`, which labels each as thesis, literature or assumed; they must add up to
the thesis's height and footprint. Solids are additive: a brick is its outer box minus its
cavity plus tubes and studs, none overlapping. `flexdt_extensions.phantom_design` chooses
other places for beads.
"""

from __future__ import annotations

import math
import tomllib
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from typing import Any

import numpy as np

from flexdt.phantoms.phantom import Phantom
from flexdt.twin.attenuation.materials import Material, material
from flexdt.twin.geometry.conventions import FloatArray, stage_rotation
from flexdt.twin.projection import analytic_solids as analytic


def lego_phantom() -> Phantom:
    """Make the LEGO phantom: 24 x 16 x 49.8 mm about the origin, its lowest face at
    z = -24.9 mm.

    Measures that the thesis does not state are assumed, and listed in `assumed`.

    >>> len(lego_phantom().beads)
    5
    """
    data = lego_data()
    thesis = data["thesis"]
    assumed = data["assumed"]
    stack = Brickwork(tuple(thesis["studs"]), int(thesis["bricks"]))
    plastic = material(assumed["material"])
    metal = material(assumed["bead_material"])
    bead_radius = thesis["bead_diameter_mm"] / 2.0
    beads = _bead_positions(stack, bead_radius)
    return Phantom(
        "lego",
        f"{stack.bricks} hollow 3 x 2 LEGO bricks of {plastic.name} with one "
        f"{metal.name} bead of {2 * bead_radius:g} mm diameter each on a spiral",
        stack.scene(beads, bead_radius, metal, assumed["turn_step_deg"]),
        stack.size_mm,
        beads,
        np.full(stack.bricks, bead_radius),
        tuple(f"{key} = {value}" for key, value in assumed.items()),
    )


def lego_data() -> dict[str, Any]:
    """Read `data/lego.toml`: thesis, literature and assumed values apart."""
    return tomllib.loads(
        (resources.files("flexdt.phantoms") / "data" / "lego.toml").read_text("utf-8")
    )


def _bead_positions(stack: Brickwork, radius: float) -> FloatArray:
    """Compute the bead centers of the LEGO phantom, one a brick, bottom first.

    They are on an elliptic spiral, inside the walls by the clearance and the bead's
    radius, each at the same height in its brick.

    Args:
        stack: the bricks with their measures.
        radius: of the beads [mm].

    Returns:
        (bricks, 3) [mm].
    """
    v = stack.measures
    k = np.arange(stack.bricks)
    width, breadth, height = stack.size_mm
    inset = v["wall_mm"] + v["bead_clearance_mm"] + radius
    angle = 2.0 * math.pi * v["spiral_turns"] * k / stack.bricks
    z = -height / 2.0 + k * v["brick_height_mm"] + v["bead_height_in_brick_mm"]
    return np.stack(
        [
            (width / 2.0 - inset) * np.cos(angle),
            (breadth / 2.0 - inset) * np.sin(angle),
            z,
        ],
        axis=1,
    )


def brick_shapes(
    v: dict[str, float], studs: tuple[int, int], floor: float, turn: float
) -> list[tuple[analytic.Shape, float]]:
    """List the shapes of one brick with +1 (filled) or -1 (hole), turned about the axis.

    Holes are in the list after the shapes that they cut; the roof stays closed. Tubes are
    between each four studs, none with one row.

    Args:
        v: the brick's measures [mm].
        studs: along x and y.
        floor: height of the brick's lower edge [mm].
        turn: about the axis [rad].

    Returns:
        (shape, sign): the block and its studs, the cavity, then the tubes in it.
    """
    rotation = stage_rotation(turn)

    def at(x: float, y: float, z: float) -> analytic.Vector:
        """Turn a place of the brick about the axis [mm]; z stays."""
        px, py, pz = (rotation @ np.array([x, y, 0.0]) + [0.0, 0.0, z]).tolist()
        return (px, py, pz)

    rows = rotation.T.tolist()
    axes = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))
    pitch = v["stud_pitch_mm"]
    tall = v["brick_height_mm"]
    outer = (studs[0] * pitch, studs[1] * pitch, tall)
    out: list[tuple[analytic.Shape, float]] = [
        (analytic.Box(at(0, 0, floor + tall / 2), outer, axes), 1.0)
    ]
    stud_z = floor + tall + v["stud_height_mm"] / 2
    for i in range(studs[0]):
        for j in range(studs[1]):
            x = (i - (studs[0] - 1) / 2) * pitch
            y = (j - (studs[1] - 1) / 2) * pitch
            stud = analytic.Cylinder(
                at(x, y, stud_z), v["stud_diameter_mm"] / 2, v["stud_height_mm"]
            )
            out.append((stud, 1.0))
    depth = tall - v["roof_mm"]
    inner = (outer[0] - 2 * v["wall_mm"], outer[1] - 2 * v["wall_mm"], depth)
    out.append((analytic.Box(at(0, 0, floor + depth / 2), inner, axes), -1.0))
    for i in range(studs[0] - 1):
        for j in range(studs[1] - 1):
            x = (i - (studs[0] - 2) / 2) * pitch
            y = (j - (studs[1] - 2) / 2) * pitch
            foot = at(x, y, floor + depth / 2)
            out.append(
                (analytic.Cylinder(foot, v["tube_outer_diameter_mm"] / 2, depth), 1.0)
            )
            out.append(
                (analytic.Cylinder(foot, v["tube_inner_diameter_mm"] / 2, depth), -1.0)
            )
    return out


@dataclass(frozen=True)
class Brickwork:
    """A straight stack of equal bricks about the rotation axis.

    Attributes:
        studs: along x and y; common bricks are 2 x 2, 3 x 2, 4 x 2, 6 x 2, 8 x 2, 4 x 4
            (that a brick of this size is sold is not checked).
        bricks: how many.
    """

    studs: tuple[int, int] = (3, 2)
    bricks: int = 5

    @cached_property
    def measures(self) -> dict[str, float]:
        """Measures of the brick from literature and assumption [mm, deg, turns]."""
        data = lego_data()
        given = {**data["literature"], **data["assumed"]}
        return {key: value for key, value in given.items() if not isinstance(value, str)}

    @property
    def size_mm(self) -> analytic.Vector:
        """Width, breadth, height [mm]; only the height includes the studs, those of the top
        brick.
        """
        v = self.measures
        return (
            self.studs[0] * v["stud_pitch_mm"],
            self.studs[1] * v["stud_pitch_mm"],
            self.bricks * v["brick_height_mm"] + v["stud_height_mm"],
        )

    def floor(self, brick: int) -> float:
        """Compute the height of a brick's lower edge in the object's frame [mm]."""
        return -self.size_mm[2] / 2.0 + brick * self.measures["brick_height_mm"]

    def scene(
        self, beads: FloatArray, radius_mm: float, metal: Material, turn_deg: float = 0.0
    ) -> analytic.Scene:
        """Make the scene of the bricks, each turned by `turn_deg` against the one below,
        and beads (k, 3) [mm].

        Holes are solids of negative attenuation; the plastic is the assumed one.

        Args:
            beads: centers (k, 3) [mm].
            radius_mm: of the beads.
            metal: of the beads.
            turn_deg: about z, from brick to brick.
        """
        plastic = material(lego_data()["assumed"]["material"])
        solids = [
            analytic.Solid(shape, plastic.name, sign * plastic.mu_per_mm)
            for k in range(self.bricks)
            for shape, sign in brick_shapes(
                self.measures, self.studs, self.floor(k), math.radians(k * turn_deg)
            )
        ]
        # In the cavities, touching no plastic: nothing to subtract.
        solids += [
            analytic.Solid(
                analytic.Sphere((x, y, z), radius_mm), metal.name, metal.mu_per_mm
            )
            for x, y, z in beads.tolist()
        ]
        return analytic.Scene(tuple(solids))
