"""How strong total variation should be: errors of FDK, SIRT and TV for some weights.

    python tests/studies/tv_weights.py [--voxels 48]

An ellipsoid with a hole and two inclusions: line integrals of the analytic solids, with noise.
Prints one line a case: views, noise, and the rms error [1/mm] of FDK, SIRT and TV with each
weight. docs/evidence/reconstruction.json has the table.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np

import flexdt as fx
from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Box, Ellipsoid, Scene, Solid, Sphere
from flexdt.twin.reconstruction import fdk, sirt, tv

SCENE = Scene((
    Solid(Ellipsoid((0, 0, 0), (18, 14, 16)), "a", 0.03),
    Solid(Ellipsoid((5, 3, 2), (5, 4, 6)), "b", 0.03),
    Solid(Box((-7, -2, 0), (6, 7, 9)), "a", -0.03),
    Solid(Sphere((2, -7, -4), 3), "c", 0.05),
))  # fmt: skip
CASES = ((20, 0.0), (20, 0.03), (60, 0.03), (60, 0.1))
WEIGHTS = (0.001, 0.003, 0.01, 0.03)
SIZE_MM = 43.2


def truth(count: int, fine: int = 3) -> np.ndarray:
    """Voxelise the scene in count^3 voxels: the mean of fine^3 points in each [1/mm]."""
    at = (np.arange(count * fine) - (count * fine - 1) / 2) * SIZE_MM / (count * fine)
    z, y, x = np.meshgrid(at, at, at, indexing="ij", sparse=True)
    full = 0.03 * ((x / 18) ** 2 + (y / 14) ** 2 + (z / 16) ** 2 < 1)
    full += 0.03 * (((x - 5) / 5) ** 2 + ((y - 3) / 4) ** 2 + ((z - 2) / 6) ** 2 < 1)
    full -= 0.03 * ((abs(x + 7) < 3) & (abs(y + 2) < 3.5) & (abs(z) < 4.5))
    full += 0.05 * ((x - 2) ** 2 + (y + 7) ** 2 + (z + 4) ** 2 < 9)
    return np.asarray(
        full.reshape(count, fine, count, fine, count, fine).mean(axis=(1, 3, 5))
    )


def errors(
    views: int, noise: float, count: int, weights: Sequence[float] = WEIGHTS
) -> list[float]:
    """Reconstruct a noisy scan by FDK, SIRT and TV with each weight.

    Args:
        views: of the turn.
        noise: standard deviation of the line integrals.
        count: voxels a side.
        weights: of TV.

    Returns:
        Root mean square error of each volume [1/mm]: FDK, SIRT, then TV in the order of
        the weights.
    """
    grid, wanted = fx.Grid((count,) * 3, SIZE_MM / count), truth(count)
    scan = fx.ConeVec.circular(
        sod=600, sdd=1059, angles=views, shape=(56 * count // 48, 60 * count // 48),
        pixel=1.6 * 48 / count,
    )  # fmt: skip
    data = project_scene(SCENE, scan, scan.shape[1:])
    data += noise * np.random.default_rng(0).normal(size=data.shape).astype(np.float32)
    volumes = [fdk(data, scan, grid, errors=False)]
    volumes += [sirt(data, scan, grid, iterations=60, nonnegative=True)]
    volumes += [tv(data, scan, grid, weight=w, iterations=200) for w in weights]
    return [float(np.sqrt(np.mean((v.data - wanted) ** 2))) for v in volumes]


def main() -> None:
    """Print the errors of all CASES, one line each."""
    parser = argparse.ArgumentParser(description="how strong total variation should be")
    parser.add_argument("--voxels", type=int, default=48)
    count = parser.parse_args().voxels
    for views, noise in CASES:
        print(
            views, noise, *(f"{e:.4f}" for e in errors(views, noise, count)), flush=True
        )


if __name__ == "__main__":
    main()
