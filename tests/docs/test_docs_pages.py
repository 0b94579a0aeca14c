"""The pages by themselves: links, drawings, generated reference, claims with their commands."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import pytest
from doc_pages import evidence
from loaded_script import load

from flexdt.runtime.access import (
    ConnectionLimits,
    TwinLimits,
    ViewerLimits,
    limit_names,
)

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(
    p for p in DOCS.rglob("*.md") if not p.relative_to(DOCS).parts[0].startswith("_")
)


LINKS = load(DOCS / "_ext" / "links_outside.py")
GENERATED = load(DOCS / "_ext" / "generated_pages.py")
ACCESS = ConnectionLimits(), TwinLimits(), ViewerLimits()


@pytest.mark.parametrize("page", [*PAGES, ROOT / "README.md"], ids=lambda p: p.stem)
def test_links_lead_somewhere_on_a_forge(page: Path) -> None:
    text = page.read_text()
    assert LINKS.rewritten(text, page, DOCS)[1] == []
    for image in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text):
        assert (page.parent / image).is_file(), image


def test_links_out_of_the_site_become_paths(tmp_path: Path) -> None:
    pages = tmp_path / "docs"
    pages.mkdir()
    (pages / "a.md").write_text("")
    (tmp_path / "spec.txt").write_text("")
    text = "[the\nspec](../spec.txt), [a](a.md), [web](https://example.org/), [gone](b.md#part)"
    new, lost = LINKS.rewritten(text, pages / "page.md", pages)
    assert new.startswith(
        "the\nspec (`spec.txt`), [a](a.md), [web](https://example.org/)"
    )
    assert lost == ["b.md"]


def test_drawings_are_what_the_code_says() -> None:
    figures = load(DOCS / "tools" / "frames_figures.py")
    for name, draw in figures.FIGURES.items():
        assert (DOCS / "images" / name).read_text(encoding="utf-8") == draw(), (
            f"{name} is out of date: python docs/tools/frames_figures.py"
        )


def test_generated_pages_name_every_method_and_every_command() -> None:
    from typer.main import get_command

    from flexdt.clients.cli.command_tree import build
    from flexdt.protocol import METHODS

    wire = GENERATED.wire()
    for name in METHODS:
        assert f"## `{name}`" in wire
    anchors = {h.lower() for h in re.findall(r"^## (\w+)$", wire, re.MULTILINE)}
    linked = set(re.findall(r"\]\(#([\w]+)\)", wire))
    assert linked
    assert linked <= anchors
    commands = GENERATED.commands()
    for path, _ in GENERATED._walk(get_command(build()), "flexdt"):
        assert f"## `{path}`" in commands
    assert "`--criterion a\\|d\\|worst`" in commands


def test_links_to_a_file_that_declares_a_list_lead_to_its_page() -> None:
    page = DOCS / "reference" / "page.md"
    text = "[codes](../../twin/script/problems.py)"
    assert LINKS.rewritten(text, page, DOCS) == ("[codes](../_generated/findings.md)", [])
    for file, listed in LINKS.list_pages.LISTED.items():
        assert (ROOT / file).is_file()
        assert listed in GENERATED.PAGES


def test_the_limits_that_are_set_by_name_are_listed_with_their_meaning() -> None:
    page = GENERATED.PAGES["limits.md"]()
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \|$", page, re.MULTILINE)
    names = [name for made in ACCESS for name in limit_names(made)]
    assert [name for name, *_ in rows] == names
    assert all(len(meaning.split()) > 2 for *_, meaning in rows)


def test_docstrings_become_restructured_text() -> None:
    plain = load(DOCS / "_ext" / "plain_docstrings.py").plain
    assert plain("`a * b` and 2 * c | d") == "``a * b`` and 2 \\* c \\| d"
    assert plain("dO_x ends_ here") == "dO_x ends\\_ here"


def test_every_claim_on_the_peers_page_has_its_command_or_source() -> None:
    text = evidence()[DOCS / "evidence" / "peers.json"]
    _, table, commands, _, sources = text.split("\n## ")
    claims = set(re.findall(r"^\|[^|]+\|[^|]*\((\d+)\) \|", table, re.MULTILINE))
    given = set(re.findall(r"^\| (\d+) \|", commands, re.MULTILINE))
    assert claims == given
    used = set(re.findall(r"\[([A-Z])\d*(?:\.\d)?(?:, T\d)?\]", table))
    assert used <= set(re.findall(r"^\| ([A-Z])\d* \|", sources, re.MULTILINE))
    for path in re.findall(r"(?:pytest|python) ([\w/.]+)", commands):
        assert (ROOT / path).exists(), path
    columns = {
        len(re.findall(r"(?<!\\)\|", row)) for row in table.splitlines() if row[:1] == "|"
    }
    assert len(columns) == 1


@pytest.mark.parametrize("page", [*PAGES, *evidence()], ids=lambda p: p.name)
def test_headings_go_down_one_level_at_a_time(page: Path) -> None:
    """What Sphinx warns of, and a warning ends the build."""
    text = evidence()[page] if page.suffix == ".json" else page.read_text()
    plain = re.sub(r"^```.*?^```|^---$.*?^---$", "", text, flags=re.MULTILINE | re.DOTALL)
    levels = [len(marks) for marks in re.findall(r"^(#+) ", plain, re.MULTILINE)]
    assert levels[:1] == [1]
    assert all(after <= before + 1 for before, after in pairwise(levels)), levels
