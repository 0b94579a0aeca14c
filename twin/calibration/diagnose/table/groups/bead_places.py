"""Beads elsewhere: all of them a little, or one by more."""

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
from flexdt.twin.findings import Finding, warning

NAME: Final = "beads"
WORDS: Final = "beads elsewhere"
ALL: Final = "beads"
MOST_STRAINED: Final = 4
"""Number of beads of which every displacement is an affine map, of twelve numbers."""
LARGEST_SHARE: Final = 3e-2
"""Largest standard deviation of beads' places, as a part of the phantom's size."""


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make the places of all beads, as the request states them or as wide as the images say,
    and of each bead; none for exact beads, or too few to tell.
    """
    k = table.k
    if known.bead_tolerance_mm == 0 or 3 * k - 7 < 2:  # less a rigid motion and a scale
        return
    columns = np.arange(
        table.problem.layout.bead_columns.start, table.problem.layout.bead_columns.stop
    )
    rows = table.columns[None, :, columns]
    size = float(np.ptp(table.problem.model.beads, axis=0).max())
    widest = LARGEST_SHARE * size
    if known.bead_tolerance_mm:
        yield Family(
            NAME, ("beads as stated",), Acts.COLUMNS, (columns,), 0.0, rows,
            always=known.bead_tolerance_mm,
        )  # fmt: skip
    if k <= MOST_STRAINED:
        widest = min(widest, table.problem.model.tolerance_mm or widest)
    yield Family(NAME, (ALL,), Acts.COLUMNS, (columns,), LOG_CHANCE, rows, widest=widest)
    each = columns.reshape(k, 3)
    yield Family(
        NAME,
        tuple(f"bead {b}" for b in range(k)),
        Acts.COLUMNS,
        tuple(each),
        LOG_CHANCE - math.log(k),
        np.ascontiguousarray(table.columns[:, each].transpose(1, 0, 2)),
        widest=size,
    )


def told(found: Found) -> list[Finding]:
    """Tell which bead is elsewhere, or how far all are off their model."""
    out = []
    moved = np.linalg.norm(found.fit.beads - found.fit.problem.model.beads, axis=1)
    seen = found.of(NAME)
    single = sorted(b for s in seen for b in [s.place_number] if b is not None)
    if single:
        far = 1000 * float(moved[single].max())
        out.append(
            warning(
                CalibrationCode.BEAD_DISPLACED,
                f"bead {', '.join(map(str, single))} is not where the phantom's model has it, by "
                f"up to {far:.0f} um: its place was fitted, too",
            )
        )
    if any(s.name == ALL for s in seen):
        out.append(
            warning(
                CalibrationCode.BEAD_TOLERANCE,
                f"the beads lie {1000 * float(moved.max()):.0f} um off their model at most; "
                "their positions were fitted too (prior "
                f"{1000 * found.fit.bead_prior_mm:.0f} um): wider intervals",
            )
        )
    return out
