"""The look-ahead of the scanner: given where every motor is bound, the first contact or None.

A `SceneGuard` belongs to one scene: another sample, profile or correction is another
guard. Bodies that overlap already may only come apart (`retreat.py`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from flexdt.twin.collision.collision_scene import CollisionScene
from flexdt.twin.collision.first_contact import bodies_touching, first_contact
from flexdt.twin.collision.retreat import _Overlap, leaving
from flexdt.twin.motion.profiles import Trajectory
from flexdt.twin.scanner.safety import Contact

HORIZON_S = 3600.0
"""Time ahead for which a motion without an end (a jog that is held) is swept [s]."""


@dataclass(frozen=True)
class SceneGuard:
    """Sweeps one scene; it keeps no state between calls, so that threads may share it."""

    scene: CollisionScene

    def __call__(
        self, trajectories: Mapping[str, Trajectory], now: float
    ) -> Contact | None:
        """Find the first contact from `now` on; when nothing moves, the nearest pair that
        is within the margin.

        Motion without an end is swept for `HORIZON_S`. Pairs that overlap at the start
        stop only motion that brings them closer (`leaving`).

        Args:
            trajectories: motor -> trajectory; motors left out are at home.
            now: since when [s].

        Returns:
            The contact, or None for a free motion. When nothing moves it is at `now`,
            with `free_before` False.
        """
        scene = self.scene
        ends = [
            t.end if math.isfinite(t.end) else now + HORIZON_S
            for t in trajectories.values()
        ]
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

    def standing(self, positions: Mapping[str, float]) -> SceneGuard:
        """Return a guard with the turntable's stages fixed at positions [mm, deg].

        Contacts are then this pose's.
        """
        parts = self.scene.parts
        if parts is None or not parts.mounts:
            return self
        return SceneGuard(parts.at(positions))

    def touching(
        self, positions: Mapping[str, float], *, deep: bool = False
    ) -> dict[tuple[str, str], float]:
        """Find the pairs of a pose within the safety margin, with their clearances [mm].

        Of several bodies of one name the nearest counts; without `deep` an overlap is 0.

        `positions`: motor -> position; motors left out are at home. `deep`: measure overlaps, as
        negative clearances; it takes some milliseconds a pair.
        Returns names -> clearance.
        """
        scene = self.scene
        q = self.scene.vector(positions)
        out: dict[tuple[str, str], float] = {}
        for pair, gap in bodies_touching(scene, q):  # a sample may be several bodies
            if deep and gap <= 0.0:
                a, b = (scene.bodies[i] for i in pair)
                gap = min(0.0, _Overlap.at(a, b, q).separation(q))
            out[scene.names(pair)] = min(gap, out.get(scene.names(pair), math.inf))
        return out
