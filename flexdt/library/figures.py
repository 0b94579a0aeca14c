"""Figures as SVG text, drawn with matplotlib; pages are of `flexdt.library.report_page`.

matplotlib is imported when the first figure is drawn.
"""

from __future__ import annotations

import html
import io
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from flexdt.library.optional.extras import package

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = (
    "#1b6ca8",
    "#c8553d",
    "#3a7d44",
    "#8e5ea2",
    "#b58900",
    "#17889b",
    "#9b2226",
    "#5f6c7b",
)
MARK_COLOUR = "#c62828"
Floats = npt.NDArray[np.float64]
DPI = 72.0
"""Resolution at which pixels, the unit of the sizes below, are matplotlib's points."""


@dataclass(frozen=True, eq=False)
class Series:
    """Points of one name; joined by a line, or dots only."""

    name: str
    x: npt.ArrayLike
    y: npt.ArrayLike
    line: bool = True


def require_plots() -> None:
    """Check that figures can be drawn, before the work whose result they are to show.

    Raises:
        TwinError: matplotlib is not installed.
    """
    package("matplotlib", "a figure", "plots")


def blank(width: float, height: float) -> Figure:
    """Make an empty figure that belongs to no window.

    Args:
        width, height: [px], at `DPI`.

    Raises:
        TwinError: matplotlib is missing.
    """
    require_plots()
    from matplotlib.figure import Figure

    return Figure(figsize=(width / DPI, height / DPI), dpi=DPI, layout="constrained")


def svg(figure: Figure) -> str:
    """Render a figure as an SVG element: text stays text, no point is left out, and equal
    figures have equal ids; without date and XML header.
    """
    import matplotlib as mpl

    text = io.StringIO()
    # Text stays text, so that a page can be searched; every point that is given is drawn; and
    # the same figure gives the same ids.
    settings = {"svg.fonttype": "none", "path.simplify": False, "svg.hashsalt": "flexdt"}
    with mpl.rc_context(settings):  # type: ignore[arg-type]
        figure.savefig(text, format="svg", metadata={"Date": None})
    whole = text.getvalue()
    return whole[whole.index("<svg") :]


def plot(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    width: int = 730,
    height: int = 260,
    flip_y: bool = False,
    equal: bool = False,
    marks: Iterable[tuple[float, str]] = (),
) -> str:
    """Draw lines and dots over two axes, as an SVG element.

    Colors repeat after the last one. x and y of a series are data units.

    Args:
        series: the lines and dots; points that are not finite are left out.
        title, x_label, y_label: texts.
        width, height: of the figure [px].
        flip_y: y grows downwards, as rows of an image do.
        equal: one unit is as long in x as in y.
        marks: x and text of vertical lines; browsers show the text under the pointer.
    """
    figure = blank(width, height)
    marked = list(marks)
    axes = axes_of(figure, title, x_label, y_label)
    for s, colour in zip(series, cycle(COLOURS), strict=False):
        style: dict[str, Any]
        if s.line:
            style = {"lw": 1.2}
        else:
            style = {"ls": "", "marker": ".", "ms": 3.2}
        x = np.asarray(s.x, dtype=np.float64)
        y = np.asarray(s.y, dtype=np.float64)
        axes.plot(x, y, color=colour, label=s.name, gid=_id(title, s.name), **style)
    for k, (at, _) in enumerate(marked):
        axes.axvline(at, color=MARK_COLOUR, lw=1.2, gid=_id(title, "mark", k))
    if flip_y:
        axes.invert_yaxis()
    if equal:
        axes.set_aspect("equal", adjustable="datalim")
    _legend(figure, series)
    text = svg(figure)
    for k, (_, words) in enumerate(marked):
        group = f'<g id="{_id(title, "mark", k)}">'
        text = text.replace(group, f"{group}<title>{html.escape(words)}</title>", 1)
    return text


def arrows(
    groups: Sequence[tuple[str, Floats, Floats]],
    size: tuple[int, int],
    *,
    title: str,
    factor: float,
) -> str:
    """Draw vectors over an image plane, row 0 at the top, each with a dot where it
    begins.

    Args:
        groups: name, places (m, 2) as (column, row) [px], and vectors (m, 2) alike; a
            pair that is not finite is left out.
        size: of the plane, (rows, cols).
        title: of the figure.
        factor: by which vectors are enlarged.
    """
    rows, cols = size
    figure = blank(730, 60 + 570 * rows / cols)
    axes = axes_of(figure, title, "column (px)", "row (px)")
    axes.set(xlim=(0, cols), ylim=(rows, 0), aspect="equal")
    for (name, places, vectors), colour in zip(groups, cycle(COLOURS), strict=False):
        keep = np.isfinite(places).all(axis=1) & np.isfinite(vectors).all(axis=1)
        start = places[keep]
        stop = places[keep] + factor * vectors[keep]
        # One line for all vectors of a group, interrupted by nan after each.
        ends = np.stack([start, stop, np.full_like(start, np.nan)], axis=1).reshape(-1, 2)
        gid = _id(title, name)
        axes.plot(*ends.T, color=colour, lw=1.0, clip_on=False, gid=gid)
        axes.plot(*start.T, ".", color=colour, ms=2.2, label=name, gid=f"{gid}-places")
    _legend(figure, groups)
    return svg(figure)


def ellipse_plot(covariance: npt.ArrayLike, names: tuple[str, str], scale: float) -> str:
    """Draw the ellipse of a covariance about zero; negative eigenvalues count as 0.

    Args:
        covariance: (2, 2).
        names: of its two parameters, for the axes.
        scale: standard deviations.

    Returns:
        SVG.
    """
    values, vectors = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    t = np.linspace(0, 2 * math.pi, 90)
    ring = vectors @ (
        scale
        * np.sqrt(np.maximum(values, 0.0))[:, None]
        * np.stack([np.cos(t), np.sin(t)])
    )
    return plot(
        [Series("", *ring)],
        title=f"{names[1]} against {names[0]}",
        x_label=names[0],
        y_label=names[1],
        width=270,
        height=210,
    )


def image_under(
    values: npt.ArrayLike, points: Sequence[Series], *, title: str, width: int = 730
) -> str:
    """Draw a gray image with points over it.

    Large values are dark; without points there is no legend.

    Args:
        values: (rows, cols); black and white are the percentiles 99.7 and 0.5.
        points: their x and y are columns and rows.
        title: of the figure.
        width: of the figure [px].

    Returns:
        SVG.
    """
    data = np.asarray(values, dtype=np.float64)
    figure = blank(
        width, 26 + (width - 90 * bool(points)) * data.shape[0] / data.shape[1]
    )
    axes = axes_of(figure, title, "", "")
    low, high = np.percentile(data, [0.5, 99.7])
    axes.imshow(data, cmap="gray_r", vmin=low, vmax=high)
    axes.set_axis_off()
    for s, colour in zip(points, cycle(COLOURS), strict=False):
        axes.plot(s.x, s.y, ".", color=colour, ms=2.6, label=s.name)
    _legend(figure, points)
    return svg(figure)


def axes_of(figure: Figure, title: str, x_label: str, y_label: str) -> Axes:
    """Add axes to a figure, with a title and labels."""
    axes = figure.add_subplot()
    axes.set_title(title, size=10, weight="bold", loc="left")
    axes.set_xlabel(x_label, size=9)
    axes.set_ylabel(y_label, size=9)
    axes.tick_params(labelsize=8)
    return axes


def _id(*words: object) -> str:
    """Make the id of a part of a figure."""
    return re.sub(r"\W+", "-", " ".join(map(str, words)))


def _legend(
    figure: Figure, series: Sequence[Series | tuple[str, Floats, Floats]]
) -> None:
    if any(s.name if isinstance(s, Series) else s[0] for s in series):
        figure.legend(loc="outside right upper", fontsize=8, frameon=False)
