"""How well is a distorted panel found, and are the intervals true with it?

`python examples/research/panel_distortion.py [--each 25] [--seed 100]` calibrates scans whose
panel is distorted as `faults_drawn` draws it (radially, decentred, by any cubic, or with a gap
between tiles; panel and axis off their nominal places by the usual amounts) and prints how far
the distortion that was found is from the true one, and pulls and coverage of the offsets.

Shifts, turns, scales and perspective belong to the offsets; they are removed from the
difference of the distortions.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from causes_named import calibrated
from faults_drawn import drawn

KINDS = ("radial", "decentred", "bent", "tiles_apart")
SEEN = (np.linspace(300, 655, 12), np.linspace(150, 610, 12))
"""Columns and rows between which beads are seen."""


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate scans with distorted panels, and print how much of the distortion is left
    [px], and pulls of the parameters.

    Shifts that a geometry can make are taken off first. Returns 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=25, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=100)
    args = parser.parse_args(argv)
    pulls: dict[str, list[float]] = {}
    offered = found = 0
    for kind in KINDS:
        rest = []
        for seed in range(args.seed, args.seed + args.each):
            scan = drawn(kind, seed)
            result = calibrated(scan)
            if not result.identifiable or result.fit is None:
                continue
            offered += 1
            for name, e in result.fit.certificate.estimates.items():
                off = e.value - scan.truth.get(name, (0.0, 0.0))[0]
                off = (off + 180.0) % 360.0 - 180.0 if name == "alpha" else off
                pulls.setdefault(name, []).append(off / e.sigma)
            panel = result.fit.panel
            if panel is None:
                continue
            found += 1
            before = np.array([(c, r, 0.0) for c in SEEN[0] for r in SEEN[1]])
            assert scan.after is not None
            (after,) = scan.after([before.copy()])
            assert after is not None
            off = (panel.shift(after[:, :2]) - (after - before)[:, :2]).T.ravel()
            x, y = ((after[:, :2] - [477.5, 379.5]) / 300.0).T
            one, none = np.ones_like(x), np.zeros_like(x)
            columns = np.stack([one, none, x, y, none, none, x * x, x * y], axis=1)
            rows = np.stack([none, one, none, none, x, y, x * y, y * y], axis=1)
            geometry = np.concatenate([columns, rows])
            off -= geometry @ np.linalg.lstsq(geometry, off, rcond=None)[0]
            rest.append(float(np.sqrt(np.mean(off**2))))
        print(
            f"{kind}: rms of the distortion {np.median(rest):.4f} px, at worst {max(rest):.3f}"
        )
    print(
        f"{len(KINDS) * args.each} scans, {offered} offered, {found} with the distortion named"
    )
    for name, values in pulls.items():
        print(f"{name:12} pulls {np.sqrt(np.mean(np.square(values))):.2f}")
    every = np.abs(np.concatenate(list(pulls.values())))
    print(
        f"largest {every.max():.1f} sigma; {100 * np.mean(every < 1.96):.1f} % within 1.96"
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
