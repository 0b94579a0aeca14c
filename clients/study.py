"""`flexdt study` without its command line: tasks to processes, results to tables and files.

It refuses to compute anything itself: plans and runs are `flexdt.twin.calibration.studies`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

from flexdt.clients.executors import executor
from flexdt.clients.study_real import run_real_images
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.beads import bead_model
from flexdt.twin.calibration.studies.basin import (
    METHODS,
    START_DEG,
    START_MM,
    Cell,
    basin_runs,
    cells,
    success_grid,
)
from flexdt.twin.calibration.studies.plans import Task, tasks
from flexdt.twin.calibration.studies.real import explained, real_runs, scan_names
from flexdt.twin.calibration.studies.runs import Run, point_runs, summary

Tell = Callable[[str], None]


def run_task(task: Task) -> list[Run]:
    """All runs of one task; a plain function, so that any process can be given it."""
    phantom = load_phantom(task.phantom)
    model = bead_model(phantom)
    if task.fidelity in ("points", "noisy"):
        return point_runs(task, model)
    from flexdt.twin.calibration.studies.images import image_runs

    return image_runs(task, model, phantom.scene)


def run_study(
    experiment: str,
    fidelity: str = "points",
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    counts: Sequence[int] | None = None,
    seed: int = 1,
    tell: Tell | None = None,
) -> dict[str, object]:
    """Run one of the thesis's experiments.

    Args:
        experiment: beads, phantoms, damping, detector, real or basin.
        fidelity: points, noisy, clean or images; basin works on noisy points alone, real on those
            or, for images, on radiographs.
        out: folder for summary.json, tables and heat maps; None writes nothing.
        jobs: processes; None is one for each core.
        scheduler: address of a dask scheduler to use instead of own processes.
        counts: numbers of projections; None is the thesis's.
        seed: of all noise.
        tell: told of progress.

    Returns:
        The JSON of `flexdt study`.

    Raises:
        UnknownNameError: no such experiment or fidelity.
        TwinError: dask.distributed is not installed, or the scheduler cannot be reached.
    """
    real = run_real_images if fidelity == "images" else run_real
    special = {"basin": run_basin, "real": real}.get(experiment)
    if special is not None:
        return special(out=out, jobs=jobs, scheduler=scheduler, seed=seed, tell=tell)
    work = tasks(experiment, fidelity, counts=counts, seed=seed)
    runs: list[Run] = []
    with executor(jobs, scheduler) as pool:
        results = map(run_task, work) if pool is None else pool.map(run_task, work)
        for i, (task, some) in enumerate(zip(work, results, strict=True)):
            runs += some
            if tell is not None:
                good = sum(r.success for r in some)
                tell(
                    f"{i + 1}/{len(work)} {task.setting} {task.scenario}: {good} of {len(some)} "
                    "runs succeed"
                )
    document = summary(experiment, fidelity, runs)
    if out is not None:
        from flexdt.clients.study_report import write_study

        write_study(out, document, runs)
    return document


def basin_task(cell: Cell) -> list[Run]:
    """All methods in one cell of start errors."""
    return basin_runs(cell, bead_model(load_phantom(cell.phantom)))


def run_basin(
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    seed: int = 1,
    draws: int = 10,
    tell: Tell | None = None,
) -> dict[str, object]:
    """Success against the start's error, for Algorithm 2, our fit, and unknown identities."""
    work = cells(draws, seed=seed)
    runs: list[Run] = []
    with executor(jobs, scheduler) as pool:
        results = map(basin_task, work) if pool is None else pool.map(basin_task, work)
        for i, some in enumerate(results):
            runs += some
            if tell is not None:
                tell(f"{i + 1}/{len(work)} {work[i].name}")
    document = summary("basin", "noisy", runs)
    grids = {m: success_grid(runs, m) for m in METHODS}
    document["start_mm"], document["start_deg"] = list(START_MM), list(START_DEG)
    document["success_share"] = {m: g.tolist() for m, g in grids.items()}
    if out is not None:
        from flexdt.clients.study_report import write_basin

        write_basin(out, document, grids)
    return document


def real_task(task: tuple[str, int]) -> tuple[list[Run], dict[str, object]]:
    """One scan of experiment 4's synthetic twin."""
    name, seed = task
    return real_runs(name, bead_model(load_phantom("lego")), seed)


def run_real(
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    seed: int = 1,
    tell: Tell | None = None,
) -> dict[str, object]:
    """Experiment 4's dependence on N, with the right angles and with the thesis's bookkeeping."""
    runs: list[Run] = []
    curves: list[dict[str, object]] = []
    work = [(name, seed) for name in scan_names()]
    with executor(jobs, scheduler) as pool:
        results = map(real_task, work) if pool is None else pool.map(real_task, work)
        for (name, _), (some, curve) in zip(work, results, strict=True):
            runs += some
            curves.append(curve)
            if tell is not None:
                tell(f"{name}: {sum(r.success for r in some)} of {len(some)} runs succeed")
    document = summary("real", "noisy", runs)
    document["curves"] = curves
    document["figure_6_4"] = explained(curves)
    if out is not None:
        from flexdt.clients.study_report import write_real

        write_real(out, document, runs)
    return document


def load_summary(folder: Path) -> dict[str, object]:
    """The summary.json of an earlier study."""
    document: dict[str, object] = json.loads((folder / "summary.json").read_text("utf-8"))
    return document
