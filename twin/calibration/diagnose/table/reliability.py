"""Reliability of the network: what a scan cannot show, and what that would do to its geometry.

A cause that no residual shows may be there all the same, too small to be told. As Baarda does for
the gross error of a measurement (A testing procedure for use in geodetic networks, 1968), this
computes of each group of columns the smallest size that is told (internal reliability), and what
one of that size does to a fit without it (external reliability). Both follow from columns and
noise alone.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.special import betaincinv

from flexdt.twin.calibration.diagnose.table.group import NEVER
from flexdt.twin.calibration.diagnose.table.groups import CAUSES, panel_shape, tiles
from flexdt.twin.calibration.diagnose.table.posterior import (
    GRID,
    OCCAM,
    Further,
    Model,
    Search,
)
from flexdt.twin.calibration.fit.certificate import Hidden
from flexdt.twin.calibration.fit.fit import FitResult
from flexdt.twin.calibration.fit.problem import edge_factors
from flexdt.twin.geometry.conventions import FloatArray

LEVEL: Final = 0.95
"""Part of the directions of a cause of several columns that do no more than is stated."""
HALVINGS: Final = 20
"""Of the interval in which the smallest width is sought, in its logarithm."""
OF_PANEL: Final = (tiles.NAME, panel_shape.NAME)
"""Causes that may shift all pixels alike, which is no change: where a panel is by its pixels is
where most of them are."""


def hidden_causes(
    search: Search, model: Model, further: Mapping[int, Further], fit: FitResult
) -> tuple[Hidden, ...]:
    """List what each cause could hide that a model does not have.

    Args:
        search: of the table.
        model: that explains it.
        further: what groups would add to it.
        fit: with the model's groups.

    Returns:
        Of each cause the group that could hide the most of the axis, and that of lengths; those
        that could hide the most of the axis first.
    """
    if not further:
        return ()
    families = search.products.families
    groups = [(f, g) for f, one in further.items() for g in range(len(one.values))]
    counts = np.array(
        [one.values.shape[1] for f, one in further.items() for _ in one.values]
    )
    first = np.cumsum(counts) - counts
    chances = np.concatenate([families[f].chances for f in further])
    widest = np.concatenate([search.products.widest(f) for f in further])
    values = np.concatenate([one.values.ravel() for one in further.values()])
    widths, detected = _smallest(
        values, first, chances + OCCAM, widest / math.sqrt(model.noise2)
    )
    # What one standard deviation of each column does: by columns, scans and quantities.
    images = _image_slopes(fit) / math.sqrt(model.noise2)
    does = (
        np.concatenate(
            [one.taken.reshape(-1, images.shape[2]) for one in further.values()]
        )
        @ images.reshape(-1, images.shape[2]).T
    )
    slopes = does.reshape(len(does), *images.shape[:2])
    at = 0
    for f, one in further.items():
        if families[f].cause in OF_PANEL:
            shift = _mean_shift(search, f) * math.sqrt(model.noise2)
            slopes[at : at + len(shift), :, 0] -= shift[:, None]
        at += one.values.size
    effect = np.sqrt(np.add.reduceat(slopes**2, first)).max(axis=1)
    effect *= (widths * np.array([_reach(count) for count in counts.tolist()]))[:, None]
    effect[chances <= NEVER] = 0.0
    effect[[i for i, group in enumerate(groups) if group in model.widths]] = 0.0
    causes = np.array([families[f].cause for f, _ in groups])
    chosen: set[int] = set()
    for cause in dict.fromkeys(causes.tolist()):
        own = np.flatnonzero(causes == cause)
        chosen |= {int(i) for i in own[effect[own].argmax(axis=0)] if effect[i].any()}
    words = {cause.name: cause.words for cause in CAUSES}
    rows = [
        Hidden(
            words[causes[i]],
            families[groups[i][0]].names[groups[i][1]],
            _shift_px(search, *groups[i]) * float(widths[i]) * math.sqrt(model.noise2),
            bool(detected[i]),
            *effect[i].tolist(),
        )
        for i in chosen
    ]
    return tuple(sorted(rows, key=lambda row: (-row.axis_px, row.group)))


def _smallest(
    values: FloatArray, first: npt.NDArray[np.intp], odds: FloatArray, widest: FloatArray
) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Find the smallest width of each group at which the evidence that is expected of weights so
    wide outweighs the odds against it; the largest that it may have if that is less.

    Args:
        values: (m,) eigenvalues of the groups' columns, one group after another.
        first: number of each group's first one.
        odds: logarithm, of each before the scan is seen.
        widest: of each, in standard deviations of a position.

    Returns:
        Widths in standard deviations of a position, and whether each is detected.
    """
    counts = np.diff(np.append(first, len(values)))

    def told(log_width: FloatArray) -> npt.NDArray[np.bool_]:
        # The non-centrality along each eigenvector; the sum is Kullback and Leibler's divergence.
        seen = values * np.repeat(np.exp(2.0 * log_width), counts)
        return np.asarray(
            0.5 * np.add.reduceat(seen - np.log1p(seen), first) + odds > 0.0
        )

    high = np.log(np.minimum(widest, GRID[-1]))
    low = np.minimum(high, math.log(GRID[0])) - math.log(10.0)
    detected = told(high)
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        there = told(middle)
        low, high = np.where(there, low, middle), np.where(there, middle, high)
    return np.exp(high), detected


@cache
def _reach(count: int) -> float:
    """Return by how much so many weights, whose squares have a mean of 1, move a quantity, in
    lengths of its slopes, in `LEVEL` of their directions.
    """
    if count == 1:
        return 1.0
    return math.sqrt(count * float(betaincinv(0.5, 0.5 * (count - 1), LEVEL)))


def _image_slopes(fit: FitResult) -> FloatArray:
    """Return the derivatives of axis column [px] and relative magnification by the columns of the
    geometry, internal units, (scans, 2, p).
    """
    layout = fit.problem.layout
    factor = edge_factors(layout.names[: layout.parameter_count])
    each = fit.image_slopes
    return np.array([[s[0] * factor, s[2] * factor / value[2]] for value, s in each])


def _mean_shift(search: Search, f: int) -> FloatArray:
    """Return by how much the columns of a family, (g c,), in units, shift the spots along the
    rows, in the mean [px].
    """
    table = search.table
    rows = search.products.families[f].rows
    assert rows is not None
    shift = table.shift_of(np.moveaxis(rows, 1, 0))[:, :, 0].sum(axis=(0, 1))
    shift = shift / search.products.units[f][:, None]
    return np.asarray(shift.ravel() / max(int((table.weight > 0).sum()), 1))


def _shift_px(search: Search, f: int, g: int) -> float:
    """Return the root mean square shift of the spots that a group moves, at a width of 1 [px]."""
    columns = search.products.rows(f, g) / search.products.units[f][g]
    square = (search.table.shift_of(columns) ** 2).sum(axis=(2, 3))
    return math.sqrt(float(square.sum()) / max(int((square > 0.0).sum()), 1))
