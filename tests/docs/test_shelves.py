"""The shelves of the documentation: what stands where, its length, what its pictures show."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from doc_pages import DOCS, evidence, pages
from loaded_script import load

ROOT = DOCS.parent
MADE = DOCS / "images" / "made"
MAX_WORDS = 27_000
"""Of all pages; figures of the evidence shelf are data, and counted apart."""
MAX_PAGES = 60
"""Notebooks of the story included; pages made from code or data left out."""
MAX_PAGES_TO_BEGIN_WITH = 25
"""Of the first shelf."""
MAX_WORDS_A_TASK = 900
MAX_PICTURE_BYTES = 90_000
COUNTS = load(DOCS / "tools" / "page_words.py")
SHELVES = COUNTS.shelves()
FREE = {"reference"}
"""Folders whose pages stand on the reference shelf."""
INDEXES = {"use.md", "index.md"}
"""Pages that lead to others."""
QUOTED = {
    "calibration.md": [
        ("calibrated", "miss_before_px", "up to {:.1f} pixels"),
        ("tile-gap", "correlation_before", "geometry: {:.3f} without"),
        ("tile-gap", "correlation_after", "and {:.3f} with the gap"),
        ("motion", "correlation_before", "above: {:.3f} if the motion"),
        ("motion", "correlation_after", "and {:.3f} if it is followed"),
    ],
    "align.md": [
        ("aligned", "correlation_before", "{:.3f} before"),
        ("aligned", "correlation_after", "{:.4f} after"),
    ],
    "large-volumes.md": [
        ("sizes", "fdk_512_s", "| {:.0f} s | 38 s |"),
        ("sizes", "iteration_512_s", "| {:.0f} s |"),
        ("sizes", "tv_1024_GiB", "| {:.0f} GiB |"),
        ("sizes", "sirt_2048_GiB", "| {:.0f} GiB |"),
    ],
}
"""Page -> figure, number and how the page says it."""


def slug(heading: str) -> str:
    """Return the anchor that a forge and MyST make of a heading."""
    words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).replace("`", "").lower()
    return re.sub(r"[^\w\- ]", "", words).strip().replace(" ", "-")


def anchors(text: str) -> set[str]:
    plain = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return {slug(h) for h in re.findall(r"^#{1,4} +(.+)$", plain, re.MULTILINE)}


def test_every_page_stands_on_a_shelf() -> None:
    loose = {
        path.relative_to(DOCS).as_posix()
        for path in SHELVES["other"]
        if path.relative_to(DOCS).parts[0] not in FREE
    }
    assert loose == {"command-line.md", "index.md"}


def test_the_documentation_has_few_pages() -> None:
    shelf = SHELVES["use"]
    assert len(shelf) <= MAX_PAGES_TO_BEGIN_WITH
    notebooks = len([*DOCS.glob("story/*.ipynb")])
    assert sum(map(len, SHELVES.values())) + notebooks <= MAX_PAGES


def test_the_documentation_is_short() -> None:
    assert (
        sum(COUNTS.words(path) for paths in SHELVES.values() for path in paths)
        <= MAX_WORDS
    )


@pytest.mark.parametrize(
    "page", [page for shelf in SHELVES.values() for page in shelf], ids=lambda p: p.stem
)
def test_each_page_says_who_may_skip_it(page: Path) -> None:
    first, *_ = re.split(r"^## |^### ", page.read_text("utf-8"), flags=re.MULTILINE)
    assert re.search(r"\bskip\b", first, re.IGNORECASE)


TASKS = [p for p in SHELVES["use"] if p.parent == DOCS and p.name not in INDEXES]


@pytest.mark.parametrize("page", TASKS, ids=lambda p: p.stem)
def test_a_task_has_a_short_page_with_a_picture(page: Path) -> None:
    assert COUNTS.words(page) <= MAX_WORDS_A_TASK
    assert COUNTS.pictures(page) > 0


def test_words_and_pictures_are_counted() -> None:
    done = subprocess.run(
        [sys.executable, str(DOCS / "tools" / "page_words.py"), "--pages"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    total = re.search(r"^all +(\d+) words$", done.stdout, re.MULTILINE)
    assert total is not None
    plain = [p for p in pages() if p.suffix == ".md"]
    assert int(total[1]) == sum(len(page.read_text("utf-8").split()) for page in plain)


def test_anchors_are_headings() -> None:
    texts = {path.resolve(): text for path, text in pages().items()}
    texts[(ROOT / "README.md").resolve()] = (ROOT / "README.md").read_text("utf-8")
    headings = {path: anchors(text) for path, text in texts.items()}
    lost = []
    for path, text in texts.items():
        for target, anchor in re.findall(r"\]\(([^)\s#]*)#([^)\s]+)\)", text):
            if target.startswith(("http:", "https:")):
                continue
            page = (path.parent / target).resolve() if target else path
            if page in headings and anchor not in headings[page]:
                lost.append((path.name, target, anchor))
    assert lost == []


def test_evidence_has_a_command_for_each_figure() -> None:
    index = (DOCS / "evidence" / "index.md").read_text("utf-8")
    for path in evidence():
        document = json.loads(path.read_text("utf-8"))
        assert f"({path.name})" in index
        titles = [section["title"] for section in document["sections"]]
        assert len({slug(title) for title in titles}) == len(titles), path.name
        for section in document["sections"]:
            where = f"{path.name}: {section['title']}"
            rows = section.get("rows", [])
            assert all(len(row) == len(section["columns"]) for row in rows), where
            if section["commands"]:
                assert all(command.strip() for command in section["commands"]), where
            elif "sources" in section:
                assert path.name == "peers.json", where
            else:
                assert section["columns"][-1] == "command", where
                assert all(row[-1].strip() for row in rows), where


def test_evidence_links_lead_somewhere() -> None:
    links = load(DOCS / "_ext" / "links_outside.py")
    for path, text in evidence().items():
        assert links.rewritten(text, path, DOCS)[1] == [], path.name


def test_made_figures_are_kept_and_named_with_their_command() -> None:
    script = (DOCS / "tools" / "scan_figures.py").read_text("utf-8")
    numbers = json.loads((MADE / "figures.json").read_text("utf-8"))
    kept = {path.stem for path in MADE.glob("*.png")}
    assert kept == set(numbers)
    assert all(f'"{name}":' in script for name in kept)
    assert all(path.stat().st_size < MAX_PICTURE_BYTES for path in MADE.glob("*.png"))
    shown = {
        name
        for text in pages().values()
        for name in re.findall(r"images/made/([\w-]+)\.png", text)
    }
    assert shown == kept
    index = (DOCS / "evidence" / "index.md").read_text("utf-8")
    assert "`python docs/tools/scan_figures.py --only NAME`" in index


@pytest.mark.parametrize("page", QUOTED)
def test_captions_quote_the_numbers_of_the_figures(page: str) -> None:
    numbers = json.loads((MADE / "figures.json").read_text("utf-8"))
    text = " ".join((DOCS / page).read_text("utf-8").split())
    for figure, name, words in QUOTED[page]:
        assert words.format(numbers[figure][name]) in text, (figure, name)
