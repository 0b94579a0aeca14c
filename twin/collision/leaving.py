"""The way out for bodies that overlap already: any motion in which they only come apart.

A sweep cannot say how deep two bodies overlap, so a motion that begins in an overlap would always
be a contact, retreating included. Here such a pair is followed by how far its boxes (along the
world's axes) are apart, negative for an overlap: as long as that never decreases the motion is a
retreat, and from the moment the pair is free the usual margin holds for it again. All other pairs
keep the margin throughout. It refuses to judge motions that do not begin in an overlap.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexdt.twin.collision.bodies import Body
from flexdt.twin.collision.paths import Path
from flexdt.twin.collision.scene import Scene
from flexdt.twin.collision.search import Contact, Pair, first_contact, separation_at
from flexdt.twin.conventions import FloatArray

STEPS = 400
"""Moments looked at along the motion, besides the ends of its segments."""
SLACK_MM = 1e-6
"""Rounding allowed in a distance that must not decrease."""


def leaving(scene: Scene, path: Path) -> Contact | None:
    """The first contact of a motion that begins with bodies overlapping, or None.

    Args:
        scene: what may touch what.
        path: the motion.
    """
    start = path.q[0]
    limit = scene.limits.margin + scene.limits.tolerance
    stack = scene.candidates(path.q.min(axis=0), path.q.max(axis=0))
    near = np.flatnonzero(stack.clearances(start, start) <= limit).tolist()
    stuck = [p for p in (stack.pairs[k] for k in near) if separation_at(scene, p, start) <= 0.0]
    others = first_contact(_without(scene, stuck), path)
    found = [c for pair in stuck if (c := _of_pair(scene, path, pair)) is not None]
    contacts = [*found, *([] if others is None else [others])]
    return min(contacts, key=lambda contact: contact.time, default=None)


def _of_pair(scene: Scene, path: Path, pair: Pair) -> Contact | None:
    """What stops one overlapping pair: coming closer, or touching again once free."""
    a, b = (scene.bodies[i] for i in pair)
    steps = np.linspace(path.times[0], path.times[-1], STEPS)
    times = np.unique(np.concatenate([path.times, steps]))
    limit = scene.limits.margin + scene.limits.tolerance
    farthest, last = -np.inf, float(times[0])
    for time, q in zip(times.tolist(), path.vectors(times), strict=True):
        apart = _boxes_apart(a, b, q)
        if apart < farthest - SLACK_MM:
            here = path.positions(last)
            return Contact(scene.names(pair), time, here, here, last, 0.0, free_before=False)
        farthest, last = max(farthest, apart), time
        if separation_at(scene, pair, q) > limit and time < float(path.times[-1]):
            alone = replace(scene, pairs=(pair,), distant=())
            return first_contact(alone, path.after(time))
    return None


def _without(scene: Scene, pairs: list[Pair]) -> Scene:
    left_out = set(pairs)
    return replace(
        scene,
        pairs=tuple(p for p in scene.pairs if p not in left_out),
        distant=tuple(p for p in scene.distant if p not in left_out),
    )


def _boxes_apart(a: Body, b: Body, q: FloatArray) -> float:
    """How far the bodies' boxes along the world's axes are apart [mm]; negative: overlap."""
    (low_a, high_a), (low_b, high_b) = _box(a, q), _box(b, q)
    return float(np.maximum(low_a - high_b, low_b - high_a).max())


def _box(body: Body, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    origin = q @ body.slides + body.origin
    turn = body.rotation(float(q @ body.turns)) if body.spins else np.eye(3)
    low = np.array([-body.solid.support(-row) for row in turn])
    high = np.array([body.solid.support(row) for row in turn])
    return origin + low, origin + high
