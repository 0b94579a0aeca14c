"""Render the evidence shelf: one page for each JSON file in `docs/evidence/`.

A file holds measured figures as tables, each with the command that makes it, so that pages of
the other shelves need none. Links in a file are relative to `docs/evidence/`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

GENERATED = "_generated/evidence"
"""Folder of the rendered pages, below the folder of all pages."""


def rendered(document: Mapping[str, Any]) -> str:
    """Render one evidence document as Markdown.

    Args:
        document: `title`, `about` and `sections`. A section has a `title`, `commands`
            (shell lines that make its figures; none if its last column is `command`, or
            if it has `sources` of what it cites), and may have `measured` (date, machine,
            load), `text` (paragraphs), `columns` and `rows` (cells in Markdown).

    Returns:
        The page. Headings of sections are its anchors. Of a section: title, text,
        commands, sources, table, in this order.
    """
    parts = [f"# {document['title']}", document["about"]]
    for section in document["sections"]:
        parts.append(f"## {section['title']}")
        parts += section.get("text", [])
        if section["commands"]:
            parts.append(_commands(section))
        if "sources" in section:
            parts.append(f"Sources: {section['sources']}.")
        if "columns" in section:
            parts.append(_table(section["columns"], section["rows"]))
    return "\n\n".join(parts) + "\n"


def _commands(section: Mapping[str, Any]) -> str:
    """Name a section's commands, and in brackets when and where they were measured, if
    that is stated.
    """
    lines = ", ".join(f"`{line}`" for line in section["commands"])
    measured = section.get("measured")
    return f"Command: {lines}" + (f" ({measured})" if measured else "")


def _table(columns: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def pages(folder: Path) -> dict[str, str]:
    """Render every document of a folder.

    Args:
        folder: holds `NAME.json` files.

    Returns:
        `NAME.md` -> Markdown whose links are relative to `folder`.
    """
    texts = {}
    for path in sorted(folder.glob("*.json")):
        texts[f"{path.stem}.md"] = rendered(json.loads(path.read_text("utf-8")))
    return texts


def moved(text: str) -> str:
    """Rewrite links relative to `docs/evidence/` for a page in `docs/_generated/evidence/`."""
    siblings = re.sub(r"\]\(([\w-]+)\.json", r"](\1.md", text)
    return siblings.replace("](../", "](../../")
