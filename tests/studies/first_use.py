"""First and second call of twelve public functions, each in a process of its own: processor
seconds, milliseconds and peak memory.

`python tests/studies/first_use.py` prints a table and marks with ! a first call that takes more
than 1.5 times the second and 0.5 s. What the first call adds is imports and kernels loaded from
numba's disk cache; kernels and Python's own files are compiled beforehand, by a round that does
not count. Take a Python that has flexdt's dependencies alone: numba and SciPy import coverage,
yaml and more where they are. Processor time is the least of `--repeats` processes. `--beside
TREE` runs another tree of flexdt in turns and shows how the second call and the peak of memory
compare: its modules must be importable from TREE/src or TREE.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

ALLOWED_RATIO: Final = 1.5
ALLOWED_S: Final = 0.5
"""A first call may take this times the second, and this more [s]."""
SCRIPT: Final = "examples/scripts/lego-fly-360.txt"


def calls(folder: Path) -> dict[str, Callable[[], Any]]:
    """Make the twelve calls: arrays are small, so that what a first call adds shows."""
    import numpy as np

    import flexdt as fx

    scan = fx.ConeVec.circular(sod=300, sdd=600, angles=60, shape=(96, 128), pixel=0.4)
    random = np.random.default_rng(0)
    images = random.random((60, 96, 128), dtype=np.float32)
    grid = fx.Grid((48, 64, 64), 0.3)
    solid = grid.blank().like(random.random((48, 64, 64), dtype=np.float32))
    data = str(folder / "lego")
    script = (Path(__file__).parents[2] / SCRIPT).read_text()
    return {
        "plan": lambda: fx.plan(script),
        "expose": lambda: fx.expose("lego"),
        "open": lambda: fx.open(data),
        "project": lambda: fx.project("lego", scan),
        "simulate": lambda: fx.simulate("lego", scan),
        "forward": lambda: fx.forward(solid, scan),
        "back": lambda: fx.back(images, scan, grid.blank()),
        "fdk": lambda: fx.fdk(images, scan, grid.blank()),
        "sirt": lambda: fx.sirt(images, scan, grid.blank(), iterations=2),
        "calibrate": lambda: fx.calibrate(data, "lego"),
        "align": lambda: fx.align(data),
        "reconstruct": lambda: fx.reconstruct(data, voxel=0.8),
    }


def here(name: str, folder: Path) -> dict[str, float]:
    """Make one call twice in this process; returns processor and wall seconds of each and
    the peak of memory [MB]."""
    import time
    import warnings

    warnings.simplefilter("ignore")
    # What the arguments need is not the call's.
    call = calls(folder)[name]
    found: dict[str, float] = {}
    for turn in ("first", "second"):
        gc.collect()  # a pass of 25 ms came in the second call by chance
        cpu, wall = time.process_time(), time.perf_counter()
        call()
        found[f"{turn}_cpu_s"] = time.process_time() - cpu
        found[f"{turn}_s"] = time.perf_counter() - wall
    # Not ru_maxrss, which begins with that of the process that started this one.
    status = Path("/proc/self/status").read_text().split("VmHWM:")[1]
    found["peak_MB"] = float(status.split()[0]) / 1024
    return found


def scanned(folder: Path) -> None:
    """Write the data set that is opened: a LEGO scan of 60 views."""
    import flexdt as fx

    scan = fx.ConeVec.circular(sod=300, sdd=1000, angles=60, shape=(300, 300), pixel=0.4)
    fx.simulate("lego", scan, noise=1).save(folder / "lego")


def measured(tree: Path, name: str, folder: Path) -> dict[str, float]:
    """Run `here` in a process that imports flexdt from a tree; {} where it fails."""
    roots = [tree / "src", tree / "extensions" / "src", tree]
    path = os.pathsep.join(str(root) for root in roots if root.is_dir())
    environment = {**os.environ, "PYTHONPATH": path}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, __file__, "--here", name, "--folder", str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        print(f"{name}: {done.stderr.strip().splitlines()[-1]}", file=sys.stderr)
        return {}
    return json.loads(done.stdout.splitlines()[-1])  # type: ignore[no-any-return]


def least(runs: list[dict[str, float]]) -> dict[str, float]:
    """Take the least of each figure of several runs."""
    kept = [run for run in runs if run]
    return {key: min(run[key] for run in kept) for key in kept[0]} if kept else {}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--beside", type=Path)
    parser.add_argument("--only", default="", help="names with commas")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--here")
    parser.add_argument("--folder", type=Path)
    given = parser.parse_args()
    if given.here:
        print(json.dumps(here(given.here, given.folder)))
        return
    own = Path(__file__).parents[2]
    trees = [own, *([given.beside.resolve()] if given.beside else [])]
    table: dict[str, list[dict[str, float]]] = {}
    with tempfile.TemporaryDirectory() as kept:
        folder = Path(kept)
        scanned(folder)
        names = given.only.split(",") if given.only else list(calls(folder))
        print(
            "call         first  second [CPU s]   first  second [ms]   limit  peak MB  beside"
        )
        for name in names:
            for tree in trees:  # compiles what is missing
                measured(tree, name, folder)
            runs: list[list[dict[str, float]]] = [[] for _ in trees]
            for _ in range(given.repeats):
                for each, tree in zip(runs, trees, strict=True):
                    each.append(measured(tree, name, folder))
            table[name] = [least(each) for each in runs]
            one, *other = table[name]
            limit = ALLOWED_RATIO * one["second_cpu_s"] + ALLOWED_S
            beyond = one["first_cpu_s"] > limit
            line = (
                f"{name:12} {one['first_cpu_s']:5.2f}  {one['second_cpu_s']:6.3f}          "
                f"{1e3 * one['first_s']:6.0f}  {1e3 * one['second_s']:6.0f}       "
                f"{limit:5.2f}{'!' if beyond else ' '} {one['peak_MB']:6.0f}"
            )
            for them in filter(None, other):
                second = one["second_cpu_s"] / them["second_cpu_s"]
                memory = one["peak_MB"] / them["peak_MB"]
                line += f"   second x {second:.2f}, peak x {memory:.2f}"
            print(line, flush=True)
    if given.json:
        given.json.write_text(json.dumps(table, indent=1) + "\n")


if __name__ == "__main__":
    main()
