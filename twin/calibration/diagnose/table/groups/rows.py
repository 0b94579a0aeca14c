"""Rows: the object turns while the rows of a frame are read."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose import CalibrationCode
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.fit.problem import usual_step
from flexdt.twin.findings import Finding, warning

NAME: Final = "rows"
WORDS: Final = "a stage that turns while the rows of a frame are read"
WIDEST: Final = 1.0
"""Of the share of a step between the first row and the last."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make the turn between rows; none for a stage at rest."""
    if known.arc == 0.0:
        return
    column = np.array([table.problem.layout.rows_column])
    yield Family(
        NAME, (NAME,), Acts.COLUMNS, (column,), LOG_CHANCE, table.columns[None, :, column],
        widest=WIDEST,
    )  # fmt: skip


def told(found: Found) -> list[Finding]:
    """Tell the turn from the first row of a frame to the last [deg], and its share of a step."""
    if not found.of(NAME):
        return []
    problem = found.fit.problem
    share = float(found.fit.solution.x[problem.layout.rows_column])
    step = math.degrees(usual_step(problem.poses.angle))
    first, last = ("first", "last") if share > 0.0 else ("last", "first")
    return [
        warning(
            CalibrationCode.ROWS_IN_TURN,
            "a frame's rows are read one after another while the object turns: by "
            f"{abs(share) * step:.2g} deg, {abs(share):.2f} of a step, from the {first} row to "
            f"the {last} (or the phantom is twisted so, which looks alike). It was fitted, and "
            "angles are those of the middle row; volumes of such scans are twisted by as much: "
            "stop the stage for each frame, or expose all rows at once",
        )
    ]
