"""Does `flexdt commission` find what laboratories hide? Simulated ones, from folder to report.

    PYTHONPATH=tests/support python tests/studies/laboratories.py [--laboratories 50] [--seed 1]

Each laboratory (`past_laboratory.py`) has hidden limits, rates, zero offsets, a drift, a sign of
one motor in its texts, a family of command times, regions and camera modes, and three planted
contradictions. Its folders are written and read without any configuration.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from past_laboratory import LINEAR, Laboratory

from flexdt.clients.cli.commands.scan_commands import read_log_file
from flexdt.clients.commission import Commissioned, commission


@dataclass
class Outcome:
    """What one laboratory gave.

    Attributes:
        wrong: axes whose limits, rates, or sign are not exactly the hidden ones.
        columns: error of the fitted column of each scan that is not displaced [px].
        pulls: (error in sigmas) of drift and det_tan.
        missed: planted contradictions that are not named.
        false: what is named and was not planted.
    """

    found: Commissioned
    wrong: list[str] = field(default_factory=list)
    columns: dict[str, float] = field(default_factory=dict)
    pulls: dict[str, float] = field(default_factory=dict)
    missed: list[tuple[str, str]] = field(default_factory=list)
    false: list[tuple[str, ...]] = field(default_factory=list)
    seconds: float = 0.0


def judged(lab: Laboratory, found: Commissioned) -> Outcome:
    """A laboratory beside what was found."""
    out = Outcome(found)
    for name in (*LINEAR, "rot_obj"):
        axis = found.machine.axes[name]
        told = (axis.lower, axis.upper, axis.max_speed, axis.max_acceleration)
        sign = lab.sign if name == "tra_det" else 1
        if told != lab.rig.limits[name] or axis.settings_sign != sign:
            out.wrong.append(name)
    for p in lab.scans:
        if p.name in found.offsets.columns and not p.aside:
            out.columns[p.name] = found.offsets.columns[p.name][1] - p.column
    lines = found.offsets.lines
    for name, true in (
        ("axs_tan", lab.axs_tan + lab.hidden_axs), ("det_tan", lab.det_tan + lab.hidden_det),
        ("det_roll_deg", math.degrees(lab.roll)),
    ):  # fmt: skip
        out.pulls[name] = (lines[name].value - true) / (lines[name].sigma or math.nan)
    axis = lines["axs_tan"]
    if axis.per_year is not None and axis.drift_sigma is not None:
        out.pulls["drift"] = (axis.per_year - lab.drift) / axis.drift_sigma
    for about, who in lab.planted:
        if not any(f.about == about and who in f.between for f in found.findings):
            out.missed.append((about, who))
    consequences = {("c_det", "pixel"), ("ROI", "roi")}
    del consequences
    for f in found.findings:
        if "machine flexray" in f.between and f.about in found.machine.axes:
            continue
        if not any(f.about == about and who in f.between for about, who in lab.planted):
            out.false.append(tuple(f))
    return out


def laboratories(count: int, seed: int) -> Iterator[Outcome]:
    """So many of them, one after the other."""
    for k in range(count):
        with tempfile.TemporaryDirectory() as root:
            lab = Laboratory(1000 * seed + k)
            folders = lab.write(Path(root))
            begun = time.perf_counter()
            out = judged(lab, commission(folders, None, read_log_file))
            out.seconds = time.perf_counter() - begun
            yield out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--laboratories", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    done, columns, planted, missed, false = list[Outcome](), list[float](), 0, 0, 0
    for k, out in enumerate(laboratories(options.laboratories, options.seed)):
        done.append(out)
        columns += out.columns.values()
        missed, false = missed + len(out.missed), false + len(out.false)
        pulls = ", ".join(f"{n} {p:+.1f}" for n, p in out.pulls.items())
        worst = max(map(abs, out.columns.values()), default=math.nan)
        print(f"{k}: worst column {worst:.4f} px; {pulls}; wrong {out.wrong}; missed {out.missed}; "
              f"not planted {out.false}; {out.seconds:.1f} s", flush=True)  # fmt: skip
    if not done:
        return
    rms = math.sqrt(sum(c * c for c in columns) / max(len(columns), 1))
    print(f"\n{len(done)} laboratories: limits, rates or signs wrong in {sum(bool(o.wrong) for o in done)}")
    print(f"axis column of {len(columns)} scans: rms {rms:.4f} px, worst "
          f"{max(map(abs, columns)):.4f} px, {sum(abs(c) > 0.05 for c in columns)} beyond 0.05 px")  # fmt: skip
    for name in ("drift", "axs_tan", "det_tan", "det_roll_deg"):
        pulls_of = [o.pulls[name] for o in done if name in o.pulls]
        print(f"{name}: {sum(abs(p) <= 3 for p in pulls_of)} of {len(pulls_of)} within 3 sigma, rms "
              f"{math.sqrt(sum(p * p for p in pulls_of) / max(len(pulls_of), 1)):.2f} sigma")  # fmt: skip
    print(f"contradictions: {missed} planted ones missed, {false} named that were not planted; "
          f"{sum(o.seconds for o in done) / len(done):.1f} s a laboratory")  # fmt: skip


if __name__ == "__main__":
    main()
