"""Processor time that each test file took: `durations.py [--over 10] [--write] [FILE.xml ...]`.

`make test`, `test-extensions`, `studies` and `page` write what each test took to
build/durations/: processor time, which other work on the machine does not change, of the test,
its fixtures and the processes that ended in it; what a module's tests share, its servers and
browsers, counts for each of them alike. The files that took more than `--over` seconds are listed,
the longest first, with their longest test.

`--write` keeps the means of tests whose cases take a third of a second or more together, for
`tests/support/suite.py`, which leaves in `make test` what its budget allows. Tests that are in no
report keep theirs, and those that are gone lose it.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "build" / "durations"
MEASURED = ROOT / "tests" / "support" / "processor_s.json"
LEAST_S = 0.3
"""Processor time of all cases of a test from which their mean is kept."""


def seconds(report: Path) -> dict[str, dict[str, float]]:
    """Test file -> test -> seconds of processor time, set-up and tear-down included."""
    found: dict[str, dict[str, float]] = defaultdict(dict)
    shared: dict[str, float] = defaultdict(float)
    for case in ElementTree.parse(report).iter("testcase"):
        name = case.get("name", "")
        module = case.get("classname", "")
        tests = found[module]
        for spent in case.iterfind("properties/property"):
            value = float(spent.get("value", "0"))
            if spent.get("name") == "processor_s":
                tests[name] = tests.get(name, 0.0) + value
            elif spent.get("name") == "shared_s":
                shared[module] += value
    for module, value in shared.items():
        for name in found[module]:
            found[module][name] += value / len(found[module])
    return found


def means(reports: list[Path]) -> dict[str, float]:
    """Mean processor time of the cases of each test [s], by its path and name: of the last
    report in which they take LEAST_S together, or 0 without one."""
    found: dict[str, float] = {}
    for report in reports:
        for place, tests in seconds(report).items():
            cases: dict[str, list[float]] = defaultdict(list)
            for case, spent in tests.items():
                cases[re.sub(r"\[.*", "", case)].append(spent)
            for name, each in cases.items():
                test = f"{place.replace('.', '/')}.py::{name}"
                if sum(each) >= LEAST_S:
                    found[test] = round(statistics.fmean(each), 2)
                else:
                    found.setdefault(test, 0.0)
    return found


def is_there(test: str) -> bool:
    """Whether a module has a function for a test."""
    path, _, name = test.partition("::")
    module = ROOT / path
    return module.is_file() and f"def {name}(" in module.read_text(encoding="utf-8")


def merged(known: dict[str, float], fresh: dict[str, float]) -> dict[str, float]:
    """Means with fresh ones in their places, of tests that exist and take long."""
    every = known | fresh
    return {test: mean for test, mean in every.items() if mean > 0.0 and is_there(test)}


def main() -> None:
    """Print the sum of each report, and the files above a limit with their longest test."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "reports", nargs="*", type=Path, default=sorted(FOLDER.glob("*.xml"))
    )
    parser.add_argument(
        "--over", type=float, default=10.0, help="list files above so many seconds"
    )
    parser.add_argument(
        "--write", action="store_true", help="keep the means for the next runs"
    )
    chosen = parser.parse_args()
    if chosen.write:
        known = json.loads(MEASURED.read_text(encoding="utf-8"))
        kept = merged(known, means(chosen.reports))
        MEASURED.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")
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
