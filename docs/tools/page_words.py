"""Count the documentation: words and pictures by shelf and by page.

    python docs/tools/page_words.py [--pages]

A page's words are those of its Markdown, code and tables included. The evidence shelf's figures
are data (`docs/evidence/*.json`) and are counted by themselves.
Pages that are generated from code are not counted.
"""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator
from pathlib import Path

DOCS = Path(__file__).resolve().parent.parent
SHELVES = {
    "use": "use.md",
    "understand": "understand.md",
    "evidence": "evidence/index.md",
}
"""Shelf -> the page whose list of contents says what stands on it."""
PICTURE = re.compile(r"!\[|\.imshow\(|\.plot\(|plt\.|\.show\(|^show\(", re.MULTILINE)
"""An image, or a line of a notebook that draws one."""
CONTENTS = re.compile(r"```\{toctree\}\n(.*?)```", re.DOTALL)


def contents(page: Path) -> Iterator[Path]:
    """Yield the pages that a page's lists of contents name, each followed by those that
    it names in turn; entries without a file are skipped.
    """
    for block in CONTENTS.findall(page.read_text("utf-8")):
        for entry in block.splitlines():
            path = (page.parent / entry.strip().removesuffix(".md")).with_suffix(".md")
            if entry.strip() and not entry.startswith(":") and path.is_file():
                yield path
                yield from contents(path)


def shelves() -> dict[str, list[Path]]:
    """Return the pages of each shelf, a page in the first shelf that lists it, and under
    `other` those of none, sorted; generated pages are left out.
    """
    pages_of: dict[str, list[Path]] = {}
    placed: set[Path] = set()
    for shelf, name in SHELVES.items():
        index = DOCS / name
        pages = [index, *(path.resolve() for path in contents(index))]
        pages_of[shelf] = [path for path in dict.fromkeys(pages) if path not in placed]
        placed |= {*pages_of[shelf]}
    rest = {path.resolve() for path in DOCS.rglob("*.md")} - placed
    generated = {path for path in rest if path.relative_to(DOCS).parts[0].startswith("_")}
    pages_of["other"] = sorted(rest - generated)
    return pages_of


def words(path: Path) -> int:
    """Count what stands between blanks."""
    return len(path.read_text("utf-8").split())


def pictures(path: Path) -> int:
    """Count images and drawing lines of notebooks."""
    return len(PICTURE.findall(path.read_text("utf-8")))


def main() -> None:
    """Print words, pages and pages without a picture of each shelf; with --pages a line
    for each page, too.
    """
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument(
        "--pages", action="store_true", help="a line for each page, too"
    )
    each_page = arguments.parse_args().pages
    total = 0
    for shelf, pages in shelves().items():
        count = sum(words(path) for path in pages)
        total += count
        bare = sum(not pictures(path) for path in pages)
        print(
            f"{shelf:12s} {count:7d} words {len(pages):4d} pages, {bare} without a picture"
        )
        if each_page:
            for path in pages:
                name = path.relative_to(DOCS).as_posix()
                print(f"  {name:40s} {words(path):6d} words {pictures(path):3d} pictures")
    print(f"{'all':12s} {total:7d} words")
    data = sum(words(path) for path in DOCS.glob("evidence/*.json"))
    print(f"{'besides':12s} {data:7d} words of evidence as JSON")


if __name__ == "__main__":
    main()
