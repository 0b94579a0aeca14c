"""`flexdt study` without its command line: tasks to processes, results to tables and files.

It refuses to compute anything itself: plans and runs are `flexdt.twin.calibration.studies`.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Final

from flexdt.clients.executors import executor
from flexdt.clients.study_real import run_real_images
from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.beads import bead_model
from flexdt.twin.calibration.studies import real, real_images
from flexdt.twin.calibration.studies.basin import (
    METHODS,
    START_DEG,
    START_MM,
    Cell,
    basin_runs,
    cells,
    success_grid,
)
from flexdt.twin.calibration.studies.plans import EXPERIMENTS, NOISE_PX, Task, tasks
from flexdt.twin.calibration.studies.plans import FIDELITIES as ALL_FIDELITIES
from flexdt.twin.calibration.studies.real import COUNTS, explained, real_runs, scan_names
from flexdt.twin.calibration.studies.runs import Run, clean, point_runs, summary
from flexdt.twin.errors import TwinError, UnknownNameError

Tell = Callable[[str], None]


def run_task(task: Task) -> list[Run]:
    """All runs of one task; a plain function, so that any process can be given it."""
    phantom = load_phantom(task.phantom)
    model = bead_model(phantom)
    if task.fidelity in ("points", "noisy"):
        return point_runs(task, model)
    from flexdt.twin.calibration.studies.images import image_runs

    return image_runs(task, model, phantom.scene)


FIDELITIES: Final[Mapping[str, tuple[str, ...]]] = {
    **dict.fromkeys(EXPERIMENTS, ALL_FIDELITIES),
    "real": ("noisy", "points", "images"),
    "basin": ("noisy", "points"),
}
"""What each experiment can be run on, the default first."""


def run_study(
    experiment: str,
    fidelity: str | None = None,
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
        fidelity: points, noisy, clean or images; None is the experiment's own (points; real and
            basin: noisy).
        out: folder for summary.json, tables and heat maps; None writes nothing.
        jobs: processes; None is one for each core.
        scheduler: address of a dask scheduler to use instead of own processes.
        counts: numbers of projections; None is the thesis's. basin has one.
        seed: of all noise.
        tell: told of progress.

    Returns:
        The JSON of `flexdt study`.

    Raises:
        UnknownNameError: no such experiment, or it has no such fidelity.
        TwinError: counts were given for basin; dask.distributed is not installed, or the scheduler
            cannot be reached.
    """
    if experiment not in FIDELITIES:
        allowed = ", ".join(FIDELITIES)
        raise UnknownNameError(
            f"no experiment {experiment!r}; allowed: {allowed}",
            {"asked": experiment, "allowed": list(FIDELITIES)},
        )
    fidelity = FIDELITIES[experiment][0] if fidelity is None else fidelity
    if fidelity not in FIDELITIES[experiment]:
        raise UnknownNameError(
            f"experiment {experiment!r} has no fidelity {fidelity!r}; allowed: "
            + ", ".join(FIDELITIES[experiment]),
            {"asked": fidelity, "allowed": list(FIDELITIES[experiment])},
        )
    if experiment == "basin":
        if counts is not None:
            raise TwinError("basin has one number of projections; counts are not for it")
        return run_basin(fidelity, out=out, jobs=jobs, scheduler=scheduler, seed=seed, tell=tell)
    if experiment == "real":
        if fidelity == "images":
            return run_real_images(
                out=out, jobs=jobs, scheduler=scheduler, seed=seed, tell=tell,
                counts=real_images.COUNTS if counts is None else counts,
            )  # fmt: skip
        return run_real(
            fidelity, out=out, jobs=jobs, scheduler=scheduler, seed=seed, tell=tell,
            counts=COUNTS if counts is None else counts,
        )  # fmt: skip
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
    fidelity: str = "noisy",
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    seed: int = 1,
    draws: int = 10,
    tell: Tell | None = None,
) -> dict[str, object]:
    """Success against the start's error, for Algorithm 2, our fit, and unknown identities."""
    work = cells(draws, seed=seed, noise_px=0.0 if fidelity == "points" else NOISE_PX)
    runs: list[Run] = []
    with executor(jobs, scheduler) as pool:
        results = map(basin_task, work) if pool is None else pool.map(basin_task, work)
        for i, some in enumerate(results):
            runs += some
            if tell is not None:
                tell(f"{i + 1}/{len(work)} {work[i].name}")
    document = summary("basin", fidelity, runs)
    grids = {m: success_grid(runs, m) for m in METHODS}
    document["start_mm"], document["start_deg"] = list(START_MM), list(START_DEG)
    document["success_share"] = {m: g.tolist() for m, g in grids.items()}
    if out is not None:
        from flexdt.clients.study_report import write_basin

        write_basin(out, document, grids)
    return document


RealTask = tuple[str, int, float, tuple[int, ...]]
"""Scan, seed, noise [px], numbers of projections."""


def real_task(task: RealTask) -> tuple[list[Run], dict[str, object]]:
    """One scan of experiment 4's synthetic twin."""
    name, seed, noise_px, counts = task
    model = bead_model(load_phantom("lego"))
    return real_runs(name, model, seed, noise_px=noise_px, counts=counts)


def run_real(
    fidelity: str = "noisy",
    *,
    out: Path | None = None,
    jobs: int | None = None,
    scheduler: str | None = None,
    seed: int = 1,
    tell: Tell | None = None,
    counts: Sequence[int] = COUNTS,
) -> dict[str, object]:
    """Experiment 4's dependence on N, with the right angles and with the thesis's bookkeeping."""
    runs: list[Run] = []
    curves: list[dict[str, object]] = []
    noise = 0.0 if fidelity == "points" else real.NOISE_PX
    work = [(name, seed, noise, tuple(counts)) for name in scan_names()]
    with executor(jobs, scheduler) as pool:
        results = map(real_task, work) if pool is None else pool.map(real_task, work)
        for (name, *_), (some, curve) in zip(work, results, strict=True):
            runs += some
            curves.append(curve)
            if tell is not None:
                tell(f"{name}: {sum(r.success for r in some)} of {len(some)} runs succeed")
    document = summary("real", fidelity, runs)
    document["assumed"] = {
        "noise_px": noise, "bead_tolerance_mm": real.TOLERANCE_MM, "mounts": "of the thesis's size"
    }  # fmt: skip
    document["curves"] = curves
    document["figure_6_4"] = {k: clean(v) for k, v in explained(curves).items()}
    if out is not None:
        from flexdt.clients.study_report import write_real

        write_real(out, document, runs)
    return document


def load_summary(folder: Path) -> dict[str, object]:
    """The summary.json of an earlier study."""
    document: dict[str, object] = json.loads((folder / "summary.json").read_text("utf-8"))
    return document
