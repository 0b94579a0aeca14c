"""What a volume's `sigma` costs: FDK without and with it, in turns.

    python tests/studies/noise_cost.py

Processor seconds, the better of three.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import flexdt as fx
from flexdt.twin.geometry.conventions import Float32Array
from flexdt.twin.reconstruction import fdk_parts

CASES = (
    (360, (128, 128), 1.17, fx.Grid((96, 96, 96), 0.6)),
    (360, (380, 478), 0.2992, fx.Grid((256, 256, 256), 0.3)),
    (720, (760, 956), 0.1496, fx.Grid((400, 400, 400), 0.2)),
)

if __name__ == "__main__":
    for views, shape, pixel, grid in CASES:
        scan = fx.ConeVec.circular(sod=600, sdd=1059, angles=views, shape=shape, pixel=pixel)
        images = np.random.default_rng(0).random((8, *shape), dtype=np.float32)

        def parts(images: Float32Array = images, views: int = views) -> Iterator[Float32Array]:
            return iter([images] * (views // 8))

        best = [np.inf, np.inf]
        for turn in range(6):
            begun = time.process_time()
            fdk_parts(parts, scan, shape, grid, errors=bool(turn % 2))
            best[turn % 2] = min(best[turn % 2], time.process_time() - begun)
        print(f"{views} views of {shape} into {grid.shape}: {best[0]:.2f} and {best[1]:.2f} s, "
              f"{best[1] / best[0]:.3f}")  # fmt: skip
