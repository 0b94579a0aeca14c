"""Time projectors and reconstructions alone and beside busy loops, in one run.

    python examples/research/busy_machine.py --loops 8 --rounds 5

Rounds take turns: each runs every case once while the loops are stopped and once while they
run, and prints how long that took (some 5 s of processor time each, two thirds of it `tv`). A
line a case: median wall time of both [s], their ratio, and processor time beside the loops as a
multiple of that without them. A fair scheduler gives n threads beside m loops on c cores c /
(n + m) of a core each, where it shares by process; Linux with `sched_autogroup_enabled` shares
by session, and the loops are one session.

`OMP_WAIT_POLICY=active` before the command shows threads that spin while they wait.
"""

from __future__ import annotations

import argparse
import os
import signal
import statistics
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np

import flexdt as fx

VOXELS = 96
VIEWS = 90
SHAPE = (96, 128)
ITERATIONS = 3
WARM_UP_S = 0.3
"""From when the loops go on to the first measurement."""


def cases() -> dict[str, Callable[[], object]]:
    """Return name -> work to time: projections and reconstructions of small views, whose
    threads meet most often.
    """
    scan = fx.ConeVec.circular(sod=300, sdd=600, angles=VIEWS, shape=SHAPE, pixel=1.0)
    random = np.random.default_rng(1)
    volume = fx.Volume(random.random((VOXELS,) * 3, dtype=np.float32), 0.4)
    images = fx.forward(volume, scan, SHAPE)
    grid = fx.Grid((VOXELS,) * 3, 0.4)
    return {
        "forward": lambda: fx.forward(volume, scan, SHAPE),
        "back": lambda: fx.back(images, scan, like=volume),
        "cgls": lambda: fx.cgls(images, scan, grid, iterations=ITERATIONS),
        "sirt": lambda: fx.sirt(images, scan, grid, iterations=ITERATIONS),
        "tv": lambda: fx.tv(images, scan, grid, weight=0.1, iterations=ITERATIONS),
        "fdk": lambda: fx.fdk(images, scan, grid),
    }


@contextmanager
def busy_loops(count: int) -> Iterator[list[subprocess.Popen[bytes]]]:
    """Start `count` processes, 1 or more, that loop for ever, in a session of their own,
    within the context; killed at its end.

    Yields:
        The first process alone; all of them are of its process group.
    """
    script = (
        f"import os\nfor _ in range({count - 1}):\n    if os.fork() == 0: break\nwhile "
        "True: pass\n"
    )
    loops = [subprocess.Popen([sys.executable, "-c", script], start_new_session=True)]
    try:
        yield loops
    finally:
        for loop in loops:
            os.killpg(loop.pid, signal.SIGKILL)
            loop.wait()


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """Wall and processor seconds of one call."""
    wall, used = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - used


def main() -> None:
    """Time each case on the quiet and on the busy machine in turns, and print medians
    [s], their ratio and that of processor time, each busy over quiet.
    """
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--loops", type=int, default=8)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--only", nargs="*", default=None)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    every = {
        n: work for n, work in cases().items() if chosen.only is None or n in chosen.only
    }
    for work in every.values():
        work()
    found: dict[tuple[str, bool], list[tuple[float, float]]] = {}
    with busy_loops(chosen.loops) as loops:
        for turn in range(1, chosen.rounds + 1):
            spent = {False: 0.0, True: 0.0}
            for busy in (False, True):
                number = signal.SIGCONT if busy else signal.SIGSTOP
                for loop in loops:
                    os.killpg(loop.pid, number)
                time.sleep(WARM_UP_S)
                for name, work in every.items():
                    taken = timed(work)
                    found.setdefault((name, busy), []).append(taken)
                    spent[busy] += taken[0]
            print(
                f"round {turn} of {chosen.rounds}: {spent[False]:.1f} s quiet, "
                f"{spent[True]:.1f} s busy",
                flush=True,
            )
    print(f"{os.cpu_count()} cores, {chosen.loops} busy loops, median of {chosen.rounds}")
    print(f"{'case':10}{'quiet [s]':>12}{'busy [s]':>12}{'ratio':>8}{'processor':>12}")
    for name in every:
        quiet, busy = (
            [statistics.median(column) for column in zip(*found[name, each], strict=True)]
            for each in (False, True)
        )
        print(
            f"{name:10}{quiet[0]:12.3f}{busy[0]:12.3f}{busy[0] / quiet[0]:8.2f}"
            f"{busy[1] / quiet[1]:12.2f}"
        )


if __name__ == "__main__":
    main()
