"""The LEGO bead phantom of thesis 6.5.1: five hollow 3 x 2 bricks, one 2 mm bead in each.

Dimensions come from `data/lego.toml`, which labels each as thesis, literature or assumed; they must
add up to the thesis's height and footprint. Solids are additive: a brick is its outer box minus its
cavity plus tubes and studs, none overlapping.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from importlib import resources
from typing import Any

import numpy as np

from flexdt.phantoms.materials import material
from flexdt.phantoms.phantom import Phantom
from flexdt.phantoms.pieces import PhantomError
from flexdt.twin.geometry.conventions import FloatArray, stage_rotation
from flexdt.twin.projection.analytic_solids import (
    Box,
    Cylinder,
    Scene,
    Shape,
    Solid,
    Sphere,
    Vector,
)


def lego_phantom() -> Phantom:
    """The LEGO phantom: 24 x 16 x 49.8 mm about the origin, its lowest face at z = -24.9 mm.

    >>> len(lego_phantom().beads)
    5
    """
    data = lego_data()
    thesis, assumed = data["thesis"], data["assumed"]
    values = lego_values(data)
    bricks = int(thesis["bricks"])
    height = bricks * values["brick_height_mm"] + values["stud_height_mm"]
    width, breadth = (n * values["stud_pitch_mm"] for n in thesis["studs"])
    if not (
        math.isclose(height, thesis["height_mm"])
        and [width, breadth] == list(thesis["footprint_mm"])
    ):
        raise PhantomError(
            f"lego.toml: bricks add up to {width:g} x {breadth:g} x {height:g} mm, the thesis has "
            f"{thesis['footprint_mm']} x {thesis['height_mm']} mm"
        )
    plastic, metal = material(assumed["material"]), material(assumed["bead_material"])
    bead_radius = thesis["bead_diameter_mm"] / 2.0
    solids: list[Solid] = []
    for k in range(bricks):
        floor = -height / 2.0 + k * values["brick_height_mm"]
        turn = math.radians(k * assumed["turn_step_deg"])
        for shape, sign in brick_shapes(values, tuple(thesis["studs"]), floor, turn):
            solids.append(Solid(shape, plastic.name, sign * plastic.mu_per_mm))
    beads = _bead_positions(values, bricks, width, breadth, height, bead_radius)
    for x, y, z in beads.tolist():
        # In the cavity, touching no plastic: nothing to subtract.
        solids.append(Solid(Sphere((x, y, z), bead_radius), metal.name, metal.mu_per_mm))
    return Phantom(
        "lego",
        f"{bricks} hollow 3 x 2 LEGO bricks of {plastic.name} with one "
        f"{metal.name} bead of {2 * bead_radius:g} mm diameter each on a spiral",
        Scene(tuple(solids)),
        (width, breadth, height),
        beads,
        np.full(bricks, bead_radius),
        tuple(f"{key} = {value}" for key, value in assumed.items()),
    )


def lego_data() -> dict[str, Any]:
    """`data/lego.toml` as it stands: thesis, literature and assumed values apart."""
    return tomllib.loads(
        (resources.files("flexdt.phantoms") / "data" / "lego.toml").read_text("utf-8")
    )


def lego_values(data: Mapping[str, Any]) -> dict[str, float]:
    """The brick's measures from literature and assumption in one table [mm, deg, turns]."""
    given = {**data["literature"], **data["assumed"]}
    return {key: value for key, value in given.items() if not isinstance(value, str)}


def _bead_positions(
    v: dict[str, float], bricks: int, width: float, breadth: float, height: float, radius: float
) -> FloatArray:
    k = np.arange(bricks)
    inset = v["wall_mm"] + v["bead_clearance_mm"] + radius
    angle = 2.0 * math.pi * v["spiral_turns"] * k / bricks
    z = -height / 2.0 + k * v["brick_height_mm"] + v["bead_height_in_brick_mm"]
    return np.stack(
        [(width / 2.0 - inset) * np.cos(angle), (breadth / 2.0 - inset) * np.sin(angle), z], axis=1
    )


def brick_shapes(
    v: dict[str, float], studs: tuple[int, int], floor: float, turn: float
) -> list[tuple[Shape, float]]:
    """Shapes of one brick with +1 (filled) or -1 (hole), turned by `turn` about the axis."""
    rotation = stage_rotation(turn)

    def at(x: float, y: float, z: float) -> Vector:
        px, py, pz = (rotation @ np.array([x, y, 0.0]) + [0.0, 0.0, z]).tolist()
        return (px, py, pz)

    rows = rotation.T.tolist()
    axes = (tuple(rows[0]), tuple(rows[1]), tuple(rows[2]))
    pitch, tall = v["stud_pitch_mm"], v["brick_height_mm"]
    outer = (studs[0] * pitch, studs[1] * pitch, tall)
    out: list[tuple[Shape, float]] = [(Box(at(0, 0, floor + tall / 2), outer, axes), 1.0)]
    stud_z = floor + tall + v["stud_height_mm"] / 2
    for i in range(studs[0]):
        for j in range(studs[1]):
            x, y = (i - (studs[0] - 1) / 2) * pitch, (j - (studs[1] - 1) / 2) * pitch
            stud = Cylinder(at(x, y, stud_z), v["stud_diameter_mm"] / 2, v["stud_height_mm"])
            out.append((stud, 1.0))
    depth = tall - v["roof_mm"]
    inner = (outer[0] - 2 * v["wall_mm"], outer[1] - 2 * v["wall_mm"], depth)
    out.append((Box(at(0, 0, floor + depth / 2), inner, axes), -1.0))
    for i in range(studs[0] - 1):
        for j in range(studs[1] - 1):
            x, y = (i - (studs[0] - 2) / 2) * pitch, (j - (studs[1] - 2) / 2) * pitch
            foot = at(x, y, floor + depth / 2)
            out.append((Cylinder(foot, v["tube_outer_diameter_mm"] / 2, depth), 1.0))
            out.append((Cylinder(foot, v["tube_inner_diameter_mm"] / 2, depth), -1.0))
    return out
