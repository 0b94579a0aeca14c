"""Bodies that overlap already (after a restart) may only come apart: a retreat.

A sweep cannot measure how deep two bodies overlap, so every motion that begins in an
overlap would be a contact, a retreat included. Here such a pair is judged by its
separation: the gap between the two bodies across a direction, the widest of all
directions, negative for an overlap. Where the motion begins it is exact, from the faces
of the bodies' Minkowski difference; later the same directions are looked at, standing and
turning with either body, which can only make the separation seem less than it is. As long
as it keeps to its floor the motion is a retreat, and from the moment the pair is free the
usual margin applies to it again. All other pairs keep the margin throughout.

Both moments are found by conservative advancement, so that none is stepped over: the
separation is evaluated again where it may have fallen to the floor, the distance where it
may have grown to that of a free pair.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.collision.first_contact import Pair, bodies_touching, first_contact
from flexdt.twin.collision.relative import (
    START,
    Limits,
    Moment,
    Path,
    RelativeMotion,
    Separate,
)
from flexdt.twin.collision.separation import Separation
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.scanner.safety import ROUNDING_MM, Contact, floor

GRAZING_MM = 1e-3
"""Pairs this near are judged as overlapping: their direction is rounding in a sweep [mm]."""
ORIENTATION_ROUNDING = 1e-12
"""Largest change of an orientation that is rounding."""
MAX_EXACT_CORNERS = 100
"""Corners of a body beyond which only some of their directions are used, the best one refined.

A mesh has thousands, and the directions of a pair grow with the product.
"""
REFINEMENT_STEPS = 40
"""Steps of the search for the direction of a round body's least overlap."""


def leaving(scene: CollisionScene, path: Path) -> Contact | None:
    """Find the first contact of a motion that begins with bodies overlapping; None for a
    retreat.

    Pairs up to `GRAZING_MM` apart count as overlapping: they stop only what brings them closer,
    or touches again once they were free (`_pair_contact`). All others keep the margin.
    `scene`: bodies and pairs that must not touch; `path`: the motion.
    """
    stuck = [pair for pair, gap in bodies_touching(scene, path.q[0]) if gap <= GRAZING_MM]
    others = first_contact(_without(scene, stuck), path)
    stopping = [
        c for pair in stuck if (c := _pair_contact(scene, path, pair)) is not None
    ]
    contacts = [*stopping, *([] if others is None else [others])]
    return min(contacts, key=lambda contact: contact.time, default=None)


def _pair_contact(scene: CollisionScene, path: Path, pair: Pair) -> Contact | None:
    """Find the contact that stops one overlapping pair: coming closer, or coming to the
    margin again once free.

    A pair that comes free is then swept alone for its next contact.

    Args:
        scene: the bodies.
        path: of all motors.
        pair: of bodies that overlap at the beginning.

    Returns:
        The contact, with clearance 0 and the last evaluated position where they come
        closer; None if the bodies only come apart.
    """
    a, b = (scene.bodies[i] for i in pair)
    motion = RelativeMotion(a, b, path)
    overlap = _Overlap.at(a, b, path.q[0])
    deeper = _deeper(motion, overlap, scene.limits.margin)
    if deeper is None:
        until = math.inf
    else:
        until = motion.time(deeper[1])
    free = _free_from(motion, scene.separation(pair), scene.limits, until)
    if free is not None:
        pair_scene = replace(scene, pairs=(pair,), distant=())
        return first_contact(pair_scene, path.after(free))
    if deeper is None:
        return None
    last = motion.time(deeper[0])
    here = path.positions(last)
    return Contact(scene.names(pair), until, here, here, last, 0.0, free_before=False)


def _deeper(
    motion: RelativeMotion, overlap: _Overlap, margin: float
) -> tuple[Moment, Moment] | None:
    """Find when the separation of an overlapping pair falls to its floor.

    The floor (`safety.floor`) follows from the start and the margin [mm]. Returns the
    moment of the look before, and that of the fall; None for never.
    """
    look = motion.look(START, overlap.separate)
    level = floor(look.gap, margin)
    while (at := motion.next_at(look, level)) is not None:
        before = look.at
        look = motion.look(at, overlap.separate)
        if look.gap <= level + 0.5 * ROUNDING_MM:
            return before, at
    return None


def _free_from(
    motion: RelativeMotion, separate: Separate, limits: Limits, until: float
) -> float | None:
    """Find when the gap of two bodies exceeds margin plus tolerance, before the time `until`.

    It is looked at from the start, each time after the travel that could open it to margin plus
    two tolerances.

    Returns time of the first such look [s]; None if there is none.
    """
    at: Moment | None = START
    while at is not None and motion.time(at) < until:
        gap = motion.look(at, separate).gap
        if gap > limits.margin + limits.tolerance:
            return motion.time(at)
        at = motion.after_travel(at, limits.margin + 2.0 * limits.tolerance - gap)
    return None


def _without(scene: CollisionScene, pairs: list[Pair]) -> CollisionScene:
    """Copy a scene without some pairs, among those tested and among the distant ones."""
    left_out = set(pairs)
    return replace(
        scene,
        pairs=tuple(p for p in scene.pairs if p not in left_out),
        distant=tuple(p for p in scene.distant if p not in left_out),
    )


@dataclass(frozen=True, eq=False)
class _Overlap:
    """Two bodies that overlap at the beginning, and the directions across which
    they may separate.

    Attributes:
        bodies: the two.
        turned: their orientations at the beginning, (3, 3) each.
        directions: (k, 3) unit directions in the world then, from the second to the
            first.
    """

    bodies: tuple[Body, Body]
    turned: tuple[FloatArray, FloatArray]
    directions: FloatArray

    @classmethod
    def at(cls, a: Body, b: Body, q: FloatArray) -> _Overlap:
        """Find the directions in which two overlapping bodies are to come apart.

        They are the inward face normals of the bodies' Minkowski difference, and a
        refined one from the best of them (`_refined`). Bodies of many corners are
        simplified for that (`_corners`).

        Args:
            a, b: the bodies.
            q: positions of all motors (axes,) [mm, deg].
        """
        from scipy.spatial import ConvexHull

        (turn_a, at_a), (turn_b, at_b) = _pose(a, q), _pose(b, q)
        corners_a = _corners(a.solid) @ turn_a.T + (at_a - at_b)
        corners_b = _corners(b.solid) @ turn_b.T
        between = (corners_a[:, None] - corners_b[None]).reshape(-1, 3)
        outward = np.unique(ConvexHull(between).equations[:, :3].round(9), axis=0)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        overlap = cls((a, b), (turn_a, turn_b), -outward)
        return replace(
            overlap, directions=np.vstack([overlap.directions, overlap._refined(q)])
        )

    @cached_property
    def _reach(self) -> tuple[FloatArray, FloatArray]:
        """Extents of either body across the directions that turn with it, (k,) each [mm]."""
        first, second = (self._reach_of(i, self.directions, self.turned) for i in (0, 1))
        return first, second

    def _reach_of(
        self, i: int, directions: FloatArray, turned: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        """Compute how far body `i` extends towards the other, (k,) [mm]."""
        towards = directions if i else -directions
        return self.bodies[i].solid.support(towards @ turned[i])

    def separate(
        self, offset: FloatArray, turn_a: FloatArray | None, turn_b: FloatArray | None
    ) -> Separation:
        """Compute the widest slab between the bodies [mm] and its direction (3,) from b
        to a, as `relative.Separate`.

        The width is negative for an overlap, and never too large. Tried are the
        directions, turned with either body since the beginning; not with one if the other
        has many corners (`_many`), so that one of many corners costs no more than
        another.

        Args:
            offset: from b's origin to a's (3,) [mm].
            turn_a: orientation of a (3, 3); None for a body that never turns.
            turn_b: orientation of b, likewise.
        """
        turned = (
            np.eye(3) if turn_a is None else turn_a,
            np.eye(3) if turn_b is None else turn_b,
        )
        off = (
            np.abs(now - then).max()
            for now, then in zip(turned, self.turned, strict=True)
        )
        turns = max(off) > ORIENTATION_ROUNDING
        widest = -math.inf
        across = self.directions[0]
        for i in (0, 1) if turns else (0,):
            if turns and _many(self.bodies[1 - i].solid):
                continue
            now = self.directions @ (turned[i] @ self.turned[i].T).T
            if turns:
                other = self._reach_of(1 - i, now, turned)
            else:
                other = self._reach[1 - i]
            gaps = now @ offset - self._reach[i] - other
            best = int(np.argmax(gaps))
            if gaps[best] > widest:
                widest = float(gaps[best])
                across = now[best]
        return widest, across

    def separation(self, q: FloatArray) -> float:
        """Compute that width with the motors at `q` (axes,) [mm]."""
        (turn_a, at_a), (turn_b, at_b) = (_pose(body, q) for body in self.bodies)
        return self.separate(at_a - at_b, turn_a, turn_b)[0]

    def _refined(self, q: FloatArray) -> FloatArray:
        """Search for the direction of the widest gap, where no faces give it exactly:
        unit vector (1, 3).

        From the best of the known directions, in `REFINEMENT_STEPS` steps to the best of
        six neighbors along x, y, z; the step shrinks where none is better. A local
        search.

        Args:
            q: positions of all motors (axes,) [mm, deg].
        """
        (_, at_a), (_, at_b) = (_pose(body, q) for body in self.bodies)

        def gaps(directions: FloatArray) -> FloatArray:
            """Compute the signed gap between the bodies along unit directions (k, 3), (k,) [mm].

            Negative where they overlap along that direction.
            """
            reach = self._reach_of(0, directions, self.turned)
            return (
                directions @ (at_a - at_b)
                - reach
                - self._reach_of(1, directions, self.turned)
            )

        best = self.directions[int(np.argmax(gaps(self.directions)))]
        step = 0.1
        for _ in range(REFINEMENT_STEPS):
            around = np.vstack([best, best + step * np.eye(3), best - step * np.eye(3)])
            around /= np.linalg.norm(around, axis=1)[:, None]
            widest = int(np.argmax(gaps(around)))
            best = around[widest]
            step *= 0.7 if widest == 0 else 1.0
        return np.asarray(best[None])


def _pose(body: Body, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Compute a body's orientation (3, 3) and origin (3,) [mm] with the motors at `q` (axes,)."""
    if body.spins:
        turn = body.rotation(float(q @ body.turns))
    else:
        turn = np.eye(3)
    return turn, q @ body.slides + body.origin


def _many(solid: ConvexSolid) -> bool:
    """Return whether a solid is a polytope of more than `MAX_EXACT_CORNERS` corners."""
    return isinstance(solid, Polytope) and len(solid.vertices) > MAX_EXACT_CORNERS


def _corners(solid: ConvexSolid) -> FloatArray:
    """Return corners of a body in its own frame (k, 3) [mm]; of a cylinder those of a
    prism around it.

    A body with too many gives only those farthest along `MAX_EXACT_CORNERS` directions,
    always the same random ones.
    """
    if _many(solid):
        ways = np.random.default_rng(0).normal(size=(MAX_EXACT_CORNERS, 3))
        return np.unique(solid.farthest(ways), axis=0)
    upright = solid.prism() if isinstance(solid, UprightCylinder) else solid
    assert isinstance(upright, Polytope)
    return upright.vertices
