"""A table of numbers as colours, for the pages of studies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from flexdt.clients.figures import axes_of, blank, cell_text, svg


def heat_map(
    values: npt.ArrayLike,
    rows: Sequence[str],
    columns: Sequence[str],
    *,
    title: str,
    x_label: str,
    good_below: float | None = None,
    good_from: float | None = None,
) -> str:
    """A table of numbers coloured by their logarithm.

    Args:
        values: (rows, columns); nan is grey.
        rows, columns: names.
        title, x_label: texts.
        good_below: smaller values are green, others red.
        good_from: values from here on are green, others red.
    """
    data = np.asarray(values, dtype=np.float64)
    figure = blank(110 + 52 * len(columns), 80 + 24 * len(rows))
    axes = axes_of(figure, title, x_label, "")
    with np.errstate(divide="ignore", invalid="ignore"):
        log = np.log10(np.where(data > 0, data, np.nan))
    some = log[np.isfinite(log)]
    low, high = (float(some.min()), float(some.max())) if some.size else (-1.0, 0.0)
    dark = np.nan_to_num((log - low) / max(high - low, 1e-12)).clip(0.0, 1.0)
    good = np.zeros(data.shape, dtype=bool)
    if good_from is not None:
        good, dark = data >= good_from, np.zeros_like(dark)
    elif good_below is not None:
        good = data < good_below
    tint = np.where(good[..., None], (-50.0, 0.0, -40.0), (0.0, -50.0, -55.0))
    colours = (235.0 - 90.0 * dark[..., None] + tint) / 255.0
    axes.imshow(np.where(np.isfinite(data)[..., None], colours, 0.87), aspect="auto")
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    for (i, j), value in np.ndenumerate(data):
        axes.text(j, i, cell_text(float(value)), ha="center", va="center", size=9)
    return svg(figure)
