"""The story's notebooks as they are kept: outputs that show something, one import of flexdt, and a
judge that finds what no reader should see."""

from __future__ import annotations

import base64
import io
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from doc_pages import DOCS
from loaded_script import load
from PIL import Image

import flexdt as fx

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


def commands() -> list[list[str]]:
    """The words of each command of the page's block, without `flexdt`."""
    (block,) = re.findall(
        r"```sh\n(.*?)```", (DOCS / "story.md").read_text("utf-8"), re.DOTALL
    )
    words = [shlex.split(line, comments=True) for line in block.splitlines()]
    assert all(line[0] == "flexdt" for line in words)
    return [line[1:] for line in words]


@pytest.mark.slow
@pytest.mark.campaign(0)
@pytest.mark.timeout(1800)
def test_the_commands_run_as_they_stand(tmp_path: Path) -> None:
    """Only the ports are others, so that a twin of the machine is left alone."""
    up, *others = commands()
    flexdt = [sys.executable, "-m", "flexdt.clients.cli"]
    ports = ["--port", "0", "--projector-port", "0", "--viewer-port", "0"]
    with (
        open(tmp_path / "log", "wb") as log,
        subprocess.Popen(
            [*flexdt, *up, *ports], cwd=tmp_path, stdout=subprocess.PIPE, stderr=log
        ) as twin,
    ):
        try:
            assert twin.stdout is not None
            ready = json.loads(twin.stdout.readline())
            server = {"FLEXDT_SERVER": f"{ready['host']}:{ready['port']}"}
            for words in others:
                done = subprocess.run(
                    [*flexdt, *words], cwd=tmp_path, env=os.environ | server,
                    capture_output=True, text=True, timeout=900, check=False,
                )  # fmt: skip
                assert done.returncode == 0, (words, done.stderr)
        finally:
            twin.send_signal(signal.SIGINT)
    assert "accuracy: within" in done.stdout.splitlines()[-1]
    volume = fx.Volume.load(tmp_path / "gear.nrrd")
    assert np.nanmax(volume.data) > 0.0
