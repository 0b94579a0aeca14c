"""Rays that run through: a panel before or inside an object is virtual, and cuts no ray.

Line integrals are those of infinite rays from the focal spot, as in other programs: their
samples often put the panel at the rotation axis, with pixels as small as there.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import FloatArray, cross

MOVED_BEHIND: Final = 1.001
"""Distance of a moved panel from the source, relative to the far side of the object."""


def stretches(cone_vec: ConeVec, points: FloatArray) -> FloatArray:
    """Compute the factor on each panel's distance from the source that puts it behind an object,
    and 1 where it is behind already.

    A moved panel is `MOVED_BEHIND` times as far as the farthest point; without points all
    factors are 1.
    `cone_vec`: n views; `points`: (k, 3) whose convex hull holds the object [mm].
    Returns (n,), each at least 1.
    """
    if not len(points) or not len(cone_vec):
        return np.ones(len(cone_vec))
    normal = cross(cone_vec.u, cone_vec.v)
    panel = np.einsum("ni,ni->n", cone_vec.detector - cone_vec.source, normal)
    depth = normal @ points.T - np.einsum("ni,ni->n", cone_vec.source, normal)[:, None]
    with np.errstate(all="ignore"):
        furthest = (depth / panel[:, None]).max(axis=1)
    return np.where(furthest > 1.0, MOVED_BEHIND * furthest, 1.0)


def run_through(cone_vec: ConeVec, points: FloatArray) -> ConeVec:
    """Move the panels that cut an object or are before it behind it, and enlarge their
    pixels: the same rays.

    Args:
        cone_vec: n views.
        points: (k, 3) whose convex hull holds the object [mm].

    Returns:
        A new geometry; the argument itself where no panel cuts.

    Example:
        >>> scan = ConeVec.circular(sod=100, sdd=100, angles=4, pixel=0.5)
        >>> through = run_through(scan, np.array([[0.0, 0.0, 0.0], [0.0, 10.0, 0.0]]))
        >>> through.source_detector_distance.round(2).tolist()
        [110.11, 100.0, 100.0, 100.0]
    """
    return stretched(cone_vec, stretches(cone_vec, points))


def stretched(cone_vec: ConeVec, times: FloatArray) -> ConeVec:
    """Move panels to `times` (n,) their distance, with pixels enlarged: the same images.

    Returns the argument itself if all are 1.
    """
    moved = times != 1.0
    if not moved.any():
        return cone_vec
    rows = cone_vec.rows.copy()
    rows[moved] = stretched_steps(rows[moved], times[moved])
    return ConeVec(rows, cone_vec.detector_shape)


def stretched_steps(rows: FloatArray, times: FloatArray) -> FloatArray:
    """Stretch rows (n, 12), or changes of such, to panels `times` (n,) as far.

    The source's numbers stay.
    """
    out = rows.copy()
    many = times[:, None]
    out[:, 3:6] = rows[:, :3] + many * (rows[:, 3:6] - rows[:, :3])
    out[:, 6:] = many * rows[:, 6:]
    return out


def relaxed_gradient(gradient: FloatArray, times: FloatArray) -> FloatArray:
    """Convert derivatives (n, 12) by the rows of `stretched_steps` to those by the
    original.

    `times`: (n,), the stretch.
    """
    out = gradient.copy()
    many = times[:, None]
    out[:, :3] = gradient[:, :3] + (1.0 - many) * gradient[:, 3:6]
    out[:, 3:] = many * gradient[:, 3:]
    return out
