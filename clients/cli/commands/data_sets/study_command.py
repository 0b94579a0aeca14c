"""`flexdt study`: repeats the thesis's experiments and prints its figures beside ours."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from flexdt.clients.cli import options
from flexdt.clients.cli.console import emit, note, say, table
from flexdt.clients.cli.options import argument, option

Experiment = Literal["beads", "phantoms", "damping", "detector", "real", "basin"]
Fidelity = Literal["points", "noisy", "clean", "images"]


def study(
    experiment: Experiment = argument(..., "EXPERIMENT"),
    fidelity: Fidelity | None = option(
        None, "Exact points, noisy points, clean or noisy images. Default: points; basin: noisy."
    ),
    variant: Literal["printed", "author"] = option(
        "printed",
        "Phantoms and scenarios of beads, phantoms, damping: as the thesis prints them, "
        "or as its author's public code has them.",
    ),
    out: Path | None = option(None, "summary.json, tables, charts.", metavar="DIR"),
    jobs: options.Jobs = None,
    scheduler: options.Scheduler = None,
    seed: int = option(1, "Of all noise.", min=0),
    json: options.Json = False,
) -> None:
    """Repeat an experiment of the thesis.

    EXPERIMENT: beads, phantoms, damping, detector (6.6), real (experiment 4: the 242 fits of real
    scans explained, or on synthetic images), basin (sensitivity to the start).
    """
    from flexdt.clients.studies.study import run_study
    from flexdt.clients.studies.study_report import open_directions, real_lines

    document = run_study(
        experiment, fidelity, out=out, jobs=jobs, scheduler=scheduler, seed=seed, variant=variant,
        tell=note,
    )  # fmt: skip
    if json:
        emit(document)
        return
    found = document["rows"]
    rows = [row for row in found if isinstance(row, Mapping)] if isinstance(found, list) else []
    head = ("setting", "runs", "success", "unidentifiable", "MAE", "largest", "iterations",
            "thesis MAE")  # fmt: skip
    weak = open_directions(rows)
    if weak is None:
        say(table([_row(row) for row in rows], head))
    else:
        say(
            table(
                [(*_row(row), *more) for row, more in zip(rows, weak, strict=True)],
                (*head, "weak", "largest sigma"),
            )
        )
    for line in real_lines(document):
        say(line)
    if out is not None:
        say(f"report: {out}")


def _row(row: Mapping[str, object]) -> tuple[str, ...]:
    keys = ("setting", "runs", "success", "unidentifiable", "mae", "mae_max", "iterations",
            "thesis_mae")  # fmt: skip
    return tuple(_text(row.get(key)) for key in keys)


def _text(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
