"""The scanner's components as recognisable machine parts, from the machine file's boxes alone.

`data/parts.toml` says of which pieces a look consists. Components of other names and roles become
bevelled boxes or cylinders, so another machine file still draws; a part with a mesh of its own is
drawn as that. Lengths are in mm.

The lead cabinet around the machine is drawn only; no collision knows of it. Its walls are seen from
the inside alone, so whatever stands between a camera and the machine is cut away. A kerb shows
where they go; the wall opposite the operator has the door, with a window of lead glass and the lamp
that says whether X-rays are on. Lengths are in mm.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes import sample as s
from flexdt.clients.viewer.scenes import sample as solids
from flexdt.clients.viewer.scenes.sample import Paint, PaintedMesh
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


ROOM_MM: Final = (150.0, 150.0, 450.0)
"""Between the machine's largest part and the walls; above that part, what towers need and more."""
DOOR_MM: Final = (900.0, 1050.0)
WALL = Paint((208, 213, 220), 0.0, 0.9)
FLOOR = Paint((120, 127, 138), 0.0, 0.95)
DOOR = Paint((232, 236, 241), 0.0, 0.7)
GLASS = Paint((58, 92, 104), 0.1, 0.25)
LAMP = {False: (92, 98, 106), True: (255, 243, 196)}
"""X-rays on or not -> colour of the lamp: no red, in which the page draws parts that touch."""


def ground_of(machine: Machine) -> Component:
    """The part on which the others stand."""
    return max(machine.components, key=lambda part: part.size_mm[0] * part.size_mm[1])


def cabinet(machine: Machine, floor_mm: float) -> tuple[list[PaintedMesh], FloatArray]:
    """The cabinet's pieces, and where its lamp is, (3,).

    Args:
        machine: around the largest of whose parts it stands.
        floor_mm: height of the floor.
    """
    ground = ground_of(machine)
    towers = max(part.size_mm[2] for part in machine.components)
    half = np.array(ground.size_mm) / 2 + ROOM_MM
    low = np.array(ground.center_mm) - half
    high = np.array(ground.center_mm) + half
    low[2], high[2] = floor_mm, ground.center_mm[2] + towers + ROOM_MM[2]
    (x0, y0, z0), (x1, y1, z1) = low, high
    door_y, (wide, door_top) = 0.3 * y0 + 0.7 * y1, (DOOR_MM[0], z0 + DOOR_MM[1])
    left, right = door_y - wide / 2, door_y + wide / 2
    walls = [
        _quad([(x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1)][::-1]),
        _quad([(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)][::-1]),
        _quad([(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)][::-1]),
        _quad([(x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1)][::-1]),
    ]
    floor = _quad([(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)])
    middle, tall = (door_top + z0) / 2, DOOR_MM[1]
    on_wall = [
        s.bevelled((8, wide + 60, tall + 60), (x0 + 4, door_y, middle), s.ANODISED),
        s.bevelled((14, wide, tall), (x0 + 7, door_y, middle), DOOR, 4.0),
        s.bevelled((18, 440, 340), (x0 + 9, door_y, door_top - 280), s.ANODISED),
        s.bevelled((20, 400, 300), (x0 + 10, door_y, door_top - 280), GLASS),
        s.bevelled((40, 26, 220), (x0 + 30, left + 90, door_top - 560), s.STEEL, 8.0),
        s.bevelled((16, 150, 150), (x0 + 9, right - 170, door_top - 590), s.SIGNAL),
    ]
    for piece in on_wall:  # as the wall, it is seen from within alone
        piece.mesh.update_faces(piece.mesh.face_normals[:, 0] > 0.2)
    kerb = [
        s.bevelled((x1 - x0 + 80, 40, 60), (0.5 * (x0 + x1), y, z0 + 30), s.STEEL)
        for y in (y0 - 20, y1 + 20)
    ] + [
        s.bevelled((40, y1 - y0, 60), (x, 0.5 * (y0 + y1), z0 + 30), s.STEEL)
        for x in (x0 - 20, x1 + 20)
    ]
    plain = [PaintedMesh(wall, WALL) for wall in walls] + [PaintedMesh(floor, FLOOR)]
    return plain + on_wall + kerb, np.array([x0 + 45.0, door_y, door_top + 130.0])


def _quad(corners: Sequence[Sequence[float]]) -> trimesh.Trimesh:
    """A rectangle that is seen where its corners go counter-clockwise."""
    faces = [[0, 1, 2], [0, 2, 3]]
    return trimesh.Trimesh(np.array(corners, dtype=float), faces, process=False)
