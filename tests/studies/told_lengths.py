"""Is a told length that is wrong ever believed, and are right ones as sure as they may be?

`python tests/studies/told_lengths.py [--kinds helix,places,steps,others,pixel] [--draws 20]
[--wrong 0.0003,0.03 | 0] [--seed 0] [--scans 2] [--strain 1e-3] [--json]` draws scans of which
one told length is off by a part between both numbers (log-uniform, either sign), calibrates
them, and prints how many sigmas the worst of what is offered is off. More than four is a
confident wrong answer, and the command fails. With `--wrong 0` all told lengths are right, and
the standard deviation of the pulls of each parameter is printed, too.

Geometry and shadows come from `told_lengths_drawn`; nothing of the fit is in them.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.frame_source import FrameSpots, FrameState, SpotFrames
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.geometry.poses import Poses

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from told_lengths_drawn import KINDS, NOISE_PX, SHAPE, Told, ToldScan, drawn_told

WRONG_SIGMAS: Final = 4.0
PULLS: Final = ("dO_x", "dO_z", "tau_x", "tau_z", "axis_column", "magnification")


@dataclass(frozen=True)
class Judged:
    """What came of one draw.

    Attributes:
        wrong: relative error of the told length.
        offered: numbers were offered.
        worst, where: largest error of them in sigmas, and its name.
        pulls: error over sigma of some.
        sigmas: of the same.
        said: codes of the findings.
    """

    kind: str
    seed: int
    wrong: float
    offered: bool
    worst: float
    where: str
    pulls: dict[str, float]
    sigmas: dict[str, float]
    said: tuple[str, ...]
    cpu_s: float


def as_scan(scan: ToldScan, name: str = "scan") -> Scan:
    """Return a drawn scan as a calibration takes it."""
    looks = []
    for frame in scan.spots:
        spots = Detections.of_points(frame[:, :2], NOISE_PX, frame[:, 2], SHAPE)
        outlines = replace(spots, bias=np.ones(len(frame)))
        looks.append(FrameSpots(outlines, FrameState.USABLE))
    poses = Poses.upright(
        scan.source, scan.axis, scan.detector, scan.pixel, np.radians(scan.angles)
    )
    return Scan(SpotFrames(looks), poses, name)


def calibrated(told: Told, **request: object) -> Calibration:
    """Calibrate drawn scans from their spots."""
    asked = CalibrationRequest(second_look=False, priors=told.priors, **request)  # type: ignore[arg-type]
    scans = [as_scan(scan, f"scan {i + 1}") for i, scan in enumerate(told.scans)]
    return calibrate(scans, BeadModel(told.beads, told.radii), asked)


def judged(kind: str, seed: int, wrong: float, told: Told) -> Judged:
    """Calibrate a draw, and compare what is offered with the truth."""
    start = time.process_time()
    result = calibrated(told)
    cpu = time.process_time() - start
    said = tuple(f"{f.code}" for f in result.findings)
    if not result.identifiable or result.fit is None:
        return Judged(kind, seed, wrong, False, 0.0, "", {}, {}, said, cpu)
    pulls, sigmas = {}, {}
    for name, e in result.fit.certificate.estimates.items():
        if name not in told.truth:
            continue
        low, high = told.truth[name]
        value = e.value
        if name == "alpha":
            value = low + math.remainder(value - low, 360.0)
        off = value - high if value > high else min(value - low, 0.0)
        pulls[name], sigmas[name] = off / e.sigma, e.sigma
    for group, seen in enumerate(image_quantities(result.fit)):
        e = seen["axis_column"]
        key = "axis_column" if group == 0 else f"axis_column@{group}"
        column = told.columns[min(group, len(told.columns) - 1)]
        pulls[key], sigmas[key] = (e.value - column) / e.sigma, e.sigma
        if group == 0:
            e = seen["magnification"]
            off = e.value - told.magnification[0]
            pulls["magnification"] = off / e.sigma
            sigmas["magnification"] = e.sigma / e.value
    where = max(pulls, key=lambda n: abs(pulls[n]))
    return Judged(
        kind, seed, wrong, True, abs(pulls[where]), where, pulls, sigmas, said, cpu
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate the draws and print each; returns 1 if one is confidently wrong, else 0."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument("--draws", type=int, default=20, help="of each kind")
    parser.add_argument("--wrong", default="0.0003,0.03")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scans", type=int, default=2)
    parser.add_argument("--strain", type=float, default=1e-3)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    ends = [float(w) for w in args.wrong.split(",")]
    results = []
    for seed in range(args.seed, args.seed + args.draws):
        for kind in args.kinds.split(","):
            rng = np.random.default_rng([seed, 77, *kind.encode()])
            wrong = 0.0
            if ends[-1] > 0.0:
                wrong = float(np.exp(rng.uniform(*np.log(ends)))) * rng.choice([-1, 1])
            told = drawn_told(kind, seed, wrong, scans=args.scans, strain=args.strain)
            one = judged(kind, seed, wrong, told)
            results.append(one)
            if args.json:
                print(json.dumps(one.__dict__), flush=True)
            else:
                end = f"{one.worst:5.1f} {one.where}" if one.offered else "  withheld"
                some = {n: float(f"{s:.2g}") for n, s in one.sigmas.items() if n in PULLS}
                print(
                    f"{kind:7s} {seed:3d} {100 * wrong:+7.3f} % {end:22s} {one.cpu_s:5.1f} s "
                    f"{some} {' '.join(one.said)}",
                    flush=True,
                )
    bad = [r for r in results if r.worst > WRONG_SIGMAS]
    offered = [r for r in results if r.offered]
    print(f"{len(results)} draws, {len(offered)} offered, {len(bad)} beyond 4 sigma")
    for name in PULLS:
        pulls = [r.pulls[name] for r in offered if name in r.pulls]
        if pulls:
            print(f"  pulls of {name}: rms {math.sqrt(np.mean(np.square(pulls))):.2f}")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
