"""One run of a study, and the tables made of many runs.

A run is a number of projections in one setting and scenario, solved by our fit and by Algorithm
2. Errors are absolute throughout, because signed ones cancel in a mean.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace

import numpy as np
import numpy.typing as npt

from flexdt.twin.calibration import BeadModel, FitResult, estimate_geometry
from flexdt.twin.calibration.fit.problem import FitProblem
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import Offsets
from flexdt.twin.geometry.poses import Poses
from flexdt_extensions.studies.algorithm_2 import algorithm_2
from flexdt_extensions.studies.experiments import (
    NOISE_PX,
    SHAPE,
    WorkUnit,
    placement_scenario,
    scenario,
    thesis,
    thesis_row,
)

OURS = "ours"
ALGORITHM_2 = "Algorithm 2"
COMPARED_FIGURES = ("mae", "cost_reduction_pct", "iterations")
"""Figures of a setting that are compared with the other method's and the thesis's."""


@dataclass(frozen=True)
class Run:
    """One solved calibration; errors are absolute, edge units.

    Attributes:
        setting, scenario, projections: of the run.
        identifiable: ours could determine every parameter, and used the data.
        errors: parameter -> |estimate - truth|; empty if not identifiable.
        sigmas: parameter -> stated standard deviation.
        iterations, cost_reduction_pct: of ours.
        success: MAE below the thesis's limit.
        weak: weak and null directions, as text.
        beside: mae, iterations, cost_reduction_pct, success of the other method on the
            same tracks, or empty.
        note: why there is no result.
        method: of this result; the other one's is in `beside`.
        failed: it raised an error instead of stating why there is no result.
    """

    setting: str
    scenario: str
    projections: int
    identifiable: bool
    errors: dict[str, float]
    sigmas: dict[str, float]
    iterations: int
    cost_reduction_pct: float
    success: bool
    weak: tuple[str, ...] = ()
    beside: dict[str, float] = field(default_factory=dict)
    note: str = ""
    method: str = OURS
    failed: bool = False

    @property
    def mae(self) -> float:
        """Mean absolute error over the free parameters; nan without a result."""
        return _mae(self.errors)

    @property
    def figures(self) -> dict[str, float]:
        """Figures to compare with the other method's: mean absolute error, iterations,
        cost reduction [%] and success (1 or 0).
        """
        return {
            "mae": self.mae,
            "iterations": float(self.iterations),
            "cost_reduction_pct": self.cost_reduction_pct,
            "success": float(self.success),
        }

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON-able form; nan becomes null."""
        text = json.dumps(asdict(self) | {"mae": self.mae})
        whole: dict[str, object] = json.loads(text, parse_constant=lambda _: None)
        return whole


def clean(value: float) -> float | None:
    """Return a finite float, or None."""
    return float(value) if math.isfinite(value) else None


def attempted(setting: str, scenario: str, n: int, solve: Callable[[int], Run]) -> Run:
    """Return the run that `solve` makes; any Exception becomes a failed run without a
    result, with the error as its note.

    Args:
        setting, scenario: of the run.
        n: number of projections.
        solve: makes the run from n.
    """
    try:
        return solve(n)
    except Exception as problem:
        note = f"{type(problem).__name__}: {problem}"
        return Run(
            setting,
            scenario,
            n,
            False,
            {},
            {},
            0,
            math.nan,
            False,
            note=note,
            failed=True,
        )


def point_runs(task: WorkUnit, model: BeadModel) -> list[Run]:
    """Fit exact or noisy points, with identities known, for each number of projections of
    a task; returns a run each, also of a failure.
    """

    def solve(n: int) -> Run:
        """Fit to the points of `n` projections and compare with the truth; noise, if the
        task has it, depends on seed, phantom, scenario and n alone.
        """
        parts, truth = geometry_of(task, n)
        poses = Poses.concatenate(parts)
        tracks = poses.cone_vec(truth).project_points(model.beads, SHAPE)
        if task.fidelity == "noisy":
            # One generator a run, so that runs can be made in any order; solvers share the
            # noise.
            key = [
                task.seed,
                *task.phantom.encode(),
                *task.scenario.encode(),
                n,
                len(parts),
            ]
            tracks = tracks + NOISE_PX * np.random.default_rng(key).normal(
                size=tracks.shape
            )
        fit = estimate_geometry(
            tracks, model, poses, task.free, shape=SHAPE, noise_px=NOISE_PX
        )
        return run_of(task, n, fit, truth, fit.problem)

    return [attempted(task.setting, task.scenario, n, solve) for n in task.counts]


def geometry_of(task: WorkUnit, n: int) -> tuple[list[Poses], Offsets]:
    """Make the poses (one set for each placement) and true offsets of a task, with `n`
    frames.
    """
    if task.experiment == "detector":
        return placement_scenario(task.setting, n)
    poses, truth = scenario(task.scenario, n, task.variant)
    return [poses], truth


def run_of(
    task: WorkUnit,
    n: int,
    fit: FitResult | None,
    truth: Offsets,
    problem: FitProblem | None,
    note: str = "",
) -> Run:
    """Compare a fit with the truth, and let Algorithm 2 solve the same tracks.

    In the damping experiment the result is that of Algorithm 2, which is studied there, and
    ours is in `beside`; elsewhere, and where our fit is not identifiable, it is the other
    way round. Without a run of Algorithm 2 the result is ours alone.

    Args:
        task: experiment and setting.
        n: number of projections.
        fit: ours; None if there is none.
        truth: offsets.
        problem: tracks for Algorithm 2; None: it is not run.
        note: why there is no result.
    """
    run = fitted_run(task.setting, task.scenario, n, fit, truth, task.limit, note)
    if problem is None:
        other = None
    else:
        other = _algorithm_2(task, n, problem, truth)
    if other is None:
        return run
    if task.experiment == "damping" and run.identifiable:
        return replace(other, sigmas=run.sigmas, weak=run.weak, beside=run.figures)
    return replace(run, beside=other.figures)


def fitted_run(
    setting: str,
    scenario: str,
    n: int,
    fit: FitResult | None,
    truth: Offsets,
    limit: float,
    note: str = "",
) -> Run:
    """Compare a fit to n projections with the truth.

    Without an identifiable fit, or with a note, the run has no errors, sigmas or success,
    but a note.

    Args:
        setting, scenario: which.
        n: number of projections.
        fit: ours; None if there is none.
        truth: in the fit's reading.
        limit: mean absolute error below which it is a success.
        note: why the fit is not to be used; "" if it is.
    """
    weak = () if fit is None else fit.certificate.weak
    if fit is None or not fit.identifiable or note:
        iterations = 0 if fit is None else fit.iterations
        note = note or "not identifiable"
        return Run(
            setting,
            scenario,
            n,
            False,
            {},
            {},
            iterations,
            math.nan,
            False,
            weak,
            note=note,
        )
    errors = errors_of(fit.values, truth)
    return Run(
        setting,
        scenario,
        n,
        True,
        errors,
        fit.sigmas,
        fit.iterations,
        fit.cost_reduction_pct,
        _mae(errors) < limit,
        weak,
    )


def _mae(errors: Mapping[str, float]) -> float:
    if errors:
        return float(np.mean(list(errors.values())))
    return math.nan


def errors_of(values: dict[str, float], truth: Offsets) -> dict[str, float]:
    """Compute |value - truth| of each offset in `values`, [mm, deg]; whole turns of alpha do
    not count, nor told lengths, which are no offsets.
    """
    edge = truth.to_edge()
    return {
        name: abs(
            math.remainder(v - edge[name], 360.0) if name == "alpha" else v - edge[name]
        )
        for name, v in values.items()
        if name in edge
    }


def _algorithm_2(
    task: WorkUnit, n: int, problem: FitProblem, truth: Offsets
) -> Run | None:
    """Solve the same tracks by Algorithm 2.

    Its success is a mean absolute error below the task's limit; it has no sigmas.

    Args:
        task: setting and damping.
        n: number of projections.
        problem: the tracks.
        truth: offsets.

    Returns:
        The run; None if beads are unknowns too.
    """
    if problem.layout.bead_column >= 0:
        return None
    result = algorithm_2(problem, task.damping)
    names = problem.layout.names
    values = {n: v for n, v in result.parameters.to_edge().items() if n in names}
    errors = errors_of(values, truth)
    return Run(
        task.setting,
        task.scenario,
        n,
        True,
        errors,
        {},
        result.iterations,
        result.cost_reduction_pct,
        _mae(errors) < task.limit,
        method=ALGORITHM_2,
    )


def rows_of(experiment: str, runs: Sequence[Run]) -> list[dict[str, object]]:
    """Sum up the runs: one row a setting, in order of first appearance, with the thesis's
    figures.

    Means are over the runs with a result; None without one.

    Args:
        experiment: its table of the thesis.
        runs: of all settings.

    Returns:
        Rows: counts of runs (all, and those that succeed, are unidentifiable, fail or are
        weak), means of MAE, iterations and cost reduction [%], maxima of MAE and
        iterations, mean errors and sigmas by parameter, `method`, `beside` of the other
        method, `thesis_*`.
    """
    settings = dict.fromkeys(r.setting for r in runs)
    return [_row(experiment, [r for r in runs if r.setting == s]) for s in settings]


def _row(experiment: str, runs: Sequence[Run]) -> dict[str, object]:
    """Sum up the runs of one setting; see `rows_of`."""
    setting = runs[0].setting
    method = runs[0].method
    printed = thesis_row(experiment, setting) or {}
    return {
        "setting": setting,
        **_counts(runs),
        **_mean_results([r for r in runs if r.errors]),
        "method": method,
        "beside": _mean_figures(method, [r.beside for r in runs if r.beside]),
        **{f"thesis_{k}": printed.get(k) for k in COMPARED_FIGURES},
    }


def _counts(runs: Sequence[Run]) -> dict[str, object]:
    """Count the runs: all, and those that succeed, are unidentifiable, fail or are weak."""
    return {
        "runs": len(runs),
        "success": sum(r.success for r in runs),
        "unidentifiable": sum(not r.identifiable for r in runs),
        "failed": sum(r.failed for r in runs),
        "weak": sum(bool(r.weak) for r in runs),
    }


def _mean_results(solved: Sequence[Run]) -> dict[str, object]:
    """Average the results of runs that have one; None, and no parameters, without any."""
    maes = np.array([r.mae for r in solved])
    names = list(solved[0].errors) if solved else []
    return {
        "mae": _mean(maes),
        "mae_max": clean(float(maes.max())) if len(maes) else None,
        "cost_reduction_pct": _mean([r.cost_reduction_pct for r in solved]),
        "iterations": _mean([r.iterations for r in solved]),
        "iterations_max": max((r.iterations for r in solved), default=None),
        "mean_absolute": {n: _mean([r.errors[n] for r in solved]) for n in names},
        "mean_sigma": {
            n: _mean([r.sigmas[n] for r in solved if n in r.sigmas]) for n in names
        },
    }


def _mean_figures(method: str, figures: Sequence[dict[str, float]]) -> dict[str, object]:
    """Compute runs, successes and means of the other method's figures (not those of
    `method`); empty without any.
    """
    if not figures:
        return {}
    return {
        "method": ALGORITHM_2 if method == OURS else OURS,
        "runs": len(figures),
        "success": int(sum(f["success"] for f in figures)),
        **{k: _mean([f[k] for f in figures]) for k in COMPARED_FIGURES},
    }


def _mean(values: Sequence[float] | npt.NDArray[np.float64]) -> float | None:
    array = np.asarray(values, dtype=np.float64)
    array = array[np.isfinite(array)]
    return float(array.mean()) if len(array) else None


def summary(experiment: str, fidelity: str, runs: Sequence[Run]) -> dict[str, object]:
    """Make the JSON of `flexdt study`: experiment, fidelity, rows, runs, thesis_source
    and assumed (noise [px] of noisy points, else None).
    """
    return {
        "experiment": experiment,
        "fidelity": fidelity,
        "rows": rows_of(experiment, runs),
        "runs": [r.to_dict() for r in runs],
        "thesis_source": thesis()["source"],
        "assumed": {
            "noise_px": NOISE_PX if fidelity == "noisy" else None,
            "algorithm_2": "nothing: eta_conv, steps and limit are those of the author's code",
            "placements": "assumed" if experiment == "detector" else None,
        },
    }


def grid(runs: Sequence[Run]) -> tuple[list[str], list[int], FloatArray]:
    """Compute the mean MAE over scenarios, by setting and number of projections.

    Runs without errors are left out.

    Returns:
        Settings, numbers of projections, and (settings, counts) means; nan without runs.
    """
    settings = list(dict.fromkeys(r.setting for r in runs))
    counts = sorted({r.projections for r in runs})
    out = np.full((len(settings), len(counts)), np.nan)
    for i, setting in enumerate(settings):
        for j, n in enumerate(counts):
            some = [
                r.mae
                for r in runs
                if r.setting == setting and r.projections == n and r.errors
            ]
            if some:
                out[i, j] = float(np.mean(some))
    return settings, counts, out
