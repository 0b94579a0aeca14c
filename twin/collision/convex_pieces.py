"""A sample's mesh as convex pieces that contain it, because collision solids must be convex.

A mesh inside a mesh has a distance to it and would count as free. One hull contains any
mesh; where that wastes room, the mesh is cut in halves and each half gets a hull of its
own, as long as the hulls together shrink enough. The pieces always contain the solid, so
a pose that is free of them is free; they may stop a motion that passes through a hollow.
Meshes are not repaired.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt

from flexdt.twin.collision.convex_solids import Polytope, hull
from flexdt.twin.errors import GeometryError
from flexdt.twin.geometry.conventions import FloatArray

MAX_PIECES = 8
"""Largest number of pieces of a sample."""
MAX_VOLUME_SHARE = 0.9
"""Largest volume of the hulls after a cut, as a part of the volume before."""
MAX_CUTTING_FACES = 50_000
"""Meshes with more faces get one hull, so that a large upload does not block the twin."""


class Mesh(Protocol):
    """A triangle mesh [mm, object frame]; trimesh's is one."""

    @property
    def vertices(self) -> npt.NDArray[np.float64]:
        """(n, 3) positions."""

    @property
    def faces(self) -> npt.NDArray[np.integer]:
        """(m, 3) indices of corners."""


def convex_pieces(
    mesh: Mesh,
    *,
    rotation: npt.ArrayLike | None = None,
    offset: npt.ArrayLike = (0.0, 0.0, 0.0),
    max_pieces: int = MAX_PIECES,
) -> tuple[Polytope, ...]:
    """Divide a mesh into convex pieces that together contain its solid.

    The piece of the largest volume is cut in two next, while that saves enough volume
    (`MAX_VOLUME_SHARE`); one that no cut makes smaller stays.

    Args:
        mesh: its surface [mm].
        rotation: (3, 3) turn of the sample on the stage, applied first; None: none.
        offset: (3,) shift on the stage [mm].
        max_pieces: largest number of pieces.

    Returns:
        The pieces, placed [mm]; the convex hull alone for a mesh of more than
        `MAX_CUTTING_FACES` faces.

    Raises:
        GeometryError: the mesh has no faces or is not finite.
    """
    vertices = np.asarray(mesh.vertices, dtype=np.float64)
    if len(mesh.faces) == 0 or not np.isfinite(vertices).all():
        message = f"a sample mesh needs faces and finite vertices; this has {len(mesh.faces)} faces"
        raise GeometryError(
            message, {"faces": len(mesh.faces), "vertices": len(vertices)}
        )
    if rotation is None:
        turn = np.eye(3)
    else:
        turn = np.asarray(rotation, dtype=np.float64)
    placed = vertices @ turn.T + np.asarray(offset, dtype=np.float64)
    triangles = placed[np.asarray(mesh.faces)]
    whole = _Piece(triangles)
    if len(triangles) > MAX_CUTTING_FACES:
        return (whole.hull,)
    pieces = [whole]
    finished: list[_Piece] = []
    while pieces and len(pieces) + len(finished) < max_pieces:
        pieces.sort(key=lambda p: p.volume)
        piece = pieces.pop()
        halves = _best_cut(piece)
        if halves is None:
            finished.append(piece)
        else:
            pieces += halves
    return tuple(p.hull for p in (*finished, *pieces))


class _Piece:
    """Triangles whose hull holds a part of the solid."""

    def __init__(self, triangles: FloatArray) -> None:
        """Keep triangles (n, 3, 3) [mm], and compute their convex hull and its volume
        [mm³].
        """
        self.triangles = triangles
        self.hull = hull(triangles.reshape(-1, 3))
        corners = self.hull.vertices[self.hull.faces]
        self.volume = float(np.linalg.det(corners).sum()) / 6.0


def _best_cut(piece: _Piece) -> Sequence[_Piece] | None:
    """Find the cut with the least volume of both halves' hulls, at a quarter, half or
    three quarters of the extent along x, y and z.

    Cuts that leave a half without triangles are skipped.

    Args:
        piece: with its triangles and hull.

    Returns:
        The two halves; None if no cut makes the volume less than `MAX_VOLUME_SHARE` of
        the piece's.
    """
    points = piece.hull.vertices
    best = None
    wanted = MAX_VOLUME_SHARE * piece.volume
    for axis in range(3):
        low = points[:, axis].min()
        high = points[:, axis].max()
        for share in (0.25, 0.5, 0.75):
            at = low + share * (high - low)
            halves = [_clip(piece.triangles, axis, at, side) for side in (-1.0, 1.0)]
            if any(len(h) == 0 for h in halves):
                continue
            pieces = [_Piece(h) for h in halves]
            volume = sum(m.volume for m in pieces)
            if volume < wanted:
                best = pieces
                wanted = volume
    return best


def _clip(triangles: FloatArray, axis: int, at: float, side: float) -> FloatArray:
    """Clip triangles at a plane, and close the cut with a convex cap.

    Triangles that cross the plane are cut there; corners in the plane count as kept. The
    cap is the convex hull of the cut.

    Args:
        triangles: (n, 3, 3) corners [mm].
        axis: number of the coordinate axis across the plane.
        at: position of the plane [mm].
        side: +1 keeps the part above it, -1 the part below.

    Returns:
        (m, 3, 3) corners of the kept part; empty if nothing is on that side.
    """
    height = side * (triangles[:, :, axis] - at)
    count = (height >= 0.0).sum(axis=1)
    one = count == 1
    two = count == 2
    # The corner that is alone on its side comes first.
    alone = np.concatenate(
        [
            _led_by(triangles[one], height[one], 1.0),
            _led_by(triangles[two], height[two], -1.0),
        ]
    )
    lead = alone[:, 0]
    left = alone[:, 1]
    right = alone[:, 2]
    to_left, to_right = (_crossing(lead, end, axis, at) for end in (left, right))
    inner = np.arange(len(alone)) < one.sum()
    tips = np.stack([lead, to_left, to_right], axis=1)[inner]
    stumps = [
        np.stack([to_left, left, right], axis=1)[~inner],
        np.stack([to_left, right, to_right], axis=1)[~inner],
    ]
    cap = _cap(np.concatenate([to_left, to_right]), axis)
    return np.concatenate([triangles[count == 3], tips, *stumps, cap])


def _led_by(triangles: FloatArray, height: FloatArray, sign: float) -> FloatArray:
    """Rotate the corners of triangles, in their order, so that the one with the largest sign *
    height comes first. `triangles`: (n, 3, 3) corners; `height`: of the corners, (n, 3); `sign`:
    +1 or -1. Returns (n, 3, 3); the sense of turning stays."""
    first = np.argmax(sign * height, axis=1)
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(triangles, order[:, :, None], axis=1)


def _crossing(start: FloatArray, end: FloatArray, axis: int, at: float) -> FloatArray:
    """Compute where edges `start` to `end` (n, 3) cross a plane of `axis` at `at` [mm].

    None may be parallel to it.
    """
    share = (at - start[:, axis]) / (end[:, axis] - start[:, axis])
    points = start + share[:, None] * (end - start)
    points[:, axis] = at
    return points


def _cap(points: FloatArray, axis: int) -> FloatArray:
    """Triangulate the convex hull of points (k, 3) of a plane across `axis`, as corners
    (m, 3, 3).

    Fewer than three points give none; points on one line a flat fan.
    """
    from scipy.spatial import ConvexHull, QhullError

    if len(points) < 3:
        return np.empty((0, 3, 3))
    try:
        ring = points[ConvexHull(np.delete(points, axis, axis=1)).vertices]
    except QhullError:  # on one line: any fan holds it
        ring = points
    first = np.broadcast_to(ring[0], ring[1:-1].shape)
    return np.stack([first, ring[1:-1], ring[2:]], axis=1)
