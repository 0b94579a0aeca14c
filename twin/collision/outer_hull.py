"""A convex body of few corners around many points, for parts whose meshes have thousands.

It is cut out of the points' box by planes of the points' own hull, where it stands out
most first; so it contains the hull, a pose that is free with it is free, and flat faces
stay flat.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.convex_solids import Polytope, hull
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.description import MAX_POINTS

MAX_PLANES: Final = 2000
"""Largest number of planes of the points' hull that are used; any of them are valid."""
MIN_CUT_MM: Final = 0.01
"""Smaller excess of a corner is not cut off [mm]."""
PLANES_PER_CUT: Final = 8
"""Number of planes added at a time."""
RELATIVE_LIFT: Final = 1e-9
"""Enlargement of the body, as a part of its size, so that rounding leaves no point outside."""


def outer_hull(points: npt.ArrayLike) -> Polytope:
    """Build a convex body that contains points and has at most `MAX_POINTS` corners.

    The exact hull if that has few enough corners. Else planes of its faces are cut from a
    box, `PLANES_PER_CUT` at a time, farthest first, until nothing is more than
    `MIN_CUT_MM` outside or the next cut would give too many corners; the result stands
    out by the `RELATIVE_LIFT`.

    Args:
        points: (k, 3) [mm].

    Example:
        >>> ball = np.random.default_rng(1).normal(size=(3000, 3))
        >>> ball *= 50.0 / np.linalg.norm(ball, axis=1, keepdims=True)
        >>> around = outer_hull(ball)
        >>> len(around.vertices) <= 256, float(around.bounds()[1].max()) < 50.1
        (True, True)
    """
    exact = hull(points)
    if len(exact.vertices) <= MAX_POINTS:
        return exact
    planes = _planes(exact)
    low, high = exact.bounds()
    lift = RELATIVE_LIFT * float((high - low).max())
    inside = exact.vertices.mean(axis=0)
    chosen = [
        np.concatenate([s * e, [-float((s * exact.vertices @ e).max()) - lift]])
        for e in np.eye(3)
        for s in (-1.0, 1.0)
    ]
    corners = _corners(chosen, inside)
    while True:
        out = corners @ planes[:, :3].T + planes[:, 3]
        far = out.max(axis=1)
        taken = list[int]()
        while far.max() > MIN_CUT_MM and len(taken) < PLANES_PER_CUT:
            taken.append(int(np.argmax(out[np.argmax(far)])))
            far[out[:, taken[-1]] > 0.0] = 0.0  # one plane is enough for these corners
        chosen += list(planes[taken] - [0.0, 0.0, 0.0, lift])
        cut = _corners(chosen, inside)
        if not taken or len(cut) > MAX_POINTS:
            return hull(corners)
        corners = cut


def _planes(solid: Polytope) -> FloatArray:
    """Compute the outward planes of the solid's largest faces, at most `MAX_PLANES`.

    Faces in one plane (to 1e-6) count together; faces without area are left out. The
    offset is that of the farthest vertex.

    Args:
        solid: convex.

    Returns:
        (m, 4): unit normal n and offset d, with n . x + d <= 0 inside [mm]; from the
        smallest face to the largest.
    """
    a, b, c = np.moveaxis(solid.vertices[solid.faces], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1)
    normals = normals[areas > 0.0] / areas[areas > 0.0, None]
    heights = np.einsum("ij,ij->i", normals, a[areas > 0.0])
    _, first, same = np.unique(
        np.column_stack([normals, heights]).round(6),
        axis=0,
        return_index=True,
        return_inverse=True,
    )
    large = np.argsort(np.bincount(same.ravel(), areas[areas > 0.0]))[-MAX_PLANES:]
    normals = normals[first[large]]
    reach = (normals @ solid.vertices.T).max(
        axis=1
    )  # a face's own height, but for rounding
    return np.column_stack([normals, -reach])


def _corners(planes: list[FloatArray], inside: FloatArray) -> FloatArray:
    """Compute the corners (k, 3) of the body that planes (n, 4) bound, each once (to 1e-6).

    `planes`: unit normal n and offset d of each, with n . x + d <= 0 inside [mm]. `inside`: (3,)
    point strictly within."""
    from scipy.spatial import HalfspaceIntersection

    corners = HalfspaceIntersection(np.array(planes), inside).intersections
    _, first = np.unique(corners.round(6), axis=0, return_index=True)
    return np.asarray(corners[first])
