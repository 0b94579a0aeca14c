"""Ten dialects of message servers: is every fault told in time, and a healthy day without
alarms?

    python tests/studies/drawn_dialects.py [--conversations 10000] [--hours 24] [--seed 0]

Conversations are drawn from all dialects in turns, each with a fault of the machine, of the
server, of both or of neither; the days are healthy, once on a machine whose times are assumed
and once on one with measured times that vary log-normally (median 0.4 s, 40 %).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[2]))

from tests.support.dialect_runs import FLEXRAY, Listener, measured, missed
from tests.support.dialects import DIALECTS, conversation, healthy

OVERHEAD = (0.4, 0.4)


def drawn(count: int, seed: int) -> None:
    """Print what of so many conversations is not told, or told though nothing is wrong."""
    began, wrong, faults = time.monotonic(), Counter[str](), 0
    for k in range(count):
        dialect = DIALECTS[k % len(DIALECTS)]
        made = conversation(dialect, seed + k // len(DIALECTS))
        faults += len(made.faults)
        for line in missed(made):
            wrong[dialect.name] += 1
            print(f"seed {seed + k // len(DIALECTS)}: {line}")
    print(
        f"{count} conversations, {faults} faults: {sum(wrong.values())} wrong {dict(wrong)}; "
        f"{time.monotonic() - began:.0f} s"
    )


def days(hours: float, seed: int) -> None:
    """Print the alarms of healthy days."""
    for what, overhead in (("assumed", None), ("measured", OVERHEAD)):
        machine = FLEXRAY if overhead is None else measured(overhead)
        for dialect in DIALECTS:
            began, listener = time.monotonic(), Listener(machine=machine)
            messages = sorted(
                healthy(dialect, seed, 3600.0 * hours, overhead), key=lambda m: m[0]
            )
            listener.hear(messages)
            kinds = Counter((a.severity, a.kind) for a in listener.alarms)
            errors = sum(n for (severity, _), n in kinds.items() if severity == "error")
            print(
                f"{hours:g} h, {what} times, {dialect.name}: {len(messages)} messages, "
                f"{errors} errors, {len(listener.alarms) - errors} warnings {dict(kinds)}; "
                f"{time.monotonic() - began:.0f} s",
                flush=True,
            )


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--conversations", type=int, default=10_000)
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    drawn(options.conversations, options.seed)
    days(options.hours, options.seed)


if __name__ == "__main__":
    main()
