"""Columns of a table of causes: image shifts of all that may move, and spots' errors."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.linalg import lapack

from flexdt.twin.calibration.diagnose.causes.cause import APART, MOTION_OF
from flexdt.twin.calibration.fit.fitted_motion import derivative
from flexdt.twin.calibration.fit.problem import (
    STRAINS,
    ColumnLayout,
    FitProblem,
    panel_heights,
    turning_shifts,
)
from flexdt.twin.calibration.fit.residual_structure import (
    HARMONICS,
    MIN_MOVING_FRAMES,
    MOVING,
)
from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border, PanelModel
from flexdt.twin.geometry.told_lengths import PANEL_TRAVEL, PHANTOM, TRAVEL

LEAST_VISIBLE: Final = 1e-3
"""Part of a motion that the geometry must leave, for it to be told."""
WAVES: Final = 8
"""Number of shapes of a motion here: a ramp, and half waves in a scan."""


def coordinates(beads: Iterable[int]) -> npt.NDArray[np.intp]:
    """Return the numbers of the coordinates of beads, (3 beads,), among those of all."""
    return np.array([3 * bead + axis for bead in beads for axis in range(3)], np.intp)


def motion_columns(
    problem: FitProblem, x: FloatArray, use: npt.NDArray[np.bool_]
) -> dict[str, FloatArray]:
    """Compute the image shifts of everything that may move: each free parameter of
    MOVING in each scan of `MIN_MOVING_FRAMES` frames or more, as a ramp and as one to
    `WAVES` - 1 half waves, and one that scans share from scan to scan.

    Args:
        problem: of the geometry's fit.
        x: its column values.
        use: (n, k) positions that count.

    Returns:
        Name of the cause -> (2 x seen positions, columns) of unit length.
    """
    n, k = use.shape
    seen = np.repeat(use.ravel(), 2)
    scans = [np.flatnonzero(problem.group == g) for g in range(problem.group.max() + 1)]
    free = problem.layout.names[: problem.layout.parameter_count]
    shared = frozenset(free)
    bases = {name.split("@")[0] for name in free}
    out: dict[str, FloatArray] = {}
    for name in MOVING:
        if name not in bases:
            continue
        slope = derivative(problem, x, name, use).reshape(n, 2 * k)
        some = {}
        for scan, frames in enumerate(scans):
            if len(frames) >= MIN_MOVING_FRAMES:
                where = f" in scan {scan + 1}" if len(scans) > 1 else ""
                some[where] = _waves(frames, n)
        # Scans that stand apart have told places, with a prior of their own.
        placed = f"{name.replace('dO', 'place')}@0" in shared
        if len(scans) > 1 and name in shared and not placed:
            some[APART] = np.equal.outer(problem.group, range(len(scans)))
        for where, shapes in some.items():
            columns = (slope[:, :, None] * shapes[:, None]).reshape(2 * n * k, -1)
            columns = columns[seen]
            length = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
            out[MOTION_OF + name + where] = columns / length
    return out


def repeating_columns(problem: FitProblem, use: npt.NDArray[np.bool_]) -> FloatArray:
    """Compute errors of a bead's positions, across or down, as waves in the angle up to
    `HARMONICS` in a turn.

    The first wave has a standard deviation of a position, the others are smaller by
    their number, as of what is smooth.

    Args:
        problem: of the geometry's fit.
        use: (n, k) positions that count.

    Returns:
        (2 x seen positions, columns).
    """
    n, k = use.shape
    number = np.arange(HARMONICS + 1)
    turn = problem.poses.angle[:, None] * number
    size = 1.0 / np.maximum(number, 1)
    waves = np.concatenate([size * np.cos(turn), size[1:] * np.sin(turn[:, 1:])], axis=1)
    own = np.einsum("nw,bc->nbwc", waves, np.eye(2 * k))
    rows = own.reshape(n * 2 * k, -1)
    return np.asarray(rows[np.repeat(use.ravel(), 2)])


def told_columns(problem: FitProblem) -> list[str]:
    """List the columns of told lengths that may be quite others: ways, the places of three or
    more scans, and the phantom's scale beside one of them.

    Without a way nothing in the images tells the phantom's scale.
    """
    names = problem.layout.names[: problem.layout.parameter_count]
    lengths = [n for n in names if n in (*TRAVEL, *PANEL_TRAVEL)]
    if problem.group.max(initial=0) > 1:
        lengths += [n for n in names if n.split("@")[0] == "place_z"]
    if lengths and PHANTOM in names:
        lengths.append(PHANTOM)
    return lengths


def visible_shares(
    gram: FloatArray, prior_weight: FloatArray, first: int, last: int
) -> FloatArray:
    """Compute which part of each column's length widths are meant for: of a motion,
    what the geometry leaves of it, `LEAST_VISIBLE` at least.

    Over a part of a turn, or in a helix, an even drift is almost an object that
    stands elsewhere, or a panel and an axis that roll: what is seen of it is little
    beside what it is.

    Args:
        gram: (q, q) products of the columns, those of the geometry first.
        prior_weight: (p,) of the geometry's columns, in units of `gram`.
        first: column of a motion.
        last: column after those of motions.

    Returns:
        (q,), 1 for other columns than motions.
    """
    count = len(prior_weight)
    own = slice(0, count)
    out = np.ones(len(gram))
    inside = gram[own, own].copy()
    inside.flat[:: count + 1] += prior_weight
    scale = 1.0 / np.sqrt(np.maximum(np.diag(inside), 1e-300))
    factor, failed = lapack.dpotrf(inside * np.outer(scale, scale), lower=1)
    if failed or first == last:  # Columns that nothing tells apart hide no more.
        return out
    push = scale[:, None] * gram[own, first:last]
    taken = np.square(lapack.dtrtrs(factor, push, lower=1)[0]).sum(axis=0)
    power = np.maximum(np.diag(gram)[first:last], 1e-300)
    out[first:last] = np.sqrt(np.maximum(1.0 - taken / power, LEAST_VISIBLE**2))
    return out


def _waves(frames: npt.NDArray[np.intp], count: int) -> FloatArray:
    """Make the shapes of a motion: a ramp, and one to `WAVES` - 1 half waves.

    Args:
        frames: of a scan, in their order.
        count: of all frames.

    Returns:
        (count, WAVES), 0 in the frames of other scans.
    """
    place = (np.arange(len(frames)) + 0.5) / len(frames)
    out = np.zeros((count, WAVES))
    out[frames] = np.cos(math.pi * place[:, None] * np.arange(WAVES))
    out[frames, 0] = place - 0.5
    return out


def panel_of(problem: FitProblem, borders: Sequence[Border]) -> PanelModel | None:
    """Make a panel model with every term that a distortion may have, of width 1 px, and
    the given borders; None for images of several shapes.
    """
    shape = image_shape(problem)
    if shape is None:
        return None
    return PanelModel(1.0, shape, tuple(borders))


def image_shape(problem: FitProblem) -> tuple[int, int] | None:
    """Return (rows, cols) of the images; None where frames differ."""
    sizes = np.unique(2 * problem.origin + 1, axis=0)
    if len(sizes) == 1:
        return (int(sizes[0, 1]), int(sizes[0, 0]))
    return None


def with_every_column(
    problem: FitProblem, x: FloatArray, panel: PanelModel | None
) -> tuple[FitProblem, FloatArray]:
    """Add a column for every cause to a problem.

    Layout: the fit's parameters, beads, strain, arc, rows, panel; all beads are free.

    Args:
        problem: of the fit; not changed.
        x: (c,) its column values.
        panel: terms of distortion, or None.

    Returns:
        The problem, and values of all columns: those of the fit, and the problem's start
        for those that it does not have.
    """
    old = problem.layout
    count = old.parameter_count
    k = len(problem.model)
    terms = () if panel is None else panel.names
    names = [
        *old.names[:count],
        *(f"bead {b} {axis}" for b in range(k) for axis in "xyz"),
        *(f"strain {term}" for term in STRAINS),
        "arc",
        "rows",
        *(f"panel {term}" for term in terms),
    ]
    strain = count + 3 * k
    arc = strain + len(STRAINS)
    layout = ColumnLayout(
        tuple(names),
        old.asked,
        old.colmap,
        count,
        strain,
        arc,
        arc + 1,
        count,
        arc + 2,
        old.active,
        old.held,
    )
    base, beads = problem.spread(x)
    rows = panel_heights(problem.measured, problem.origin)
    whole = replace(
        problem,
        layout=layout,
        panel=panel,
        base=base,
        turning=turning_shifts(
            problem.poses, beads, base, problem.group, problem.reading, rows
        ),
    )
    there = whole.start
    places = {name: i for i, name in enumerate(names)}
    for name, value in zip(old.names, x.tolist(), strict=True):
        if name in places:
            there[places[name]] = value
    return whole, there
