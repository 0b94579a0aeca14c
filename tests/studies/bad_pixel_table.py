"""Dead, hot and flickering pixels, and dead columns: what is found, and what noise is left.

    python tests/studies/bad_pixel_table.py --count 40 --seed 4000

Counts of `tests/clients/test_bad_pixels.py`, whose places and numbers (1 to 50, or a column) are
drawn. Prints, a kind: pixels found over those there are, and the standard deviation of the
body's values over that of a clean scan, median and largest, with and without interpolation.
Exits with 1 where it is above 1.3.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "clients"))

import test_bad_pixels as scans

from flexdt.twin.projection import Grid
from flexdt.twin.reconstruction import fdk

KINDS = ("dead", "hot", "flickering", "column")
MAX_RATIO = 1.3
"""Largest standard deviation over that of a clean scan."""


def left_as_it_is(counts: np.ndarray) -> float:
    """Standard deviation of the body where nothing is interpolated."""
    light = np.maximum(counts, 0.5) / scans.OPEN
    integrals = (-np.log(light)).astype(np.float32)
    volume = fdk(integrals, scans.SCAN, Grid((12, 60, 60), 0.8), errors=False)
    return float(scans.body(volume).std())


def main() -> int:
    """Draw, reconstruct and compare."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=40, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=4000)
    chosen = parser.parse_args()
    begun = time.process_time()
    worst = 0.0
    for kind in KINDS:
        found, ratios, raw = [], [], []
        for seed in range(chosen.seed, chosen.seed + chosen.count):
            counts = scans.counts_of(seed)
            clean = float(scans.body(scans.reconstructed(counts)[0]).std())
            made, bad = scans.spoilt(counts, kind, seed)
            volume, said = scans.reconstructed(made)
            told = [one for one in said if "do not respond" in one]
            number = int(told[0].split()[0]) if told else 0
            found.append(number / int(bad.sum()))
            ratios.append(float(scans.body(volume).std()) / clean)
            raw.append(left_as_it_is(made) / clean)
        worst = max(worst, *ratios)
        print(
            f"{kind}: found {min(found):.2f} to {max(found):.2f} of them; std over a clean "
            f"scan's {np.median(ratios):.3f}, at most {max(ratios):.3f}; not interpolated "
            f"{np.median(raw):.2f}, at most {max(raw):.2f}",
            flush=True,
        )
    print(f"{time.process_time() - begun:.0f} CPU s")
    return int(worst > MAX_RATIO)


if __name__ == "__main__":
    sys.exit(main())
