"""The whole site is built once, as `make docs` does: warnings are errors, notebooks
executed."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
QUESTIONS = sorted((DOCS / "questions").glob("*.md"))
MOST_WORDS = 600
"""Of a page that answers one question."""


@pytest.mark.parametrize(
    "page", [p for p in QUESTIONS if p.stem != "index"], ids=lambda p: p.stem
)
def test_a_question_has_a_short_answer_with_code_and_a_picture(page: Path) -> None:
    text = page.read_text()
    assert len(text.split()) <= MOST_WORDS
    assert "{code-cell}" in text
    assert "imshow" in text
    assert f"({page.name})" in (page.parent / "index.md").read_text()


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_site_builds_without_a_warning(tmp_path: Path) -> None:
    words = [
        "-b",
        "html",
        "-n",
        "-W",
        "--keep-going",
        "-q",
        "-d",
        str(tmp_path / "doctrees"),
    ]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words, str(DOCS), str(tmp_path / "html")],
        capture_output=True, text=True, timeout=880, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-6000:]
    html = tmp_path / "html"
    for notebook in (*(DOCS / "tutorials").glob("*.md"), *QUESTIONS):
        page = (html / notebook.relative_to(DOCS).with_suffix(".html")).read_text()
        text = notebook.read_text()
        cells = text.count("{code-cell}") - text.count("[remove-cell]")
        assert page.count('class="cell_input docutils container"') == cells
        assert "Traceback" not in page
        if cells:
            assert "cell_output" in page
    # What was computed is in the pages: figures, and the calibration's secret found again.
    assert len(list((html / "_images").glob("*.png"))) > 8
    calibrate = (html / "tutorials" / "calibrate.html").read_text()
    found = re.search(r"dO_y\s+(-?\d\.\d+) \+- (\d\.\d+)", calibrate)
    assert found is not None
    assert abs(float(found[1]) + 1.1) < 5 * float(found[2])
    assert "state.get" in (html / "_generated" / "wire.html").read_text()
    assert (
        'id="flexdt-phantom-design"'
        in (html / "_generated" / "commands.html").read_text()
    )
    cone_vec = html / "_generated" / "python" / "flexdt.twin.geometry.cone_vec.html"
    assert "project_points" in cone_vec.read_text()
    assert (
        "flexdt.twin.geometry.cone_vec.html"
        in (html / "reference" / "python.html").read_text()
    )
    # Evidence is rendered, old addresses forward, and the figures are made anew.
    coverage = (html / "_generated" / "evidence" / "calibration.html").read_text()
    assert 'id="coverage-of-the-joint-95-region"' in coverage
    assert "itk-rtk" in (html / "_generated" / "evidence" / "bench.html").read_text()
    assert 'url=use.html"' in (html / "how-to.html").read_text()
    made = json.loads((DOCS / "_generated" / "figures" / "figures.json").read_text())
    kept = json.loads((DOCS / "images" / "made" / "figures.json").read_text())
    assert [*made] == [*kept]
    for name, numbers in kept.items():
        assert made[name] == pytest.approx(numbers, rel=0.05, abs=1e-3), name
