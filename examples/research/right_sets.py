"""Do the intervals of right scans hold, with everything that a calibration looks for?

`python examples/research/right_sets.py [--scans 500] [--seed 0] [--json]` draws scanners and
phantoms from their assumed tolerances (`as_assumed` of `faults_drawn`: all offsets of detector
and axis, stretches and shears of the phantom), calibrates their spots with all causes, and
counts refusals, truths inside the 95 % intervals, and those of all parameters together inside
the joint 95 % region. The command fails if more than 2 % are refused, or if an answer is more
than four sigmas off.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from causes_named import WRONG_SIGMAS, calibrated
from faults_drawn import drawn

from flexdt.twin.errors import TwinError

KIND: Final = "as_assumed"
MOST_REFUSED: Final = 0.02
"""Largest share of right scans that may be refused."""


@dataclass(frozen=True)
class Covered:
    """What a right scan's calibration covers.

    Attributes:
        seed: of the scan.
        pulls: parameter -> error in stated standard deviations.
        inside: parameter -> whether the truth is in its 95 % interval.
        joint: whether all parameters together are in the joint 95 % region.
    """

    seed: int
    pulls: dict[str, float]
    inside: dict[str, bool]
    joint: bool


def covered(seed: int) -> Covered | None:
    """Calibrate a drawn right scan and compare it with its truth; None if it is refused."""
    scan = drawn(KIND, seed)
    try:
        result = calibrated(scan)
    except TwinError:
        return None
    if not result.identifiable or result.fit is None:
        return None
    certificate = result.fit.certificate
    known = {}
    for name, e in certificate.estimates.items():
        true = scan.truth.get(name, (0.0, 0.0))[0]
        if name == "alpha":
            true = e.value + (true - e.value + 180.0) % 360.0 - 180.0
        known[name] = true
    some = {n: e for n, e in certificate.estimates.items() if e.sigma > 0}
    pulls = {n: (e.value - known[n]) / e.sigma for n, e in some.items()}
    inside = {n: e.low <= known[n] <= e.high for n, e in some.items()}
    joint = certificate.inside_95({n: known[n] for n in some})
    return Covered(seed, pulls, inside, joint)


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate right scans and print the shares that are covered.

    Returns:
        1 if too many are refused or an answer is far off, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    offered = []
    refused = []
    for seed in range(args.seed, args.seed + args.scans):
        one = covered(seed)
        if one is None:
            refused.append(seed)
        else:
            offered.append(one)
    names = list(dict.fromkeys(n for one in offered for n in one.inside))
    values = [v for one in offered for v in one.inside.values()]
    pulls = [(abs(p), n, one.seed) for one in offered for n, p in one.pulls.items()]
    worst = max(pulls, default=(0.0, "", 0))
    found = {
        "scans": args.scans,
        "refused": refused,
        "values": len(values),
        "values_inside_pct": 100.0 * float(np.mean(values)),
        "joint_inside_pct": 100.0 * float(np.mean([one.joint for one in offered])),
        "inside_pct": {
            n: 100.0 * float(np.mean([o.inside[n] for o in offered if n in o.inside]))
            for n in names
        },
        "largest_sigmas": worst,
    }
    if args.json:
        print(json.dumps(found))
    else:
        for what, value in found.items():
            print(f"{what}: {value}")
    return int(len(refused) > MOST_REFUSED * args.scans or worst[0] > WRONG_SIGMAS)


if __name__ == "__main__":
    raise SystemExit(main())
