"""Two materials in the loop, and a fine region in coarse surroundings: what either is worth.

    python tests/studies/joint_iterations.py materials
    python tests/studies/joint_iterations.py region

`materials`: a cylinder of PMMA with two pins of steel, projected by this file's own sums over
samples of rays and over all energies; errors of SART without correction, with that of one
material, and with both in the loop, beside SART of images at one energy. `region`: an object of
ellipses, a third of it wanted in fine voxels; errors in there, memory and time of the region
alone, in coarse surroundings, and of everything in fine voxels. Exits with 1 where the joint
way is not the better.
"""

from __future__ import annotations

import argparse
import sys
import time
import tracemalloc

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion, map_coordinates

import flexdt as fx
from flexdt.twin.attenuation.substances import Substance
from flexdt.twin.physics.chain import Chain, weights_of
from flexdt.twin.physics.detector import Detector
from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import Polychromatic, cgls, hardening, sart, sirt

KV, KEV = 90.0, 60.0
PMMA, STEEL = Substance.of("pmma", "C5H8O2", 1.18), Substance.of("steel", "Fe", 7.87)


def sampled(layer: np.ndarray, voxel: float, scan: fx.ConeVec, cols: int) -> np.ndarray:
    """Line integrals (n, 1, cols) of a layer in the middle plane, by samples along each ray."""
    c = np.arange(cols) - (cols - 1) / 2
    reach = 0.5 * voxel * len(layer) * np.sqrt(2.0)
    step = voxel / 3.0
    out = np.empty((len(scan), 1, cols), np.float32)
    for view, row in enumerate(scan.rows):
        source, panel, u, _ = row.reshape(4, 3)
        ray = panel + c[:, None] * u - source
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = np.arange(-reach, reach, step)[:, None] - (ray @ source)
        at = source[:2] + along[..., None] * ray[:, :2]
        index = np.moveaxis(at[..., ::-1], -1, 0) / voxel + (len(layer) - 1) / 2
        out[view, 0] = map_coordinates(layer, index, order=1).sum(axis=0) * step
    return out


def materials(o: argparse.Namespace) -> int:
    """PMMA of 28 mm with two steel pins of 3 mm, 8.5 mm from its axis."""
    n, cols, fine = 64, 100, 4
    scan = fx.ConeVec.circular(
        sod=300,
        sdd=500,
        angles=np.arange(o.views) * 360.0 / o.views,
        shape=(1, cols),
        pixel=0.6,
    )
    grid = Grid((1, n, n), 0.5)
    labels = {}
    for m in (n, fine * n):
        y, x = (np.mgrid[:m, :m] - (m - 1) / 2) * 0.5 * n / m
        labels[m] = (x**2 + y**2 < 14.0**2).astype(int)
        for side in (-7.0, 7.0):
            labels[m][(x - side) ** 2 + (y - 0.3) ** 2 < 1.5**2] = 2
    paths = np.stack([
        sampled((labels[fine * n] == k).astype(float), 0.5 / fine, scan, cols) for k in (1, 2)
    ])  # fmt: skip
    weights, _ = weights_of(Chain(Detector()), KV)
    depth = np.tensordot(np.stack([PMMA.attenuation(), STEEL.attenuation()], 1), paths, 1)
    seen = -np.log(np.tensordot(weights / weights.sum(), np.exp(-depth), 1)).astype(
        np.float32
    )
    both = Polychromatic.of((PMMA, STEEL), KV, KEV)
    label, mu = labels[n], both.mu
    inner = binary_erosion(label > 0, iterations=2) & ~binary_dilation(
        label == 2, iterations=2
    )
    y, x = (np.mgrid[:n, :n] - (n - 1) / 2) * 0.5
    places = {
        "PMMA": inner,
        "between the pins": inner & (abs(y - 0.3) < 1.2) & (abs(x) < 4.5),
        "PMMA, middle less rim": inner & (x**2 + y**2 < 5.0**2),
        "steel": binary_erosion(label == 2),
    }
    ways = {
        "one energy": (np.tensordot(mu, paths, 1).astype(np.float32), {}),
        "no correction": (seen, {}),
        "one material": (hardening(PMMA, KV, KEV)(seen), {}),
        "two materials": (seen, {"hardening": both}),
    }
    errors = {}
    for name, (images, options) in ways.items():
        begun = time.process_time()
        found = sart(
            images, scan, grid, iterations=o.iterations, subsets=6, nonnegative=True, **options
        ).data[0]  # fmt: skip
        spent = time.process_time() - begun
        mean = {
            k: float(found[p].mean()) / mu[int(k == "steel")] - 1
            for k, p in places.items()
        }
        rim = inner & (x**2 + y**2 > 9.0**2) & (abs(y - 0.3) > 4.0)
        mean["PMMA, middle less rim"] -= float(found[rim].mean()) / mu[0] - 1
        errors[name] = abs(mean["between the pins"])
        print(f"{name}: " + ", ".join(f"{k} {100 * v:+.1f} %" for k, v in mean.items())
              + f"; {spent:.1f} CPU s", flush=True)  # fmt: skip
    return int(errors["two materials"] > 0.3 * errors["one material"])


def region(o: argparse.Namespace) -> int:
    """Ellipses out to 29 mm; the region is 20 mm wide and off the axis."""
    k = round(0.5 / o.voxel)  # voxels for each of 0.5 mm
    n, layers = 120 * k, 24 * k
    scan = fx.ConeVec.circular(
        sod=400, sdd=700, angles=np.arange(o.views) * 360.0 / o.views, shape=(40 * k, 190 * k),
        pixel=0.7 / k,
    )  # fmt: skip
    rng = np.random.default_rng(o.seed)
    half = o.voxel / 2.0
    axes = [(np.arange(2 * m) - m + 0.5) * half for m in (layers, n, n)]
    z, y, x = np.meshgrid(*axes, indexing="ij", sparse=True)
    truth = np.zeros((2 * layers, 2 * n, 2 * n), np.float32)
    truth[:] = np.where((x / 29) ** 2 + (y / 24) ** 2 < 1, 0.02, 0.0)
    for _ in range(60):
        at, size = rng.uniform((-18, -14, -5), (18, 14, 5)), rng.uniform(0.8, 4.0, 3)
        near = [
            slice(*np.searchsorted(axis, (a - s, a + s)))
            for axis, a, s in zip(axes, at[::-1], size[::-1], strict=True)
        ]
        places = zip(
            (z[near[0]], y[:, near[1]], x[..., near[2]]),
            at[::-1],
            size[::-1],
            strict=True,
        )
        inside = sum(((q - a) / s) ** 2 for q, a, s in places) < 1
        truth[tuple(near)][inside] = rng.uniform(0.0, 0.06)
    images = fx.forward(fx.Volume(truth, half), scan)
    wanted = truth.reshape(layers, 2, n, 2, n, 2).mean(axis=(1, 3, 5))
    whole, rest = Grid((layers, n, n), o.voxel), Grid((12, 30, 30), 2.0)
    part = Grid((layers, 40 * k, 40 * k), o.voxel, (6.0, -4.0, 0.0))
    cut = (slice(None), slice(32 * k, 72 * k), slice(52 * k, 92 * k))
    method = {"sirt": sirt, "sart": sart, "cgls": cgls}[o.method]
    errors = {}
    for name, grid, options in (
        ("region alone", part, {}),
        ("in surroundings of 2 mm", part, {"surroundings": rest}),
        ("all in fine voxels", whole, {}),
    ):
        begun = time.process_time()
        found = method(images, scan, grid, iterations=o.iterations, **options).data
        spent = time.process_time() - begun
        tracemalloc.start()  # it takes time itself
        method(images, scan, grid, iterations=1, **options)
        most = tracemalloc.get_traced_memory()[1] / 2**20
        tracemalloc.stop()
        off = ((found[cut] if grid is whole else found) - wanted[cut])[4:-4, 3:-3, 3:-3]
        errors[name] = float(np.sqrt((off**2).mean()))
        print(f"{name}: mean {off.mean() / 2e-4:+.1f} %, rms {errors[name] / 2e-4:.1f} % of the "
              f"body's 0.02 / mm; {most:.0f} MiB, {spent:.1f} CPU s", flush=True)  # fmt: skip
    alone, joint, _ = errors.values()
    return int(joint > 0.5 * alone)


def main() -> int:
    """One of the two."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("what", choices=("materials", "region"))
    parser.add_argument("--views", type=int, default=120)
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--method", choices=("sirt", "sart", "cgls"), default="sart")
    parser.add_argument("--voxel", type=float, default=0.5, help="of `region` [mm]")
    parser.add_argument("--seed", type=int, default=1)
    o = parser.parse_args()
    return {"materials": materials, "region": region}[o.what](o)


if __name__ == "__main__":
    sys.exit(main())
