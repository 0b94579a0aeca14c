"""What a volume's `sigma` and `bias_bound` cost: FDK without and with both, in turns; and of it
the comparison of images and geometry, where they fit and where all explanations are tried.

    python tests/studies/noise_cost.py [NUMBER OF CASES]

Images of a cylinder that the panel sees whole, and of one that it cuts off. Processor seconds,
the better of three.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Iterator

import numpy as np

import flexdt as fx
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.reconstruction.checked_fdk import checked_fdk
from flexdt.twin.reconstruction.coarse_scan import CoarseScan
from flexdt.twin.reconstruction.consistency.agreement import compared

CASES = (
    (360, (128, 128), 1.17, fx.Grid((96, 96, 96), 0.6)),
    (360, (380, 478), 0.2992, fx.Grid((256, 256, 256), 0.3)),
    (144, (96, 96), 1.56, fx.Grid((96, 96, 96), 0.6)),
    (720, (760, 956), 0.1496, fx.Grid((400, 400, 400), 0.2)),
)
SOD, SDD = 600.0, 1059.0


def image_of(radius: float, shape: tuple[int, int], pixel: float) -> Float32Array:
    """Line integrals of a tall cylinder about the axis, of 0.02 / mm, (rows, cols)."""
    beside = (np.arange(shape[1]) - (shape[1] - 1) / 2) * pixel
    up = ((np.arange(shape[0]) - (shape[0] - 1) / 2) * pixel)[:, None]
    away = SOD * np.sin(np.arctan2(beside, SDD))
    chord = 2.0 * np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    return np.asarray(
        0.02 * chord * np.sqrt(1.0 + up**2 / (SDD**2 + beside**2)), np.float32
    )


def comparison_times(
    image: Float32Array, scan: fx.ConeVec, shape: tuple[int, int]
) -> tuple[str, str]:
    """Processor seconds of a comparison, the least of three, as texts: of images that fit
    the geometry, and of ones on a panel moved aside by five pixels.
    """
    pixel = float(np.linalg.norm(scan.u[0]))
    aside = fx.ConeVec.circular(
        sod=SOD,
        sdd=SDD,
        angles=len(scan),
        shape=shape,
        pixel=pixel,
        offset=(5.0 * pixel, 0.0),
    )
    found = []
    for geometry in (scan, aside):
        coarse = CoarseScan.of(lambda number: image, geometry, shape, None)
        times = []
        for _ in range(3):
            begun = time.process_time()
            compared(coarse)
            times.append(time.process_time() - begun)
        found.append(f"{min(times):.3f}")
    return found[0], found[1]


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    for views, shape, pixel, grid in CASES[: int(sys.argv[1]) if sys.argv[1:] else None]:
        scan = fx.ConeVec.circular(
            sod=SOD, sdd=SDD, angles=views, shape=shape, pixel=pixel
        )
        for what, radius in (("seen whole", 30.0), ("cut off", 55.0)):
            image = image_of(radius, shape, pixel)
            chunk = np.broadcast_to(image, (8, *shape))

            def parts(
                chunk: Float32Array = chunk, views: int = views
            ) -> Iterator[Float32Array]:
                return (chunk.copy() for _ in range(views // 8))

            best = [np.inf, np.inf]
            for turn in range(6):
                begun = time.process_time()
                checked_fdk(
                    lambda number, image=image: image, parts, scan, shape, grid,
                    errors=bool(turn % 2),
                )  # fmt: skip
                best[turn % 2] = min(best[turn % 2], time.process_time() - begun)
            print(f"{views} views of {shape} into {grid.shape}, {what}: {best[0]:.2f} and "
                  f"{best[1]:.2f} s, {best[1] / best[0]:.3f}; comparison "
                  f"{', '.join(comparison_times(image, scan, shape))} s", flush=True)  # fmt: skip
