"""Does a spoilt scan get the right name, and is none offered that is wrong?

`python tests/studies/causes_named.py [--each 2] [--seed 0] [--kinds a,b] [--pairs 0]
[--placed] [--panel flexray] [--json]` spoils scans of drawn bead phantoms in the ways of
`faults_drawn.KINDS`, calibrates each and says whether the cause was named right, vaguely or
not at all, and how many sigmas the worst of an answer that was offered is off. More than four
is a confident wrong answer, and the command fails. `--pairs N` draws N scans with two causes
or of unusual setups instead (`faults_paired`; a name of one, `strain_z+frame_lost@helix`, is
a kind, too). `--placed` joins scans of a phantom that is placed anew between them
(`placements_drawn`; so is a kind `slip@two_placements`). `--panel` takes another panel or
magnification. `--json` prints a line as soon as a scan is judged, one scan of every kind
before the second of any, and the sums last.

Geometry and shadows come from `faults_drawn`; nothing of the fit or of its diagnoses is in
them.
"""

from __future__ import annotations

import argparse
import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from flexdt.twin.calibration.bead_model import BeadModel
from flexdt.twin.calibration.detect.detection import Detections
from flexdt.twin.calibration.fit.fit import image_quantities
from flexdt.twin.calibration.fit.problem import Reading
from flexdt.twin.calibration.frame_source import (
    FrameSpots,
    FrameState,
    SpotFrames,
    nothing,
)
from flexdt.twin.calibration.pipeline import (
    Calibration,
    CalibrationRequest,
    Scan,
    calibrate,
)
from flexdt.twin.errors import TwinError
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from faults_drawn import DRAWS, KINDS, PANELS, UNSEEN, Faulty, drawn
from faults_paired import drawn_names, drawn_together
from placements_drawn import PLACED, PLACEMENTS, Placed, angles_apart, drawn_placed

WRONG_SIGMAS: Final = 4.0
FAULTLESS: Final = r"frames_|beads_missing|priors_narrow"
"""Findings that may stand beside a right name."""


@dataclass(frozen=True)
class Scored:
    """What came of one scan.

    Attributes:
        kind, seed: which.
        verdict: right, part, vague or none; right without a name where nothing had to be
            said, part where one cause of two was named.
        offered: numbers were offered.
        worst: largest error of them in sigmas; 0 if none were offered.
        where: the parameter that is so far off.
        said: the findings, with their codes.
    """

    kind: str
    seed: int
    verdict: str
    offered: bool
    worst: float
    where: str
    said: tuple[str, ...]

    @property
    def conditional(self) -> bool:
        """What was offered hangs on a value that was stated as exact, and that was said."""
        return any(s.startswith("held_unchecked") for s in self.said)

    @property
    def wrong(self) -> bool:
        """Offered without a condition, and far off."""
        return self.offered and self.worst > WRONG_SIGMAS and not self.conditional


def calibrated(
    scan: Faulty | Placed,
    per_frame: tuple[str, ...] = (),
    free: tuple[str, ...] = (),
    bead_tolerance_mm: float | None = None,
) -> Calibration:
    """Calibrate drawn scans from their spots, with the operator's beliefs.

    Args:
        scan: the scan, or several of one phantom.
        per_frame: parameters that may differ from frame to frame.
        free: parameters that are free beside the operator's.
        bead_tolerance_mm: standard deviation of the beads' places.
    """
    scans = scan.scans if isinstance(scan, Placed) else (scan,)
    b = scans[0].believed
    request = CalibrationRequest(
        free=tuple(dict.fromkeys((*b.free, *free))), start=Offsets.from_edge(b.held),
        priors=b.priors, second_look=False, per_frame=per_frame,
        bead_tolerance_mm=bead_tolerance_mm,
    )  # fmt: skip
    if isinstance(scan, Placed) and scan.per_scan:
        request = replace(request, reading=Reading.MOUNT_SHIFT, per_scan=scan.per_scan)
    return calibrate([_seen(one) for one in scans], BeadModel(b.beads, b.radii), request)


def _seen(scan: Faulty) -> Scan:
    """Return a drawn scan as a calibration takes it: its spots, and what is believed."""
    looks = []
    for frame in scan.spots:
        if frame is None:
            looks.append(FrameSpots(nothing(scan.shape), FrameState.MISSING))
            continue
        spots = Detections.of_points(frame[:, :2], scan.noise_px, frame[:, 2], scan.shape)
        outlines = replace(spots, bias=np.ones(len(frame)))
        looks.append(FrameSpots(outlines, FrameState.USABLE))
    b = scan.believed
    rise = b.pitch / 360.0 * b.angles
    stage = np.stack([0 * rise, 0 * rise + b.sod, rise], axis=1)
    poses = Poses.upright([0, 0, 0], stage, [0, b.sdd, 0], b.pixel, np.radians(b.angles))
    return Scan(SpotFrames(looks), poses, arc=b.arc)


def scored(kind: str, seed: int, panel: str = "flexray") -> Scored:
    """Draw a scan of a kind, of a pair or setup (`faults_paired`), or scans of several
    placements, calibrate, and judge findings and values; a refusal is scored, too. All but
    pairs and setups are of a machine of PANELS.
    """
    placed: Placed | None = None
    if kind in DRAWS:
        scan = drawn(kind, seed, panel)
        causes: tuple[tuple[str, ...], ...] = (scan.names,)
    elif kind.partition("@")[2] in PLACEMENTS:
        placed = drawn_placed(kind, seed, panel)
        scan = placed.scans[0]
        causes = (scan.names,)
    else:
        scan, causes = drawn_together(kind, seed)
    try:
        result = calibrated(placed or scan)
    except TwinError as error:
        said: tuple[str, ...] = (f"refused: {error}",)
        return Scored(
            kind, seed, _verdict(scan, causes, said, False), False, 0.0, "", said
        )
    said = tuple(f"{f.code}: {f.text}" for f in result.findings)
    worst, where = 0.0, ""
    if result.identifiable:
        worst, where = worst_error(result, placed or scan)
    verdict = _verdict(scan, causes, said, result.identifiable)
    return Scored(kind, seed, verdict, result.identifiable, worst, where, said)


def worst_error(result: Calibration, scan: Faulty | Placed) -> tuple[float, str]:
    """Find the parameter or image quantity with the largest error [sigma], and its name;
    (0, "") if all are exact.

    A parameter that moves may have any of its values, and image quantities any of theirs;
    where the motion was followed, they are those of its mean. They do not count where the
    phantom grows, or the spots were changed.
    """
    assert result.fit is not None
    worst, where = 0.0, ""
    truths = scan.truths if isinstance(scan, Placed) else scan.truth
    for name, e in result.fit.certificate.estimates.items():
        low, high = truths.get(name, (0.0, 0.0))
        value = e.value
        if name.startswith("alpha"):
            value = angles_apart(value, (low, high))
        off = max(low - value, value - high, 0.0) / max(e.sigma, 1e-12)
        if off > worst:
            worst, where = off, name
    scans = scan.scans if isinstance(scan, Placed) else (scan,)
    images = image_quantities(result.fit)
    # Without values of their own, scans have one geometry.
    for one, estimates in zip(scans, images, strict=len(images) > 1):
        moves = any(low < high for low, high in one.truth.values())
        told = any(low < high for low, high in one.image_ends.values())
        if one.after is not None or (moves and not told):
            continue
        for name, e in estimates.items():
            low = high = one.image.get(name, e.value)
            if moves and not result.motions:
                low, high = one.image_ends.get(name, (e.value, e.value))
            off = max(low - e.value, e.value - high) / max(e.sigma, 1e-12)
            if off > worst:
                worst, where = off, name
    return worst, where


def _verdict(
    scan: Faulty, causes: Sequence[Sequence[str]], said: Sequence[str], offered: bool
) -> str:
    """Judge what was said of a scan: "right", "part", "vague" or "none".

    Right is every expected finding without a false one, or nothing where the scan may be
    silent and was offered. Part is one cause's findings of several. Vague is something
    else, none nothing.
    """
    named = all(any(re.search(one, s) for s in said) for one in scan.names)
    others = [
        s
        for s in said
        if not re.match(FAULTLESS, s)
        and not _told_rightly(s, scan)
        and not any(re.search(one, s) for one in scan.names)
    ]
    false = [s for s in others if not any(re.search(one, s) for one in scan.beside)]
    if scan.silent and offered and not others:
        return "right"
    if scan.names and named:
        return "vague" if false else "right"
    if len(causes) > 1 and not false:
        for names in causes:
            if names and all(any(re.search(one, s) for s in said) for one in names):
                return "part"
    return "vague" if said else "none"


def _told_rightly(said: str, scan: Faulty) -> bool:
    """Check whether lengths are said to disagree of which one was drawn beyond two of the widths
    that are known of it.
    """
    names = re.findall(r"(d[OD]_[xyz]) is", said)
    far = [
        n
        for n in names
        if abs(np.mean(scan.truth.get(n, 0.0))) > 2 * UNSEEN.get(n, np.inf)
    ]
    return said.startswith("lengths_disagree") and bool(far)


def _to_judge(args: argparse.Namespace) -> list[tuple[str, int]]:
    """List the kinds and seeds of the scans to be judged: every kind in turn, or drawn
    pairs and setups.
    """
    kinds = args.kinds.split(",")
    if args.placed:
        some = [k for k in PLACED if k in kinds]
        kinds = [f"{kind}@{placements}" for kind in some for placements in PLACEMENTS]
    if args.pairs:
        return drawn_names(args.pairs, args.seed, kinds)
    seeds = range(args.seed, args.seed + args.each)
    return [(kind, seed) for seed in seeds for kind in kinds]


def main(argv: Sequence[str] | None = None) -> int:
    """Calibrate scans of each kind and print the counts, and every scan that was not
    judged right.

    Returns:
        1 if an answer is confidently wrong, else 0.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=2, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kinds", default=",".join(KINDS))
    parser.add_argument(
        "--pairs", type=int, default=0, help="scans of drawn pairs and setups"
    )
    parser.add_argument(
        "--placed", action="store_true", help="join scans of several placements"
    )
    parser.add_argument("--panel", choices=PANELS, default="flexray", help="of the scans")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    if args.pairs and args.panel != "flexray":
        parser.error("pairs and setups are of the panel flexray")
    all_of_them = []
    for kind, seed in _to_judge(args):
        all_of_them.append(scored(kind, seed, args.panel))
        if args.json:
            print(json.dumps(asdict(all_of_them[-1])), flush=True)
    wrong = [s for s in all_of_them if s.wrong]
    right = sum(s.verdict == "right" for s in all_of_them)
    offered = [s for s in all_of_them if s.offered]
    summary = {
        "scans": len(all_of_them), "kinds": len({s.kind for s in all_of_them}), "right": right,
        "offered": len(offered), "conditional": sum(s.conditional for s in offered),
        "wrong": len(wrong),
        "largest_sigmas": max((s.worst for s in offered if not s.conditional), default=math.nan),
        "with_a_condition": max((s.worst for s in offered if s.conditional), default=math.nan),
    }  # fmt: skip
    if args.json:
        print(json.dumps(summary))
        return 1 if wrong else 0
    for s in all_of_them:
        if s.verdict != "right" or s.wrong:
            print(
                f"{s.kind} {s.seed}: {s.verdict}, offered {s.offered}, {s.worst:.1f} {s.where}"
            )
            for line in s.said:
                print("   ", line)
    print(", ".join(f"{n} {v:.4g}" for n, v in summary.items()))
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
