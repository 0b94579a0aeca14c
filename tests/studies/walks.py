"""How views are walked, timed: `python tests/studies/walks.py [--count 150] [--seed 1]`.

Volumes, detectors and sources are drawn: flat and long volumes, single rows, sources beside and
above, detectors turned about their normal. Each view is projected on one core in fans along z,
x and y, and ray by ray. Prints how much longer what `level_axes` chooses takes than the
quickest way (mean, 90 %), and how much shorter than fans along z always; and the geometries it
loses most at.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from functools import partial

import numba
import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.projection import Volume, cpu, operators
from flexdt.twin.projection.operators import box_of, voxel_rays

WAYS = ("along z", "along x", "along y", "ray by ray")


def drawn(draw: np.random.Generator) -> tuple[Volume, ConeVec, tuple[int, int]]:
    """Draw a volume, a view of it, and the panel's rows and columns."""
    sides = draw.integers(32, 257, 3)
    if draw.random() < 0.15:
        sides[draw.integers(3)] = draw.integers(1, 12)
    volume = Volume(draw.random(tuple(sides), dtype=np.float32), 25.6 / sides.max())
    rows = 1 if draw.random() < 0.2 else int(2 ** draw.uniform(0, 9.6))
    shape = (rows, int(2 ** draw.uniform(5, 9.9)))
    above = math.radians(
        draw.choice([0, 0, 10, 30, 45, 60, 80, 90]) + draw.choice([0, 1.3])
    )
    turn, roll = (
        draw.uniform(0, np.pi / 2),
        math.radians(draw.choice([0, 0, 0.4, 30, 90])),
    )
    beam = np.array([0, math.cos(above), -math.sin(above)])
    u, v = np.array([1.0, 0, 0]), np.array([0, -math.sin(above), -math.cos(above)])
    u, v = (
        math.cos(roll) * u + math.sin(roll) * v,
        math.cos(roll) * v - math.sin(roll) * u,
    )
    c, s = math.cos(turn), math.sin(turn)
    about = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    pitch = 60 / max(shape)
    vectors = [about @ x for x in (-600 * beam, 459 * beam, pitch * u, pitch * v)]
    return volume, ConeVec(np.concatenate(vectors)[None]), shape


def milliseconds(call: Callable[[], object]) -> float:
    """Least of what fits into 50 ms, at least three calls."""
    call()
    times: list[float] = []
    while len(times) < 3 or sum(times) < 0.05:
        begun = time.perf_counter()
        call()
        times.append(time.perf_counter() - begun)
    return 1e3 * min(times)


def main() -> None:
    """Time drawn views along each way, and print how good the choice was."""
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--count", type=int, default=150)
    p.add_argument("--seed", type=int, default=1)
    options = p.parse_args()
    numba.set_num_threads(1)
    draw = np.random.default_rng(options.seed)
    rows: list[tuple[float, float, str]] = []
    for _ in range(options.count):
        volume, geometry, shape = drawn(draw)
        rays = geometry.rays(shape) / volume.voxel_xyz[0]
        chosen = int(operators.level_axes(rays, volume.shape, shape)[0])
        out = np.empty((1, *shape), np.float32)
        times = []
        for way in range(4):
            order = operators.ORDERS[way % 3]
            layout = volume.in_order(order).layout
            views = voxel_rays(operators.in_order(geometry, order), layout, shape)
            once = partial(cpu.project, box_of(layout), views, out, fans=way < 3)
            times.append(milliseconds(once))
        said = ", ".join(f"{w} {t:.2f}" for w, t in zip(WAYS, times, strict=True))
        what = f"{volume.shape} voxels, {shape} pixels: {WAYS[chosen]} chosen; {said} ms"
        rows.append((times[chosen] / min(times), times[0] / times[chosen], what))
    lost, gained = np.log([[r[0], r[1]] for r in rows]).T
    print(
        f"{len(rows)} views: {np.exp(lost.mean()):.2f} times the quickest way's time "
        f"(90 %: {np.exp(np.quantile(lost, 0.9)):.2f}), "
        f"{np.exp(gained.mean()):.2f} times as fast as along z"
    )
    for loss, _, what in sorted(rows, reverse=True)[:5]:
        print(f"{loss:.1f} times: {what}")


if __name__ == "__main__":
    main()
