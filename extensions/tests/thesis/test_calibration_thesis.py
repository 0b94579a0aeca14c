"""Algorithm 2 as printed, and the thesis's figures as copied."""

from __future__ import annotations

import numpy as np
import pytest
from calibration_scenarios import SCENARIOS, SHAPE, exact_tracks, scenario, spiral

from flexdt.twin.calibration.fit.problem import SIX, build_problem
from flexdt_extensions.studies.algorithm_2 import Stop, algorithm_2
from flexdt_extensions.studies.experiments import placements, thesis, thesis_row


@pytest.mark.parametrize("lam", [0.0, 1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("name", list(SCENARIOS))
def test_algorithm_2_solves_exact_points_with_every_damping(
    name: str, lam: float
) -> None:
    poses, truth = scenario(name, 12)
    model = spiral((20, 22, 40), 3)
    problem = build_problem(
        exact_tracks(poses, truth, model), model, poses, free=SIX, shape=SHAPE
    )
    result = algorithm_2(problem, lam)
    edge = result.parameters.to_edge()
    assert result.stop is Stop.CONVERGED
    assert max(abs(edge[n] - truth.to_edge()[n]) for n in SIX) < 1e-9
    assert result.iterations <= 8
    assert result.cost_reduction_pct == pytest.approx(100.0)


def test_damping_of_zero_stays_zero_and_a_bad_start_stalls() -> None:
    poses, truth = scenario("G0", 12)
    model = spiral((20, 22, 40), 3)
    problem = build_problem(
        exact_tracks(poses, truth, model), model, poses, free=SIX, shape=SHAPE
    )
    turned = np.zeros_like(problem.base)
    turned[..., 3] = np.pi
    far = problem.with_base(problem.base + turned)
    result = algorithm_2(far, 0.0)
    assert result.lam == 0.0
    good = (
        max(abs(result.parameters.to_edge()[n] - truth.to_edge()[n]) for n in SIX) < 1e-6
    )
    assert good or result.stop in (Stop.STALLED, Stop.LIMIT)


def test_one_bead_has_singular_normal_equations_without_damping() -> None:
    poses, truth = scenario("G0", 6)
    model = spiral((20, 40, 60), 1)
    problem = build_problem(
        exact_tracks(poses, truth, model), model, poses, free=SIX, shape=SHAPE
    )
    result = algorithm_2(problem, 1e-2)
    wrong = max(abs(result.parameters.to_edge()[n] - truth.to_edge()[n]) for n in SIX)
    assert wrong > 1.0  # a low cost, and not the truth
    assert result.cost_reduction_pct > 99.0


def test_the_theses_figures_are_copied_whole() -> None:
    figures = thesis()
    assert "thesis" in figures["source"].lower()
    assert thesis_row("beads", "3") == {
        "mae": 0.01, "cost_reduction_pct": 100.0, "iterations": 42.8
    }  # fmt: skip
    assert thesis_row("damping", "LM_high")["lambda"] == 1  # type: ignore[index]
    assert thesis_row("real", "Scan1") is None
    assert figures["scenarios"]["G3"]["alpha_deg"] == 25.0
    for scan in range(1, 12):
        table = figures[f"table_A_{scan + 4}_scan_{scan}"]
        assert len(table) == 22
        # The last row is the one of Table A.4 (the tables were copied independently).
        assert table["360"] == figures["table_A_4_at_360"][f"Scan{scan}"]
    assert placements()["source"] == "assumed"
