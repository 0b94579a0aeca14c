"""Time against the number of rays, voxels along an edge and threads.

The points of a curve are timed in rotation, so that a disturbance affects all of them alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexdt.server.bench.cases import BINNED, C1_SHAPE, NONE, TILT_DEG, circle, noise
from flexdt.server.bench.measure import interleaved
from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, forward

Entry = dict[str, Any]

SERIES = (("level", NONE), ("tilted", TILT_DEG))
"""The detector's tilt of each curve."""


@dataclass(frozen=True)
class Point:
    """A point of a curve: which curve, where on it, what is timed, how many views that makes."""

    series: str
    x: int
    call: Callable[[], object]
    views: int = 1


def rays() -> list[Entry]:
    """Time against the number of rays, C1's volume."""
    volume = noise(C1_SHAPE)
    points: list[Point] = []
    for name, tilt in SERIES:
        for factor in (8, 4, 2, 1, 0.5, 0.25):
            shape = (round(760 / factor), round(956 / factor))
            view = circle(1, shape, pitch=0.1496 * factor, tilt_deg=tilt)
            points.append(Point(name, shape[0] * shape[1], _forward(volume, view, shape)))
    return _curve(points)


def voxels() -> list[Entry]:
    """Time against voxels a side: the same field of view in smaller voxels, as many rays."""
    points: list[Point] = []
    for side in (32, 64, 128, 256, 384, 512):
        volume = noise((side,) * 3, 51.2 / side)
        for name, tilt in SERIES:
            view = circle(1, BINNED, tilt_deg=tilt)
            points.append(Point(name, side, _forward(volume, view, BINNED)))
    return _curve(points)


def threads() -> list[Entry]:
    """Time a view against threads, C1: one view, and 36 in one call."""
    import numba

    before = numba.get_num_threads()
    volume = noise(C1_SHAPE)
    points: list[Point] = []
    for views, label in ((1, ""), (36, ", 36 views")):
        for name, tilt in SERIES:
            call = _forward(volume, circle(views, BINNED, tilt_deg=tilt), BINNED)
            count = 1
            while count <= before:

                def on(count: int = count, call: Callable[[], object] = call) -> None:
                    numba.set_num_threads(count)
                    call()

                points.append(Point(name + label, count, on, views))
                count *= 2
    try:
        return _curve(points)
    finally:
        numba.set_num_threads(before)


def _forward(volume: Volume, view: ConeVec, shape: tuple[int, int]) -> Callable[[], object]:
    out = np.empty((len(view), *shape), np.float32)
    return lambda: forward(volume, view, shape, out)


def _curve(points: Sequence[Point]) -> list[Entry]:
    """Best times a view of all points, taken turn by turn: what disturbs one disturbs all."""
    timing = interleaved({f"{i}": point.call for i, point in enumerate(points)}, budget_s=3.0)
    return [
        {"series": point.series, "x": point.x, "ms": timing[f"{i}"].best * 1e3 / point.views}
        for i, point in enumerate(points)
    ]
