"""The story's notebooks as they are kept: outputs that show something, one import of flexdt, and a
judge that finds what no reader should see."""

from __future__ import annotations

import base64
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from doc_pages import DOCS
from loaded_script import load
from PIL import Image

PROGRAM = load(DOCS.parent / "tests" / "studies" / "story_from_wheel.py")
BOOKS = sorted((DOCS / "story").glob("*.ipynb"))
IMPORTS = {"warnings", "flexdt", "numpy", "matplotlib.pyplot"}


def read(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(path.read_text("utf-8"))
    return found


def test_the_story_has_five_steps_and_a_page_that_names_them() -> None:
    page = (DOCS / "story.md").read_text("utf-8")
    assert len(BOOKS) == 5
    assert all(f"(story/{book.name})" in page for book in BOOKS)


@pytest.mark.parametrize("book", BOOKS, ids=lambda book: book.stem)
def test_a_notebook_is_kept_with_outputs_and_imports_nothing_inside(book: Path) -> None:
    notebook = read(book)
    assert [*PROGRAM.faults_of(notebook)] == []
    code = "\n".join(
        "".join(c["source"]) for c in notebook["cells"] if c["cell_type"] == "code"
    )
    lines = re.findall(r"^(?:import|from) +([\w.]+)", code, re.MULTILINE)
    assert set(lines) <= IMPORTS
    assert all(c.get("execution_count") for c in notebook["cells"] if "outputs" in c)
    assert book.stat().st_size < 1_500_000


def picture(pixels: np.ndarray) -> dict[str, Any]:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    coded = base64.b64encode(out.getvalue()).decode("ascii")
    return {"output_type": "display_data", "data": {"image/png": coded}}


WHITE = np.full((50, 60), 255, np.uint8)
INK = np.where(np.mgrid[:50, :60][0] == 20, 0, WHITE).astype(np.uint8)
GOOD = np.where(np.abs(np.mgrid[:50, :60] - 25).max(axis=0) < 9, 0, WHITE).astype(
    np.uint8
)


@pytest.mark.parametrize(
    ("outputs", "fault"),
    [
        ([], "nothing is shown"),
        ([{"output_type": "stream", "text": "nan to nan / mm"}], "'nan'"),
        ([{"output_type": "error", "ename": "E", "evalue": "no"}], "E: no"),
        ([picture(WHITE)], "a picture is empty"),
        ([picture(INK)], "a picture is cut"),
        ([{"output_type": "stream", "text": "<a object at 0x7f>"}], "object at 0x"),
        ([picture(GOOD)], ""),
    ],
)
def test_what_no_reader_should_see_is_found(
    outputs: list[dict[str, Any]], fault: str
) -> None:
    faults = [*PROGRAM.faults_of({"cells": [{"outputs": outputs}]})]
    assert (fault in " ".join(faults)) if fault else (faults == [])
