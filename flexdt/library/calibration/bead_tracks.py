"""Bead positions of a calibration, measured and predicted, frame by frame."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from flexdt.library.calibration.calibrate import Outcome
from flexdt.library.datasets.image_set import ImageSet
from flexdt.runtime.files.whole_files import write_whole
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import from_printed_reading, values_in
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.offsets import NOMINAL, Offsets
from flexdt.twin.geometry.told_lengths import TOLD

TRACK_DECIMALS: Final = 3
"""Decimals of pixel positions in a file of tracks."""


def predictions(fit: FitResult, geometry: Sequence[Offsets]) -> FloatArray:
    """Predict bead positions (n, k, 2) [px] in every frame, also of beads that were not
    seen, with the fitted bead places and panel's distortion.

    Args:
        fit: gives the frames and the beads.
        geometry: offsets of each scan, in the reading of `Poses.cone_vec`.
    """
    problem = fit.problem
    base = [values_in(from_printed_reading(p, fit.reading)) for p in geometry]
    problem = problem.with_base(np.array(base))
    x = problem.start
    first = problem.layout.parameter_count  # then the beads, and the panel's distortion
    x[first:] = fit.solution.x[first:]
    for i, name in enumerate(problem.layout.names[:first]):
        if name.split("@")[0] in TOLD:
            x[i] = fit.solution.x[i]
    return problem.predictions(x, np.ones_like(problem.seen))[0]


def tracks_document(outcome: Outcome[ImageSet]) -> dict[str, object]:
    """Return measured and predicted bead positions of every frame, (column, row) in
    pixels.

    `before` is by the correction in force during the scan, or the nominal geometry;
    `after` by the fitted one, null where it must not be used. Beads that were not seen
    are null in `measured`.

    Args:
        outcome: of a calibration.

    Returns:
        phantom (name), and datasets: for each dataset (name), folder, before (name of the
        correction, or "nominal"), rms_before_px, rms_after_px and frames; of each frame
        file, measured, before and after. No datasets without a fit.
    """
    result = outcome.calibration
    fit = result.fit
    document: dict[str, object] = {"phantom": outcome.phantom.name, "datasets": []}
    if fit is None:
        return document
    corrections = [d.correction for d in outcome.datasets]
    before = predictions(
        fit, tuple(NOMINAL if c is None else c.parameters for c in corrections)
    )
    if result.identifiable:
        after = predictions(fit, fit.group_parameters)
    else:
        after = None
    measured = fit.problem.pixels
    rows: list[dict[str, Any]] = []
    for (dataset, part), correction in zip(outcome.parts, corrections, strict=True):
        rows.append(
            {
                "dataset": dataset.name,
                "folder": dataset.where,
                "before": "nominal" if correction is None else correction.name,
                "rms_before_px": _seen_rms(measured[part] - before[part]),
                "rms_after_px": None
                if after is None
                else _seen_rms(measured[part] - after[part]),
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


def write_tracks(outcome: Outcome[ImageSet], path: Path) -> None:
    """Write `tracks_document` as JSON; the file appears under its name only when complete."""
    write_whole(path, json.dumps(tracks_document(outcome)) + "\n")


def _pixels(points: npt.NDArray[np.float64]) -> list[list[float] | None]:
    """Convert points (k, 2) to [column, row], rounded to `TRACK_DECIMALS`; None for a
    point that was not seen (not finite).
    """
    return [
        [round(c, TRACK_DECIMALS), round(r, TRACK_DECIMALS)]
        if math.isfinite(c) and math.isfinite(r)
        else None
        for c, r in points.tolist()
    ]


def _seen_rms(residual: FloatArray) -> float | None:
    """Return `coordinate_rms`, or None if no bead was seen."""
    if np.isfinite(residual).any():
        return coordinate_rms(residual)
    return None


def coordinate_rms(residual: FloatArray) -> float:
    """Return the root mean square per coordinate [px] over the beads that were seen."""
    return float(np.sqrt(np.nanmean(residual**2)))
