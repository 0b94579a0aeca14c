"""Do the intervals of right scans hold, with everything that a calibration looks for?

`python tests/studies/right_sets.py [--scans 500] [--seed 0] [--kind as_assumed] [--json]`
draws scanners and phantoms from their assumed tolerances (`RIGHT` of `faults_drawn`: all
offsets of detector and axis, the pixel pitch, the phantom's scale, stretches and shears),
calibrates their spots with all causes, and counts refusals, truths inside the 95 % intervals,
and those of all parameters together inside the joint regions of LEVELS.

What the calibration assumes of causes is drawn with `--kind with_causes`, and with
`--kind with_motion` also what moves. `as_assumed` has none of the causes that a calibration
leaves open, so that its regions may contain more than they say. The command fails if the 95 %
region does not contain what is ASKED, but for two binomial standard deviations, if another
region contains fewer than it says by FAR_SIGMAS, if an answer is more than four sigmas off, or
if more than 2 % of `as_assumed` are refused.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from causes_named import WRONG_SIGMAS, calibrated

from flexdt.twin.errors import TwinError

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from faults_drawn import RIGHT, drawn

MOST_REFUSED: Final = 0.02
"""Largest share of right scans that may be refused."""
LEVELS: Final = (0.5, 0.8, 0.95, 0.99)
ASKED: Final = (0.93, 0.97)
"""Share of truths that the joint 95 % region is to contain."""
FAR_SIGMAS: Final = 4.0
"""Binomial standard deviations from which a share is not as stated."""


@dataclass(frozen=True)
class Covered:
    """What a right scan's calibration covers.

    Attributes:
        seed: of the scan.
        pulls: parameter -> error in stated standard deviations.
        inside: parameter -> whether the truth is in its 95 % interval.
        level: of the smallest joint region that contains all parameters together, 0 to 1: evenly
            distributed if regions contain as many truths as they say.
    """

    seed: int
    pulls: dict[str, float]
    inside: dict[str, bool]
    level: float


def covered(kind: str, seed: int) -> Covered | None:
    """Calibrate a drawn right scan and compare it with its truth; None if it is refused."""
    scan = drawn(kind, seed)
    try:
        result = calibrated(scan)
    except TwinError:
        return None
    if not result.identifiable or result.fit is None:
        return None
    certificate = result.fit.certificate
    known = {}
    for name, e in certificate.estimates.items():
        true = scan.truth[name][0]  # No default: what is not stated is not 0.
        if name == "alpha":
            true = e.value + (true - e.value + 180.0) % 360.0 - 180.0
        known[name] = true
    some = {n: e for n, e in certificate.estimates.items() if e.sigma > 0}
    pulls = {n: (e.value - known[n]) / e.sigma for n, e in some.items()}
    inside = {n: e.low <= known[n] <= e.high for n, e in some.items()}
    level = certificate.level({n: known[n] for n in some})
    return Covered(seed, pulls, inside, level)


def shares(levels: Sequence[float]) -> dict[float, float]:
    """Compute the share of truths inside the region of each of LEVELS."""
    return {level: float(np.mean(np.less_equal(levels, level))) for level in LEVELS}


def off(levels: Sequence[float]) -> dict[float, float]:
    """Compute by how many binomial standard deviations each of `shares` differs from its
    level, positive where more truths are inside.
    """
    return {
        level: (share - level) / math.sqrt(level * (1.0 - level) / len(levels))
        for level, share in shares(levels).items()
    }


def contains_what_is_asked(levels: Sequence[float]) -> bool:
    """Check that the 95 % region contains what is ASKED, and no region too few."""
    share = shares(levels)[0.95]
    counting = 2.0 * math.sqrt(share * (1.0 - share) / len(levels))
    least, most = ASKED
    inside = least - counting <= share <= most + counting
    return inside and min(off(levels).values()) > -FAR_SIGMAS


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate right scans and print the shares that are covered.

    Returns:
        1 if too many are refused, or an answer or a share is far off, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scans", type=int, default=500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", choices=[*RIGHT], default="as_assumed")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    offered = []
    refused = []
    for seed in range(args.seed, args.seed + args.scans):
        one = covered(args.kind, seed)
        if one is None:
            refused.append(seed)
        else:
            offered.append(one)
    names = list(dict.fromkeys(n for one in offered for n in one.inside))
    values = [v for one in offered for v in one.inside.values()]
    pulls = [(abs(p), n, one.seed) for one in offered for n, p in one.pulls.items()]
    worst = max(pulls, default=(0.0, "", 0))
    levels = [one.level for one in offered]
    far = off(levels)
    found = {
        "kind": args.kind,
        "scans": args.scans,
        "refused": refused,
        "values": len(values),
        "values_inside_pct": 100.0 * float(np.mean(values)),
        "joint_inside_pct": {
            f"{100 * n:g}": 100.0 * v for n, v in shares(levels).items()
        },
        "joint_off_sigmas": {f"{100 * n:g}": v for n, v in far.items()},
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
    many = args.kind == "as_assumed" and len(refused) > MOST_REFUSED * args.scans
    wrong = worst[0] > WRONG_SIGMAS
    return int(many or wrong or not contains_what_is_asked(levels))


if __name__ == "__main__":
    raise SystemExit(main())
