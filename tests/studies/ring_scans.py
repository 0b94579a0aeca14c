"""Drawn scans with and without errors of pixels: does `rings` help, and does it leave others
alone?

    python tests/studies/ring_scans.py --count 200 --seed 7

Scans of `bias_bound.py` in whole turns, of several kinds of objects, with noise. Pixels, a
few of them, or whole columns add normally distributed errors of none, .3, 1 or 3 % to all
views. The root mean square error of uniform regions is compared: with the errors, and with them
corrected, over that of the scan without errors.
Exits with 1 where a correction makes a volume worse by more than 5 %, or where it removes less
than half of what errors of 1 % and more do, in the median.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass, replace

import bias_bound
import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

import flexdt as fx
from flexdt.library.reconstruction.ring_correction import scan_rings
from flexdt.twin.reconstruction import fdk_parts, field_of_view, truncation_of

GAINS = (0.0, 0.003, 0.01, 0.03)
"""Standard deviations of what pixels add to line integrals."""
KINDS = ("pixels", "some", "columns")
SOME = 0.03
"""Share of the pixels that have errors, of the kind `some`."""
REGION_VOXELS = 5
"""Side of the cube that is uniform about a voxel which is compared."""
MOST_WORSE = 1.05
"""Error with a correction over that without, at most."""


@dataclass(frozen=True)
class Outcome:
    """Errors of uniform regions over those of the scan without errors of pixels.

    Attributes:
        said: of the scan.
        kind: of the errors, one of `KINDS`.
        gain: their standard deviation.
        ringed: with the errors.
        corrected: with the errors, corrected.
    """

    said: str
    kind: str
    gain: float
    ringed: float
    corrected: float

    @property
    def removed(self) -> float:
        """Share of the errors' power that was removed."""
        return (self.ringed**2 - self.corrected**2) / max(self.ringed**2 - 1.0, 1e-9)

    @property
    def worse(self) -> bool:
        """Whether the correction does harm."""
        return self.corrected > MOST_WORSE * self.ringed


def thing(scan: bias_bound.Scan, rng: np.random.Generator) -> bias_bound.Scan:
    """The scan of one of several kinds of objects in the drawn one's place."""
    body = scan.solids[0]
    kind = str(
        rng.choice(["drawn", "wires", "foam", "bottle", "bricks"], p=[0.4] + [0.15] * 4)
    )
    room = body.half

    def part(
        shape: str, at: np.ndarray, half: np.ndarray, times: float
    ) -> bias_bound.Solid:
        return bias_bound.Solid(
            shape, at, half, float(rng.uniform(0.0, 3.0)), times * body.mu
        )

    if kind == "drawn":
        return scan
    if kind == "wires":
        solids = [part("cylinder", np.append(rng.uniform(-0.5, 0.5, 2) * room[:2], 0.0),
                       np.array([0.06, 0.06, 1.0]) * room, 8.0) for _ in range(6)]  # fmt: skip
        return replace(scan, solids=[replace(body, mu=0.3 * body.mu), *solids])
    if kind == "foam":
        holes = [part("ellipsoid", rng.uniform(-0.5, 0.5, 3) * room,
                      np.full(3, rng.uniform(0.1, 0.16)) * room.min(), -1.0)
                 for _ in range(25)]  # fmt: skip
        return replace(scan, solids=[body, *holes])
    round_ = replace(
        body, kind="cylinder", half=np.array([*np.full(2, 0.9 * room[:2].min()), room[2]])
    )
    if kind == "bottle":
        inside = replace(round_, half=0.8 * round_.half, mu=-0.6 * body.mu)
        return replace(scan, solids=[round_, inside])
    bricks = [part("box", rng.uniform(-0.4, 0.4, 3) * room, rng.uniform(0.15, 0.3, 3) * room, 1.0)
              for _ in range(5)]  # fmt: skip
    return replace(scan, solids=[replace(body, mu=0.3 * body.mu), *bricks])


def drawn(
    seed: int, number: int
) -> tuple[bias_bound.Scan, str, float, np.ndarray] | None:
    """A scan, kind and size of its pixels' errors, and these (rows, cols); None of other
    scans."""
    rng = np.random.default_rng([seed, number, 77])
    scan = bias_bound.drawn(seed, number)
    if not scan.said.startswith(("whole", "turns")) or " cut " in scan.said:
        return None
    scan = thing(scan, rng)
    scan = replace(scan, counts=float(10.0 ** rng.uniform(3.5, 5.5)), drift=0.0)
    gain, kind = float(rng.choice(GAINS)), str(rng.choice(KINDS))
    errors = gain * rng.normal(size=scan.shape)
    if kind == "columns":
        errors = np.broadcast_to(errors[:1], scan.shape)
    if kind == "some":
        errors = errors * (rng.random(scan.shape) < SOME)
    return scan, kind, gain, np.asarray(errors, np.float32)


def judged(seed: int, number: int) -> Outcome | None:
    """What came of a drawn scan; None where it has no uniform region."""
    case = drawn(seed, number)
    if case is None:
        return None
    scan, kind, gain, errors = case
    clean = scan.images()
    grid = field_of_view(scan.geometry, scan.shape)
    truncation = truncation_of(clean.__getitem__, scan.geometry, scan.shape)
    x, y, z = grid.blank().centers()
    places = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1)
    truth = scan.truth(places)
    uniform = minimum_filter(truth, REGION_VOXELS) == maximum_filter(truth, REGION_VOXELS)
    uniform &= truth > 0.0

    def error(images: np.ndarray) -> float:
        """Root mean square error of a reconstruction of the images, where the truth is
        uniform [1/mm].
        """
        volume = fdk_parts(
            lambda: [images.copy()],
            scan.geometry,
            scan.shape,
            grid,
            truncation=truncation,
        )
        off = np.nan_to_num(volume.data)[uniform] - truth[uniform]
        return float(np.sqrt(np.square(off).mean()))

    if not uniform.any():
        return None
    ringed = clean + errors
    found = scan_rings(ringed.__getitem__, scan.geometry, scan.shape)
    usual = error(clean)
    return Outcome(
        scan.said, kind, gain, error(ringed) / usual, error(ringed - found) / usual
    )


def main() -> int:
    """Draw, correct and count."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the first draw")
    parser.add_argument("--seed", type=int, default=7)
    chosen = parser.parse_args()
    begun = time.process_time()
    found: list[Outcome] = []
    for number in range(chosen.first, chosen.first + chosen.count):
        try:
            one = judged(chosen.seed, number)
        except fx.TwinError:
            continue
        if one is None:
            continue
        found.append(one)
        if one.worse:
            print(f"{number}: {one}", flush=True)
    for gain in GAINS:
        some = [one for one in found if one.gain == gain]
        if some:
            ringed, corrected = (
                np.percentile([getattr(one, name) for one in some], [50, 100])
                for name in ("ringed", "corrected")
            )
            print(f"errors of {100 * gain:g} %, {len(some)} scans: error over that without, median "
                  f"and most: {ringed[0]:.2f}, {ringed[1]:.2f}; corrected {corrected[0]:.2f}, "
                  f"{corrected[1]:.2f}")  # fmt: skip
    worse = sum(one.worse for one in found)
    strong = [one.removed for one in found if one.ringed > 1.1]
    removed = float(np.median(strong)) if strong else 1.0
    print(f"{worse} of {len(found)} worse by more than 5 %; of {len(strong)} with errors that show "
          f"{100 * removed:.0f} % of their power removed (median); "
          f"{time.process_time() - begun:.0f} CPU s")  # fmt: skip
    return int(worse > 0 or removed < 0.5)


if __name__ == "__main__":
    sys.exit(main())
