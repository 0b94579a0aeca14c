"""The distance of two convex solids with a certificate; the one module that wraps python-fcl.

fcl proposes the nearest points; the clearance that counts is then computed from the two
solids' supports along that direction, a lower bound of the true distance whatever fcl
returned. So an error of the library can stop a motion too early but never call a touch
free. fcl is imported when the first pair is made. Its continuous collision (which misses
contacts) is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.geometry.conventions import FloatArray

Separation = tuple[float, FloatArray]
"""Certified clearance [mm], 0 when they touch or overlap, and the unit direction
from b to a."""

_IDENTITY = np.eye(3)
_ORIGIN = np.zeros(3)
_TOUCHING: Separation = (0.0, np.array([0.0, 0.0, 1.0]))
"""Separation of bodies that touch or overlap."""
MAX_DEFICIT_MM = 1e-5
"""Largest deficit of a certificate from fcl's distance before the search improves it [mm]."""
MAX_SEARCH_STEPS = 40
"""Largest number of steps of Gilbert's search."""


def separation_of(
    a: ConvexSolid, b: ConvexSolid
) -> Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]:
    """Make a function that computes the certified separation of `a` from `b`.

    The gap is that of a slab without points of either, hence never more than the
    distance.

    Args:
        a: solid in its own frame.
        b: the other, in its own frame.

    Returns:
        A function of the vector from b's origin to a's (3,) [mm] and of the orientations
        of a and b (3, 3), None for a body that never turns.
    """
    import fcl

    request = fcl.DistanceRequest(enable_nearest_points=True)
    shape_a, shift_a = _as_fcl(a)
    shape_b, shift_b = _as_fcl(b)
    still_b = fcl.CollisionObject(shape_b, fcl.Transform(_IDENTITY, shift_b))

    def separate(
        offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        """Compute the separation of the two solids in a pose; thread-safe.

        The gap is never more than the distance. fcl proposes the normal; where the slab
        is thinner than its distance by more than `MAX_DEFICIT_MM` it is improved.

        Args:
            offset: from b's origin to a's (3,) [mm].
            turn_a, turn_b: orientations (3, 3); None for a body that never turns.

        Returns:
            Gap [mm] and unit normal (3,) from b to a; `_TOUCHING`, a gap of 0 and no
            meaningful normal, for solids that touch or overlap.
        """
        # Nothing is shared that changes: several threads may call at once.
        ra, rb = (_IDENTITY if turn is None else turn for turn in (turn_a, turn_b))
        object_a = fcl.CollisionObject(shape_a, fcl.Transform(ra, offset + ra @ shift_a))
        object_b = still_b
        if turn_b is not None:
            object_b = fcl.CollisionObject(shape_b, fcl.Transform(rb, rb @ shift_b))
        result = fcl.DistanceResult()
        distance = fcl.distance(object_a, object_b, request, result)
        # Not `<=`: whatever else fcl may return, nan too, counts as a touch.
        if not distance > 0.0:
            return _TOUCHING
        on_a, on_b = result.nearest_points
        difference = on_a - on_b
        length = math.sqrt(difference @ difference)
        if length == 0.0:
            return _TOUCHING
        normal = difference / length
        # The empty slab across the normal: no two points are nearer than it is wide.
        gap = float(normal @ offset - a.support(-normal @ ra) - b.support(normal @ rb))
        if gap < distance - MAX_DEFICIT_MM:
            gap, normal = _improved(a, b, (gap, normal), offset, ra, rb)
        return (gap, normal) if gap > 0.0 else _TOUCHING

    return separate


def _improved(
    a: ConvexSolid,
    b: ConvexSolid,
    found: Separation,
    offset: FloatArray,
    ra: FloatArray,
    rb: FloatArray,
) -> Separation:
    """Improve a certificate by Gilbert's search for the nearest point of the hull of all
    differences.

    It stops within `MAX_DEFICIT_MM` of the distance, after `MAX_SEARCH_STEPS`, or where
    the least squares fail. fcl is off by millimeters where two edges are parallel, as
    those of upright boxes are.

    Args:
        a, b: the solids.
        found: certificate to improve.
        offset: from b's origin to a's (3,) [mm].
        ra, rb: orientations of a and b (3, 3).

    Returns:
        Gap [mm] and normal (3,); never a worse one than `found`.
    """
    from scipy.optimize import nnls

    normal = found[1]
    corners = []
    for _ in range(MAX_SEARCH_STEPS):
        corners.append(
            offset + ra @ a.farthest(-normal @ ra) - rb @ b.farthest(normal @ rb)
        )
        found = max(found, (float(normal @ corners[-1]), normal), key=lambda f: f[0])
        # The hull's point nearest to the origin: least squares with weights that add up to one.
        points = np.array(corners).T
        system = np.vstack([points, np.full(len(corners), 100.0)])
        try:
            weights, _ = nnls(system, [0.0, 0.0, 0.0, 100.0])
        except (
            RuntimeError
        ):  # not within its rounds: the last result is a certificate, too
            break
        nearest = points @ weights / weights.sum()
        length = math.sqrt(nearest @ nearest)
        if length - max(found[0], 0.0) < MAX_DEFICIT_MM:
            break
        normal = nearest / length
    return found


def _as_fcl(solid: ConvexSolid) -> tuple[Any, FloatArray]:
    """Make fcl's shape of a cylinder or polytope.

    Args:
        solid: in its own frame.

    Returns the shape, and its own center in the solid's frame (3,) [mm]; the origin for a
    polytope.
    Raises TypeError: neither cylinder nor polytope.
    """
    import fcl

    match solid:
        case UprightCylinder(center, radius, height):
            return fcl.Cylinder(radius, height), np.array(center)
        case Polytope():
            counts = np.full((len(solid.faces), 1), 3, dtype=np.int32)
            faces = np.concatenate([counts, solid.faces], axis=1).ravel()
            return fcl.Convex(np.array(solid.vertices), len(solid.faces), faces), _ORIGIN
    raise TypeError(f"no collision shape for {type(solid).__name__}")
