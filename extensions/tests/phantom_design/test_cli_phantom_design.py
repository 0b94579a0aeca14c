"""`flexdt phantom design`: documents, files, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from flexdt.clients.cli.command_tree import run
from flexdt.phantoms.samples import as_phantom

QUICK = ["--frames", "24", "--trials", "4"]


def test_lego_design_is_written_whole(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "mine"
    words = ["phantom", "design", "--bricks", "3", "--beads", "4", *QUICK]
    assert run([*words, "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    ours = document["design"]
    assert document["gain"] > 1.0
    assert ours["identified"] == 1.0
    assert (
        set(ours["sigmas"]) == set(document["spiral"]["sigmas"]) == set(document["free"])
    )
    felt = {"axis_column", "axis_angle", "magnification"}
    assert set(ours["image_sigmas"]) == felt
    assert set(ours["measured"]) == set(document["free"]) | felt
    assert set(ours["stated"]) == set(document["free"]) | felt
    for name, (low, high) in ours["stated_ranges"].items():
        assert low <= ours["stated"][name] <= high, name
    # What looks like a drift is stated, too.
    low, high = ours["stated_ranges"]["dO_z"]
    assert high > 1.05 * low
    # Nobody said that the phantom is exact, so that its millimetre is known to 0.1 %.
    assert ours["stated"]["magnification"] > 10 * ours["image_sigmas"]["magnification"]
    assert document["priors"]["dD_x"] > 0
    found = as_phantom(str(out / "phantom.json"))
    np.testing.assert_allclose(found.beads, ours["beads"])
    np.testing.assert_allclose(
        trimesh.load(out / "phantom.stl", file_type="stl").extents,
        (24, 16, 30.6),
        atol=1e-2,
    )
    assert sorted(document["files"]) == sorted(p.name for p in out.iterdir())
    page = (out / "build.html").read_text()
    assert page.count("<svg") == 3
    assert all(f"bead {k}:" in page for k in range(1, 5))
    picture = cv2.imread(str(out / "brick-1.png"))
    red = (picture[..., 2] > 180) & (picture[..., 1] < 110)
    assert red.any()


def test_free_design_in_a_block(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["phantom", "design", "--grid", "free", "--size", "16,20,24", "--beads", "3"]
    places = ["--position", "600", "--position", "450:15"]
    out = tmp_path / "block"
    assert run([*words, *places, *QUICK, "--out", str(out), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["frames"] == 48
    beads = np.array(document["design"]["beads"])
    assert (np.abs(beads) <= np.array([8.0, 10.0, 12.0]) - 2.0 + 1e-9).all()
    mesh = trimesh.load(out / "phantom.stl", file_type="stl")
    # The block less three balls of radius 1: beads are cavities in it.
    assert mesh.volume == pytest.approx(16 * 20 * 24 - 3 * 4.19, rel=1e-3)


def test_design_for_a_script(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "scan.txt"
    assert (
        run(["script", "new", "--kind", "step", "--frames", "12", "--out", str(script)])
        == 0
    )
    capsys.readouterr()
    words = ["phantom", "design", "--plan", str(script), "--trials", "0", "--beads", "3"]
    assert run([*words, "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["frames"] == 12
    assert document["design"]["measured"] is None


@pytest.mark.parametrize(
    ("words", "code", "says"),
    [
        (["--studs", "3by2"], 2, "NxM"),
        (["--bricks", "0"], 3, "bricks"),
        (["--beads", "1"], 1, "1 beads"),
        (["--free", "dO_x,sigma"], 1, "sigma"),
        (["--noise", "0"], 2, "positive"),
        (["--position", "near"], 2, "not a number"),
        (["--position", "2000"], 1, "0 < SOD < SDD"),
        (["--position", "600", "--sdd", "nan"], 1, "0 < SOD < SDD"),
        (["--plan", "missing.txt"], 1, "missing.txt"),
    ],
)
def test_bad_wishes(
    words: list[str], code: int, says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["phantom", "design", *QUICK, *words]) == code
    assert says in capsys.readouterr().err


def test_a_spiral_that_does_not_determine_anything_is_not_a_factor() -> None:
    from flexdt_extensions.phantom_design.phantom_design import table_rows, verdict

    entry = {
        "sigmas": {"dO_x": 0.1},
        "image_sigmas": {"axis_column": 0.01},
        "measured": None,
        "stated": None,
    }
    document: dict[str, object] = {
        "design": entry,
        "spiral": {**entry, "sigmas": {"dO_x": 5e5}, "name": "spiral-50"},
        "gain": None,
        "criterion_text": "A",
    }
    assert verdict(document).startswith("spiral-50 does not determine the geometry")
    assert [row[0] for row in table_rows(document)] == ["axis_column (optimized)", "dO_x"]
    assert table_rows(document)[0][-1] == "-"
    open_ = {"dO_x": 0.2, "axis_column": 0.02}
    ranges = {"dO_x": [0.1, 0.35], "axis_column": [0.02, 0.02]}
    said = {**entry, "stated": open_, "stated_ranges": ranges}
    rows = table_rows(document | {"design": said})
    assert [row[4] for row in rows] == ["0.02", "0.2 (0.1 to 0.35)"]
    assert "2.00 times better than spiral-50" in verdict(document | {"gain": 2.0})
