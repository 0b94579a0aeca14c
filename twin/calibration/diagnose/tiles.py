"""Where a tile of the panel begins: the border through which the residuals are parted best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np
import numpy.typing as npt

from flexdt.twin.geometry.conventions import FloatArray
from flexdt.twin.geometry.panel import Border

GAP_WIDTHS_PX: Final = (0.1, 0.5, 2.0, 8.0)
"""Standard deviations of a tile's shift that are tried."""
LEAST_TILE: Final = 1 / 8
"""Part of the panel's rows or columns that a tile has at least; assumed."""
LEAST_SIDE: Final = 4
"""Positions that a tile shows at least."""


def likely_border(
    rows: FloatArray,
    values: FloatArray,
    widths: FloatArray,
    noise: float,
    places: FloatArray,
    whiten: FloatArray,
    shape: tuple[int, int],
    known: Sequence[Border],
) -> Border | None:
    """Find the border whose shift explains most of the residuals that the columns leave.

    A border is one between two panel tiles, along columns or rows; it leaves every tile
    `LEAST_TILE` of the panel and `LEAST_SIDE` positions on either side.

    Args:
        rows: (2 m, c) of the columns.
        values: (2 m,) to be explained.
        widths: (c,) of the columns' priors; inf: none.
        noise: standard deviation of the values.
        places: (m, 2) predicted column and row of each position; by measured ones, a
            border would part the positions of a bead that keeps its row by their noise.
        whiten: (m, 3) of the positions.
        shape: (rows, cols) of the image.
        known: borders found before.

    Returns:
        The border, halfway between two positions; None if its gain is no more than chance
        gives among all rows and columns.
    """
    m = len(places)
    weight = np.where(np.isinf(widths), 0.0, noise / widths)
    size = np.sqrt(np.einsum("mc,mc->c", rows, rows) + weight**2)
    size = np.where(size > 0, size, 1.0)
    table = np.concatenate([rows / size, np.diag(weight / size)])
    basis = np.linalg.qr(table)[0][: 2 * m]
    left = values - basis @ (basis.T @ values)
    # Rows of a shift by a column, and by a row.
    across = np.stack([whiten[:, 0], np.zeros(m)], axis=1).ravel()
    down = np.stack([whiten[:, 1], whiten[:, 2]], axis=1).ravel()
    best = None
    most = -math.inf
    for axis in (0, 1):
        order = np.argsort(-places[:, axis], kind="stable")
        both = (2 * order[:, None] + [0, 1]).ravel()
        push = []
        inside = []
        for shift in (across, down):
            push.append(np.cumsum((shift * left)[both])[1::2])
            inside.append(np.cumsum(shift[both, None] * basis[both], axis=0)[1::2])
        gram = np.empty((m, 2, 2))
        for i, one in enumerate((across, down)):
            for j, other in enumerate((across, down)):
                whole = np.cumsum((one * other)[both])[1::2]
                gram[:, i, j] = whole - np.einsum("mc,mc->m", inside[i], inside[j])
        pushed = np.stack(push, axis=1)
        bend = np.maximum(np.einsum("mii->mi", gram), 1e-12)
        unit = gram / np.sqrt(bend[:, :, None] * bend[:, None, :]) + 1e-6 * np.eye(2)
        scaled = pushed / np.sqrt(bend)
        gain = np.einsum(
            "mi,mi->m", scaled, np.linalg.solve(unit, scaled[..., None])[..., 0]
        )
        at = places[order, axis]
        between = np.append(0.5 * (at[:-1] + at[1:]), 0.0)
        usable = _allowed(
            between, shape[1 - axis], [b.at for b in known if b.axis == axis]
        )
        usable[: LEAST_SIDE - 1] = False
        usable[m - LEAST_SIDE :] = False
        gain = np.where(usable, gain, -math.inf)
        top = int(np.argmax(gain))
        if gain[top] > most:
            best = Border(axis, float(between[top]))
            most = float(gain[top])
    places_tried = math.log(sum(shape))
    if 0.5 * most / noise**2 > places_tried:
        return best
    return None


def alike_places(border: Border, places: FloatArray, shape: tuple[int, int]) -> float:
    """Return the share of all borders that part the positions as one does.

    Where no position is between two borders, both explain the same; together they are as
    probable as the stretch is long.

    Args:
        border: along columns or rows.
        places: (m, 2) column and row of each position.
        shape: (rows, cols) of the image.

    Returns:
        The stretch between the positions next to the border, a pixel at least, over all
        rows and columns.
    """
    side = shape[1 - border.axis]
    at = np.append(places[:, border.axis], [0.0, side])
    before = float(at[at <= border.at].max())
    behind = float(at[at > border.at].min())
    return max(behind - before, 1.0) / sum(shape)


def _allowed(at: FloatArray, side: int, known: Sequence[float]) -> npt.NDArray[np.bool_]:
    """Mark borders that leave every panel tile its least width (`LEAST_TILE`): from the
    ends of a side and from the known borders.

    Args:
        at: (m,) places along the side [px].
        side: length of the side [px].
        known: places of borders on this axis.

    Returns:
        (m,) bool.
    """
    least = LEAST_TILE * side
    out = (at > least) & (at < side - least)
    for other in known:
        out &= np.abs(at - other) > least
    return np.asarray(out)
