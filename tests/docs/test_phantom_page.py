"""The page of phantoms has a row for each name, and the names of the materials."""

from __future__ import annotations

import re
from pathlib import Path

from flexdt.phantoms import materials, phantom_names

PAGE = Path(__file__).resolve().parents[2] / "docs" / "phantoms.md"


def test_every_shipped_phantom_has_a_row() -> None:
    table = (
        PAGE.read_text(encoding="utf-8")
        .split("| name | what |", 1)[1]
        .split("\n\n", 1)[0]
    )
    rows = re.findall(r"^\| `([a-z0-9 -]+)` \|", table, re.MULTILINE)
    assert sorted(name for row in rows for name in row.split()) == sorted(phantom_names())


def test_the_materials_are_listed() -> None:
    listed = re.findall(r"^Materials: `([^`]*)`", PAGE.read_text("utf-8"), re.MULTILINE)
    assert [text.split() for text in listed] == [list(materials())]
