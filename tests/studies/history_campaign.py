"""Long histories of small requests: `history_campaign.py --requests 100000 --seed 1 --jobs 2`.

Each machine file is drawn anew (`motion_histories`). On it parts are brought near, every small
request is tried there, and the one that takes most from the gap is repeated up to `--repeats`
times; then `--moves` drawn moves are compared with a dense sweep. The judge shares no code with
the scanner. Prints what was asked, the most that any pair lost, the least gap, and moves that
were refused although safe or allowed although unsafe. Ends with 1 on any violation.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from motion_histories import Outcome, Verdicts, dense_moves, run_histories


def one_machine(seed: int, number: int, runs: int, repeats: int, moves: int
                ) -> tuple[int, Outcome, Verdicts]:  # fmt: skip
    """Histories and single moves on one drawn machine."""
    histories = run_histories(np.random.default_rng([seed, number, 0]), runs, repeats)
    return number, histories, dense_moves(np.random.default_rng([seed, number, 1]), moves)


def main() -> int:
    """Run histories on drawn machines until there are enough requests or the time is
    over.

    Returns:
        1 where something was violated.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--requests", type=int, default=100_000, help="in histories, at least")
    p.add_argument("--seed", type=int, default=1)
    p.add_argument("--runs", type=int, default=4, help="long runs on each machine")
    p.add_argument(
        "--repeats", type=int, default=2000, help="of a small request in each run"
    )
    p.add_argument(
        "--moves", type=int, default=50, help="compared with a dense sweep, on each"
    )
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument(
        "--minutes", type=float, default=math.inf, help="end earlier, with fewer"
    )
    options = p.parse_args()
    begun = time.monotonic()
    machines = requests = runs = safe = near = unsafe = 0
    loss, least, said = 0.0, math.inf, list[str]()
    with ProcessPoolExecutor(options.jobs) as pool:
        while (
            requests < options.requests
            and time.monotonic() - begun < 60.0 * options.minutes
        ):
            work = [
                pool.submit(one_machine, options.seed, machines + i, options.runs,
                            options.repeats, options.moves)
                for i in range(4 * options.jobs)
            ]  # fmt: skip
            for done in work:
                number, histories, verdicts = done.result()
                machines += 1
                requests += histories.requests
                runs += histories.long_runs
                loss, least = max(loss, histories.loss), min(least, histories.least)
                safe, near = safe + verdicts.safe, near + verdicts.near
                unsafe += verdicts.unsafe
                said += [f"machine {number}: {words}" for words in histories.found]
                said += [
                    f"machine {number}: safe, refused: {w}" for w in verdicts.refused
                ]
                said += [
                    f"machine {number}: unsafe, allowed: {w}" for w in verdicts.allowed
                ]
            print(f"{requests} requests, {runs} long runs, {safe} safe moves,"
                  f" {time.monotonic() - begun:.0f} s, {len(said)} violations",
                  file=sys.stderr, flush=True)  # fmt: skip
    print(f"{requests} requests on {machines} drawn machines, seed {options.seed}, "
          f"{runs} runs of {options.repeats} repeats, {time.monotonic() - begun:.0f} s\n"
          f"most that a pair lost within the margin: {1e3 * loss:.2f} um\n"
          f"least gap of what was free: the margin and {1e3 * least:.2f} um\n"
          f"moves: {safe} safe by a dense sweep ({near} of them begun near a part), "
          f"{unsafe} unsafe\nviolations: {len(said)}")  # fmt: skip
    print(*said, sep="\n")
    return 1 if said else 0


if __name__ == "__main__":
    sys.exit(main())
