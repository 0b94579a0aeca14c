"""Does `flexdt commission` find what laboratories hide? Simulated ones, from folder to report.

    python tests/studies/laboratories.py [--laboratories 50] [--seed 1]

Each laboratory (`past_laboratory.py`) has hidden limits, rates, zero offsets, a drift, a sign
of one motor in its texts, a family of command times, regions and camera modes, and three
planted contradictions. Its folders are written and read without any configuration.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flexdt.clients.cli.commands.script_files import read_log_file
from flexdt.library.commission import Commissioned, commission

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from past_laboratory import LINEAR, Laboratory


@dataclass
class Outcome:
    """What one laboratory gave.

    Attributes:
        wrong: axes whose limits, rates, or sign are not exactly the hidden ones.
        columns: error of the fitted column of each scan that is not displaced [px].
        column_sigmas: standard deviation that is stated of each of them [px].
        pulls: (error in sigmas) of drift and det_tan.
        missed: planted contradictions that are not named.
        false: what is named and was not planted.
    """

    found: Commissioned
    wrong: list[str] = field(default_factory=list)
    columns: dict[str, float] = field(default_factory=dict)
    column_sigmas: dict[str, float] = field(default_factory=dict)
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
    fitted = {Path(name).name: c[1] for name, c in found.offsets.columns.items()}
    out.columns = {p.name: fitted[p.name] - p.column for p in lab.scans
                   if p.name in fitted and not p.aside}  # fmt: skip
    stated = {Path(name).name: c[2] for name, c in found.offsets.columns.items()}
    out.column_sigmas = {name: stated[name] for name in out.columns}
    lines = found.offsets.lines
    for name, true in (
        ("axs_tan", lab.axs_tan + lab.hidden_axs), ("det_tan", lab.det_tan + lab.hidden_det),
        ("det_roll_deg", math.degrees(lab.roll)),
    ):  # fmt: skip
        out.pulls[name] = (lines[name].value - true) / (lines[name].sigma or math.nan)
    axis = lines["axs_tan"]
    if axis.per_year is not None and axis.drift_sigma is not None:
        out.pulls["drift"] = (axis.per_year - lab.drift) / axis.drift_sigma
    named = set[int]()
    for about, who in lab.planted:
        hits = {k for k, f in enumerate(found.findings)
                if str(f.place).startswith(about) and who in f"{f.place} {f.text}"}  # fmt: skip
        named |= hits
        if not hits:
            out.missed.append((about, who))
    # Limits are drawn without bodies, so most drawn machines could not stand at home.
    out.false = [
        (str(f.place), f.text)
        for k, f in enumerate(found.findings)
        if k not in named and not f.forbids and "machine flexray" not in f.text
    ]
    return out


def laboratories(count: int, seed: int) -> Iterator[Outcome]:
    """Draw laboratories and commission from their folders, one after the other.

    Args:
        count: how many.
        seed: of all.

    Yields:
        What was right of each, with the seconds that commissioning took.
    """
    for k in range(count):
        with tempfile.TemporaryDirectory() as root:
            lab = Laboratory(1000 * seed + k)
            folders = lab.write(Path(root))
            begun = time.perf_counter()
            out = judged(lab, commission(folders, read_log_file))
            out.seconds = time.perf_counter() - begun
            yield out


def main() -> None:
    """Read drawn laboratories, print each, then what was right of all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--laboratories", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    done = list[Outcome]()
    for k, out in enumerate(laboratories(options.laboratories, options.seed)):
        done.append(out)
        pulls = ", ".join(f"{n} {p:+.1f}" for n, p in out.pulls.items())
        worst = max(map(abs, out.columns.values()), default=math.nan)
        print(
            f"{k}: worst column {worst:.4f} px; {pulls}; wrong {out.wrong}; "
            f"missed {out.missed}; not planted {out.false}; {out.seconds:.1f} s", flush=True,
        )  # fmt: skip
    columns = np.abs([c for out in done for c in out.columns.values()])
    print(f"\n{len(done)} laboratories, {sum(o.seconds for o in done):.0f} s in all")
    print(f"limits, rates or signs wrong in {sum(bool(o.wrong) for o in done)}")
    print(
        f"axis column of {len(columns)} scans: rms {np.sqrt(np.mean(columns**2)):.4f} px, "
        f"worst {columns.max():.4f} px, {np.sum(columns > 0.05)} beyond 0.05 px"
    )
    for name in ("drift", "axs_tan", "det_tan", "det_roll_deg"):
        told = np.abs([o.pulls[name] for o in done if name in o.pulls])
        rms = np.sqrt(np.mean(told**2))
        print(
            f"{name}: {np.sum(told <= 3)} of {len(told)} within 3 sigma, rms {rms:.2f} sigma"
        )
    missed, false = (
        sum(len(getattr(o, what)) for o in done) for what in ("missed", "false")
    )
    print(
        f"contradictions: {missed} planted ones missed, {false} named that were not planted"
    )


if __name__ == "__main__":
    main()
