"""The studies in short: plans, points, one small case in images, basin, experiment 4."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexdt.clients.cli.command_tree import run as command
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.bead_model import bead_model
from flexdt.twin.errors import LimitError, UnknownNameError
from flexdt_extensions.studies import runs as solved_runs
from flexdt_extensions.studies import study
from flexdt_extensions.studies.experiment_4 import hidden_phantom, off_truth
from flexdt_extensions.studies.experiments import (
    EXPERIMENTS,
    WorkUnit,
    placement_scenario,
    tasks,
)
from flexdt_extensions.studies.study import (
    METHODS,
    Cell,
    basin_task,
    real_images_runs,
    run_study,
    run_task,
)


def test_the_experiments_have_the_theses_numbers_of_runs() -> None:
    runs = {e: sum(len(t.counts) for t in tasks(e, "points")) for e in EXPERIMENTS}
    assert runs["beads"] == 490
    assert runs["phantoms"] == 490
    assert runs["damping"] == 280
    assert {t.setting for t in tasks("detector", "points")} == {"1", "2", "8"}
    poses, truth = placement_scenario("8", 3)
    assert len(poses) == 8
    assert len({float(p.sod[0]) for p in poses}) == 2
    assert truth.to_edge()["dD_y"] == -7.0
    with pytest.raises(UnknownNameError, match="no fidelity"):
        tasks("beads", "guesses")


def test_exact_points_solve_everything_but_one_bead(tmp_path: Path) -> None:
    document = run_study("beads", "points", counts=(3, 36), jobs=1, out=tmp_path)
    rows = {r["setting"]: r for r in document["rows"]}  # type: ignore[attr-defined]
    assert rows["1"]["unidentifiable"] == rows["1"]["runs"] == 10
    assert rows["1"]["mae"] is None
    for k in "234567":
        assert rows[k]["success"] == rows[k]["runs"] == 10
        assert rows[k]["mae_max"] < 1e-9
        assert rows[k]["iterations_max"] <= 8
        assert rows[k]["thesis_mae"] > 0
    stored = json.loads((tmp_path / "summary.json").read_text())
    assert stored["rows"] == json.loads(json.dumps(document["rows"]))
    assert {"report.html", "mae.svg", "parameters.svg"} <= {
        p.name for p in tmp_path.iterdir()
    }
    run = stored["runs"][-1]
    assert set(run["errors"]) == {"dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z"}
    assert run["projections"] == 36


def test_detector_lateral_is_weak_with_one_placement_only() -> None:
    document = run_study("detector", "noisy", counts=(12, 36), jobs=1)
    rows = {r["setting"]: r for r in document["rows"]}  # type: ignore[attr-defined]
    assert rows["1"]["weak"] == 2
    assert rows["1"]["mean_sigma"]["dD_x"] > 0.5
    assert rows["2"]["weak"] == rows["8"]["weak"] == 0
    assert rows["2"]["mae"] < 0.02
    assert rows["8"]["mae"] < 0.01


def test_damping_rows_are_algorithm_2() -> None:
    document = run_study("damping", "points", counts=(6,), jobs=1)
    for row in document["rows"]:  # type: ignore[attr-defined]
        assert row["method"] == "Algorithm 2"
        assert row["success"] == 5
        assert row["beside"]["method"] == "ours"


def test_rendered_noisy_images_with_unknown_identities() -> None:
    """One scenario in images: Beer-Lambert, blur, 5000 counts, nobody told which bead is
    which."""
    task = next(
        t for t in tasks("phantoms", "images", counts=(6, 12)) if t.setting == "normal"
    )
    runs = run_task(task)
    assert [r.projections for r in runs] == [6, 12]
    for run in runs:
        assert run.identifiable
        assert run.mae < 0.01
        assert max(run.errors[n] / run.sigmas[n] for n in run.errors) < 6.0


def one_scenario_each(*words: Any, **options: Any) -> list[WorkUnit]:
    """List a unit of each setting, of another scenario than the one before; for damping,
    whose settings share their images, all of the first scenario."""
    every = tasks(*words, **options)
    settings = list(dict.fromkeys(t.setting for t in every))
    if words[0] == "damping":
        return every[: len(settings)]
    of = {s: [t for t in every if t.setting == s] for s in settings}
    return [of[s][i % len(of[s])] for i, s in enumerate(settings)]


@pytest.mark.slow
@pytest.mark.campaign
@pytest.mark.parametrize("scenarios", ["one", "all"])
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_in_images_runs_to_its_end(
    experiment: str, scenarios: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole by `flexdt study EXPERIMENT --fidelity images`; here with two numbers of
    projections.

    One bead determines nothing; of two beads, three images may be too few.
    """
    if scenarios == "one":
        monkeypatch.setattr(study, "tasks", one_scenario_each)
    document = run_study(experiment, "images", counts=(3, 12), jobs=1)
    settings = {t.setting for t in tasks(experiment, "images")}
    assert {row["setting"] for row in document["rows"]} == settings
    assert [run["note"] for run in document["runs"] if run["failed"]] == []
    assert all(run["note"] for run in document["runs"] if not run["identifiable"])
    for row in document["rows"]:
        few = 2 if experiment != "beads" else int(row["setting"])
        if few == 1:
            assert row["unidentifiable"] == row["runs"]
        else:
            assert row["success"] >= (row["runs"] if few > 2 else row["runs"] - 2), row[
                "setting"
            ]


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_counts_that_no_run_can_have_are_refused_before_the_first_run(
    experiment: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The thesis's counts are allowed in every experiment and fidelity."""
    monkeypatch.setattr("flexdt_extensions.studies.study.run_task", pytest.fail)
    rng = np.random.default_rng(581)
    for fidelity in ("clean", "images"):
        assert tasks(experiment, fidelity)
        most = int(rng.integers(5, 400))
        uneven = int(rng.choice([n for n in range(2, most) if most % n]))
        with pytest.raises(LimitError, match=f"the {most} images") as refused:
            run_study(experiment, fidelity, counts=(uneven, most), jobs=1)
        assert refused.value.data["asked"] == [uneven]
        for n in refused.value.data["allowed"]:
            assert tasks(experiment, fidelity, counts=(n, most))
    for counts in ((), (0, 12), (-3,)):
        with pytest.raises(LimitError, match="from 1 on"):
            run_study(experiment, "points", counts=counts, jobs=1)


def test_a_run_that_raises_is_a_row_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    estimate = solved_runs.estimate_geometry

    def raising(tracks: Any, *args: Any, **options: Any) -> Any:
        if len(tracks) == 5:
            raise ArithmeticError("planted")
        return estimate(tracks, *args, **options)

    monkeypatch.setattr(solved_runs, "estimate_geometry", raising)
    document = run_study("phantoms", "points", counts=(3, 5), jobs=1)
    assert len(document["runs"]) == 70
    for row in document["rows"]:
        assert (row["runs"], row["failed"], row["success"]) == (10, 5, 5)
    reasons = {run["note"] for run in document["runs"] if run["projections"] == 5}
    assert reasons == {"ArithmeticError: planted"}
    assert command(["study", "phantoms", "--jobs", "1"]) == 1
    shown = capsys.readouterr()
    assert "normal" in shown.out
    assert "35 of 490 runs failed" in shown.err
    assert "planted" in shown.err


def test_cut_beads_solve_the_tall_phantom() -> None:
    """In G3 one whole bead stays in view: the two at the edge are fitted (calibration.md)."""
    task = WorkUnit(
        "phantoms", "tall", "G3", "tall-3", ("dO_x", "dO_y", "dO_z", "alpha", "tau_x", "tau_z"),
        0.0, (12,), "images", 1, 0.2,
    )  # fmt: skip
    (run,) = run_task(task)
    assert run.success
    assert run.mae < 0.02


def test_basin_of_our_fit_is_not_smaller_than_algorithm_2s() -> None:
    runs = basin_task(Cell(20.0, 90.0, 5, "normal-5", 3))
    share = {m: np.mean([r.success for r in runs if r.setting == m]) for m in METHODS}
    assert share["ours, identities unknown"] == 1.0
    assert share["ours"] >= max(share["GN"], share["LM_normal"]) - 0.21
    near = basin_task(Cell(5.0, 30.0, 3, "normal-5", 3))
    assert all(r.success for r in near)


@pytest.mark.slow
def test_experiment_4_on_images_does_not_depend_on_the_number_of_projections() -> None:
    """Beam hardening, noise, beads off their model; the first scan's volume gives the model of
    the others (short: 24 images of two scans)."""
    runs, document = real_images_runs(map, print, 1, (3, 12), scans=("Scan2",), frames=24)
    off = document["beads_off_truth_mm"]
    designed = bead_model(load_phantom("lego"))
    truth = hidden_phantom(load_phantom("lego").scene, designed, 1)[1]
    assert max(off) < 0.06  # type: ignore[type-var]
    assert np.mean(off) < np.mean(off_truth(designed, truth))  # type: ignore[arg-type]
    few, many = (run.to_dict() for run in runs)
    for run in (few, many):
        assert run["identifiable"]
        assert max(run["errors"][n] / run["sigmas"][n] for n in run["errors"]) < 5.0
    assert abs(few["errors"]["alpha"] - many["errors"]["alpha"]) < 0.05


def test_exact_points_say_why_one_placement_succeeds(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert command(["study", "detector", "--jobs", "1"]) == 0
    assert "because exact points have no noise" in capsys.readouterr().out
    assert command(["study", "detector", "--jobs", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["experiment"] == "detector"
