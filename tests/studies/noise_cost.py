"""What it costs to look at a volume: FDK with and without `errors`, in turns in one run.

    python tests/studies/noise_cost.py [--sizes small,96,256,384] [--rtk] [--turns 3]

Images of a cylinder with two bodies in it that the panel sees whole, and of one that it cuts off,
clean and noisy, of users' size (380 x 478 pixels) and smaller. Processor seconds, the least of all
turns; peak memory above what the images take. `--rtk`: beside itk-rtk's FDK of the same images
(needs `pip install itk-rtk`).
"""

from __future__ import annotations

import argparse
import time
import tracemalloc
import warnings
from functools import partial

import numpy as np
from compare_fdk import by_rtk

import flexdt as fx
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.projection import project_scene
from flexdt.twin.projection.analytic_solids import Box, Cylinder, Scene, Solid, Sphere

SOD, SDD, WIDE_MM = 600.0, 1059.0, 143.0
SIZES = {
    "tiny": (9, (48, 48), (28, 28, 28)),
    "small": (48, (48, 48), (28, 48, 48)),
    "96 of few pixels": (144, (96, 96), (96, 96, 96)),
    "96": (360, (380, 478), (96, 96, 96)),
    "256": (360, (380, 478), (256, 256, 256)),
    "384": (720, (760, 956), (384, 384, 384)),
}
OBJECTS = {"seen whole": 26.0, "cut off": 48.0}


def images_of(radius: float, scan: fx.ConeVec, shape: tuple[int, int]) -> Float32Array:
    """Line integrals of a cylinder about the axis, of 0.02 / mm, with a ball and a box."""
    solids = (
        Solid(Cylinder((0.0, 0.0, 0.0), radius, 18.0), "a", 0.02),
        Solid(Sphere((9.0, -6.0, 5.0), 6.0), "b", 0.01),
        Solid(Box((-8.0, 5.0, -6.0), (10.0, 6.0, 8.0)), "c", -0.01),
    )
    return np.asarray(project_scene(Scene(solids), scan, shape), np.float32)


def image_of(radius: float, shape: tuple[int, int], pixel: float) -> Float32Array:
    """Line integrals of a tall cylinder about the axis, of 0.02 / mm, (rows, cols)."""
    beside = (np.arange(shape[1]) - (shape[1] - 1) / 2) * pixel
    up = ((np.arange(shape[0]) - (shape[0] - 1) / 2) * pixel)[:, None]
    away = SOD * np.sin(np.arctan2(beside, SDD))
    chord = 2.0 * np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    return np.asarray(
        0.02 * chord * np.sqrt(1.0 + up**2 / (SDD**2 + beside**2)), np.float32
    )


def seconds_of(made: object) -> float:
    """Processor seconds of a call without arguments."""
    begun = time.process_time()
    made()  # type: ignore[operator]
    return time.process_time() - begun


def peak_of(made: object) -> float:
    """Largest memory that a call without arguments allocates [MiB]."""
    tracemalloc.start()
    made()  # type: ignore[operator]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return peak / 2**20


def main() -> None:
    """Print a line for each size, object and noise."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sizes", default=",".join(SIZES))
    parser.add_argument("--rtk", action="store_true")
    parser.add_argument("--turns", type=int, default=3)
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    for name in options.sizes.split(","):
        views, shape, cells = SIZES[name]
        pixel = WIDE_MM / shape[1]
        scan = fx.ConeVec.circular(
            sod=SOD, sdd=SDD, angles=views, shape=shape, pixel=pixel
        )
        grid = fx.Grid(cells, 57.6 / cells[2])
        for what, radius in OBJECTS.items():
            clean = images_of(radius, scan, shape)
            for sigma in (0.0, 0.01):
                noise = np.random.default_rng(1).normal(0.0, 1.0, clean.shape)
                images = (clean + sigma * noise).astype(np.float32)
                del noise

                ways = [
                    partial(fx.fdk, images, scan, grid, errors=looks, progress=False)
                    for looks in (False, True)
                ]
                least = [np.inf] * 3
                for turn in range(options.turns + 1):
                    for k, way in enumerate(ways):
                        took = seconds_of(way)
                        least[k] = min(least[k], took if turn else np.inf)
                    if options.rtk and turn:
                        begun = time.process_time()
                        by_rtk(images, views, cells[0], 57.6 / cells[2], pixel)
                        least[2] = min(least[2], time.process_time() - begun)
                memory = [peak_of(way) for way in ways]
                text = (
                    f"{name}: {views} views of {shape} into {cells}, {what}, "
                    f"{'noisy' if sigma else 'clean'}: {least[0]:.3f} and {least[1]:.3f} "
                    f"CPU s, {least[1] / least[0]:.2f} times, "
                    f"{1000.0 * (least[1] - least[0]):.0f} ms; {memory[0]:.0f} and "
                    f"{memory[1]:.0f} MiB, {memory[1] / memory[0]:.2f} times"
                )
                if options.rtk:
                    text += f"; itk-rtk {least[2]:.2f} CPU s, {least[1] / least[2]:.3f}"
                print(text, flush=True)


if __name__ == "__main__":
    main()
