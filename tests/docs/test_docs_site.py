"""The checks of the site that `make docs` builds."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType

import pytest
from loaded_script import load

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"


@pytest.fixture
def checks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The checks, of a site of one notebook and one figure."""
    module = load(DOCS / "tools" / "site_checks.py")
    monkeypatch.setattr(module, "DOCS", tmp_path)
    monkeypatch.setattr(module, "NOTEBOOKS", [tmp_path / "own-scanner.md"])
    return module


CELL = '<div class="cell_input docutils container"></div> cell_output'


def site(folder: Path, checks: ModuleType) -> dict[str, str]:
    """Files of a source and its site that have no fault."""
    figures = json.dumps({"aligned": {"before": 0.5, "after": 2.0}})
    return {
        "own-scanner.md": "```{code-cell}\n",
        "_generated/figures/figures.json": figures,
        "images/made/figures.json": figures,
        "html/own-scanner.html": CELL,
        **{f"html/{page}": text for page, text in checks.SHOWN.items()},
    }


@pytest.mark.parametrize(
    ("file", "content", "fault"),
    [
        ("html/own-scanner.html", CELL * 2, "2 of 1 cells are on its page"),
        ("html/own-scanner.html", f"{CELL} Traceback", "an error is on its page"),
        ("html/own-scanner.html", CELL[:-11], "no output is on its page"),
        ("html/_generated/wire.html", "", "'state.get' is not on it"),
        ("_generated/figures/figures.json", "{}", "aligned are kept"),
        (
            "_generated/figures/figures.json",
            '{"aligned": {"before": 0.53, "after": 2.0}}',
            "figure aligned: made",
        ),
    ],
)
def test_each_fault_of_a_site_is_found_and_nothing_else(
    file: str,
    content: str | None,
    fault: str,
    checks: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["site_checks.py", str(tmp_path / "html")])
    for name, text in site(tmp_path, checks).items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert checks.main() == 0
    assert capsys.readouterr().out == ""
    if content is None:
        (tmp_path / file).unlink()
    else:
        (tmp_path / file).write_text(content)
    assert checks.main() == 1
    assert fault in capsys.readouterr().out


def test_the_notebooks_of_the_site_are_found() -> None:
    notebooks = load(DOCS / "tools" / "site_checks.py").NOTEBOOKS
    executed = [p for p in DOCS.rglob("*.md") if "{code-cell}" in p.read_text("utf-8")]
    assert sorted(notebooks) == sorted(executed)
