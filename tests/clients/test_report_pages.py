"""HTML reports: one template, texts escaped wherever they come from, a plot to scale."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from flexdt.library import dry_run_page
from flexdt.library import report_page as r
from flexdt.twin.errors import TwinError
from flexdt.twin.script import Clearance, Collision

ROOT = Path(__file__).resolve().parents[2]
TEMPLATE = "flexdt/library/report_page.py"
NO_PAGES = {
    "flexdt/library/datasets/notebook_html.py",  # values in a notebook
    "flexdt/library/notebook/notebook_pages.py",  # values in a notebook, with sliders
    "flexdt/library/figures.py",  # finds the SVG in what matplotlib writes
    "twin/projection/volume.py",  # a value in a notebook
    "twin/geometry/cone_vec.py",  # a value in a notebook
}
"""Modules with markup that is not a page's."""
VOID = ("meta",)
NASTY = (
    "<b>",
    "&lt;",
    "a & b",
    "</p>",
    "'\"",
    "<script>x</script>",
    "{title}",
    "é·",
    "  ",
)


class Parsed(HTMLParser):
    """The elements of a page and the texts in them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.classes: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.classes += [str(value) for name, value in attrs if name == "class"]
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


PARTS: dict[str, Callable[[str], str]] = {
    "h1": lambda s: r.heading(s),
    "h3": lambda s: r.heading(s, level=3),
    "p": lambda s: r.paragraph(s, kind="bad"),
    "p span": lambda s: r.paragraph("", r.marked(s, "good")),
    "pre": lambda s: r.code(s),
    "ul li": lambda s: r.bullets([s], ["bad"]),
    "dl dt dd": lambda s: r.facts([(s, s)]),
    "details summary pre": lambda s: r.folded(s, s),
    "table tr th tr td": lambda s: r.table([s], [[s]], kinds=["error"], text=[s]),
}


@pytest.mark.parametrize("tags", PARTS)
def test_every_part_says_its_text_and_nothing_else(tags: str) -> None:
    rng = np.random.default_rng(len(tags))
    for _ in range(50):
        text = "".join(rng.choice(NASTY, rng.integers(1, 6)))
        found = Parsed(PARTS[tags](text))
        assert " ".join(found.tags) == tags
        twice = tags.split()[0] in ("dl", "details", "table")
        assert "".join(found.texts) == text * (1 + twice)


def test_a_page_has_its_title_and_its_parts() -> None:
    body = [
        r.heading("a<b"),
        "",
        r.figure("<svg><g></g></svg>"),
        "<i>of another distribution</i>",
    ]
    found = Parsed(r.page("x & <y>", body).removeprefix("<!doctype html>"))
    assert found.tags == ["html", "head", "meta", "title", "style", "body", "h1", "figure", "svg",
                          "g", "i"]  # fmt: skip
    assert "x & <y>" in found.texts


def test_rows_and_columns_have_their_classes() -> None:
    found = Parsed(
        r.table(["n", "what"], [[1, "a"], [2, "b"]], kinds=["error"], text=["what"])
    )
    assert found.classes == ["text", "error", "text", "text"]


def test_no_other_module_writes_html() -> None:
    """Of the library, the commands, the scripts of the core and the extensions."""
    element = re.compile(
        r"</?(html|body|h[1-6]|p|table|tr|td|th|ul|li|dl|dd|dt|pre|span|svg|path)\b"
    )
    folders = ("flexdt/library", "clients/cli", "twin", "extensions/flexdt_extensions")
    found = set()
    for path in (path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        text = path.read_text("utf-8")
        constants = ast.walk(ast.parse(text)) if element.search(text) else ()
        texts = [node.value for node in constants if isinstance(node, ast.Constant)]
        if any(isinstance(one, str) and element.search(one) for one in texts):
            found.add(path.relative_to(ROOT).as_posix())
    assert TEMPLATE in found
    assert found - {TEMPLATE} == NO_PAGES


def group(svg: str, name: str) -> str:
    """The content of an SVG's group."""
    (found,) = re.findall(rf'<g id="{name}">(.*?)</g>', svg, re.DOTALL)
    return str(found)


def places(path: str) -> np.ndarray:
    """Points (n, 2) of the one path in a group."""
    (d,) = re.findall(r' d="([^"]*)"', path)
    return np.array(re.findall(r"[ML] (-?[\d.]+) (-?[\d.]+)", d), dtype=float)


def test_a_plot_of_clearance_is_to_scale() -> None:
    """Of its curve, its contacts and the labels of its axes: all lie on the same two scales."""
    trace = ((0.0, 40.0), (2.5, -3.0), (7.5, 10.0), (10.0, 0.0))
    hits = (Collision(10, 2.5, ("a<b", "panel"), {}), Collision(12, 9.0, ("x", "y"), {}))
    svg = dry_run_page.clearance_plot(Clearance(hits, -3.0, None, trace))
    curve = places(group(svg, "Smallest-clearance-"))
    across = np.polyfit([0.0, 2.5, 7.5, 10.0], curve[:, 0], 1)
    up = np.polyfit(
        [40.0, 0.0, 10.0, 0.0], curve[:, 1], 1
    )  # parts that overlap are 0 apart
    np.testing.assert_allclose(
        np.polyval(across, [t for t, _ in trace]), curve[:, 0], atol=1e-3
    )
    np.testing.assert_allclose(
        np.polyval(up, [40.0, 0.0, 10.0, 0.0]), curve[:, 1], atol=1e-3
    )
    assert across[0] > 60.0
    assert up[0] < -3.0
    for k, (hit, title) in enumerate(
        zip(hits, ("a&lt;b and panel", "x and y"), strict=True)
    ):
        mark = group(svg, f"Smallest-clearance-mark-{k}")
        assert f"<title>line {hit.line}: {title}</title>" in mark
        x, y = places(mark).T
        np.testing.assert_allclose(x, np.polyval(across, hit.time_s), atol=1e-3)
        assert np.ptp(y) > 0.9 * np.ptp(curve[:, 1])
    for scale, axis in ((across, "x"), (up, "y")):
        ticks = re.findall(rf'<g id="{axis}tick_\d+">(.*?)</text>', svg, re.DOTALL)
        assert len(ticks) > 2
        for tick in ticks:
            (at,) = re.findall(rf'<use [^>]*\b{axis}="([\d.]+)"', tick)[-1:]
            (value,) = re.findall(r">([\d.]+)$", tick)
            assert float(at) == pytest.approx(np.polyval(scale, float(value)), abs=1e-2)


def test_without_matplotlib_the_page_says_why_it_has_no_plot(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def lacking() -> None:
        raise TwinError("a figure needs matplotlib")

    monkeypatch.setattr(dry_run_page, "require_plots", lacking)
    parts = dry_run_page._clearance(Clearance((), 1.0, None, ((0.0, 1.0), (1.0, 2.0))))
    assert Parsed("".join(parts)).texts == [
        "Clearance", "Not drawn: a figure needs matplotlib",
    ]  # fmt: skip
    assert dry_run_page._clearance(None) == []
