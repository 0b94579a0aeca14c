"""Arc: the object turns while a frame is exposed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.measured_spots import exposure_arc
from flexdt.twin.calibration.diagnose.table.group import (
    LOG_CHANCE,
    Acts,
    Family,
    Found,
    Known,
)
from flexdt.twin.calibration.diagnose.table.linearised import Linearised
from flexdt.twin.calibration.fit.problem import usual_step
from flexdt.twin.findings import Finding

NAME: Final = "arc"
WORDS: Final = "a stage that turns while a frame is exposed"
STATED_LOG_CHANCE: Final = math.log(0.5)
"""The same where the script states it: images may be made of instants; assumed."""
WIDEST: Final = 1.0
"""Of the squared share of a step that an exposure lasts."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make the arc; where the spots' smear was measured, what that leaves always holds. None
    for a stage at rest.
    """
    column = np.array([table.problem.layout.arc_column])
    rows = table.columns[None, :, column]
    if known.arc_left is not None:
        if known.arc_left > 0:
            yield Family(
                NAME, ("arc as measured",), Acts.COLUMNS, (column,), 0.0, rows,
                always=known.arc_left,
            )  # fmt: skip
        return
    if known.arc == 0.0:
        return
    chance = LOG_CHANCE if known.arc is None else STATED_LOG_CHANCE
    yield Family(NAME, (NAME,), Acts.COLUMNS, (column,), chance, rows, widest=WIDEST)


def told(found: Found) -> list[Finding]:
    """Tell the arc [deg], and its share of a step; a negative square counts as 0."""
    if not found.of(NAME):
        return []
    problem = found.fit.problem
    square = float(found.fit.solution.x[problem.layout.arc_column])
    share = math.sqrt(max(square, 0.0))
    step = math.degrees(usual_step(problem.poses.angle))
    return [exposure_arc(share * step, share, "the mean of the arc was fitted")]
