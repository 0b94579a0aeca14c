"""Processor time that each test file took: `durations.py [--over 10] [FILE.xml ...]`.

`make test`, `test-extensions`, `studies` and `page` write what each test took to
build/durations/: processor time, which other work on the machine does not change, of the test,
its fixtures and the processes that ended in it. The files that took more than `--over` seconds,
the budget of a file in `make test`, are listed, the longest first, with their longest test.
"""

from __future__ import annotations

import argparse
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

FOLDER = Path(__file__).parents[2] / "build" / "durations"


def seconds(report: Path) -> dict[str, dict[str, float]]:
    """Test file -> test -> seconds of processor time, set-up and tear-down included."""
    found: dict[str, dict[str, float]] = defaultdict(dict)
    for case in ElementTree.parse(report).iter("testcase"):
        name = case.get("name", "")
        tests = found[case.get("classname", "")]
        for spent in case.iterfind("properties/property[@name='processor_s']"):
            tests[name] = tests.get(name, 0.0) + float(spent.get("value", "0"))
    return found


def main() -> None:
    """Print the sum of each report, and the files above a limit with their longest test."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "reports", nargs="*", type=Path, default=sorted(FOLDER.glob("*.xml"))
    )
    parser.add_argument(
        "--over", type=float, default=10.0, help="list files above so many seconds"
    )
    chosen = parser.parse_args()
    for report in chosen.reports:
        files = {name: (sum(t.values()), t) for name, t in seconds(report).items()}
        print(
            f"{report.stem}: {sum(t for t, _ in files.values()):.0f} s in {len(files)} files"
        )
        for name, (total, tests) in sorted(files.items(), key=lambda f: -f[1][0]):
            if total > chosen.over:
                longest = max(tests, key=lambda test: tests[test])
                print(f"{total:8.1f} s  {name}  ({tests[longest]:.1f} s: {longest})")


if __name__ == "__main__":
    main()
