"""Painted solids made by code: bevelled boxes, extrusions, cylinders; mm in, metres out.

The result is a list of painted meshes that becomes one GLB.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual.material import PBRMaterial

from flexdt.twin.geometry.conventions import rotation_about

MM = 0.001
"""Scene units (m) per mm: viser's renderer clips at 1 cm and 1 km."""
SMOOTH_RAD = 0.6
"""Edges sharper than this stay sharp when shaded."""

Vector = Sequence[float]


@dataclass(frozen=True)
class Paint:
    """A surface: colour (r, g, b in 0 to 255), metalness and roughness in 0 to 1."""

    color: tuple[int, int, int]
    metal: float = 0.0
    rough: float = 0.6
    glow: tuple[float, float, float] = (0.0, 0.0, 0.0)


STEEL = Paint((186, 192, 200), 0.25, 0.35)
ALUMINIUM = Paint((205, 210, 217), 0.15, 0.45)
ANODISED = Paint((62, 68, 79), 0.15, 0.5)
GRANITE = Paint((96, 104, 117), 0.0, 0.85)
ENAMEL = Paint((240, 243, 247), 0.0, 0.4)
BRAND = Paint((28, 120, 200), 0.0, 0.45)
BRASS = Paint((206, 168, 92), 0.3, 0.35)
SIGNAL = Paint((255, 140, 0), 0.0, 0.5, (0.25, 0.12, 0.0))
RUBBER = Paint((34, 37, 43), 0.0, 0.8)


@dataclass(frozen=True, eq=False)
class Piece:
    """A mesh [mm] and its paint."""

    mesh: trimesh.Trimesh
    paint: Paint


def bevelled(size: Vector, center: Vector, paint: Paint, bevel: float = 2.0) -> Piece:
    """A box [mm] whose edges are cut, so that they catch the light."""
    h = np.asarray(size, dtype=float) / 2.0
    b = min(bevel, 0.35 * float(h.min()))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
    points = np.concatenate(
        [corners * (h - b * np.array(k)) for k in ((0, 1, 1), (1, 0, 1), (1, 1, 0))]
    )
    mesh = trimesh.convex.convex_hull(points)
    mesh.apply_translation(center)
    return Piece(mesh, paint)


def cylinder(
    diameter: float,
    height: float,
    center: Vector,
    paint: Paint,
    axis: str = "z",
    sections: int = 48,
) -> Piece:
    """A cylinder [mm] along x, y or z."""
    mesh = trimesh.creation.cylinder(radius=diameter / 2, height=height, sections=sections)
    if axis == "y":
        mesh.apply_transform(_turn((1, 0, 0), np.pi / 2))
    elif axis == "x":
        mesh.apply_transform(_turn((0, 1, 0), np.pi / 2))
    mesh.apply_translation(center)
    return Piece(mesh, paint)


def lathe(
    profile: Sequence[tuple[float, float]], center: Vector, paint: Paint, axis: str = "z"
) -> Piece:
    """A body of revolution [mm]: (radius, height) from bottom to top, about z (or y)."""
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=64)
    if axis == "y":
        mesh.apply_transform(_turn((1, 0, 0), -np.pi / 2))
    mesh.apply_translation(center)
    return Piece(mesh, paint)


def column(size: Vector, center: Vector, paint: Paint, slots: int = 2) -> list[Piece]:
    """An upright aluminium profile [mm] with T-slots in its four faces."""
    x, y, z = size
    cx, cy, cz = center
    width = 0.045 * (x + y)
    core = bevelled(size, center, paint, 3.0)
    pieces = [core]
    for i in range(slots):
        at = (i + 1) / (slots + 1) - 0.5
        for sign in (-1.0, 1.0):
            pieces.append(
                bevelled(
                    (width, 1.2, z * 0.985), (cx + at * x, cy + sign * (y / 2), cz), RUBBER, 0.2
                )
            )
            pieces.append(
                bevelled(
                    (1.2, width, z * 0.985), (cx + sign * (x / 2), cy + at * y, cz), RUBBER, 0.2
                )
            )
    return pieces


def glb(pieces: Iterable[Piece]) -> bytes:
    """One binary glTF of the pieces, in metres; pieces of one paint share a mesh."""
    groups: dict[Paint, list[trimesh.Trimesh]] = {}
    for piece in pieces:
        groups.setdefault(piece.paint, []).append(piece.mesh)
    scene = trimesh.Scene()
    for i, (paint, meshes) in enumerate(groups.items()):
        scene.add_geometry(_painted(meshes, paint), geom_name=f"part{i}", node_name=f"part{i}")
    out = io.BytesIO()
    export: Any = scene.export
    export(out, file_type="glb", include_normals=True)
    return out.getvalue()


def _painted(meshes: Sequence[trimesh.Trimesh], paint: Paint) -> trimesh.Trimesh:
    shaded = [trimesh.graph.smooth_shade(m, angle=SMOOTH_RAD) for m in meshes]
    vertices, normals, faces, offset = [], [], [], 0
    for m in shaded:
        vertices.append(np.asarray(m.vertices) * MM)
        normals.append(np.asarray(m.vertex_normals))
        faces.append(np.asarray(m.faces) + offset)
        offset += len(m.vertices)
    r, g, b = (_linear(c) for c in paint.color)
    make: Any = PBRMaterial
    material = make(
        baseColorFactor=[r, g, b, 1.0],
        metallicFactor=paint.metal,
        roughnessFactor=paint.rough,
        emissiveFactor=list(paint.glow),
    )
    visuals: Any = trimesh.visual.TextureVisuals
    return trimesh.Trimesh(
        np.concatenate(vertices),
        np.concatenate(faces),
        vertex_normals=np.concatenate(normals),
        visual=visuals(material=material),
        process=False,
    )


def _linear(channel: int) -> float:
    """A channel of sRGB as glTF wants it: linear, 0 to 1."""
    c = channel / 255.0
    return c / 12.92 if c <= 0.04045 else float(((c + 0.055) / 1.055) ** 2.4)


def _turn(axis: Vector, angle: float) -> npt.NDArray[np.float64]:
    out = np.eye(4)
    out[:3, :3] = rotation_about(axis, angle)
    return out


def plain(mesh: trimesh.Trimesh) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Vertices [m] and faces of a mesh in mm."""
    return (
        (np.asarray(mesh.vertices) * MM).astype(np.float32),
        np.asarray(mesh.faces, dtype=np.uint32),
    )
