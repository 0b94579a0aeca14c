"""The look-ahead of the scanner: given where every motor is bound, the first contact or None.

A guard is a function for `ScannerTwin`, made anew when the sample or the profile changes. Bodies
that overlap already (after a restart) may only come apart: see `leaving`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from flexdt.twin.collision.leaving import leaving
from flexdt.twin.collision.paths import path_of, standing, table_of
from flexdt.twin.collision.scene import Scene
from flexdt.twin.collision.search import Contact, first_contact, touching
from flexdt.twin.motion import Trajectory

HORIZON = 3600.0
"""A motion without an end (a jog that is held) is looked at so far ahead [s]."""

Guard = Callable[[Mapping[str, Trajectory], float], Contact | None]


def scene_guard(scene: Scene) -> Guard:
    """A guard that sweeps `scene`; when nothing moves, it tells what touches already."""

    def guard(trajectories: Mapping[str, Trajectory], now: float) -> Contact | None:
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
        found = touching(scene, here)
        if not found:
            return None
        pair, clearance = min(found, key=lambda near: near[1])
        return Contact(pair, now, here, here, now, clearance, free_before=False)

    return guard
