"""The names that other people's programs and scripts use are those of the list in the docs."""

from __future__ import annotations

import difflib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_the_public_surface_is_the_list_in_the_docs() -> None:
    """A change of it is a change of the list, which the review sees."""
    found = subprocess.run(
        [sys.executable, ROOT / "tests" / "studies" / "public_surface.py"],
        check=True, capture_output=True, text=True,
    ).stdout  # fmt: skip
    listed = (ROOT / "docs" / "reference" / "surface.txt").read_text()
    assert (
        "\n".join(difflib.unified_diff(listed.splitlines(), found.splitlines(), n=0))
        == ""
    )
