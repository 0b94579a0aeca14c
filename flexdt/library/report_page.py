"""The template of HTML reports: a page that needs no other file, and the parts of its body.

Every part escapes the texts that it is given. Figures are SVG elements of
`flexdt.library.figures`.
"""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Sequence
from itertools import zip_longest
from typing import Final

PAGE: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font-family: system-ui, sans-serif; margin: 2rem auto; max-width: 62rem; color: #1f2933; }}
table {{ border-collapse: collapse; margin: 1rem 0; }}
td, th {{ border: 1px solid #cbd2d9; padding: .25rem .6rem; text-align: right; font-size: .85rem; }}
th {{ background: #f0f3f6; }} td:first-child, th:first-child {{ text-align: left; }}
td.text, th.text {{ text-align: left; }}
dl {{ display: grid; grid-template-columns: max-content 1fr; gap: .1rem 1.2rem; }}
dd {{ margin: 0; }}
.bad, .error {{ color: #9b2226; font-weight: 600; }} .good {{ color: #2d6a4f; font-weight: 600; }}
.warning {{ color: #8a5300; }}
figure {{ display: inline-block; margin: .5rem 1rem .5rem 0; }}
svg {{ max-width: 100%; height: auto; }}
</style></head><body>
{body}
</body></html>
"""


class Markup(str):
    """HTML; any other text is escaped where it becomes part of a page."""

    __slots__ = ()


def page(title: str, body: Sequence[str]) -> str:
    """Make a complete HTML page of HTML parts, empty ones left out."""
    return PAGE.format(
        title=html.escape(title), body="\n".join(part for part in body if part)
    )


def heading(*texts: str, level: int = 1) -> Markup:
    """Make a heading; level 1 is the page's own."""
    return _element(f"h{level}", *texts)


def paragraph(*texts: str, kind: str = "") -> Markup:
    """Make a paragraph.

    Args:
        texts: joined as they are.
        kind: `good`, `bad`, `error`, `warning` or empty.
    """
    return _element("p", *texts, kind=kind)


def marked(text: str, kind: str) -> Markup:
    """Mark a word in a text (see `paragraph`)."""
    return _element("span", text, kind=kind)


def code(text: str) -> Markup:
    """Make a block of code."""
    return _element("pre", text)


def bullets(texts: Iterable[str], kinds: Iterable[str] = ()) -> Markup:
    """Make an HTML list; `kinds` are the items' kinds in order (see `paragraph`), none
    for those beyond.
    """
    items = zip_longest(texts, kinds, fillvalue="")
    return _element(
        "ul", Markup("".join(_element("li", text, kind=kind) for text, kind in items))
    )


def facts(pairs: Iterable[tuple[str, str]]) -> Markup:
    """Make a list of labels and values."""
    rows = (_element("dt", label) + _element("dd", value) for label, value in pairs)
    return _element("dl", Markup("".join(rows)))


def folded(summary: str, text: str) -> Markup:
    """Make a block of code that opens on demand."""
    return _element("details", _element("summary", summary), code(text))


def figure(svg: str) -> Markup:
    """Make a figure of an SVG element."""
    return _element("figure", Markup(svg))


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    kinds: Iterable[str] = (),
    text: Iterable[str] = (),
) -> Markup:
    """Make a table.

    Args:
        head: names of the columns.
        rows: cells (see `cell_text`).
        kinds: of the rows (see `paragraph`), in order; rows beyond them have none.
        text: names of the columns that hold text, which begins at the left.
    """
    texts = set(text)
    sides = ["text" if name in texts else "" for name in head]
    lines = [_row("th", head, sides)]
    for row, kind in zip_longest(rows, kinds, fillvalue=""):
        lines.append(_row("td", row, sides, str(kind)))
    return _element("table", Markup("".join(lines)))


def _row(
    tag: str, cells: Sequence[object], sides: Sequence[str], kind: str = ""
) -> Markup:
    """Make an HTML table row of cells with the tag `td` or `th`, each with the class of
    its side; `kind` is the row's class, none if ""."""
    made = (
        _element(tag, cell_text(c), kind=side)
        for c, side in zip(cells, sides, strict=True)
    )
    return _element("tr", Markup("".join(made)), kind=kind)


def cell_text(value: object) -> str:
    """Format the value of a table's cell: None and non-finite numbers as "-", booleans as
    yes or no.

    Other floats get four digits, two if under 0.01 or from 1e4 on; the rest as `str`
    does.
    """
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float() if not math.isfinite(value):
            return "-"
        case float():
            if 0 < abs(value) < 0.01 or abs(value) >= 1e4:
                return f"{value:.2g}"
            return f"{value:.4g}"
        case _:
            return str(value)


def _element(tag: str, *content: str, kind: str = "") -> Markup:
    """Make an HTML element with its class (none if ""); content that is no `Markup` is
    escaped.
    """
    inner = "".join(
        part if isinstance(part, Markup) else html.escape(part) for part in content
    )
    mark = f" class='{kind}'" if kind else ""
    return Markup(f"<{tag}{mark}>{inner}</{tag}>")
