"""Clean scans of objects that look like bad pixels: what is interpolated of them.

    python tests/studies/clean_pixel_table.py --count 8 --seed 0

Draws scans of each kind of object, a quarter of them without noise: foam, powder, wires,
thin plates, tubes, discs and rings about the axis, whose edges stay before one pixel, beads on
the axis and elsewhere, a lattice, a screw; also of 12 to 24 views, of half a turn, and with a
beam of stripes and spots. Prints, a kind: scans of which pixels are interpolated, the pixels'
share of all, and the largest change of the volume's standard deviation. Exits with 1 where a
share is above 1 in 1 000 or a change above 1 %.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import bias_bound
import numpy as np

from flexdt.twin.geometry.cone_vec import ConeVec
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk
from flexdt.twin.reconstruction.consistency.pixels import bad_pixels

KINDS = (
    "noise", "foam", "powder", "wires", "blocks", "tubes", "discs", "rings", "plates",
    "axis beads", "lattice", "screw", "few views", "half turn", "beam",
)  # fmt: skip
SHAPE = (48, 96)
VOXEL_MM = 0.8
OPEN = (500.0, 3000.0, 30_000.0, 60_000.0)
"""Counts of the open beam that are drawn."""
MAX_SHARE = 1e-3
MAX_OFF = 0.01


def centre(rng: np.random.Generator, radius: float) -> np.ndarray:
    """Draw a place within a cylinder [mm]."""
    r, turn = radius * np.sqrt(rng.random()), 2.0 * np.pi * rng.random()
    return np.array([r * np.cos(turn), r * np.sin(turn), rng.uniform(-18.0, 18.0)])


def ball(at: np.ndarray, radius: float, mu: float) -> bias_bound.Solid:
    """A ball [mm, 1/mm]."""
    return bias_bound.Solid("ellipsoid", at, np.full(3, radius), 0.0, mu)


def disc(at: np.ndarray, radius: float, half: float, mu: float) -> bias_bound.Solid:
    """An upright cylinder [mm, 1/mm]."""
    return bias_bound.Solid("cylinder", at, np.array([radius, radius, half]), 0.0, mu)


def solids(kind: str, rng: np.random.Generator) -> Iterator[bias_bound.Solid]:
    """Draw an object of a kind."""
    middle = np.zeros(3)
    if kind not in ("powder", "blocks", "discs", "rings", "lattice"):
        yield disc(middle, 22.4, 90.0, 0.02)
    if kind in ("foam", "few views", "half turn", "beam"):
        for _ in range(60):
            yield ball(centre(rng, 19.0), rng.uniform(0.5, 4.0), -0.02)
    elif kind == "powder":
        for _ in range(60):
            yield ball(centre(rng, 24.0), rng.uniform(0.3, 1.2), rng.uniform(0.1, 0.6))
    elif kind == "wires":
        for reach in (20.0,) * 8 + (0.7,):
            at = centre(rng, reach) * [1.0, 1.0, 0.0]
            yield disc(at, rng.uniform(0.15, 0.8), rng.choice([5.0, 12.0, 90.0]), 0.4)
        for _ in range(4):
            half = np.array([rng.uniform(3.0, 12.0), 0.3, 0.3])
            yield bias_bound.Solid(
                "box", centre(rng, 15.0), half, 3.0 * rng.random(), 0.3
            )
    elif kind == "blocks":
        for _ in range(3):
            at = np.append(rng.uniform(-3.0, 3.0, 2), 0.0)
            yield bias_bound.Solid(
                "box", at, rng.uniform(4.0, 15.0, 3), rng.random(), 0.1
            )
    elif kind == "tubes":
        for radius in (10.0, 6.0, 2.0, 1.0):
            yield disc(middle, radius, rng.uniform(4.0, 20.0), rng.choice([-0.02, 0.06]))
    elif kind in ("discs", "rings"):
        for _ in range(5):
            at = np.append(rng.normal(0.0, 0.3, 2), rng.uniform(-16.0, 16.0))
            half, radius = rng.uniform(0.2, 1.0), rng.uniform(4.0, 20.0)
            yield disc(at, radius, half, 0.2)
            yield disc(at, 0.6 * radius if kind == "discs" else radius - 0.8, half, -0.2)
    elif kind == "plates":
        for _ in range(4):
            half = np.array([rng.uniform(4.0, 15.0), 0.25, rng.uniform(4.0, 14.0)])
            yield bias_bound.Solid("box", centre(rng, 8.0), half, 3.0 * rng.random(), 0.3)
        at = np.array([0.0, 0.0, rng.uniform(-10.0, 10.0)])
        yield bias_bound.Solid("box", at, np.array([14.0, 14.0, 0.3]), 0.3, 0.2)
    elif kind == "axis beads":
        for _ in range(4):
            radius, mu = rng.uniform(0.35, 1.0), rng.uniform(0.1, 0.5)
            at = np.append(rng.normal(0.0, 1.2, 2), rng.uniform(-15.0, 15.0))
            yield ball(at, radius, mu)
            yield ball(centre(rng, 19.0), radius, mu)
    elif kind == "lattice":
        for x in np.arange(-16.0, 17.0, 6.4):
            for y in np.arange(-16.0, 17.0, 6.4):
                yield ball(np.array([x, y, rng.choice([-9.0, -3.0, 3.0, 9.0])]), 0.8, 0.3)
    elif kind == "screw":
        for turn in np.arange(40) * np.pi / 4.0:
            at = [12.0 * np.cos(turn), 12.0 * np.sin(turn), 0.9 * turn - 14.0]
            yield ball(np.array(at), 0.6, 0.5)


def drawn(kind: str, seed: int) -> tuple[Float32Array, ConeVec, float]:
    """Draw a scan: line integrals, geometry and column of the axis."""
    rng = np.random.default_rng([KINDS.index(kind), seed])
    views = int(rng.integers(12, 25)) if kind == "few views" else 96
    span = 180.0 if kind == "half turn" else 360.0
    aside = float(rng.choice([0.0, 0.5, rng.uniform(-2.0, 2.0)]))
    scan = ConeVec.circular(
        sod=400.0, sdd=800.0, angles=np.arange(views) * span / views, shape=SHAPE,
        pixel=1.6,
    )  # fmt: skip
    rows = np.array(scan.rows)
    rows[:, 3:6] += aside * rows[:, 6:9]
    scan = ConeVec(rows)
    things = list(solids(kind, rng))
    images = bias_bound.Scan("", scan, SHAPE, things, 0.0, 0.0, 0).images()
    if rng.random() < 0.75:
        row, column = np.ogrid[: SHAPE[0], : SHAPE[1]]
        beam = np.full(SHAPE, rng.choice(OPEN))
        if kind == "beam":
            spots = 0.3 * np.sin(column / 3.0) * np.sin(row / 4.0)
            beam *= 0.55 + spots + 0.15 * np.sin(1.7 * column)
        beam = np.maximum(beam, 30.0)
        light = np.maximum(rng.poisson(beam * np.exp(-images)), 0.5)
        images = -np.log(light / np.maximum(rng.poisson(16.0 * beam) / 16.0, 0.5))
    return images.astype(np.float32), scan, (SHAPE[1] - 1) / 2.0 - aside


def main() -> int:
    """Draw, look for bad pixels, and reconstruct where there are any."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=8, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    wrong = 0
    for kind in KINDS:
        scans, pixels, off = 0, 0, 0.0
        for seed in range(chosen.seed, chosen.seed + chosen.count):
            images, scan, axis = drawn(kind, seed)

            def some(many: int, images: Float32Array = images) -> Float32Array:
                last = len(images) - 1
                return images[np.unique(np.linspace(0, last, many).astype(int))]

            found = bad_pixels(some, axis)
            if found is None:
                continue
            scans, pixels = scans + 1, pixels + found.count
            mended = images.copy()
            columns = np.arange(SHAPE[1])
            for row in np.flatnonzero(found.mask.any(axis=1)):
                bad = found.mask[row]
                for view in mended:
                    view[row, bad] = np.interp(
                        columns[bad], columns[~bad], view[row, ~bad]
                    )
            grid = Grid((48, 64, 64), VOXEL_MM)
            before, after = (
                fdk(one, scan, grid, errors=False).data.std() for one in (images, mended)
            )
            off = max(off, abs(float(after / before) - 1.0))
        share = pixels / (chosen.count * SHAPE[0] * SHAPE[1])
        wrong += share > MAX_SHARE or off > MAX_OFF
        print(
            f"{kind}: pixels of {scans} of {chosen.count} scans, {share:.1e} of all; std "
            f"of the volume changes by {100.0 * off:.2f} % at most",
            flush=True,
        )
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main())
