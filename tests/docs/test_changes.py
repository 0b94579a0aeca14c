"""Fragments of the changelog: read by their names and texts, and built by towncrier on a
copy."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CHANGES = ROOT / "changes"
NOT_FRAGMENTS = {"README.md", "template.md"}
MOST_CHARACTERS = 500
"""A fragment is one or two sentences; more belongs to the documentation, which it links."""


def types() -> set[str]:
    with (ROOT / "pyproject.toml").open("rb") as file:
        return {t["directory"] for t in tomllib.load(file)["tool"]["towncrier"]["type"]}


def problems(fragments: Iterable[tuple[str, str]], known: set[str]) -> list[str]:
    """What is wrong with the names and texts of fragments.

    Args:
        fragments: file name and text of each.
        known: types that a fragment may have.
    """
    found = []
    names: Counter[str] = Counter()
    for name, text in fragments:
        topic, _, rest = name.partition(".")
        kind, *end = rest.split(".")
        names[name.lower()] += 1
        if not topic or kind not in known:
            found.append(f"{name}: no type of {', '.join(sorted(known))}")
        elif (
            end[-1:] != ["md"]
            or not all(part.isdecimal() for part in end[:-1])
            or len(end) > 2
        ):
            found.append(f"{name}: not TOPIC.{kind}.md or TOPIC.{kind}.1.md")
        if not text.strip():
            found.append(f"{name}: no text")
        elif len(text) > MOST_CHARACTERS:
            found.append(f"{name}: {len(text)} characters, at most {MOST_CHARACTERS}")
        elif text.lstrip().startswith(("-", "*", "#")):
            found.append(f"{name}: begins with a list or a heading")
    found += [f"{name}: named twice" for name, count in names.items() if count > 1]
    return found


def test_every_fragment_has_a_known_type_and_a_text() -> None:
    fragments = [
        (path.name, path.read_text(encoding="utf-8"))
        for path in sorted(CHANGES.iterdir())
        if path.name not in NOT_FRAGMENTS
    ]
    assert types() == {"feature", "fix", "change", "removal"}
    assert problems(fragments, types()) == []


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("align.feature.md", "Text.", None),
        ("align.feature.1.md", "Text.", None),
        ("align.bug.md", "Text.", "no type"),
        ("align.md", "Text.", "no type"),
        (".fix.md", "Text.", "no type"),
        ("align.fix.txt", "Text.", "not TOPIC"),
        ("align.fix", "Text.", "not TOPIC"),
        ("align.fix.new.md", "Text.", "not TOPIC"),
        ("align.fix.md", " \n", "no text"),
        ("align.fix.md", "- Text.", "begins with a list"),
        ("align.fix.md", "Text. " * 100, "characters"),
    ],
)
def test_a_wrong_fragment_is_found(name: str, text: str, said: str | None) -> None:
    found = problems([(name, text)], types())
    assert (len(found), said is None or said in found[0]) == (
        0 if said is None else 1,
        True,
    )


def test_a_fragment_named_twice_is_found() -> None:
    """On a file system that ignores case, one of the two would vanish."""
    twice = [("align.fix.md", "One."), ("Align.fix.md", "Other.")]
    assert problems(twice, types()) == ["align.fix.md: named twice"]


@pytest.mark.slow
def test_a_release_takes_every_fragment_into_the_changelog(tmp_path: Path) -> None:
    pytest.importorskip("towncrier")
    shutil.copytree(CHANGES, tmp_path / "changes")
    for name in ("CHANGELOG.md", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    drawn = {kind: f"Sentence about {kind}." for kind in types()}
    for kind, text in drawn.items():
        (tmp_path / "changes" / f"drawn.{kind}.md").write_text(text + "\n")
    before = (tmp_path / "CHANGELOG.md").read_text()
    # Outside a git repository towncrier asks before it deletes.
    words = ["build", "--version", "9.0.0", "--date", "2030-01-02", "--yes"]
    subprocess.run(["git", "init", "-q"], cwd=tmp_path, check=True)
    subprocess.run([sys.executable, "-m", "towncrier", *words], cwd=tmp_path, check=True)
    after = (tmp_path / "CHANGELOG.md").read_text()
    assert after.index("## 9.0.0 (2030-01-02)") < after.index("## 0.3.0 (")
    assert all(after.count(f"\n- {text}\n") == 1 for text in drawn.values())
    assert after.endswith(before[before.index("## 0.3.0 (") :])
    assert {path.name for path in (tmp_path / "changes").iterdir()} == NOT_FRAGMENTS
