"""Shells of a mesh inside others: cavities, or bodies counted once with their surroundings."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray

MAX_SHELLS: Final = 200
"""Largest number of shells that are examined."""
Faces = npt.NDArray[Any]


def filled_twice(vertices: FloatArray, faces: Faces) -> int:
    """Count the shells turned outwards inside other filled shells.

    0 for one shell, or more than `MAX_SHELLS`. A shell counts if its box is strictly within
    the box of another, its volume is above 0, and the winding number of all others about
    one of its vertices is above 0.5.

    Such a shell changes nothing: where bodies overlap, path counts once. Cavities turn
    inwards.

    Args:
        vertices: (v, 3), in any unit of length.
        faces: (f, 3), indices of vertices, of closed shells.
    """
    shells = _shells(vertices, faces)
    if not 1 < len(shells) <= MAX_SHELLS:
        return 0
    corners = [vertices[faces[shell]] for shell in shells]
    boxes = [(three.min(axis=(0, 1)), three.max(axis=(0, 1))) for three in corners]
    count = 0
    for i, (low, high) in enumerate(boxes):
        within = any((a < low).all() and (high < b).all() for a, b in boxes)
        if not within or float(np.linalg.det(corners[i]).sum()) <= 0.0:
            continue
        others = np.concatenate([three for j, three in enumerate(corners) if j != i])
        count += _winding(corners[i][0, 0], others) > 0.5
    return int(count)


def _shells(vertices: FloatArray, faces: Faces) -> list[npt.NDArray[np.intp]]:
    """Find the faces of each connected surface.

    Faces are connected by shared vertices.

    Args:
        vertices: (v, 3).
        faces: (f, 3).

    Returns indices of faces, ascending, an array for each surface.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    first = faces.ravel()
    last = faces[:, [1, 2, 0]].ravel()
    size = len(vertices)
    edges = coo_array((np.ones(len(first), bool), (first, last)), shape=(size, size))
    _, part = connected_components(edges, directed=False)
    of_face = part[faces[:, 0]]
    order = np.argsort(of_face, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(of_face[order])) + 1)


def _winding(point: FloatArray, triangles: FloatArray) -> float:
    """Compute the winding number of triangles (f, 3, 3) about a point, by their solid
    angles (van Oosterom and Strackee, IEEE Trans. Biomed. Eng. 30 (1983) 125).

    1 inside an outward closed surface, 0 outside, -1 inside a cavity alone.
    """
    a, b, c = (triangles[:, i] - point for i in range(3))
    la, lb, lc = (np.linalg.norm(edge, axis=1) for edge in (a, b, c))
    volume = np.einsum("ni,ni->n", a, np.cross(b, c))
    below = (
        la * lb * lc
        + np.einsum("ni,ni->n", a, b) * lc
        + np.einsum("ni,ni->n", b, c) * la
        + np.einsum("ni,ni->n", c, a) * lb
    )
    return float(np.arctan2(volume, below).sum() / (2.0 * np.pi))
