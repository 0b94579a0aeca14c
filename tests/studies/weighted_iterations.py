"""Weighted iterations beside SIRT: the noise of the LEGO phantom's volume at equal sharpness.

    python tests/studies/weighted_iterations.py --photons 300

The phantom's voxels are projected by this file's own sums over rays, photons are counted, and
both methods run to a ladder of iterations on images with noise and without. Sharpness is the
part of the bricks' edges that the volume without noise has, noise the rms difference of the two
volumes inside bricks. Exits with 1 where weights make the noise larger.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from scipy.ndimage import map_coordinates, maximum_filter, minimum_filter, uniform_filter

import flexdt as fx
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import sart

SHAPE, PIXEL, SOD, SDD, VIEWS = (72, 96), 1.2, 600.0, 1059.0, 60
LADDER = (1, 2, 3, 4, 6, 8)
STEEL = 0.6
"""Attenuation of a bead [1/mm]; of the bricks 0.02."""


def voxels(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A stack of bricks of ABS with five steel balls, (n, n, n) of 0.5 mm, and its bricks."""
    z, y, x = np.mgrid[:n, :n, :n] * 0.5 - 0.25 * (n - 1)
    brick = (np.abs(x) < 12.0) & (np.abs(y) < 8.0) & (np.abs(z) < 9.6)
    brick &= ~(
        (np.abs(x) < 10.5) & (np.abs(y) < 6.5) & (np.abs((z + 9.6) % 9.6 - 3.8) < 3.0)
    )
    out = np.where(brick, 0.02, 0.0)
    for at in ((9, 6, 7), (-9, 6, 0), (9, -6, -3), (-9, -6, -7), (0, 7, 4)):
        out[(x - at[0]) ** 2 + (y - at[1]) ** 2 + (z - at[2]) ** 2 < 4.0] = STEEL
    return out.astype(np.float32), brick & (out < 0.1)


def projected(volume: np.ndarray, scan: fx.ConeVec) -> np.ndarray:
    """Line integrals by samples along each ray, a third of a voxel apart."""
    rows, cols = SHAPE
    c, r = np.arange(cols) - (cols - 1) / 2, np.arange(rows) - (rows - 1) / 2
    reach = 0.25 * len(volume) * np.sqrt(3.0)
    out = np.empty((len(scan), rows, cols), np.float32)
    for view, row in enumerate(scan.rows):
        source, panel, u, v = row.reshape(4, 3)
        ray = panel + c[None, :, None] * u + r[:, None, None] * v - source
        ray /= np.linalg.norm(ray, axis=2, keepdims=True)
        along = np.arange(-reach, reach, 1.0 / 6.0) - (source @ ray[rows // 2, cols // 2])
        at = source + along[:, None, None, None] * ray
        index = np.moveaxis(at[..., ::-1], -1, 0) / 0.5 + 0.5 * (len(volume) - 1)
        out[view] = map_coordinates(volume, index, order=1).sum(axis=0) / 6.0
    return out


def main() -> int:
    """Reconstruct, and compare at equal sharpness."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--photons", type=float, default=300.0, help="of an open pixel")
    parser.add_argument("--seed", type=int, default=1)
    o = parser.parse_args()
    truth, brick = voxels(72)
    scan = fx.ConeVec.circular(
        sod=SOD,
        sdd=SDD,
        angles=np.arange(VIEWS) * 360.0 / VIEWS,
        shape=SHAPE,
        pixel=PIXEL,
    )
    clean = projected(truth, scan)
    light = o.photons * np.exp(-clean.astype(float))
    counts = np.maximum(np.random.default_rng(o.seed).poisson(light), 0.5)
    noisy = -np.log(counts / o.photons).astype(np.float32)
    edge = maximum_filter(truth, 3) > minimum_filter(truth, 3) + 1e-6
    edge &= ~(maximum_filter(truth, 7) > 0.1)
    inner = brick & ~edge & ~(maximum_filter(truth, 5) > 0.1)
    grid, curves = Grid((72, 72, 72), 0.5), {}
    for name, weights in (("SIRT's step", None), ("weighted", 1e-6 / counts)):
        curve, found, done = [], [grid.blank(), grid.blank()], 0
        for passes in LADDER:
            # Smaller variances of the same ratios: none ends before its iterations are done.
            found = [
                sart(
                    p,
                    scan,
                    grid,
                    iterations=passes - done,
                    subsets=6,
                    start=v,
                    variances=weights,
                )
                for p, v in zip((clean, noisy), found, strict=True)
            ]
            done = passes
            shown = (found[0].data - uniform_filter(found[0].data, 7))[edge]
            there = (truth - uniform_filter(truth, 7))[edge]
            sharp = float((shown * there).sum() / (there * there).sum())
            curve.append((sharp, float(np.std((found[1].data - found[0].data)[inner]))))
            print(f"{name}, {passes} passes: edges {sharp:.3f}, noise {curve[-1][1]:.5f} 1/mm",
                  flush=True)  # fmt: skip
        curves[name] = np.array(curve)
    even, weighted = curves.values()
    common = np.linspace(
        max(even[0, 0], weighted[0, 0]), min(even[-1, 0], weighted[-1, 0]), 4
    )
    noise = [np.interp(common, c[:, 0], c[:, 1]) for c in (even, weighted)]
    for sharp, one, other in zip(common, *noise, strict=True):
        print(
            f"edges {sharp:.3f}: noise {one:.5f} even, {other:.5f} weighted, {other / one:.2f}"
        )
    return int(bool((noise[1] > 1.02 * noise[0]).any()))


if __name__ == "__main__":
    sys.exit(main())
