"""Figures as SVG text: line plots, scatter plots, heat maps, ellipses. No dependencies.

It refuses to know what the numbers mean.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

COLOURS = ("#1b6ca8", "#c8553d", "#3a7d44", "#8e5ea2", "#b58900", "#17889b", "#9b2226", "#5f6c7b")
Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Series:
    """Points of one name; joined by a line, or dots only."""

    name: str
    x: npt.ArrayLike
    y: npt.ArrayLike
    line: bool = True


def plot(
    series: Sequence[Series],
    *,
    title: str,
    x_label: str,
    y_label: str,
    width: int = 620,
    height: int = 260,
    flip_y: bool = False,
    equal: bool = False,
) -> str:
    """A plot with axes, ticks and a legend, as an SVG element."""
    xs = np.concatenate(
        [np.asarray(s.x, dtype=np.float64).ravel() for s in series] or [np.zeros(1)]
    )
    ys = np.concatenate(
        [np.asarray(s.y, dtype=np.float64).ravel() for s in series] or [np.zeros(1)]
    )
    good = np.isfinite(xs) & np.isfinite(ys)
    box = _Box.around(xs[good], ys[good], width, height, flip_y, equal)
    parts = [_frame(box, title, x_label, y_label)]
    for i, s in enumerate(series):
        colour = COLOURS[i % len(COLOURS)]
        x, y = np.asarray(s.x, dtype=np.float64), np.asarray(s.y, dtype=np.float64)
        keep = np.isfinite(x) & np.isfinite(y)
        px, py = box.at(x[keep], y[keep])
        if s.line:
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(px, py, strict=True))
            parts.append(
                f'<polyline points="{path}" fill="none" stroke="{colour}" stroke-width="1.2"/>'
            )
        else:
            parts += _dots(px, py, 1.6, colour)
        parts.append(_legend(box, i, colour, s.name))
    return _svg(width + 110, height, parts)


def arrows(
    groups: Sequence[tuple[str, Floats, Floats]],
    size: tuple[int, int],
    *,
    title: str,
    factor: float,
    width: int = 620,
) -> str:
    """Arrows over an image plane, row 0 at the top.

    Args:
        groups: name, places (m, 2) as (column, row), and vectors (m, 2) alike; nan: none.
        size: of the plane, (rows, cols).
        title: of the figure.
        factor: by which vectors are enlarged.
        width: of the drawing.
    """
    rows, cols = size
    height = int(66 + (width - 74) * rows / cols)
    box = _Box(0.0, float(cols), 0.0, float(rows), 62.0, width - 12.0, 28.0, height - 38.0, True)
    parts = [_frame(box, title, "column (px)", "row (px)")]
    for i, (name, places, vectors) in enumerate(groups):
        colour = COLOURS[i % len(COLOURS)]
        keep = np.isfinite(places).all(axis=1) & np.isfinite(vectors).all(axis=1)
        start, stop = places[keep], places[keep] + factor * vectors[keep]
        x0, y0 = box.at(start[:, 0], start[:, 1])
        x1, y1 = box.at(stop[:, 0], stop[:, 1])
        path = "".join(
            f"M{a:.1f},{b:.1f}L{c:.1f},{d:.1f}" for a, b, c, d in zip(x0, y0, x1, y1, strict=True)
        )
        parts.append(f'<path d="{path}" fill="none" stroke="{colour}"/>')
        parts += _dots(x0, y0, 1.1, colour)
        parts.append(_legend(box, i, colour, name))
    return _svg(width + 110, height, parts)


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
    """A table of numbers coloured by their logarithm, green below `good_below` or from `good_from`;
    nan is grey."""
    data = np.asarray(values, dtype=np.float64)
    cell, tall, left, top = 52, 24, 90, 46
    width, height = left + cell * len(columns) + 10, top + tall * len(rows) + 34
    parts = [f'<text x="8" y="16" font-size="13" font-weight="600">{html.escape(title)}</text>']
    finite = data[np.isfinite(data) & (data > 0)]
    low = math.log10(float(finite.min())) if finite.size else -1.0
    high = math.log10(float(finite.max())) if finite.size else 0.0
    for j, name in enumerate(columns):
        parts.append(
            f'<text x="{left + cell * (j + 0.5)}" y="{top - 6}" text-anchor="middle" '
            f'font-size="11">{html.escape(name)}</text>'
        )
    for i, name in enumerate(rows):
        y = top + tall * i
        parts.append(
            f'<text x="{left - 8}" y="{y + 16}" text-anchor="end" font-size="11">'
            f"{html.escape(name)}</text>"
        )
        for j in range(len(columns)):
            value = float(data[i, j])
            x = left + cell * j
            parts.append(
                f'<rect x="{x}" y="{y}" width="{cell - 2}" height="{tall - 2}" '
                f'fill="{_fill(value, low, high, good_below, good_from)}"/>'
                f'<text x="{x + cell / 2 - 1}" y="{y + 15}" text-anchor="middle" '
                f'font-size="10">{_short(value)}</text>'
            )
    parts.append(
        f'<text x="{left + cell * len(columns) / 2}" y="{height - 12}" text-anchor="middle" '
        f'font-size="11">{html.escape(x_label)}</text>'
    )
    return _svg(width, height, parts)


def ellipse_plot(
    covariance: npt.ArrayLike, names: tuple[str, str], scale: float, *, size: int = 190
) -> str:
    """The ellipse of a 2 x 2 covariance at `scale` standard deviations, about zero."""
    c = np.asarray(covariance, dtype=np.float64)
    values, vectors = np.linalg.eigh(c)
    t = np.linspace(0, 2 * math.pi, 90)
    ring = vectors @ (
        scale * np.sqrt(np.maximum(values, 0.0))[:, None] * np.stack([np.cos(t), np.sin(t)])
    )
    return plot(
        [Series("", ring[0], ring[1])],
        title=f"{names[1]} against {names[0]}",
        x_label=names[0],
        y_label=names[1],
        width=size + 60,
        height=size,
    )


def image_under(
    values: npt.ArrayLike, points: Sequence[Series], *, title: str, width: int = 620
) -> str:
    """A grey image with points over it; x and y of the points are its columns and rows."""
    import base64

    import cv2

    data = np.asarray(values, dtype=np.float64)
    rows, cols = data.shape
    low, high = np.percentile(data, [0.5, 99.7])
    grey = 255 - np.clip((data - low) / max(high - low, 1e-9) * 235, 0, 235)
    scale = width / cols
    small = cv2.resize(
        grey.astype(np.uint8), (width, round(rows * scale)), interpolation=cv2.INTER_AREA
    )
    _, encoded = cv2.imencode(".png", small)
    payload = base64.b64encode(encoded.tobytes()).decode("ascii")
    parts = [
        f'<text x="4" y="15" font-size="13" font-weight="600">{html.escape(title)}</text>',
        f'<image x="0" y="22" width="{small.shape[1]}" height="{small.shape[0]}" '
        f'href="data:image/png;base64,{payload}"/>',
    ]
    for i, s in enumerate(points):
        x, y = np.asarray(s.x, dtype=np.float64), np.asarray(s.y, dtype=np.float64)
        colour = COLOURS[i % len(COLOURS)]
        for a, b in zip(x, y, strict=True):
            if math.isfinite(a) and math.isfinite(b):
                parts.append(
                    f'<circle cx="{(a + 0.5) * scale:.1f}" cy="{22 + (b + 0.5) * scale:.1f}" '
                    f'r="1.3" fill="{colour}"/>'
                )
        parts.append(
            f'<text x="{width + 6}" y="{36 + 14 * i}" fill="{colour}" font-size="11">'
            f"{html.escape(s.name)}</text>"
        )
    return _svg(width + 90, small.shape[0] + 26, parts)


@dataclass(frozen=True)
class _Box:
    """Data to drawing coordinates."""

    x0: float
    x1: float
    y0: float
    y1: float
    left: float
    right: float
    top: float
    bottom: float
    flip: bool

    @classmethod
    def around(cls, x: Floats, y: Floats, width: int, height: int, flip: bool, equal: bool) -> _Box:
        def span(v: Floats) -> tuple[float, float]:
            if v.size == 0:
                return 0.0, 1.0
            a, b = float(v.min()), float(v.max())
            pad = 0.05 * (b - a) or 0.5 * abs(a) or 0.5
            return a - pad, b + pad

        (x0, x1), (y0, y1) = span(x), span(y)
        left, right, top, bottom = 62.0, width - 12.0, 28.0, height - 38.0
        if equal:
            per = max((x1 - x0) / (right - left), (y1 - y0) / (bottom - top))
            cx, cy = (x0 + x1) / 2, (y0 + y1) / 2
            x0, x1 = cx - per * (right - left) / 2, cx + per * (right - left) / 2
            y0, y1 = cy - per * (bottom - top) / 2, cy + per * (bottom - top) / 2
        return cls(x0, x1, y0, y1, left, right, top, bottom, flip)

    def at(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        px = self.left + (x - self.x0) / (self.x1 - self.x0) * (self.right - self.left)
        part = (y - self.y0) / (self.y1 - self.y0)
        if not self.flip:
            part = 1.0 - part
        return px, self.top + part * (self.bottom - self.top)


def _frame(box: _Box, title: str, x_label: str, y_label: str) -> str:
    parts = [
        f'<rect x="{box.left}" y="{box.top}" width="{box.right - box.left}" '
        f'height="{box.bottom - box.top}" fill="none" stroke="#9aa5b1"/>',
        f'<text x="{box.left}" y="18" font-size="13" font-weight="600">{html.escape(title)}</text>',
        f'<text x="{(box.left + box.right) / 2}" y="{box.bottom + 32}" text-anchor="middle" '
        f'font-size="11">{html.escape(x_label)}</text>',
        f'<text x="14" y="{(box.top + box.bottom) / 2}" text-anchor="middle" font-size="11" '
        f'transform="rotate(-90 14 {(box.top + box.bottom) / 2})">{html.escape(y_label)}</text>',
    ]
    for value in _ticks(box.x0, box.x1):
        px, _ = box.at(np.array([value]), np.array([box.y0]))
        parts.append(
            f'<line x1="{px[0]:.1f}" x2="{px[0]:.1f}" y1="{box.bottom}" y2="{box.bottom + 4}" '
            f'stroke="#9aa5b1"/><text x="{px[0]:.1f}" y="{box.bottom + 16}" '
            f'text-anchor="middle" font-size="10">{_short(value)}</text>'
        )
    for value in _ticks(box.y0, box.y1):
        _, py = box.at(np.array([box.x0]), np.array([value]))
        parts.append(
            f'<line x1="{box.left - 4}" x2="{box.left}" y1="{py[0]:.1f}" y2="{py[0]:.1f}" '
            f'stroke="#9aa5b1"/><text x="{box.left - 6}" y="{py[0] + 3:.1f}" '
            f'text-anchor="end" font-size="10">{_short(value)}</text>'
        )
    return "".join(parts)


def _dots(x: Floats, y: Floats, radius: float, colour: str) -> list[str]:
    return [
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="{radius}" fill="{colour}"/>'
        for a, b in zip(x, y, strict=True)
    ]


def _legend(box: _Box, line: int, colour: str, name: str) -> str:
    return (
        f'<text x="{box.right + 8}" y="{box.top + 12 + 14 * line}" fill="{colour}" '
        f'font-size="11">{html.escape(name)}</text>'
    )


def _ticks(low: float, high: float) -> list[float]:
    span = high - low
    step = 10.0 ** math.floor(math.log10(span / 4))
    for factor in (1, 2, 5, 10):
        if span / (step * factor) <= 6:
            step *= factor
            break
    first = math.ceil(low / step)
    return [i * step for i in range(first, math.floor(high / step) + 1)]


def _short(value: float) -> str:
    if not math.isfinite(value):
        return "-"
    return (
        f"{value:.2g}"
        if value != 0 and (abs(value) < 0.01 or abs(value) >= 1e4)
        else f"{value:.4g}"
    )


def _fill(
    value: float, low: float, high: float, good_below: float | None, good_from: float | None
) -> str:
    """Green from `good_from`, if that is asked for; else as `_shade`."""
    if good_from is None or not math.isfinite(value):
        return _shade(value, low, high, good_below)
    return "#cfe8d5" if value >= good_from else "#e9b8b3"


def _shade(value: float, low: float, high: float, good_below: float | None) -> str:
    if not math.isfinite(value):
        return "#d9dee3"
    part = 0.0 if value <= 0 or high <= low else (math.log10(value) - low) / (high - low)
    light = int(235 - 90 * min(max(part, 0.0), 1.0))
    if good_below is not None and value < good_below:
        return f"rgb({light - 50},{light},{light - 40})"
    return f"rgb({light},{light - 50},{light - 55})"


def _svg(width: float, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}" font-family="system-ui, sans-serif">'
        + "".join(parts)
        + "</svg>"
    )


PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<style>
body {{ font-family: system-ui, sans-serif; margin: 2rem auto; max-width: 62rem; color: #1f2933; }}
table {{ border-collapse: collapse; margin: 1rem 0; }}
td, th {{ border: 1px solid #cbd2d9; padding: .25rem .6rem; text-align: right; font-size: .85rem; }}
th {{ background: #f0f3f6; }} td:first-child, th:first-child {{ text-align: left; }}
.bad {{ color: #9b2226; font-weight: 600; }} .good {{ color: #2d6a4f; font-weight: 600; }}
figure {{ display: inline-block; margin: .5rem 1rem .5rem 0; }}
</style></head><body>
{body}
</body></html>
"""


def page(title: str, body: Sequence[str]) -> str:
    """A whole HTML page that needs nothing else."""
    return PAGE.format(title=html.escape(title), body="\n".join(body))


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """An HTML table; cells are escaped."""
    top = "".join(f"<th>{html.escape(h)}</th>" for h in head)
    body = "".join(
        "<tr>" + "".join(f"<td>{html.escape(cell_text(c))}</td>" for c in row) + "</tr>"
        for row in rows
    )
    return f"<table><tr>{top}</tr>{body}</table>"


def cell_text(value: object) -> str:
    """A table cell: numbers short, None as a dash."""
    match value:
        case None:
            return "-"
        case bool():
            return "yes" if value else "no"
        case float():
            return _short(value)
        case _:
            return str(value)
