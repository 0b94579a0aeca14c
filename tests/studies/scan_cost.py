"""What the demonstration's scan costs the servers: processor seconds and memory, by rays a pixel.

    python tests/studies/scan_cost.py [--repeats 3] [--beside TREE]

Twin and projector (one thread) are started for each scan, in turns with one ray a pixel and with
the default, and with `--beside` those of another tree of flexdt, whose modules must be importable
from TREE/src or TREE. Processor time is from the script's submission to the scan's end, of both
servers and their children; memory is the peak of each server's own. Exits with 1 where the default
costs more than `MOST_TIMES` one ray, or memory is more than `MOST_MEMORY` times the other tree's.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path
from statistics import mean

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Process, Wire, machine, projector, twin

ROOT = Path(__file__).parents[2]
SCRIPT = ROOT / "examples" / "scripts" / "lego-fly-360.txt"
MOST_TIMES = 1.5
"""Processor time of a scan at the default, in times of one with one ray a pixel."""
MOST_MEMORY = 1.05


def used_s(server: Process) -> float:
    """Processor time of a server and its children, those that have ended included [s]."""
    total = 0.0
    tick = os.sysconf("SC_CLK_TCK")
    for task in [server.pid, *children(server.pid)]:
        words = Path(f"/proc/{task}/stat").read_text().rpartition(")")[2].split()
        total += sum(int(words[i]) for i in (11, 12, 13, 14)) / tick
    return total


def children(pid: int) -> list[int]:
    """Processes that a process has started and that live."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    return [int(c) for t in threads for c in (t / "children").read_text().split()]


def peak_mb(server: Process) -> float:
    """Largest resident memory of a server so far, without children [MB]."""
    status = Path(f"/proc/{server.pid}/status").read_text().split("VmHWM:")[1]
    return float(status.split()[0]) / 1024


def scanned(tree: Path, *options: str) -> dict[str, float]:
    """Scan once with servers of a tree; their processor seconds and peaks of memory."""
    roots = [tree / "src", tree]
    path = os.pathsep.join(str(root) for root in roots if root.is_dir())
    env = {
        "PYTHONPATH": path,
        "PYTHONSAFEPATH": "1",
    }  # the tree alone, wherever this runs
    with tempfile.TemporaryDirectory() as data:
        rays = projector(env=env)
        server = twin(rays.port, Path(data), "--speed-up", "max", *options, env=env)
        try:
            wire = Wire(server.port, 600.0)
            wire.call("session.hello", protocol="1.0", client="cost")
            wire.call("session.control", action="acquire")
            wire.call("sample.set", name="lego")
            before = used_s(server), used_s(rays)
            made = wire.call("script.submit", text=SCRIPT.read_text(), name="cost")
            wire.wait(made["job"], "done", timeout_s=900.0)
            return {
                "twin s": used_s(server) - before[0],
                "projector s": used_s(rays) - before[1],
                "twin MB": peak_mb(server),
                "projector MB": peak_mb(rays),
            }
        finally:
            server.end()
            rays.end()


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--beside", type=Path)
    asked = parser.parse_args()
    ways: dict[str, tuple[Path, list[str]]] = {
        "rays=1": (ROOT, ["--rays", "1"]),
        "default": (ROOT, []),
    }
    if asked.beside:
        ways["other tree"] = (asked.beside.resolve(), [])
    scanned(ROOT)  # compiles what is missing, and does not count
    runs: dict[str, list[dict[str, float]]] = {way: [] for way in ways}
    for _ in range(asked.repeats):
        for way, (tree, options) in ways.items():
            runs[way].append(scanned(tree, *options))
    found = {way: {k: mean(r[k] for r in rs) for k in rs[0]} for way, rs in runs.items()}
    for way, figures in found.items():
        seconds = figures["twin s"] + figures["projector s"]
        each = ", ".join(f"{name} {value:.1f}" for name, value in figures.items())
        print(f"{way:12s} {seconds:6.2f} s of processor time: {each}")
    cost = [found[w]["twin s"] + found[w]["projector s"] for w in ("default", "rays=1")]
    times = cost[0] / cost[1]
    print(f"the default costs {times:.2f} times one ray a pixel. {machine()}")
    grown = 0.0
    if asked.beside:
        for name in ("twin MB", "projector MB"):
            ratio = found["default"][name] / found["other tree"][name]
            print(f"{name}: {ratio:.2f} times the other tree's")
            grown = max(grown, ratio)
    sys.exit(times > MOST_TIMES or grown > MOST_MEMORY)


if __name__ == "__main__":
    main()
