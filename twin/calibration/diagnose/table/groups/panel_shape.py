"""Panel: it distorts its picture smoothly."""

from __future__ import annotations

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

NAME: Final = "panel"
WORDS: Final = "a panel that distorts"


def families(table: Linearised, known: Known) -> Iterator[Family]:
    """Make the panel's polynomials; none for images of several shapes."""
    layout = table.problem.layout
    columns = np.arange(layout.panel_column, len(layout.names))
    if len(columns):
        rows = table.columns[None, :, columns]
        yield Family(NAME, (NAME,), Acts.COLUMNS, (columns,), LOG_CHANCE, rows)


def told(found: Found) -> list[Finding]:
    """Tell the panel's largest shift along an axis [px], on a grid of 9 x 9 points, and where
    each tile begins.
    """
    panel = found.fit.panel
    if panel is None or not (found.of(NAME) or found.of("tiles")):
        return []
    rows, cols = panel.model.shape
    row, column = np.mgrid[0 : rows - 1 : 9j, 0 : cols - 1 : 9j]
    size = float(np.abs(panel.shift(np.stack([column, row], axis=-1))).max())
    borders = "".join(
        f"; a tile begins at {('column', 'row')[b.axis]} {b.at:.0f}"
        for b in panel.model.borders
    )
    return [
        warning(
            CalibrationCode.PANEL_DISTORTED,
            f"the panel distorts its picture by up to {size:.2f} px{borders}: this was "
            "estimated along with the geometry, its uncertainty is in every sigma, "
            "and reconstruct undoes it with the correction",
        )
    ]
