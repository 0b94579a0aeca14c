"""The pages of the documentation as texts: Markdown files, and the evidence rendered from
JSON."""

from __future__ import annotations

from pathlib import Path

from loaded_script import load

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


def evidence() -> dict[Path, str]:
    """Return the rendered Markdown of each evidence document, by the path of its JSON."""
    rendered = load(DOCS / "_ext" / "evidence_pages.py").pages(DOCS / "evidence")
    return {
        DOCS / "evidence" / f"{Path(name).stem}.json": text
        for name, text in rendered.items()
    }


def pages() -> dict[Path, str]:
    """Return the text of each page, by its path; what is generated from code is left out."""
    paths = (
        p for p in DOCS.rglob("*.md") if not p.relative_to(DOCS).parts[0].startswith("_")
    )
    return {path: path.read_text("utf-8") for path in sorted(paths)} | evidence()
