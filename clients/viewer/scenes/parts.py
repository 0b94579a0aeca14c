"""The scanner's components as recognisable machine parts, from the machine file's boxes alone.

`data/parts.toml` says of which pieces a look consists. Components of other names and roles become
bevelled boxes or cylinders, so another machine file still draws; a part with a mesh of its own is
drawn as that. Lengths are in mm.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes import sample as s
from flexdt.clients.viewer.scenes import sample as solids
from flexdt.clients.viewer.scenes.sample import PaintedMesh
from flexdt.phantoms.files.mesh_files import read_part
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine

MIDDLE: Final = (0.0, 0.0, 0.0)
_TABLE = resources.files("flexdt.clients.viewer.scenes") / "data" / "parts.toml"
LOOKS: Final[Mapping[str, Any]] = tomllib.loads(_TABLE.read_text(encoding="utf-8"))


def own_looks(machine: Machine, folder: Path) -> dict[str, bytes]:
    """Part -> its own mesh as a GLB file [m], for those that have one.

    Args:
        machine: whose parts.
        folder: of its machine file, in which the meshes lie.

    Raises:
        PhantomError: a file cannot be read any more.
    """
    looks = {}
    for part in machine.components:
        if part.mesh:
            file = folder / part.mesh
            own = file.suffix.lower() == ".glb"  # with its colours
            looks[part.name] = (
                file.read_bytes() if own else s.glb([PaintedMesh(read_part(file), s.ALUMINIUM)])
            )
    return looks


def pieces_of(part: Component) -> list[PaintedMesh]:
    """The part's painted meshes, in its own frame [mm]."""
    if part.points_mm:
        return [PaintedMesh(trimesh.convex.convex_hull(np.array(part.points_mm)), s.ALUMINIUM)]
    role = part.role if part.role in LOOKS["looks"] else part.shape
    look = LOOKS["looks"][LOOKS["components"].get(part.name, role)]
    pieces = [made for piece in look for made in _pieces(piece, np.array(part.size_mm))]
    for made in pieces:
        made.mesh.apply_translation(part.center_mm)
    return pieces


def _pieces(piece: Mapping[str, Any], sides: FloatArray) -> list[PaintedMesh]:
    """One piece of a look, as often as it is turned; about the middle of a box of these sides."""
    size, place = (
        (sides * piece.get(share, MIDDLE) + piece.get(more, MIDDLE)).tolist()
        for share, more in (("share", "mm"), ("at", "at_mm"))
    )
    paint, axis = getattr(s, piece["paint"]), piece.get("axis", "z")
    made = []
    for angle in np.radians(piece.get("turned_deg", [0.0])):
        match piece["solid"]:
            case "box":
                one = s.bevelled(size, place, paint, piece.get("bevel", 2.0))
            case "cylinder":
                along = size["xyz".index(axis)]
                one = s.cylinder(size[0], along, place, paint, axis, piece.get("sections", 48))
            case _:
                wide = max(sides[0], sides[2])
                profile = [(r * wide + a, h * sides[1] + b) for r, a, h, b in piece["profile"]]
                one = s.lathe(profile, place, paint, axis)
        one.mesh.apply_transform(s.turn_matrix((0, 0, 1), angle))
        made.append(one)
    return made


FINENESS = 2
"""Of the ball that a body is grown by: an icosphere, whose points lie along the axes too."""


def bare(solid: ConvexSolid) -> trimesh.Trimesh:
    """A convex solid [mm]."""
    if isinstance(solid, UprightCylinder):
        size = 2.0 * solid.radius, solid.height
        return solids.cylinder(*size, solid.center, solids.STEEL).mesh
    assert isinstance(solid, Polytope)
    return _hull(solid.vertices)


def grown(body: trimesh.Trimesh, margin_mm: float) -> trimesh.Trimesh:
    """A convex body and everything within `margin_mm` of it."""
    ball = trimesh.creation.icosphere(subdivisions=FINENESS, radius=margin_mm).vertices
    corners = np.asarray(body.vertices)[:, None, :] + np.asarray(ball)[None, :, :]
    return _hull(corners.reshape(-1, 3))


def _hull(points: FloatArray) -> trimesh.Trimesh:
    hull: trimesh.Trimesh = trimesh.convex.convex_hull(points)
    return hull
