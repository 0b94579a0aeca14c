"""The look-ahead of the scanner: given where every motor is bound, the first contact or None.

A guard belongs to one scene: another sample, profile or correction is another guard. Bodies that
overlap already (after a restart) may only come apart: see `leaving`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from flexdt.twin.collision.collision_scene import Scene
from flexdt.twin.collision.leaving import leaving
from flexdt.twin.collision.paths import path_of, standing, table_of
from flexdt.twin.collision.scene_search import Contact, first_contact, touching
from flexdt.twin.motion.profiles import Trajectory

HORIZON = 3600.0
"""A motion without an end (a jog that is held) is looked at so far ahead [s]."""


@dataclass(frozen=True)
class SceneGuard:
    """Sweeps one scene; it keeps nothing between calls, so that threads may share it."""

    scene: Scene

    def __call__(self, trajectories: Mapping[str, Trajectory], now: float) -> Contact | None:
        """The first contact from `now` on; when nothing moves, the nearest pair that touches.

        Args:
            trajectories: motor -> trajectory; motors left out stand at home.
            now: since when [s].
        """
        scene = self.scene
        ends = [t.end if math.isfinite(t.end) else now + HORIZON for t in trajectories.values()]
        tables = {
            name: table_of(trajectories[name]) if name in trajectories else standing(home)
            for name, home in zip(scene.axes, scene.home.tolist(), strict=True)
        }
        path = path_of(scene.axes, tables, now, max([now, *ends]))
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

    def touching(self, positions: Mapping[str, float]) -> dict[tuple[str, str], float]:
        """Pairs of a pose that are within the safety margin, with their clearances [mm].

        Args:
            positions: motor -> position; motors left out stand at home [mm, deg].
        """
        out: dict[tuple[str, str], float] = {}
        for pair, gap in touching(self.scene, positions):  # a sample may be several bodies
            out[pair] = min(gap, out.get(pair, math.inf))
        return out


def scene_guard(scene: Scene) -> SceneGuard:
    """A guard that sweeps `scene`."""
    return SceneGuard(scene)
