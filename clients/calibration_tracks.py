"""Where a calibration saw the beads, and where the geometry before and after it puts them.

For people who want to see the fit over a radiograph: pixels of every frame, beside the residuals.
It refuses to read images and to judge.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.calibrate import Outcome
from flexdt.twin.calibration.fit import FitResult
from flexdt.twin.calibration.model import from_printed_reading, values_in
from flexdt.twin.conventions import FloatArray
from flexdt.twin.parameters import NOMINAL, Parameters

DIGITS: Final = 3


def predictions(fit: FitResult, geometry: tuple[Parameters, ...]) -> FloatArray:
    """Bead shadows (n, k, 2) [px] of every frame and bead, seen or not.

    Args:
        fit: says frames and beads.
        geometry: one for each scan, as corrections have it.
    """
    problem = fit.problem
    base = [values_in(from_printed_reading(p, fit.reading)) for p in geometry]
    problem = problem.with_base(np.array(base))
    x = problem.start
    if problem.layout.bead_column >= 0:
        x[problem.layout.bead_column :] = fit.beads.ravel()
    return problem.residuals(x, np.ones_like(problem.seen))[0]


def tracks_document(outcome: Outcome) -> dict[str, object]:
    """Measured and predicted bead positions of every frame, (column, row) in pixels.

    `before` is the correction in force during the scan, or the nominal geometry; `after` the
    fitted one, null where there is none to be used. Unseen beads are null.
    """
    result = outcome.calibration
    fit = result.fit
    document: dict[str, object] = {"phantom": outcome.phantom.name, "datasets": []}
    if fit is None:
        return document
    corrections = [d.correction for d in outcome.datasets]
    before = predictions(fit, tuple(NOMINAL if c is None else c.parameters for c in corrections))
    after = predictions(fit, fit.group_parameters) if result.identifiable else None
    problem = fit.problem
    measured = np.where(
        problem.seen[..., None], problem.measured + problem.origin[:, None, :], np.nan
    )
    rows: list[dict[str, Any]] = []
    first = 0
    for dataset, correction in zip(outcome.datasets, corrections, strict=True):
        part = slice(first, first + len(dataset))
        first += len(dataset)
        rows.append(
            {
                "dataset": dataset.name,
                "folder": str(dataset.folder),
                "before": "nominal" if correction is None else correction.name,
                "rms_before_px": _rms(measured[part] - before[part]),
                "rms_after_px": None if after is None else _rms(measured[part] - after[part]),
                "frames": [
                    {
                        "file": frame.file,
                        "measured": _pixels(measured[part][i]),
                        "before": _pixels(before[part][i]),
                        "after": None if after is None else _pixels(after[part][i]),
                    }
                    for i, frame in enumerate(dataset.frames)
                ],
            }
        )
    document["datasets"] = rows
    return document


def write_tracks(outcome: Outcome, path: Path) -> None:
    """Write `tracks_document` as JSON, under its final name only when it is whole."""
    temporary = path.with_name(path.name + ".part")
    temporary.write_text(json.dumps(tracks_document(outcome)) + "\n", encoding="utf-8")
    temporary.replace(path)


def _pixels(points: npt.NDArray[np.float64]) -> list[list[float] | None]:
    return [
        [round(c, DIGITS), round(r, DIGITS)] if math.isfinite(c) and math.isfinite(r) else None
        for c, r in points.tolist()
    ]


def _rms(residual: FloatArray) -> float | None:
    """Per coordinate [px], as `flexdt compare` has it."""
    seen = np.isfinite(residual)
    return float(np.sqrt(np.mean(residual[seen] ** 2))) if seen.any() else None
