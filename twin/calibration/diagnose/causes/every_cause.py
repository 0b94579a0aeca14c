"""Every cause of a table: its columns, the widths to try, and how probable it is before."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from flexdt.twin.calibration.diagnose.causes.cause import (
    MOTION_OF,
    REPEATING,
    SHAPES,
    TOLD,
    Cause,
    Known,
    border_name,
)
from flexdt.twin.calibration.diagnose.tiles import GAP_WIDTHS_PX
from flexdt.twin.calibration.fit.problem import (
    ARC_PRIOR,
    ROWS_PRIOR,
    STRETCHES,
    FitProblem,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.machine.stated_causes import TOLD_RIVALS

STATED_LOG_CHANCE: Final = math.log(0.5)
"""The same for a cause that the script states: images may be made of instants; assumed."""
ARC_TOLERANCE: Final = 0.2
"""Relative standard deviation of the squared share of a step that the script states: the
trigger's place in the exposure is not published; assumed."""
STRAIN_WIDTHS: Final = (1e-3, 2.5e-3, 6e-3, 1.5e-2, 4e-2)
BEAD_SHARES: Final = tuple(2e-4 * 2.0**k for k in range(8))
"""Widths of the beads' places as parts of the phantom's size."""
PANEL_WIDTHS_PX: Final = tuple(0.004 * 2.5**k for k in range(9))
MOTION_WIDTHS: Final = (1.0, 4.0, 16.0, 64.0)
"""Widths of a motion, in standard deviations of its estimate."""
PRIOR_FACTORS: Final = (3.0, 10.0)
PRIOR_LOG_CHANCE: Final = math.log(1e-3)
"""Logarithm of the probability that the scanner is so many times further off than stated;
assumed."""
STATED: Final = (
    ("tile", "gap"),
    ("panel", "distortion"),
    ("stretch", "shape"),
    ("shear", "shape"),
    ("beads", "beads"),
    ("arc", "arc"),
    ("rows", "rows"),
    (f"{MOTION_OF}alpha", "angles"),
    (MOTION_OF, "motion"),
    (REPEATING, "spots"),
    (TOLD, TOLD_RIVALS),
)
"""Begin of a cause's name, and the name by which it is stated; the first counts."""
SAME_UNIT: Final = ("gap", "distortion", "shape", "beads")
"""Stated causes whose widths here have the stated unit."""
TOLD_WIDTHS: Final = (5e-3, 2e-2, 5e-2)
"""Widths of a told length that is quite another, over the told one; of a place over the SOD."""
REPEATING_WIDTHS: Final = (0.1, 0.2, 0.4, 0.8, 1.6)
"""Widths of a wave of such errors, in standard deviations of a position."""


def list_causes(
    everything: FitProblem,
    known: Known,
    noise: float,
    motions: Mapping[str, FloatArray],
    repeating: int,
    chances: Sequence[float],
    told: Sequence[str] = (),
) -> tuple[Cause, ...]:
    """List the causes of a table: shape, beads, arc, rows, panel, borders, motion, errors of
    spots, told lengths and priors, in this order.

    Exact beads have no cause of shape or position, a stage at rest none of arc or rows;
    beads need three at least; panel and borders only where the problem has a panel.
    Only widths above 1.5 times the stated one are tried.

    Args:
        everything: problem with a column for each cause but motions and errors of spots.
        known: statements on the phantom and the positions.
        noise: standard deviation of whitened residuals.
        motions: their columns, which follow.
        repeating: number of columns of errors of spots, which follow; 0: no cause.
        chances: logarithm of each border's probability before the scan is seen.
        told: lengths that may be quite others (`columns.told_columns`), the last columns.

    Returns:
        Causes with their columns, the widths to try, and a width that always holds.
    """
    layout = everything.layout
    first = len(layout.names)
    last = first + sum(m.shape[1] for m in motions.values()) + repeating
    sod = float(np.median(everything.poses.sod))
    listed = (
        *_of_phantom(everything, known),
        *_arc(layout.arc_column, known),
        *_rows(layout.rows_column, known.arc),
        *_of_panel(everything, chances),
        *_motions(first, noise, motions),
        *_repeating(first + sum(m.shape[1] for m in motions.values()), noise, repeating),
        *(
            Cause(
                TOLD + name,
                (last + i,),
                tuple(
                    w * (sod if name.startswith("place") else 1.0) for w in TOLD_WIDTHS
                ),
            )
            for i, name in enumerate(told)
        ),
        Cause("priors", (), PRIOR_FACTORS, PRIOR_LOG_CHANCE),
    )
    return tuple(_limited(cause, known.limits) for cause in listed)


def _limited(cause: Cause, limits: Mapping[str, float]) -> Cause:
    """Return a cause with the widths up to a stated limit; of a size that is stated in
    another unit than its columns', only 0 is one.
    """
    name = next((stated for begin, stated in STATED if cause.name.startswith(begin)), "")
    limit = limits.get(name)
    if limit is None or (limit > 0.0 and name not in SAME_UNIT):
        return cause
    widths = tuple(width for width in cause.widths if width <= limit)
    if limit > 0.0 and cause.widths and not widths:
        widths = (limit,)
    return replace(cause, widths=widths)


def _of_phantom(everything: FitProblem, known: Known) -> list[Cause]:
    """Make the causes of a phantom of another shape, and of beads elsewhere; empty for exact
    beads.
    """
    if known.bead_tolerance_mm == 0:
        return []
    out = []
    layout = everything.layout
    first = layout.strain_columns.start
    last = layout.strain_columns.stop
    parts = range(first, first + STRETCHES), range(first + STRETCHES, last)
    for name, part, stated in zip(SHAPES, parts, known.strain, strict=True):
        widths = tuple(w for w in STRAIN_WIDTHS if w > 1.5 * stated)
        out.append(Cause(name, tuple(part), widths, always=stated))
    k = len(everything.model)
    if 3 * k - 7 >= 2:  # less a rigid motion and a scale
        size = float(np.ptp(everything.model.beads, axis=0).max())
        stated = known.bead_tolerance_mm or 0.0
        widths = tuple(w for s in BEAD_SHARES if (w := s * size) > 1.5 * stated)
        columns = tuple(range(layout.bead_columns.start, layout.bead_columns.stop))
        out.append(Cause("beads", columns, widths, always=stated))
    return out


def _arc(column: int, known: Known) -> list[Cause]:
    """Make the cause that the object turns while a frame is exposed.

    Args:
        column: of the squared share of a step.
        known: of the arc, by the script and by the spots' smear.

    Returns:
        One cause; more probable before the scan, and narrow, if stated. Where smear was
        measured it tells the arc, and what it leaves holds always. Empty for a share of 0.
    """
    share = known.arc
    if known.arc_left is not None:
        return [Cause("arc", (column,), (), always=known.arc_left)]
    if share is None:
        return [Cause("arc", (column,), (ARC_PRIOR,))]
    if share == 0.0:
        return []
    return [Cause("arc", (column,), (ARC_TOLERANCE * share**2,), STATED_LOG_CHANCE)]


def _rows(column: int, share: float | None) -> list[Cause]:
    """Make the cause that the object turns while rows are read; empty for a stage at rest.

    Args:
        column: of the share of a step between the first row and the last.
        share: of a step in an exposure, by the script; None: not stated.
    """
    return [] if share == 0.0 else [Cause("rows", (column,), (ROWS_PRIOR,))]


def _of_panel(everything: FitProblem, chances: Sequence[float]) -> list[Cause]:
    """Make the causes that the panel distorts, and of each border; empty without a panel.

    Args:
        everything: problem with a column for each term of the panel.
        chances: logarithm of each border's probability before the scan is seen.
    """
    panel = everything.panel
    if panel is None:
        return []
    first = everything.layout.panel_column
    edge = first + len(panel.names) - 2 * len(panel.borders)
    out = [Cause("panel", tuple(range(first, edge)), PANEL_WIDTHS_PX)]
    for border, chance in zip(panel.borders, chances, strict=True):
        out.append(Cause(border_name(border), (edge, edge + 1), GAP_WIDTHS_PX, chance))
        edge += 2
    return out


def _motions(first: int, noise: float, motions: Mapping[str, FloatArray]) -> list[Cause]:
    """Make the causes that something moves, of columns from `first` on."""
    widths = tuple(w * noise for w in MOTION_WIDTHS)
    out = []
    for name, own in motions.items():
        last = first + own.shape[1]
        out.append(Cause(name, tuple(range(first, last)), widths))
        first = last
    return out


def _repeating(first: int, noise: float, count: int) -> list[Cause]:
    """Make the cause of errors of spots, of `count` columns from `first` on; empty without
    columns.
    """
    widths = tuple(w * noise for w in REPEATING_WIDTHS)
    columns = tuple(range(first, first + count))
    return [Cause(REPEATING, columns, widths)] if count else []
