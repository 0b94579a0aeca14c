"""Painted meshes: bevelled boxes, cylinders and bodies of revolution [mm]; as one GLB [m]."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, cast

import numpy as np
import numpy.typing as npt
import trimesh
from trimesh.visual.material import PBRMaterial

from flexdt.clients.viewer.scenes.world import MM
from flexdt.twin.geometry.conventions import FloatArray, rotation_about

SMOOTH_RAD: Final = 0.6
"""Angle of edges that stay sharp when shaded [rad]."""

Vector = Sequence[float]


@dataclass(frozen=True)
class Paint:
    """A surface: color (r, g, b in 0 to 255), metalness and roughness in 0 to 1."""

    color: tuple[int, int, int]
    metal: float = 0.0
    rough: float = 0.6
    glow: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class PaintedMesh:
    """A mesh [mm] and its paint."""

    mesh: trimesh.Trimesh
    paint: Paint


def bevelled(
    size: Vector, center: Vector, paint: Paint, bevel: float = 2.0
) -> PaintedMesh:
    """Build a box whose edges are cut, so that they catch the light.

    The mesh is the convex hull of 24 points: each corner moved inwards by the bevel along
    two of three axes. The bevel is at most 0.35 of the smallest half side.

    Args:
        size: sides [mm].
        center: [mm].
        paint: color and gloss.
        bevel: width that is cut off [mm]; less for thin boxes.
    """
    h = np.asarray(size, dtype=float) / 2.0
    b = min(bevel, 0.35 * float(h.min()))
    corners = np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float
    )
    points = np.concatenate(
        [corners * (h - b * np.array(k)) for k in ((0, 1, 1), (1, 0, 1), (1, 1, 0))]
    )
    mesh = trimesh.convex.convex_hull(points)
    mesh.apply_translation(center)
    return PaintedMesh(mesh, paint)


def cylinder(
    diameter: float,
    height: float,
    center: Vector,
    paint: Paint,
    axis: str = "z",
    sections: int = 48,
) -> PaintedMesh:
    """Build a painted cylinder about an axis ("z", "y") through its center [mm]."""
    mesh = trimesh.creation.cylinder(
        radius=diameter / 2, height=height, sections=sections
    )
    return _standing(mesh, center, paint, axis)


def lathe(
    profile: Sequence[tuple[float, float]], center: Vector, paint: Paint, axis: str = "z"
) -> PaintedMesh:
    """Build a painted body of revolution about an axis ("z", "y") [mm].

    `profile`: (radius, height).
    """
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=64)
    return _standing(mesh, center, paint, axis)


def _standing(
    mesh: trimesh.Trimesh, center: Vector, paint: Paint, axis: str
) -> PaintedMesh:
    """Turn a mesh made about z, in place, move it to its center [mm] and paint it."""
    if axis == "y":
        mesh.apply_transform(turn_matrix((1, 0, 0), -np.pi / 2))
    mesh.apply_translation(center)
    return PaintedMesh(mesh, paint)


def glb(pieces: Iterable[PaintedMesh]) -> bytes:
    """Encode pieces as one binary glTF file (bytes), scaled from mm to meters.

    Pieces of equal paint are joined to one mesh, in order of their first use; nodes are
    named part0, part1, ...; normals are included.
    """
    groups: dict[Paint, list[trimesh.Trimesh]] = {}
    for piece in pieces:
        groups.setdefault(piece.paint, []).append(piece.mesh)
    scene = trimesh.Scene()
    for i, (paint, meshes) in enumerate(groups.items()):
        scene.add_geometry(
            _painted(meshes, paint), geom_name=f"part{i}", node_name=f"part{i}"
        )
    out = io.BytesIO()
    export: Any = scene.export
    export(out, file_type="glb", include_normals=True)
    return out.getvalue()


def _painted(meshes: Sequence[trimesh.Trimesh], paint: Paint) -> trimesh.Trimesh:
    """Join meshes [mm] of one paint to one mesh [m], smooth but for sharp edges.

    The mesh has the paint as its material, and no metadata. Edges of more than
    `SMOOTH_RAD` stay sharp. Colors are converted from sRGB to linear; opacity is 1.

    Args:
        meshes: of one paint.
        paint: color, metal, roughness and glow.
    """
    shaded = [trimesh.graph.smooth_shade(m, angle=SMOOTH_RAD) for m in meshes]
    mesh: Any = trimesh.util.concatenate(shaded)
    mesh.apply_scale(MM)
    mesh.metadata.clear()  # notes of the mesh library, which would travel to every page
    r, g, b = (_linear(c) for c in paint.color)
    make: Any = PBRMaterial
    material = make(
        baseColorFactor=[r, g, b, 1.0],
        metallicFactor=paint.metal,
        roughnessFactor=paint.rough,
        emissiveFactor=list(paint.glow),
    )
    visuals: Any = trimesh.visual.TextureVisuals
    mesh.visual = visuals(material=material)
    return cast("trimesh.Trimesh", mesh)


def _linear(channel: int) -> float:
    """Convert an sRGB channel (integer 0 to 255) to a linear one (0 to 1), by the
    standard's curve.
    """
    c = channel / 255.0
    if c <= 0.04045:
        return c / 12.92
    return float(((c + 0.055) / 1.055) ** 2.4)


def turn_matrix(axis: Vector, angle: float) -> FloatArray:
    """Make a right-handed turn about an axis through the origin, (4, 4)."""
    out = np.eye(4)
    out[:3, :3] = rotation_about(axis, angle)
    return out


def plain(
    mesh: trimesh.Trimesh,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint32]]:
    """Convert a mesh [mm] to vertices (v, 3) float32 [m] and faces (f, 3) uint32, numbers
    of vertices.
    """
    return (
        (np.asarray(mesh.vertices) * MM).astype(np.float32),
        np.asarray(mesh.faces, dtype=np.uint32),
    )
