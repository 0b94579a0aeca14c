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
    good_from: float = 1.0,
) -> str:
    """A table of numbers, green where they are good and red where not.

    Args:
        values: (rows, columns); nan is white.
        rows, columns: names.
        title, x_label: texts.
        good_below: smaller values are good, the more the smaller.
        good_from: where no `good_below` is given: values from here on are good.
    """
    data = np.asarray(values, dtype=np.float64)
    figure = blank(110 + 52 * len(columns), 80 + 24 * len(rows))
    axes = axes_of(figure, title, x_label, "")
    worse = np.where(data >= good_from, -0.5, 0.5)
    if good_below is not None:
        worse = np.log10(np.maximum(data, 1e-9) / good_below)
    axes.imshow(
        np.where(np.isfinite(data), worse, np.nan), "RdYlGn_r", aspect="auto", vmin=-2, vmax=2
    )
    axes.set_xticks(range(len(columns)), columns)
    axes.set_yticks(range(len(rows)), rows)
    for (i, j), value in np.ndenumerate(data):
        axes.text(j, i, cell_text(float(value)), ha="center", va="center", size=9)
    return svg(figure)
