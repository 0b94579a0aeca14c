"""Small files that ask for much, at three doors: `python tests/studies/bombs.py [--each 3]
[--seed 1] [--doors library,command,wire] [--only KIND]`.

Each bomb of `tests/support/bombs_drawn.py` is opened by the library, by the command line, each in a
process of its own, and by a twin to which a client sends it. Every answer must be a sentence (at
most `MOST_LINES` lines, no traceback, no "defect"), within `MOST_S` of processor time and `MOST_MB`
of memory; for the wire these are the twin's and its workers', beyond what it had. Prints a line a
bomb and door, and exits with 1 where one is not so.
"""

from __future__ import annotations

import argparse
import base64
import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from bombs_drawn import KINDS, Bomb, mib
from lab import Process, Refused, Wire, projector, twin

MOST_S, MOST_MB, MOST_LINES, MOST_CHARACTERS = 10.0, 500.0, 51, 10_000
PATIENCE_S = 200.0
CHUNK = 3 << 20
PEAK = """
import atexit, sys
@atexit.register
def tell():
    with open("/proc/self/status") as status, open(sys.argv[1], "w") as out:
        out.write(status.read().split("VmHWM:")[1].split()[0])
"""
"""Writes the peak of its memory [KiB] into the file of the first argument."""
OPEN = f"""{PEAK}
import flexdt as fx
P = sys.argv[2]
try:
    STATEMENT
except (fx.TwinError, OSError) as error:
    print(error, file=sys.stderr)
    sys.exit(1)
"""
COMMAND = f"""{PEAK}
from flexdt.clients.cli.command_tree import run
sys.exit(run(sys.argv[2:]))
"""


class Answer(NamedTuple):
    """How a door answered: its words, what they cost, whether it refused."""

    words: str
    seconds: float
    mb: float
    refused: bool

    def faults(self, bomb: Bomb, door: str) -> list[str]:
        """What is not as it must be; a twin lists a data set whose document it cannot read."""
        listed = door == "wire" and bomb.upload == "dataset"
        lines = self.words.strip().splitlines()
        return [
            said
            for said, holds in (
                ("a traceback", "Traceback" in self.words),
                ("a defect", "defect" in self.words),
                ("no words", self.refused and not lines),
                (f"{len(lines)} lines", len(lines) > MOST_LINES),
                (f"{len(self.words)} characters", len(self.words) > MOST_CHARACTERS),
                (f"{self.seconds:.1f} s", self.seconds > MOST_S),
                (f"{self.mb:.0f} MB", self.mb > MOST_MB),
                ("not refused", not self.refused and not bomb.harmless and not listed),
            )
            if holds
        ]


def run(program: str, *arguments: str) -> Answer:
    """Run a program of Python to its end, or for `PATIENCE_S`; infinite memory where it
    did not end by itself.
    """
    with tempfile.TemporaryFile() as said, tempfile.NamedTemporaryFile("r") as peak:
        process = subprocess.Popen(
            ["timeout", "-s", "KILL", str(PATIENCE_S), sys.executable, "-c", program,
             peak.name, *arguments],
            stdout=subprocess.DEVNULL, stderr=said, stdin=subprocess.DEVNULL,
        )  # fmt: skip
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        words = said.read(1 << 20).decode("utf-8", "replace")
        mb = float(peak.read() or "inf") / 1024
    return Answer(words, used.ru_utime + used.ru_stime, mb, process.returncode != 0)


def at_the_wire(bomb: Bomb, port: int) -> Answer:
    """Let a new twin read a bomb, and tell what it cost beyond the start."""
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder)
        if bomb.upload == "dataset":
            (data / bomb.path.name).symlink_to(bomb.path)
            (data / "own").mkdir()
            for file in bomb.path.iterdir():
                (data / "own" / file.name).write_bytes(file.read_bytes())
        server = twin(port, data)
        try:
            wire = Wire(server.port, PATIENCE_S)
            before = usage(server)
            refused, words = False, ""
            try:
                send(wire, bomb)
            except Refused as error:
                refused, words = True, str(error)
            after = usage(server)
            if not wire.call("state.get"):
                words += "Traceback: the twin is gone"
        finally:
            server.end()
    return Answer(words, after[0] - before[0], after[1] - before[1], refused)


def usage(server: Process) -> tuple[float, float]:
    """Processor time [s] and peak memory [MB] of a server and the processes below it."""
    return server.processor_s() + children_s(server.pid), peak_mb(server.pid)


def below(pid: int) -> Iterator[int]:
    """A process and those that it started."""
    yield pid
    for task in Path(f"/proc/{pid}/task").glob("*/children"):
        for child in task.read_text().split():
            yield from below(int(child))


def peak_mb(pid: int) -> float:
    """Sum of the peaks of a process and those below it [MB]."""
    total = 0
    for one in below(pid):
        status = Path(f"/proc/{one}/status").read_text().split("VmHWM:")
        total += int(status[1].split()[0]) if len(status) > 1 else 0
    return total / 1024


def children_s(pid: int) -> float:
    """Processor time of the processes below one, and of those that it waited for [s]."""
    tick = os.sysconf("SC_CLK_TCK")
    total = 0.0
    for one in below(pid):
        words = Path(f"/proc/{one}/stat").read_text().rpartition(")")[2].split()
        user, system, waited_user, waited_system = map(int, words[11:15])
        total += waited_user + waited_system + (user + system if one != pid else 0)
    return total / tick


def send(wire: Wire, bomb: Bomb) -> None:
    """Send a bomb as a client would, or ask for it where it lies."""
    wire.call("session.hello", protocol="1.0", client="bombs")
    if bomb.upload == "dataset":
        wire.call("dataset.get", name="own")
        return
    raw = bomb.path.read_bytes()
    form = {"format": bomb.upload}
    if bomb.upload == "scene":
        form = {"format": bomb.path.suffix.removeprefix("."), "kind": "scene"}
    for at in range(0, len(raw), CHUNK):
        part = base64.b64encode(raw[at : at + CHUNK]).decode()
        wire.call(
            "sample.upload", name="bomb", total=len(raw), start=at, data=part, **form
        )
    wire.call("sample.set", file="bomb")


def main() -> None:
    """Run the command line."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--each", type=int, default=3)
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--doors", default="library,command,wire")
    arguments.add_argument("--only", choices=KINDS, action="append")
    asked = arguments.parse_args()
    doors = asked.doors.split(",")
    rays = projector() if "wire" in doors else None
    bad, answers, worst_s, worst_mb = 0, 0, 0.0, 0.0
    try:
        for kind in asked.only or KINDS:
            for i in range(asked.each):
                with tempfile.TemporaryDirectory() as folder:
                    rng = random.Random(f"{asked.seed} {kind} {i}")
                    bomb = KINDS[kind](rng, Path(folder))
                    said = (
                        f"{kind} {i}: {mib(bomb.path):.3g} MiB"
                        if kind != "endless"
                        else kind
                    )
                    for door in doors:
                        if door == "wire" and not bomb.upload:
                            continue
                        answer = answered(door, bomb, Path(folder), rays)
                        faults = answer.faults(bomb, door)
                        bad, answers = bad + bool(faults), answers + 1
                        worst_s = max(worst_s, answer.seconds)
                        worst_mb = max(worst_mb, answer.mb)
                        words = answer.words.strip().replace("\n", " | ")[:110]
                        print(
                            f"{said} {door:8s} {answer.seconds:5.1f} s {answer.mb:5.0f} MB "
                            f"{'; '.join(faults) or 'ok'}: {words}",
                            flush=True,
                        )
    finally:
        if rays is not None:
            rays.end()
    print(
        f"{answers} answers, {bad} not as they must be; at most {worst_s:.1f} s of processor "
        f"time and {worst_mb:.0f} MB"
    )
    sys.exit(bad > 0)


def answered(door: str, bomb: Bomb, folder: Path, rays: Process | None) -> Answer:
    """Bring a bomb to a door."""
    if door == "library":
        return run(OPEN.replace("STATEMENT", bomb.library), str(bomb.path))
    if door == "command":
        out = folder / "out"
        out.mkdir(exist_ok=True)
        words = [word.replace("{P}", str(bomb.path)) for word in bomb.command]
        return run(COMMAND, *(word.replace("{OUT}", str(out)) for word in words))
    assert rays is not None
    return at_the_wire(bomb, rays.port)


if __name__ == "__main__":
    main()
