"""`flexdt batch`: thousands of scans or calibrations from a plan, here or on a cluster."""

from __future__ import annotations

import time
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from flexdt.extending import (
    Answer,
    CommandError,
    Jobs,
    Scheduler,
    argument,
    free_bytes,
    note,
    option,
    size,
    table,
)

if TYPE_CHECKING:
    from concurrent.futures import Executor

PROGRESS_S = 2.0
"""Interval between lines of progress [s]."""


def batch(
    plan: Path = argument(..., "PLAN.toml"),
    out: Path | None = option(
        None, "Write results here; default: the plan's name.", metavar="DIR"
    ),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    slurm: Path | None = option(
        None, "Submit workers to SLURM as this file says.", metavar="FILE"
    ),
    slurm_script: bool = option(
        False, "Print the script of --slurm's jobs and leave.", "--slurm-script"
    ),
) -> Answer:
    """Make a batch of scans or calibrations; run again to take up an interrupted one.

    Results are Zarr arrays and a manifest with every item's seed, parameters and checksums;
    they are the same bytes whatever the number of processes. Too little free disk space is
    stated, and not an error.

    Yields:
        The summary as document of --json, then items done, failed and taken up, a table of
        the parameters' errors if any were judged, and the manifest; with --slurm-script
        only that script.
    """
    from flexdt_extensions.batch.batch_plan import read_plan
    from flexdt_extensions.batch.batch_run import run_batch
    from flexdt_extensions.batch.work import item_bytes
    from flexdt_extensions.executors import (
        dask_executor,
        job_script,
        processes,
        read_slurm,
        slurm_workers,
    )

    wanted = read_plan(plan)
    if scheduler is not None and slurm is not None:
        raise typer.BadParameter("give --scheduler or --slurm, not both")
    workers: AbstractContextManager[Executor]
    if slurm is not None:
        if slurm_script:
            yield job_script(read_slurm(slurm)).rstrip()
            return
        workers = slurm_workers(slurm)
    elif slurm_script:
        raise typer.BadParameter("--slurm-script needs --slurm FILE")
    else:
        if scheduler is not None:
            workers = dask_executor(scheduler)
        else:
            workers = processes(jobs)
    if out is None:
        folder = Path(wanted.batch.name)
    else:
        folder = out
    if folder.exists() and not folder.is_dir():
        raise CommandError(f"{folder}: is a file")
    whole = wanted.batch.items * item_bytes(wanted)
    free = free_bytes(folder)
    if whole > free:
        more = f"; {size(free)} are free"
    else:
        more = ""
    note(f"{wanted.batch.items} items, {size(whole)} before compression{more}")
    last = 0.0

    def tell(done: int, items: int, rate: float) -> None:
        """Note items done, their rate and the estimated time left [s]; at most every
        PROGRESS_S, and at the end.
        """
        nonlocal last
        if time.monotonic() - last >= PROGRESS_S or done == items:
            last = time.monotonic()
            if rate > 0:
                left = (items - done) / rate
            else:
                left = 0.0
            note(f"{done}/{items} items, {rate:.2f} a second, {left:.0f} s left")

    summary = run_batch(wanted, folder, workers, tell=tell)
    yield summary
    rate = summary["items_per_s"]
    pace = "" if rate is None else f", {rate:g} a second"
    yield (
        f"{summary['done']} of {summary['items']} items done, {summary['failed']} failed, "
        f"{summary['resumed']} taken up{pace}"
    )
    found = summary["figures"]
    if found:
        yield f"{found['identifiable']} of {found['judged']} calibrations are identifiable"
        rows = [
            (
                name,
                f"{f['mae']:.4g}",
                f"{f['rms_pull']:.3g}",
                f"{100 * f['within_95']:.1f} %",
            )
            for name, f in found["parameters"].items()
        ]
        yield table(rows, ("parameter", "MAE", "error/sigma", "within 1.96 sigma"))
    yield f"{folder / 'manifest.json'}: items {summary['items_sha256'][:16]}"
