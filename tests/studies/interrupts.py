"""Interrupt each of several commands at drawn moments: `python tests/studies/interrupts.py`.

`--count` moments a command, from the start of its process to its end or `--longest` seconds,
drawn with `--seed`. Every end is one of these:

- told: exit code 130 and the line, no traceback;
- done: the command's own end, its exit code without a traceback;
- early: Python had not reached flexdt yet, whose own end or traceback names none of its
  modules;
- wrong: anything else, printed with its moment.

A line a command: how many of each, and the longest time from the signal to the end, by the
clock and in processor time of the command and its children [s]. Exits with 1 where anything is
wrong.
"""

from __future__ import annotations

import argparse
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[2]
SILENCE_S = 120.0
"""A command that goes on for so long has not heard the signal."""
INTERRUPTED = 130
PORTS = ("--port", "0", "--projector-port", "0", "--viewer-port", "0")
SCRIPT = str(ROOT / "examples" / "scripts" / "step-72.txt")

COMMANDS: Mapping[str, Sequence[str]] = {
    "help": ("--help",),
    "doctor": ("doctor",),
    "check": ("check", SCRIPT),
    "state": ("state",),
    "up": ("up", *PORTS, "--data", "data"),
    "twin": ("twin", "--port", "0", "--data", "data"),
    "projector": ("projector", "--port", "0"),
    "demo": ("demo", "--no-viewer", "--out", "demo"),
    "phantom": ("phantom", "make", "lego", "--out", "lego.nrrd"),
    "machine": ("machine", "show", "flexray"),
}
"""Name -> words of the command line."""


@dataclass(frozen=True)
class End:
    """How an interrupted command ended: kind, exit code, what it said, wall and processor
    [s]."""

    kind: str
    code: int
    said: str
    wall_s: float
    used_s: float


def interrupted(words: Sequence[str], moment_s: float, folder: Path) -> End:
    """Start a command, interrupt it after `moment_s`, and wait for its end; after
    SILENCE_S it is killed.

    Args:
        words: of the command.
        moment_s: when; a command that ends before is not interrupted.
        folder: to run in.
    """
    flexdt = Path(sys.executable).parent / "flexdt"
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        [flexdt, *words], cwd=folder, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    used = 0.0
    try:
        process.wait(moment_s)
    except subprocess.TimeoutExpired:
        used = tree_seconds(process.pid)
        process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    try:
        _, said = process.communicate(timeout=SILENCE_S)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
    wall = time.monotonic() - sent
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    whole = sum(getattr(after, n) - getattr(before, n) for n in ("ru_utime", "ru_stime"))
    text = said.decode("utf-8", "replace")
    kind = kind_of(process.returncode, text, interrupted=used > 0.0)
    more = max(0.0, whole - used) if used else 0.0
    return End(kind, process.returncode, text, wall, more)


def kind_of(code: int, said: str, *, interrupted: bool) -> str:
    """What an end was: told, done, early or wrong.

    Args:
        code: of the exit.
        said: on stderr.
        interrupted: whether the signal was sent.
    """
    if "Traceback" in said or "KeyboardInterrupt" in said or code < 0:
        files = re.findall(r'File "([^"]+)"', said)
        ours = any("/flexdt/" in file or "flexdt_command" in file for file in files)
        early = not ours and "interrupted" not in said and code in (-signal.SIGINT, 1)
        # A signal that nobody heard, after the command's own words, is not early.
        return "early" if early and (files or not said.strip()) else "wrong"
    if code == INTERRUPTED:
        return "told" if "interrupted" in said and interrupted else "wrong"
    return "done" if 0 <= code <= 5 else "wrong"


def tree_seconds(root: int) -> float:
    """Processor time so far of a process and of what it started, in whatever session [s]."""
    parents, ticks = {}, {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            words = Path("/proc", name, "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(name)] = int(words[1])
        ticks[int(name)] = sum(int(word) for word in words[11:15])
    found, new = set(), {root}
    while new:
        found |= new
        new = {pid for pid, parent in parents.items() if parent in new}
    return max(sum(ticks.get(pid, 0) for pid in found), 1) / os.sysconf("SC_CLK_TCK")


@contextmanager
def in_a_folder() -> Iterator[Path]:
    """A folder for what a command writes."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as name:
        yield Path(name)


def campaign(
    names: Sequence[str], count: int, longest_s: float, seed: int
) -> Iterator[tuple[str, float, End]]:
    """Interrupt commands at random moments of their time.

    Args:
        names: of COMMANDS.
        count: for each.
        longest_s: no moment is later.
        seed: draws the moments.

    Yields:
        Command, moment [s] and end, of each.
    """
    random = np.random.default_rng(seed)
    for name in names:
        with in_a_folder() as folder:
            begun = time.monotonic()
            interrupted(COMMANDS[name], longest_s, folder)
            length = min(longest_s, time.monotonic() - begun)
        for moment in random.uniform(0.0, length, count).tolist():
            with in_a_folder() as folder:
                yield name, moment, interrupted(COMMANDS[name], moment, folder)


def main() -> int:
    """Interrupt each command many times, and print a line for each; 1 where one ended
    wrongly.
    """
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--longest", type=float, default=6.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--only", nargs="*", default=list(COMMANDS), choices=list(COMMANDS)
    )
    chosen = parser.parse_args()
    # A shell ignores SIGINT for what it starts in the background, and so would our children.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    print(
        f"{'command':12}{'told':>6}{'done':>6}{'early':>6}{'wrong':>6}{'clock':>8}{'used':>8}"
    )
    wrong = 0
    for name in chosen.only:
        ends = []
        for _, moment, end in campaign([name], chosen.count, chosen.longest, chosen.seed):
            ends.append(end)
            if end.kind == "wrong":
                print(
                    f"{name} after {moment:.3f} s: code {end.code}\n{end.said}",
                    file=sys.stderr,
                )
        kinds = Counter(end.kind for end in ends)
        wrong += kinds["wrong"]
        row = "".join(f"{kinds[kind]:6}" for kind in ("told", "done", "early", "wrong"))
        clock, used = max(end.wall_s for end in ends), max(end.used_s for end in ends)
        print(f"{name:12}{row}{clock:8.2f}{used:8.2f}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
