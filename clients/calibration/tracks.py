"""Table of the bead positions that a calibration measured and those that the geometry before and
after it predicts: pixels of every frame with their residuals, to draw over the radiographs."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.clients.calibration.calibrate import Outcome
from flexdt.clients.whole_files import write_whole
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import from_printed_reading, values_in
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets

DIGITS: Final = 3


def predictions(fit: FitResult, geometry: Sequence[Offsets]) -> FloatArray:
    """Predicted bead positions (n, k, 2) [px] in every frame, also of beads that were not seen.

    Args:
        fit: gives the frames and the beads.
        geometry: offsets of each scan, in the reading of `Poses.cone_vec`.
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
    measured = fit.problem.pixels
    rows: list[dict[str, Any]] = []
    for (dataset, part), correction in zip(outcome.parts, corrections, strict=True):
        rows.append(
            {
                "dataset": dataset.name,
                "folder": dataset.where,
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
    write_whole(path, json.dumps(tracks_document(outcome)) + "\n")


def _pixels(points: npt.NDArray[np.float64]) -> list[list[float] | None]:
    return [
        [round(c, DIGITS), round(r, DIGITS)] if math.isfinite(c) and math.isfinite(r) else None
        for c, r in points.tolist()
    ]


def _rms(residual: FloatArray) -> float | None:
    """Per coordinate [px], as `flexdt compare` has it."""
    seen = np.isfinite(residual)
    return float(np.sqrt(np.mean(residual[seen] ** 2))) if seen.any() else None
