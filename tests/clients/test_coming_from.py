"""The pages for users of other programs: our side runs as it stands there, only smaller, and so
does the side of each peer that is installed.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def example() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "coming_from", ROOT / "examples" / "coming_from.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["coming_from"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", ["astra", "gvxr", "tigre", "cil"])
def test_our_side_of_a_page_runs(
    page: str, example: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = example.given()
    found = example.run(example.blocks(page)["flexdt"], names)
    assert found["error"] is None
    made = names["data"].line_integrals() if page == "gvxr" else names["projections"]
    assert made.shape == (40, 38, 48)
    if page == "astra":
        paired = float(np.vdot(names["projections"], names["A"] @ names["array"]))
        assert paired == pytest.approx(
            float(np.vdot(names["spread"], names["array"])), rel=1e-4
        )
    if page != "gvxr":
        assert names["found"].data[11:14, 7:12, 8:14].mean() == pytest.approx(
            0.05, rel=0.05
        )


@pytest.mark.filterwarnings("default")  # theirs
def test_the_side_of_each_peer_that_is_installed_runs(example: ModuleType) -> None:
    """Statements that need a CUDA device are left out where there is none."""
    pages = sorted(path.stem for path in example.PAGES.glob("*.md"))
    peers = {caption.split(",")[0] for page in pages for caption in example.blocks(page)}
    assert peers == {
        "flexdt",
        "ASTRA",
        "tomosipo",
        "gVXR",
        "TIGRE",
        "CIL",
        "CIL with flexdt",
    }
    installed = {peer for peer in peers - {"flexdt"} if example.named(peer) is not None}
    if not installed:
        pytest.skip(f"none of {', '.join(sorted(peers - {'flexdt'}))} is installed")
    for page in pages:
        for caption, found in example.page(page).items():
            assert not found.get("geometry_mm", 0.0) > 1e-3, caption
            assert not found.get("mean_difference_part", 0.0) > 0.02, caption
            if caption.split(",")[0] in installed & {
                "gVXR",
                "CIL with flexdt",
            }:
                assert found["error"] is None, caption


def test_a_statement_that_fails_does_not_keep_the_others_from_running(
    example: ModuleType,
) -> None:
    names: dict[str, object] = {}
    found = example.run("a = 1\nimport no_such_peer\nb = a + 1\n", names)
    assert (found["ran"], names["b"]) == (2, 2)
    assert "no_such_peer" in str(found["error"])
    if not example.has_card():
        assert "CUDA" in str(example.run("x = ts.operator(a, b)\n", names)["error"])
