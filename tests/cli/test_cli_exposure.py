"""`check`, `run` and `snap` say which part of the pixels is saturated or starved."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import tifffile

from flexdt.clients.cli.command_tree import run
from flexdt.clients.launch.processes import Servers

Capture = pytest.CaptureFixture[str]
TOP = 16383  # of the panel, 14 bits


def written(folder: Path, exposure: float, kV: float = 90.0, frames: int = 3) -> Path:
    script = folder / f"{exposure:g}-{kV:g}.txt"
    words = ["--kind", "step", "--frames", frames, "--exposure", exposure, "--kv", kV]
    assert run(["script", "new", *map(str, words), "--out", str(script)]) == 0
    return script


@pytest.mark.parametrize(
    ("exposure", "kV", "expected"),
    [(100.0, 90.0, []), (2000.0, 90.0, ["saturated"]), (20.0, 25.0, ["starved"])],
)
@pytest.mark.daily(2)
def test_check_foresees_saturated_and_starved_pixels(
    exposure: float, kV: float, expected: list[str], tmp_path: Path, capsys: Capture
) -> None:
    script = written(tmp_path, exposure, kV)
    capsys.readouterr()
    assert run(["check", str(script), "--sample", "normal-5", "--json"]) == 0
    problems = json.loads(capsys.readouterr().out)["problems"]
    codes = [p["code"] for p in problems if p["code"].endswith("_pixels")]
    assert codes == [f"{name}_pixels" for name in expected]
    for problem in problems:
        if problem["code"] in codes:
            assert problem["severity"] == "warning"
            assert problem["line"] > 0
    # Without a sample there is nothing to foresee.
    assert run(["check", str(script), "--json"]) == 0
    assert "_pixels" not in capsys.readouterr().out


def share(text: str, state: str) -> float:
    """Read the one share of pixels of which `text` says that they "are" or "will be" so."""
    [found] = re.findall(rf"([\d.e+-]+) % of the (?:projections' )?pixels {state}", text)
    return float(found) / 100.0


@pytest.mark.slow
def test_run_and_snap_say_what_their_images_are(tmp_path: Path, capsys: Capture) -> None:
    """Against the counts that they saved."""
    options = {"data": tmp_path / "data", "speed-up": "max", "physics": "poly"}
    with Servers(options, tmp_path / "log") as servers:
        server = ["--server", "{}:{}".format(*servers.address)]
        long = written(tmp_path, 700.0)
        capsys.readouterr()
        assert (
            run(["run", str(long), "--out", "long", "--sample", "normal-5", *server]) == 0
        )
        told = share(capsys.readouterr().err, "are saturated")
        saved = sorted((tmp_path / "data" / "long").glob("*.tif*"))
        counts = [tifffile.imread(file) for file in saved]
        assert any(
            abs((image == TOP).mean() - told) < 0.02 + 0.1 * told for image in counts
        )
        assert run(["check", str(long), "--sample", "normal-5"]) == 0
        assert share(capsys.readouterr().err, "will be saturated") == pytest.approx(
            told, abs=0.02
        )
        snapped = tmp_path / "now.tif"
        assert run(["tube", "--on", *server]) == 0
        assert run(["snap", str(snapped), *server]) == 0
        assert share(capsys.readouterr().err, "are saturated") == pytest.approx(
            (tifffile.imread(snapped) == TOP).mean(), abs=0.02
        )
        dim = written(tmp_path, 20.0, 25.0)
        capsys.readouterr()
        assert run(["run", str(dim), "--out", "dim", *server]) == 0
        predicted = re.findall(
            r"about ([\d.e+-]+) % .* will be starved", capsys.readouterr().err
        )
        [kept] = json.loads((tmp_path / "data/dim/flexdt.json").read_text())["predicted"]
        folder = tmp_path / "data/dim"
        dark = tifffile.imread(folder / "di000000.tif")
        images = (tifffile.imread(path) for path in folder.glob("scan_*.tif"))
        signal = [image.astype(float) - dark for image in images]
        starved = max(float((image < 10).mean()) for image in signal)
        assert kept["starved"] == pytest.approx(starved, abs=0.03)
        assert [float(one) / 100 for one in predicted] == [
            pytest.approx(kept["starved"], rel=0.01)
        ]
        short = written(tmp_path, 60.0)
        capsys.readouterr()
        assert run(["run", str(short), "--out", "short", *server]) == 0
        assert "saturated" not in capsys.readouterr().err
