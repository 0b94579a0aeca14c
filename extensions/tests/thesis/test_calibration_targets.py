"""The table of targets, and what the studies refuse, print and report."""

from __future__ import annotations

import html
import json
import math
import sys
from pathlib import Path

import calibration_speed
import pytest
import robustness
from calibration_targets import TARGETS, collected, main, targets_table
from spoilt_scans import Outcome

from flexdt.clients.cli.command_tree import run
from flexdt.twin.errors import TwinError, UnknownNameError
from flexdt_extensions.studies.experiment_4 import scan_names
from flexdt_extensions.studies.study import (
    FIDELITIES,
    METHODS,
    Cell,
    basin_runs,
    run_study,
)
from flexdt_extensions.studies.study_report import open_directions, real_lines


def test_every_target_is_met_missed_or_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_study("beads", "points", counts=(12,), jobs=1, out=tmp_path / "a")
    run_study("detector", "noisy", counts=(36,), jobs=1, out=tmp_path / "b")
    (tmp_path / "c.json").write_text(
        json.dumps({"camera": "demo", "share_pct": 80.0, "offered": 9})
    )
    (tmp_path / "other.json").write_text("[1]")
    rows = {
        text: (ours, thesis, met)
        for text, ours, thesis, met in targets_table(collected([tmp_path]))
    }
    assert len(rows) == len(TARGETS)
    ours, thesis, met = next(v for k, v in rows.items() if "K = 2 to 7" in k)
    assert (met, ours[:5]) == ("yes", "30/30")
    assert "MAE 0.01 to 0.33" in thesis
    assert (
        next(v for k, v in rows.items() if "K = 1:" in k)[0]
        == "5/5 reported unidentifiable"
    )
    assert next(v for k, v in rows.items() if "camera demo" in k)[2] == "NO"
    missing = [v for v in rows.values() if v[2] == "missing"]
    assert all(v[0].startswith(("flexdt study", "python tests/studies")) for v in missing)
    assert main([str(tmp_path)]) == 1
    assert "| NO |" in capsys.readouterr().out
    assert main([str(tmp_path / "nowhere")]) == 1
    assert "no such folder" in capsys.readouterr().err


def test_a_missed_target_is_a_miss(tmp_path: Path) -> None:
    run_study("phantoms", "noisy", counts=(12,), jobs=1, out=tmp_path)
    file = tmp_path / "summary.json"
    document = json.loads(file.read_text())
    file.write_text(json.dumps(document | {"fidelity": "points"}))
    row = next(
        r for r in targets_table(collected([tmp_path])) if "seven phantoms" in r[0]
    )
    assert row[3] == "NO"


def test_what_an_experiment_would_ignore_is_refused() -> None:
    for experiment, fidelity in (
        ("real", "clean"),
        ("basin", "clean"),
        ("basin", "images"),
    ):
        with pytest.raises(
            UnknownNameError, match=f"{experiment}.* has no fidelity '{fidelity}'"
        ):
            run_study(experiment, fidelity)
    with pytest.raises(UnknownNameError, match="no experiment 'bees'; allowed: beads"):
        run_study("bees")
    with pytest.raises(TwinError, match="counts are not for it"):
        run_study("basin", counts=(3,))
    assert (FIDELITIES["real"][0], FIDELITIES["basin"][0]) == ("points", "noisy")


@pytest.mark.slow
def test_the_report_of_the_real_fits_says_what_was_found(tmp_path: Path) -> None:
    document = run_study("real", "points", counts=(10, 36), jobs=1, out=tmp_path)
    assert len(document["runs"]) == 2 * len(scan_names())  # type: ignore[arg-type]
    first, *rest = real_lines(document)
    assert "11 agree" in first or "of 11 agree" in first
    assert [line.split(":")[0] for line in rest] == list(scan_names())
    page = (tmp_path / "report.html").read_text()
    assert html.escape(first) in page
    assert "21.08" in page  # the thesis's alpha of Scan 2 at N = 10
    assert document["truths"][1]["scans"][0] == "Scan7"


def test_weak_rows_show_their_sigma() -> None:
    rows = run_study("detector", "noisy", counts=(36,), jobs=1)["rows"]
    one, two, _ = open_directions(rows)  # type: ignore[misc, arg-type]
    assert one[0] == "1 of 1"
    assert one[1].startswith("dD_x ")
    assert two[0] == "0 of 1"


def test_basin_without_noise_is_without_noise() -> None:
    from flexdt.phantoms import load_phantom
    from flexdt.twin.calibration.bead_model import bead_model

    runs = basin_runs(
        Cell(5.0, 30.0, 1, "normal-5", 3, 0.0), bead_model(load_phantom("normal-5"))
    )
    assert [r.setting for r in runs] == list(METHODS)
    assert all(r.mae < 1e-6 for r in runs)


def test_long_studies_say_what_they_cannot_do(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["--sets", "0"], ["--coverage", "-3"], ["--jobs", "many"]):
        with pytest.raises(SystemExit) as caught:
            robustness.main(words)
        assert caught.value.code == 2
        assert "a whole number from 1 up" in capsys.readouterr().err
    assert calibration_speed.main([str(tmp_path)]) == 1
    assert "no projections" in capsys.readouterr().err


def test_kinds_are_a_table() -> None:
    outcomes = [
        Outcome("control", 0, False, False, 2.04, 0.1, ()),
        Outcome("no_beads", 1, True, False, math.nan, math.nan, ("no_beads",)),
    ]
    lines = robustness.kinds_table(robustness.summary(outcomes, ["lego", "lego"]))
    assert lines[2:] == [
        "| control | 1 | 0 | 1 | 0 | 2.0 |  |",
        "| no_beads | 1 | 1 | 0 | 0 |  | no_beads 1 |",
    ]


def test_figures_without_matplotlib_are_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)  # Python says that there is none
    assert run(["study", "beads", "--out", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err.count("pip install 'flexdt[plots]'") == 1
    assert not (tmp_path / "none").exists()
