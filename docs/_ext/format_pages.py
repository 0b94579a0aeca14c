"""Pages of the formats of scans, from the tables that their readers follow."""

from __future__ import annotations

import re
from typing import Any

ROLE_WORDS = {
    "used": "used: {}",
    "ignored": "ignored: {}",
    "not applied": "reported, not applied: {}",
    "refused": "refused: {}",
}
"""Role of a field -> how the page says it."""


def file_name(name: str) -> str:
    """Return the name of a format's page."""
    return f"{re.sub(r'[^a-z0-9]+', '-', name.lower()).strip('-')}.md"


def page(form: Any) -> str:
    """Describe a format of `SCAN_FORMATS` with a table: from its file to a volume, where its
    facts come from, which of two statements wins, and every field.
    """
    endings = ", ".join(f"`{ending}`" for ending in form.endings)
    lines = [f"data = {form.table.example}", 'volume = data.reconstruct("fdk")']
    return _described(f"{form.name}: fields of {endings}", form.table, lines)


def _described(title: str, table: Any, lines: list[str]) -> str:
    """Describe a table under a title, with lines of Python that read such a file."""
    rows = [
        f"| `{field.name}` | {_cell(field.meaning)}{_unit(field.unit)} | "
        f"{_cell(ROLE_WORDS[field.role.value].format(field.why))} |"
        for field in table.fields
    ]
    return "\n".join([
        f"# {title}",
        "",
        "```python",
        "import flexdt as fx",
        "",
        *lines,
        "```",
        "",
        f"Sources: {table.source}.",
        "",
        f"If a file states the same quantity twice: {_cell(table.rule)}",
        "",
        "`data.provenance` and `flexdt describe FILE` list every value of a file with its "
        "use. What is not in this table is named in one warning.",
        "",
        "| field | meaning | flexdt |",
        "|---|---|---|",
        *rows,
        "",
    ])  # fmt: skip


def pages() -> dict[str, str]:
    """Return the page of every format with a table, by its file's name."""
    from flexdt.library.reading.foreign_files import SCAN_FORMATS

    return {file_name(form.name): page(form) for form in SCAN_FORMATS if form.table}


def other_pages() -> dict[str, str]:
    """Return the pages of geometry files and of the scanner's own texts, by their names."""
    from flexdt.library.datasets.exchange_formats import FORMATS
    from flexdt.twin.dataset.scan_tables import TEXTS
    from flexdt.twin.exchange.geometry_tables import GEOMETRY_TABLES

    made = {}
    for name, table in GEOMETRY_TABLES.items():
        endings = ", ".join(f"`{ending}`" for ending in FORMATS[name].endings)
        title = f"{table.name}: fields of geometry in {endings}"
        lines = [f"geometry = {table.example}"]
        made[f"geometry-{name}.md"] = _described(title, table, lines)
    for table in TEXTS:
        title = f"FleX-ray: fields of `{table.name}`"
        made[file_name(f"flexray {table.name}")] = _described(
            title, table, [f"data = {table.example}"]
        )
    return made


def block(text: str) -> str:
    """Return the first Python block of a page."""
    found = re.search(r"^```python\n(.*?)```", text, re.MULTILINE | re.DOTALL)
    return found[1] if found else ""


def _unit(unit: str) -> str:
    return f" [{unit}]" if unit else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "\\<").replace("*", "\\*")
