"""The look-ahead of the scanner: given where every motor is bound, the first contact or None.

A guard belongs to one scene: another sample, profile or correction is another guard. Bodies that
overlap already (after a restart) may only come apart: a retreat.

A sweep cannot measure how deep two bodies overlap, so every motion that begins in an overlap would
be a contact, a retreat included. Here such a pair is judged by its separation: the gap between the
two bodies across a direction, the widest of all directions, negative for an overlap. Where the
motion begins it is exact, from the faces of the bodies' Minkowski difference; later the same
directions are looked at, standing and turning with either body, which can only make the separation
seem less than it is. As long as it keeps to its floor the motion is a retreat, and from the moment
the pair is free the usual margin applies to it again. All other pairs keep the margin throughout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.convex_solids import ConvexSolid, Polytope, UprightCylinder
from flexdt.twin.collision.paths import Path
from flexdt.twin.collision.scene_search import (
    Pair,
    bodies_touching,
    first_contact,
    separation_at,
)
from flexdt.twin.collision.stages import Body
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.safety import Contact, floor

STEPS = 400
"""Moments looked at along the motion, besides the ends of its segments."""
GRAZING_MM = 1e-3
"""Pairs this near are judged as overlapping ones: their direction is rounding in a sweep."""
MANY = 100
"""Corners of a body beyond which not all of their directions are looked at (a mesh has thousands,
and the directions of a pair grow with the product): some, and the best one, refined."""
REFINEMENTS = 40
"""Halvings of the step in which the direction of a round body's least overlap is looked for."""


def leaving(scene: CollisionScene, path: Path) -> Contact | None:
    """The first contact of a motion that begins with bodies overlapping, or None.

    Args:
        scene: what may touch what.
        path: the motion.
    """
    stuck = [pair for pair, gap in bodies_touching(scene, path.q[0]) if gap <= GRAZING_MM]
    others = first_contact(_without(scene, stuck), path)
    found = [c for pair in stuck if (c := _of_pair(scene, path, pair)) is not None]
    contacts = [*found, *([] if others is None else [others])]
    return min(contacts, key=lambda contact: contact.time, default=None)


def _of_pair(scene: CollisionScene, path: Path, pair: Pair) -> Contact | None:
    """What stops one overlapping pair: coming closer, or touching again once free."""
    a, b = (scene.bodies[i] for i in pair)
    overlap = _Overlap.at(a, b, path.q[0])
    steps = np.linspace(path.times[0], path.times[-1], STEPS)
    times = np.unique(np.concatenate([path.times, steps]))
    limit = scene.limits.margin + scene.limits.tolerance
    least, last = -np.inf, float(times[0])
    for time, q in zip(times.tolist(), path.vectors(times), strict=True):
        apart = overlap.separation(q)
        if apart < least:
            here = path.positions(last)
            return Contact(scene.names(pair), time, here, here, last, 0.0, free_before=False)
        least, last = max(least, floor(apart, scene.limits.margin)), time
        if separation_at(scene, pair, q) > limit and time < float(path.times[-1]):
            alone = replace(scene, pairs=(pair,), distant=())
            return first_contact(alone, path.after(time))
    return None


def _without(scene: CollisionScene, pairs: list[Pair]) -> CollisionScene:
    left_out = set(pairs)
    return replace(
        scene,
        pairs=tuple(p for p in scene.pairs if p not in left_out),
        distant=tuple(p for p in scene.distant if p not in left_out),
    )


@dataclass(frozen=True, eq=False)
class _Overlap:
    """Two bodies that overlap at the beginning, and the directions across which they may part.

    Attributes:
        bodies: the two.
        turned: their orientations at the beginning, (3, 3) each.
        directions: (k, 3) unit directions in the world then, from the second to the first.
    """

    bodies: tuple[Body, Body]
    turned: tuple[FloatArray, FloatArray]
    directions: FloatArray

    @classmethod
    def at(cls, a: Body, b: Body, q: FloatArray) -> _Overlap:
        """The overlap with the motors at `q` (axes,)."""
        from scipy.spatial import ConvexHull

        (turn_a, at_a), (turn_b, at_b) = _pose(a, q), _pose(b, q)
        corners_a = _corners(a.solid) @ turn_a.T + (at_a - at_b)
        corners_b = _corners(b.solid) @ turn_b.T
        between = (corners_a[:, None] - corners_b[None]).reshape(-1, 3)
        outward = np.unique(ConvexHull(between).equations[:, :3].round(9), axis=0)
        outward /= np.linalg.norm(outward, axis=1)[:, None]
        overlap = cls((a, b), (turn_a, turn_b), -outward)
        return replace(overlap, directions=np.vstack([overlap.directions, overlap._refined(q)]))

    @cached_property
    def _reach(self) -> tuple[FloatArray, FloatArray]:
        """(k,) each: how far either body reaches across the directions that turn with it [mm]."""
        first, second = (self._reach_of(i, self.directions, self.turned) for i in (0, 1))
        return first, second

    def _reach_of(
        self, i: int, directions: FloatArray, turned: tuple[FloatArray, FloatArray]
    ) -> FloatArray:
        towards = directions if i else -directions
        return self.bodies[i].solid.support(towards @ turned[i])

    def separation(self, q: FloatArray) -> float:
        """Width of the widest slab between them [mm]; negative for an overlap, never too large.

        Looked at are directions that turn with either body. How far that body reaches across them
        does not change, so that one of many corners costs no more than another.
        """
        (turn_a, at_a), (turn_b, at_b) = (_pose(body, q) for body in self.bodies)
        turned = turn_a, turn_b
        turns = not all(map(np.array_equal, turned, self.turned))
        widest = -np.inf
        for i in (0, 1) if turns else (0,):
            if turns and _many(self.bodies[1 - i].solid):
                continue
            now = self.directions @ (turned[i] @ self.turned[i].T).T
            other = self._reach_of(1 - i, now, turned) if turns else self._reach[1 - i]
            gaps = now @ (at_a - at_b) - self._reach[i] - other
            widest = max(widest, float(gaps.max()))
        return widest

    def _refined(self, q: FloatArray) -> FloatArray:
        """(1, 3): the direction of the widest gap, where no faces tell it exactly."""
        (_, at_a), (_, at_b) = (_pose(body, q) for body in self.bodies)

        def gaps(directions: FloatArray) -> FloatArray:
            reach = self._reach_of(0, directions, self.turned)
            return directions @ (at_a - at_b) - reach - self._reach_of(1, directions, self.turned)

        best = self.directions[int(np.argmax(gaps(self.directions)))]
        step = 0.1
        for _ in range(REFINEMENTS):
            around = np.vstack([best, best + step * np.eye(3), best - step * np.eye(3)])
            around /= np.linalg.norm(around, axis=1)[:, None]
            widest = int(np.argmax(gaps(around)))
            best = around[widest]
            step *= 0.7 if widest == 0 else 1.0
        return np.asarray(best[None])


def _pose(body: Body, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    turn = body.rotation(float(q @ body.turns)) if body.spins else np.eye(3)
    return turn, q @ body.slides + body.origin


def _many(solid: ConvexSolid) -> bool:
    return isinstance(solid, Polytope) and len(solid.vertices) > MANY


def _corners(solid: ConvexSolid) -> FloatArray:
    """(k, 3): corners of a body, of one with very many only some."""
    if _many(solid):
        ways = np.random.default_rng(0).normal(size=(MANY, 3))
        return np.unique(solid.farthest(ways), axis=0)
    upright = solid.prism() if isinstance(solid, UprightCylinder) else solid
    assert isinstance(upright, Polytope)
    return upright.vertices


HORIZON = 3600.0
"""A motion without an end (a jog that is held) is looked at so far ahead [s]."""


@dataclass(frozen=True)
class SceneGuard:
    """Sweeps one scene; it keeps nothing between calls, so that threads may share it."""

    scene: CollisionScene

    def __call__(self, trajectories: Mapping[str, Trajectory], now: float) -> Contact | None:
        """The first contact from `now` on; when nothing moves, the nearest pair that touches.

        Args:
            trajectories: motor -> trajectory; motors left out stand at home.
            now: since when [s].
        """
        scene = self.scene
        ends = [t.end if math.isfinite(t.end) else now + HORIZON for t in trajectories.values()]
        path = scene.path(trajectories, now, max([now, *ends]))
        if path.moving.any():
            contact = first_contact(scene, path)
            if contact is None or contact.free_before:
                return contact
            return leaving(scene, path)
        here = path.positions(now)
        near = self.touching(here)
        if not near:
            return None
        pair = min(near, key=lambda names: near[names])
        return Contact(pair, now, here, here, now, near[pair], free_before=False)

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> dict[tuple[str, str], float]:
        """Pairs of a pose that are within the safety margin, with their clearances [mm].

        Args:
            positions: motor -> position; motors left out stand at home [mm, deg].
            deep: measure overlaps, as negative clearances; it takes some milliseconds a pair.
        """
        scene, q = self.scene, self.scene.vector(positions)
        out: dict[tuple[str, str], float] = {}
        for pair, gap in bodies_touching(scene, q):  # a sample may be several bodies
            if deep and gap <= 0.0:
                a, b = (scene.bodies[i] for i in pair)
                gap = min(0.0, _Overlap.at(a, b, q).separation(q))
            out[scene.names(pair)] = min(gap, out.get(scene.names(pair), math.inf))
        return out
