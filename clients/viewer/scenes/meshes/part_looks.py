"""The scanner's components as painted meshes: recognizable machine parts, from the
machine file's boxes alone (mm).

`data/parts.toml` has the pieces of each look. Components of other names and roles become
bevelled boxes or cylinders, so another machine file still draws; a part with a mesh of
its own is drawn as that.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes.meshes.painted_meshes import (
    PaintedMesh,
    bevelled,
    cylinder,
    glb,
    lathe,
    turn_matrix,
)
from flexdt.clients.viewer.scenes.meshes.paints import ALUMINIUM, PAINTS
from flexdt.phantoms.files.mesh_files import read_part
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine

MIDDLE: Final = (0.0, 0.0, 0.0)
_TABLE = resources.files("flexdt.clients.viewer.scenes") / "data" / "parts.toml"
LOOKS: Final[Mapping[str, Any]] = tomllib.loads(_TABLE.read_text(encoding="utf-8"))


def own_looks(machine: Machine, folder: Path) -> dict[str, bytes]:
    """Read the parts' own meshes as GLB files [m], part -> file.

    A .glb file is passed on unchanged; any other mesh [mm] is painted `ALUMINIUM`. Raises
    PhantomError: a file cannot be read any more.
    """
    looks = {}
    for part in machine.components:
        if part.mesh:
            file = folder / part.mesh
            own = file.suffix.lower() == ".glb"  # with its colours
            looks[part.name] = (
                file.read_bytes()
                if own
                else glb([PaintedMesh(read_part(file), ALUMINIUM)])
            )
    return looks


def pieces_of(part: Component) -> list[PaintedMesh]:
    """Build the part's painted meshes, in its own frame [mm]: the convex hull of its
    points if it has any, else the look of its name, role or shape.

    A hull is painted `ALUMINIUM` and not moved; the pieces of a look are sized to the
    part's box and moved to its center. The look is that of the part's name, else of its
    role if `LOOKS` has one, else of its shape.
    """
    if part.points_mm:
        return [
            PaintedMesh(trimesh.convex.convex_hull(np.array(part.points_mm)), ALUMINIUM)
        ]
    role = part.role if part.role in LOOKS["looks"] else part.shape
    look = LOOKS["looks"][LOOKS["components"].get(part.name, role)]
    pieces = [made for piece in look for made in _pieces(piece, np.array(part.size_mm))]
    for made in pieces:
        made.mesh.apply_translation(part.center_mm)
    return pieces


def _pieces(piece: Mapping[str, Any], sides: FloatArray) -> list[PaintedMesh]:
    """Build one piece of a look, once for each of its turns, about the middle of a box.

    Boxes, cylinders and else bodies of revolution; sizes are shares of the box plus mm.
    Each turn is about z, by an angle of `turned_deg` (one of 0 by default). A cylinder
    takes its diameter from the first size and its height from the one along its axis.
    Radii of a body of revolution are in shares of the larger of the x and z sides,
    heights in shares of the y side.

    Args:
        piece: of `data/parts.toml`.
        sides: of the box (3,) [mm].
    """
    size, place = (
        (sides * piece.get(share, MIDDLE) + piece.get(more, MIDDLE)).tolist()
        for share, more in (("share", "mm"), ("at", "at_mm"))
    )
    paint = PAINTS[piece["paint"]]
    axis = piece.get("axis", "z")
    made = []
    for angle in np.radians(piece.get("turned_deg", [0.0])):
        match piece["solid"]:
            case "box":
                one = bevelled(size, place, paint, piece.get("bevel", 2.0))
            case "cylinder":
                along = size["xyz".index(axis)]
                one = cylinder(
                    size[0], along, place, paint, axis, piece.get("sections", 48)
                )
            case _:
                wide = max(sides[0], sides[2])
                profile = [
                    (r * wide + a, h * sides[1] + b) for r, a, h, b in piece["profile"]
                ]
                one = lathe(profile, place, paint, axis)
        one.mesh.apply_transform(turn_matrix((0, 0, 1), angle))
        made.append(one)
    return made
