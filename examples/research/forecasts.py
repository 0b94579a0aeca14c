"""Do calibrations state the sigmas that were forecast?

`python examples/research/forecasts.py [--scans 40] [--seed 0] [--json]` draws scans of 8 to 240
frames, 4 to 8 balls, magnifications 1.3 to 6 and panels of 190 to 1912 columns, with scanners
and phantoms within their assumed tolerances, calibrates their spots with all causes, and divides
each stated sigma by that of `identifiability` at the true place of the object. The shadows are
those of `faults_drawn`.

How much a scan leaves open depends on how far its own phantom is strained, and a drift that the
noise looks like widens what it may hide, so that single scans differ by more. The command fails
if a median differs by MEDIAN_OFF, or if fewer than LEAST_ALIKE of a parameter's ratios are
within ALIKE.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from faults_drawn import SHAPE, SIX, UNSEEN, World, shadows

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.diagnose.identifiability import identifiability
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import CalibrationRequest, Scan, calibrate
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

PANELS: Final = (
    (190, 239, 0.2992),
    (380, 478, 0.2992),
    (760, 956, 0.1496),
    (1520, 1912, 0.0748),
)
"""Rows, columns and pitch [mm]."""
ALIKE: Final = 1.25
"""Factor within which a stated sigma is as forecast."""
LEAST_ALIKE: Final = 0.8
MEDIAN_OFF: Final = 0.1


def ratios(seed: int, causes: bool = True) -> dict[str, float] | None:
    """Draw and calibrate a scan, and divide its stated sigmas by the forecast ones.

    Args:
        seed: of the scan.
        causes: forecast what causes leave open, too.

    Returns:
        Of the six parameters and the quantities in the image; None if it is refused.
    """
    rng = np.random.default_rng([seed, 12])
    frames = int(rng.choice([8, 12, 24, 36, 60, 120, 240]))
    rows, cols, pixel = PANELS[int(rng.integers(len(PANELS)))]
    sdd = float(rng.uniform(500.0, 1100.0))
    magnification = float(rng.uniform(1.3, 6.0))
    sod = sdd / magnification
    reach = min(rng.uniform(0.4, 0.8) * rows * pixel / 2 / magnification, 0.3 * sod)
    beads = _beads(rng, int(rng.integers(4, 9)), reach)
    radii = np.full(len(beads), 0.04 * reach)
    noise = float(rng.uniform(0.005, 0.04))
    sizes = (0.1 * reach, 0.1 * reach, 0.02 * sod, 20.0, 0.05 * reach, 0.05 * reach)
    six = {n: float(s * rng.uniform(-1, 1)) for n, s in zip(SIX, sizes, strict=True)}
    unseen = {n: float(w * rng.normal()) for n, w in UNSEEN.items()}
    strain = 1e-3 * rng.normal(size=(3, 3)) + (1.0 + 1e-3 * rng.normal()) * np.eye(3)
    angles = 360.0 * np.arange(frames) / frames
    shown = np.ones((frames, len(beads)), dtype=bool)
    world = World(
        beads @ strain.T, radii, {**six, **unseen}, angles, np.zeros((frames, 3)), shown,
        sod, sdd, pixel,
    )  # fmt: skip
    centres, spot_sizes = shadows(world)
    centres = centres + (np.array([cols, rows]) - SHAPE[::-1]) / 2
    looks = []
    for places, size in zip(centres, spot_sizes, strict=True):
        spots = places + noise * rng.normal(size=places.shape)
        inside = (spots > size[:, None]) & (
            spots < np.array([cols, rows]) - size[:, None]
        )
        order = rng.permutation(np.flatnonzero(inside.all(axis=1)))
        found = Detections.of_points(spots[order], noise, size[order], (rows, cols))
        outlines = replace(found, bias=np.ones(len(order)))
        looks.append(FrameSpots(outlines, FrameState.USABLE))
    poses = Poses.upright([0, 0, 0], [0, sod, 0], [0, sdd, 0], pixel, np.radians(angles))
    model = BeadModel(beads, radii)
    request = CalibrationRequest(second_look=False)
    result = calibrate([Scan(SpotFrames(looks), poses)], model, request)
    if not result.identifiable or result.fit is None:
        return None
    planned = identifiability(
        model, poses, noise, shape=(rows, cols), at=Offsets.from_edge(six), causes=causes
    )
    (seen,) = image_quantities(result.fit)
    stated = result.fit.sigmas | {n: e.sigma for n, e in seen.items()}
    expected = planned.sigmas | planned.image_sigmas
    return {n: stated[n] / sigma for n, sigma in expected.items()}


def _beads(rng: np.random.Generator, count: int, reach: float) -> np.ndarray:
    """Draw balls apart from each other in a box of 1.4 x 1.4 x 1.8 reaches, (count, 3)
    [mm]."""
    while True:
        beads = rng.uniform(-1, 1, size=(count, 3)) * [
            0.7 * reach,
            0.7 * reach,
            0.9 * reach,
        ]
        apart = np.linalg.norm(beads[:, None] - beads, axis=2)[~np.eye(count, dtype=bool)]
        if apart.min() > 0.3 * reach and np.ptp(beads[:, 2]) > 0.8 * reach:
            return beads


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate drawn scans and print how stated and forecast sigmas compare.

    Returns:
        1 if they do not, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    every = [ratios(seed) for seed in range(args.seed, args.seed + args.scans)]
    some = [one for one in every if one is not None]
    found = {}
    for name in some[0]:
        values = np.array([one[name] for one in some])
        found[name] = {
            "median": float(np.median(values)),
            "least": float(values.min()),
            "largest": float(values.max()),
            "alike": float(np.mean(np.abs(np.log(values)) < math.log(ALIKE))),
        }
    if args.json:
        print(json.dumps({"scans": args.scans, "offered": len(some), "ratios": found}))
    else:
        print(f"{len(some)} of {args.scans} offered; stated over forecast sigma:")
        for name, row in found.items():
            print(f"  {name:14}" + "  ".join(f"{k} {v:.2f}" for k, v in row.items()))
    return int(
        any(
            abs(row["median"] - 1.0) > MEDIAN_OFF or row["alike"] < LEAST_ALIKE
            for row in found.values()
        )
    )


if __name__ == "__main__":
    raise SystemExit(main())
