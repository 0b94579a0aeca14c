"""Python on the pages of the use shelf runs as it stands there, on a small scan."""

from __future__ import annotations

import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
from doc_pages import DOCS

import flexdt as fx

PAGES = (
    "calibration",
    "align",
    "reconstruction",
    "corrections",
    "data-sets",
    "exchange",
)
BLOCKS = [
    pytest.param(text, id=f"{page}-{number}")
    for page in PAGES
    for number, text in enumerate(
        re.findall(r"```python\n(.*?)```", (DOCS / f"{page}.md").read_text("utf-8"), re.S)
    )
]
SCAN = {"sod": 600, "sdd": 1059, "angles": 40, "shape": (190, 239), "pixel": 0.5984}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scan that the pages open, and its geometry as a file."""
    folder = tmp_path_factory.mktemp("pages")
    believed = fx.ConeVec.circular(**SCAN)
    seen = fx.simulate("lego", fx.ConeVec.circular(**SCAN, offset=(0.8, 0.0)), noise=2)
    fx.DataSet.from_arrays(
        seen.counts(), believed, dark=seen.dark, flat=seen.flat, name="lego"
    ).save(folder / "lego-scan")
    believed.save(folder / "geometry.json")
    return folder


@pytest.mark.parametrize("block", BLOCKS)
@pytest.mark.daily(4)
def test_a_block_runs(
    block: str, folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    space: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # 40 views are few
        exec(compile(block, "<page>", "exec"), space)
    volume = space.get("volume")
    if isinstance(volume, fx.Volume):
        assert np.nanmax(volume.data) > 0.0
