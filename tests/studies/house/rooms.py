"""Modules and code lines of each folder."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from house.sources import Measure, Module


def measure(modules: Sequence[Module]) -> list[Measure]:
    """Return the code lines of each folder, then the modules and code lines of all."""
    lines: Counter[str] = Counter()
    for module in modules:
        lines[module.room] += module.lines_of_code
    rooms = [Measure(room, lines[room], "lines") for room in sorted(lines)]
    return [
        *rooms,
        Measure("modules", len(modules)),
        Measure("code lines", sum(lines.values()), "lines"),
    ]
