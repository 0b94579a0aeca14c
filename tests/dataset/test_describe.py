"""`flexdt describe` and `flexdt geometry guess` on a scan of another maker."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

import flexdt as fx
from flexdt.clients.cli.command_tree import run

SAID = {
    "Projections": 4, "WhiteLevel": 1000, "DetectorPixelsX": 9, "DetectorPixelsY": 6,
    "DetectorPixelSizeX": 0.2, "DetectorPixelSizeY": 0.2, "SrcToObject": 100,
    "SrcToDetector": 400, "AngularStep": 90, "CoefX2": 0.5, "unknown_thing": 7,
}  # fmt: skip


@pytest.fixture
def scan(tmp_path: Path) -> Path:
    for i in range(4):
        tifffile.imwrite(tmp_path / f"p_{i + 1}.tif", np.full((6, 9), 500, np.uint16))
    path = tmp_path / "p.xtekct"
    path.write_text("".join(f"{key}={value}\n" for key, value in SAID.items()))
    return path


def test_every_value_is_printed_with_its_use(
    scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["describe", str(scan)]) == 0
    out, err = capsys.readouterr()
    head, columns, *rows = out.splitlines()
    assert head.endswith("4 projections of 9 x 6 pixels")
    assert columns.split() == ["field", "value", "use", "consequence"]
    assert [row.split()[0] for row in rows] == list(SAID)
    assert "unknown_thing = 7" in err
    assert run(["describe", str(scan), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [one["field"] for one in document["provenance"]] == list(SAID)
    assert {one["use"] for one in document["provenance"]} == {"used", "ignored"}
    assert document["provenance"][-1]["known"] is False
    assert len(document["warnings"]) == 2


@pytest.mark.parametrize(("gone", "count"), [(0, "4"), (1, "3 of 4"), (3, "1 of 4")])
def test_projections_that_are_not_there_are_not_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], gone: int, count: str
) -> None:
    geometry = fx.ConeVec.circular(sod=50.0, sdd=100.0, angles=4, shape=(6, 9), pixel=0.2)
    images = np.full((4, 6, 9), 500, np.uint16)
    flat = np.full((6, 9), 900, np.uint16)
    fx.DataSet.from_arrays(images, geometry, dark=flat * 0, flat=flat).save(
        tmp_path / "s"
    )
    for path in sorted((tmp_path / "s").glob("scan_*.tif"))[:gone]:
        path.unlink()
    assert run(["describe", str(tmp_path / "s")]) == 0
    assert f": {count} projections of 9 x 6 pixels" in capsys.readouterr().out


def test_sample_and_beam_are_told_where_the_files_say_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scan = fx.ConeVec.circular(sod=50.0, sdd=100.0, angles=4, shape=(6, 9), pixel=2.0)
    fx.simulate("gear", scan, tube=fx.Tube(kV=70), noise=1).save(tmp_path / "s")
    assert run(["describe", str(tmp_path / "s")]) == 0
    _, *told = capsys.readouterr().out.splitlines()
    assert told[0] == "sample: gear"
    assert told[1].startswith("beam: 70 kV")


def test_a_notebook_shows_the_table(scan: Path) -> None:
    html = fx.open(scan)._repr_html_()
    assert "<td>unknown_thing</td><td>7</td><td>ignored</td>" in html


def test_images_that_do_not_decide_are_code_5(
    scan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["geometry", "guess", str(scan)]) == 5
    assert "the images do not decide" in capsys.readouterr().err
    geometry: Any = scan.with_name("other.json")
    fx.open(scan).geometry.save(geometry)
    assert run(["geometry", "guess", str(scan), str(geometry), "--json"]) == 5
