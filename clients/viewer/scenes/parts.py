"""The scanner's components as recognisable machine parts, from the machine file's boxes alone.

Each builder fills the component's box; what it adds outside (carriages, motors, a tube housing) is
decoration that is fixed to its own stage and never checked for collisions. Components with unknown
names become bevelled boxes, so another machine file still draws; a part with a mesh of its own is
drawn as that. Lengths are in mm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path

import numpy as np
import trimesh

from flexdt.clients.viewer.scenes import sample as s
from flexdt.clients.viewer.scenes import sample as solids
from flexdt.clients.viewer.scenes.sample import PaintedMesh
from flexdt.phantoms.files.mesh_files import read_part
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import Component, Machine

Builder = Callable[[float, float, float], list[PaintedMesh]]
"""Pieces of a part of some size along x, y and z [mm], about its middle."""
MIDDLE = (0.0, 0.0, 0.0)


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
    usual = _drum if part.shape == "cylinder" else _block
    pieces = (BUILDERS.get(part.name) or ROLES.get(part.role) or usual)(*part.size_mm)
    for piece in pieces:
        piece.mesh.apply_translation(part.center_mm)
    return pieces


def _drum(x: float, y: float, z: float) -> list[PaintedMesh]:
    return [s.cylinder(x, z, MIDDLE, s.ALUMINIUM)]


def _block(x: float, y: float, z: float) -> list[PaintedMesh]:
    return [s.bevelled((x, y, z), MIDDLE, s.ALUMINIUM)]


def _platform(x: float, y: float, z: float) -> list[PaintedMesh]:
    feet = product((-0.42 * x, 0.42 * x), (-0.42 * y, 0.42 * y))
    return [
        s.bevelled((x, y, z), MIDDLE, s.GRANITE, 8.0),
        s.bevelled((x * 0.96, 14.0, 1.0), (0, -y * 0.47, z / 2), s.BRAND, 0.2),
        *(s.cylinder(150.0, 90.0, (dx, dy, -z / 2 - 45), s.RUBBER) for dx, dy in feet),
    ]


def _rail(x: float, y: float, z: float) -> list[PaintedMesh]:
    return [
        s.bevelled((x * 1.9, y, z * 0.55), (0, 0, -z * 0.225), s.ANODISED, 2.0),
        s.bevelled((x * 0.62, y, z * 0.5), (0, 0, z * 0.25), s.STEEL, 2.0),
    ]


def _plate(x: float, y: float, z: float) -> list[PaintedMesh]:
    screws = product((-0.45 * x, 0.45 * x), (-0.45 * y, 0.45 * y))
    return [
        s.bevelled((x, y, z * 0.55), (0, 0, z * 0.225), s.ALUMINIUM, 4.0),
        s.bevelled((x * 0.92, y * 0.92, z * 0.45), (0, 0, -z * 0.275), s.ANODISED, 2.0),
        *(s.cylinder(9.0, 1.6, (dx, dy, z / 2), s.RUBBER, sections=18) for dx, dy in screws),
    ]


def _tower(x: float, y: float, z: float) -> list[PaintedMesh]:
    top = z / 2
    return [
        *s.column((x, y, z), s.ALUMINIUM),
        s.bevelled((x * 1.15, y * 1.15, 24.0), (0, 0, top + 12.0), s.ANODISED, 4.0),
        s.cylinder(x * 0.62, 70.0, (0, 0, top + 58.0), s.RUBBER),
        s.cylinder(x * 0.5, 8.0, (0, 0, top + 96.0), s.BRAND),
    ]


def _tube(x: float, y: float, z: float) -> list[PaintedMesh]:
    """A microfocus tube: housing beside the tower, a nose that ends in the focal spot."""
    back, front = -y / 2, y / 2
    nose = [
        (0.0, 0.0), (46.0, 0.0), (46.0, 0.30 * y), (30.0, 0.52 * y), (13.0, 0.80 * y),
        (max(x, z) * 0.75, 0.9 * y), (max(x, z) / 2, y - 0.4), (0.0, y - 0.4),
    ]  # fmt: skip
    return [
        s.lathe(nose, (0, back, 0), s.ENAMEL, axis="y"),
        s.cylinder(7.0, 0.8, (0, front - 0.4, 0), s.BRASS, axis="y"),
        s.cylinder(97.0, 7.0, (0, back + 0.17 * y, 0), s.BRAND, axis="y"),
        s.bevelled((132.0, 26.0, 118.0), (0, back - 8.0, 0), s.ANODISED, 4.0),
        s.bevelled((16.0, 118.0, 96.0), (-60.0, back - 55.0, 0), s.ANODISED, 3.0),
        s.bevelled((16.0, 118.0, 96.0), (60.0, back - 55.0, 0), s.ANODISED, 3.0),
        s.bevelled((136.0, 22.0, 96.0), (0, back - 114.0, 0), s.ANODISED, 3.0),
        s.cylinder(88.0, 210.0, (0, back - 215.0, 0), s.ENAMEL, axis="y"),
        s.cylinder(92.0, 10.0, (0, back - 150.0, 0), s.BRAND, axis="y"),
        s.cylinder(40.0, 26.0, (0, back - 332.0, 0), s.RUBBER, axis="y"),
    ]


def _base(x: float, y: float, z: float) -> list[PaintedMesh]:
    return [
        s.bevelled((x, y, z), MIDDLE, s.ANODISED, 5.0),
        s.bevelled((x * 1.002, y * 0.5, z * 0.16), MIDDLE, s.BRAND, 0.4),
        s.cylinder(x * 0.86, 3.0, (0, 0, z / 2 - 0.5), s.STEEL, sections=72),
    ]


def _holder(x: float, y: float, z: float) -> list[PaintedMesh]:
    """The turntable, with ticks on its rim so that one sees it turn."""
    pieces = [s.cylinder(x, z, MIDDLE, s.ALUMINIUM, sections=96)]
    for k in range(24):
        long = k % 6 == 0
        size = (3.0 if long else 1.6, x * (0.1 if long else 0.06), 0.8)
        place = (0, x / 2 - size[1] / 2 - 2.0, z / 2)
        piece = s.bevelled(size, place, s.SIGNAL if k == 0 else s.RUBBER, 0.1)
        piece.mesh.apply_transform(s.turn_matrix((0, 0, 1), 2.0 * math.pi * k / 24))
        pieces.append(piece)
    return pieces


def _mount(x: float, y: float, z: float) -> list[PaintedMesh]:
    return [
        s.cylinder(x * 0.7, z, MIDDLE, s.BRASS),
        s.cylinder(x, z * 0.12, (0, 0, -z * 0.44), s.STEEL),
        s.cylinder(x, z * 0.1, (0, 0, z * 0.45), s.STEEL),
    ]


def _carriage(x: float, y: float, z: float) -> list[PaintedMesh]:
    """What runs along the detector's tower, and the cross slide that it carries."""
    return [
        s.bevelled((x, y, z), MIDDLE, s.ANODISED, 2.0),
        s.bevelled((14.0, 116.0, z * 0.8), (-58.0, 56.0, 0), s.ANODISED, 3.0),
        s.bevelled((14.0, 116.0, z * 0.8), (58.0, 56.0, 0), s.ANODISED, 3.0),
        s.bevelled((130.0, 14.0, z * 0.8), (0, 114.0, 0), s.ANODISED, 3.0),
    ]


def _panel(x: float, y: float, z: float) -> list[PaintedMesh]:
    """The flat panel: its front face is where the image is drawn."""
    return [
        s.bevelled((x, y * 0.92, z), (0, y * 0.04, 0), s.RUBBER, 1.0),
        s.bevelled((x + 7.0, y * 0.7, z + 7.0), (0, y * 0.15, 0), s.ENAMEL, 2.0),
    ]


BUILDERS: Mapping[str, Builder] = {
    "main_platform": _platform,
    "mag_rail_left": _rail,
    "mag_rail_right": _rail,
    "source_platform": _plate,
    "sample_rail": _plate,
    "detector_platform": _plate,
    "source_tower": _tower,
    "detector_tower": _tower,
    "sample_base": _base,
    "detector_stage": _carriage,
}
"""Component name -> its builder."""

ROLES: Mapping[str, Builder] = {
    "tube": _tube,
    "sample_holder": _holder,
    "sample_mount": _mount,
    "panel": _panel,
}
"""Component role -> its builder, where the name says nothing."""


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
