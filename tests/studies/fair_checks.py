"""Who waits for whom: `python tests/studies/fair_checks.py [--clients 20] [--lines 12000]`.

Many connections to a real twin each send a dear check at once; then the client with control sends
one. It must be answered when at most the checks under way at that moment, and the one that took
its place, have been: prints how many answers came first and how long one check took alone, and
exits with 1 where the controller waited for more. `--leave` ends once the controller is answered:
twenty checks of two minutes take an hour of two cores.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import threading
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))

from lab import Refused, Wire, projector, twin

PARALLEL = 2
"""Checks that a twin works on at a time (`x-limits` in `rpc.discover`)."""
PATIENCE_S = 900.0


def dear(lines: int, first: int) -> str:
    """A script of so many moves, another for each client."""
    return "".join(
        f"rot_obj\tmove absolute\t{(first + i) % 360}\t0\tACK\t\t\r\n"
        for i in range(lines)
    )


def check(port: int, text: str, name: str, done: list[tuple[float, str]]) -> None:
    """Check a script over a connection of its own, and note when it was answered."""
    wire = Wire(port, PATIENCE_S)
    wire.call("session.hello", protocol="1.0", client=name)
    try:
        wire.call("script.check", text=text)
    except Refused as error:
        name += f" ({error.code})"
    except OSError:  # the study has left
        return
    done.append((time.monotonic(), name))


def processor_s(pid: int) -> float:
    """Processor time of a process and of the children that it has now [s]."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    pids = [pid, *(int(c) for t in tasks for c in (t / "children").read_text().split())]
    texts = [Path(f"/proc/{p}/stat").read_text().rpartition(")")[2].split() for p in pids]
    return sum(int(t[11]) + int(t[12]) for t in texts) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Run the command line."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--clients", type=int, default=20)
    arguments.add_argument("--lines", type=int, default=12_000)
    arguments.add_argument("--leave", action="store_true")
    asked = arguments.parse_args()
    rays = projector()
    with tempfile.TemporaryDirectory() as data:
        server = twin(rays.port, Path(data))
        try:
            done: list[tuple[float, str]] = []
            began = time.monotonic()
            check(server.port, dear(asked.lines, 0), "alone", done)
            alone = done.pop()[0] - began
            worked = processor_s(server.pid)
            control = Wire(server.port, PATIENCE_S)
            control.call("session.hello", protocol="1.0", client="controller")
            control.call("session.control", action="acquire")
            many = [
                threading.Thread(
                    target=check,
                    args=(server.port, dear(asked.lines, 1 + i), f"client {i}", done),
                    daemon=True,
                )
                for i in range(asked.clients)
            ]
            for thread in many:
                thread.start()
            time.sleep(max(0.5 * alone, 1.0))  # all wait, or are under way
            before = len(done)
            sent = time.monotonic()
            control.call("script.check", text=dear(asked.lines, 500))
            waited, first = time.monotonic() - sent, len(done) - before
            for thread in many if not asked.leave else []:
                thread.join(PATIENCE_S)
        finally:
            server.end()
            rays.end()
    refused = sorted({name.partition(" (")[2] for _, name in done} - {""})
    print(
        f"alone {alone:.1f} s ({worked:.0f} s of the twin's processor); beside {asked.clients} the "
        f"controller waited {waited:.1f} s, "
        f"after {first} answers to others; {len(done)} answered, refused: {refused or 'none'}"
    )
    whole = asked.leave or len(done) == asked.clients
    sys.exit(first > PARALLEL + 1 or not whole)


if __name__ == "__main__":
    main()
