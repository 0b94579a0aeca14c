"""How surely can anybody tell the gaps of `natural_objects.py --gaps` from none?

    python tests/studies/gap_bound.py [--count 24] [--seed 5001] [--only bottle]

The object is known here, and the scan; what tells the gap from none is how badly the best
rival without a gap explains the turn's mean: any body of revolution for each row of its own,
about an axis at any column of its own for each row, behind any yaw. The rival's body is shells
of independent densities, of the object's own size in variance; noise is that of photons and of
the flat image, the latter's rings included, at its largest over the rows. Data are without
noise, so the difference of both chi squares, from the scan with the gap and that without, is
the square of a number of sigmas that the mean alone gives to everybody who does not know
the object. What turns adds to it: the number is a lower bound.

Prints a line for each scan, and how many are decidable, at DECIDABLE sigmas. Nothing of the
code that looks for gaps is used.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from typing import Any, Final

import numpy as np
from natural_objects import ACROSS, OBJECTS, SDD_MM, SOD_MM, Scan, drawn
from scipy.linalg import cho_factor, cho_solve

DECIDABLE: Final = 5.0
"""Number of sigmas from which a gap is decidable: its likelihood over none is that of 100 at
odds of 1 in 20 at one of 40 columns, and of a width that is not known."""
SHELLS_PER_COLUMN: Final = 2
"""Shells of the rival's body to a column at the axis."""
DENSITY: Final = 0.05
"""Standard deviation of the shells' densities [1/mm]."""
FLATS: Final = 20
"""Number of frames in the flat image of `natural_objects.Scan.data`."""
ASIDE_PX: Final = np.arange(-1.5, 1.51, 0.05)
"""Columns of the rival's axis, from that of the scan [px]."""
YAWS_PX: Final = np.arange(-0.2, 0.21, 0.1)
"""Displacements of the panel's edges by the rival's yaw [px]."""


def chords(scan: Scan, axis: float, yaw: float) -> np.ndarray:
    """Compute the lengths of rays in shells about the axis.

    Args:
        scan: gives source, panel and pixels.
        axis: its column [px].
        yaw: by how much the panel's edges are displaced [px].

    Returns:
        Mean over each pixel's rays, (cols, shells) [mm].
    """
    cols = scan.shape[1]
    inner = np.arange(cols * SHELLS_PER_COLUMN) / SHELLS_PER_COLUMN
    edges = np.append(inner, inner[-1] + 1.0) * scan.pitch * SOD_MM / SDD_MM
    at = (np.arange(cols * ACROSS) + 0.5) / ACROSS - 0.5 - axis
    at = at + yaw * np.square(at / (cols / 2.0))
    far = SOD_MM * np.sin(np.arctan(at * scan.pitch / SDD_MM))
    half = np.sqrt(np.maximum(np.square(edges) - np.square(far)[:, None], 0.0))
    return np.asarray(2.0 * np.diff(half, axis=1).reshape(cols, ACROSS, -1).mean(axis=1))


def mean_of(scan: Scan) -> np.ndarray:
    """Compute the mean of the line integrals over the turn, without noise, (rows, cols)."""
    light = scan.light()
    first, width = scan.gap
    if width > 0:
        light[:, :, first:] = scan.light(width)[:, :, first:]
    return np.asarray(-np.log(light).mean(axis=0))


def noise_of(scan: Scan) -> np.ndarray:
    """Compute the variance of the mean's columns, the largest over the rows, (cols,)."""
    of_photons = (1.0 / scan.light()).mean(axis=0).max(axis=0) / scan.views
    return np.asarray((of_photons + 1.0 / FLATS) / scan.photons + scan.rings**2 + 1e-12)


def sigmas(scan: Scan) -> float:
    """Compute by how many sigmas the mean tells the scan's gap from none."""
    both = np.stack([mean_of(scan), mean_of(replace(scan, gap=(0, 0.0)))])
    noise = noise_of(scan)
    least = np.full(both.shape[:2], np.inf)
    for aside in ASIDE_PX.tolist():
        for yaw in YAWS_PX.tolist():
            body = DENSITY * chords(scan, scan.column() + aside, yaw)
            factor = cho_factor(body @ body.T + np.diag(noise), check_finite=False)
            known = cho_solve(factor, both.reshape(-1, len(noise)).T, check_finite=False)
            left = np.einsum("src,csr->sr", both, known.reshape(-1, *both.shape[:2]))
            least = np.minimum(least, left)
    return float(np.sqrt(max((least[0] - least[1]).sum(), 0.0)))


def drawn_sigmas(kind: str, seed: int) -> tuple[tuple[int, float], float]:
    """Return the gap of a drawn scan, and by how many sigmas the mean tells it."""
    rng = np.random.default_rng([list(OBJECTS).index(kind), seed, True])
    scan = drawn(kind, rng, True)
    return scan.gap, sigmas(scan)


def main(words: list[str] | None = None) -> int:
    """Bound drawn scans and print how many are decidable; 0."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--seed", type=int, default=5001)
    parser.add_argument("--only", help="objects, with commas between them")
    o = parser.parse_args(words)
    names = o.only.split(",") if o.only else list(OBJECTS)
    told: list[dict[str, Any]] = []
    for k in range(o.count):
        kind, seed = names[k % len(names)], o.seed + k // len(names)
        gap, surely = drawn_sigmas(kind, seed)
        told.append({"kind": kind, "seed": seed, "gap": gap, "sigmas": round(surely, 1)})
        print(json.dumps(told[-1]), flush=True)
    count = sum(one["sigmas"] >= DECIDABLE for one in told)
    print(
        f"{count} of {len(told)} decidable by the mean, at {DECIDABLE:g} sigmas or more"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
