"""Links from pages to files of the repository that are no pages.

On a forge they open the file; on the site they become its path, since the site has no copy of
it. A link to a document of `docs/evidence/` leads to the page that is rendered from it. A link
to something that does not exist is a warning, so the build fails.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

from sphinx.util import logging

EVIDENCE = Path("evidence")
"""Folder of the evidence documents, below the folder of all pages."""
RENDERED = Path("_generated", "evidence")
"""Folder of the pages that are rendered from them (`evidence_pages.py`)."""
BENCHMARK = Path("images", "bench.json")
"""The kept benchmark, which is rendered beside them."""

log = logging.getLogger(__name__)
LINK = re.compile(r"(?<!!)\[([^\]\n]+)\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")


def rewritten(text: str, page: Path, pages: Path) -> tuple[str, list[str]]:
    """Return a page's text with links out of the site as paths, and the links that lead
    nowhere.

    Args:
        text: Markdown.
        page: its file.
        pages: the folder of all pages.
    """
    lost: list[str] = []

    def replace(match: re.Match[str]) -> str:
        words, target = match[1], match[2]
        found = (page.parent / target).resolve()
        if not found.exists():
            lost.append(target)
            return match[0]
        if found.suffix == ".json" and (
            found.parent == pages / EVIDENCE or found == pages / BENCHMARK
        ):
            rendered = pages / RENDERED / f"{found.stem}.md"
            link = Path(os.path.relpath(rendered, page.parent)).as_posix()
            return f"[{words}]({link}{match[3] or ''})"
        inside = found.is_relative_to(pages) and found.suffix == ".md"
        if inside or not found.is_relative_to(pages.parent):
            return match[0]
        name = found.relative_to(pages.parent).as_posix() + (
            "/" if found.is_dir() else ""
        )
        plain = words.strip("`")
        return (
            f"`{name}`"
            if name.rstrip("/").endswith(plain.rstrip("/"))
            else f"{words} (`{name}`)"
        )

    return LINK.sub(replace, text), lost


def read(app: Any, docname: str, content: list[str]) -> None:
    """Sphinx's hook: the text of a page, before it is parsed."""
    page = Path(app.env.doc2path(docname)).resolve()
    if page.parent.name == "_generated":
        return
    content[0], lost = rewritten(content[0], page, Path(app.srcdir).resolve())
    for target in lost:
        log.warning("no such page or file: %s", target, location=docname, type="links")


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
