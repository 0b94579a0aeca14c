"""`flexdt study` without its command line: tasks to processes, results to tables and files.

It refuses to compute anything itself: plans and runs are `flexdt.twin.calibration.studies`.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

from flexdt.phantoms import load_phantom
from flexdt.twin.calibration.beads import bead_model
from flexdt.twin.calibration.studies.plans import Task, tasks
from flexdt.twin.calibration.studies.runs import Run, point_runs, summary
from flexdt.twin.errors import TwinError

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
        experiment: beads, phantoms, damping or detector.
        fidelity: points, noisy, clean or images.
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


@contextmanager
def executor(jobs: int | None, scheduler: str | None) -> Iterator[Executor | None]:
    """Something to map tasks with: a dask scheduler, own processes, or None for this process."""
    if scheduler is not None:
        with _dask(scheduler) as remote:
            yield remote
        return
    count = os.cpu_count() or 1 if jobs is None else jobs
    if count <= 1:
        yield None
        return
    with ProcessPoolExecutor(count) as pool:
        yield pool


@contextmanager
def _dask(address: str) -> Iterator[Executor]:
    try:
        from distributed import Client  # type: ignore[import-not-found,unused-ignore]
    except ImportError:
        raise TwinError(
            "a scheduler needs dask.distributed, which is not installed: pip install distributed",
            {"asked": address},
        ) from None
    try:
        client = Client(address, timeout="10s")
    except OSError as error:
        raise TwinError(f"no dask scheduler at {address}: {error}", {"asked": address}) from None
    with client, client.get_executor() as pool:
        yield pool


def load_summary(folder: Path) -> dict[str, object]:
    """The summary.json of an earlier study."""
    document: dict[str, object] = json.loads((folder / "summary.json").read_text("utf-8"))
    return document
