"""`flexdt phantom list` and `make`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh

from flexdt.clients.cli.command_tree import run
from flexdt.phantoms import phantom_names
from flexdt.phantoms.samples import as_phantom


def test_list(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["phantom", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)["phantoms"]
    assert [p["name"] for p in listed] == list(phantom_names())
    assert run(["phantom", "list"]) == 0
    assert "lego" in capsys.readouterr().out


def test_made_phantom_is_found_again_by_its_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, stl = tmp_path / "mine.json", tmp_path / "mine.stl"
    words = ["--size", "20,30,40", "--beads", "4", "--radius", "1.5", "--body", "pmma"]
    assert run(["phantom", "make", str(path), *words, "--stl", str(stl), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["beads"] == 4
    found = as_phantom(str(path))
    assert found.size_mm == (20.0, 30.0, 40.0)
    assert found.bead_radius_mm.tolist() == [1.5] * 4
    extents = trimesh.load(stl, file_type="stl").extents
    np.testing.assert_allclose(extents, (20.0, 30.0, 40.0), atol=1e-3)


def test_phantom_from_a_mesh(tmp_path: Path) -> None:
    mesh, path = tmp_path / "box.stl", tmp_path / "box.json"
    trimesh.creation.box((1.0, 2.0, 3.0)).export(mesh)
    assert run(["phantom", "make", str(path), "--mesh", str(mesh), "--unit", "cm"]) == 0
    np.testing.assert_allclose(
        as_phantom(str(path)).size_mm, (10.0, 20.0, 30.0), atol=1e-6
    )


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        ([], 2, "give one of"),
        (["--size", "1,2"], 2, "W,B,H"),
        (["--size", "1,2,x"], 2, "not a number"),
        (["--like", "nothing"], 1, "nothing"),
        (["--like", "normal", "--radius", "50"], 3, "does not fit"),
        (["--like", "normal", "--body", "cheese"], 1, "cheese"),
        (["--mesh", "missing.stl"], 1, "missing.stl"),
    ],
)
def test_bad_wishes(
    words: list[str],
    code: int,
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run(["phantom", "make", str(tmp_path / "x.json"), *words]) == code
    captured = capsys.readouterr()
    assert says in captured.err
    assert captured.out == ""
    assert not (tmp_path / "x.json").exists()


def test_make_says_what_is_assumed_and_that_beads_overlap(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "phantom",
        "make",
        str(tmp_path / "p.json"),
        "--size",
        "20,20,40",
        "--beads",
        "500",
    ]
    assert run(words) == 0
    said = capsys.readouterr()
    assert "assumed: the spiral's formula" in said.err
    assert "overlap by" in said.err
    assert "assumed:" not in said.out


@pytest.mark.parametrize("size", ["10,10,-1", "10,0,10", "-1,-1,-1"])
def test_a_cuboid_with_no_inside_says_what_is_allowed(
    size: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "p.json"
    assert run(["phantom", "make", str(file), "--size", size]) == 3
    assert "allowed: sides of more than 0 mm" in capsys.readouterr().err
    assert not file.exists()
