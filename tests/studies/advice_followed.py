"""Does following the advice of a calibration end in a right or a more careful answer?

    python tests/studies/advice_followed.py [--each 4] [--seed 0] [--kinds a,b]
        [--per-frame dO_x/dS_x,dO_y] [--json]

Scans are spoilt in the ways of `faults_drawn.KINDS` and calibrated; every argument that a
finding advises (`--per-frame ...`, `free ... too`, `--bead-tolerance`) is given to a second
calibration of the same scan. That must be refused, or right within 4 sigma. `--per-frame`
gives each scan further lists of parameters that may move, whatever its findings say: a source
that jumped is followed as an object, an object as a source. A line for each argument and code
says how often it was followed, and what came of it; exit code 1 where an answer was wrong.

Shadows come from `faults_drawn`, which shares nothing with what is tested.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from causes_named import WRONG_SIGMAS, calibrated, worst_error

from flexdt.twin.errors import TwinError

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from faults_drawn import KINDS, drawn

BEAD_TOLERANCE_MM: Final = 0.1
"""What is given where `--bead-tolerance` is advised without a value."""
PER_FRAME: Final = re.compile(r"--per-frame ([\w,]+)")
FREE: Final = re.compile(r"free ([\w, ]+?)(?: too|$)")
ADVISED: Final = (
    "drift_across", "drift_along", "screw", "jump_across", "spot_drift", "runout", "wobble",
    "vibration", "angle_factor", "endpoint", "slip", "sdd_far_off", "panel_far_rolled",
    "axis_far_aslant", "tau_held", "height_held", "across_held", "strain_x", "strain_z", "grows",
    "source_jumps", "source_jumps_up", "source_jumps_along", "source_drifts",
    "source_drifts_up", "object_jumps", "object_jumps_up", "object_jumps_along",
    "object_jumps_twice", "panel_jumps", "panel_jumps_up", "other_pitch",
)  # fmt: skip
"""Kinds of faults whose findings advise arguments. Not among them: `four_tiles`, whose tiles
may have no name."""


@dataclass(frozen=True)
class Followed:
    """What came of an argument that was followed.

    Attributes:
        kind, seed: of the scan.
        code: of the finding.
        argument: that it advises.
        offered: numbers were offered.
        worst: largest error of them in sigmas; 0 if none were offered.
        where: the parameter that is so far off.
        before: the largest error of what was offered without it.
        moving: parameters that were found to move.
        said: codes of the findings.
    """

    kind: str
    seed: int
    code: str
    argument: str
    offered: bool
    worst: float
    where: str
    before: float
    moving: tuple[str, ...] = ()
    said: tuple[str, ...] = ()

    @property
    def wrong(self) -> bool:
        """Whether the answer is far off."""
        return self.worst > WRONG_SIGMAS


def arguments(text: str) -> Iterator[tuple[str, dict[str, object]]]:
    """Give each argument that a finding advises, and the options of a calibration with it."""
    for found in PER_FRAME.finditer(text):
        yield found[0], {"per_frame": tuple(found[1].split(","))}
    for found in FREE.finditer(text):
        names = tuple(re.findall(r"\w+", found[1]))
        yield f"free {','.join(names)}", {"free": names}
    if "--bead-tolerance" in text:
        yield "--bead-tolerance", {"bead_tolerance_mm": BEAD_TOLERANCE_MM}


def followed(
    kind: str, seed: int, per_frame: Sequence[tuple[str, ...]] = ()
) -> list[Followed]:
    """Calibrate a drawn scan, and once more with each argument that its findings advise.

    Args:
        kind: of scan.
        seed: the same gives the same scan.
        per_frame: lists of parameters that may move, which are tried, too.

    Returns:
        One for each argument advised; a refusal counts as not offered.
    """
    scan = drawn(kind, seed)
    first = calibrated(scan)
    before = worst_error(first, scan)[0] if first.identifiable else 0.0
    advised = [
        (finding.code, argument, options)
        for finding in first.findings
        for argument, options in arguments(finding.text)
    ]
    for names in per_frame:
        advised.append(("asked", f"--per-frame {','.join(names)}", {"per_frame": names}))
    out = []
    for code, argument, options in advised:
        offered = False
        worst = 0.0
        where = ""
        moving: tuple[str, ...] = ()
        said: tuple[str, ...] = ()
        try:
            found = calibrated(scan, **options)
        except TwinError:
            pass
        else:
            offered = found.identifiable
            said = tuple(finding.code for finding in found.findings)
            if found.motions:
                motion = found.motions[0]
                moves = motion.values.any(axis=0).tolist()
                moving = tuple(n for n, m in zip(motion.names, moves, strict=True) if m)
            if offered:
                worst, where = worst_error(found, scan)
        out.append(
            Followed(
                kind, seed, code, argument, offered, worst, where, before, moving, said
            )
        )
    return out


def main(argv: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--each", type=int, default=4, help="scans of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--kinds", default=",".join(ADVISED), help=f"of {', '.join(KINDS)}"
    )
    parser.add_argument(
        "--per-frame", default="", help="further lists, with / between them"
    )
    parser.add_argument(
        "--json", action="store_true", help="a line for each argument as well"
    )
    args = parser.parse_args(argv)
    lists = [tuple(some.split(",")) for some in args.per_frame.split("/") if some]
    runs: list[Followed] = []
    for kind in args.kinds.split(","):
        for seed in range(args.seed, args.seed + args.each):
            runs += followed(kind, seed, lists)
            if args.json:
                for run in runs:
                    if (run.kind, run.seed) == (kind, seed):
                        print(json.dumps(asdict(run)), flush=True)
    by_advice: dict[tuple[str, str], list[Followed]] = defaultdict(list)
    for run in runs:
        by_advice[run.code, run.argument].append(run)
    for (code, argument), some in sorted(by_advice.items()):
        offered = [run for run in some if run.offered]
        print(
            f"{code}: {argument}: followed {len(some)} times, offered {len(offered)}, worst "
            f"{max((run.worst for run in offered), default=0.0):.1f} sigma"
        )
    wrong = [run for run in runs if run.wrong]
    for run in wrong:
        print(json.dumps(asdict(run)))
    print(f"{len(runs)} followed, {len(wrong)} wrong")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
