"""Random motion under the eye of the oracle: `motion_campaign.py --requests 100000 --seed 1`.

Four fifths of the requests go to the pure scanner, a fifth comes from three clients of a whole
server in a simulation (`--wire`), with scans, scenes, control and clocks from real time to
"max". Moves, jogs, stops, E-stops, resets, settings in flight, programmes that are paused,
resumed and aborted, samples, corrections and restarts on three machines, aimed at where parts
meet. Every motion that the scanner publishes is looked at by `motion_oracle`, which shares no
code with the guard. Prints requests by verb and outcome, violations, and stop distances beside
those of motors that would brake each by itself. Ends with 1 on any violation, with the seed and
the shortest history that shows it.
"""

from __future__ import annotations

import argparse
import logging
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from unittest.mock import patch

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
from motion_rules import MACHINES, Request, Start, run_episode, script_of, shortest
from wire_rules import (
    Ask,
    WireStart,
    data_with_samples,
    read_here,
    run_wire_episode,
    shortest_wire,
)

from flexdt.server.storage import stored_samples as store

VERBS = (
    "move", "jog", "lease end", "stop", "pause", "abort", "resume", "sample", "correction",
    "programme", "script", "trajectory", "step", "scene", "take", "set", "estop", "reset",
    "restart", "control", "clock",
)  # fmt: skip

OUTCOMES = ("accepted", "certified", "halted", "refused", "nothing", "hang", "raised")
KINDS = (
    "contact", "margin", "limit", "speed", "acceleration", "jump", "coupling", "state", "changed",
    "answer", "unrest", "hang", "raised",
)  # fmt: skip
LENGTH = 50
BATCH = 1000
WIRE_BATCH = 250


@dataclass
class Tally:
    """What a batch of requests came to."""

    requests: int = 0
    episodes: int = 0
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    stops: list[tuple[float, float, float, float]] = field(default_factory=list)
    found: Counter[str] = field(default_factory=Counter)
    first: dict[str, tuple[int, Start, list[Request], str]] = field(default_factory=dict)
    first_wire: dict[str, tuple[int, WireStart, list[Ask], str]] = field(
        default_factory=dict
    )
    slowest: tuple[float, str] = (0.0, "")
    least: float = np.inf

    def add(self, other: Tally) -> None:
        """Add another batch: of each kind of violation the shorter history stays."""
        self.requests += other.requests
        self.episodes += other.episodes
        self.counts += other.counts
        self.stops += other.stops
        self.found += other.found
        for kind, case in other.first.items():
            if kind not in self.first or len(case[2]) < len(self.first[kind][2]):
                self.first[kind] = case
        for wire, there in other.first_wire.items():
            self.first_wire.setdefault(wire, there)
        self.slowest = max(self.slowest, other.slowest)
        self.least = min(self.least, other.least)


def batch(machine: str, seed: int, requests: int) -> Tally:
    """Episodes of one seed until so many requests are made."""
    tally = Tally()
    while tally.requests < requests:
        number = tally.episodes
        rng = np.random.default_rng([seed, number])
        episode, history = run_episode(rng, machine, LENGTH)
        tally.requests += len(history)
        tally.episodes += 1
        tally.counts += episode.counts
        tally.stops += episode.stops
        tally.slowest = max(tally.slowest, episode.slowest)
        tally.least = min(tally.least, episode.watch.least)
        if episode.found:
            kind = episode.found[0].kind
            tally.found[kind] += 1
            case = number, episode.start, history, str(episode.found[0])
            tally.first.setdefault(kind, case)
    return tally


def wire_batch(machine: str, seed: int, requests: int, samples: Path) -> Tally:
    """Make random requests over the wire, episode by episode, until there are so many.

    Args:
        machine: its name.
        seed: of all.
        requests: at least.
        samples: see `data_with_samples`.
    """
    logging.getLogger("flexdt").addHandler(logging.NullHandler())
    tally = Tally()
    with tempfile.TemporaryDirectory() as folder:
        while tally.requests < requests:
            number = tally.episodes
            rng = np.random.default_rng([seed, number])
            root = Path(folder) / str(number)
            episode, history = run_wire_episode(rng, machine, LENGTH, root, samples)
            tally.requests += len(history)
            tally.episodes += 1
            tally.counts += episode.counts
            tally.slowest = max(tally.slowest, episode.slowest)
            if episode.found:
                kind = episode.found[0].kind
                tally.found[kind] += 1
                case = number, episode.start, history, str(episode.found[0])
                tally.first_wire.setdefault(kind, case)
    return tally


def main() -> int:
    """Make random requests on all processors, then shorten what was found and print it.

    Returns:
        1 where something was violated.
    """
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--requests", type=int, default=100_000)
    p.add_argument("--seed", type=int, default=1)
    p.add_argument(
        "--machine", action="append", choices=MACHINES, help="default: all three"
    )
    p.add_argument("--jobs", type=int, default=2)
    p.add_argument("--wire", type=float, default=0.2, help="share of the requests")
    p.add_argument(
        "--minutes", type=float, default=np.inf, help="end earlier, with fewer requests"
    )
    p.add_argument(
        "--no-shrink", action="store_true", help="print histories as they were"
    )
    options = p.parse_args()
    machines = options.machine or list(MACHINES)
    begun = time.monotonic()
    tally = Tally()
    with (
        patch.object(store, "mesh_apart", read_here),
        tempfile.TemporaryDirectory() as folder,
        ProcessPoolExecutor(options.jobs) as pool,
    ):
        samples = data_with_samples(Path(folder))
        plan: list[tuple[float, int, bool]] = []  # when, how many, whether over the wire
        for share, size, wire in ((1.0 - options.wire, BATCH, False),
                                  (options.wire, WIRE_BATCH, True)):  # fmt: skip
            wanted = round(share * options.requests)
            parts = -(-wanted // size)
            plan += [
                (i / parts, min(size, wanted - i * size), wire) for i in range(parts)
            ]
        work = []
        for i, (_, size, wire) in enumerate(sorted(plan)):
            machine, seed = machines[i % len(machines)], options.seed * 1_000_000 + i
            if wire:
                work.append(pool.submit(wire_batch, machine, seed, size, samples))
            else:
                work.append(pool.submit(batch, machine, seed, size))
        count = len(work)
        for n, done in enumerate(as_completed(work), 1):
            tally.add(done.result())
            if time.monotonic() - begun > 60.0 * options.minutes:
                pool.shutdown(cancel_futures=True)
                break
            if n % max(1, count // 20) == 0:
                seconds = time.monotonic() - begun
                found = f"{sum(tally.found.values())} violations"
                done = f"{tally.requests} requests, {seconds:.0f} s, {found}"
                print(done, file=sys.stderr, flush=True)
    report(tally, machines, options.seed, time.monotonic() - begun)
    for kind, (number, start, history, what) in tally.first.items():
        if not options.no_shrink:
            start, history = shortest(start, history, kind)
        print(f"\n# {kind} (episode {number}): {what}\n{script_of(start, history)}")
    with tempfile.TemporaryDirectory() as folder:
        for kind, (number, at, asked, what) in tally.first_wire.items():
            if not options.no_shrink:
                samples = data_with_samples(Path(folder) / "data")
                asked = shortest_wire(at, asked, kind, Path(folder) / "episode", samples)
            print(f"\n# over the wire: {kind} (episode {number}): {what}\n{at}")
            print(*asked, sep="\n")
    return 1 if tally.found else 0


def report(tally: Tally, machines: list[str], seed: int, seconds: float) -> None:
    """Print counts of all requests, the violations and how stops went."""
    print(f"{tally.requests} requests in {tally.episodes} episodes on {', '.join(machines)}, "
          f"seed {seed}, {seconds:.0f} s")  # fmt: skip
    used = [o for o in OUTCOMES if any(tally.counts[v, o] for v in VERBS)]
    print(f"\n{'verb':12}" + "".join(f"{o:>11}" for o in used))
    for verb in VERBS:
        row = [tally.counts[verb, o] for o in used]
        if any(row):
            print(f"{verb:12}" + "".join(f"{n:11}" for n in row))
    print("\nviolations: " + ", ".join(f"{k} {tally.found[k]}" for k in KINDS))
    print(f"least clearance looked at: {tally.least:.4f} mm")
    print(f"slowest answer: {1e3 * tally.slowest[0]:.0f} ms, {tally.slowest[1]}")
    if tally.stops:
        stops = np.array(tally.stops)
        print(f"\n{len(stops)} stops of what moved:         median      95 %     worst")
        for name, column in zip(
            ("as it was, s", "as it was, mm or deg", "each alone, s", "each alone, mm or deg"),
            stops.T, strict=True,
        ):  # fmt: skip
            m, p95, worst = np.median(column), np.quantile(column, 0.95), column.max()
            print(f"  {name:28}{m:9.2f} {p95:9.2f} {worst:9.2f}")
        longer = stops[:, 0] > stops[:, 2] + 1e-6
        print(f"  longer than braking alone: {100.0 * longer.mean():.1f} % of them")


if __name__ == "__main__":
    sys.exit(main())
