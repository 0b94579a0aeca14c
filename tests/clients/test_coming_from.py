"""Our side of the page for users of other programs runs as it stands there, only smaller."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

PAGE = Path(__file__).resolve().parents[2] / "docs" / "coming-from.md"
WHOLE = "angles=360, shape=(760, 956), pixel=0.1496"
SMALL = "angles=40, shape=(38, 48), pixel=2.0"


def test_our_sides_of_all_tasks_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    trimesh.creation.torus(9.0, 4.0).export("part.stl")
    text = PAGE.read_text(encoding="utf-8")
    blocks = re.findall(r":caption: flexdt\n\n(.*?)```", text, re.DOTALL)
    assert len(blocks) == 3
    assert all(WHOLE in block for block in blocks)
    array = np.zeros((24, 24, 24), np.float32)
    array[6:18, 6:18, 6:18] = 0.05
    names: dict[str, Any] = {"array": array}
    for block in blocks:
        exec(block.replace(WHOLE, SMALL).replace("array, 0.2", "array, 1.0"), names)
    assert names["data"].counts().shape == names["projections"].shape == (40, 38, 48)
    paired = float(np.vdot(names["projections"], names["A"] @ array))
    assert paired == pytest.approx(float(np.vdot(names["spread"], array)), rel=1e-4)
    assert names["found"].data[10:14, 10:14, 10:14].mean() == pytest.approx(0.05, rel=0.05)
