"""How fast calibration is: `python tests/studies/calibration_speed.py DATASET --phantom
lego`.

Three figures, best and median of several runs with kernels compiled and files in the page
cache: the fit alone (bead positions in, parameters out), everything from counts in memory, and
everything from the files. CPU seconds are given beside wall seconds, so that a busy machine
shows.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from flexdt.library.calibration.calibrate import (
    DatasetFrames,
    calibrate_datasets,
    find_phantom,
)
from flexdt.library.reading.folders import load_dataset
from flexdt.twin.calibration.fit.fit import solve
from flexdt.twin.calibration.pipeline import Scan, calibrate
from flexdt.twin.errors import TwinError


def bench(folder: Path, phantom: str, repeats: int = 7) -> dict[str, object]:
    """Time the calibration of a data set: the fit alone, from memory, and from files.

    Args:
        folder: a data set.
        phantom: name of the scanned one.
        repeats: runs from memory and from files, five times as many of the fit alone,
            each after one that is not counted.

    Returns:
        `solve`, `memory` and `files`, each with best_s, median_s and cpu_s (the least);
        and frames, shape, positions and cores.

    Raises:
        DatasetError: the folder is no data set.
        TwinError: the phantom does not exist, or nothing was found.
    """
    dataset = load_dataset(folder)
    outcome = calibrate_datasets([dataset], phantom)
    fit = outcome.calibration.fit
    if fit is None:
        raise TwinError(
            f"{folder}: no calibration comes of this data set: nothing to time"
        )
    problem = fit.problem
    model = find_phantom(phantom)
    frames = DatasetFrames(dataset)
    start = problem.start

    def alone() -> None:
        solve(problem, x=start)

    def memory() -> None:
        calibrate([Scan(frames, dataset.poses)], model)

    def files() -> None:
        calibrate_datasets([load_dataset(folder)], phantom)

    seen = int(problem.seen.sum())
    return {
        "frames": len(dataset),
        "shape": list(dataset.shape),
        "positions": seen,
        "cores": os.cpu_count(),
        "solve": timed(alone, 5 * repeats),
        "memory": timed(memory, repeats),
        "files": timed(files, repeats),
    }


def timed(work: Callable[[], object], repeats: int) -> dict[str, float]:
    """Run work `repeats` times after one run for warmth.

    Returns:
        best_s and median_s of the wall clock, and cpu_s, the least processor time.
    """
    work()
    wall, cpu = [], []
    for _ in range(repeats):
        begun, used = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - begun)
        cpu.append(time.process_time() - used)
    return {"best_s": min(wall), "median_s": statistics.median(wall), "cpu_s": min(cpu)}


def main(argv: Sequence[str] | None = None) -> int:
    """Time the calibration of the data set on the command line and print the figures.

    Returns:
        0; 1 after an error, which is printed.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--phantom", default="lego")
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args(argv)
    try:
        document = bench(args.dataset, args.phantom, args.repeats)
    except TwinError as error:
        print(f"calibration_speed: {error}", file=sys.stderr)
        return 1
    if args.json:
        print(json.dumps(document))
        return 0
    print(f"{document['frames']} frames, {document['positions']} bead positions")
    for name, what in (
        ("solve", "the fit alone"),
        ("memory", "from counts in memory"),
        ("files", "from files in the page cache"),
    ):
        row = document[name]
        assert isinstance(row, dict)
        print(
            f"{what:30} best {1e3 * row['best_s']:9.2f} ms   median "
            f"{1e3 * row['median_s']:9.2f} "
            f"ms   CPU {1e3 * row['cpu_s']:9.2f} ms"
        )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
