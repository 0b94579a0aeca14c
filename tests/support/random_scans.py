"""Random scans: any place of source, axis and panel, any correction, any angles."""

from __future__ import annotations

import numpy as np

from flexdt.twin.geometry.conventions import FloatArray, turn_detector
from flexdt.twin.geometry.offsets import UNITS, Offsets
from flexdt.twin.geometry.poses import Poses

SHAPE = (76, 96)
PITCH = 0.7
# No mirror image of these points can be turned into themselves.
CHIRAL = np.array(
    [[0, 0, 0], [14, 0, 0], [0, 9, 0], [0, 0, 5], [6, -4, 11], [-8, 3, -12.0]]
)


def some_parameters(rng: np.random.Generator, size: float = 1.0) -> Offsets:
    """A correction with every parameter at work: some mm and degrees."""
    edge = {name: float(rng.normal(0.0, size)) for name in UNITS}
    return Offsets.from_edge(edge | {"angle_scale": 1.0 + 0.01 * edge["angle_scale"]})


def some_poses(
    rng: np.random.Generator, views: int = 7, *, even: bool = True, still: bool = True
) -> Poses:
    """Draw a scan of up to about 2.5 rad a view about an upright axis.

    Args:
        rng: draws all.
        views: how many.
        even: steps of angle are equal; otherwise each is drawn.
        still: source, detector and axis stay; otherwise each is elsewhere in each view.
    """
    sign = rng.choice([-1, 1])
    start, turn = rng.uniform(-9, 9), sign * rng.uniform(0.5, 2.5 * views)
    angle = np.linspace(start, start + turn, views)
    if not even:
        angle = start + np.cumsum(rng.uniform(0.01, 2.9, views)) * sign
    wander = np.zeros((3, views, 3)) if still else rng.normal(0.0, 3.0, (3, views, 3))
    roll = float(rng.normal(0.0, 0.01))
    u, v = turn_detector([PITCH, 0, 0], [0, 0, -PITCH], 0.0, 0.0, roll)
    return Poses(
        rng.normal(0, 20, 3) + wander[0],
        rng.normal(0, 20, 3) + [0, rng.uniform(200, 700), 0] + wander[1],
        rng.normal(0, 20, 3) + [0, rng.uniform(900, 1200), 0] + wander[2],
        u[None],
        v[None],
        angle,
    )


def worst(a: FloatArray, b: FloatArray) -> float:
    """Largest difference."""
    assert a.shape == b.shape
    return float(np.abs(a - b).max())
