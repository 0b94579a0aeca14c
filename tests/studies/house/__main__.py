"""Print all measures of the core beside those of the last release; `make house`.

    PYTHONPATH=tests/studies python -m house [--list WORD] [--save VERSION] [ROOT]

Figures of a release are kept in docs/house/VERSION.json; `--save` writes them.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from house import circles, copied_lists, density, glue, lookups, prose, rooms
from house.sources import Measure, Module, read_modules

REPOSITORY = Path(__file__).resolve().parents[3]
RELEASES = REPOSITORY / "docs" / "house"
MEASURES = (rooms, circles, lookups, copied_lists, glue, prose, density)
"""Modules with a function `measure`, in the order of the table."""


def main() -> None:
    """Print the table, or the findings of the measures that `--list` names."""
    parser = argparse.ArgumentParser(
        prog="house",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "root", nargs="?", type=Path, default=REPOSITORY, help="another clone"
    )
    parser.add_argument(
        "--list", metavar="WORD", help="print findings of measures with this word"
    )
    parser.add_argument(
        "--save", metavar="VERSION", help="keep the figures as those of a release"
    )
    chosen = parser.parse_args()
    found = measured(read_modules(chosen.root))
    if chosen.list is not None:
        lines = findings(found, chosen.list)
    else:
        version, before = last_release(RELEASES, before=chosen.save)
        lines = table(found, version, before)
    try:
        print("\n".join(lines))
    except BrokenPipeError:
        sys.stderr.close()
    if chosen.save is not None:
        save(found, RELEASES / f"{chosen.save}.json")


def measured(modules: Sequence[Module]) -> list[Measure]:
    """Apply every measure."""
    return [result for measure in MEASURES for result in measure.measure(modules)]


def table(
    found: Sequence[Measure], version: str, before: Mapping[str, float]
) -> list[str]:
    """Return the lines of the table: measure, figure of the last release, figure now.

    Args:
        found: measures now.
        version: last release; empty where none is kept.
        before: its figures by the measures' names.
    """
    gone = [Measure(name, 0.0) for name in before if name not in {m.name for m in found}]
    lines = [f"{'':46}{version or 'no release':>12}{'now':>10}"]
    for measure in [*found, *gone]:
        old = _figure(before[measure.name]) if measure.name in before else "-"
        lines.append(
            f"{measure.name:46}{old:>12}{_figure(measure.value):>10} {measure.unit}".rstrip()
        )
    return lines


def findings(found: Sequence[Measure], word: str) -> list[str]:
    """Return the findings of the measures whose name contains `word`, or which names there
    are."""
    chosen = [measure for measure in found if word.lower() in measure.name.lower()]
    if not chosen:
        return [
            f'no measure has "{word}" in its name; there are:',
            *(m.name for m in found),
        ]
    return [
        line for m in chosen for line in (f"# {m.name}: {_figure(m.value)}", *m.findings)
    ]


def last_release(folder: Path, before: str | None = None) -> tuple[str, dict[str, float]]:
    """Return version and figures of the newest kept release; empty where there is none.

    Args:
        folder: one JSON file a release.
        before: a version that does not count.
    """
    versions = [path.stem for path in folder.glob("*.json") if path.stem != before]
    if not versions:
        return "", {}
    newest = max(versions, key=lambda v: [int(part) for part in v.split(".")])
    return newest, json.loads((folder / f"{newest}.json").read_text(encoding="utf-8"))


def save(found: Sequence[Measure], path: Path) -> None:
    """Write the figures, measure -> number, as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figures = {measure.name: round(measure.value, 2) for measure in found}
    path.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def _figure(value: float) -> str:
    return f"{value:.0f}" if value == round(value) else f"{value:.1f}"


if __name__ == "__main__":
    main()
