"""`flexdt study`: repeats the thesis's experiments and prints its figures with ours."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from flexdt.extending import (
    Answer,
    CommandError,
    Jobs,
    Scheduler,
    argument,
    note,
    option,
    table,
)

Experiment = Literal["beads", "phantoms", "damping", "detector", "real", "basin"]
Fidelity = Literal["points", "noisy", "clean", "images"]
COLUMNS: Final = {
    "setting": "setting",
    "runs": "runs",
    "success": "success",
    "unidentifiable": "unidentifiable",
    "mae": "MAE",
    "mae_max": "largest",
    "iterations": "iterations",
    "thesis_mae": "thesis MAE",
}
"""Member of a row of the document -> head of its column."""

EXACT_NOTE: Final = (
    "G = 1 succeeds here and fails in the thesis because exact points have no noise, which the "
    "weak direction multiplies: see --fidelity noisy"
)


def study(
    experiment: Experiment = argument(..., "EXPERIMENT"),
    fidelity: Fidelity | None = option(
        None,
        "Exact points, noisy points, clean or noisy images. Default: points; basin: noisy.",
    ),
    variant: Literal["printed", "author"] = option(
        "printed",
        "Take phantoms and scenarios of beads, phantoms, damping as the thesis prints them, "
        "or as its author's public code has them.",
    ),
    out: Path | None = option(
        None, "Write summary.json, tables and charts here.", metavar="DIR"
    ),
    jobs: Jobs = None,
    scheduler: Scheduler = None,
    seed: int = option(1, "Draw all noise from this seed.", min=0),
) -> Answer:
    """Repeat an experiment of the thesis.

    EXPERIMENT: beads, phantoms, damping, detector (6.6), real (experiment 4: the 242 fits of
    real scans explained, or on synthetic images), basin (sensitivity to the start). The command
    fails, after all results, if a run failed.

    Yields:
        The document of --json, a table of the settings, remarks on the experiment, and the
        report's folder if one is written.
    """
    from flexdt_extensions.studies.study import run_study
    from flexdt_extensions.studies.study_report import open_directions, real_lines

    document = run_study(
        experiment,
        fidelity,
        out=out,
        jobs=jobs,
        scheduler=scheduler,
        seed=seed,
        variant=variant,
        tell=note,
    )
    yield document
    rows = [[_text(row.get(key)) for key in COLUMNS] for row in document["rows"]]
    head = [*COLUMNS.values()]
    weak = open_directions(document["rows"])
    if weak is not None:
        rows = [[*row, *more] for row, more in zip(rows, weak, strict=True)]
        head += ["weak", "largest sigma"]
    yield table(rows, head)
    if (document["experiment"], document["fidelity"]) == ("detector", "points"):
        yield EXACT_NOTE
    yield from real_lines(document)
    if out is not None:
        yield f"report: {out}"
    if failed := [run for run in document["runs"] if run["failed"]]:
        first = failed[0]
        raise CommandError(
            f"{len(failed)} of {len(document['runs'])} runs failed; the first, "
            f"{first['setting']} "
            f"{first['scenario']} with {first['projections']} projections: {first['note']}"
        )


def _text(value: object) -> str:
    """Format a cell: "-" for None, three digits for floats."""
    if value is None:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}"
    return str(value)
