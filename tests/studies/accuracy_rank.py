"""Drawn scans: does the accuracy that is stated of a scan hold, and does it rank scans?

    python tests/studies/accuracy_rank.py --count 200 --seed 63

Scans of `bias_bound.py` that the panel sees whole, without noise. Means over cubes of five
voxels, all over the object and away from edges, are compared with the truth: what half of them,
and nine of ten, are off by is what `accuracy.half` and `accuracy.most` state. Prints the share
of scans in which they hold, the stated over the true figure (median), and their rank
correlation (Spearman). Exits with 1 where `half` holds in less than 98 % of scans, or ranks
them by less than 0.5.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace

import bias_bound
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter, uniform_filter
from scipy.stats import spearmanr

import flexdt as fx
from flexdt.twin.reconstruction import bias_of, fdk_parts, field_of_view, truncation_of

REGION_VOXELS = 5
"""Side of the cube whose mean is compared."""
UNIFORM_VOXELS = 9
"""Side of the cube about it in which the truth is the same."""
FEWEST_REGIONS = 50
LEAST_SHARE = 0.3
"""Attenuation of a region over that of the body, at least."""


@dataclass(frozen=True)
class Stated:
    """Errors of half of a scan's uniform regions, and of nine of ten.

    Attributes:
        said: of the scan.
        stated: by `volume.accuracy`.
        true: of the volume.
    """

    said: str
    stated: tuple[float, float]
    true: tuple[float, float]


def judged(seed: int, number: int) -> Stated | None:
    """Compare what is stated of a drawn scan's accuracy with its true errors in uniform
    regions.

    Args:
        seed, number: of the draw; the same give the same scan.

    Returns:
        None for a scan that is cut off or refused, without an accuracy, or with fewer
        than FEWEST_REGIONS regions.
    """
    scan = replace(bias_bound.drawn(seed, number), counts=0.0)
    if " cut " in scan.said:
        return None
    images = scan.images()
    grid = field_of_view(scan.geometry, scan.shape)
    try:
        truncation = truncation_of(images.__getitem__, scan.geometry, scan.shape)
        bias = bias_of(images.__getitem__, scan.geometry, scan.shape, truncation)
        volume = fdk_parts(
            lambda: [images.copy()],
            scan.geometry,
            scan.shape,
            grid,
            truncation=truncation,
        )
    except fx.TwinError:
        return None
    accuracy = None if bias is None else bias.accuracy(grid)
    if accuracy is None or accuracy.cut_off:
        return None
    x, y, z = volume.centers()
    places = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    truth = scan.truth(places)
    uniform = minimum_filter(truth, UNIFORM_VOXELS) == maximum_filter(
        truth, UNIFORM_VOXELS
    )
    means = uniform_filter(np.nan_to_num(volume.data), REGION_VOXELS)
    seen = uniform_filter(np.isnan(volume.data).astype(float), REGION_VOXELS) == 0.0
    regions = uniform & seen & (truth > LEAST_SHARE * scan.solids[0].mu)
    if regions.sum() < FEWEST_REGIONS:
        return None
    half, most = np.percentile(
        np.abs(means[regions] / truth[regions] - 1.0), [50.0, 90.0]
    )
    return Stated(scan.said, (accuracy.half, accuracy.most), (float(half), float(most)))


def main() -> int:
    """Draw, compare and rank."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--seed", type=int, default=63)
    chosen = parser.parse_args()
    begun = time.process_time()
    numbers = range(chosen.first, chosen.first + chosen.count)
    found = [
        one for number in numbers if (one := judged(chosen.seed, number)) is not None
    ]
    good = True
    for place, name in enumerate(("half of the regions", "nine of ten")):
        stated, true = (
            np.array([getattr(one, which)[place] for one in found])
            for which in ("stated", "true")
        )
        within, rank = float((true <= stated).mean()), float(spearmanr(stated, true)[0])
        print(f"{name}: holds in {100 * within:.1f} % of {len(found)} scans; stated over true, "
              f"median: {np.median(stated / true):.1f}; rank correlation {rank:.2f}")  # fmt: skip
        good &= place > 0 or (within >= 0.98 and rank >= 0.5)
    print(f"{time.process_time() - begun:.0f} CPU s")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main())
