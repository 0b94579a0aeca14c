"""How far an error of the geometry doubles edges: what no moved, turned or scaled object shows.

Each view shows points of the object elsewhere than the stated geometry says. What a motion of the
whole object does in all views alike moves its edges, and doubles none; the rest moves them against
each other, those of opposite views by twice as much.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.reconstruction.consistency.causes import pixel_at_axis

AZIMUTHS: Final = 8
"""Points about the axis at each of three heights."""
STEP: Final = 1e-3
"""Of the motions, over the radius of the points; projections are nearly linear in them."""


def doubled_mm(
    stated: ConeVec,
    right: ConeVec,
    shape: tuple[int, int],
    centre: FloatArray,
    radius: float,
    half_height: float,
) -> float:
    """Compute by how much two geometries double edges, at the axis [mm].

    Args:
        stated, right: n views each, of the same panel.
        shape: (rows, cols).
        centre: (x, y, z) of the object [mm].
        radius, half_height: of a cylinder in which it is [mm].

    Returns:
        Twice the root mean square of a point's displacement in a view, as far from the source
        as the axis; 0 where a view does not project the points.
    """
    turn = np.arange(AZIMUTHS) * 2.0 * np.pi / AZIMUTHS
    around = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(AZIMUTHS)]) * radius
    up = np.array([0.0, 0.0, half_height])
    points = np.concatenate([around - up, around, around + up])
    step = STEP * radius
    moves = [np.broadcast_to(step * axis, points.shape) for axis in np.eye(3)]
    moves += [STEP * np.cross(axis, points) for axis in np.eye(3)]
    moves.append(STEP * points)
    side = np.stack(pixel_at_axis(stated, centre[:2]), axis=-1)[:, None]
    there = stated.project_points(points + centre, shape)
    off = (side * (right.project_points(points + centre, shape) - there)).ravel()
    columns = np.array(
        [
            (side * (stated.project_points(points + m + centre, shape) - there)).ravel()
            for m in moves
        ]
    ).T
    if not (np.isfinite(off).all() and np.isfinite(columns).all()):
        return 0.0
    left = off - columns @ np.linalg.lstsq(columns, off, rcond=1e-9)[0]
    return 2.0 * float(np.sqrt(2.0 * np.square(left).mean()))
