"""The distance of two convex solids with a certificate; the one module that wraps python-fcl.

fcl proposes the nearest points; the clearance that counts is then computed from the two solids'
supports along that direction, a lower bound of the true distance whatever fcl said. So an error of
the library can stop a motion too early but never call a touch free. fcl is imported when the first
pair is made. Its continuous collision (which misses contacts) is not used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flexdt.twin.collision.convex_solids import Cylinder, Polytope, Solid
from flexdt.twin.geometry.conventions import FloatArray

Separation = tuple[float, FloatArray]
"""Certified clearance [mm], 0 when they touch or overlap, and the unit direction from b to a."""

_IDENTITY = np.eye(3)
_ORIGIN = np.zeros(3)
_NOWHERE: Separation = (0.0, np.array([0.0, 0.0, 1.0]))
DOUBT = 1e-5
"""A certificate this far below fcl's distance [mm] is tried across other directions."""
SNAP = 0.01
"""Components of a direction below this may be fcl's inaccuracy (with cylinders it has some)."""


def separation_of(
    a: Solid, b: Solid
) -> Callable[[FloatArray, FloatArray | None, FloatArray | None], Separation]:
    """A function that separates `a` from `b`.

    Returns:
        A function of the vector from b's origin to a's (3,) [mm] and of the orientations of a and
        b (3, 3), None for a body that never turns.
    """
    import fcl

    request = fcl.DistanceRequest(enable_nearest_points=True)
    shape_a, shift_a = _as_fcl(a)
    shape_b, shift_b = _as_fcl(b)
    still_b = fcl.CollisionObject(shape_b, fcl.Transform(_IDENTITY, shift_b))

    def separate(
        offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        # Nothing is shared that changes: several threads may ask at once.
        ra = _IDENTITY if turn_a is None else turn_a
        object_a = fcl.CollisionObject(shape_a, fcl.Transform(ra, offset + ra @ shift_a))
        object_b = still_b
        if turn_b is not None:
            object_b = fcl.CollisionObject(shape_b, fcl.Transform(turn_b, turn_b @ shift_b))
        result = fcl.DistanceResult()
        distance = fcl.distance(object_a, object_b, request, result)
        if not distance > 0.0:
            return _NOWHERE
        on_a, on_b = result.nearest_points
        apart = on_a - on_b
        length = math.sqrt(apart @ apart)
        if length == 0.0:
            return _NOWHERE
        normal = apart / length
        gap = _gap(a, b, normal, offset, turn_a, turn_b)
        if gap < distance - DOUBT:
            for other in _second_guesses(normal):
                wider = _gap(a, b, other, offset, turn_a, turn_b)
                if wider > gap:
                    gap, normal = wider, other
        return (gap, normal) if gap > 0.0 else _NOWHERE

    return separate


def _gap(
    a: Solid,
    b: Solid,
    normal: FloatArray,
    offset: FloatArray,
    turn_a: FloatArray | None,
    turn_b: FloatArray | None,
) -> float:
    """Width of the empty slab between them across `normal`: no two points are nearer than that."""
    in_a = -normal if turn_a is None else -normal @ turn_a
    in_b = normal if turn_b is None else normal @ turn_b
    return float(normal @ offset) - a.support(in_a) - b.support(in_b)


def _second_guesses(normal: FloatArray) -> list[FloatArray]:
    """Directions that fcl may have meant: small components zero; nearest points swapped."""
    snapped = np.where(np.abs(normal) < SNAP, 0.0, normal)
    snapped /= math.sqrt(snapped @ snapped)
    return [snapped, -normal]


def _as_fcl(solid: Solid) -> tuple[Any, FloatArray]:
    """fcl's shape and where its own centre lies in the solid's frame."""
    import fcl

    match solid:
        case Cylinder(center, radius, height):
            return fcl.Cylinder(radius, height), np.array(center)
        case Polytope():
            counts = np.full((len(solid.faces), 1), 3, dtype=np.int32)
            faces = np.concatenate([counts, solid.faces], axis=1).ravel()
            return fcl.Convex(np.array(solid.vertices), len(solid.faces), faces), _ORIGIN
    raise TypeError(f"no collision shape for {type(solid).__name__}")
