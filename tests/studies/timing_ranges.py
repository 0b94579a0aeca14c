"""Do the 90 % ranges of a fitted machine hold 90 % of the times of its next scan?

    python tests/studies/timing_ranges.py [--machines 50] [--seed 17] [--families NAME ...]
    [--json]

Each simulated machine has limits, rates and times of its own and runs one to four scans, whose
logs are fitted, and then another one, whose lines and total are compared with their ranges.
Where its axes stand before that scan is known. Its times follow a family that the fit does not
know: lognormal, bimodal (some commands of a kind take much longer) or drifting (everything
becomes slower from line to line). Not among the 50 unless asked for are `daily`: all times
of a scan share a factor; and those of `timed_rigs.COMPARED` and `UNSEEN`.

The logs are written by `timed_rigs.py`, byte by byte, with kinematics and times of its own; of
flexdt only the reader, the fit and the comparison are used.

Each share has two standard errors: binomial, as if all lines were independent, and from how the
machines differ, since the lines of a machine share its fit.
"""

from __future__ import annotations

import argparse
import json
import math
import random
import statistics
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from flexdt.twin.machine.description import Machine, Timing, builtin_machine
from flexdt.twin.script.executed_log import Executed, read_log
from flexdt.twin.script.log_fit import LogComparison, fit_machine

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from timed_rigs import COMPARED, DAILY, FAMILIES, UNSEEN, Rig, Scan

FEW = 3
"""Times of a kind from which on its range is to hold 88 to 92 %."""


def base() -> Machine:
    """A machine that knows nothing of the rigs."""
    machine = builtin_machine("unitom_xl")
    wide = {"lower": -1e5, "upper": 1e5, "max_speed": 1e3, "max_acceleration": 1e3}
    axes = {name: axis.model_copy(update=wide) for name, axis in machine.axes.items()}
    return machine.model_copy(update={"axes": axes, "timing": Timing(source="assumed")})


def lines(log: bytes) -> tuple[Executed, ...]:
    """The lines of a log that was written here; nothing may be wrong with them."""
    found, problems = read_log(log)
    if problems:
        raise ValueError(str(problems[0]))
    return found


def next_scan(rig: Rig, logs: int) -> tuple[LogComparison, int]:
    """The scan after `logs` others, beside its prediction; and how many limits are fitted
    wrong."""
    read = [lines(Scan(rig).run()) for _ in range(logs)]
    machine = fit_machine(read, base(), "simulated").machine
    wrong = sum(
        (axis.lower, axis.upper, axis.max_speed, axis.max_acceleration)
        != rig.limits[name]
        for name, axis in machine.axes.items()
        if name in rig.limits
    )
    stands = {
        name: axis.model_copy(update={"home": rig.at.get(name, axis.home)})
        for name, axis in machine.axes.items()
    }
    machine = machine.model_copy(update={"axes": stands})
    return LogComparison.of(lines(Scan(rig).run()), machine), wrong


def share(parts: list[list[bool]]) -> dict[str, float]:
    """Part of all that is true, in percent, with its standard errors; one list a machine."""
    every = [x for part in parts for x in part]
    held = sum(every) / len(every)
    between = [sum(part) - held * len(part) for part in parts]
    return {
        "percent": 100.0 * held,
        "binomial": 100.0 * math.sqrt(held * (1.0 - held) / len(every)),
        "machines": 100.0 * math.sqrt(sum(x * x for x in between)) / len(every),
        "n": len(every),
    }


def study(machines: int, seed: int, families: Sequence[str] = FAMILIES) -> dict[str, Any]:
    """Lines and totals inside their range: of all machines, by family, number of logs and
    kind."""
    held: dict[str, list[list[bool]]] = defaultdict(list)
    relative: dict[str, list[float]] = defaultdict(list)
    widths, wrong = [], 0
    for index in range(machines):
        rng = random.Random(f"{seed}/{index}")
        rig = Rig(rng, families[index % len(families)])
        logs = rng.randrange(1, 5)
        found, bad = next_scan(rig, logs)
        wrong += bad
        low, high = found.total_range or (math.nan, math.nan)
        total = [low <= found.total_real_s <= high]
        widths.append((high - low) / found.total_real_s)
        inside = [bool(row.inside) for row in found.rows]
        for group in ("all", rig.family, f"after {logs} logs"):
            held[f"lines, {group}"].append(inside)
            held[f"totals, {group}"].append(total)
        kinds: dict[str, list[bool]] = defaultdict(list)
        for row in found.rows:
            kinds[row.kind].append(bool(row.inside))
        timing = found.machine.timing
        for kind, parts in kinds.items():
            held[f"lines, kind {kind}"].append(parts)
            known = timing.spread.get(kind)
            if known is not None and known.n >= FEW:
                held[f"lines, kind {kind}, n >= {FEW}"].append(parts)
                relative[kind].append(
                    (known.p95_s - known.p5_s) / max(timing.seconds(kind), 1e-3)
                )
    return {
        "machines": machines,
        "seed": seed,
        "inside": {group: share(parts) for group, parts in sorted(held.items())},
        "width_percent": {
            k: 100.0 * statistics.median(w) for k, w in sorted(relative.items())
        },
        "total_width_percent": 100.0 * statistics.median(widths),
        "limits_wrong": wrong,
    }


def main() -> None:
    """Study drawn machines and print how often the ranges held."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--machines", type=int, default=50)
    parser.add_argument("--seed", type=int, default=17)
    parser.add_argument(
        "--families",
        nargs="+",
        choices=(*FAMILIES, DAILY, *COMPARED, *UNSEEN),
        default=FAMILIES,
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    found = study(options.machines, options.seed, options.families)
    if options.json:
        print(json.dumps(found, indent=2))
        return
    print(
        f"{found['machines']} machines, seed {found['seed']}; {found['limits_wrong']} limits wrong"
    )
    print(
        f"median width of a total's range: {found['total_width_percent']:.0f} % of the total"
    )
    for kind, width in found["width_percent"].items():
        print(f"median width of {kind}, n >= {FEW}: {width:.0f} % of its median")
    print(
        f"{'inside the 90 % range':36} {'%':>6} {'binomial':>9} {'machines':>9} {'n':>6}"
    )
    for group, x in found["inside"].items():
        print(
            f"{group:36} {x['percent']:6.1f} {x['binomial']:9.1f} {x['machines']:9.1f} {x['n']:6d}"
        )


if __name__ == "__main__":
    main()
