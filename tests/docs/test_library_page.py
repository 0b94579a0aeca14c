"""The library's page: every block runs, is short, and writes what it says."""

from __future__ import annotations

import re
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest
import trimesh

import flexdt as fx

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "library.md").read_text(encoding="utf-8")
BLOCKS = dict(
    re.findall(r"^## ([^\n]+)\n(?:(?!^## ).)*?```python\n(.*?)```", PAGE, re.M | re.S)
)
TASKS = [name for name in BLOCKS if name != "Geometry as a value"]
MADE = {
    "STL file to counts": ["part-scan/geometry.json", "part-scan/scan_000035.tif"],
    "Array and ASTRA vectors to FDK, SIRT and TV": [
        "fdk.nrrd",
        "sirt.nrrd",
        "tv.nrrd",
    ],
    "Folder to calibrated slices": [],
    "A scan script with its timeline": ["timeline.png"],
    "A hundred misalignments for training": ["training.npz"],
    "Geometry as a value": ["moved.json"],
}


SCAN = {"sod": 600, "sdd": 1059, "angles": 40, "shape": (190, 239), "pixel": 0.5984}
NOMINAL = fx.ConeVec.circular(**SCAN)
TRUE = fx.ConeVec.circular(**SCAN, offset=(0.8, 0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What the tasks begin with."""
    folder = tmp_path_factory.mktemp("tasks")
    trimesh.creation.box((12.0, 8.0, 10.0)).export(folder / "part.stl")
    scan = fx.ConeVec.circular(sod=400, sdd=800, angles=24, shape=(24, 28), pixel=4.8)
    np.save(folder / "vectors.npy", scan.rows)
    np.save(folder / "line_integrals.npy", fx.project("shepp-logan", scan))
    seen = fx.simulate("lego", TRUE, noise=2)
    fx.DataSet.from_arrays(
        seen.counts(), NOMINAL, dark=seen.dark, flat=seen.flat, name="lego"
    ).save(folder / "lego-scan")
    shutil.copy(ROOT / "examples" / "scripts" / "lego-fly-360.txt", folder / "scan.txt")
    return folder


@pytest.fixture
def there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    pytest.importorskip("matplotlib", reason="the extra `plots`").use("Agg")
    monkeypatch.chdir(folder)
    return folder


def test_the_page_has_five_tasks_of_ten_lines_and_two_imports() -> None:
    assert list(BLOCKS) == list(MADE)
    assert len(TASKS) == 5
    for name in TASKS:
        lines = [line for line in BLOCKS[name].splitlines() if line.strip()]
        assert len(lines) <= 10, name
        assert sum(line.startswith(("import ", "from ")) for line in lines) <= 2, name


@pytest.mark.parametrize("name", BLOCKS)
@pytest.mark.daily(2)
def test_the_block_runs(name: str, there: Path) -> None:
    space: dict[str, object] = {}
    exec(compile(BLOCKS[name], name, "exec"), space)
    for file in MADE[name]:
        assert (there / file).stat().st_size > 0
    if name == "Folder to calibrated slices":
        beads = fx.phantoms.lego().beads
        found = space["data"].with_correction(space["found"].correction).geometry  # type: ignore[attr-defined]
        miss = [
            np.abs(g.project_points(beads) - TRUE.project_points(beads))
            for g in (found, NOMINAL)
        ]
        assert miss[0].max() < 0.05
        assert miss[1].max() > 1.0


@pytest.mark.slow
@pytest.mark.campaign(1)
def test_the_readmes_lines_run(there: Path, capsys: pytest.CaptureFixture[str]) -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = [
        b for b in re.findall(r"```python\n(.*?)```", readme, re.S) if "flexdt as fx" in b
    ]
    assert len([line for line in block.splitlines() if line.strip()]) <= 10
    with warnings.catch_warnings():
        warnings.simplefilter(
            "error"
        )  # of biased values, too: it is a newcomer's first volume
        exec(compile(block.replace("lego-scan", "readme-scan"), "README.md", "exec"), {})
    assert (there / "lego.nrrd").stat().st_size > 0
    assert "6 parameters from 240 frames" in capsys.readouterr().out


def test_every_name_of_the_face_is_on_the_page() -> None:
    named = set(re.findall(r"`(\w+)`", PAGE.split("\n## ")[0]))
    assert {n for n in fx.__all__ if n != "__version__"} <= named
