"""Links from pages to files of the repository that are no pages.

On a forge they open the file; on the site they become its path, since the site has no copy of
it. A link to a document of `docs/evidence/` leads to the page that is rendered from it, and one
to a file that declares a list to the page of that list (`list_pages.py`). A link to something
that does not exist is a warning, so the build fails.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import list_pages

EVIDENCE = Path("evidence")
"""Folder of the evidence documents, below the folder of all pages."""
RENDERED = Path("_generated", "evidence")
"""Folder of the pages that are rendered from them (`evidence_pages.py`)."""
BENCHMARK = Path("images", "bench.json")
"""The kept benchmark, which is rendered beside them."""

LINK = re.compile(
    r"(?<!!)\[((?:[^\[\]\n]|\n(?!\s*\n))+)\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)"
)
"""A link; its words may go on in the next line, but in no other paragraph."""


def rewritten(text: str, page: Path, pages: Path) -> tuple[str, list[str]]:
    """Return a page's text with links out of the site as paths, and the links that lead
    nowhere.

    Links to evidence and benchmark files become links to their rendered pages. Other
    links, to pages, to files out of the repository and of the web, stay; so do pictures.

    Args:
        text: Markdown.
        page: its file.
        pages: the folder of all pages.

    Returns:
        The text, and the targets that do not exist, whose links stay.
    """
    lost: list[str] = []

    def replace(match: re.Match[str]) -> str:
        """Return the replacement of one link; a target that does not exist is added to
        `lost`, and its link stays.
        """
        words = match[1]
        target = match[2]
        path = (page.parent / target).resolve()
        if not path.exists():
            lost.append(target)
            return match[0]
        if path.suffix == ".json" and (
            path.parent == pages / EVIDENCE or path == pages / BENCHMARK
        ):
            rendered = pages / RENDERED / f"{path.stem}.md"
            link = Path(os.path.relpath(rendered, page.parent)).as_posix()
            return f"[{words}]({link}{match[3] or ''})"
        if path.is_relative_to(pages.parent) and (
            listed := list_pages.LISTED.get(path.relative_to(pages.parent).as_posix())
        ):
            made = pages / RENDERED.parent / listed
            return f"[{words}]({Path(os.path.relpath(made, page.parent)).as_posix()})"
        inside = path.is_relative_to(pages) and path.suffix == ".md"
        if inside or not path.is_relative_to(pages.parent):
            return match[0]
        name = path.relative_to(pages.parent).as_posix() + ("/" if path.is_dir() else "")
        plain = words.strip("`")
        return (
            f"`{name}`"
            if name.rstrip("/").endswith(plain.rstrip("/"))
            else f"{words} (`{name}`)"
        )

    return LINK.sub(replace, text), lost


def read(app: Any, docname: str, content: list[str]) -> None:
    """Rewrite the links of a page in place, before it is parsed, and warn of those that
    lead nowhere (hook `source-read`); pages of `_generated` itself stay.
    """
    from sphinx.util import logging  # tests use the rest, and need no Sphinx

    log = logging.getLogger(__name__)
    page = Path(app.env.doc2path(docname)).resolve()
    if page.parent.name == "_generated":
        return
    content[0], lost = rewritten(content[0], page, Path(app.srcdir).resolve())
    for target in lost:
        log.warning("no such page or file: %s", target, location=docname, type="links")


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
