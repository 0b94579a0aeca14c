"""The house's size is a budget: whoever needs more lines in a room says so in `code_budget.toml`.

`PYTHONPATH=tests/studies python tests/test_code_budget.py` writes the numbers of today into it;
the reasons are yours.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

from code_lines import by_folder

ROOT = Path(__file__).parents[1]
BUDGET = Path(__file__).with_name("code_budget.toml")
ROOMS = 2
"""Folders deep that a room is counted."""
SLACK = 20
"""Lines that a room may fall short of its number: what has gone is given back."""


def rooms() -> dict[str, int]:
    """Room of the core -> its code lines, with those of the folders in it."""
    lines: dict[str, int] = {}
    for folder, (_, count) in by_folder(ROOT).items():
        room = "/".join(folder.split("/")[:ROOMS])
        lines[room] = lines.get(room, 0) + count
    return lines


def test_each_room_keeps_its_budget() -> None:
    allowed = tomllib.loads(BUDGET.read_text("utf-8"))["lines"]
    lines = rooms()
    wrong = {
        room: f"{count} lines; {allowed.get(room, 0)} are allowed"
        for room, count in lines.items()
        if not allowed.get(room, 0) - SLACK <= count <= allowed.get(room, 0)
    }
    assert wrong == {}, f"change {BUDGET.name}, with a reason"
    assert set(allowed) == set(lines)


if __name__ == "__main__":
    head = BUDGET.read_text("utf-8").partition("[lines]")[0]
    lines = "".join(f'"{room}" = {count}\n' for room, count in sorted(rooms().items()))
    BUDGET.write_text(f"{head}[lines]\n{lines}", "utf-8")
