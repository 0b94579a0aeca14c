"""Overlapping meshes made one, or cut out of each other.

Path lengths through a mesh count once for each of its bodies, and attenuations of several
meshes add up. Bodies of one mesh that overlap are therefore united before they are
projected, and a mesh of higher priority is cut out of those below it. Both are exact and
made by the library manifold3d.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Final

import numpy as np
import numpy.typing as npt

from flexdt.phantoms.checked_reading import PhantomError
from flexdt.phantoms.pieces import Surface, bounds
from flexdt.phantoms.solid_meshes import solid_mesh
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.projection import TriangleMesh
from flexdt.twin.projection import analytic_solids as analytic

if TYPE_CHECKING:
    import manifold3d


MAX_COMPARED_BODIES: Final = 2000
"""Largest number of bodies whose boxes are compared pair by pair."""


def united(mesh: TriangleMesh) -> TriangleMesh | None:
    """Unite the overlapping bodies of a closed mesh; itself where their boxes are apart.

    Shells turned inwards are cavities. A mesh of one body is unchecked. None where the
    surface of a body meets itself, so that it has no inside.
    """
    bodies = _bodies(mesh)
    if not _boxes_meet([mesh.vertices[np.unique(mesh.faces[body])] for body in bodies]):
        return mesh
    try:
        mesh64 = _solid(mesh, bodies).to_mesh64()
    except PhantomError:
        return None
    return TriangleMesh(mesh64.vert_properties[:, :3], mesh64.tri_verts.astype(np.int64))


def cut(
    parts: Sequence[tuple[analytic.Scene, Sequence[Surface], float]],
) -> tuple[analytic.Scene, tuple[Surface, ...]]:
    """Cut solids and surfaces so that those of a higher priority take precedence.

    A piece whose box overlaps none of a higher priority stays as it is, also a round one;
    a piece that is cut becomes a mesh, and is left out if nothing remains.

    Args:
        parts: solids, surfaces and the priority of both.

    Returns:
        The remaining parts of the solids, and of the surfaces.

    Raises:
        PhantomError: a round solid, a hole, or a mesh that meets itself would have to be
            cut or to cut.

    Example:
        >>> import trimesh
        >>> from flexdt.twin.projection.analytic_solids import Scene
        >>> big, small = (trimesh.creation.box((side,) * 3) for side in (4.0, 2.0))
        >>> _, (shell, _) = cut([(Scene(()), [Surface(big.vertices, big.faces, "pmma", 0.02)], 0),
        ...                      (Scene(()), [Surface(small.vertices, small.faces, "Fe", 0.5)], 1)])
        >>> round(TriangleMesh(shell.vertices, shell.faces).volume_mm3, 6)
        56.0
    """
    pieces: list[tuple[analytic.Solid | Surface, float]] = []
    for scene, surfaces, rank in parts:
        pieces += [(one, rank) for one in scene.solids]
        pieces += [(one, rank) for one in surfaces]
    boxes = [_box(one) for one, _ in pieces]
    left: list[analytic.Solid | Surface] = []
    for (one, rank), (low, high) in zip(pieces, boxes, strict=True):
        above = [
            other
            for (other, its), (bottom, top) in zip(pieces, boxes, strict=True)
            if its > rank and (low < top).all() and (bottom < high).all()
        ]
        rest = (
            _outside(_filled(one), [_filled(other) for other in above]) if above else one
        )
        left += [] if rest is None else [rest]
    return (
        analytic.Scene(tuple(one for one in left if isinstance(one, analytic.Solid))),
        tuple(one for one in left if isinstance(one, Surface)),
    )


def _box(one: analytic.Solid | Surface) -> tuple[FloatArray, FloatArray]:
    """Return the low and high corner of the box around a piece, (3,) each [mm]."""
    if isinstance(one, analytic.Solid):
        return bounds(one.shape)
    return one.vertices.min(axis=0), one.vertices.max(axis=0)


def _filled(one: analytic.Solid | Surface) -> Surface:
    """Convert a piece to a filled mesh of exactly its form.

    Args:
        one: mesh, box or convex solid.

    Returns:
        The mesh; a surface itself.

    Raises:
        PhantomError: a round solid, or a hole (of negative attenuation).
    """
    if isinstance(one, Surface):
        return one
    if (
        not isinstance(one.shape, analytic.Box | analytic.ConvexPolyhedron)
        or one.mu_per_mm < 0.0
    ):
        kind = "hole"
        if one.mu_per_mm > 0.0:
            kind = type(one.shape).__name__.lower()
        raise PhantomError(
            f"a {kind} of {one.material} overlaps something of another priority; "
            "allowed: meshes, "
            "boxes and convex solids. A round solid names what it replaces instead",
            {"asked": kind, "allowed": ["mesh", "box", "convex"]},
        )
    mesh = solid_mesh(one)
    return Surface(mesh.vertices, mesh.faces, one.material, one.mu_per_mm)


def _outside(surface: Surface, others: Sequence[Surface]) -> Surface | None:
    """Subtract the others from a filled mesh; material and attenuation stay.

    Args:
        surface: filled.
        others: filled, that are taken away.

    Returns:
        The rest; None if nothing is left.

    Raises:
        PhantomError: the surface of one meets itself.
    """
    import manifold3d

    solids = [
        _solid(mesh, _bodies(mesh))
        for mesh in (
            TriangleMesh(s.vertices, s.faces.astype(np.int64)) for s in (surface, *others)
        )
    ]
    left = manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Subtract)
    if left.is_empty():
        return None
    mesh64 = left.to_mesh64()
    return replace(
        surface,
        vertices=mesh64.vert_properties[:, :3],
        faces=mesh64.tri_verts.astype(np.int32),
    )


def _bodies(mesh: TriangleMesh) -> list[npt.NDArray[np.int64]]:
    """Find the connected surfaces of a mesh: arrays of face indices, one for each.

    Faces are connected by shared vertices.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first = mesh.faces.ravel()
    last = mesh.faces[:, [1, 2, 0]].ravel()
    size = len(mesh.vertices)
    edges = coo_array((np.ones(len(first), bool), (first, last)), shape=(size, size))
    _, part = connected_components(edges, directed=False)
    part = part[mesh.faces[:, 0]]
    order = np.argsort(part, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(part[order])) + 1)


def _boxes_meet(bodies: Sequence[npt.NDArray[np.float64]]) -> bool:
    """Return whether the bounding boxes of any two bodies overlap (touching does not
    count).

    More than `MAX_COMPARED_BODIES` are not compared: True.
    """
    if len(bodies) > MAX_COMPARED_BODIES:
        return True
    low = np.array([corners.min(axis=0) for corners in bodies])
    high = np.array([corners.max(axis=0) for corners in bodies])
    meet = (low[:, None] < high[None]).all(axis=2)
    return bool((meet & meet.T & ~np.eye(len(bodies), dtype=bool)).any())


def _solid(
    mesh: TriangleMesh, bodies: Sequence[npt.NDArray[np.int64]]
) -> manifold3d.Manifold:
    """Unite the bodies of a mesh, each without the cavities in it, as a manifold.

    A surface of negative volume is a cavity of the smallest body whose box holds its box;
    without one it is dropped.

    Args:
        mesh: all bodies and cavities.
        bodies: indices of the faces of each.

    Raises:
        PhantomError: the surface of one meets itself.
    """
    import manifold3d

    corners = [mesh.vertices[mesh.faces[body]] for body in bodies]
    volumes = [float(np.linalg.det(three).sum()) for three in corners]
    boxes = [(three.min(axis=(0, 1)), three.max(axis=(0, 1))) for three in corners]
    shells = {i: [bodies[i]] for i, volume in enumerate(volumes) if volume > 0}
    for i, (low, high) in enumerate(boxes):
        around = [
            j
            for j in shells
            if (boxes[j][0] <= low).all() and (high <= boxes[j][1]).all()
        ]
        if volumes[i] <= 0 and around:
            shells[min(around, key=volumes.__getitem__)].append(bodies[i])
    solids = []
    for faces in shells.values():
        used, triangles = np.unique(
            mesh.faces[np.concatenate(faces)], return_inverse=True
        )
        given = manifold3d.Mesh64(
            mesh.vertices[used], triangles.reshape(-1, 3).astype(np.uint64)
        )
        solids.append(manifold3d.Manifold(given))
        if solids[-1].status() != manifold3d.Error.NoError:
            raise PhantomError(
                f"a mesh's surface meets itself ({solids[-1].status().name}); "
                "it cannot be united with or cut out of another"
            )
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)
